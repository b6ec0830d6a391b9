"""How a grid of heights lies on the Earth: how far apart its samples are row by row, and where north is.

Light is computed in the grid's own directions. Its columns rarely run to true north: in a projection they are off by the convergence of
meridians (3 degrees at the edge of a UTM zone at 60 N), and in a rotated grid by any angle. Everything is measured at the grid's
centre with geodesics (Karney 2013, GeographicLib), but for the distances between samples, which are measured along the central column.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from geographiclib.geodesic import Geodesic

from schemas.errors import InputError, UsageError
from schemas.manifest import Layer, Transform, World
from schemas.region import Rect
from tiler.geodesy import geographic_places, ground_spacing_m
from tiler.light.frame import SunPosition
from tiler.light.ground import Ground
from tiler.light.sweeping import Float64

_NODES: Final = 257
"""Rows at which distances are measured; between them they are interpolated: 4e-5 off at worst, over a grid from pole to pole."""
_SQUARE_DEG: Final = 2.0
"""Rows and columns that are less square than this cannot be swept as a grid."""


@dataclass(frozen=True)
class GridPlace:
    """Where a grid lies: ``cells_m`` (2, rows) are the distances [m] between samples along a row and along a column, row by row.

    ``up_deg`` is the azimuth [degrees, clockwise from true north] of the direction of decreasing rows; ``handed`` is -1 for a grid that
    lies mirrored, rows from south to north. ``longitude_deg`` and ``latitude_deg`` of the centre are None if nothing says where on the
    Earth it is; ``ground`` tells directions and distances everywhere, those above are the centre's.
    """

    cells_m: Float64
    cell_m: tuple[float, float]
    up_deg: float
    handed: int
    longitude_deg: float | None
    latitude_deg: float | None
    ground: Ground | None = None

    def on_grid(self, azimuth_deg: float, elevation_deg: float) -> SunPosition:
        """Return where the sun stands as seen from the grid, given its azimuth from true north [degrees]."""
        return SunPosition(self.handed * (azimuth_deg - self.up_deg) % 360.0, elevation_deg)

    def cells_in(self, window: Rect) -> Float64:
        """Return the distances (2, rows) [m] in a ``window``: those of the whole if it is as wide, else along its own central column."""
        if self.ground is None or window.width >= self.ground.shape[1]:
            return self.cells_m[:, window.y0 : window.y1]
        rows = np.arange(window.y0, window.y1, dtype=np.float64)
        nodes = np.unique(np.linspace(window.y0, window.y1 - 1, min(33, window.height)).round())
        steps = self.ground.steps(nodes, np.full(nodes.size, (window.x0 + window.x1 - 1) / 2))
        if steps is None:
            return self.cells_m[:, window.y0 : window.y1]
        return np.stack([np.interp(rows, nodes, np.hypot(*each)) for each in (steps.right_m, steps.up_m)])


def place_of(layer: Layer, world: World, where: str) -> GridPlace:
    """Return how the samples of ``layer`` lie.

    Raises UsageError if the distances between them are not known, InputError if its rows and columns are not at right angles.
    """
    if layer.ground_spacing_m is None:
        raise UsageError(f"{where}: nothing says how far apart the samples are; build the heights again with --spacing METRES")
    column, row = (layer.width - 1) / 2, (layer.height - 1) / 2
    if world.crs is None:
        up, right, centre = (*_plane_directions(layer.transform), None)
        cells = np.repeat(np.array(layer.ground_spacing_m)[:, np.newaxis], layer.height, axis=1)
    else:
        up, right, centre = _directions(layer.transform, world.crs, column, row, where)
        cells = _cells_m(layer, world.crs)
    turn = (right - up + 180.0) % 360.0 - 180.0
    if abs(abs(turn) - 90.0) > _SQUARE_DEG:
        raise InputError(f"{where}: its rows and columns are {abs(turn):.1f} degrees apart; bring the heights onto a square grid first")
    middle = cells[:, layer.height // 2]
    longitude, latitude = centre or (None, None)
    ground = None if world.crs is None else Ground((layer.height, layer.width), layer.transform, world.crs)
    return GridPlace(cells, (float(middle[0]), float(middle[1])), up, 1 if turn > 0 else -1, longitude, latitude, ground)


def _plane_directions(transform: Transform) -> tuple[float, float]:
    """Return the azimuths of decreasing rows and of increasing columns; world y points north."""
    a, b, _, d, e, _ = transform
    return math.degrees(math.atan2(-b, -e)) % 360.0, math.degrees(math.atan2(a, d)) % 360.0


def _directions(transform: Transform, crs: str, column: float, row: float, where: str) -> tuple[float, float, tuple[float, float]]:
    a, b, c, d, e, f = transform
    columns, rows = np.array([column, column, column - 0.5, column + 0.5, column]), np.array([row + 0.5, row - 0.5, row, row, row])
    found = geographic_places(crs, (a * columns + b * rows + c).tolist(), (d * columns + e * rows + f).tolist())
    if found is None:
        raise UsageError(f"{where}: the centre of the layer is no place on the Earth in {crs}")
    longitudes, latitudes = found
    # From the centre itself, to both sides: at a pole every other place lies on a meridian of its own, and has another north.
    sides = [
        float(Geodesic.WGS84.Inverse(latitudes[4], longitudes[4], latitudes[i], longitudes[i], Geodesic.AZIMUTH)["azi1"]) for i in range(4)
    ]
    up, right = (ahead + ((back + 180.0 - ahead + 180.0) % 360.0 - 180.0) / 2 for back, ahead in (sides[:2], sides[2:]))
    return up % 360.0, right % 360.0, (longitudes[4], latitudes[4])


def _cells_m(layer: Layer, crs: str) -> Float64:
    """Return the distances between samples along the central column; where a row has no place on the Earth, those of the next one."""
    last = layer.height - 1
    nodes = np.unique(np.linspace(0, last, min(_NODES, layer.height)).round())
    column = (layer.width - 1) / 2
    found = [ground_spacing_m(layer.transform, crs, column, float(np.clip(row, 0.5, max(last - 0.5, 0.5)))) for row in nodes]
    known = [number for number, cell in enumerate(found) if cell is not None]
    pairs = np.array([cell for cell in found if cell is not None] or [layer.ground_spacing_m or (1.0, 1.0)], np.float64)
    places = nodes[known] if known else nodes[:1]
    rows = np.arange(layer.height)
    return np.stack([np.interp(rows, places, pairs[:, axis]) for axis in (0, 1)])
