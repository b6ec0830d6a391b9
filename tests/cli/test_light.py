"""``clipmap light`` as a user runs it, on a real elevation model where there is one."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Clipmap
from tests.integration.files import assemble, write_tiff
from tests.reference.terrain import power_law_field
from tiler.stores.dataset import open_dataset

DATA = os.environ.get("CLIPMAP_TEST_DATA")


@pytest.fixture
def dataset(clipmap: Clipmap, tmp_path: Path) -> Path:
    heights = np.asarray(300 * power_law_field(120, 120, 4, 4.0), np.float32)
    write_tiff(tmp_path / "dem.tif", (heights - heights.min())[..., np.newaxis])
    assert clipmap("build", tmp_path / "dem.tif", "--block", 64, "-o", tmp_path / "dataset").code == 0
    return tmp_path / "dataset"


def test_a_sun_becomes_a_layer(clipmap: Clipmap, dataset: Path) -> None:
    ran = clipmap("light", dataset, "--sun", "270,10")
    assert (ran.code, ran.err) == (0, "")
    assert "azimuth 270.00, elevation 10.00 degrees" in ran.out
    assert "hard shadows (1 per sample), curvature" in ran.out
    assert "heights" in ran.out
    assert clipmap("verify", dataset).code == 0
    shown = clipmap("inspect", dataset, "light")
    assert "light (light), 120 x 120 samples, point-registered" in shown.out
    assert "up to date" in clipmap("light", dataset, "--sun", "270,10").out


def test_several_suns_become_several_layers(clipmap: Clipmap, dataset: Path) -> None:
    ran = clipmap(
        "light", dataset, "--sun", "90,20", "--when", "2026-06-21T12:00:00+02:00", "--layer", "day", "--json", "--soft", "--sky", 4
    )
    assert (ran.code, ran.err) == (0, "")
    report = json.loads(ran.out)
    assert [entry["layer"] for entry in report["layers"]] == ["day_1", "day_2"]
    first, second = (entry["light"] for entry in report["layers"])
    assert (first["azimuth_deg"], first["elevation_deg"], first["when"]) == (90, 20, None)
    assert second["when"] == "2026-06-21T12:00:00+02:00"
    assert 60 < second["elevation_deg"] < 69
    assert set(report["layers"][0]["stages_s"]) == {"heights", "sun", "sky", "blocks"}
    manifest = json.loads((dataset / "manifest.json").read_bytes())
    assert manifest["version"] == report["version"]
    assert manifest["layers"]["day_2"]["light"] == second
    assert "light" not in manifest["layers"]["height"], "or datasets from before would have another version"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "give a sun: --sun AZ,EL or --when TIME"),
        (("--sun", "270"), "azimuth and elevation in degrees, separated by a comma"),
        (("--sun", "270,91"), "--sun: Input should be less than or equal to 90"),
        (("--sun", "nan,10"), "--sun: Input should be a finite number"),
        (("--when", "noon"), "a time as of ISO 8601 with its offset"),
        (("--when", "2026-06-21T12:00:00"), "add the offset from UTC"),
        (("--sun", "1,1", "--soft", "--certified"), "are three kinds of shadows; give one"),
        (("--sun", "1,1", "--lines", "0"), "--lines: Input should be greater than or equal to 1"),
        (("--sun", "1,1", "--codec", "rgb565"), "light is stored as png, jpeg, webp, raw, exr"),
        (("--sun", "1,1", "--layer", "height"), "is there and no light; choose another name"),
        (("--sun", "1,1", "--layer", "Light!"), "use lower-case letters"),
    ],
)
def test_mistakes_are_one_sentence(clipmap: Clipmap, dataset: Path, arguments: tuple[str, ...], sentence: str) -> None:
    ran = clipmap("light", dataset, *arguments)
    assert ran.code == 2
    assert sentence in ran.err
    assert ran.err.count("\n") == 1
    assert sorted(path.name for path in dataset.iterdir()) == ["height", "manifest.json"]


def test_where_there_is_no_dataset(clipmap: Clipmap, tmp_path: Path) -> None:
    ran = clipmap("light", tmp_path / "nothing", "--sun", "1,1")
    assert ran.code == 3
    assert "no dataset there" in ran.err
    assert not (tmp_path / "nothing").exists()


@pytest.mark.skipif(DATA is None, reason="CLIPMAP_TEST_DATA is not set")
def test_morning_on_mount_everest(clipmap: Clipmap, tmp_path: Path) -> None:
    """Ground that looks to the rising sun is brighter than ground that looks away, and void ground stays void."""
    assert clipmap("build", Path(DATA or "") / "dem/mt_everest_90m.tif", "-o", tmp_path / "everest").code == 0
    ran = clipmap("light", tmp_path / "everest", "--when", "2026-06-21T01:00:00Z", "--soft", "--sky", 4)
    assert ran.code == 0
    assert "no light on them, and no shadow of them" in ran.out
    found = open_dataset(tmp_path / "everest")
    lit = assemble(found, "light", 0)[0]
    heights, ground = assemble(found, "height", 0)
    seen = lit[:1201, :1201, 1] > 0
    np.testing.assert_array_equal(seen, ground[:1201, :1201])
    rise = np.gradient(heights[:1201, :1201, 0].astype(np.float64), axis=1)
    codes = lit[:1201, :1201, 0].astype(np.float64)
    assert codes[seen & (rise < -60)].mean() > 1.5 * codes[seen & (rise > 60)].mean()
    assert clipmap("verify", tmp_path / "everest").code == 0
