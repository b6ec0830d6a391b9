"""Statistics of a stored dataset: those of its heights in one piece, every block decoded once, safe where distances change."""

import math
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.region import Rect
from schemas.scene import Scene, Sun
from schemas.settings import BuildSettings
from tests.contract.picture_files import write_with_rasterio
from tests.reference.effects import facet_gradients
from tiler.building.build import build_layer
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.effects.dataset import measure_dataset, place_of_window, read_heights
from tiler.effects.levels import compare_levels
from tiler.effects.statistics import measure_heights
from tiler.light.place import place_of
from tiler.light.sunposition import sun_position
from tiler.stores.dataset import Dataset, open_dataset

UTM = {"crs": "EPSG:32632", "transform": Affine(30, 0, 400000, 0, -30, 5200000)}
NORTH = {"crs": "EPSG:4326", "transform": Affine(0.02, 0, 10, 0, -0.01, 72)}
"""From 72 to 70 degrees north: samples of a row lie 6 % farther apart at one end than at the other."""
SCENE = Scene(sun=Sun(azimuth_deg=200, elevation_deg=30))


def heights(height: int, width: int, seed: int = 1) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    z = np.cumsum(np.cumsum(rng.normal(size=(height, width)), axis=0), axis=1).astype(np.float32)
    z[height // 3 : height // 3 + 5, 10:30] = np.nan
    return z


def built(folder: Path, z: NDArray[np.float32], place: dict[str, Any], block: int = 32) -> Dataset:
    folder.mkdir(exist_ok=True)
    write_with_rasterio(folder / "dem.tif", z[..., np.newaxis], nodata=math.nan, **place)
    build_layer(folder / "dem.tif", folder / "out", BuildSettings(block=block, codec="raw", workers=1))
    return open_dataset(folder / "out")


@pytest.mark.parametrize(("height", "width"), [(150, 200), (32, 97), (129, 65), (20, 30), (33, 33)])
def test_as_in_one_piece(tmp_path: Path, height: int, width: int) -> None:
    z = heights(height, width)
    measured = measure_dataset(built(tmp_path, z, UTM), "height", SCENE)
    found, scene = measured.found, measured.scene
    (least,), (widest,) = {found.cell_m}, {measured.place.cell_m}
    assert least == pytest.approx(widest, rel=1e-3)
    whole = measure_heights([z], z.shape, found.cell_m, scene.sun.direction_deg)
    for name in ("low_m", "high_m", "steepest", "voids", "width", "height", "sketch_step"):
        assert getattr(found, name) == getattr(whole, name), name
    assert whole.toward <= found.toward <= whole.toward * 1.01 + 1e-6
    assert (found.tiles.facing <= whole.tiles.facing).all()
    assert (found.tiles.steepest == whole.tiles.steepest).all()
    assert np.array_equal(found.sketch, whole.sketch, equal_nan=True)


@pytest.mark.parametrize(("height", "width"), [(150, 200), (97, 300), (33, 33)])
def test_levels_are_compared_as_in_one_piece(tmp_path: Path, height: int, width: int) -> None:
    dataset = built(tmp_path, heights(height, width), UTM)
    reader = BlockReader(dataset, "height")
    facts = measure_dataset(dataset, "height", SCENE)
    sizes = [Rect(0, 0, level.width, level.height) for level in reader.layer.levels]
    levels = [read_heights(reader, size, number) for number, size in enumerate(sizes)]
    cell = facts.found.cell_m
    expected = [compare_levels(fine, coarse, cell) for fine, coarse in pairwise(levels)]
    assert facts.facts.differences_m == tuple(one.height_m for one in expected)
    assert facts.facts.gradient_difference == expected[0].gradient


def test_one_block_has_no_other_level(tmp_path: Path) -> None:
    measured = measure_dataset(built(tmp_path, heights(30, 20), UTM), "height", SCENE)
    assert measured.facts.differences_m == ()
    assert measured.facts.gradient_difference is None
    assert measured.plan().effect("geomorph").bound is None


def test_every_block_is_decoded_once_and_few_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = built(tmp_path, heights(300, 170), UTM)
    decoded: Counter[BlockAddress] = Counter()
    read_core = BlockReader.read_core

    def counted(self: BlockReader, address: BlockAddress) -> DecodedBlock | None:
        decoded[address] += 1
        return read_core(self, address)

    monkeypatch.setattr(BlockReader, "read_core", counted)
    rows: list[tuple[int, int]] = []
    measure_dataset(dataset, "height", SCENE, workers=1, on_progress=lambda done, total: rows.append((done, total)))
    layer = dataset.manifest.layer("height")
    assert set(decoded.values()) == {1}
    assert len(decoded) == sum(level.columns * level.rows for level in layer.levels)
    assert rows == [(n, len(rows)) for n in range(1, len(rows) + 1)]


def test_distances_that_change_are_on_the_safe_side(tmp_path: Path) -> None:
    """Slope, and how facets face the sun, with the distances of each facet's own row, for suns all around."""
    z = 30 * heights(40, 50, seed=4)
    dataset = built(tmp_path, z, NORTH)
    for azimuth in (0, 60, 90, 135, 180, 250, 300):
        measured = measure_dataset(dataset, "height", Scene(sun=Sun(azimuth_deg=azimuth, elevation_deg=75)))
        found, place = measured.found, measured.place
        assert found.cell_m[0] < place.cells_m[0, 0] * 1.001
        grid_azimuth, elevation = (math.radians(angle) for angle in measured.scene.sun.direction_deg)
        east, north = math.sin(grid_azimuth), math.cos(grid_azimuth)
        for row in range(0, z.shape[0] - 1, 3):
            gradients = facet_gradients(z[row : row + 2].astype(np.float64), (float(place.cells_m[0, row]), float(place.cells_m[1, row])))
            toward = gradients[:, 0] * east - gradients[:, 1] * north
            length = np.hypot(gradients[:, 0], gradients[:, 1])
            facing = (math.sin(elevation) - math.cos(elevation) * toward) / np.sqrt(1 + length**2)
            assert length.max() <= found.steepest
            assert toward.max() <= found.toward
            assert facing.min() >= min(found.facing, 0.0) or facing.min() >= found.facing
        assert found.diagonal_m >= math.hypot(49 * place.cells_m[0].mean(), 39 * place.cells_m[1].mean())


def test_a_time_becomes_a_sun(tmp_path: Path) -> None:
    scene = Scene.model_validate({"sun": {"when": "2026-06-21T10:00:00Z"}})
    measured = measure_dataset(built(tmp_path, heights(64, 64), UTM), "height", scene)
    place = measured.place
    assert place.longitude_deg is not None
    assert place.latitude_deg is not None
    assert scene.sun.when is not None
    azimuth, elevation = sun_position(scene.sun.when, place.longitude_deg, place.latitude_deg)
    plan = measured.plan()
    assert (plan.azimuth_deg, plan.elevation_deg) == pytest.approx((azimuth, elevation))
    assert measured.scene.sun.direction_deg[0] == pytest.approx(place.on_grid(azimuth, elevation).azimuth_deg)


def test_windows(tmp_path: Path) -> None:
    z = heights(100, 90)
    dataset = built(tmp_path, z, UTM)
    reader = BlockReader(dataset, "height")
    for window in (Rect(0, 0, 90, 100), Rect(31, 32, 33, 65), Rect(89, 99, 90, 100), Rect(5, 60, 80, 61)):
        found = read_heights(reader, window)
        assert np.array_equal(found, z[window.y0 : window.y1, window.x0 : window.x1], equal_nan=True)
        place = place_of_window(place_of(reader.layer, dataset.manifest.world, "here"), window)
        assert place.cells_m.shape == (2, window.height)


def test_what_cannot_be_planned(tmp_path: Path) -> None:
    write_with_rasterio(tmp_path / "photo.tif", np.zeros((9, 9, 3), np.uint8))
    build_layer(tmp_path / "photo.tif", tmp_path / "out", BuildSettings(block=32, codec="raw", workers=1))
    opened = open_dataset(tmp_path / "out")
    with pytest.raises(NotFoundError, match="light"):
        measure_dataset(opened, "light", SCENE)
    with pytest.raises(UsageError, match="is of kind imagery"):
        measure_dataset(opened, "imagery", SCENE)
    (tmp_path / "void").mkdir()
    void = np.full((40, 40), np.nan, np.float32)
    void[3, 3] = 1.0
    dataset = built(tmp_path / "void", void, UTM)
    assert measure_dataset(dataset, "height", SCENE).found.voids > 0
    block = next((tmp_path / "void" / "out" / "height" / "0").glob("height-0-*.raw"))
    block.write_bytes(block.read_bytes()[:-1] + b"x")
    with pytest.raises(InputError, match="damaged"):
        measure_dataset(open_dataset(tmp_path / "void" / "out"), "height", SCENE)
