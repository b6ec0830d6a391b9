"""Layers of light whose effects were planned: as bright as with all effects, up to the tolerance, and the same from run to run."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.errors import UsageError
from schemas.scene import Scene
from schemas.settings import BuildSettings, LightSettings
from tests.contract.picture_files import write_with_rasterio
from tests.integration.files import tree_digest
from tests.integration.lighting import lit, rough, samples, store_heights
from tiler.building.build import build_layer
from tiler.building.light import LightReport, build_light
from tiler.building.lightplan import EffectChoice, scene_of
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks
from tiler.stores.dataset import open_dataset

EVERYTHING: dict[str, Any] = {"shadows": "soft", "sky": 8, "bounce": True}


def hills(relief_m: float, side: int = 160) -> NDArray[np.float32]:
    """Hills of so much relief."""
    field = rough(side).astype(np.float64)
    return np.asarray(field * (relief_m / np.ptp(field)), np.float32)


def planned(dataset: Path, azimuth: float, elevation: float, codes: float = 1.0, **options: Any) -> LightReport:
    settings = LightSettings(azimuth_deg=azimuth, elevation_deg=elevation, **{"codec": "exr:float", **options})
    return build_light(dataset, settings, choose=EffectChoice(scene_of(settings, codes)))


def test_a_plain_is_baked_by_its_slopes_alone(tmp_path: Path) -> None:
    """No horizon is looked for and no shadow swept, and no sample differs by more than the bounds of what was left out."""
    dataset = store_heights(tmp_path, hills(5.0))
    report = planned(dataset, 200, 40, layer="planned", **EVERYTHING)
    light = report.light
    assert (light.shadows, light.sky_azimuths, light.sky_share, light.albedo) == ("none", 0, 0.15, 0)
    assert [one.effect for one in light.left_out] == ["shadow", "penumbra", "sky", "bounce", "sun_direction"]
    assert "sky" not in report.stages_s
    everything = lit(dataset, 200, 40, curvature=True, **EVERYTHING)
    different = 255 * np.abs(everything - samples(dataset, report))
    assert different.max() <= sum(one.bound or 0 for one in light.left_out) + 0.02
    manifest = open_dataset(dataset).manifest
    assert manifest.layer("planned").light == light
    assert b"left_out" not in manifest.layer("light").model_dump_json().encode(), "or layers from before would have another version"


@pytest.mark.parametrize("relief", [3.0, 12.0, 40.0, 150.0, 600.0])
@pytest.mark.parametrize(("codes", "elevation"), [(1.0, 35.0), (0.1, 60.0), (5.0, 8.0), (1.0, 0.5)])
def test_what_is_left_out_is_not_seen(relief: float, codes: float, elevation: float, tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(relief, 96))
    everything = lit(dataset, 290, elevation, curvature=True, refraction=True, **EVERYTHING)
    report = planned(dataset, 290, elevation, codes, layer="planned", refraction=True, **EVERYTHING)
    different = 255 * np.abs(everything - samples(dataset, report)).max()
    assert different <= codes
    if not report.light.left_out:
        assert different == 0


def test_mountains_are_baked_with_everything(tmp_path: Path) -> None:
    """Then the layer is that without a plan, bit for bit."""
    dataset = store_heights(tmp_path, rough())
    report = planned(dataset, 200, 15, layer="light", **EVERYTHING)
    assert report.light.left_out == []
    again = build_light(dataset, LightSettings(azimuth_deg=200, elevation_deg=15, codec="exr:float", layer="light", **EVERYTHING))
    assert again.build.outcome == "up to date"


def test_only_what_is_asked_for_is_planned(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0))
    report = planned(dataset, 200, 40)
    assert [one.effect for one in report.light.left_out] == ["shadow"]
    assert (report.light.sky_share, report.light.sky_azimuths) == (0, 0)
    assert planned(dataset, 200, 40, shadows="none", layer="none").light.left_out == []


def test_hard_edges_do_not_move(tmp_path: Path) -> None:
    """Curvature moves the edges of shadows on a small map by less than any sun is known, and still it is not left out."""
    report = planned(store_heights(tmp_path, rough()), 200, 15)
    assert (report.light.shadows, report.light.left_out) == ("hard", [])
    assert report.light.radius_m is not None


def test_the_same_command_again_changes_nothing(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0))
    planned(dataset, 200, 40, **EVERYTHING)
    before = tree_digest(dataset)
    again = planned(dataset, 200, 40, **EVERYTHING)
    assert again.build.outcome == "up to date"
    assert again.light.shadows == "none"
    assert tree_digest(dataset) == before


def test_an_update_that_keeps_the_verdicts_goes_on(tmp_path: Path) -> None:
    heights = hills(5.0, 256)
    dataset = store_heights(tmp_path, heights)
    first = planned(dataset, 200, 40, task=64, **EVERYTHING)
    heights[100, 130] += 1.0
    store_heights(tmp_path, heights, update=True)
    with pytest.raises(UsageError, match=r"the source has changed since.*add --update"):
        planned(dataset, 200, 40, task=64, **EVERYTHING)
    second = planned(dataset, 200, 40, task=64, update=True, **EVERYTHING)
    assert second.build.outcome == "updated"
    assert 0 < second.build.blocks_written < first.build.blocks_written / 3
    assert second.light.left_out != first.light.left_out, "bounds are those of the heights that are there now"
    assert open_dataset(dataset).manifest.layer("light").light == second.light


def test_an_update_that_calls_for_more_says_so(tmp_path: Path) -> None:
    heights = hills(5.0, 128)
    dataset = store_heights(tmp_path, heights)
    planned(dataset, 200, 40, **EVERYTHING)
    heights[60, 60] += 400.0
    store_heights(tmp_path, heights, update=True)
    before = tree_digest(dataset)
    missing = "soft shadows, what hides the sky, reflected light"
    with pytest.raises(UsageError, match=f"layer 'light' was built without {missing}, .* add --overwrite to build it anew"):
        planned(dataset, 200, 40, update=True, **EVERYTHING)
    assert tree_digest(dataset) == before
    report = planned(dataset, 200, 40, overwrite=True, **EVERYTHING)
    assert (report.light.shadows, report.light.sky_azimuths, report.light.left_out) == ("soft", 8, [])


def test_an_update_that_calls_for_less_keeps_what_is_there(tmp_path: Path) -> None:
    heights = hills(5.0, 128)
    heights[60, 60] += 400.0
    dataset = store_heights(tmp_path, heights)
    planned(dataset, 200, 40, **EVERYTHING)
    heights[60, 60] -= 400.0
    store_heights(tmp_path, heights, update=True)
    report = planned(dataset, 200, 40, update=True, **EVERYTHING)
    assert (report.build.outcome, report.light.shadows, report.light.sky_azimuths) == ("updated", "soft", 8)
    assert planned(dataset, 200, 40, overwrite=True, **EVERYTHING).light.shadows == "none"


def test_a_smaller_tolerance_says_what_is_missing(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(60.0))
    report = planned(dataset, 200, 50, 20.0, **EVERYTHING)
    assert report.light.sky_azimuths == 0
    with pytest.raises(UsageError, match=r"was built without what hides the sky.*add --overwrite"):
        planned(dataset, 200, 50, 0.001, **EVERYTHING)


def test_another_sun_is_another_layer(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0))
    planned(dataset, 200, 40)
    with pytest.raises(UsageError, match="has a layer 'light' already, built with other settings"):
        planned(dataset, 210, 40)


def test_damaged_blocks_are_made_again_with_what_was_chosen(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0))
    planned(dataset, 200, 40, codec="png", **EVERYTHING)
    before = tree_digest(dataset)
    sorted((dataset / "light/0").glob("*.png"))[2].write_bytes(b"damaged")
    report = verify_and_repair(open_dataset(dataset), None, Checks())
    assert (len(report.repaired), report.findings, report.notes) == (1, [], [])
    assert tree_digest(dataset) == before


def test_estimates_are_used_where_the_scene_allows_them(tmp_path: Path) -> None:
    """A pit of one sample hides much sky there, which no coarse level knows."""
    heights = np.zeros((500, 500), np.float32)
    heights[250, 250] = -200.0
    dataset = store_heights(tmp_path, heights)
    found = {}
    for allowed in (False, True):
        scene = Scene.model_validate(
            {"sun": {"azimuth_deg": 200, "elevation_deg": 80, "radius_deg": 0}, "tolerance": {"codes": 10, "estimates": allowed}}
        )
        settings = LightSettings(azimuth_deg=200, elevation_deg=80, sky=8, bounce=True, overwrite=True)
        found[allowed] = build_light(dataset, settings, choose=EffectChoice(scene)).light
    assert found[False].sky_azimuths == 8
    assert [one.effect for one in found[False].left_out] == []
    if any(one.estimated for one in found[True].left_out):
        assert found[True].sky_azimuths == 0


@pytest.mark.parametrize("latitude", [89.8, 89.0, 85.0, 60.0, -75.0])
def test_where_meridians_converge_the_sun_turns(latitude: float, tmp_path: Path) -> None:
    """Found 2026-11-23 at 89 degrees north: 1.4 codes off, as the sun was taken to turn no more than the vertical."""
    step = 0.0002
    transform = Affine(step / math.cos(math.radians(latitude)), 0, 10, 0, -step, latitude)
    heights = hills(300.0)
    write_with_rasterio(tmp_path / "dem.tif", heights[..., np.newaxis], crs="EPSG:4326", transform=transform)
    build_layer(tmp_path / "dem.tif", tmp_path / "out", BuildSettings(layer="height", codec="raw", block=32))
    report = planned(tmp_path / "out", 230, 40, layer="planned", shadows="soft")
    everything = lit(tmp_path / "out", 230, 40, curvature=True, shadows="soft")
    different = 255 * np.abs(everything - samples(tmp_path / "out", report)).max()
    assert different <= sum(one.bound or 0 for one in report.light.left_out) + 0.02


def test_light_between_the_heights_is_not_planned(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0, 40))
    with pytest.raises(UsageError, match="--twice: effects are planned for heights as they are stored"):
        planned(dataset, 200, 40, density=2)


_KILLED = """
import sys
from schemas.settings import LightSettings
from tiler.building.light import build_light
from tiler.building.lightplan import EffectChoice, scene_of
settings = LightSettings(azimuth_deg=200, elevation_deg=40, task=64, workers=1, shadows="soft", sky=8, bounce=True)
build_light(sys.argv[1], settings, choose=EffectChoice(scene_of(settings, 1.0)))
"""


def test_a_killed_build_goes_on_with_the_same_effects(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, hills(5.0, 512))
    process = subprocess.Popen([sys.executable, "-c", _KILLED, str(dataset)], cwd=Path(__file__).parents[2])
    records = dataset / "light/tasks/0"
    give_up = time.monotonic() + 60
    while len(list(records.rglob("*.json"))) < 5 and time.monotonic() < give_up and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it was done before it was killed: make the terrain larger"
    report = planned(dataset, 200, 40, codec="png", task=64, **EVERYTHING)
    assert report.build.tasks_kept >= 4
    assert report.light.shadows == "none"


REAL: dict[str, tuple[dict[str, Any], float]] = {
    "puget/ps_height_1k.png": ({"spacing": 160.0, "height_scale": 0.1, "layer": "height"}, 10.0),
    "dem/mt_everest_90m.tif": ({}, 8.0),
    "dem/slovenia_lidar_nan.tif": ({}, 60.0),
}


@pytest.mark.parametrize("name", REAL)
def test_real_heights_differ_by_less_than_the_tolerance(name: str, data_dir: Path, tmp_path: Path) -> None:
    settings, elevation = REAL[name]
    build_layer(data_dir / name, tmp_path / "out", BuildSettings(**settings))
    for codes in (1.0, 40.0):
        options = {**EVERYTHING, "sky": 4, "refraction": True, "overwrite": True}
        report = planned(tmp_path / "out", 270, elevation, codes, layer="planned", **options)
        everything = lit(tmp_path / "out", 270, elevation, **{**options, "curvature": True})
        different = 255 * np.abs(everything - samples(tmp_path / "out", report))
        assert np.nanmax(different) <= codes
