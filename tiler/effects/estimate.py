"""What effects change on a coarse level: no proof, but far closer to the truth than bounds where those are loose.

Horizons are marched to, sample by sample of the level: 4 % of a second for the 192 x 192 samples that a measurement keeps.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.scene import Scene
from tiler.compiled import compiled
from tiler.effects.bounds import FULL_SCALE, code_scale

Float64 = NDArray[np.float64]

SLOPE_GUARD: Final = 1.5
"""Factor on horizons for the slopes that a coarse level lacks. Real terrain is about 2**(1 - H) steeper per level, H = 0.7 to 0.9."""
LIGHT_GUARD: Final = 2.0
"""Factor on light lost, which grows with the square of slopes, for the same."""
_AZIMUTHS: Final = 8


@dataclass(frozen=True, slots=True)
class Estimates:
    """Largest changes on the coarse level, guards included [codes]."""

    shadow: float
    penumbra: float
    sky: float
    bounce: float
    step: int
    """Samples of level 0 per sample of the level it was made on."""


def estimate_effects(scene: Scene, heights_m: NDArray[Any], cell_m: tuple[float, float], step: int) -> Estimates:
    """Return what effects change on coarse heights (h, w) [m], NaN where void, whose samples are ``step`` times ``cell_m`` apart.

    ``cell_m`` is the distance of samples of level 0 along a row and a column [m].
    """
    z = np.where(np.isfinite(heights_m), heights_m, np.nan).astype(np.float64)
    cell = (cell_m[0] * step, cell_m[1] * step)
    azimuth, elevation = scene.sun.direction_deg
    scale = code_scale(scene.sky.share)
    sun = SLOPE_GUARD * np.fmax(_horizons(z, azimuth, cell), 0.0)
    hidden = np.zeros_like(z)
    slope_x, slope_y = _gradient(z, cell)
    cosine = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    seen = np.zeros_like(z)
    for n in range(_AZIMUTHS):
        # Half a step off the grid's own directions.
        turn = 2 * math.pi * (n + 0.5) / _AZIMUTHS
        rise = slope_x * math.sin(turn) - slope_y * math.cos(turn)
        horizon = np.maximum(np.maximum(_horizons(z, math.degrees(turn), cell), rise), 0.0)
        zenith = np.arctan2(1.0, horizon)
        # Of a vertical plane through the zenith, all above the horizon, weighed by the normal (Dozier & Frew 1990, eq. 7b).
        seen += cosine * (1 / (1 + horizon**2) - rise * (zenith - horizon / (1 + horizon**2))) / _AZIMUTHS
    hidden = np.maximum((1 + cosine) / 2 - seen, 0.0)
    lost, ground = (float(np.nanmax(part)) if np.isfinite(part).any() else 0.0 for part in (hidden, 1 - seen))
    # Of a sun at the horizontal everything is hidden.
    edges = (elevation, elevation - scene.sun.radius_deg)
    point, edge = (math.tan(math.radians(angle)) if angle > 0 else -math.inf for angle in edges)
    return Estimates(
        shadow=scale if bool((sun > point).any()) else 0.0,
        penumbra=scale / 2 if bool((sun > edge).any()) else 0.0,
        sky=LIGHT_GUARD * scale * scene.sky.share * lost,
        bounce=LIGHT_GUARD * FULL_SCALE * scene.ground.albedo * ground,
        step=step,
    )


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
