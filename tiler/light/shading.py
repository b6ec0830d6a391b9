"""What a sample makes of the light that reaches it. Compiled, outside the GIL.

Slopes are central differences over the true distances between samples, one-sided at the edge of the grid and beside voids, which
continues a ramp exactly. All is float64 and of one sample and its four neighbours alone, so it does not depend on the window.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled
from tiler.light.sweeping import Float32, Float64

_COLLAPSED = 1e-6
"""Samples of a row that are nearer to each other than this share of the distance between rows are one place: a pole."""


@compiled
def _slope(before: float, here: float, after: float, cell: float) -> float:
    """Return the rise per metre from ``before`` to ``after``, each one cell away; NaN is a void."""
    if not math.isnan(before) and not math.isnan(after):
        return (after - before) * 0.5 / cell
    if not math.isnan(after):
        return (after - here) / cell
    if not math.isnan(before):
        return (here - before) / cell
    return 0.0


@compiled
def gradient(around: Float32, y: int, x: int, cell_x: float, cell_y: float) -> tuple[float, float]:
    """Return the rise per metre to the right and upward at sample (y, x) of a window, whose heights ``around`` (h + 2, w + 2) are."""
    here = float(around[y + 1, x + 1])
    right = 0.0
    if cell_x > _COLLAPSED * cell_y:
        right = _slope(float(around[y + 1, x]), here, float(around[y + 1, x + 2]), cell_x)
    return right, _slope(float(around[y + 2, x + 1]), here, float(around[y, x + 1]), cell_y)


@compiled
def _light(facing: float, upright: float, sun: float, sky: float, open_sky: float, bounced: float) -> np.float32:
    """Return the light of a sample from the shares of sun and sky that it sees; without a ``sky`` (negative) its own slope hides some."""
    light = max(facing, 0.0) * sun
    if sky >= 0.0:
        light += open_sky * sky + bounced * (1.0 - sky)
    else:
        light += open_sky * 0.5 * (1.0 + upright)
    return np.float32(light / (1.0 + open_sky))


@compiled
def shade_window(
    around: Float32,
    cells_m: Float64,
    east: float,
    north: float,
    slopes: Float64,
    sun: NDArray[np.uint16],
    sky: NDArray[np.uint16],
    open_sky: float,
    bounced: float,
    out: Float32,
) -> None:
    """Set ``out`` (h, w) to the light of a window; 0 where it is void.

    ``around`` (h + 2, w + 2) are its heights [m] and those around it, ``cells_m`` (2, h) the distances between them, ``east`` and ``north``
    the sun's direction on the grid, ``slopes`` the tangent of its elevation as ``sun_slopes`` gives it, infinite at the zenith. ``sun``
    (h, w) and ``sky`` (h, w or 0) are the shares that are seen, of 65535; without a ``sky`` only the sample's own slope hides any.
    ``open_sky`` is the light of the whole sky, ``bounced`` that of ground that fills it, both relative to the sun's.
    """
    height, width = out.shape
    top = 1.0 / 65535.0
    has_sky = sky.shape[1] == width
    for y in range(height):
        cell_x, cell_y = cells_m[0, y], cells_m[1, y]
        for x in range(width):
            here = around[y + 1, x + 1]
            if math.isnan(here):
                out[y, x] = np.float32(0)
                continue
            right, up = gradient(around, y, x, cell_x, cell_y)
            upright = 1.0 / math.sqrt(1.0 + (right * right + up * up))
            slope = slopes[0] + ((slopes[3] + y) * slopes[1] + (slopes[4] + x) * slopes[2])
            facing = upright
            if not math.isinf(slope):
                facing = upright * (slope - (right * east + up * north)) / math.sqrt(1.0 + slope * slope)
            elif slope < 0:
                facing = 0.0
            seen = sky[y, x] * top if has_sky else -1.0
            out[y, x] = _light(facing, upright, sun[y, x] * top, seen, open_sky, bounced)


@compiled
def shade_patch(
    around: Float32,
    corners: Float64,
    place: Float64,
    sun: NDArray[np.uint16],
    sky: NDArray[np.uint16],
    open_sky: float,
    bounced: float,
    out: Float32,
) -> None:
    """Set ``out`` (h, w) to the light of a part of a map over which the sun's direction changes; else as ``shade_window``.

    ``corners`` (5, 2, 2) are, at the four nodes around it, the sun's unit vector on the grid (right, upward, vertical) and the distances
    between samples along a row and along a column; ``place`` the row and column of the first sample, from the first node, and the rows and
    columns from node to node. What is between nodes is interpolated.
    """
    height, width = out.shape
    top = 1.0 / 65535.0
    has_sky = sky.shape[1] == width
    left, right_end = np.empty(5, np.float64), np.empty(5, np.float64)
    for y in range(height):
        down = (place[0] + y) / place[2]
        for n in range(5):
            left[n] = corners[n, 0, 0] + down * (corners[n, 1, 0] - corners[n, 0, 0])
            right_end[n] = corners[n, 0, 1] + down * (corners[n, 1, 1] - corners[n, 0, 1]) - left[n]
        for x in range(width):
            here = around[y + 1, x + 1]
            if math.isnan(here):
                out[y, x] = np.float32(0)
                continue
            aside = (place[1] + x) / place[3]
            cell_x, cell_y = left[3] + aside * right_end[3], left[4] + aside * right_end[4]
            right, up = gradient(around, y, x, cell_x, cell_y)
            upright = 1.0 / math.sqrt(1.0 + (right * right + up * up))
            east, north = left[0] + aside * right_end[0], left[1] + aside * right_end[1]
            facing = upright * (left[2] + aside * right_end[2] - (right * east + up * north))
            seen = sky[y, x] * top if has_sky else -1.0
            out[y, x] = _light(facing, upright, sun[y, x] * top, seen, open_sky, bounced)


@compiled
def add_sky(around: Float32, cells_m: Float64, tangents: Float32, east: float, north: float, shares: NDArray[np.uint32]) -> None:
    """Add to ``shares`` (h, w) what is seen of the sky in one direction on the grid, in units of 2**-20.

    The share is cos(S) (sin(H)**2 - g (H - sin(H) cos(H))), with S the slope, g the rise per metre in the direction, H the angle from the
    zenith to the horizon, to the sample's own plane or to the horizontal, whichever is nearest (Dozier and Frew 1990, eq. 7b): directions
    below the horizontal are no sky, whatever is seen there. Whole numbers, so that the order in which directions are added does not matter.
    """
    height, width = shares.shape
    for y in range(height):
        cell_x, cell_y = cells_m[0, y], cells_m[1, y]
        for x in range(width):
            here = around[y + 1, x + 1]
            if math.isnan(here):
                continue
            right, up = gradient(around, y, x, cell_x, cell_y)
            own = right * east + up * north
            tangent = max(float(tangents[y, x]), own, 0.0)
            angle = 0.5 * math.pi - math.atan(tangent)
            sine_squared = 1.0 / (1.0 + tangent * tangent)
            seen = (sine_squared - own * (angle - tangent * sine_squared)) / math.sqrt(1.0 + (right * right + up * up))
            shares[y, x] += np.uint32(max(seen, 0.0) * 1048576.0 + 0.5)


@compiled
def share_of_disc(
    tangents: Float32, heights: Float32, slopes: Float64, curvature: float, radius_deg: float, out: NDArray[np.uint16]
) -> None:
    """Set ``out`` (h, w) to the shares, of 65535, of the sun's disc that are seen above horizons of ``tangents`` (h, w).

    ``slopes`` are as of ``shade_window``. Where there is no terrain the horizon is that of a sea at height 0, which drops as a parabola of
    ``curvature`` [1/m]: ``sqrt(4 curvature height)`` below the horizontal. The arctangent is taken in penumbras only, 1 % of samples.
    """
    height, width = out.shape
    radius = math.radians(radius_deg)
    wide = math.tan(radius)
    for y in range(height):
        for x in range(width):
            if math.isnan(tangents[y, x]):
                out[y, x] = 0
                continue
            sea = -math.sqrt(4.0 * curvature * max(float(heights[y, x]), 0.0))
            horizon = max(float(tangents[y, x]), sea)
            slope = slopes[0] + ((slopes[3] + y) * slopes[1] + (slopes[4] + x) * slopes[2])
            slope = min(max(slope, -1e18), 1e18)
            # The angle between the sun's centre and the horizon has the tangent above / along.
            above, along = slope - horizon, 1.0 + slope * horizon
            if along <= 0.0 or abs(above) >= wide * along:
                out[y, x] = 65535 if above > 0.0 else 0
                continue
            u = min(max(math.atan(above / along) / radius, -1.0), 1.0)
            out[y, x] = np.uint16((0.5 + (u * math.sqrt(1.0 - u * u) + math.asin(u)) / math.pi) * 65535.0 + 0.5)
