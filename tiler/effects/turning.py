"""By how much the directions of a grid turn the sun, besides the globe itself.

Seen from a sample the sun stands elsewhere than from the centre of the map for two reasons: the vertical turns with the globe, by half a
diagonal's arc at most, and the directions of rows and columns turn about it. In geographic coordinates these follow the meridians, which
converge: a degree of longitude apart they turn by the sine of the latitude, near a pole by far more than the vertical does.
"""

import math
from typing import Final

import numpy as np

from schemas.region import Rect
from tiler.light.ground import SunField
from tiler.light.place import GridPlace
from tiler.light.zones import lattice

_PLACES: Final = 33
"""Along each side of the map, its edges included, where the sun turns the most; on 30 degrees of it a turn between two of them is
missed by 1 % at most."""
_BETWEEN: Final = 1.02


def sun_turn_deg(place: GridPlace, azimuth_deg: float, elevation_deg: float) -> float:
    """Return by how much [degrees] the sun, as seen on the grid, is turned anywhere from where it stands at the map's centre.

    ``azimuth_deg`` is from true north, there. 0 if nothing says where on the Earth the map is; 180 if part of it is no place there.
    """
    if place.ground is None or place.longitude_deg is None or place.latitude_deg is None:
        return 0.0
    height, width = place.ground.shape
    field = SunField(place.ground, (place.longitude_deg, place.latitude_deg), azimuth_deg, elevation_deg, refraction=False)
    view = field.view(*lattice(Rect(0, 0, width, height), _PLACES))
    if view is None:
        return 180.0
    on_grid = place.on_grid(azimuth_deg, elevation_deg)
    azimuth, elevation = math.radians(on_grid.azimuth_deg), math.radians(elevation_deg)
    centre = np.array([math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)])
    apart = np.sqrt(((np.stack([view.east, view.north, view.up]) - centre[:, np.newaxis]) ** 2).sum(axis=0)).max()
    return min(180.0, _BETWEEN * math.degrees(2 * math.asin(min(1.0, float(apart) / 2))))
