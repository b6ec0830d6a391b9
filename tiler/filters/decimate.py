"""The hot loops: level n to level n + 1, arrays in, arrays out. numba, outside the GIL, no Python objects.

Every output sample is computed by the same operations in the same order wherever it lies in an array, and no
fast-math flag lets the compiler reorder or fuse them: so results do not depend on how a level is split into pieces, and
NaN checks stay. Sums are taken over differences to a reference sample, which keeps a constant bit-constant and loses
no accuracy on a large offset (error at 1e7 with unit noise: 0.5 instead of 2.0).
"""

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Flags = NDArray[np.uint8]
Integers = NDArray[np.uint8] | NDArray[np.uint16]
Bounds = tuple[int, int, int, int]

_CHUNK = 1024
"""Samples of a row filtered at once: what is summed (8 KiB) stays in the first-level cache, integers as float32 (310 KiB) in the second."""

ENOUGH_WEIGHT = 0.5
FULL_WEIGHT = 0.9
"""Between these sums of weights the sinc takes over from the covering kernel (see ``coarsen_partial``)."""


@compiled
def _sum_pairs(
    source: Float32, low: Int64, high: Int64, row: int, column: int, weights: Float32, reference: Float32, total: Float32
) -> None:
    """Set ``total`` to ``reference`` plus the weighted differences to it, for every sample of ``total``.

    Tap k is ``source`` at rows ``row + low[0, k]`` and ``row + high[0, k]``, from columns ``column + low[1, k]`` and
    ``column + high[1, k]`` on. Three taps go at a time: sums are fetched and stored a third as often, which takes 0.7 of the time.
    """
    size = total.size
    for x in range(size):
        total[x] = np.float32(0)
    k = 0
    while k + 3 <= weights.size:
        w0, w1, w2 = weights[k], weights[k + 1], weights[k + 2]
        before0, after0 = source[row + low[0, k], column + low[1, k] :], source[row + high[0, k], column + high[1, k] :]
        before1, after1 = source[row + low[0, k + 1], column + low[1, k + 1] :], source[row + high[0, k + 1], column + high[1, k + 1] :]
        before2, after2 = source[row + low[0, k + 2], column + low[1, k + 2] :], source[row + high[0, k + 2], column + high[1, k + 2] :]
        for x in range(size):
            base = reference[x]
            partial = total[x] + w0 * ((before0[x] - base) + (after0[x] - base))
            partial = partial + w1 * ((before1[x] - base) + (after1[x] - base))
            total[x] = partial + w2 * ((before2[x] - base) + (after2[x] - base))
        k += 3
    while k < weights.size:
        weight = weights[k]
        before, after = source[row + low[0, k], column + low[1, k] :], source[row + high[0, k], column + high[1, k] :]
        for x in range(size):
            base = reference[x]
            total[x] += weight * ((before[x] - base) + (after[x] - base))
        k += 1
    for x in range(size):
        total[x] = reference[x] + total[x]


@compiled
def _places(first: int, offsets: Int64, channels: int) -> Int64:
    """Return (2, taps): for taps around column ``first``, which half holds them (0 even, 1 odd columns) and where it begins there."""
    places = np.empty((2, offsets.size), np.int64)
    for k in range(offsets.size):
        places[0, k] = (first + offsets[k]) % 2
        places[1, k] = (first + offsets[k]) // 2 * channels
    return places


@compiled
def _in_rows(offsets: Int64) -> Int64:
    """Return (2, taps): ``offsets`` as rows, and no columns."""
    places = np.zeros((2, offsets.size), np.int64)
    places[0] = offsets
    return places


@compiled
def _coarsen_part(
    fine: Float32, first: int, column: int, low: Int64, high: Int64, weights: Float32, twin: int, start: int, size: int, coarse: Float32
) -> None:
    """Filter ``size`` columns of ``fine`` from ``column`` on into those of ``coarse`` from ``start`` on."""
    reference = np.empty(size, np.float32)
    half = np.float32(0.5)
    for j in range(coarse.shape[0]):
        centre = first + 2 * j
        upper, lower = fine[centre, column:], fine[centre + twin, column:]
        for x in range(size):
            reference[x] = half * (upper[x] + lower[x])
        _sum_pairs(fine, low, high, centre, column, weights, reference, coarse[j, start : start + size])


@compiled
def coarsen_rows(fine: Float32, first: int, low: Int64, high: Int64, weights: Float32, twin: int, coarse: Float32) -> None:
    """Filter and halve along rows: ``coarse`` (m, n) from ``fine`` (rows, n).

    Coarse row j is centred on fine row ``first + 2j`` (``twin`` 0, point) or between it and the next (``twin`` 1, area).
    """
    width = fine.shape[1]
    before, after = _in_rows(low), _in_rows(high)
    for start in range(0, width, _CHUNK):
        _coarsen_part(fine, first, start, before, after, weights, twin, start, min(_CHUNK, width - start), coarse)


