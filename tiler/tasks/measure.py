"""Statistics of a block in one pass: numba, outside the GIL (NumPy's reductions over interleaved channels are 50 times slower)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled


@compiled
def _measure_valid(samples: NDArray[Any], valid: NDArray[np.bool_], found: NDArray[np.float64]) -> int:
    """Put minimum, maximum and sum per channel of the valid samples into ``found`` (3, channels); return how many are valid."""
    rows, columns = samples.shape[:2]
    channels = found.shape[1]
    count = 0
    for channel in range(channels):
        low, high, total = np.inf, -np.inf, 0.0
        count = 0
        for y in range(rows):
            for x in range(columns):
                if not valid[y, x]:
                    continue
                value = np.float64(samples[y, x, channel])
                low = min(low, value)
                high = max(high, value)
                total += value
                count += 1
        found[0, channel], found[1, channel], found[2, channel] = low, high, total
    return count


@compiled
def _measure_whole(
    samples: NDArray[Any], lows: NDArray[Any], highs: NDArray[Any], sums: NDArray[Any], count: int, found: NDArray[np.float64]
) -> None:
    """Put minimum, maximum and sum per channel of all samples into ``found`` (3, channels).

    ``lows``, ``highs`` and ``sums`` are scratch for the values of a row, ``count`` at a time: rows are taken together sample by
    sample, which the compiler turns into vector instructions, and channels are told apart once, at the end.
    """
    rows, columns, stored = samples.shape
    channels = found.shape[1]
    first = samples[0].reshape(columns * stored)
    for x in range(count):
        lows[x] = first[x]
        highs[x] = first[x]
        sums[x] = 0
    for y in range(rows):
        row = samples[y].reshape(columns * stored)
        for x in range(count):
            value = row[x]
            lows[x] = value if value < lows[x] else lows[x]
            highs[x] = value if value > highs[x] else highs[x]
            sums[x] += value
    for channel in range(channels):
        low, high, total = lows[channel], highs[channel], 0.0
        for x in range(channel, count, stored):
            low, high = min(low, lows[x]), max(high, highs[x])
            total += sums[x]
        found[0, channel], found[1, channel], found[2, channel] = low, high, total


_LONGEST_COLUMN = 65536
"""So many samples of 16 bits have a sum below 2**32."""


def measure(samples: NDArray[Any], valid: NDArray[np.bool_] | None, channels: int) -> tuple[int, NDArray[np.float64]]:
    """Return the number of valid samples, and minimum, maximum and sum of the first ``channels`` channels, (3, channels).

    ``samples`` is (rows, columns, channels or more) of any number type, ``valid`` (rows, columns) or None if all are. Sums of whole
    numbers are exact, others are taken in float64, always in the same order.
    """
    found = np.empty((3, channels))
    if valid is not None and not valid.all():
        return _measure_valid(samples, valid, found), found
    samples = np.ascontiguousarray(samples)
    rows, columns, stored = samples.shape
    count = columns * stored
    exact = samples.dtype in (np.uint8, np.uint16) and rows <= _LONGEST_COLUMN
    lows, highs = np.empty((2, count), samples.dtype)
    sums = np.empty(count, np.uint32 if exact else np.float64)
    _measure_whole(samples, lows, highs, sums, count, found)
    return rows * columns, found
