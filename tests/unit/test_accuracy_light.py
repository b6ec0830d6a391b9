"""The experiments on light against references that share nothing with them, closed forms, and what must not be said."""

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cli.main import run
from schemas.scene import SUN_RADIUS_DEG
from tests.reference.shadows import horizon_tangents, shadow_margins, step_toward
from tests.reference.terrain import photo, terrain
from tiler.accuracy.lightexperiments import LINES, STEPS, SUNS, LightResult, light_frontier, measure_lights
from tiler.accuracy.lightground import Ground, ground_of, inner
from tiler.accuracy.lightparts import chords, disc_by_chords, disc_points, sky_share
from tiler.accuracy.lightprecision import measure_light_precision, plain_sweep
from tiler.accuracy.lightreport import LightReport, light_section
from tiler.accuracy.lightwalk import walked_horizons, walked_lit
from tiler.accuracy.sample import built_in
from tiler.light.disc import disc_coverage
from tiler.light.frame import SunPosition, frame_of, tangent_deg
from tiler.light.shadow import cast_shadow
from tiler.light.sweeping import LIT

AZIMUTHS = (0.0, 37.0, 45.0, 90.0, 123.0, 200.0, 247.0, 290.0, 359.0)


def ground(height: int = 40, width: int = 33, cell_m: tuple[float, float] = (10.0, 25.0)) -> Ground:
    return Ground(terrain(height, width, 3)[..., 0].astype(np.float32), cell_m)


@pytest.fixture(scope="module")
def measured() -> LightReport:
    rough = ground_of(built_in(128))
    return LightReport(rough, tuple(measure_lights(rough, 1)), tuple(measure_light_precision(rough, SUNS)))


# The walks


@pytest.mark.parametrize("azimuth", AZIMUTHS)
@pytest.mark.parametrize("margins", [(0, 0), (5, 3)])
def test_walks_are_those_of_the_reference(azimuth: float, margins: tuple[int, int]) -> None:
    land = ground()
    step = step_toward(azimuth, land.cell_m)
    exact = land.heights_m.astype(np.float64)
    for elevation in (1.0, 12.0, 40.0):
        expected = inner(shadow_margins(exact, step, math.tan(math.radians(elevation))), margins)
        lit = walked_lit(land, SunPosition(azimuth, elevation), margins)
        decided = np.abs(expected) > 1e-9  # both walk alike, but a ray that grazes is rounded in another order
        assert ((expected >= 0) == lit)[decided].all()
        assert decided.mean() > 0.99
    tangents = inner(horizon_tangents(exact, step), margins)
    np.testing.assert_allclose(walked_horizons(land, azimuth, margins), tangents, rtol=0, atol=1e-9)
    np.testing.assert_allclose(walked_horizons(land, azimuth, margins, floor=0.1), np.maximum(tangents, 0.1), rtol=0, atol=1e-9)


def test_a_walk_by_nearest_samples_is_another_one() -> None:
    land, sun = ground(), SunPosition(290.0, 12.0)
    assert (walked_lit(land, sun) != walked_lit(land, sun, nearest=True)).any()
    straight = SunPosition(270.0, 12.0)
    assert (walked_lit(land, straight) == walked_lit(land, straight, nearest=True)).all(), "along a row both meet samples"


# The disc and the sky


def level(angle_deg: float) -> Callable[[float], NDArray[np.floating]]:
    return lambda azimuth: np.full((1, 1), math.tan(math.radians(angle_deg)))


@pytest.mark.parametrize("below", [-0.3, -0.2, -0.05, 0.0, 0.1, 0.25, 0.3])
def test_chords_of_a_level_horizon_are_a_segment_of_a_circle(below: float) -> None:
    sun = SunPosition(100.0, 20.0)
    expected = disc_coverage(np.full((1, 1), math.tan(math.radians(20.0 + below)), np.float32), 20.0)
    assert disc_by_chords(level(20.0 + below), sun, 31)[0, 0] == pytest.approx(float(expected[0, 0]), abs=2e-3)


@given(st.integers(1, 40), st.floats(0, 80))
def test_chords_and_points_lie_in_the_disc(count: int, elevation: float) -> None:
    sun = SunPosition(100.0, elevation)
    assert sum(weight for _, _, weight in chords(sun, count)) == pytest.approx(1)
    for azimuth, half, _ in chords(sun, count):
        aside = (azimuth - 100) * math.cos(math.radians(elevation))
        assert math.hypot(aside, half) == pytest.approx(SUN_RADIUS_DEG, abs=1e-9)
    for point in disc_points(sun, count):
        aside = (point.azimuth_deg - 100) * math.cos(math.radians(elevation))
        assert math.hypot(aside, point.elevation_deg - elevation) <= SUN_RADIUS_DEG


@pytest.mark.parametrize("slope", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("toward", [0.0, 30.0, 90.0])
def test_a_tilted_plane_sees_half_the_sky_and_what_its_tilt_leaves(slope: float, toward: float) -> None:
    nothing: Callable[[float], NDArray[np.floating]] = lambda azimuth: np.full((1, 1), -np.inf)  # noqa: E731
    east, north = (np.full((1, 1), slope * part) for part in (math.sin(math.radians(toward)), math.cos(math.radians(toward))))
    share = sky_share(nothing, (east, north), 256)[0, 0]
    assert share == pytest.approx((1 + 1 / math.hypot(1, slope)) / 2, abs=1e-4)


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 60.0, 89.0])
def test_the_bottom_of_a_cone_sees_the_cosine_squared(angle_deg: float) -> None:
    level_ground = (np.zeros((1, 1)), np.zeros((1, 1)))
    assert sky_share(level(angle_deg), level_ground, 4)[0, 0] == pytest.approx(math.cos(math.radians(angle_deg)) ** 2, abs=1e-12)


