"""``clipmap plan``: verdicts on a dataset, put to the proof, and what it says of mistakes."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.scene import Scene, parse_scene
from schemas.settings import BuildSettings
from tests.cli.conftest import Clipmap
from tests.cli.reports import parsed
from tests.contract.picture_files import write_with_rasterio
from tiler.building.build import build_layer
from tiler.terrain import make_island

SUN = "[sun]\nazimuth_deg = 250\nelevation_deg = 30\n"


@pytest.fixture(scope="module")
def island(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small island in UTM; not to be changed."""
    return dataset(tmp_path_factory.mktemp("island"), make_island(128).heights_m, 20.0)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hills of 5 m on 3 km; not to be changed."""
    i, j = np.mgrid[0:100, 0:120] / 100
    return dataset(tmp_path_factory.mktemp("plain"), (2.5 * np.sin(7 * i) * np.cos(5 * j)).astype(np.float32), 30.0)


def dataset(folder: Path, heights_m: NDArray[np.float32], spacing_m: float) -> Path:
    place = Affine(spacing_m, 0, 400000, 0, -spacing_m, 5200000)
    write_with_rasterio(folder / "dem.tif", heights_m[..., np.newaxis], crs="EPSG:32632", transform=place)
    build_layer(folder / "dem.tif", folder / "out", BuildSettings(layer="height", block=64, codec="raw", workers=1))
    return folder / "out"


def scene(folder: Path, text: str = SUN, name: str = "scene.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_text(plain: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("plan", scene(tmp_path), plain)
    assert (ran.code, ran.err) == (0, "")
    head, verdicts, measured, sentences = ran.out.split("\n\n")
    assert head.splitlines() == ["map  120 x 100 samples", "sun  azimuth 250.00, elevation 30.00 degrees"]
    assert verdicts.splitlines()[0].split() == ["effect", "verdict", "at", "most", "allowed", "estimate", "saves"]
    assert verdicts.splitlines()[1].startswith("shadow            skip proven ")
    assert measured.splitlines()[1].startswith("shadow            slope toward the sun <= ")
    assert measured.splitlines()[1].endswith("  #cast-shadow")
    assert sentences.startswith("Left out of the bake by proof: at most ")
    assert max(map(len, [*verdicts.splitlines(), *measured.splitlines()])) <= 110, "a terminal's width"


def test_a_plain_calls_for_nothing(plain: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("plan", scene(tmp_path), plain, "--prove", "--json")
    assert (ran.code, ran.err) == (0, "")
    proof = parsed(ran.out, "EffectProof")
    assert {one["verdict"] for one in proof["effects"]} == {"skip proven"}
    assert proof["holds"]
    assert proof["difference_codes"] <= proof["allowed_codes"]
    assert (proof["width"], proof["height"]) == (120, 100)


def test_an_island_calls_for_shadows(island: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("plan", scene(tmp_path), island, "--json")
    assert (ran.code, ran.err) == (0, "")
    plan = parsed(ran.out, "EffectPlan")
    verdicts = {one["effect"]: one["verdict"] for one in plan["effects"]}
    assert verdicts["shadow"] == verdicts["penumbra"] == verdicts["sky"] == "run"
    assert verdicts["curvature_sky"] == "skip proven"
    assert (plan["azimuth_deg"], plan["elevation_deg"], plan["width"], plan["height"]) == (250, 30, 129, 129)


def test_the_proof_in_words(island: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("plan", scene(tmp_path), island, "--prove", "--crop", "64")
    assert (ran.code, ran.err) == (0, "")
    assert "Baked with and without every effect: 64 x 64 samples from column " in ran.out
    assert ran.out.endswith("Every bound holds, and the picture is within the tolerance.\n")
    assert "BROKEN" not in ran.out


def test_a_tower_is_no_estimates_business(tmp_path: Path, clipmap: Clipmap) -> None:
    """One sample, which the coarse level does not have: its shadow stays, and so does the sky it hides."""
    heights = np.zeros((500, 500), np.float32)
    heights[251, 250] = 40.0
    ran = clipmap("plan", scene(tmp_path), dataset(tmp_path, heights, 10.0), "--prove", "--crop", "80", "--estimate")
    assert ran.code == 0
    assert "skip estimated" not in ran.out


def test_what_an_estimate_hides_is_found(tmp_path: Path, clipmap: Clipmap) -> None:
    """Pits where no sample of the coarse level is, and a scarp as steep as they are, so that nothing tells of them."""
    heights = np.zeros((500, 500), np.float32)
    heights[1::3, 1::3] = -3.0
    heights[:, 400:] = -5.0 * np.arange(100, dtype=np.float32)
    given, pitted = scene(tmp_path, SUN.replace("30", "60")), dataset(tmp_path, heights, 10.0)
    ran = clipmap("plan", given, pitted, "--prove", "--crop", "120", "--estimate")
    assert ran.code == 1
    assert "skip estimated" in ran.out
    assert "Every bound holds, but what was left out by an estimate is seen; --no-estimate simulates it." in ran.out
    ran = clipmap("plan", given, pitted, "--prove", "--crop", "120")
    assert ran.code == 0
    assert "skip estimated" not in ran.out


def test_the_scene_decides_about_estimates(island: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    allowed = scene(tmp_path, SUN + "[tolerance]\nestimates = true\n")
    estimates = []
    for arguments in ([], ["--estimate"], ["--no-estimate"]):
        plan = json.loads(clipmap("plan", allowed, island, "--json", *arguments).out)
        estimates.append([one["effect"] for one in plan["effects"] if one["estimate"] is not None])
    assert estimates == [["sky", "bounce"], ["sky", "bounce"], []]


def test_a_time_instead_of_angles(island: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    given = scene(tmp_path, '{"sun": {"when": "2026-06-21T12:00:00+02:00"}}', "scene.json")
    plan = json.loads(clipmap("plan", given, island, "--json").out)
    # 47 degrees north, 8 degrees east, an hour and a half before noon.
    assert 115 < plan["azimuth_deg"] < 150
    assert 50 < plan["elevation_deg"] < 65


def test_the_example_is_a_scene(tmp_path: Path, plain: Path, clipmap: Clipmap) -> None:
    """As it is, it has all defaults; with every comment taken away it says the same."""
    ran = clipmap("plan", "--example")
    assert (ran.code, ran.err) == (0, "")
    found = parse_scene(ran.out, "scene.toml")
    assert found == Scene.model_validate({"sun": {"azimuth_deg": 270, "elevation_deg": 10}})
    lines = [line for line in ran.out.splitlines() if not line.startswith("# when = ")]
    spoken = "\n".join(line.removeprefix("# ") if " = " in line else line for line in lines)
    assert parse_scene(spoken, "scene.toml") == found
    said = tomllib.loads(spoken)
    assert {name: set(settings) for name, settings in said.items()} == {
        name: set(type(getattr(found, name)).model_fields) - {"when"} for name in Scene.model_fields
    }
    assert clipmap("plan", scene(tmp_path, ran.out), plain).code == 0


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        (None, "none.toml", "no such file"),
        (SUN, "scene.yaml", "a scene is a file that ends in .toml or .json"),
        ("[sun\n", "scene.toml", "is not valid TOML"),
        ("[sun]\nazimuth_deg = 3\n", "scene.toml", "sun: azimuth_deg and elevation_deg, or when, must be given"),
        (SUN + "[sky]\nshare = -1\n", "scene.toml", "sky.share: "),
        (SUN + "[moon]\n", "scene.toml", "moon: "),
        ("\x00" * ((1 << 20) + 1), "scene.toml", "is larger than 1 MiB"),
    ],
    ids=["missing", "suffix", "syntax", "half a sun", "range", "unknown", "huge"],
)
def test_mistakes_in_a_scene(text: str | None, name: str, says: str, plain: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    path = tmp_path / name if text is None else scene(tmp_path, text, name)
    ran = clipmap("plan", path, plain)
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith(f"clipmap: {path}: ")
    assert says in ran.err
    assert ran.err.count("\n") == 1


def test_other_mistakes(plain: Path, survey: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    given = scene(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"# \xff\n")
    mistakes: list[tuple[list[object], int, str]] = [
        ([], 2, "give a scene and a dataset"),
        ([given], 2, "give a scene and a dataset"),
        ([given, tmp_path / "nothing"], 3, "nothing"),
        ([given, plain, "--layer", "light"], 3, "light"),
        ([given, survey, "--layer", "imagery"], 2, "is of kind imagery"),
        ([given, plain, "--crop", "0"], 2, "--crop"),
        ([given, plain, "--crop", "64"], 2, "--crop says how much --prove bakes; give --prove as well"),
        (["--example", "--crop", "64"], 2, "--crop says how much"),
        ([tmp_path, plain], 4, "cannot be read"),
        ([tmp_path / "latin.toml", plain], 3, "is not UTF-8"),
    ]
    for arguments, code, says in mistakes:
        ran = clipmap("plan", *arguments)
        assert (ran.code, ran.out) == (code, ""), arguments
        assert says in ran.err
        assert ran.err.count("\n") == 1


REAL: dict[str, tuple[dict[str, Any], float]] = {
    "puget/ps_height_1k.png": ({"spacing": 160.0, "height_scale": 0.1, "layer": "height"}, 10.0),
    "dem/mt_everest_90m.tif": ({}, 8.0),
    "dem/slovenia_lidar_nan.tif": ({}, 60.0),
}


@pytest.mark.parametrize("name", REAL)
def test_real_heights(name: str, data_dir: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    """No bound breaks, and nothing but what is proved is left out."""
    settings, elevation = REAL[name]
    build_layer(data_dir / name, tmp_path / "out", BuildSettings(**settings))
    given = scene(tmp_path, f"[sun]\nazimuth_deg = 270\nelevation_deg = {elevation}\n")
    ran = clipmap("plan", given, tmp_path / "out", "--prove", "--crop", "200", "--no-estimate", "--json")
    proof = parsed(ran.out, "EffectProof")
    assert [one for one in proof["effects"] if not one["holds"]] == []
    assert (ran.code, proof["holds"]) == (0, True)
    assert {one["verdict"] for one in proof["effects"]} == {"run", "skip proven"}
