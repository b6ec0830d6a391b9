"""Layers of light: what a terrain looks like under a sun, by formula, and that nothing depends on how it was computed."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import NotFoundError, UsageError
from schemas.settings import BuildSettings
from tests.integration.files import tree_digest
from tests.integration.lighting import CELL_M, Array, light, lit, plain_tiff, ramp, rough, samples, store_heights, toward
from tiler.building.build import build_layer
from tiler.building.light import LightReport
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks, verify
from tiler.stores.dataset import open_dataset


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 30), (90, 30), (123, 50), (270, 10), (37, 90)])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.1), (-0.2, 0.25)])
def test_a_plane_has_the_cosine_of_its_incidence_everywhere(
    slope: tuple[float, float], azimuth: float, elevation: float, tmp_path: Path
) -> None:
    """Lambert, to the edge of the grid. A plane that is turned away is dark."""
    east, north, up = toward(azimuth, elevation)
    expected = max(0.0, (up - slope[0] * east - slope[1] * north) / math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2))
    found = lit(store_heights(tmp_path, ramp(*slope)), azimuth, elevation, shadows="none")
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_c46_the_terminator_of_a_dome(tmp_path: Path) -> None:
    """A hemisphere is lit where its normal is within 90 degrees of the sun, and its shadow as long as geometry says."""
    side, radius = 201, 40
    rows, columns = np.mgrid[0:side, 0:side] - (side - 1) / 2
    inside = rows**2 + columns**2 < radius**2
    heights = CELL_M * np.sqrt(np.where(inside, radius**2 - rows**2 - columns**2, 0))
    found = lit(store_heights(tmp_path, heights), 90, 30, lines=8)
    facing = (columns * math.cos(math.radians(30)) + heights / CELL_M * math.sin(math.radians(30))) / radius
    well_inside = rows**2 + columns**2 < (radius - 4) ** 2
    assert (found[well_inside & (facing > 0.03)] > 0).all()
    assert (found[well_inside & (facing < -0.03)] == 0).all()
    np.testing.assert_allclose(found[well_inside], np.maximum(facing, 0)[well_inside], atol=0.02)
    dark = np.flatnonzero(found[side // 2] == 0) - (side - 1) / 2
    assert dark.min() == pytest.approx(-radius / math.sin(math.radians(30)), abs=1.5)


@pytest.mark.parametrize("half_angle", [30.0, 45.0, 70.0])
def test_c47_the_sky_from_the_bottom_of_a_conical_pit(half_angle: float, tmp_path: Path) -> None:
    """The sky is a cone about the zenith: its cosine-weighed share is the squared sine of the half angle.

    The bottom is level: beside a sharp one samples are joined by lines that are up to 8 % higher than a cone.
    """
    side, floor = 129, 24
    rows, columns = np.mgrid[0:side, 0:side] - (side - 1) / 2
    share = (np.minimum(np.hypot(rows, columns), side // 2) - floor).clip(0) / (side // 2 - floor)
    heights = CELL_M * share * (side // 2) / math.tan(math.radians(half_angle))
    found = lit(store_heights(tmp_path, heights), 0, -90, sky=32, share=1.0)
    assert 2 * found[side // 2, side // 2] == pytest.approx(math.sin(math.radians(half_angle)) ** 2, abs=0.01)


def test_c48_light_between_the_walls_of_a_valley(tmp_path: Path) -> None:
    """Of two planes that meet at 120 degrees, each fills (1 + cos 120) / 2 of the other's sky; the bounce is that share of the mean."""
    side, slope = 257, math.tan(math.radians(30))
    distance = np.abs(np.arange(side) - (side - 1) / 2)
    heights = np.repeat((CELL_M * slope * distance)[np.newaxis], side, axis=0)
    dataset = store_heights(tmp_path, heights)
    sky = lit(dataset, 0, -90, sky=64, share=1.0)
    both = lit(dataset, 0, -90, sky=64, share=1.0, bounce=True, albedo=0.5)
    # The walls end, which opens the sky in proportion to the distance from the bottom: 0.0034 of it per sample.
    row = 2 * sky[side // 2, side // 2 :]
    filled = (1 - math.cos(math.radians(60))) / 2
    assert 2 * row[1] - row[2] == pytest.approx(1 - filled, abs=1e-3)
    assert row[1] == pytest.approx(1 - filled, abs=5e-3)
    mean = round(2 * float(sky.mean()) * 1024) / 1024
    np.testing.assert_allclose(2 * (both - sky), 0.5 * mean * (1 - 2 * sky), atol=1e-4)


def test_a_flat_plain_sees_all_of_the_sky_and_nothing_else(tmp_path: Path) -> None:
    found = lit(store_heights(tmp_path, np.full((50, 40), 123.0)), 200, 40, sky=16, bounce=True, shadows="soft")
    np.testing.assert_allclose(found, (math.sin(math.radians(40)) + 0.15) / 1.15, atol=1e-6)


def test_a_penumbra_is_the_share_of_the_disc_above_a_wall(tmp_path: Path) -> None:
    """Behind a wall across the sun's direction the disc rises with the distance: half of it where the shadow of its centre ends."""
    heights = np.zeros((40, 200))
    heights[:, 20] = 500.0
    found = lit(store_heights(tmp_path, heights), 270, 10, shadows="soft", radius_deg=1.0)[20, 24:]
    steps = np.arange(4, 180)
    u = np.clip((10 - np.degrees(np.arctan(500 / (CELL_M * steps)))) / 1.0, -1, 1)
    share = 0.5 + (u * np.sqrt(1 - u**2) + np.arcsin(u)) / np.pi
    np.testing.assert_allclose(found, share * math.sin(math.radians(10)), atol=1e-4)
    assert 5 < ((share > 0) & (share < 1)).sum() < 40, "else there is no penumbra to look at"


@pytest.mark.parametrize("shadows", ["hard", "certified", "soft"])
def test_a_turned_terrain_has_the_turned_light(shadows: str, tmp_path: Path) -> None:
    """Bit for bit: quarter turns of the grid are quarter turns of the sun."""
    heights = rough(96)
    found = []
    for quarters in range(4):
        (tmp_path / str(quarters)).mkdir()
        dataset = store_heights(tmp_path / str(quarters), np.rot90(heights, quarters))
        found.append(np.rot90(lit(dataset, 130 - 90 * quarters, 20, shadows=shadows, curvature=True), -quarters))
    assert len({each.tobytes() for each in found}) == 1


def test_the_sun_under_the_horizon_lights_summits_only(tmp_path: Path) -> None:
    """35: at -1 degree the shadow of the Earth is 970 m high on ground that faces the sun; farther below, all is dark."""
    heights = np.repeat(np.linspace(0, 2000, 80)[:, np.newaxis], 80, axis=1)
    dataset = store_heights(tmp_path, heights)
    summits = heights[lit(dataset, 0, -1, curvature=True, shadows="hard") > 0]
    assert summits.min() == pytest.approx(970, abs=30)
    assert (lit(dataset, 0, -36, curvature=True) == 0).all()
    assert (lit(dataset, 0, -1, curvature=False) == 0).all()
    assert (lit(dataset, 0, -3, curvature=True, shadows="soft") == 0).all()


def test_voids_have_no_light_and_shade_nothing(tmp_path: Path) -> None:
    heights = np.zeros((70, 70))
    heights[30, 30:40] = np.nan
    heights[0:32, 0:32] = np.nan
    dataset = store_heights(tmp_path, heights)
    found = lit(dataset, 180, 30, sky=8)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(heights))
    np.testing.assert_allclose(found[~np.isnan(heights)], (0.5 + 0.15) / 1.15, atol=1e-6)
    report = light(dataset, 180, 30, layer="codes", codec="png")
    layer = report.build.manifest.layer("codes")
    assert (layer.channels, layer.alpha, layer.levels[0].blank) == (2, True, 1)
    assert layer.light is not None
    assert layer.light.voids == report.light.voids == 32 * 32 + 8
    assert verify(open_dataset(dataset)).findings == []


