"""What horizons are wanted for: the part of the sun's disc, and of the sky, that a sample sees. Compiled where every sample is visited.

The sky of a tilted sample is what Dozier and Frew integrate ("Rapid calculation of terrain parameters for radiation modeling from digital
elevation data", IEEE Trans. Geosci. Remote Sensing 28, 1990, eq. 7), here with the tangents of horizons and the slopes of the ground.
"""

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from schemas.scene import SUN_RADIUS_DEG
from tiler.compiled import compiled
from tiler.light.frame import SunPosition, sine_cosine_deg

Array = NDArray[np.float64]
Horizons = Callable[[float], NDArray[np.floating]]
"""From an azimuth [degrees] to the tangents (h, w) of the horizons."""


@compiled
def _add_sky(tangents: NDArray[np.floating], east: Array, north: Array, sine: float, cosine: float, total: Array) -> None:
    """Add what one azimuth shows of the sky, above the horizontal and above the sample's own plane, weighted by the cosine law."""
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            rise = east[y, x] * sine + north[y, x] * cosine
            tangent = max(np.float64(tangents[y, x]), rise, 0.0)
            square = 1.0 / (1.0 + tangent * tangent)
            lit = square - rise * (0.5 * math.pi - math.atan(tangent) - tangent * square)
            if lit > 0.0:
                total[y, x] += lit


def sky_share(horizons: Horizons, slopes: tuple[Array, Array], count: int) -> Array:
    """Return the light (h, w) of an even sky, 1 on open level ground, from ``count`` azimuths; none lies along a row or a column."""
    east, north = slopes
    total = np.zeros(east.shape)
    for n in range(count):
        azimuth = 360 * (n + 0.5) / count
        _add_sky(horizons(azimuth), east, north, *sine_cosine_deg(azimuth), total)
    share: Array = total / (count * np.sqrt(1 + east * east + north * north))
    return share


def chords(sun: SunPosition, count: int) -> Iterator[tuple[float, float, float]]:
    """Yield azimuth [degrees], half length [degrees] and weight of upright chords of the disc: Gauss-Chebyshev, of the second kind."""
    for n in range(1, count + 1):
        angle = math.pi * n / (count + 1)
        aside = SUN_RADIUS_DEG * math.cos(angle) / math.cos(math.radians(sun.elevation_deg))
        yield sun.azimuth_deg + aside, SUN_RADIUS_DEG * math.sin(angle), 2 * math.sin(angle) ** 2 / (count + 1)


def disc_by_chords(horizons: Horizons, sun: SunPosition, count: int) -> Array:
    """Return the share (h, w) of the sun's disc that is above the horizons of ``count`` chords, each level over its own."""
    total: Array | None = None
    for azimuth, half, weight in chords(sun, count):
        angles = np.degrees(np.arctan(horizons(azimuth).astype(np.float64)))
        seen = weight * np.clip((sun.elevation_deg + half - angles) / (2 * half), 0, 1)
        total = seen if total is None else total + seen
    if total is None:
        raise ValueError("a disc has at least one chord")
    return total


def disc_points(sun: SunPosition, count: int) -> list[SunPosition]:
    """Return places spread evenly over the sun's disc, on a spiral of golden angles."""
    points = []
    for n in range(count):
        radius, angle = SUN_RADIUS_DEG * math.sqrt((n + 0.5) / count), n * math.pi * (3 - math.sqrt(5))
        aside = radius * math.cos(angle) / math.cos(math.radians(sun.elevation_deg))
        points.append(SunPosition(sun.azimuth_deg + aside, sun.elevation_deg + radius * math.sin(angle)))
    return points
