"""What the precision of a sweep's state costs: one line per sample, in float32 and in float64, on heights far from zero."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tiler.accuracy.lightground import Ground
from tiler.light.frame import SunPosition, frame_of, tangent_deg

OFFSETS_M: Final = (0.0, 1e5, 1e6, 1e7)
_NOTHING: Final = -1e30


@dataclass(frozen=True, slots=True)
class LightRung:
    """Shadows of heights moved up by ``offset_m``: samples that differ from those of float64 on heights that were not moved [%]."""

    offset_m: float
    elevation_deg: float
    wrong_float32_percent: float
    wrong_float64_percent: float


def plain_sweep(rows_m: NDArray[np.floating], shift: float, drop_m: float) -> NDArray[np.bool_]:
    """Return whether samples of a frame are lit, swept in NumPy with one line per sample, in the precision of ``rows_m`` (h, w).

    ``shift`` columns and ``drop_m`` of height per row, as in ``tiler.light.sweeping``; beyond the edges there is nothing.
    """
    kind = rows_m.dtype.type
    height, width = rows_m.shape
    offsets = shift * np.arange(height)
    wholes = np.floor(offsets).astype(int)
    levels = np.full(width + 1 + int(np.ptp(wholes)), _NOTHING, rows_m.dtype)
    lit = np.empty(rows_m.shape, np.bool_)
    for row in range(height):
        first = wholes[row] - wholes.min()
        share, base = kind(offsets[row] - wholes[row]), kind(row * drop_m)
        met = levels[first : first + width + 1]
        risen = rows_m[row] + base
        lit[row] = risen >= met[:-1] + share * (met[1:] - met[:-1])
        between = risen[1:] + share * (risen[:-1] - risen[1:])
        met[1:-1] = np.maximum(met[1:-1], between)
        if share == 0:
            met[0] = max(met[0], risen[0])
    return lit


def measure_light_precision(ground: Ground, suns: tuple[tuple[float, float], ...]) -> list[LightRung]:
    """Return what each precision costs for each offset and sun; heights are rounded to it after they were moved."""
    rungs = []
    for azimuth, elevation in suns:
        sun = SunPosition(azimuth, elevation)
        frame = frame_of((ground.heights_m.shape[0], ground.heights_m.shape[1]), ground.cell_m, sun.azimuth_deg)
        rows = np.ascontiguousarray(np.rot90(ground.heights_m, frame.turns), np.float64)
        drop = frame.step_m * tangent_deg(sun.elevation_deg)
        expected = plain_sweep(rows, frame.shift, drop)
        for offset in OFFSETS_M:
            single, double = (
                100 * float((plain_sweep((rows + offset).astype(kind), frame.shift, drop) != expected).mean())
                for kind in (np.float32, np.float64)
            )
            rungs.append(LightRung(offset, elevation, single, double))
    return rungs