@pytest.mark.parametrize(
    ("codec", "bits"), [("png", 8), ("png", 16), ("jpeg:95", 8), ("webp:95", 8), ("raw", 16), ("exr:half", 8), ("exr:float", 8)]
)
def test_codes_are_the_srgb_encoding_of_light(codec: str, bits: int, tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough())
    exact = lit(dataset, 300, 35)
    report = light(dataset, 300, 35, layer="codes", codec=codec, bits=bits, curvature=False)
    layer = report.build.manifest.layer("codes")
    found = samples(dataset, report)
    if codec.startswith("exr"):
        assert not layer.filter.linear_light
        np.testing.assert_allclose(found, exact, atol=0 if codec == "exr:float" else 5e-4)
        return
    assert layer.filter.linear_light
    top = 2**bits - 1
    expected = top * np.where(exact <= 0.0031308, 12.92 * exact, 1.055 * exact ** (1 / 2.4) - 0.055)
    assert np.abs(found - expected).max() < (25 if ":95" in codec else 0.51)


def test_nothing_depends_on_workers_tasks_or_how_it_was_cut(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough(300))
    options = {"shadows": "soft", "sky": 6, "bounce": True}
    trees = []
    for task, workers in ((64, 1), (64, 2), (128, 3), (1024, 1)):
        report = light(dataset, 215, 12, task=task, workers=workers, overwrite=True, **options)
        trees.append(tree_digest(dataset / report.build.manifest.layer("light").path))
    assert len(set(trees)) == 1


