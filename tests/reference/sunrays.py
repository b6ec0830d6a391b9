"""Shadows by walking rays through space, in plain float64: the oracle for maps on which no two samples have the sun in the same place.

A ray starts at a sample, in Earth-centred coordinates above the ellipsoid of WGS 84, and goes along one vector, the same for all. It is
in the shadow of the terrain where the terrain below it, bilinear between samples, is higher above the ellipsoid than the ray.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_A = 6378137.0
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)


def to_space(longitude: Array, latitude: Array, height: Array) -> Array:
    """Return Earth-centred coordinates (3, n) [m] of places [radians, m above the ellipsoid]."""
    n = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    across = (n + height) * np.cos(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), (n * (1 - _E2) + height) * np.sin(latitude)])


def to_ground(place: Array) -> tuple[Array, Array, Array]:
    """Return longitudes and latitudes [radians] and heights [m] of places in space: by Bowring's formula, then once more for the height."""
    x, y, z = place
    b = _A * (1 - _F)
    across = np.hypot(x, y)
    reduced = np.arctan2(z * _A, across * b)
    for _ in range(3):
        latitude = np.arctan2(z + _E2 * _A**2 / b * np.sin(reduced) ** 3, across - _E2 * _A * np.cos(reduced) ** 3)
        reduced = np.arctan2((1 - _F) * np.sin(latitude), np.cos(latitude))
    n = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    height = across * np.cos(latitude) + z * np.sin(latitude) - n * (1 - _E2 * np.sin(latitude) ** 2)
    return np.arctan2(y, x), latitude, height


def sun_vector(longitude_deg: float, latitude_deg: float, azimuth_deg: float, elevation_deg: float) -> Array:
    """Return the unit vector (3,) to a sun that stands so at a place."""
    lon, lat, az, el = np.radians([longitude_deg, latitude_deg, azimuth_deg, elevation_deg])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.asarray(np.cos(el) * (np.sin(az) * east + np.cos(az) * np.cross(up, east)) + np.sin(el) * up, np.float64)


def seen_from(longitude: Array, latitude: Array, vector: Array) -> tuple[Array, Array]:
    """Return azimuths and elevations [degrees] at which a sun in the direction of ``vector`` stands at places [radians]."""
    up = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)])
    north = np.cross(up, east, axis=0)
    parts = [(each * vector[:, np.newaxis]).sum(axis=0) for each in (east, north, up)]
    return np.degrees(np.arctan2(parts[0], parts[1])) % 360, np.degrees(np.arcsin(parts[2]))


def bilinear(heights: Array, rows: Array, columns: Array) -> Array:
    """Return heights between samples; minus infinity beyond the grid."""
    height, width = heights.shape
    inside = (rows >= 0) & (columns >= 0) & (rows <= height - 1) & (columns <= width - 1)
    y, x = np.where(inside, rows, 0), np.where(inside, columns, 0)
    top, left = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    v, u = y - top, x - left
    upper = heights[top, left] * (1 - u) + heights[top, left + 1] * u
    lower = heights[top + 1, left] * (1 - u) + heights[top + 1, left + 1] * u
    return np.where(inside, upper * (1 - v) + lower * v, -np.inf)


def clearances(
    heights: Array,
    start: tuple[Array, Array],
    place_of: Callable[[Array, Array], tuple[Array, Array]],
    grid_of: Callable[[Array, Array], tuple[Array, Array]],
    vector: Array,
    step_m: float,
    reach_m: float,
) -> Array:
    """Return by how much (n,) [radians] the rays of the samples at ``start`` (rows, columns) pass above the terrain, seen from there.

    ``place_of`` leads from rows and columns to longitudes and latitudes [radians], ``grid_of`` back. Negative is in the shadow.
    """
    own = bilinear(heights, *start)
    origin = to_space(*place_of(*start), own)
    least = np.full(own.size, np.inf)
    for distance in np.arange(step_m, reach_m, step_m):
        longitude, latitude, height = to_ground(origin + distance * vector[:, np.newaxis])
        terrain = bilinear(heights, *grid_of(longitude, latitude))
        least = np.minimum(least, (height - terrain) / distance)
        # Beyond the grid lies a sea at height 0.
        least = np.where(height < 0, -1.0, least)
    return least