# Precision


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_the_plain_sweep_is_the_sweep(azimuth: float) -> None:
    land, sun = ground(90, 70, (10.0, 10.0)), SunPosition(azimuth, 12.0)
    frame = frame_of((90, 70), land.cell_m, azimuth)
    rows = np.rot90(land.heights_m, frame.turns).astype(np.float64)
    plain = np.rot90(plain_sweep(rows, frame.shift, frame.step_m * tangent_deg(12.0)), -frame.turns)
    swept = cast_shadow(land.heights_m, land.cell_m, sun) == LIT
    assert (plain == swept)[1:-1, 1:-1].all(), "at the edges the shipped one lets the terrain go on for a column"


def test_offsets_cost_float32_and_not_float64(measured: LightReport) -> None:
    far = [rung for rung in measured.precision if rung.offset_m == 1e7]
    near = [rung for rung in measured.precision if rung.offset_m == 0]
    assert all(rung.wrong_float64_percent < 0.01 for rung in measured.precision)
    assert all(rung.wrong_float32_percent < 0.05 for rung in near)
    assert all(rung.wrong_float32_percent > 0.02 for rung in far), "at 10 000 km a float32 is a metre from the next"


# What is measured


def errors(report: LightReport, experiment: str, start: str) -> list[float]:
    wanted = (SUNS[1][0], None)
    return [r.error for r in report.results if r.experiment == experiment and r.method.startswith(start) and r.azimuth_deg in wanted]


def test_more_work_is_closer(measured: LightReport) -> None:
    for azimuth, elevation in SUNS:
        found = {r.method: r.error for r in measured.results if r.place == ("shadow", azimuth, elevation)}
        assert found["certified"] == found["march, interpolated"] == 0
        assert found["march, nearest sample"] > 10 * found[f"sweep, {LINES[-1]} lines"]
        assert found["sweep, 1 line"] > 4 * found["sweep, 4 lines"]
    hulls = errors(measured, "horizon", "hulls")
    assert len(hulls) == len(STEPS)
    assert hulls == sorted(hulls, reverse=True)
    assert errors(measured, "horizon", "march, interpolated") == [0]
    assert errors(measured, "disc", "1 horizon, 32")[0] < errors(measured, "disc", "1 hard")[0] / 3
    skies = [r.error for r in measured.results if r.experiment == "sky" and r.method.endswith(", 16 exact steps")]
    assert skies == sorted(skies, reverse=True)
    assert skies[-1] < 1


def test_the_section_says_what_was_found(measured: LightReport) -> None:
    content = json.loads(json.dumps(measured.as_dict(), allow_nan=False))
    assert content["ground"]["width"] == content["ground"]["height"] == 129
    section = light_section(content)
    for row in content["results"]:
        assert f"<td>{row['method']}</td>".replace("'", "&#x27;") in section
    assert section.count('class="frontier"') == sum(row["frontier"] for row in content["results"])
    assert "certified, 0 %" in " ".join(content["findings"])


def result(place: int, nanoseconds: float, error: float) -> LightResult:
    return LightResult("shadow", "m", float(place), 1.0, "% wrong", error, None, None, (1.0,), nanoseconds, nanoseconds, 1)


@given(st.lists(st.builds(result, st.integers(0, 1), st.integers(1, 9).map(float), st.integers(0, 9).map(float)), max_size=12))
def test_the_frontier_is_what_nothing_beats(results: list[LightResult]) -> None:
    best = light_frontier(results)
    for one in results:
        beaten = any(
            other.place == one.place
            and other.ns_per_sample <= one.ns_per_sample
            and other.error <= one.error
            and (other.ns_per_sample, other.error) != (one.ns_per_sample, one.error)
            for other in results
        )
        assert (one in best) != beaten


# The command


def test_the_command_measures_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert run(["accuracy", "--light", "--crop", "96", "--runs", "1", "-o", str(tmp_path / "report")]) == 0
    assert "certified, 0 %" in capsys.readouterr().out
    page = (tmp_path / "report" / "index.html").read_text()
    assert "<h2>Light</h2>" in page
    assert (tmp_path / "report" / "light.svg").stat().st_size > 10_000
    with (tmp_path / "report" / "light.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["experiment"] for row in rows} == {"shadow", "horizon", "disc", "sky", "bounce"}
    assert {row["frontier"] for row in rows} == {"True", "False"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--spacing", "30"], "--spacing matters to light only"),
        (["--light", "--layer", "imagery"], "light falls on heights"),
        (["--light", "--layer", "height"], "give it with --spacing"),
    ],
)
def test_mistakes_are_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    pytest.importorskip("matplotlib")
    source = tmp_path / "picture.tif"
    profile = {"driver": "GTiff", "width": 128, "height": 128, "count": 1, "dtype": "uint8"}
    with rasterio.open(source, "w", transform=rasterio.Affine(1, 0, 1, 0, -1, 1), **profile) as file:
        file.write(photo(128, 128)[..., 0], 1)
    assert run(["accuracy", str(source), *options, "-o", str(tmp_path / "report")]) == 2
    shown = capsys.readouterr()
    assert said in shown.err
    assert "measuring" not in shown.err
