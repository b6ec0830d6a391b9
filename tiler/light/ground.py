"""Where the sun stands at every sample of a large map: one vector at infinity, seen from ground that turns away beneath it.

Given where the sun stands at one place, its direction in Earth-centred coordinates is found, and from it azimuth and elevation above the
ellipsoid's horizontal at any other. On the grid they are told in its own directions: those of its rows and columns there, by their
differences of half a sample to either side. Directions and radii of WGS 84 are as in any textbook (NIMA TR 8350.2, 4.2).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.manifest import Transform
from tiler.geodesy import geographic_places
from tiler.light.frame import Shape
from tiler.light.sunposition import refracted_deg, unrefracted_deg
from tiler.light.sweeping import Float64

_SEMI_MAJOR_M: Final = 6_378_137.0
_ECCENTRICITY_SQUARED: Final = 0.00669437999014
_SHORTEST_M: Final = 1e-3
"""Samples that are nearer to each other than this are one place, a pole."""


@dataclass(frozen=True)
class Ground:
    """A grid of ``shape`` on the Earth: its transform from (column, row) to the coordinates of ``crs``."""

    shape: Shape
    transform: Transform
    crs: str

    def steps(self, rows: Float64, columns: Float64) -> "GroundSteps | None":
        """Return what the grid does at samples, places in arrays of any one shape; None if one of them is no place on the Earth.

        At the edges the differences are those half a sample inside: a pole or the end of a projection is not crossed.
        """
        height, width = self.shape
        rows, columns = rows.ravel(), columns.ravel()
        row, column = np.clip(rows, 0.5, max(height - 1.5, 0.5)), np.clip(columns, 0.5, max(width - 1.5, 0.5))
        a, b, c, d, e, f = self.transform
        y = np.concatenate([rows, row, row, row - 0.5, row + 0.5])
        x = np.concatenate([columns, column - 0.5, column + 0.5, column, column])
        places = geographic_places(self.crs, (a * x + b * y + c).tolist(), (d * x + e * y + f).tolist())
        if places is None:
            return None
        longitudes, latitudes = (np.radians(each).reshape(5, -1) for each in places)

        def ground_m(first: int, second: int) -> Float64:
            turn = np.remainder(longitudes[second] - longitudes[first] + math.pi, 2 * math.pi) - math.pi
            middle = 0.5 * (latitudes[first] + latitudes[second])
            squared = 1.0 - _ECCENTRICITY_SQUARED * np.sin(middle) ** 2
            meridian = _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_SQUARED) / squared**1.5
            return np.stack([_SEMI_MAJOR_M / np.sqrt(squared) * np.cos(middle) * turn, meridian * (latitudes[second] - latitudes[first])])

        return GroundSteps(longitudes[0], latitudes[0], ground_m(1, 2), ground_m(4, 3))


@dataclass(frozen=True)
class GroundSteps:
    """Longitudes and latitudes (n,) [radians] of places; where a column to the right and a row up lead there, (2, n) east, north [m]."""

    longitudes: Float64
    latitudes: Float64
    right_m: Float64
    up_m: Float64


@dataclass(frozen=True)
class SunView:
    """The sun seen from samples: the parts (n,) of its unit vector to the right on the grid, toward decreasing rows, and upward.

    ``cells_m`` (2, n) are the distances between samples along a row and along a column.
    """

    east: Float64
    north: Float64
    up: Float64
    cells_m: Float64

    @property
    def azimuths_deg(self) -> Float64:
        """Azimuths on the grid [degrees], clockwise from decreasing rows."""
        return np.degrees(np.arctan2(self.east, self.north)) % 360.0

    @property
    def elevations_deg(self) -> Float64:
        """Elevations [degrees]."""
        return np.degrees(np.arctan2(self.up, np.hypot(self.east, self.north)))


class SunField:
    """The sun over a grid on the round Earth, given its azimuth from true north and elevation [degrees] at ``centre_deg``, longitude first.

    With ``refraction`` the elevation is that seen through the air, and so are those at all samples.
    """

    def __init__(
        self, ground: Ground, centre_deg: tuple[float, float], azimuth_deg: float, elevation_deg: float, *, refraction: bool
    ) -> None:
        self.ground = ground
        self._refraction = refraction
        longitude, latitude = np.radians(centre_deg)
        azimuth, elevation = np.radians([azimuth_deg, unrefracted_deg(elevation_deg) if refraction else elevation_deg])
        local = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
        self._vector = local @ _axes(longitude, latitude)

    def view(self, rows: Float64, columns: Float64) -> SunView | None:
        """Return how the sun is seen from samples, (n,) rows and columns; None if one of them is no place on the Earth."""
        steps = self.ground.steps(rows, columns)
        if steps is None:
            return None
        east, north, up = np.einsum("ijn,j->in", _axes(steps.longitudes, steps.latitudes), self._vector)
        if self._refraction:
            lifted = np.radians([refracted_deg(elevation) for elevation in np.degrees(np.arcsin(np.clip(up, -1, 1)))])
            level = np.hypot(east, north)
            scale = np.cos(lifted) / np.where(level > 0, level, 1.0)
            east, north, up = east * scale, north * scale, np.sin(lifted)
        return _on_grid(steps, east, north, up)


def _axes(longitude: NDArray[np.float64], latitude: NDArray[np.float64]) -> Float64:
    """Return the unit vectors (3, 3, ...) east, north and up at places, in Earth-centred coordinates."""
    sine, cosine = np.sin(latitude), np.cos(latitude)
    zero = np.zeros_like(sine)
    return np.array(
        [
            [-np.sin(longitude), np.cos(longitude), zero],
            [-sine * np.cos(longitude), -sine * np.sin(longitude), cosine],
            [cosine * np.cos(longitude), cosine * np.sin(longitude), sine],
        ]
    )


def _on_grid(steps: GroundSteps, east: Float64, north: Float64, up: Float64) -> SunView:
    """Return the sun in directions of the grid: as many columns to the right and rows up as lead toward it, times their lengths."""
    right_m, up_m = steps.right_m, steps.up_m
    cells = np.stack([np.hypot(*right_m), np.hypot(*up_m)])
    area = right_m[0] * up_m[1] - right_m[1] * up_m[0]
    flat = np.abs(area) <= _SHORTEST_M * cells[1]
    area = np.where(flat, 1.0, area)
    columns, rows = (east * up_m[1] - north * up_m[0]) / area, (right_m[0] * north - right_m[1] * east) / area
    across, along = np.where(flat, 0.0, columns * cells[0]), np.where(flat, 0.0, rows * cells[1])
    length = np.hypot(across, along)
    # Where rows and columns are not at right angles, what leads toward the sun is right, and its length is made so.
    scale = np.hypot(east, north) / np.where(length > 0, length, 1.0)
    return SunView(across * scale, along * scale, up, np.maximum(cells, _SHORTEST_M))
