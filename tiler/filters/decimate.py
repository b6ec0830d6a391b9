"""The hot loops: level n to level n + 1, arrays in, arrays out. numba, outside the GIL, no Python objects.

Every output sample is computed by the same operations in the same order wherever it lies in an array, and no
fast-math flag lets the compiler reorder or fuse them: so results do not depend on how a level is split into pieces, and
NaN checks stay. Sums are taken over differences to a reference sample, which keeps a constant bit-constant and loses
no accuracy on a large offset (error at 1e7 with unit noise: 0.5 instead of 2.0).
"""

import numba
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Flags = NDArray[np.uint8]
Bounds = tuple[int, int, int, int]

_CHUNK = 1024
"""Columns filtered at once: reference and sum (8 KiB) stay in the first-level cache."""

ENOUGH_WEIGHT = 0.5
FULL_WEIGHT = 0.9
"""Between these sums of weights the sinc takes over from the covering kernel (see ``coarsen_partial``)."""


@numba.njit(nogil=True, cache=True)
def coarsen_rows(fine: Float32, first: int, low: Int64, high: Int64, weights: Float32, twin: int, coarse: Float32) -> None:
    """Filter and halve along rows: ``coarse`` (m, n) from ``fine`` (rows, n).

    Coarse row j is centred on fine row ``first + 2j`` (``twin`` 0, point) or between it and the next (``twin`` 1, area).
    """
    width = fine.shape[1]
    reference = np.empty(_CHUNK, np.float32)
    total = np.empty(_CHUNK, np.float32)
    half = np.float32(0.5)
    for j in range(coarse.shape[0]):
        centre = first + 2 * j
        for start in range(0, width, _CHUNK):
            size = min(_CHUNK, width - start)
            upper = fine[centre, start : start + size]
            lower = fine[centre + twin, start : start + size]
            for x in range(size):
                reference[x] = half * (upper[x] + lower[x])
                total[x] = np.float32(0)
            for k in range(weights.size):
                weight = weights[k]
                before = fine[centre + low[k], start : start + size]
                after = fine[centre + high[k], start : start + size]
                for x in range(size):
                    total[x] += weight * ((before[x] - reference[x]) + (after[x] - reference[x]))
            out = coarse[j, start : start + size]
            for x in range(size):
                out[x] = reference[x] + total[x]


