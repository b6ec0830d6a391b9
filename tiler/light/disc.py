"""How much of the sun's disc stands above a horizon. Compiled, outside the GIL."""

import math

import numpy as np

from schemas.errors import UsageError
from schemas.scene import SUN_RADIUS_DEG
from tiler.compiled import compiled
from tiler.light.frame import tangent_deg
from tiler.light.sweeping import Float32, Float64


@compiled
def _segment(tangent: float, elevation_deg: float, radius_deg: float) -> float:
    """Return the share of a disc that is above a straight horizon, the area of a circular segment over that of the circle."""
    u = (elevation_deg - math.degrees(math.atan(tangent))) / radius_deg
    if u >= 1.0:
        return 1.0
    if u <= -1.0:
        return 0.0
    return 0.5 + (u * math.sqrt(1.0 - u * u) + math.asin(u)) / math.pi


@compiled
def _cover_evenly(tangents: Float32, elevation_deg: float, radius_deg: float, clear: float, dark: float, out: Float32) -> None:
    """Set ``out`` to the shares for one elevation; tangents up to ``clear`` hide nothing, from ``dark`` on everything."""
    for y in range(tangents.shape[0]):
        for x in range(tangents.shape[1]):
            tangent = tangents[y, x]
            if tangent <= clear:
                out[y, x] = np.float32(1)
            elif tangent >= dark:
                out[y, x] = np.float32(0)
            else:
                out[y, x] = np.float32(_segment(tangent, elevation_deg, radius_deg))


@compiled
def _cover(tangents: Float32, elevations_deg: Float64, radius_deg: float, out: Float32) -> None:
    """Set ``out`` to the shares for an elevation per sample."""
    for y in range(tangents.shape[0]):
        for x in range(tangents.shape[1]):
            out[y, x] = np.float32(_segment(tangents[y, x], elevations_deg[y, x], radius_deg))


def disc_coverage(tangents: Float32, elevation_deg: float | Float64, radius_deg: float = SUN_RADIUS_DEG) -> Float32:
    """Return the share (h, w) float32, 0 to 1, of a disc that is seen above horizons of ``tangents`` (h, w) float32; NaN stays NaN.

    ``elevation_deg`` is that of the disc's centre [degrees], one for all or one for each sample (``shadow.local_elevation_deg``); the
    horizon is taken as straight and level over the width of the disc. Raises UsageError for a radius that is not positive.
    """
    if not (math.isfinite(radius_deg) and 0 < radius_deg < 90):
        raise UsageError(f"a sun of radius {radius_deg} degrees: give more than 0, less than 90")
    out = np.empty(tangents.shape, np.float32)
    if isinstance(elevation_deg, np.ndarray):
        elevations = np.ascontiguousarray(np.broadcast_to(elevation_deg, tangents.shape), np.float64)
        _cover(tangents, elevations, radius_deg, out)
    else:
        low, high = max(elevation_deg - radius_deg, -90.0), min(elevation_deg + radius_deg, 90.0)
        # The shortcut spares the arctangent; what rounding leaves just inside is 1 - 1e-12 or 1e-12 of the disc.
        _cover_evenly(tangents, elevation_deg, radius_deg, tangent_deg(low), tangent_deg(high), out)
    return out
