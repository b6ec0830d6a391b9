"""Light at twice the heights' resolution: what it must share with light on the heights, and that it is nearer to the truth."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.manifest import Layer
from schemas.settings import BuildSettings
from tests.integration.files import tree_digest
from tests.integration.lighting import CELL_M, light, lit, plain_tiff, ramp, rough, samples, store_heights, toward
from tests.reference.edges import extend
from tests.reference.kernels import taps
from tests.reference.pyramid import coarsen
from tiler.building.build import build_layer
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks, verify
from tiler.inspecting.probe import probe_world
from tiler.stores.dataset import open_dataset

Array = NDArray[np.float64]


def layer_of(dataset: Path, name: str) -> Layer:
    return open_dataset(dataset).manifest.layer(name)


@pytest.mark.parametrize("shadows", ["none", "hard", "certified", "soft"])
def test_a_plane_is_lit_alike_at_any_resolution(shadows: str, tmp_path: Path) -> None:
    """Exactly between the heights, too: ramps go on exactly, to the edge."""
    dataset = store_heights(tmp_path, ramp(0.25, -0.125))
    east, north, up = toward(200, 40)
    expected = (up - 0.25 * east + 0.125 * north) / math.sqrt(1 + 0.25**2 + 0.125**2)
    found = lit(dataset, 200, 40, shadows=shadows, density=2)
    assert found.shape == (79, 79)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    np.testing.assert_array_equal(found[::2, ::2], lit(dataset, 200, 40, shadows=shadows))


def test_light_between_heights_is_nearer_to_that_of_the_ground_itself(tmp_path: Path) -> None:
    """Hills that are known everywhere, 12 samples from one to the next: slopes are 4.5 % off on the heights, 1.3 % at twice the density."""

    def normal_light(step: float, side: int) -> Array:
        y, x = np.mgrid[0:side, 0:side] * step
        wave = 2 * math.pi / 12
        east_slope, north_slope = 60 * wave * np.cos(wave * x) * np.sin(wave * y), -60 * wave * np.sin(wave * x) * np.cos(wave * y)
        east, north, up = toward(250, 35)
        facing = up - (east_slope * east + north_slope * north) / CELL_M
        return np.asarray(np.maximum(facing / np.sqrt(1 + (east_slope**2 + north_slope**2) / CELL_M**2), 0), np.float64)

    y, x = np.mgrid[0:61, 0:61]
    dataset = store_heights(tmp_path, 60 * np.sin(2 * math.pi * x / 12) * np.sin(2 * math.pi * y / 12))
    inner = np.s_[8:-8, 8:-8]
    coarse = np.abs(lit(dataset, 250, 35, shadows="none") - normal_light(1, 61))[inner].mean()
    fine = np.abs(lit(dataset, 250, 35, shadows="none", density=2) - normal_light(0.5, 121))[inner]
    assert fine.mean() < coarse / 2.5
    assert fine[1::2, 1::2].mean() < coarse / 2.5, "between the heights as well"


def test_samples_lie_where_the_manifest_says(tmp_path: Path) -> None:
    """Sample 2i of the light on height i, both half as far apart; a place asked for by world coordinates is the same place."""
    heights = np.zeros((40, 50))
    heights[12, 30] = 500.0
    dataset = store_heights(tmp_path, heights)
    report = light(dataset, 90, 45, density=2, codec="exr:float", layer="fine")
    layer = layer_of(dataset, "fine")
    assert (layer.width, layer.height, layer.registration) == (99, 79, "point")
    assert layer.transform == (CELL_M / 2, 0.0, 0.0, 0.0, -CELL_M / 2, 0.0)
    assert layer.ground_spacing_m == (CELL_M / 2, CELL_M / 2)
    assert layer.extent == layer_of(dataset, "height").extent
    assert report.light.density == 2
    x, y = 30 * CELL_M - 100, -12 * CELL_M
    facts = probe_world(open_dataset(dataset), x, y, ["fine", "height"])
    assert facts.layers[0].levels[0].sample == (round(2 * x / CELL_M), 24)
    assert facts.layers[0].levels[0].value == [0.0], "west of the tower, in its shadow"
    found = samples(dataset, report)
    dark = np.flatnonzero(found[24] == 0)
    assert dark.min() / 2 == pytest.approx(30 - 500 / CELL_M, abs=1.5)


def test_the_manifest_of_light_on_the_heights_is_what_it_was(tmp_path: Path) -> None:
    """A field that is there only at twice the density: datasets from before keep their version."""
    dataset = store_heights(tmp_path, rough(40))
    light(dataset, 90, 45)
    assert "density" not in json.loads((dataset / "manifest.json").read_bytes())["layers"]["light"]["light"]


def test_nothing_depends_on_workers_or_tasks(tmp_path: Path) -> None:
    heights = rough(150)
    heights[40:44, 60:70] = np.nan
    dataset = store_heights(tmp_path, heights)
    options: dict[str, Any] = {"shadows": "soft", "sky": 4, "bounce": True, "density": 2}
    trees = []
    for task, workers in ((64, 1), (64, 2), (128, 3), (1024, 1)):
        report = light(dataset, 215, 12, task=task, workers=workers, overwrite=True, **options)
        trees.append(tree_digest(dataset / report.build.manifest.layer("light").path))
    assert len(set(trees)) == 1
    assert verify(open_dataset(dataset)).findings == []


@pytest.mark.parametrize("shadows", ["hard", "certified", "soft"])
def test_a_turned_terrain_has_the_turned_light(shadows: str, tmp_path: Path) -> None:
    heights = rough(60)
    heights[20:23, 30:34] = np.nan
    found = []
    for quarters in range(4):
        (tmp_path / str(quarters)).mkdir()
        dataset = store_heights(tmp_path / str(quarters), np.rot90(heights, quarters))
        found.append(np.rot90(lit(dataset, 130 - 90 * quarters, 20, shadows=shadows, curvature=True, density=2), -quarters))
    assert len({each.tobytes() for each in found}) == 1


def test_voids_stay_voids_and_ground_beside_them_is_lit_as_a_plain(tmp_path: Path) -> None:
    heights = np.zeros((40, 40))
    heights[10:14, 20:30] = np.nan
    found = lit(store_heights(tmp_path, heights), 180, 30, density=2)
    void = np.isnan(found)
    assert void[19:28, 39:60].all(), "from the midpoint before the first void to the one after the last"
    assert void.sum() == 9 * 21
    np.testing.assert_allclose(found[~void], 0.5, atol=1e-6)


def test_an_update_is_a_new_build(tmp_path: Path) -> None:
    heights = np.zeros((128, 128))
    heights[::16, ::16] = 20
    dataset = store_heights(tmp_path, heights)
    first = light(dataset, 270, 30, task=64, density=2)
    assert light(dataset, 270, 30, task=64, density=2).build.outcome == "up to date"
    heights[50, 65] = 600
    store_heights(tmp_path, heights, update=True)
    second = light(dataset, 270, 30, task=64, density=2, update=True)
    assert second.build.outcome == "updated"
    assert 0 < second.build.blocks_written < first.build.blocks_written / 2
    (tmp_path / "fresh").mkdir()
    fresh = store_heights(tmp_path / "fresh", heights)
    again = light(fresh, 270, 30, task=64, density=2)
    for level in range(4):
        assert samples(dataset, second, level).tobytes() == samples(fresh, again, level).tobytes()
    before = tree_digest(dataset)
    layer = layer_of(dataset, "light")
    sorted((dataset / layer.path / "0").glob("*.png"))[0].write_bytes(b"damaged")
    report = verify_and_repair(open_dataset(dataset), None, Checks())
    assert (len(report.repaired), report.findings) == (1, [])
    assert tree_digest(dataset) == before


def test_coarser_levels_are_mirrored_at_the_outermost_sample(tmp_path: Path) -> None:
    """Against the reference in float64; with the mirror of cells light at the border would lie half a sample off."""
    assert extend(np.arange(4.0).reshape(4, 1, 1), np.ones((4, 1, 1)), (2, 2), "mirror-sample")[0][:, 0, 0].tolist() == [
        2,
        1,
        0,
        1,
        2,
        3,
        2,
        1,
    ]
    dataset = store_heights(tmp_path, rough(75))
    for density in (1, 2):
        report = light(dataset, 300, 30, codec="exr:float", density=density, overwrite=True)
        layer = report.build.manifest.layer("light")
        assert (layer.filter.edge, layer.registration) == ("mirror-sample", "point")
        expected = samples(dataset, report)[..., np.newaxis]
        for level in range(1, len(layer.levels)):
            expected, _ = coarsen(expected, None, kernel="blackman-sinc", radius=3, registration="point", edge="mirror-sample")
            np.testing.assert_allclose(samples(dataset, report, level), expected[..., 0], atol=2e-6)
    assert taps("blackman-sinc", 3, "point")[1].sum() == pytest.approx(1)


def test_single_rows_of_heights(tmp_path: Path) -> None:
    source = plain_tiff(tmp_path / "row.tif", np.linspace(0, 90, 40, dtype=np.float32)[np.newaxis])
    build_layer(source, tmp_path / "row", BuildSettings(layer="height", codec="raw", block=32, spacing=CELL_M))
    found = lit(tmp_path / "row", 90, 30, density=2)
    assert found.shape == (1, 79)
    np.testing.assert_allclose(found, found[0, 0], rtol=1e-5)
