"""Quarter turns of grids. Compiled, outside the GIL.

A turn reads along rows and writes along columns. Done naively every sample touches a cache line of its own, and rows of a power of two
bytes fall on the same few sets of the cache: NumPy's copy of a turned grid of 4096 by 4096 takes ten times as long as the sweep it
is made for. Through a square of ``_SIDE`` samples that stays in the first-level cache, a turn takes about as long as the sweep.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled

_SIDE = 64
"""A square of float32 is 16 KiB. 32 and 128 are slower by a third."""

Sample = TypeVar("Sample", np.float32, np.uint8)


@compiled
def _transpose(grid: NDArray[Sample], up: bool, mirrored: bool, out: NDArray[Sample]) -> None:
    """Write the columns of ``grid`` (h, w) as the rows of ``out`` (w, h): from the bottom ``up``, and each of them ``mirrored``."""
    height, width = grid.shape
    square = np.empty((_SIDE, _SIDE), grid.dtype)
    for top in range(0, height, _SIDE):
        rows = min(_SIDE, height - top)
        for left in range(0, width, _SIDE):
            columns = min(_SIDE, width - left)
            for y in range(rows):
                place = rows - 1 - y if mirrored else y
                row = grid[top + y, left : left + columns]
                for x in range(columns):
                    square[x, place] = row[x]
            start = height - top - rows if mirrored else top
            for x in range(columns):
                target = out[width - 1 - left - x if up else left + x, start : start + rows]
                column = square[x]
                for y in range(rows):
                    target[y] = column[y]


def transposed(grid: NDArray[Sample]) -> NDArray[Sample]:
    """Return the transpose (w, h) of ``grid`` (h, w), float32 or uint8, as a contiguous copy."""
    grid = np.ascontiguousarray(grid)
    out = np.empty(grid.shape[::-1], grid.dtype)
    _transpose(grid, False, False, out)
    return out


def turned(grid: NDArray[Sample], turns: int) -> NDArray[Sample]:
    """Return ``grid`` (h, w), float32 or uint8, after so many quarter turns counterclockwise, as ``numpy.rot90`` counts them.

    The result is contiguous: ``grid`` itself if nothing is to be done, a copy otherwise.
    """
    grid = np.ascontiguousarray(grid)
    if turns % 2 == 0:
        return grid if turns % 4 == 0 else np.ascontiguousarray(grid[::-1, ::-1])
    out = np.empty(grid.shape[::-1], grid.dtype)
    _transpose(grid, turns % 4 == 1, turns % 4 == 3, out)
    return out
