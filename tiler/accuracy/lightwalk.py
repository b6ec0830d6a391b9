"""Shadows and horizons by walking every ray, in float64: what is right, and what the sweeps have to be faster than. Compiled.

Heights lie in the frame of ``tiler.light.frame``: a ray to the sun goes one row up and ``shift`` columns to the right per step. What it
meets on a row is interpolated between the two samples beside it, or taken from the nearest one, as many programs do. It ends at the
edge of the grid, or where even the highest sample could no longer change the result: that is the only short cut.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tiler.accuracy.lightground import Ground, Margins
from tiler.compiled import compiled
from tiler.light.frame import SunPosition, frame_of, tangent_deg

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_SLACK_M: Final = 1e-6
"""What rounding may add to the highest sample; the short cut waits for so much more."""


@compiled
def met(rows: Array, row: int, place: float, nearest: bool) -> float:
    """Return the value at a place on a row, NaN where one of the samples beside it is missing."""
    if nearest:
        column = math.floor(place + 0.5)
        return float(rows[row, column]) if 0 <= column < rows.shape[1] else math.nan
    column = math.floor(place)
    share = place - column
    if column < 0 or column + (1 if share > 0 else 0) >= rows.shape[1]:
        return math.nan
    here = float(rows[row, column])
    return here if share == 0 else here + share * (float(rows[row, column + 1]) - here)


@compiled
def _walk_to_sun(rows: Array, shift: float, drop: float, top: float, nearest: bool, margins: Margins, lit: Flags) -> None:
    """Set ``lit`` for all samples within the margins; ``drop`` is what a ray rises per step [m], positive."""
    for i in range(lit.shape[0]):
        for j in range(lit.shape[1]):
            row, column = i + margins[0], j + margins[1]
            height = rows[row, column]
            seen = True
            for k in range(1, row + 1):
                there = met(rows, row - k, column + shift * k, nearest)
                if math.isnan(there) or height + k * drop > top:
                    break
                if there - k * drop > height:
                    seen = False
                    break
            lit[i, j] = seen


@compiled
def _walk_to_horizon(
    rows: Array, shift: float, step: float, top: float, floor: float, nearest: bool, margins: Margins, tangents: Array
) -> None:
    """Set ``tangents`` of the horizons of all samples within the margins, of those below ``floor`` to that."""
    for i in range(tangents.shape[0]):
        for j in range(tangents.shape[1]):
            row, column = i + margins[0], j + margins[1]
            height = rows[row, column]
            best = floor
            for k in range(1, row + 1):
                there = met(rows, row - k, column + shift * k, nearest)
                if math.isnan(there) or (best > 0 and top - height < best * k * step):
                    break
                best = max(best, (there - height) / (k * step))
            tangents[i, j] = best


def left_out_of_frame(turns: int, margins: Margins) -> Margins:
    """Return the margins of a frame that is turned by so many quarters."""
    return margins if turns % 2 == 0 else (margins[1], margins[0])


def walked_lit(ground: Ground, sun: SunPosition, margins: Margins = (0, 0), *, nearest: bool = False) -> Flags:
    """Return whether the sun, above the horizontal, is seen from each sample within the margins (h, w)."""
    frame = frame_of((ground.heights_m.shape[0], ground.heights_m.shape[1]), ground.cell_m, sun.azimuth_deg)
    rows = np.ascontiguousarray(np.rot90(ground.heights_m, frame.turns), np.float64)
    left_out = left_out_of_frame(frame.turns, margins)
    lit = np.empty((rows.shape[0] - 2 * left_out[0], rows.shape[1] - 2 * left_out[1]), np.bool_)
    drop = frame.step_m * tangent_deg(sun.elevation_deg)
    _walk_to_sun(rows, frame.shift, drop, float(rows.max()) + _SLACK_M, nearest, left_out, lit)
    return np.rot90(lit, -frame.turns)


def walked_horizons(
    ground: Ground, azimuth_deg: float, margins: Margins = (0, 0), *, nearest: bool = False, floor: float = -math.inf
) -> Array:
    """Return the tangents (h, w) of the horizons of the samples within the margins, or ``floor`` where that is higher.

    Without a floor a sample that has no terrain before it has a horizon of minus infinity.
    """
    frame = frame_of((ground.heights_m.shape[0], ground.heights_m.shape[1]), ground.cell_m, azimuth_deg)
    rows = np.ascontiguousarray(np.rot90(ground.heights_m, frame.turns), np.float64)
    left_out = left_out_of_frame(frame.turns, margins)
    tangents = np.empty((rows.shape[0] - 2 * left_out[0], rows.shape[1] - 2 * left_out[1]))
    _walk_to_horizon(rows, frame.shift, frame.step_m, float(rows.max()) + _SLACK_M, floor, nearest, left_out, tangents)
    return np.rot90(tangents, -frame.turns)
