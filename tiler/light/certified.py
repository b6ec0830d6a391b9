"""Cast shadows without a wrong sample: bounds decide most of them with proof, the exact march decides the rest.

What is right is what the march finds: a sample is shaded if, on one of the rows that its ray to the sun crosses, the straight line
between the two samples beside the ray passes above it. Two sweeps, of the highest and of the lowest that a strip of a quarter of a
column meets, leave a percent or two of the samples open; only those are marched, over a pyramid of maxima that lets a
ray skip what it passes above.
"""

import math
from typing import Final

import numpy as np

from tiler.light.bracketing import bracket_rows, darken_rows, range_of
from tiler.light.frame import Earth, Frame, Shape, SunPosition
from tiler.light.marching import march_undecided
from tiler.light.shadow import Rays, check_rows, rays_of, uniform_codes
from tiler.light.sweeping import NOTHING, VOID, Codes, Float32, Float64
from tiler.light.terrainkept import KeptTerrain
from tiler.light.turning import turned

_ROUNDING: Final = 2.0**-48
_STRIPS: Final = 4
"""Strips per column. Twice as many leave half as many samples open; from here on that no longer pays."""


def reach_rows(rays: Rays, relief_m: float) -> int:
    """Return how many rows away in the frame terrain with so much relief [m] can shade a sample, at most the whole frame."""
    frame, (row_m, column_m, reference_row, reference_column, curvature) = rays.frame, rays.lift
    corners = [
        row_m * (row - reference_row) + column_m * (column - reference_column)
        for row in (0, frame.rows - 1)
        for column in (0, frame.columns - 1)
    ]
    slope = rays.slope - 2 * curvature * max(corners)
    if curvature > 0:
        distance_m = (math.sqrt(slope * slope + 4 * curvature * relief_m) - slope) / (2 * curvature)
    else:
        distance_m = relief_m / slope if slope > 0 else math.inf
    return frame.rows if distance_m >= frame.rows * frame.step_m else math.ceil(distance_m / frame.step_m) + 1


class CertifiedSweep:
    """As ``ShadowSweep``, without ``lines``: the codes are those of the exact march, whatever the bands.

    Besides the bounds of the strips, the rows are kept that can still shade: all of them, unless ``range_m`` tells the lowest and the
    highest height of the grid [m] (ValueError where a pushed row is outside of it). ``marched`` counts the rays that had to be marched.
    """

    def __init__(
        self,
        shape: Shape,
        cell_m: tuple[float, float],
        sun: SunPosition,
        earth: Earth | None = None,
        *,
        bias_m: float = 0.0,
        sea_m: float = 0.0,
        reference: tuple[float, float] | None = None,
        range_m: tuple[float, float] | None = None,
    ) -> None:
        self.rays = rays_of(shape, cell_m, sun, earth, bias_m=bias_m, sea_m=sea_m, reference=reference)
        self.voids = 0
        self.marched = 0
        reach = self.frame.rows
        if range_m is not None and self.rays.level is None:
            reach = reach_rows(self.rays, range_m[1] - range_m[0])
        self._row = 0
        self._kept = KeptTerrain(self.rays, reach)
        self._brackets = Brackets(self.rays)
        self._extent = HeightExtent(self.rays, range_m)

    @property
    def frame(self) -> Frame:
        """How the grid is turned so that its rows can be pushed from the sun's side."""
        return self.rays.frame

    def push(self, rows_m: Float32) -> Codes:
        """Return the codes (h, columns) uint8 of the next ``rows_m`` (h, columns) float32 [m] of the frame; no number is a void."""
        check_rows(self.frame, self._row, rows_m)
        rays = self.rays
        if rays.level is not None:
            codes = uniform_codes(rows_m, rays.level)
        else:
            highest = self._extent.grown(rows_m)
            codes = self._brackets.push(rows_m, highest)
            self._kept.push(rows_m)
            if (codes > VOID).any():
                self._march(codes, highest)
            darken_rows(rows_m, self._row, rays.slope, rays.sea_m, rays.lift, codes)
        self._row += rows_m.shape[0]
        self.voids += int(np.count_nonzero(codes == VOID))
        return codes

    def _march(self, codes: Codes, highest: float) -> None:
        """Decide what the bounds left open in ``codes``, of the last rows."""
        rays, frame, kept = self.rays, self.frame, self._kept
        peaks, table, maxima = kept.pyramid()
        slack = slack_of(rays, highest)
        self.marched += march_undecided(
            kept.heights, kept.first, frame.shift, rays.slope, frame.step_m, rays.bias_m, slack, rays.lift, peaks, table, maxima, codes
        )


