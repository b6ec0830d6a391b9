"""What the bounds rest on, measured on the heights in one pass of rows, in memory that does not grow with the map's height.

A *facet* is a triangle between neighbouring samples, with either diagonal; slopes of the bilinear surface, of the profile a ray meets
on the grid's lines, and of central differences are weighted means of facets' slopes, so what bounds these bounds them all. Results
are rounded to the safe side, and are the same bits however the rows are cut into bands.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from tiler.effects.facets import HIGH, LOW, STEEPEST, TOWARD, measure_cells

Float64 = NDArray[np.float64]

ROUNDING: Final = 1e-9
"""Relative margin of everything measured: float64 errors of the pass are below 1e-14, those of the shadows' long sums below 1e-10."""
_TILE_SIDE: Final = 64
_MAX_TILES: Final = 1 << 16
_SKETCH_SIDE: Final = 192
"""Samples along the longer side of the coarse heights that estimates are made on."""


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """Numbers per tile of ``side`` by ``side`` cells, edges included; arrays are (rows, columns)."""

    side: int
    low_m: Float64
    """Least height [m]; infinite where all is void."""
    high_m: Float64
    """Greatest height [m]; minus infinity where all is void."""
    steepest: Float64
    """At least the slope of every facet."""
    facing: Float64
    """At most the cosine of the angle between every facet's normal and the sun."""
    voids: NDArray[np.int64]
    """More than 0 if a cell of the tile touches a void."""


@dataclass(frozen=True, slots=True, eq=False)
class HeightStatistics:
    """What was measured on a map of ``width`` by ``height`` samples, ``cell_m`` metres (along a row, along a column) apart."""

    width: int
    height: int
    cell_m: tuple[float, float]
    sun_deg: tuple[float, float]
    """Azimuth and elevation that ``toward`` and ``facing`` are measured for [degrees]."""
    low_m: float
    high_m: float
    steepest: float
    """At least the slope of every facet: metres of height per metre of ground."""
    toward: float
    """At least the slope of every facet toward the sun; negative if all fall toward it."""
    facing: float
    """At most the cosine of the angle between every facet's normal and the sun."""
    voids: int
    """Voids that the pass met, counted once per cell row and tile they touch; 0 if and only if there is none."""
    tiles: Tiles
    sketch: NDArray[np.float32]
    """Every ``sketch_step``-th sample of every ``sketch_step``-th row, NaN where void, for estimates."""
    sketch_step: int

    @property
    def relief_m(self) -> float:
        """Greatest less least height [m]."""
        return self.high_m - self.low_m

    @property
    def diagonal_m(self) -> float:
        """Distance between opposite corners of the map [m]; no two places are further apart."""
        return math.hypot((self.width - 1) * self.cell_m[0], (self.height - 1) * self.cell_m[1])

    @property
    def sun_turn_deg(self) -> float:
        """At least by how much the grid's directions turn the sun anywhere, if that is known to be more than the globe does [degrees]."""
        return 0.0

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.width * self.height


