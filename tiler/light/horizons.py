"""Horizons: how high the terrain stands toward one azimuth, as seen from every sample.

What is farther than ``near_steps`` rows of the frame is taken from hulls along lines one column apart; what is nearer is looked at from
the sample itself. The hulls alone leave an error of some tenths of a degree, because near ground between two lines is unlike both;
the exact steps bring it down about as 1 / steps. Sky and the sun's disc both need 8 or more.

Voids (no number, or infinite) have no horizon and are none. A sample with no terrain toward the azimuth has one of minus infinity.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from itertools import pairwise
from typing import Final, TypeVar

import numpy as np

from schemas.errors import UsageError
from tiler.light.frame import Earth, Frame, Shape, curvature_per_m, frame_of
from tiler.light.hulls import NO_HORIZON, Int32, Int64, near_steps, walk_lines
from tiler.light.shadow import check_rows
from tiler.light.sweeping import Float32, Float64
from tiler.light.turning import transposed, turned

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_NEAR_STEPS: Final = 1024
_NEAR_ROWS: Final = 32
_LINES: Final = 1024
"""Rows, and lines, that one thread works at."""
BAND_ROWS: Final = 512
"""Rows that ``horizon_tangents`` pushes at once: hulls are carried between bands at a cost that is then some percent."""


class _Hulls:
    """What is carried between bands: for lines from number ``first``, corners by line, and the heights that wait to be one."""

    def __init__(self, first: int, starts: Int64, rows: Int32, heights: Float64, waiting: Float64) -> None:
        self.first, self.starts, self.rows, self.heights, self.waiting = first, starts, rows, heights, waiting

    def within(self, first: int, stop: int) -> "_Hulls":
        """Return the hulls of lines ``first`` up to before ``stop``; those that are not here are empty."""
        count = stop - first
        starts, waiting = np.zeros(count + 1, np.int64), np.full((count, self.waiting.shape[1]), np.nan)
        known, known_stop = max(first, self.first), min(stop, self.first + self.starts.size - 1)
        if known >= known_stop:
            return _Hulls(first, starts, self.rows[:0], self.heights[:0], waiting)
        begins = self.starts[known - self.first : known_stop - self.first + 1]
        starts[known - first : known_stop - first + 1] = begins - begins[0]
        starts[known_stop - first :] = begins[-1] - begins[0]
        waiting[known - first : known_stop - first] = self.waiting[known - self.first : known_stop - self.first]
        part = slice(int(begins[0]), int(begins[-1]))
        return _Hulls(first, starts, self.rows[part], self.heights[part], waiting)


class HorizonSweep:
    """Horizons of a grid toward an azimuth [degrees], band by band: ``push`` rows of the frame, get the tangents of their horizons.

    ``shape`` is the grid's (rows, columns), ``cell_m`` the distance [m] between its samples along a row and along a column. On a round
    ``earth`` tangents are above the local horizontal, with what lies far away as low as it is seen. Between bands the hulls of the
    lines are kept, some tens of corners each, and ``near_steps`` rows; bands of any height give the same bits. With the height of its
    lowest ground, ``lowest_m``, only horizons above the horizontal are looked for, which is faster on a round Earth; others are 0. A
    ``pool`` of threads may help.
    """

    def __init__(
        self,
        shape: Shape,
        cell_m: tuple[float, float],
        azimuth_deg: float,
        earth: Earth | None = None,
        *,
        near_steps: int = 16,
        lowest_m: float | None = None,
        pool: Executor | None = None,
    ) -> None:
        if not 0 <= near_steps <= MAX_NEAR_STEPS:
            raise UsageError(f"{near_steps} exact steps: give 0 to {MAX_NEAR_STEPS}")
        self.frame: Frame = frame_of(shape, cell_m, azimuth_deg)
        self.near_steps = near_steps
        self._curvature = curvature_per_m(earth)
        self._lowest_m = lowest_m
        self._pool = pool
        self._row = 0
        self._kept = np.empty((0, self.frame.columns), np.float32)
        self._hulls = _Hulls(0, np.zeros(1, np.int64), np.empty(0, np.int32), np.empty(0), np.empty((0, near_steps)))

    def push(self, rows_m: Float32) -> Float32:
        """Return the tangents (h, columns) float32 of the next ``rows_m`` (h, columns) float32 [m] of the frame; voids are NaN."""
        check_rows(self.frame, self._row, rows_m)
        if np.isinf(rows_m).any():
            rows_m = np.where(np.isinf(rows_m), np.float32(np.nan), rows_m)
        tangents = self._far(rows_m)
        heights = np.concatenate((self._kept, rows_m)) if self._kept.size else np.ascontiguousarray(rows_m)
        frame = self.frame

        def look_near(start: int) -> None:
            seen = heights[: heights.shape[0] - tangents.shape[0] + start + _NEAR_ROWS]
            part = tangents[start : start + _NEAR_ROWS]
            near_steps(seen, frame.shift, frame.step_m, self._curvature, self.near_steps, part)

        self._each(look_near, list(range(0, tangents.shape[0], _NEAR_ROWS)))
        self._kept = heights[max(0, heights.shape[0] - self.near_steps) :].copy()
        self._row += rows_m.shape[0]
        return tangents if self._lowest_m is None else np.maximum(tangents, np.float32(0))

    def _far(self, rows_m: Float32) -> Float32:
        """Return the tangents of what is more than ``near_steps`` rows away, and carry the hulls on."""
        count, width = rows_m.shape
        offsets = self.frame.shift * np.arange(self._row, self._row + count, dtype=np.float64)
        wholes = np.floor(offsets).astype(np.int64)
        if not count:
            return np.empty((0, width), np.float32)
        first, stop = int(wholes.min()), width + 1 + int(wholes.max())
        old = self._hulls.within(first, stop)
        far = np.full((width, count), NO_HORIZON, np.float32)
        columns, rests = transposed(rows_m), offsets - wholes

        def walk(part: tuple[int, int]) -> _Hulls:
            return self._walked(old, part, columns, wholes, rests, far)

        lines = stop - first
        parts = 1 if self._pool is None else max(1, lines // _LINES)
        ends = [lines * part // parts for part in range(parts + 1)]
        self._hulls = _joined(first, self._each(walk, list(pairwise(ends))))
        return transposed(far)

    def _each(self, work: Callable[[Item], Result], items: list[Item]) -> list[Result]:
        """Return what ``work`` makes of each item, by the pool if there is one."""
        return list(map(work, items) if self._pool is None else self._pool.map(work, items))

    def _walked(self, old: _Hulls, part: tuple[int, int], columns: Float32, wholes: Int64, rests: Float64, far: Float32) -> _Hulls:
        """Walk the lines from ``part[0]`` up to before ``part[1]`` of ``old``, set what lies before each, and return their hulls."""
        # What lies before the first line is between it and the one before, which is walked once more for that.
        begin = max(part[0] - 1, 0)
        starts, count = old.starts[begin : part[1] + 1], columns.shape[1]
        lines, room = part[1] - begin, int(starts[-1] - starts[0]) + (part[1] - begin) * (count + 1)
        new = _Hulls(
            old.first + begin, np.zeros(lines + 1, np.int64), np.empty(room, np.int32), np.empty(room), np.empty((lines, self.near_steps))
        )
        walk_lines(
            columns,
            self._row,
            self.frame.shift,
            wholes,
            rests,
            self.frame.step_m,
            self._curvature,
            -np.inf if self._lowest_m is None else self._lowest_m,
            self.near_steps,
            part[0] > 0,
            new.first,
            starts,
            old.rows,
            old.heights,
            old.waiting[begin : part[1]],
            new.starts,
            new.rows,
            new.heights,
            new.waiting,
            far,
        )
        return new.within(old.first + part[0], old.first + part[1])


def _joined(first: int, parts: list[_Hulls]) -> _Hulls:
    """Return the hulls of lines one after the other."""
    sizes = np.concatenate([np.diff(part.starts) for part in parts])
    return _Hulls(
        first,
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        np.concatenate([part.rows for part in parts]),
        np.concatenate([part.heights for part in parts]),
        np.concatenate([part.waiting for part in parts]),
    )


def horizon_tangents(
    heights_m: Float32, cell_m: tuple[float, float], azimuth_deg: float, earth: Earth | None = None, *, near_steps: int = 16
) -> Float32:
    """Return the tangents (h, w) float32 of the horizons of whole ``heights_m`` (h, w) float32 [m]; parameters as of ``HorizonSweep``."""
    if heights_m.ndim != 2:
        raise ValueError(f"heights must be (rows, columns), got {heights_m.shape}")
    sweep = HorizonSweep((heights_m.shape[0], heights_m.shape[1]), cell_m, azimuth_deg, earth, near_steps=near_steps)
    rows = turned(heights_m, sweep.frame.turns)
    tangents = np.empty(rows.shape, np.float32)
    for start in range(0, rows.shape[0], BAND_ROWS):
        tangents[start : start + BAND_ROWS] = sweep.push(rows[start : start + BAND_ROWS])
    return turned(tangents, -sweep.frame.turns)


def sines(tangents: Float32) -> Float32:
    """Return the sines of angles in -90 to 90 degrees by their tangents, minus infinity included; NaN stays NaN."""
    double = np.abs(tangents.astype(np.float64))
    with np.errstate(divide="ignore", under="ignore", over="ignore"):
        size = 1.0 / np.sqrt(1.0 + (1.0 / double) ** 2)
    return np.copysign(size, tangents).astype(np.float32)


def angles_deg(tangents: Float32) -> Float32:
    """Return the angles [degrees] of tangents; NaN stays NaN."""
    return np.degrees(np.arctan(tangents.astype(np.float64))).astype(np.float32)
