"""Light on large maps: the sun of every sample, against rays walked through space, and zones that nobody can see."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.manifest import Transform
from schemas.region import Rect
from tests.reference.sunrays import clearances, seen_from, sun_vector
from tests.reference.terrain import power_law_field
from tiler.light.directions import sun_directions
from tiler.light.frame import Earth, SunPosition
from tiler.light.ground import Ground, SunField
from tiler.light.place import GridPlace
from tiler.light.sunposition import refracted_deg, unrefracted_deg
from tiler.light.sweeping import Float32, Float64
from tiler.light.visibility import TOP, HeightWindow, SunSetting, hard_sun, make_shares, sun_shares, whole_zone
from tiler.light.zones import SunZones, Zone, centre_of, sky_zones

ROUND = Earth(refraction=0.0)


@dataclass(frozen=True)
class Grid:
    """Heights in memory, as ``HeightGrid`` gives them."""

    heights: Float32
    block: int = 32

    @property
    def shape(self) -> tuple[int, int]:
        return self.heights.shape[0], self.heights.shape[1]

    @property
    def range_m(self) -> tuple[float, float]:
        return float(self.heights.min()), float(self.heights.max())

    def read(self, window: Rect, /) -> Float32:
        return self.heights[window.y0 : window.y1, window.x0 : window.x1]

    def read_around(self, window: Rect, /) -> Float32:
        around = np.pad(self.heights, 1, constant_values=np.float32(np.nan))
        return around[window.y0 : window.y1 + 2, window.x0 : window.x1 + 2]


def rough(height: int, width: int, relief_m: float) -> Float32:
    field = power_law_field(max(height, width), max(height, width), 3, 3.2)[:height, :width]
    return np.asarray(relief_m * (field - field.min()) / (field.max() - field.min()), np.float32)


@dataclass(frozen=True)
class Geographic:
    """A grid of longitudes and latitudes, and how to get from its samples to the Earth and back."""

    shape: tuple[int, int]
    cell_deg: float
    west: float
    north: float

    @property
    def transform(self) -> Transform:
        return (self.cell_deg, 0, self.west, 0, -self.cell_deg, self.north)

    @property
    def centre_deg(self) -> tuple[float, float]:
        longitudes, latitudes = self.place(*(np.array([(side - 1) / 2]) for side in self.shape))
        return float(np.degrees(longitudes[0])), float(np.degrees(latitudes[0]))

    def place(self, rows: Float64, columns: Float64) -> tuple[Float64, Float64]:
        return np.radians(self.west + self.cell_deg * columns), np.radians(self.north - self.cell_deg * rows)

    def samples(self, longitudes: Float64, latitudes: Float64) -> tuple[Float64, Float64]:
        turned = (np.degrees(longitudes) - self.centre_deg[0] + 180) % 360 - 180 + self.centre_deg[0]
        return (self.north - np.degrees(latitudes)) / self.cell_deg, (turned - self.west) / self.cell_deg

    def field(self, azimuth: float, elevation: float, *, refraction: bool = False) -> SunField:
        return SunField(Ground(self.shape, self.transform, "EPSG:4326"), self.centre_deg, azimuth, elevation, refraction=refraction)


class Mercator(Geographic):
    """The same in EPSG:3857: columns are as far apart, rows are at equal distances of the projection."""

    _RADIUS = 6378137.0

    @property
    def transform(self) -> Transform:
        cell = self._RADIUS * math.radians(self.cell_deg)
        return (cell, 0, self._RADIUS * math.radians(self.west), 0, -cell, self._RADIUS * self._top)

    @property
    def _top(self) -> float:
        return math.asinh(math.tan(math.radians(self.north)))

    def place(self, rows: Float64, columns: Float64) -> tuple[Float64, Float64]:
        return np.radians(self.west + self.cell_deg * columns), np.arctan(np.sinh(self._top - np.radians(self.cell_deg) * rows))

    def samples(self, longitudes: Float64, latitudes: Float64) -> tuple[Float64, Float64]:
        return (self._top - np.arcsinh(np.tan(latitudes))) / math.radians(self.cell_deg), super().samples(longitudes, latitudes)[1]

    def field(self, azimuth: float, elevation: float, *, refraction: bool = False) -> SunField:
        return SunField(Ground(self.shape, self.transform, "EPSG:3857"), self.centre_deg, azimuth, elevation, refraction=refraction)


SCANDINAVIA = Geographic((300, 800), 0.05, 10.0, 67.5)
SOUTH = Geographic((300, 800), 0.05, -80.0, -52.5)
FIJI = Geographic((300, 500), 0.05, 167.0, -40.0)
WEB = Mercator((300, 800), 0.05, 10.0, 64.0)


def shares_of(grid: Grid, zones: list[Zone], setting: SunSetting, tmp_path: Path, workers: int = 2) -> NDArray[np.uint16]:
    shares = make_shares(grid, tmp_path)
    sun_shares(grid, zones, setting, workers, shares)
    found = shares.read(Rect(0, 0, grid.shape[1], grid.shape[0]))[..., 0].copy()
    shares.close()
    return np.asarray(found, np.uint16)


def one_zone(field: SunField) -> list[Zone]:
    """The whole map as its centre is lit."""
    height, width = field.ground.shape
    whole = Rect(0, 0, width, height)
    row, column = centre_of(whole)
    view = field.view(np.array([row]), np.array([column]))
    assert view is not None
    sun = SunPosition(float(view.azimuths_deg[0]), float(view.elevations_deg[0]))
    return [Zone(whole, whole, (float(view.cells_m[0, 0]), float(view.cells_m[1, 0])), sun, (row, column))]


def planned(field: SunField, grid: Grid, radius_deg: float = 0.0) -> list[Zone]:
    zones = SunZones(field, grid.range_m, ROUND, radius_deg).plan()
    assert zones is not None
    return zones


@pytest.mark.parametrize(
    ("where", "azimuth", "elevation"),
    [(SCANDINAVIA, 270, 10), (SCANDINAVIA, 160, 5), (SOUTH, 60, 7), (FIJI, 300, 8), (WEB, 90, 8)],
    ids=["west over 60 N", "south over 60 N", "southern summer", "across the antimeridian", "Web Mercator"],
)
def test_shadows_are_those_of_rays_through_space(where: Geographic, azimuth: float, elevation: float, tmp_path: Path) -> None:
    """40 degrees of longitude: over them the sun's azimuth changes by 35 degrees. Cells of 3 by 6 km, mountains of 14 km.

    Rays cross bilinear ground there, and ground that is straight between the samples of a row here, so some edges differ by less than a
    sample. By more than the sun's radius hardly any does; with one sun for the map there are many times as many.
    """
    grid = Grid(rough(*where.shape, 14_000.0))
    field = where.field(azimuth, elevation)
    vector = sun_vector(*where.centre_deg, azimuth, elevation)
    random = np.random.default_rng(1)
    rows, columns = random.integers(0, where.shape[0], 8000), random.integers(0, where.shape[1], 8000)
    start = rows.astype(np.float64), columns.astype(np.float64)
    clear = clearances(grid.heights.astype(float), start, where.place, where.samples, vector, 1000.0, 250e3)
    wrong = []
    for zones in (planned(field, grid), one_zone(field)):
        lit = shares_of(grid, zones, SunSetting(None, None, ROUND), tmp_path)[rows, columns] == TOP
        assert 0.3 < lit.mean() < 0.99, "else there is little to see"
        wrong.append(((lit != (clear >= 0)) & (np.abs(clear) > math.radians(0.2666))).mean())
    assert wrong[0] < 0.006
    assert wrong[1] > 2.5 * wrong[0]


def test_a_zone_is_swept_as_the_whole_map_would_be(tmp_path: Path) -> None:
    """Its window reaches as far as anything that shades it, so its shadows are those of the whole map under the zone's sun, bit for bit."""
    grid = Grid(rough(*SCANDINAVIA.shape, 14_000.0))
    for setting in (SunSetting(2, None, ROUND), SunSetting(None, None, ROUND)):
        zones = planned(SCANDINAVIA.field(300, 12), grid)
        found = shares_of(grid, zones, setting, tmp_path)
        for zone in zones[:: len(zones) // 6]:
            assert not zone.window.contains(Rect(0, 0, 800, 300))
            alone = Zone(zone.core, Rect(0, 0, 800, 300), zone.cell_m, zone.sun, zone.centre)
            whole = np.zeros(grid.shape, np.uint16)
            for window, seen in hard_sun(HeightWindow(grid, alone.window), alone, setting):
                whole[window.y0 : window.y1, window.x0 : window.x1] = seen
            core = slice(zone.core.y0, zone.core.y1), slice(zone.core.x0, zone.core.x1)
            # The lines of a sweep are counted from its window's corner: elsewhere they lie at other shares of a column.
            assert (whole[core] == found[core]).mean() > (0.99 if setting.lines else 0.99999)


def test_zones_cover_the_map_once_and_bands_and_workers_change_nothing(tmp_path: Path) -> None:
    grid = Grid(rough(*SCANDINAVIA.shape, 9_000.0))
    zones = planned(SCANDINAVIA.field(250, 15), grid, 0.2666)
    count = np.zeros(grid.shape, int)
    for zone in zones:
        assert zone.window.contains(zone.core)
        count[zone.core.y0 : zone.core.y1, zone.core.x0 : zone.core.x1] += 1
    assert (count == 1).all()
    for setting in (SunSetting(1, None, ROUND), SunSetting(None, None, ROUND), SunSetting(None, 0.2666, ROUND)):
        first = shares_of(grid, zones, setting, tmp_path, 1)
        assert first.tobytes() == shares_of(Grid(grid.heights, 7), zones, setting, tmp_path, 3).tobytes()


def test_a_small_map_is_one_zone_and_as_it_was() -> None:
    """12 km of 10 m samples in UTM, 1 degree off the central meridian, under a low sun."""
    ground = Ground((1200, 1200), (10, 0, 574_000, 0, -10, 5_196_000), "EPSG:32632")
    for azimuth in (0, 90, 200, 300):
        for elevation in (3, 10, 40):
            field = SunField(ground, (10.05, 46.9), azimuth, elevation, refraction=True)
            assert SunZones(field, (200, 1500), Earth(), 0.2666).plan() is None
            assert sky_zones(field, (200, 1500), Earth()) is None


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
@pytest.mark.parametrize("soft", [False, True])
def test_day_and_night_of_the_whole_earth(crs: str, soft: bool, tmp_path: Path) -> None:
    """A calm sea sees the sun where it stands above the horizontal: half of the Earth, its border a great circle."""
    height, width = 180, 360
    side = 2 * math.pi * 6378137.0
    transform: Transform = (1.0, 0, -179.5, 0, -1.0, 89.5) if crs == "EPSG:4326" else (side / 360, 0, -side / 2, 0, -side / 360, side / 4)
    grid = Grid(np.zeros((height, width), np.float32))
    field = SunField(Ground(grid.shape, transform, crs), (0.0, 0.0), 60.0, 30.0, refraction=False)
    view = field.view(*(each.ravel().astype(float) for each in np.mgrid[0:height, 0:width]))
    assert view is not None
    shares = shares_of(grid, planned(field, grid, 0.2666 * soft), SunSetting(1, 0.2666 if soft else None, ROUND), tmp_path)
    elevations = view.elevations_deg.reshape(height, width)
    assert elevations.max() > 89
    steps = field.ground.steps(*(each.ravel().astype(float) for each in np.mgrid[0:height, 0:width]))
    assert steps is not None
    away = np.abs(np.degrees(steps.latitudes.reshape(height, width))) < 75
    assert (shares[away & (elevations > 0.75)] == TOP).all()
    assert (shares[away & (elevations < -0.75)] == 0).all()


@given(
    azimuth=st.integers(0, 360 * 64).map(lambda turn: turn / 64),
    elevation=st.integers(-5 * 64, 89 * 64).map(lambda turn: turn / 64),
    refraction=st.booleans(),
    where=st.sampled_from([SCANDINAVIA, SOUTH, FIJI, WEB]),
)
@settings(max_examples=30, deadline=None)
def test_the_sun_is_where_space_has_it(azimuth: float, elevation: float, refraction: bool, where: Geographic) -> None:
    """Azimuth and elevation of all samples to a millionth of a degree of rounding, and the half a percent that differences cost."""
    field = where.field(azimuth, elevation, refraction=refraction)
    rows, columns = np.mgrid[1 : where.shape[0] - 1 : 29, 1 : where.shape[1] - 1 : 31].reshape(2, -1).astype(np.float64)
    view = field.view(rows, columns)
    assert view is not None
    vector = sun_vector(*where.centre_deg, azimuth, unrefracted_deg(elevation) if refraction else elevation)
    azimuths, elevations = seen_from(*where.place(rows, columns), vector)
    if refraction:
        elevations = np.array([refracted_deg(each) for each in elevations])
    np.testing.assert_allclose(view.elevations_deg, elevations, atol=1e-5)
    off = (view.azimuths_deg - azimuths + 180) % 360 - 180
    assert np.abs(off * np.cos(np.radians(elevations))).max() < 0.01


def test_interpolated_directions_have_no_step_and_are_right() -> None:
    """To 0.02 codes of 8 bits everywhere, whatever windows they are read in."""
    field = SCANDINAVIA.field(270, 20)
    ground = GridPlace(np.full((2, 300), 4000.0), (2780.0, 5570.0), 0.0, 1, *SCANDINAVIA.centre_deg, field.ground)
    directions = sun_directions(field, ground, SunPosition(270, 20), ROUND)
    assert directions is not None
    found = np.full((5, 300, 800), np.nan)
    for patch in directions.patches(Rect(0, 0, 800, 300)):
        window, (row, column, down, right) = patch.window, patch.place
        y = (row + np.arange(window.height))[:, np.newaxis] / down
        x = (column + np.arange(window.width)) / right
        (a, b), (c, d) = np.moveaxis(patch.corners, 0, -1)[..., np.newaxis, np.newaxis]
        found[:, window.y0 : window.y1, window.x0 : window.x1] = (a * (1 - y) + c * y) * (1 - x) + (b * (1 - y) + d * y) * x
    rows, columns = np.mgrid[0:300, 0:800].reshape(2, -1).astype(np.float64)
    view = field.view(rows, columns)
    assert view is not None
    expected = np.concatenate([np.stack([view.east, view.north, view.up]), view.cells_m]).reshape(5, 300, 800)
    assert 255 * np.abs(found[:3] - expected[:3]).max() < 0.02
    assert np.abs(found[3:] / expected[3:] - 1).max() < 2e-3
    part = Rect(123, 45, 500, 201)
    pieces = [patch.window for patch in directions.patches(part)]
    assert sum(piece.area for piece in pieces) == part.area
    assert all(part.contains(piece) for piece in pieces)


def test_a_small_map_has_one_direction() -> None:
    ground = Ground((1000, 1000), (10, 0, 500_000, 0, -10, 5_200_000), "EPSG:32632")
    field = SunField(ground, (9.07, 46.9), 200, 30, refraction=False)
    view = field.view(np.array([499.5]), np.array([499.5]))
    assert view is not None
    sun = SunPosition(float(view.azimuths_deg[0]), float(view.elevations_deg[0]))
    place = GridPlace(np.full((2, 1000), 10.0), (10.0, 10.0), 0.0, 1, 9.07, 46.9, ground)
    assert sun_directions(field, place, sun, ROUND) is None


@given(st.integers(-5 * 64, 89 * 64).map(lambda turn: turn / 64))
def test_refraction_is_taken_back(elevation: float) -> None:
    assert unrefracted_deg(refracted_deg(elevation)) == pytest.approx(elevation, abs=1e-9)


def test_a_map_that_nobody_has_placed_is_one_zone() -> None:
    place = GridPlace(np.full((2, 10), 30.0), (30.0, 30.0), 0.0, 1, None, None)
    zone = whole_zone(Grid(np.zeros((10, 20), np.float32)), place, SunPosition(200, 30))
    assert (zone.core, zone.window, zone.reference) == (Rect(0, 0, 20, 10), Rect(0, 0, 20, 10), (4.5, 9.5))
