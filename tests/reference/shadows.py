"""Shadows and horizons by walking every ray, in plain float64: the oracle for ``tiler.light``, with which it shares nothing.

A ray starts at a sample and goes toward the sun. Where it crosses a grid line of the major axis (rows if the sun is nearer to north
or south than to east or west, counted in samples), the terrain is interpolated between the two samples beside it; a void beside
it is a gap. Rays end at the edge of the grid. Elevations above the horizontal of the sample; the ground of a round Earth drops by
d**2 / 2R.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Step = tuple[float, float, float]
"""Rows, columns and metres from one crossed grid line to the next."""


def step_toward(azimuth_deg: float, cell_m: tuple[float, float]) -> Step:
    """Return the step toward an azimuth clockwise from decreasing rows."""
    quarter, exact = divmod(azimuth_deg % 360, 90)
    east, north = math.sin(math.radians(exact)), math.cos(math.radians(exact))
    if exact == 45:
        east = north
    for _ in range(int(quarter)):
        east, north = north, -east
    down, right = -north / cell_m[1], east / cell_m[0]
    longest = max(abs(down), abs(right))
    down, right = down / longest, right / longest
    return down, right, math.hypot(down * cell_m[1], right * cell_m[0])


def _crossed(heights: Array, step: Step, k: int) -> tuple[Array, bool]:
    """Return what the rays of all samples meet on the k-th grid line they cross, NaN for gaps; and whether any is still inside."""
    height, width = heights.shape
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    y, x = rows + step[0] * k, columns + step[1] * k
    y0, x0, y1, x1 = np.floor(y), np.floor(x), np.ceil(y), np.ceil(x)
    inside = (y0 >= 0) & (x0 >= 0) & (y1 <= height - 1) & (x1 <= width - 1)
    share = (y - y0) + (x - x0)  # one of them is a whole number
    top, left = y0.clip(0, height - 1).astype(int), x0.clip(0, width - 1).astype(int)
    bottom, right = y1.clip(0, height - 1).astype(int), x1.clip(0, width - 1).astype(int)
    first, second = heights[top, left], heights[bottom, right]
    return np.where(inside, first + share * (second - first), np.nan), bool(inside.any())


def horizon_tangents(heights: Array, step: Step, curvature_per_m: float = 0.0) -> Array:
    """Return the tangent (h, w) of the elevation of the horizon at every sample; -inf where there is nothing, NaN in voids."""
    result = np.full(heights.shape, -np.inf)
    k, inside = 1, True
    while inside:
        met, inside = _crossed(heights, step, k)
        distance = k * step[2]
        result = np.fmax(result, (met - heights) / distance - distance * curvature_per_m)
        k += 1
    return np.where(np.isnan(heights), np.nan, result)


def shadow_margins(heights: Array, step: Step, slope: float) -> Array:
    """Return by how many metres (h, w) each sample rises above the shadow that falls on it; inf where none can, NaN in voids."""
    result = np.full(heights.shape, np.inf)
    k, inside = 1, True
    while inside:
        met, inside = _crossed(heights, step, k)
        result = np.fmin(result, heights - (met - k * step[2] * slope))
        k += 1
    return np.where(np.isnan(heights), np.nan, result)
