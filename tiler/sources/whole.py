"""Heights without voids, taken over in one pass: most elevation models declare or allow voids and have none in most places."""

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled


@compiled
def _take_whole(
    heights: NDArray[np.float32], bits: NDArray[np.int32], limit: np.int32, void: np.float32, taken: NDArray[np.float32]
) -> bool:
    rows, columns = heights.shape
    largest = np.int32(0)
    voids = np.int64(0)
    for y in range(rows):
        row, row_bits, out = heights[y], bits[y], taken[y]
        for x in range(columns):
            magnitude = row_bits[x] & np.int32(0x7FFFFFFF)
            largest = magnitude if magnitude > largest else largest
            voids += row[x] == void
            out[x] = row[x] + np.float32(0)
    return bool(largest <= limit and voids == 0)


def take_whole(heights: NDArray[np.float32], nodata: float | None, limit: float) -> NDArray[np.float32] | None:
    """Return a copy of ``heights`` (rows, columns), -0 as 0, if all are finite, none is ``nodata`` and none is beyond ``limit``.

    Otherwise return None. Magnitudes are compared as the integers that their bits are, which order like the numbers, NaN and infinity
    above all: the compiler may then take many samples at a time, which it must not where NaN could be.
    """
    rows = np.ascontiguousarray(heights)
    taken = np.empty(rows.shape, np.float32)
    void = np.float32(np.nan) if nodata is None else np.float32(nodata)
    bound = np.float32(limit).view(np.int32)
    return taken if _take_whole(rows, rows.view(np.int32), bound, void, taken) else None
