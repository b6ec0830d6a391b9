"""Bounds of every tile: what the ground around it can hide from it, near and far."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tiler.effects.bounds import least_facing, lowest_ray_tan
from tiler.effects.statistics import ROUNDING, HeightStatistics

Float64 = NDArray[np.float64]

_SINGLE_RINGS: Final = 32
"""Rings of tiles that are looked at one by one; further ones in groups, each twice as far as the one before."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Per tile (rows, columns): bounds that hold for every sample of it."""

    tilt_tan: Float64
    """At least the slope of every facet of the tile and of the eight around it."""
    horizon_tan: Float64
    """At least the slope to any horizon, and at least ``tilt_tan``."""


def surroundings(found: HeightStatistics) -> Surroundings:
    """Return the bounds of every tile of ``found``.

    A straight way over ground without voids rises nowhere faster than the steepest facet on it, so neither does its chord. Other places
    are no higher than the highest and no nearer than they can be: a row or column beyond a void, k - 1 tiles where they are k tiles off.
    """
    tilt = _widened(found.tiles.steepest, 1)
    horizon = tilt
    for ring in _rings(found):
        over_facets = np.where(ring.holed, np.inf, ring.steepest)
        horizon = np.maximum(horizon, np.minimum(ring.rise_tan, over_facets))
    return Surroundings(tilt, horizon)


def lit_tiles(found: HeightStatistics, elevation_deg: float, margin_deg: float) -> NDArray[np.bool_]:
    """Return the tiles (rows, columns) every sample of which every point within ``margin_deg`` of the sun lights, by proof.

    Each place around is seen either no steeper than the lowest such point, or over ground that faces them all.
    """
    facing, lowest = least_facing(margin_deg), lowest_ray_tan(elevation_deg, margin_deg)
    lit = (-_widened(-found.tiles.facing, 1) >= facing) & (lowest >= 0)
    for ring in _rings(found):
        lit &= (ring.rise_tan <= lowest) | (~ring.holed & (ring.facing >= facing))
    return lit


@dataclass(frozen=True, slots=True, eq=False)
class _Ring:
    """Tiles at some distance around each tile, and the square up to them; the first is the tile itself and the eight around it."""

    rise_tan: Float64
    """At least the slope from any sample to any place of the ring, from heights and distances."""
    holed: NDArray[np.bool_]
    """Whether any cell up to there touches a void."""
    steepest: Float64
    facing: Float64


def _rings(found: HeightStatistics) -> Iterator[_Ring]:
    tiles, cell = found.tiles, min(found.cell_m)
    low = np.where(tiles.low_m < np.inf, tiles.low_m, found.high_m)
    layers = (tiles.high_m, (tiles.voids > 0).astype(np.float64), tiles.steepest, -tiles.facing)
    high, holed, steepest, away = (_widened(layer, 1) for layer in layers)
    reach, distance_m = 1, cell
    while True:
        rise = (high - low) / distance_m * (1 + ROUNDING)
        yield _Ring(rise, holed > 0, steepest, -away)
        if reach >= max(low.shape) - 1:
            return
        # Tiles from reach + 1 to reach + step off are at least reach tiles away.
        step, distance_m = (1 if reach < _SINGLE_RINGS else reach), reach * tiles.side * cell
        high, holed, steepest, away = (_widened(layer, step) for layer in (high, holed, steepest, away))
        reach += step


def _widened(values: Float64, step: int) -> Float64:
    """Return maxima over squares that reach ``step`` tiles further to every side than those of ``values``, by at least (step - 1) / 2."""
    for axis in (0, 1):
        moved = np.moveaxis(values, axis, 0)
        wider = moved.copy()
        if step < len(moved):
            np.maximum(wider[step:], moved[:-step], out=wider[step:])
            np.maximum(wider[:-step], moved[step:], out=wider[:-step])
        values = np.moveaxis(wider, 0, axis)
    return values