@numba.njit(nogil=True, cache=True)
def coarsen_columns(fine: Float32, first: int, low: Int64, high: Int64, weights: Float32, twin: int, coarse: Float32) -> None:
    """Filter and halve along columns: ``coarse`` (m, n, c) from ``fine`` (m, columns, c).

    Coarse column i is centred on fine column ``first + 2i``. Even and odd columns are first laid apart, so that the sums
    run over contiguous memory.
    """
    rows, columns, channels = fine.shape
    width = coarse.shape[1]
    halves = np.empty((2, columns // 2 + 1), np.float32)
    reference = np.empty(width, np.float32)
    total = np.empty(width, np.float32)
    half = np.float32(0.5)
    for j in range(rows):
        for channel in range(channels):
            for x in range(columns // 2):
                halves[0, x] = fine[j, 2 * x, channel]
                halves[1, x] = fine[j, 2 * x + 1, channel]
            if columns % 2:
                halves[0, columns // 2] = fine[j, columns - 1, channel]
            left = halves[first % 2, first // 2 :]
            right = halves[(first + twin) % 2, (first + twin) // 2 :]
            for i in range(width):
                reference[i] = half * (left[i] + right[i])
                total[i] = np.float32(0)
            for k in range(weights.size):
                weight = weights[k]
                before = halves[(first + low[k]) % 2, (first + low[k]) // 2 :]
                after = halves[(first + high[k]) % 2, (first + high[k]) // 2 :]
                for i in range(width):
                    total[i] += weight * ((before[i] - reference[i]) + (after[i] - reference[i]))
            for i in range(width):
                coarse[j, i, channel] = reference[i] + total[i]


@numba.njit(nogil=True, cache=True)
def flag_partial(coverage: Float32, first_row: int, first_column: int, offsets: Int64, flags: Flags) -> int:
    """Set ``flags`` (m, n) to 1 where any sample under the taps has a coverage below 1; return how many were set.

    ``coverage`` is (rows, columns); ``offsets`` are all taps of the kernel; coarse (j, i) is centred on fine
    ``(first_row + 2j, first_column + 2i)``.
    """
    height, width = flags.shape
    columns = coverage.shape[1]
    below = np.empty(columns, np.uint8)
    count = 0
    for j in range(height):
        centre = first_row + 2 * j
        found = np.uint8(0)
        for x in range(columns):
            below[x] = np.uint8(0)
        for offset in offsets:
            for x in range(columns):
                below[x] |= np.uint8(coverage[centre + offset, x] < np.float32(1))
        for x in range(columns):
            found |= below[x]
        for i in range(width):
            flag = np.uint8(0)
            if found:
                for offset in offsets:
                    flag |= below[first_column + 2 * i + offset]
            flags[j, i] = flag
            count += int(flag)
    return count


@numba.njit(nogil=True, cache=True)
def _weight(coverage: Float32, row: int, column: int, offsets: Int64, weights: Float64) -> float:
    """Sum of separable weights times coverage around (row, column)."""
    total = 0.0
    for a in range(offsets.size):
        for b in range(offsets.size):
            total += weights[a] * weights[b] * coverage[row + offsets[a], column + offsets[b]]
    return total


@numba.njit(nogil=True, cache=True)
def _peak(coverage: Float32, row: int, column: int, offsets: Int64) -> float:
    """Largest coverage under the taps around (row, column)."""
    largest = 0.0
    for a in range(offsets.size):
        for b in range(offsets.size):
            largest = max(largest, coverage[row + offsets[a], column + offsets[b]])
    return largest


@numba.njit(nogil=True, cache=True)
def _moment(
    fine: Float32, channel: int, reference: float, coverage: Float32, row: int, column: int, offsets: Int64, weights: Float64
) -> float:
    """Sum of separable weights times coverage times (value - reference) around (row, column)."""
    total = 0.0
    for a in range(offsets.size):
        for b in range(offsets.size):
            y, x = row + offsets[a], column + offsets[b]
            total += weights[a] * weights[b] * coverage[y, x] * (fine[y, x, channel] - reference)
    return total


@numba.njit(nogil=True, cache=True)
def coarsen_partial(
    fine: Float32,
    coverage: Float32,
    first_row: int,
    first_column: int,
    offsets: Int64,
    weights: Float64,
    covering_offsets: Int64,
    covering_weights: Float64,
    flags: Flags,
    coarse: Float32,
    coarse_coverage: Float32,
) -> None:
    """Recompute the flagged samples of ``coarse`` (m, n, c) by guarded normalised convolution; set ``coarse_coverage`` (m, n).

    With w the kernel, p the covering kernel, v the coverage and z the values: W = sum w v, Wp = sum p v. Wp is the coarse coverage;
    where it is 0 the sample is void. Elsewhere the value goes from sum p v z / Wp (share up to 0.5) to sum w v z / W (share from 0.9)
    by a smooth step of the share W / max v, so its gain is at most 2 (sum |w|)**2, where sum w v z / W alone is unbounded. Dividing
    by max v keeps an evenly half-transparent picture as sharp as an opaque one. Sums are float64.
    """
    for j in range(flags.shape[0]):
        row = first_row + 2 * j
        for i in range(flags.shape[1]):
            if not flags[j, i]:
                coarse_coverage[j, i] = np.float32(1)
                continue
            column = first_column + 2 * i
            covered = _weight(coverage, row, column, covering_offsets, covering_weights)
            coarse_coverage[j, i] = np.float32(covered)
            if covered == 0.0:
                coarse[j, i] = np.float32(0)
                continue
            weight = _weight(coverage, row, column, offsets, weights)
            share = weight / _peak(coverage, row, column, offsets)
            t = min(max((share - ENOUGH_WEIGHT) / (FULL_WEIGHT - ENOUGH_WEIGHT), 0.0), 1.0)
            blend = t * t * (3.0 - 2.0 * t)
            for channel in range(fine.shape[2]):
                mean = _moment(fine, channel, 0.0, coverage, row, column, covering_offsets, covering_weights) / covered
                detail = 0.0
                if blend > 0.0:
                    detail = blend / weight * _moment(fine, channel, mean, coverage, row, column, offsets, weights)
                coarse[j, i, channel] = np.float32(mean + detail)


@numba.njit(nogil=True, cache=True)
def _range_of_rows(fine: Float32, coverage: Float32, centre: int, offsets: Int64, inside: Bounds, low: Float32, high: Float32) -> None:
    """Set ``low`` and ``high`` (columns, c) to the range of each column of ``fine`` over the taps around row ``centre``."""
    low[:] = np.float32(np.inf)
    high[:] = np.float32(-np.inf)
    masked = coverage.size > 0
    for offset in offsets:
        y = centre + offset
        if y < inside[0] or y >= inside[1]:
            continue
        for x in range(inside[2], inside[3]):
            if masked and coverage[y, x] == 0:
                continue
            for channel in range(fine.shape[2]):
                low[x, channel] = min(low[x, channel], fine[y, x, channel])
                high[x, channel] = max(high[x, channel], fine[y, x, channel])


@numba.njit(nogil=True, cache=True)
def clamp_to_support(
    fine: Float32, coverage: Float32, first_row: int, first_column: int, offsets: Int64, inside: Bounds, coarse: Float32
) -> None:
    """Clamp ``coarse`` (m, n, c) to the range of the samples of ``fine`` under its taps.

    Only samples of the level itself count, rows ``inside[0]`` up to before ``inside[1]`` and columns ``inside[2]`` up to before
    ``inside[3]``, and only those with some ``coverage`` (all, if it is empty): what an edge rule made up or what a void hides
    does not widen the range.
    """
    low = np.empty(fine.shape[1:], np.float32)
    high = np.empty(fine.shape[1:], np.float32)
    for j in range(coarse.shape[0]):
        _range_of_rows(fine, coverage, first_row + 2 * j, offsets, inside, low, high)
        for i in range(coarse.shape[1]):
            for channel in range(coarse.shape[2]):
                least, most = np.float32(np.inf), np.float32(-np.inf)
                for offset in offsets:
                    x = first_column + 2 * i + offset
                    if inside[2] <= x < inside[3]:
                        least, most = min(least, low[x, channel]), max(most, high[x, channel])
                if least <= most:
                    coarse[j, i, channel] = min(max(coarse[j, i, channel], least), most)