@compiled
def coarsen_rows_of_integers(fine: Integers, first: int, low: Int64, high: Int64, weights: Float32, twin: int, coarse: Float32) -> None:
    """Do what ``coarsen_rows`` does with ``fine`` (rows, n) of whole numbers, to the same bits: they become float32 on the way.

    A part of all rows is converted at a time, so that an 8-bit picture moves through memory as one byte a sample, not as four.
    """
    width = fine.shape[1]
    before, after = _in_rows(low), _in_rows(high)
    top = first + min(0, low.min())
    rows = first + 2 * (coarse.shape[0] - 1) + max(twin, high.max()) + 1 - top
    floats = np.empty((rows, _CHUNK), np.float32)
    for start in range(0, width, _CHUNK):
        size = min(_CHUNK, width - start)
        for y in range(rows):
            whole, converted = fine[top + y, start:], floats[y]
            for x in range(size):
                converted[x] = np.float32(whole[x])
        _coarsen_part(floats, first - top, 0, before, after, weights, twin, start, size, coarse)


@compiled
def _split_columns(fine: Float32, columns: int, channels: int, halves: Float32) -> None:
    """Lay the even and the odd of ``columns`` pixels apart: ``fine`` (columns * channels) to ``halves`` (2, ...)."""
    even, odd = halves[0], halves[1]
    pairs = columns // 2
    if channels == 3:  # written out, or the compiler makes a loop of it that takes three times as long
        for x in range(pairs):
            even[3 * x], even[3 * x + 1], even[3 * x + 2] = fine[6 * x], fine[6 * x + 1], fine[6 * x + 2]
            odd[3 * x], odd[3 * x + 1], odd[3 * x + 2] = fine[6 * x + 3], fine[6 * x + 4], fine[6 * x + 5]
    elif channels == 1:
        for x in range(pairs):
            even[x], odd[x] = fine[2 * x], fine[2 * x + 1]
    else:
        for x in range(pairs):
            for channel in range(channels):
                even[channels * x + channel] = fine[2 * channels * x + channel]
                odd[channels * x + channel] = fine[2 * channels * x + channels + channel]
    if columns % 2:
        even[pairs * channels : (pairs + 1) * channels] = fine[(columns - 1) * channels :]


@compiled
def coarsen_columns(fine: Float32, first: int, low: Int64, high: Int64, weights: Float32, twin: int, coarse: Float32) -> None:
    """Filter and halve along columns: ``coarse`` (m, n, c) from ``fine`` (m, columns, c).

    Coarse column i is centred on fine column ``first + 2i``. Even and odd columns are first laid apart, so that the sums
    run over contiguous memory.
    """
    rows, columns, channels = fine.shape
    width = coarse.shape[1] * channels
    halves = np.empty((2, (columns // 2 + 1) * channels), np.float32)
    reference = np.empty(_CHUNK, np.float32)
    half = np.float32(0.5)
    before, after = _places(first, low, channels), _places(first, high, channels)
    centre = _places(first, np.array([0, twin]), channels)
    for j in range(rows):
        _split_columns(fine[j].reshape(columns * channels), columns, channels, halves)
        out = coarse[j].reshape(width)
        for start in range(0, width, _CHUNK):
            size = min(_CHUNK, width - start)
            left, right = halves[centre[0, 0], centre[1, 0] + start :], halves[centre[0, 1], centre[1, 1] + start :]
            for x in range(size):
                reference[x] = half * (left[x] + right[x])
            _sum_pairs(halves, before, after, 0, start, weights, reference, out[start : start + size])


@compiled
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


@compiled
def _weight(coverage: Float32, row: int, column: int, offsets: Int64, weights: Float64) -> float:
    """Sum of separable weights times coverage around (row, column)."""
    total = 0.0
    for a in range(offsets.size):
        for b in range(offsets.size):
            total += weights[a] * weights[b] * coverage[row + offsets[a], column + offsets[b]]
    return total


@compiled
def _peak(coverage: Float32, row: int, column: int, offsets: Int64) -> float:
    """Largest coverage under the taps around (row, column)."""
    largest = 0.0
    for a in range(offsets.size):
        for b in range(offsets.size):
            largest = max(largest, coverage[row + offsets[a], column + offsets[b]])
    return largest


@compiled
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


@compiled
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


@compiled
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


@compiled
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