class HeightMeter:
    """Measures a map whose rows are pushed from the top, in bands of any height.

    ``shape`` is (rows, columns) of the map, ``cell_m`` the distance of samples along a row and along a column [m]. Where it differs from
    place to place, measure with the least and with the largest of both and take what is worse, as ``tiler.effects.dataset`` does: the
    least give the steepest slopes, but facets may face the sun the least with others. ``sun_deg`` is azimuth and elevation [degrees];
    rows run east and follow each other south. ``tile_side`` is that of tiles [cells]; left out, it follows from the shape. Raises
    UsageError if one of them makes no sense.
    """

    def __init__(
        self, shape: tuple[int, int], cell_m: tuple[float, float], sun_deg: tuple[float, float], tile_side: int | None = None
    ) -> None:
        if min(shape) < 1 or not all(0 < cell < math.inf for cell in cell_m):
            raise UsageError(f"a map of {shape[1]} x {shape[0]} samples, {cell_m[0]:g} x {cell_m[1]:g} m apart, cannot be measured")
        azimuth, elevation = sun_deg
        if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
            raise UsageError(f"a sun at azimuth {azimuth:g}, elevation {elevation:g} degrees: the elevation is between -90 and 90")
        self._shape, self._cell_m, self._sun_deg = shape, cell_m, sun_deg
        a = math.radians(azimuth)
        self._sun = np.array([1 / cell_m[0], 1 / cell_m[1], math.sin(a), -math.cos(a)])
        self._side = tile_side or _tile_side(shape)
        counts = tuple(max(1, -(-(size - 1) // self._side)) for size in shape)
        self._tiles = np.empty((*counts, 4))
        self._tiles[:] = (np.inf, -np.inf, 0.0, -np.inf)
        self._voids = np.zeros(counts, np.int64)
        self._step = max(1, -(-max(shape) // _SKETCH_SIDE))
        self._sketch: list[NDArray[np.float32]] = []
        self._last: NDArray[Any] | None = None
        self._pushed = 0

    def push(self, rows: NDArray[Any]) -> None:
        """Take the next ``rows`` (n, width) of heights [m], float32 or float64, NaN or infinite where void.

        Raises UsageError if they do not fit the map.
        """
        height, width = self._shape
        if rows.ndim != 2 or rows.shape[1] != width or self._pushed + len(rows) > height or rows.dtype not in (np.float32, np.float64):
            raise UsageError(
                f"rows of shape {rows.shape}, {rows.dtype}, do not fit after {self._pushed} of {height} rows of {width} floats"
            )
        if len(rows) == 0:
            return
        first = -self._pushed % self._step
        with np.errstate(over="ignore"):
            self._sketch.append(np.array(rows[first :: self._step, :: self._step], np.float32))
        known = rows[:1] if self._last is None else self._last
        # A row or column on its own is measured as if it lay beside a second one just like it.
        repeated = self._last is not None or height == 1
        band = np.concatenate([known, rows]) if repeated else np.ascontiguousarray(rows)
        if width == 1:
            band = np.repeat(band, 2, axis=1)
        measure_cells(band, max(self._pushed - 1, 0), self._side, self._sun, self._tiles, self._voids)
        self._last = rows[-1:].copy()
        self._pushed += len(rows)

    def finish(self) -> HeightStatistics:
        """Return what was measured; raises UsageError if rows are missing, InputError if all is void."""
        if self._pushed != self._shape[0]:
            raise UsageError(f"{self._pushed} of {self._shape[0]} rows were measured; push them all first")
        found = self._tiles
        if not found[..., LOW].min() < np.inf:
            raise InputError("the heights are void everywhere; there is nothing to light")
        steepest = np.sqrt(found[..., STEEPEST]) * (1 + ROUNDING)
        toward = found[..., TOWARD] + ROUNDING * (1 + steepest)
        facing = _facing(steepest, toward, self._sun_deg[1])
        tiles = Tiles(self._side, found[..., LOW].copy(), found[..., HIGH].copy(), steepest, facing, self._voids)
        return HeightStatistics(
            width=self._shape[1],
            height=self._shape[0],
            cell_m=self._cell_m,
            sun_deg=self._sun_deg,
            low_m=float(tiles.low_m.min()),
            high_m=float(tiles.high_m.max()),
            steepest=float(tiles.steepest.max()),
            toward=float(toward.max()),
            facing=float(tiles.facing.min()),
            voids=int(self._voids.sum()),
            tiles=tiles,
            sketch=np.concatenate(self._sketch),
            sketch_step=self._step,
        )


def measure_heights(
    bands: Iterable[NDArray[Any]],
    shape: tuple[int, int],
    cell_m: tuple[float, float],
    sun_deg: tuple[float, float],
    tile_side: int | None = None,
) -> HeightStatistics:
    """Return the statistics of a map whose rows come in ``bands`` (n, columns); arguments and errors as for ``HeightMeter``."""
    meter = HeightMeter(shape, cell_m, sun_deg, tile_side)
    for rows in bands:
        meter.push(rows)
    return meter.finish()


def _facing(steepest: Float64, toward: Float64, elevation_deg: float) -> Float64:
    """Return at most n.s of all facets with slopes up to ``steepest``, and up to ``toward`` the sun.

    n.s = (sin - cos times the slope toward the sun) / sqrt(1 + slope^2): the divisor is the longest if that is positive, else 1.
    """
    e = math.radians(elevation_deg)
    # An empty tile has no facet: 1 is the most there is.
    rise = np.where(toward > -np.inf, math.sin(e) - math.cos(e) * toward, 1.0)
    return np.asarray(np.maximum(np.minimum(rise, rise / np.sqrt(1 + steepest**2)), -1.0) - ROUNDING, np.float64)


def _tile_side(shape: tuple[int, int]) -> int:
    """Return the side of tiles [cells], a power of two of at least 64 with which there are at most 65536."""
    side = _TILE_SIDE
    while math.prod(-(-size // side) for size in shape) > _MAX_TILES:
        side *= 2
    return side