def slack_of(rays: Rays, highest: float) -> float:
    """Return by how much rounding may raise interpolated heights that are at most so far from 0 [m], lifted where ground is curved."""
    return 0.0 if rays.lift[4] == 0 else _ROUNDING * highest


class HeightExtent:
    """A bound on the size of all lifted heights so far; ``range_m`` is what heights were said to have."""

    def __init__(self, rays: Rays, range_m: tuple[float, float] | None) -> None:
        self._range_m = range_m
        self._lifted = rays.lift[4] * _farthest_m(rays.frame) ** 2
        self._highest = 0.0

    def grown(self, rows_m: Float32) -> float:
        """Return the bound [m] with the next rows; ValueError if they are not as promised."""
        lowest, highest = range_of(rows_m)
        if lowest > highest:
            return self._highest
        if self._range_m is not None and not (self._range_m[0] <= lowest and highest <= self._range_m[1]):
            raise ValueError(
                f"heights of {lowest} to {highest} m in a grid that was said to have {self._range_m[0]} to {self._range_m[1]} m"
            )
        self._highest = max(self._highest, max(abs(lowest), abs(highest)) + self._lifted)
        return self._highest


class Brackets:
    """The bounds of the strips between the lines of a sweep, carried from band to band: ``push`` rows, get what is certain."""

    def __init__(self, rays: Rays) -> None:
        self._rays = rays
        self._row = 0
        self._bounds = _fresh(0, rays.frame.columns + 1)

    def push(self, rows_m: Float32, highest: float) -> Codes:
        """Return the codes of the next rows as far as the bounds tell, else UNDECIDED, and move these on; heights are up to ``highest``."""
        rays, frame = self._rays, self._rays.frame
        offsets = sorted((math.floor(frame.shift * self._row), math.floor(frame.shift * (self._row + rows_m.shape[0]))))
        first, bounds = _fresh(offsets[0], frame.columns + 1 + offsets[1] - offsets[0] + 1)
        known_first, known = self._bounds
        start, stop = max(first, known_first), min(first + bounds.shape[2], known_first + known.shape[2])
        bounds[:, :, start - first : stop - first] = known[:, :, start - known_first : stop - known_first]
        codes = np.empty(rows_m.shape, np.uint8)
        bracket_rows(
            np.ascontiguousarray(rows_m),
            self._row,
            frame.shift,
            rays.slope,
            frame.step_m,
            rays.bias_m,
            highest,
            rays.lift,
            first,
            bounds[0],
            bounds[1],
            codes,
        )
        self._bounds = first, bounds
        self._row += rows_m.shape[0]
        return codes


def _fresh(first: int, count: int) -> tuple[int, Float64]:
    """Return strips that have met nothing: the number of the first, and upper and lower bounds (2, m, count)."""
    return first, np.full((2, _STRIPS, count), NOTHING)


def _farthest_m(frame: Frame) -> float:
    """Return a bound on the distance [m] of the frame's samples from its reference."""
    rows = max(abs(frame.reference_row), abs(frame.rows - frame.reference_row))
    columns = max(abs(frame.reference_column), abs(frame.columns - frame.reference_column))
    return abs(frame.row_m) * rows + abs(frame.column_m) * columns


def certified_shadow(
    heights_m: Float32, cell_m: tuple[float, float], sun: SunPosition, earth: Earth | None = None, *, bias_m: float = 0.0
) -> Codes:
    """Return the codes (h, w) uint8 of whole ``heights_m`` (h, w) float32 [m] that the exact march gives; else as ``cast_shadow``."""
    if heights_m.ndim != 2:
        raise ValueError(f"heights must be (rows, columns), got {heights_m.shape}")
    sweep = CertifiedSweep((heights_m.shape[0], heights_m.shape[1]), cell_m, sun, earth, bias_m=bias_m)
    turns = sweep.frame.turns
    return turned(sweep.push(turned(heights_m, turns)), -turns)
