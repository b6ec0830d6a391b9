"""Distances on the ground: how far apart the samples of a layer are on the WGS 84 ellipsoid (GeographicLib, Karney 2013)."""

import numpy as np
from geographiclib.geodesic import Geodesic
from rasterio._err import CPLE_BaseError
from rasterio.errors import CRSError, RasterioError
from rasterio.warp import transform as reproject

from schemas.manifest import Transform

GEOGRAPHIC = "EPSG:4326"


def transformed(source: str, target: str, xs: list[float], ys: list[float]) -> tuple[list[float], list[float]] | None:
    """Return coordinates of ``source`` in ``target``, x (or longitude) first; None if one of them has no place there."""
    try:
        found = reproject(source, target, xs, ys)
    except (RasterioError, CRSError, CPLE_BaseError):
        # Unknown here, local (a quarry's own axes), or outside of what the projection can be inverted for.
        return None
    return (found[0], found[1]) if np.isfinite(found[0]).all() and np.isfinite(found[1]).all() else None


def geographic_places(crs: str, xs: list[float], ys: list[float]) -> tuple[list[float], list[float]] | None:
    """Return longitudes and latitudes [degrees] of coordinates of ``crs``; None if one of them is no place on the Earth."""
    found = transformed(crs, GEOGRAPHIC, xs, ys)
    if found is None or max(map(abs, found[1])) > 90 + 1e-9:
        return None
    return found[0], [min(max(latitude, -90.0), 90.0) for latitude in found[1]]


def ground_spacing_m(transform: Transform, crs: str | None, column: float, row: float) -> tuple[float, float] | None:
    """Return the ground distances [m] between samples along a row and along a column at sample (column, row).

    The distance is that between the places half a sample to either side, so it is right for geographic coordinates and for
    projections that stretch (EPSG:3857 by 1 / cos latitude). None if the coordinate system is unknown or cannot be inverted there.
    """
    if crs is None:
        return None
    a, b, c, d, e, f = transform
    columns = np.array([column - 0.5, column + 0.5, column, column])
    rows = np.array([row, row, row - 0.5, row + 0.5])
    found = geographic_places(crs, (a * columns + b * rows + c).tolist(), (d * columns + e * rows + f).tolist())
    if found is None:
        return None
    longitudes, latitudes = found
    east, south = (
        Geodesic.WGS84.Inverse(latitudes[i], longitudes[i], latitudes[i + 1], longitudes[i + 1], Geodesic.DISTANCE)["s12"] for i in (0, 2)
    )
    return float(east), float(south)
