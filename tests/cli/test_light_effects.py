"""``clipmap light`` with planned effects: what it leaves out and says of it, what a scene asks for, and ``--plan``."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Clipmap
from tests.cli.reports import parsed
from tests.integration.files import tree_digest, write_tiff
from tests.reference.terrain import power_law_field
from tiler.stores.dataset import open_dataset

ASKED = ("--soft", "--sky", 4, "--bounce")
SCENE = "[sun]\nazimuth_deg = 200\nelevation_deg = 40\n"


def dataset(clipmap: Clipmap, folder: Path, relief_m: float, side: int = 120) -> Path:
    heights = np.asarray(relief_m / 6 * power_law_field(side, side, 4, 4.0), np.float32)
    folder.mkdir()
    write_tiff(folder / "dem.tif", (heights - heights.min())[..., np.newaxis])
    ran = clipmap("build", folder / "dem.tif", "--block", 64, "--codec", "raw", "-o", folder / "dataset")
    assert ran.code == 0, ran.err
    return folder / "dataset"


@pytest.fixture
def plain(clipmap: Clipmap, tmp_path: Path) -> Path:
    return dataset(clipmap, tmp_path / "plain", 3.0)


@pytest.fixture
def mountains(clipmap: Clipmap, tmp_path: Path) -> Path:
    return dataset(clipmap, tmp_path / "mountains", 900.0)


def scene(folder: Path, text: str = SCENE) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_left_out_is_said(clipmap: Clipmap, plain: Path) -> None:
    ran = clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--tolerance", 0.5)
    assert (ran.code, ran.err) == (0, "")
    assert "effects   no shadows, open sky, curvature" in ran.out or "effects   no shadows, open sky\n" in ran.out
    assert "left out  shadow: proved to change at most 0 codes\n" in ran.out, "what it saves is not worth a word"
    for name in ("penumbra", "sky", "bounce"):
        assert f"\n          {name}: proved to change at most " in ran.out
    assert " codes; saves about " in ran.out, "the sky's horizons take milliseconds"
    assert "stages    plan " in ran.out
    assert clipmap("verify", plain).code == 0
    assert "up to date" in clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--tolerance", 0.5).out


def test_what_is_called_for_is_simulated(clipmap: Clipmap, mountains: Path) -> None:
    ran = clipmap("light", mountains, "--sun", "200,15", *ASKED, "--effects", "auto")
    assert ran.code == 0
    assert "soft shadows, sky (4 azimuths), bounce, curvature" in ran.out
    assert "left out  nothing: none of the effects is proved to be too small to be seen" in ran.out
    assert "up to date" in clipmap("light", mountains, "--sun", "200,15", *ASKED).out, "it is the layer without a plan"


def test_a_layer_with_more_than_is_called_for_is_kept(clipmap: Clipmap, plain: Path) -> None:
    assert clipmap("light", plain, "--sun", "200,40", *ASKED).code == 0
    before = tree_digest(plain)
    ran = clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto")
    assert ran.code == 0
    assert "up to date" in ran.out
    assert "left out  more could be: the layer that is there has effects that are not called for; --overwrite builds it" in ran.out
    assert tree_digest(plain) == before
    assert "no shadows, open sky" in clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--overwrite").out


def test_json(clipmap: Clipmap, plain: Path) -> None:
    ran = clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--json")
    (report,) = json.loads(ran.out)["layers"]
    names = {one["effect"] for one in report["light"]["left_out"]}
    assert {"shadow", "penumbra", "sky", "bounce"} <= names
    assert set(report["effects"]["saved_s"]) == names
    assert report["effects"]["saved_s"]["sky"] > 0
    verdicts = {one["effect"]: one["verdict"] for one in report["effects"]["plan"]["effects"]}
    assert verdicts["sky"] == "skip proven"
    manifest = json.loads((plain / "manifest.json").read_bytes())
    assert manifest["layers"]["light"]["light"]["left_out"] == report["light"]["left_out"]
    without = clipmap("light", plain, "--sun", "200,40", *ASKED, "--json", "--layer", "all")
    (report,) = json.loads(without.out)["layers"]
    assert "effects" not in report
    assert "left_out" not in report["light"]


def test_a_scene_instead_of_options(clipmap: Clipmap, plain: Path, tmp_path: Path) -> None:
    given = scene(tmp_path, SCENE + "[sky]\nazimuths = 8\nshare = 0.3\n[tolerance]\ncodes = 0.25\n")
    ran = clipmap("light", plain, "--scene", given)
    assert (ran.code, ran.err) == (0, "")
    light = open_dataset(plain).manifest.layer("light").light
    assert light is not None
    assert (light.azimuth_deg, light.sky_share, light.shadows) == (200, 0.3, "none")
    assert light.elevation_deg == pytest.approx(40, abs=0.03), "the air lifts it by a minute of arc"
    ran = clipmap("light", plain, "--scene", given, "--effects", "all", "--layer", "everything")
    assert ran.code == 0
    light = open_dataset(plain).manifest.layer("everything").light
    assert light is not None
    assert (light.shadows, light.sky_azimuths, light.albedo, light.refraction, light.left_out) == ("soft", 8, 0.3, 0.13, [])


def test_a_scene_with_a_time_for_heights_that_lie_nowhere(clipmap: Clipmap, tmp_path: Path) -> None:
    heights = np.zeros((40, 40, 1), np.float32)
    heights[3, 3] = 9
    from tests.integration.lighting import plain_tiff

    plain_tiff(tmp_path / "dem.tif", heights[..., 0])
    assert clipmap("build", tmp_path / "dem.tif", "--layer", "height", "--spacing", 10, "-o", tmp_path / "out").code == 0
    ran = clipmap("light", tmp_path / "out", "--scene", scene(tmp_path, '[sun]\nwhen = "2026-06-21T05:00:00Z"\n'))
    assert ran.code == 2
    assert "nothing says where on the Earth it lies" in ran.err
    assert ran.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--sun", "1,1"), "--sun: the scene says that; leave it out, or change the scene"),
        (("--when", "2026-06-21T05:00:00Z"), "--when: the scene says that"),
        (("--sky", 16), "--sky: the scene says that"),
        (("--hard",), "--soft or --hard: the scene says that"),
        (("--no-curvature",), "--curvature or --no-curvature: the scene says that"),
        (("--tolerance", 2), "--tolerance: the scene says that"),
        (("--certified",), "--certified is for the shadows of a point; the scene's sun is a disc"),
    ],
)
def test_a_scene_and_options_do_not_contradict_each_other(
    arguments: tuple[object, ...], sentence: str, clipmap: Clipmap, plain: Path, tmp_path: Path
) -> None:
    ran = clipmap("light", plain, "--scene", scene(tmp_path), *arguments)
    assert (ran.code, ran.out) == (2, "")
    assert sentence in ran.err
    assert ran.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (("--sun", "1,1", "--tolerance", 1), 2, "--tolerance is what --effects auto may leave out; add --effects auto"),
        (("--sun", "1,1", "--effects", "auto", "--tolerance", 0), 2, "--tolerance 0: codes of light are more than 0"),
        (("--sun", "1,1", "--effects", "auto", "--tolerance", "nan"), 2, "--tolerance nan: codes of light"),
        (("--sun", "1,1", "--effects", "auto", "--sky", 2), 2, "--sky 2: --effects auto needs at least 4 azimuths"),
        (("--sun", "1,1", "--effects", "auto", "--codec", "lerc"), 2, "--codec lerc: light is stored as"),
        (("--sun", "1,1", "--effects", "auto", "--from", "dem"), 3, "no layer 'dem'"),
        (("--sun", "1,1", "--effects", "none"), 2, "'none' is not one of 'all', 'auto'"),
        (("--scene", "nothing.toml"), 3, "nothing.toml: no such file"),
        ((), 2, "give a sun: --sun AZ,EL or --when TIME, or --scene SCENE"),
    ],
)
def test_mistakes_are_one_sentence(arguments: tuple[object, ...], code: int, sentence: str, clipmap: Clipmap, plain: Path) -> None:
    before = tree_digest(plain)
    for more in ((), ("--plan",)):
        ran = clipmap("light", plain, *arguments, *more)
        assert (ran.code, ran.out) == (code, "")
        assert sentence in ran.err
        assert ran.err.count("\n") == 1
    assert tree_digest(plain) == before


# --plan


def test_a_plan_says_what_a_build_would_take_and_writes_nothing(clipmap: Clipmap, plain: Path, tmp_path: Path) -> None:
    before = tree_digest(tmp_path)
    ran = clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--plan")
    assert (ran.code, ran.err) == (0, "")
    assert "skip proven" in ran.out
    assert "haze" not in ran.out, "no matter of a bake"
    assert "refraction" not in ran.out, "not asked for"
    for name in ("standing  begin", "blocks ", "memory ", "time ", "left out  shadow: proved"):
        assert name in ran.out
    assert tree_digest(tmp_path) == before
    assert clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto").code == 0
    again = clipmap("light", plain, "--sun", "200,40", *ASKED, "--effects", "auto", "--plan")
    assert "standing  up to date: nothing to do" in again.out


@pytest.mark.parametrize("more", [(), ("--twice",), ("--codec", "exr:half", "--certified", "--block", 32)])
def test_what_a_plan_says_is_what_is_built(more: tuple[object, ...], clipmap: Clipmap, mountains: Path) -> None:
    """Blocks, tasks and levels to the number, bytes as near as windows tell, which here are the whole."""
    arguments = ("light", mountains, "--sun", "200,15", "--sky", 4, *more)
    (planned,) = json.loads(clipmap(*arguments, "--plan", "--json").out)["layers"]
    build = planned["build"]
    report = json.loads(clipmap(*arguments, "--json").out)["layers"][0]
    layer = open_dataset(mountains).manifest.layer("light")
    assert [(level["width"], level["height"], level["stored"]) for level in build["levels"]] == [
        (level.width, level.height, level.stored) for level in layer.levels
    ]
    assert build["standing"]["tasks"] == report["tasks"]
    assert build["space"]["stored_bytes"] == pytest.approx(report["stored_bytes"], rel=0.05)
    assert build["codec"] == report["codec"]
    assert build["time_s"] > 0
    assert build["memory_bytes"] > 1e8


def test_a_large_map_is_planned_by_windows(clipmap: Clipmap, tmp_path: Path) -> None:
    large = dataset(clipmap, tmp_path / "large", 4000.0, side=1500)
    arguments = ("light", large, "--sun", "200,10")
    (planned,) = json.loads(clipmap(*arguments, "--plan", "--json").out)["layers"]
    space = planned["build"]["space"]
    assert "effects" not in planned
    report = json.loads(clipmap(*arguments, "--json").out)["layers"][0]
    assert space["stored_bytes"] == pytest.approx(report["stored_bytes"], rel=0.25)


def test_several_suns_are_planned_one_by_one(clipmap: Clipmap, plain: Path) -> None:
    suns = ("--sun", "200,40", "--sun", "100,20", "--layer", "day")
    ran = clipmap("light", plain, *suns, "--effects", "auto", "--plan", "--json")
    first, second = json.loads(ran.out)["layers"]
    assert (first["build"]["layer"], second["build"]["layer"]) == ("day_1", "day_2")
    assert first["effects"]["plan"]["elevation_deg"] == 40
    text = clipmap("light", plain, *suns, "--effects", "auto", "--plan").out
    assert text.count("standing  begin") == 2


def test_the_plan_is_that_of_clipmap_plan(clipmap: Clipmap, plain: Path, tmp_path: Path) -> None:
    given = scene(tmp_path)
    other = parsed(clipmap("plan", given, plain, "--json").out, "EffectPlan")
    (planned,) = json.loads(clipmap("light", plain, "--scene", given, "--plan", "--json").out)["layers"]
    assert planned["effects"]["plan"] == other
