"""The frame in which light is swept: rows run away from the sun, whatever its azimuth; and the shape of the Earth beneath.

A grid is turned by quarter turns until the sun stands nearer to the direction of decreasing rows than to any other, counted in
samples. A ray to the sun then goes one row up and ``shift`` columns to the right per step, with -1 <= shift <= 1. The row of the
grid that is nearest to the sun comes first, so what casts a shadow is swept before what the shadow falls on.

Turns, not flips and transposes, and sines that are exact at quarter turns make the same terrain under the same sun the same
arithmetic however the grid lies: the shadows of a grid turned by 90 degrees are the turned shadows, bit for bit.
"""

import math
from dataclasses import dataclass
from typing import Final

from schemas.errors import UsageError
from schemas.region import Rect

MEAN_RADIUS_M: Final = 6_371_008.8
"""Mean radius of the Earth, (2a + b) / 3 of WGS 84 (Moritz, Geodetic Reference System 1980)."""

_NO_SHIFT: Final = 2.0**-30
"""Columns over the whole grid by which a ray may be off a column, or a diagonal, and still count as on it: 180.00000000001 is south."""

Shape = tuple[int, int]


@dataclass(frozen=True, slots=True)
class SunPosition:
    """Where the sun stands: azimuth [degrees] clockwise from the direction of decreasing rows, elevation [degrees] above the horizontal.

    An azimuth outside of 0 to 360 is brought there. Raises UsageError for numbers that are no angles, or elevations beyond the poles.
    """

    azimuth_deg: float
    elevation_deg: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.azimuth_deg) and math.isfinite(self.elevation_deg) and abs(self.elevation_deg) <= 90):
            raise UsageError(
                f"sun at azimuth {self.azimuth_deg}, elevation {self.elevation_deg}: give finite degrees, the elevation from -90 to 90"
            )


@dataclass(frozen=True, slots=True)
class Earth:
    """A round Earth: its radius [m], and the share of its curvature that refraction takes back along a ray in the air.

    0.13 is what surveyors use. ``None`` in place of an Earth stands for a flat one throughout this package.
    """

    radius_m: float = MEAN_RADIUS_M
    refraction: float = 0.13

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius_m) and self.radius_m > 0 and 0 <= self.refraction < 1):
            raise UsageError(
                f"an Earth of radius {self.radius_m} m, refraction {self.refraction}: give a positive radius, refraction from 0 to 1"
            )

    @property
    def radius_of_rays_m(self) -> float:
        """The radius [m] of an airless Earth above which straight rays rise as the bent ones do above this one."""
        return self.radius_m / (1 - self.refraction)


def curvature_per_m(earth: Earth | None) -> float:
    """Return how far the ground has dropped at a distance, over the square of that distance [1/m]; 0 for a flat Earth.

    The parabola d**2 / 2R is 0.001 m off the sphere at 36 km and 2.7 m at 240 km.
    """
    return 0.0 if earth is None else 0.5 / earth.radius_of_rays_m


def sine_cosine_deg(angle_deg: float) -> tuple[float, float]:
    """Return sine and cosine of an angle [degrees], exact at multiples of 30 and 45 degrees, and so that quarter turns permute them.

    Radians do not do: their sine of 180 degrees is 1.2e-16, and shadows on knife's edges change when the grid is turned.
    """
    reduced = math.fmod(angle_deg, 360.0)
    quarter = round(reduced / 90)
    rest = reduced - 90.0 * quarter
    if abs(rest) == 45:
        sine, cosine = math.copysign(math.sqrt(0.5), rest), math.sqrt(0.5)
    elif abs(rest) == 30:
        sine, cosine = math.copysign(0.5, rest), math.sqrt(0.75)
    else:
        sine, cosine = math.sin(math.radians(rest)), math.cos(math.radians(rest))
    for _ in range(quarter % 4):
        sine, cosine = cosine, -sine
    return sine + 0.0, cosine + 0.0


def tangent_deg(angle_deg: float) -> float:
    """Return the tangent of an angle [degrees], exact at 45; infinite at 90."""
    sine, cosine = sine_cosine_deg(angle_deg)
    return sine / cosine if cosine else math.copysign(math.inf, sine)


