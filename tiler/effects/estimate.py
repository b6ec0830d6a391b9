"""What sky and reflected light change on a coarse level: no proof, but closer to the truth than bounds where those are loose.

A coarse level lacks slopes, and with them hidden sky. How much, the map itself says, twice: by its steepest facet, which is known of level
0 (the coarse heights are exaggerated until theirs is as steep), and by how much more is hidden on a level than on one half as fine,
for each level that is missing. The larger of both is the estimate. docs/EFFECTS.md says how it compares with what is true.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.scene import Scene
from tiler.compiled import compiled
from tiler.effects.bounds import FULL_SCALE, code_scale
from tiler.effects.statistics import HeightStatistics, measure_heights

Float64 = NDArray[np.float64]

LEAST_GROWTH: Final = 1.5
"""Factor by which lost light grows at least from a level to one twice as fine, whatever the map says of itself: the largest on real terrain
was 1.47 (Puget Sound, ground seen, from 960 m to 160 m)."""
_LEAST_SIDE: Final = 24
"""Samples along the longer side of the coarsest level that is looked at."""


@dataclass(frozen=True, slots=True)
class Estimates:
    """Largest changes that level 0 is taken to have [codes]."""

    sky: float
    bounce: float
    step: int
    """Samples of level 0 per sample of the level it was made on."""
    exaggeration: float
    """How much steeper the steepest facet of level 0 is."""


def estimate_effects(scene: Scene, found: HeightStatistics) -> Estimates | None:
    """Return what effects change, estimated on the coarse heights of ``found``.

    None if nothing can be said: beside voids, where cliffs may stand that no facet tells of, or if the coarse heights are level.
    """
    cell = (found.cell_m[0] * found.sketch_step, found.cell_m[1] * found.sketch_step)
    z = found.sketch.astype(np.float64)
    if found.voids or not np.isfinite(z).all():
        return None
    coarse = measure_heights([z], (z.shape[0], z.shape[1]), cell, found.sun_deg).steepest
    if not coarse:
        return None
    exaggeration = max(1.0, found.steepest / coarse)
    azimuths = scene.sky.azimuths
    steep, grown = _lost(z * exaggeration, cell, azimuths), _lost(z, cell, azimuths) * _growth(z, cell, azimuths, found.sketch_step)
    sky, ground = np.minimum(np.maximum(steep, grown), 1.0)
    return Estimates(
        sky=float(code_scale(scene.sky.share) * scene.sky.share * sky),
        bounce=float(FULL_SCALE * scene.ground.albedo * ground / (1 - scene.ground.albedo * ground)),
        step=found.sketch_step,
        exaggeration=exaggeration,
    )


def _growth(z: Float64, cell: tuple[float, float], azimuths: int, step: int) -> Float64:
    """Return by what the light lost on coarse heights ``z`` is multiplied for that on level 0: sky, ground."""
    factor, levels = np.full(2, LEAST_GROWTH), math.log2(step)
    finer, stride = _lost(z, cell, azimuths), 2
    while levels and max(z.shape) // stride >= _LEAST_SIDE:
        coarser = _lost(z[::stride, ::stride], (cell[0] * stride, cell[1] * stride), azimuths)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.fmax(factor, finer / coarser)
        finer, stride = coarser, 2 * stride
    return np.asarray(factor**levels, np.float64)


def _lost(z: Float64, cell: tuple[float, float], azimuths: int) -> Float64:
    """Return the largest parts of the open sky's light that are hidden, and of what a sample sees that is ground, on ``z`` (h, w)."""
    slope_x, slope_y = _gradient(z, cell)
    cosine = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    open_sky, seen = np.zeros_like(z), np.zeros_like(z)
    for n in range(azimuths):
        # Half a step off the grid's own directions.
        turn = 2 * math.pi * (n + 0.5) / azimuths
        rise = slope_x * math.sin(turn) - slope_y * math.cos(turn)
        own = np.maximum(rise, 0.0)
        open_sky += _above(own, rise, cosine) / azimuths
        seen += _above(np.maximum(_horizons(z, math.degrees(turn), cell), own), rise, cosine) / azimuths
    return np.array([max(0.0, float((open_sky - seen).max())), max(0.0, float((1 - seen).max()))])


def _above(horizon: Float64, rise: Float64, cosine: Float64) -> Float64:
    """Return what a vertical half plane holds above a horizon, weighed by the normal (Dozier & Frew 1990, eq. 7b)."""
    zenith, share = np.arctan2(1.0, horizon), 1 / (1 + horizon**2)
    return np.asarray(cosine * (share - rise * (zenith - horizon * share)), np.float64)


def _gradient(z: Float64, cell: tuple[float, float]) -> tuple[Float64, Float64]:
    """Return slopes along rows and along columns (h, w), central inside, 0 on an axis of one sample."""
    x = np.gradient(z, cell[0], axis=1) if z.shape[1] > 1 else np.zeros_like(z)
    y = np.gradient(z, cell[1], axis=0) if z.shape[0] > 1 else np.zeros_like(z)
    return x, y


def _horizons(z: Float64, azimuth_deg: float, cell: tuple[float, float]) -> Float64:
    """Return the steepest slope from every sample to ground in an azimuth, minus infinity if there is none, NaN where void."""
    a = math.radians(azimuth_deg)
    column, row = math.sin(a) / cell[0], -math.cos(a) / cell[1]
    turned = abs(column) > abs(row)
    if turned:
        z, column, row = np.ascontiguousarray(z.T), row, column
    if row > 0:
        z, row = np.ascontiguousarray(z[::-1]), -row
    shift = column / -row
    sizes = (cell[1], cell[0]) if turned else cell
    found = np.empty_like(z)
    _march(z, shift, math.hypot(sizes[1], shift * sizes[0]), float(np.nanmax(z)), found)
    found = found[::-1] if (math.sin(a) if turned else -math.cos(a)) > 0 else found
    return found.T if turned else found


@compiled
def _march(z: Float64, shift: float, step_m: float, highest: float, found: Float64) -> None:
    """Put the steepest slope toward smaller rows into ``found``: ``shift`` columns per row, ``step_m`` metres apart."""
    rows, columns = z.shape
    for i in range(rows):
        for j in range(columns):
            steepest, start = -np.inf, z[i, j]
            for n in range(1, i + 1):
                x = j + n * shift
                left = int(np.floor(x))
                if left < 0 or left >= columns or highest - start <= steepest * n * step_m:
                    break
                part = x - left
                right = min(left + 1, columns - 1)
                height = z[i - n, left] + part * (z[i - n, right] - z[i - n, left])
                if not np.isnan(height):
                    steepest = max(steepest, (height - start) / (n * step_m))
            found[i, j] = steepest if not np.isnan(start) else np.nan
