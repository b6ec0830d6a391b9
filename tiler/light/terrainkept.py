"""The rows of a sweep that can still shade what is swept next, with a pyramid of maxima that lets a ray skip what it passes above."""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from tiler.light.marching import FINEST, Int64, build_coarser, raise_finest
from tiler.light.shadow import Rays
from tiler.light.sweeping import NOTHING, Float32, Float64

Sample = TypeVar("Sample", np.float32, np.float64)

_SPARE_BYTES: Final = 64 << 20
"""Room for rows beyond those kept: what is kept is moved to the front only when this is full."""


class KeptTerrain:
    """The last rows of a frame, at least ``reach`` of them; ``push`` adds rows, the first of all kept is ``first``."""

    def __init__(self, rays: Rays, reach: int) -> None:
        self._rays, self._reach = rays, reach
        self.first = 0
        self._used = 0
        self._columns = -(-rays.frame.columns >> FINEST)
        self._heights = np.empty((0, rays.frame.columns), np.float32)
        self._tops = np.empty(0, np.float64)
        self._finest = np.empty((0, self._columns), np.float64)

    @property
    def heights(self) -> Float32:
        """The kept rows (n, columns) float32 [m]."""
        return self._heights[: self._used]

    def push(self, rows_m: Float32) -> None:
        """Keep the next rows (h, columns) as well."""
        start, count = self._make_room(rows_m.shape[0]), rows_m.shape[0]
        self._used = start + count
        self._heights[start : self._used] = rows_m
        blocks = -(-start >> FINEST), -(-self._used >> FINEST)
        self._finest[blocks[0] : blocks[1]] = NOTHING
        rays = self._rays
        drop = rays.frame.step_m * rays.slope
        finest = self._finest.reshape(-1)
        raise_finest(self._heights[start : self._used], self.first, start, drop, rays.lift, self._columns, self._tops, finest)

    def _make_room(self, count: int) -> int:
        """Return the row at which ``count`` new ones begin; rows out of reach may have been dropped, whole blocks of them."""
        if self._used + count <= self._heights.shape[0]:
            return self._used
        dropped = max(self._used - self._reach, 0) >> FINEST
        kept = self._used - (dropped << FINEST)
        spare = _SPARE_BYTES // (4 * self._rays.frame.columns)
        # All that is ever needed, at once: pages are taken when they are written, and to grow is to hold everything twice.
        needed = min(max(kept, self._reach + (1 << FINEST)) + count + spare, self._rays.frame.rows - self.first - (dropped << FINEST))
        if needed > self._heights.shape[0]:
            self._heights = _moved(self._heights, dropped << FINEST, kept, needed)
            self._tops = _moved(self._tops, dropped << FINEST, kept, needed)
            self._finest = _moved(self._finest, dropped, -(-kept >> FINEST), -(-needed >> FINEST))
        else:
            _move_up(self._heights, dropped << FINEST, kept)
            _move_up(self._tops, dropped << FINEST, kept)
            _move_up(self._finest, dropped, -(-kept >> FINEST))
        self.first += dropped << FINEST
        return kept

    def pyramid(self) -> tuple[Float64, Int64, Float64]:
        """Return the maximum of all kept rows up to each, and the pyramid: (offset, rows, columns) of each level, and its maxima."""
        table = _pyramid_table((self._used, self._rays.frame.columns))
        maxima = np.empty(int(table[-1, 0] + table[-1, 1] * table[-1, 2]), np.float64)
        maxima[: table[0, 1] * table[0, 2]] = self._finest[: table[0, 1]].reshape(-1)
        build_coarser(table, maxima)
        return np.maximum.accumulate(self._tops[: self._used]), table, maxima


def _moved(array: NDArray[Sample], begin: int, count: int, size: int) -> NDArray[Sample]:
    """Return a larger array that begins with ``count`` rows of ``array`` from ``begin`` on."""
    larger = np.empty((size, *array.shape[1:]), array.dtype)
    larger[:count] = array[begin : begin + count]
    return larger


def _move_up(array: NDArray[Sample], begin: int, count: int) -> None:
    """Move ``count`` rows of ``array`` from ``begin`` on to its front, in pieces that do not overlap: else NumPy copies them all twice."""
    for start in range(0, count if begin else 0, max(begin, 1)):
        stop = min(start + begin, count)
        array[start:stop] = array[begin + start : begin + stop]


def _pyramid_table(shape: tuple[int, ...]) -> Int64:
    """Return (offset, rows, columns) of each level of the pyramid of maxima over heights of ``shape``."""
    rows, columns = (-(-size >> FINEST) for size in shape)
    levels, offset = [(0, rows, columns)], 0
    while max(rows, columns) > 1:
        offset += rows * columns
        rows, columns = -(-rows // 2), -(-columns // 2)
        levels.append((offset, rows, columns))
    table: NDArray[np.int64] = np.array(levels, np.int64)
    return table