def test_an_update_writes_only_what_the_change_can_shade(tmp_path: Path) -> None:
    """A tower rises; the sun is in the west: blocks west of it, and north and south, keep their bytes and are not written."""
    heights = np.zeros((256, 256))
    heights[::16, ::16] = 20
    dataset = store_heights(tmp_path, heights)
    first = light(dataset, 270, 30, task=64)
    assert light(dataset, 270, 30, task=64).build.outcome == "up to date"
    heights[100, 130] = 600
    store_heights(tmp_path, heights, update=True)
    with pytest.raises(UsageError, match=r"the source has changed since.*add --update"):
        light(dataset, 270, 30, task=64)
    second = light(dataset, 270, 30, task=64, update=True)
    assert second.build.outcome == "updated"
    assert 0 < second.build.blocks_written < first.build.blocks_written / 3
    (tmp_path / "fresh").mkdir()
    fresh = store_heights(tmp_path / "fresh", heights)
    again = light(fresh, 270, 30, task=64)
    for level in range(4):
        assert samples(dataset, second, level).tobytes() == samples(fresh, again, level).tobytes()
    changed = samples(dataset, second) != samples_of_first(first, tmp_path)
    assert changed[:, 132:].any()
    assert not changed[:, :128].any()
    assert verify(open_dataset(dataset)).findings == []


def samples_of_first(first: LightReport, folder: Path) -> Array:
    """The light before the tower, built anew."""
    (folder / "before").mkdir()
    heights = np.zeros((256, 256))
    heights[::16, ::16] = 20
    dataset = store_heights(folder / "before", heights)
    return samples(dataset, light(dataset, first.light.azimuth_deg, first.light.elevation_deg, task=64))


_KILLED = """
import sys
from pathlib import Path
from schemas.settings import LightSettings
from tiler.building.light import build_light
build_light(sys.argv[1], LightSettings(azimuth_deg=200, elevation_deg=20, task=64, workers=1))
"""


def test_a_killed_build_goes_on_where_it_was(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough(512))
    process = subprocess.Popen([sys.executable, "-c", _KILLED, str(dataset)], cwd=Path(__file__).parents[2])
    records = dataset / "light/tasks/0"
    give_up = time.monotonic() + 60
    while len(list(records.rglob("*.json"))) < 5 and time.monotonic() < give_up and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it was done before it was killed: make the terrain larger"
    assert "light" not in open_dataset(dataset).manifest.layers
    report = light(dataset, 200, 20, task=64)
    assert report.build.tasks_kept >= 4
    (tmp_path / "fresh").mkdir()
    fresh = store_heights(tmp_path / "fresh", rough(512))
    light(fresh, 200, 20, task=64)
    assert tree_digest(dataset / "light") == tree_digest(fresh / "light")


def test_a_damaged_block_of_light_is_made_again(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough())
    light(dataset, 60, 25, sky=4)
    before = tree_digest(dataset)
    block = sorted((dataset / "light/0").glob("*.png"))[3]
    block.write_bytes(b"damaged")
    os.unlink(sorted((dataset / "light/1").glob("*.png"))[0])
    report = verify_and_repair(open_dataset(dataset), None, Checks())
    assert (len(report.repaired), report.findings, report.notes) == (2, [], [])
    assert tree_digest(dataset) == before


def test_what_cannot_be_lit_is_said(tmp_path: Path) -> None:
    dataset = store_heights(tmp_path, rough(40))
    with pytest.raises(NotFoundError, match="no dataset there; build one with heights first"):
        light(tmp_path / "nothing", 0, 10)
    with pytest.raises(NotFoundError, match="no layer 'dem' in the dataset"):
        light(dataset, 0, 10, height="dem")
    with pytest.raises(UsageError, match="--layer height: is there and no light"):
        light(dataset, 0, 10, layer="height")
    with pytest.raises(UsageError, match="--codec lerc: light is stored as"):
        light(dataset, 0, 10, codec="lerc")
    light(dataset, 0, 10)
    with pytest.raises(UsageError, match="is of kind light; light falls on heights"):
        light(dataset, 0, 10, height="light", layer="more")
    with pytest.raises(UsageError, match="built with other settings"):
        light(dataset, 0, 11)
    source = plain_tiff(tmp_path / "bare.tif", rough(40))
    build_layer(source, tmp_path / "bare", BuildSettings(layer="height"))
    with pytest.raises(UsageError, match="nothing says how far apart the samples are; build the heights again with --spacing"):
        light(tmp_path / "bare", 0, 10)
