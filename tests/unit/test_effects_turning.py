"""By how much a grid turns the sun: against vectors at places, found with other formulas."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.manifest import World
from tests.unit.test_effects_dataset import SCENE, UTM, built
from tiler.effects.dataset import measure_dataset
from tiler.effects.turning import sun_turn_deg
from tiler.light.place import GridPlace, place_of
from tiler.stores.dataset import Dataset

Array = NDArray[np.float64]


def local_sun(longitude: float, latitude: float, vector: Array) -> Array:
    """The vector as east, north and up of a place [degrees], by turning the globe under it."""
    a, b = math.radians(longitude), math.radians(latitude)
    about_axis = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
    outward, east, polar = about_axis @ vector
    return np.array([east, polar * math.cos(b) - outward * math.sin(b), outward * math.cos(b) + polar * math.sin(b)])


def from_local(longitude: float, latitude: float, azimuth: float, elevation: float) -> Array:
    """The Earth-centred vector of a sun at azimuth and elevation of a place: ``local_sun`` solved for its argument."""
    matrix = np.column_stack([local_sun(longitude, latitude, axis) for axis in np.eye(3)])
    a, e = math.radians(azimuth), math.radians(elevation)
    found = np.linalg.solve(matrix, [math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])
    return np.asarray(found, np.float64)


def place(dataset: Dataset) -> GridPlace:
    world: World = dataset.manifest.world
    return place_of(dataset.manifest.layer("height"), world, "here")


def degrees(step_x: float, step_y: float, north: float) -> dict[str, Any]:
    return {"crs": "EPSG:4326", "transform": Affine(step_x, 0, 10, 0, -step_y, north)}


@pytest.mark.parametrize("where", [degrees(0.1, 0.05, 52), degrees(0.1, 0.01, 85), degrees(0.02, 0.01, -40), degrees(0.5, 0.5, 20)])
@pytest.mark.parametrize(("azimuth", "elevation"), [(200.0, 30.0), (10.0, 3.0), (95.0, 89.0)])
def test_the_sun_turns_as_it_does_at_places(where: dict[str, Any], azimuth: float, elevation: float, tmp_path: Any) -> None:
    """In geographic coordinates rows run along parallels, so that a place's east and north are the grid's."""
    height, width = 40, 60
    grid = place(built(tmp_path, np.zeros((height, width), np.float32), where))
    assert grid.longitude_deg is not None
    assert grid.latitude_deg is not None
    vector = from_local(grid.longitude_deg, grid.latitude_deg, azimuth, elevation)
    centre = local_sun(grid.longitude_deg, grid.latitude_deg, vector)
    transform, largest = where["transform"], 0.0
    for row in np.linspace(0.5, height - 0.5, 9):
        for column in np.linspace(0.5, width - 0.5, 9):
            seen = local_sun(transform.c + transform.a * column, transform.f + transform.e * row, vector)
            largest = max(largest, 2 * math.degrees(math.asin(min(1.0, float(np.linalg.norm(seen - centre)) / 2))))
    found = sun_turn_deg(grid, azimuth, elevation)
    assert largest <= found <= 1.03 * largest + 1e-3


def test_at_a_pole_the_grid_turns_more_than_the_globe(tmp_path: Any) -> None:
    z = np.zeros((64, 64), np.float32)
    z[5, 5] = 0.1
    measured = measure_dataset(built(tmp_path, z, degrees(0.02, 0.0002, 89.9)), "height", SCENE)
    turn = measured.plan().effect("sun_direction")
    vertical = math.degrees(measured.found.diagonal_m / 2 / 6.3e6)
    assert measured.found.sun_turn_deg > 20 * vertical
    assert turn.bound is not None
    assert turn.bound >= math.radians(measured.found.sun_turn_deg) * 255 / 1.15 * 0.999
    assert "on the grid" in turn.statistic


def test_a_grid_that_lies_nowhere_turns_nothing(tmp_path: Any) -> None:
    grid = place(built(tmp_path, np.zeros((40, 60), np.float32), UTM))
    assert 0 < sun_turn_deg(grid, 200.0, 30.0) < 0.1
    assert sun_turn_deg(GridPlace(grid.cells_m, grid.cell_m, 0.0, 1, None, None), 200.0, 30.0) == 0
