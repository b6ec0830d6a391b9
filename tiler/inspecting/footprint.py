"""Where a layer lies on the Earth and how large it is there: extent in degrees, area, and the range of its sample spacing."""

from typing import Final

import numpy as np
from geographiclib.geodesic import Geodesic
from numpy.typing import NDArray

from schemas.facts import Footprint
from schemas.manifest import Layer, Transform
from tiler.geodesy import geographic_places, ground_spacing_m

Line = NDArray[np.float64]
Line2D = tuple[Line, Line]

_STRIPS: Final = 16
"""An area is summed over strips of columns: a polygon once around the Earth would enclose nothing."""
_POINTS: Final = 17
"""Points along each edge of a strip; straight in projection is not straight on the ellipsoid (error of a UTM zone's area: 1e-7)."""
_PROBES: Final = 9


def measure_footprint(layer: Layer, crs: str | None) -> Footprint | None:
    """Return the footprint of ``layer`` in ``crs``; None if there is no ``crs`` or a part of the layer has no place on the Earth."""
    if crs is None:
        return None
    last = 0 if layer.registration == "area" else 1
    width, height = max(layer.width - last, 0), max(layer.height - last, 0)
    ring = _places(layer.transform, crs, *_ring(0, 0, width, height))
    spacings = _spacings(layer.transform, crs, width, height)
    if ring is None or spacings is None:
        return None
    longitudes, latitudes = ring
    # Follow the outline: a step of more than half a turn is a step across the antimeridian.
    unwrapped = np.rad2deg(np.unwrap(np.deg2rad(longitudes)))
    turns = round((unwrapped[-1] - unwrapped[0]) / 360)
    west, east = float(unwrapped.min()), float(unwrapped.max())
    south, north = float(latitudes.min()), float(latitudes.max())
    if turns:
        west, east = -180.0, 180.0
        south, north = (south, 90.0) if north + south > 0 else (-90.0, north)
    area = _area_m2(layer.transform, crs, width, height)
    if area is None:
        return None
    whole = east - west >= 360 - 1e-9
    west_deg, east_deg = (-180.0, 180.0) if whole else (_normal(west), _normal(east))
    return Footprint(
        west_deg=west_deg,
        south_deg=south,
        east_deg=east_deg,
        north_deg=north,
        crosses_antimeridian=west_deg > east_deg,
        contains_pole=bool(turns),
        area_m2=area,
        row_spacing_m=spacings[0],
        column_spacing_m=spacings[1],
    )


def _normal(longitude: float) -> float:
    """Return a longitude between -180 and 180; 180 itself stays."""
    return longitude if -180 <= longitude <= 180 else (longitude + 180) % 360 - 180


def _ring(x0: float, y0: float, x1: float, y1: float) -> Line2D:
    """Return sample coordinates once around a rectangle, the first point again at the end."""
    along = np.linspace(0, 1, _POINTS)[:-1]
    x = np.concatenate([x0 + (x1 - x0) * along, np.full(_POINTS - 1, x1), x1 + (x0 - x1) * along, np.full(_POINTS - 1, x0), [x0]])
    y = np.concatenate([np.full(_POINTS - 1, y0), y0 + (y1 - y0) * along, np.full(_POINTS - 1, y1), y1 + (y0 - y1) * along, [y0]])
    return x, y


def _places(transform: Transform, crs: str, columns: Line, rows: Line) -> Line2D | None:
    """Return longitudes and latitudes of sample coordinates, None if one has no place on the Earth."""
    a, b, c, d, e, f = transform
    found = geographic_places(crs, (a * columns + b * rows + c).tolist(), (d * columns + e * rows + f).tolist())
    if found is None:
        return None
    longitudes, latitudes = np.array(found[0]), np.array(found[1])
    return longitudes, np.clip(latitudes, -90, 90)


def _area_m2(transform: Transform, crs: str, width: float, height: float) -> float | None:
    total = 0.0
    for strip in range(_STRIPS):
        ring = _places(transform, crs, *_ring(width * strip / _STRIPS, 0, width * (strip + 1) / _STRIPS, height))
        if ring is None:
            return None
        polygon = Geodesic.WGS84.Polygon()
        for longitude, latitude in zip(ring[0][:-1], ring[1][:-1], strict=True):
            polygon.AddPoint(latitude, longitude)
        total += abs(polygon.Compute(False, True)[2])
    return total


def _spacings(transform: Transform, crs: str, width: float, height: float) -> tuple[tuple[float, float], tuple[float, float]] | None:
    found = []
    for x in np.linspace(0.5, max(0.5, width - 0.5), _PROBES):
        for y in np.linspace(0.5, max(0.5, height - 0.5), _PROBES):
            spacing = ground_spacing_m(transform, crs, float(x), float(y))
            if spacing is None:
                return None
            found.append(spacing)
    rows, columns = zip(*found, strict=True)
    return (min(rows), max(rows)), (min(columns), max(columns))