@dataclass(frozen=True, slots=True)
class Frame:
    """How a grid is turned for an azimuth, and how rays run through it then.

    ``turns`` quarter turns counterclockwise (as of ``numpy.rot90``) lead from the grid to the frame, which has ``rows`` by ``columns``
    samples. A ray goes ``shift`` columns to the right per row toward the sun, and ``step_m`` metres over the ground. The distance [m] of
    a sample from the reference, away from the sun, is ``row_m * (row - reference_row) + column_m * (column - reference_column)``.
    """

    turns: int
    rows: int
    columns: int
    shift: float
    step_m: float
    row_m: float
    column_m: float
    reference_row: float
    reference_column: float

    @property
    def grid_shape(self) -> Shape:
        """Rows and columns of the grid."""
        return (self.columns, self.rows) if self.turns % 2 else (self.rows, self.columns)

    def grid_window(self, rows: tuple[int, int], columns: tuple[int, int] | None = None) -> Rect:
        """Return the window of the grid that becomes half-open ``rows`` and ``columns`` (default: all) of the frame."""
        (top, bottom), (left, right) = rows, columns or (0, self.columns)
        height, width = self.grid_shape
        match self.turns:
            case 0:
                return Rect(left, top, right, bottom)
            case 1:
                return Rect(width - bottom, left, width - top, right)
            case 2:
                return Rect(width - right, height - bottom, width - left, height - top)
            case _:
                return Rect(top, height - right, bottom, height - left)


def frame_of(shape: Shape, cell_m: tuple[float, float], azimuth_deg: float, reference: tuple[float, float] | None = None) -> Frame:
    """Return the frame of a grid of ``shape`` (rows, columns) for the sun's azimuth.

    ``cell_m`` is the distance [m] between samples along a row and along a column (x first, as ``tiler.geodesy.ground_spacing_m``
    gives it); ``reference`` the place (row, column) at which the sun stands where it is said to, by default the middle of the grid.
    Raises UsageError if a size, a distance or the azimuth is not usable.
    """
    height, width = shape
    cell_x_m, cell_y_m = cell_m
    if height < 1 or width < 1:
        raise UsageError(f"a grid of {height} rows and {width} columns has no samples to light")
    if not all(math.isfinite(side) and side > 0 for side in cell_m):
        raise UsageError(f"samples {cell_x_m} m by {cell_y_m} m apart: both distances must be positive (they collapse at a pole)")
    if not math.isfinite(azimuth_deg):
        raise UsageError(f"azimuth {azimuth_deg}: give finite degrees")
    east, north = sine_cosine_deg(azimuth_deg)
    turns = _turns(north / cell_y_m, east / cell_x_m)
    along, across = ((north, east), (east, -north), (-north, -east), (-east, north))[turns]
    cell_along_m, cell_across_m = (cell_x_m, cell_y_m) if turns % 2 else (cell_y_m, cell_x_m)
    shift = (across / cell_across_m) / (along / cell_along_m)
    rows, columns = (width, height) if turns % 2 else (height, width)
    if abs(shift - round(shift)) * rows < _NO_SHIFT:
        shift = float(round(shift))
    row, column = reference or ((height - 1) / 2, (width - 1) / 2)
    places = ((row, column), (width - 1 - column, row), (height - 1 - row, width - 1 - column), (column, height - 1 - row))
    reference_row, reference_column = places[turns]
    return Frame(
        turns=turns,
        rows=rows,
        columns=columns,
        shift=shift + 0.0,
        step_m=math.hypot(cell_along_m, shift * cell_across_m),
        row_m=along * cell_along_m,
        column_m=-across * cell_across_m,
        reference_row=reference_row,
        reference_column=reference_column,
    )


def _turns(up: float, right: float) -> int:
    """Return the quarter turns that bring a direction, in samples up and to the right, nearest to upward.

    On a diagonal the choice goes round with the direction, so that it does not depend on how the grid lies.
    """
    if abs(up) == abs(right):
        return (1 if up > 0 else 2) if right > 0 else (3 if up < 0 else 0)
    if abs(up) > abs(right):
        return 0 if up > 0 else 2
    return 1 if right > 0 else 3
