"""``clipmap normals`` and ``clipmap light --twice`` as a user runs them, on a real elevation model where there is one."""

import json
import os
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import rasterio

from tests.cli.conftest import Clipmap
from tests.integration.files import assemble, write_tiff
from tests.reference.terrain import power_law_field
from tiler.stores.dataset import open_dataset

DATA = os.environ.get("CLIPMAP_TEST_DATA")


@pytest.fixture
def dataset(clipmap: Clipmap, tmp_path: Path) -> Path:
    heights = np.asarray(300 * power_law_field(120, 120, 4, 4.0), np.float32)
    heights[10:20, 30:40] = np.nan
    write_tiff(tmp_path / "dem.tif", heights[..., np.newaxis])
    assert clipmap("build", tmp_path / "dem.tif", "--block", 64, "-o", tmp_path / "dataset").code == 0
    return tmp_path / "dataset"


def test_heights_become_a_layer_of_normals(clipmap: Clipmap, dataset: Path) -> None:
    ran = clipmap("normals", dataset)
    assert (ran.code, ran.err) == (0, "")
    assert "(sample - 127) / 127 is x, to the right, and y, upward on the grid" in ran.out
    assert "100 samples of the heights: no normals there" in ran.out
    assert clipmap("verify", dataset).code == 0
    assert "normal (normal), 120 x 120 samples, point-registered" in clipmap("inspect", dataset, "normal").out
    assert "up to date" in clipmap("normals", dataset).out
    picture = dataset.parent / "block.png"
    assert clipmap("inspect", dataset, "normal/0/0/0", "--png", picture).code == 0
    grey = imagecodecs.imread(picture).astype(np.float64)
    stored, _ = assemble(open_dataset(dataset), "normal", 0)
    x, y = np.moveaxis((stored[:64, :64, :2].astype(np.float64) - 127) / 127, -1, 0)
    # A sun in the upper left, 45 degrees high, as of maps.
    facing = np.clip(np.sqrt(0.5) * np.sqrt(1 - np.minimum(x**2 + y**2, 1)) + 0.5 * (y - x), 0, 1)
    ground = stored[:64, :64, 2] > 0
    np.testing.assert_array_equal(grey[..., 1] > 0, ground)
    np.testing.assert_allclose(grey[ground, 0], 255 * facing[ground], atol=0.51)


def test_the_report_says_what_the_manifest_says(clipmap: Clipmap, dataset: Path) -> None:
    ran = clipmap("normals", dataset, "--twice", "--codec", "exr:half", "--layer", "fine", "--json")
    assert (ran.code, ran.err) == (0, "")
    report = json.loads(ran.out)
    layer = json.loads((dataset / "manifest.json").read_bytes())["layers"]["fine"]
    assert report["normals"] == layer["normals"]
    assert (layer["width"], layer["normals"]["density"], layer["normals"]["one"]) == (239, 2, 1)
    assert set(report["stages_s"]) == {"heights", "blocks"}
    assert json.loads(clipmap("inspect", dataset, "fine", "--json").out)["normals"] == layer["normals"]


def test_normals_in_other_forms(clipmap: Clipmap, dataset: Path) -> None:
    """A GeoTIFF keeps codes and mask, an OpenEXR file has x and y themselves; a Deep Zoom image would be no picture."""
    assert clipmap("normals", dataset).code == 0
    folder = dataset.parent
    for form in ("cog", "exr", "pmtiles"):
        assert clipmap("export", dataset, form, "--layer", "normal", "-o", folder / "out").code == 0
    stored, _ = assemble(open_dataset(dataset), "normal", 0)
    with rasterio.open(folder / "out.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1), stored[:120, :120])
        assert [each.name for each in file.colorinterp] == ["gray", "undefined", "alpha"]
    ground = stored[:120, :120, 2] > 0
    with OpenEXR.File(str(folder / "out.exr")) as picture:
        channels = {name: channel.pixels for name, channel in picture.channels().items()}
    assert set(channels) == {"N.X", "N.Y", "A"}
    np.testing.assert_array_equal(channels["A"] > 0, ground)
    for place, name in enumerate(("N.X", "N.Y")):
        expected = np.where(ground, (stored[:120, :120, place].astype(np.float64) - 127) / 127, 0)
        np.testing.assert_allclose(channels[name], expected, atol=5e-4)
    ran = clipmap("export", dataset, "dzi", "--layer", "normal", "-o", folder / "out")
    assert (ran.code, ran.err.count("\n")) == (2, 1)
    assert "normals are no pictures" in ran.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--codec", "webp"), "normals are stored as png, raw, exr"),
        (("--codec", "exr:double"), "use exr:half or exr:float"),
        (("--layer", "height"), "is there and holds no normals; choose another name"),
        (("--layer", "Normal!"), "use lower-case letters"),
        (("--task", "1"), "--task: Input should be greater than or equal to 2"),
        (("--bits", "12"), "Invalid value for '--bits'"),
    ],
)
def test_mistakes_are_one_sentence(clipmap: Clipmap, dataset: Path, arguments: tuple[str, ...], sentence: str) -> None:
    ran = clipmap("normals", dataset, *arguments)
    assert ran.code == 2
    assert sentence in ran.err
    assert sorted(path.name for path in dataset.iterdir()) == ["height", "manifest.json"]


def test_light_at_twice_the_resolution(clipmap: Clipmap, dataset: Path) -> None:
    ran = clipmap("light", dataset, "--sun", "270,10", "--twice", "--codec", "webp:90")
    assert (ran.code, ran.err) == (0, "")
    assert "samples  239 x 239" in ran.out
    assert clipmap("verify", dataset).code == 0
    for form in ("dzi", "cog"):
        assert clipmap("export", dataset, form, "--layer", "light", "-o", dataset.parent / "light").code == 0
    stored, _ = assemble(open_dataset(dataset), "light", 0)
    with rasterio.open(dataset.parent / "light.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1), stored[:239, :239])


@pytest.mark.skipif(DATA is None, reason="CLIPMAP_TEST_DATA is not set")
def test_normals_of_mount_everest_are_those_of_the_ground(clipmap: Clipmap, tmp_path: Path) -> None:
    """In geographic coordinates: a degree of longitude is 88 % of one of latitude here, which differences of codes must show."""
    assert clipmap("build", Path(DATA or "") / "dem/mt_everest_90m.tif", "-o", tmp_path / "everest", "--codec", "lerc:0").code == 0
    assert clipmap("normals", tmp_path / "everest", "--codec", "exr:float").code == 0
    found = open_dataset(tmp_path / "everest")
    heights, ground = (each[:1201, :1201] for each in assemble(found, "height", 0))
    normals, there = (each[:1201, :1201] for each in assemble(found, "normal", 0))
    np.testing.assert_array_equal(there, ground)
    z = np.where(ground, heights[..., 0].astype(np.float64), np.nan)
    # WGS 84: metres per degree at latitude 27.5, from its semi-axes.
    latitude, e2 = np.radians(27.5), 0.00669437999014
    curve = np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    east_m = np.radians(6378137 * np.cos(latitude) / curve) / 1200
    north_m = np.radians(6378137 * (1 - e2) / curve**3) / 1200
    up, right = np.gradient(z, -north_m, east_m)
    expected = -np.stack([right, up], axis=-1) / np.sqrt(1 + right**2 + up**2)[..., np.newaxis]
    rows = np.s_[595:606, 1:-1]
    whole = ~np.isnan(expected[rows]).any(axis=-1) & ground[rows]
    assert whole.mean() > 0.5
    np.testing.assert_allclose(normals[rows][whole], expected[rows][whole], atol=2e-5)
