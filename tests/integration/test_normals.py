"""Layers of normals: against differences of heights in NumPy, and that nothing depends on how they were computed."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.errors import NotFoundError, UsageError
from schemas.settings import NormalSettings
from tests.integration.files import assemble, tree_digest
from tests.integration.lighting import CELL_M, lit, ramp, rough, store_heights, toward
from tests.reference.midpoints import refined
from tests.reference.pyramid import coarsen
from tiler.building.normals import NormalReport, build_normals
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks, verify
from tiler.stores.dataset import open_dataset

Array = NDArray[np.float64]


def normals(dataset: Path, **options: Any) -> NormalReport:
    return build_normals(dataset, NormalSettings(**options))


def vectors(dataset: Path, report: NormalReport, level: int = 0) -> Array:
    """A level as (x, y), by what the manifest says of its codes; NaN where it is void."""
    opened = open_dataset(dataset)
    layer = opened.manifest.layer(report.build.layer)
    assert layer.normals is not None
    values, valid = assemble(opened, report.build.layer, level)
    found = (values[..., :2].astype(np.float64) - layer.normals.zero) / layer.normals.one
    found[~valid if not layer.alpha else values[..., 2] == 0] = np.nan
    return np.asarray(found[: layer.levels[level].height, : layer.levels[level].width])


def slopes(heights: Array, cell_m: float) -> Array:
    """Rise per metre from left to right: central, or to the one side on which there is ground."""
    right = np.full(heights.shape, np.nan)
    right[:, :-1] = heights[:, 1:] - heights[:, :-1]
    left = np.full(heights.shape, np.nan)
    left[:, 1:] = right[:, :-1]
    both = np.where(np.isnan(left), right, np.where(np.isnan(right), left, (left + right) / 2))
    return np.where(np.isnan(heights), np.nan, np.nan_to_num(both)) / cell_m


def expected_of(heights: NDArray[Any], cell_m: float = CELL_M) -> Array:
    """The reference: x and y of the unit normals."""
    heights = heights.astype(np.float64)
    east, north = slopes(heights, cell_m), -slopes(heights.T, cell_m).T
    return np.stack([-east, -north], axis=-1) / np.sqrt(1 + east**2 + north**2)[..., np.newaxis]


def with_voids(side: int = 120) -> NDArray[np.float32]:
    heights = rough(side)
    heights[30:50, 40:43] = np.nan
    heights[60, 60] = heights[62, 60] = np.nan
    heights[64:96, 0:32] = np.nan
    return heights


@pytest.mark.parametrize(
    ("codec", "bits", "within"),
    [
        ("png", 8, 0.501 / 127),
        ("png", 16, 0.51 / 32767),
        ("raw", 8, 0.501 / 127),
        ("raw", 16, 0.51 / 32767),
        ("exr:half", 8, 2.5e-4),
        ("exr:float", 8, 3e-7),
    ],
)
@pytest.mark.parametrize("density", [1, 2])
@pytest.mark.parametrize("voids", [False, True])
def test_normals_are_differences_of_heights(codec: str, bits: int, within: float, density: int, voids: bool, tmp_path: Path) -> None:
    heights = with_voids() if voids else rough(120)
    dataset = store_heights(tmp_path, heights)
    report = normals(dataset, codec=codec, bits=bits, density=density)
    # Midpoints are float32 heights: rounding 1500 m to them turns a slope by up to 8e-6.
    ground = heights if density == 1 else refined(heights.astype(np.float64)).astype(np.float32)
    expected = expected_of(ground, CELL_M / density)
    found = vectors(dataset, report)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, atol=within)
    layer = report.build.manifest.layer("normal")
    assert (layer.kind, layer.registration, layer.filter.edge) == ("normal", "point", "mirror-sample")
    assert layer.normals is not None
    assert layer.normals.voids == np.isnan(heights).sum()
    assert verify(open_dataset(dataset)).findings == []


@pytest.mark.parametrize(("codec", "channels"), [("png", 3), ("raw", 2), ("exr:half", 2)])
def test_a_slope_is_the_same_code_on_every_level_and_level_ground_is_exactly_zero(codec: str, channels: int, tmp_path: Path) -> None:
    for slope in ((0.0, 0.0), (0.5, -0.25)):
        folder = tmp_path / str(slope)
        folder.mkdir()
        dataset = store_heights(folder, ramp(*slope, side=70))
        report = normals(dataset, codec=codec)
        layer = report.build.manifest.layer("normal")
        assert layer.channels == channels
        scale = math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
        for level in range(len(layer.levels)):
            found = vectors(dataset, report, level)
            assert len(np.unique(found.reshape(-1, 2), axis=0)) == 1, "the same sample everywhere"
            np.testing.assert_allclose(found[0, 0], (-slope[0] / scale, -slope[1] / scale), atol=0.51 / 127)
            assert slope != (0.0, 0.0) or (found == 0).all()


def test_the_cosine_with_the_sun_is_the_light_on_the_same_sample(tmp_path: Path) -> None:
    for density in (1, 2):
        dataset = tmp_path / "dataset" if density == 2 else store_heights(tmp_path, with_voids())
        found = vectors(dataset, normals(dataset, codec="exr:float", density=density, overwrite=True))
        east, north, up = toward(310, 25)
        upright = np.sqrt(1 - (found**2).sum(axis=-1))
        light = np.maximum(found[..., 0] * east + found[..., 1] * north + upright * up, 0)
        np.testing.assert_allclose(light, lit(dataset, 310, 25, shadows="none", density=density), atol=3e-6)


@pytest.mark.parametrize("voids", [False, True])
def test_coarser_levels_are_means_of_x_and_y(voids: bool, tmp_path: Path) -> None:
    """Against the float64 reference: no level is made unit length again, and none comes from rounded samples."""
    heights = with_voids() if voids else rough(120)
    dataset = store_heights(tmp_path, heights)
    exact, rounded = normals(dataset, codec="exr:float", layer="exact"), normals(dataset, codec="png", layer="rounded")
    expected = expected_of(heights)
    cover = None if not voids else (~np.isnan(heights)).astype(np.float64)
    for level in range(1, len(exact.build.manifest.layer("exact").levels)):
        expected, cover = coarsen(
            np.nan_to_num(expected), cover, kernel="blackman-sinc", radius=3, registration="point", edge="mirror-sample"
        )
        valid = np.ones(expected.shape[:2], np.bool_) if cover is None else cover > 0
        np.testing.assert_allclose(vectors(dataset, exact, level)[valid], expected[valid], atol=1e-6)
        seen = valid if cover is None else np.rint(cover * 255) > 0
        np.testing.assert_allclose(vectors(dataset, rounded, level)[seen], expected[seen], atol=0.501 / 127)


def test_png_is_red_green_and_a_mask_in_blue(tmp_path: Path) -> None:
    """Not grey and alpha, by which programs multiply: x would be lost where y is small."""
    heights = with_voids()
    dataset = store_heights(tmp_path, heights)
    report = normals(dataset)
    layer = report.build.manifest.layer("normal")
    assert (layer.channels, layer.alpha, layer.dtype) == (3, True, "uint8")
    blue = assemble(open_dataset(dataset), "normal", 0)[0][:120, :120, 2]
    np.testing.assert_array_equal(blue == 255, ~np.isnan(heights))
    assert layer.levels[0].blank == 1


@pytest.mark.parametrize("density", [1, 2])
def test_a_turned_terrain_has_the_turned_normals(density: int, tmp_path: Path) -> None:
    """Bit for bit. Turned left once, what looked to the right looks up."""
    heights = with_voids(97)
    found = []
    for quarters in range(4):
        (tmp_path / str(quarters)).mkdir()
        dataset = store_heights(tmp_path / str(quarters), np.rot90(heights, quarters))
        level = np.rot90(vectors(dataset, normals(dataset, codec="exr:float", density=density)), -quarters)
        x, y = level[..., 0], level[..., 1]
        found.append([(x, y), (y, -x), (-x, -y), (-y, x)][quarters])
    for x, y in found[1:]:
        np.testing.assert_array_equal(x, found[0][0])
        np.testing.assert_array_equal(y, found[0][1])


def test_nothing_depends_on_workers_or_tasks(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, with_voids(200))
    trees = []
    for task, workers in ((64, 1), (64, 2), (128, 3), (1024, 1)):
        report = normals(dataset, task=task, workers=workers, overwrite=True, density=2)
        trees.append(tree_digest(dataset / report.build.manifest.layer("normal").path))
    assert len(set(trees)) == 1


def test_an_update_writes_the_changed_blocks_only(tmp_path: Path) -> None:
    heights = rough(256)
    dataset = store_heights(tmp_path, heights)
    first = normals(dataset, task=64)
    assert normals(dataset, task=64).build.outcome == "up to date"
    heights[100, 130] += 300
    store_heights(tmp_path, heights, update=True)
    with pytest.raises(UsageError, match=r"the source has changed since.*add --update"):
        normals(dataset, task=64)
    second = normals(dataset, task=64, update=True)
    assert second.build.outcome == "updated"
    assert 4 <= second.build.blocks_written < first.build.blocks_written / 4
    (tmp_path / "fresh").mkdir()
    fresh = store_heights(tmp_path / "fresh", heights)
    again = normals(fresh, task=64)
    for level in range(4):
        assert vectors(dataset, second, level).tobytes() == vectors(fresh, again, level).tobytes()


_KILLED = """
import sys
from schemas.settings import NormalSettings
from tiler.building.normals import build_normals
build_normals(sys.argv[1], NormalSettings(task=64, workers=1, density=2))
"""


def test_a_killed_build_goes_on_and_a_damaged_block_is_made_again(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough(300))
    process = subprocess.Popen([sys.executable, "-c", _KILLED, str(dataset)], cwd=Path(__file__).parents[2])
    records = dataset / "normal/tasks/0"
    give_up = time.monotonic() + 60
    while len(list(records.rglob("*.json"))) < 5 and time.monotonic() < give_up and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it was done before it was killed: make the terrain larger"
    assert "normal" not in open_dataset(dataset).manifest.layers
    assert normals(dataset, task=64, density=2).build.tasks_kept >= 4
    (tmp_path / "fresh").mkdir()
    fresh = store_heights(tmp_path / "fresh", rough(300))
    normals(fresh, task=64, density=2)
    assert tree_digest(dataset / "normal") == tree_digest(fresh / "normal")
    before = tree_digest(dataset)
    sorted((dataset / "normal/0").glob("*.png"))[3].write_bytes(b"damaged")
    os.unlink(sorted((dataset / "normal/1").glob("*.png"))[0])
    report = verify_and_repair(open_dataset(dataset), None, Checks())
    assert (len(report.repaired), report.findings, report.notes) == (2, [], [])
    assert tree_digest(dataset) == before


def test_what_has_no_normals_is_said(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough(40))
    with pytest.raises(NotFoundError, match="no dataset there; build one with heights first"):
        normals(tmp_path / "nothing")
    with pytest.raises(NotFoundError, match="no layer 'dem' in the dataset"):
        normals(dataset, height="dem")
    with pytest.raises(UsageError, match="--layer height: is there and holds no normals"):
        normals(dataset, layer="height")
    for codec in ("jpeg", "webp:90", "lerc"):
        with pytest.raises(UsageError, match=f"--codec {codec}: normals are stored as png, raw, exr"):
            normals(dataset, codec=codec)
    normals(dataset)
    with pytest.raises(UsageError, match="is of kind normal; normals are those of heights"):
        normals(dataset, height="normal", layer="more")
    with pytest.raises(UsageError, match="built with other settings"):
        normals(dataset, density=2)
