"""Light that the ground throws back, gathered: against closed forms, rays through a hemisphere, and the conservation of light."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.reference.terrain import terrain
from tiler.accuracy.lightbounce import direct_light, gathered_light, local_mean
from tiler.accuracy.lightexperiments import AZIMUTHS, GATHERED, RADII, SUNS, LightResult, measure_bounces, measure_shadows, measure_skies
from tiler.accuracy.lightground import Ground, ground_of, inner
from tiler.accuracy.lightparts import sky_share
from tiler.accuracy.lightwalk import walked_horizons
from tiler.accuracy.sample import built_in
from tiler.light.frame import SunPosition

Array = NDArray[np.float64]
SUN = SunPosition(*SUNS[1])


def rough(side: int = 61, cell_m: tuple[float, float] = (10.0, 25.0)) -> Ground:
    return Ground(terrain(side, side, 3)[..., 0].astype(np.float32), cell_m)


@pytest.mark.parametrize("cell_m", [(10.0, 10.0), (10.0, 25.0)])
def test_what_is_not_sky_is_ground(cell_m: tuple[float, float]) -> None:
    """Under a sky of 1, ground of 1 brings what is missing: both are 1 together, but for what azimuths add up to on slopes."""
    ground = rough(61, cell_m)
    margins = (12, 12)
    slopes = tuple(np.ascontiguousarray(inner(slope, margins), np.float64) for slope in ground.slopes())
    sky = sky_share(lambda azimuth: walked_horizons(ground, azimuth, margins), (slopes[0], slopes[1]), 128)
    gathered = gathered_light(ground, np.ones(ground.heights_m.shape), margins, 128)
    assert gathered.max() > 0.2
    np.testing.assert_allclose(sky + gathered, 1, atol=2e-3)


def test_light_is_gathered_in_proportion() -> None:
    ground = rough()
    light = np.random.default_rng(1).random(ground.heights_m.shape)
    once, twice = (gathered_light(ground, light * factor, (20, 20), 8) for factor in (1, 2))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-12)


@pytest.mark.parametrize("degrees", [15, 30, 45, 60])
@pytest.mark.parametrize("across", [False, True])
def test_c48_one_side_of_a_valley_sees_the_other(degrees: int, across: bool) -> None:
    """Two planes that meet at an angle of 180 - 2a see (1 - cos 2a) / 2 of each other, at any distance from the fold."""
    side = 801
    heights = np.repeat(np.abs(np.arange(side) - side // 2)[:, None] * math.tan(math.radians(degrees)), side, axis=1)
    ground = Ground(np.ascontiguousarray(heights.T if across else heights, np.float32), (1.0, 1.0))
    found = gathered_light(ground, np.ones((side, side)), (side // 2 - 8, side // 2 - 8), 256)
    walls = np.delete(found, range(7, 10), axis=int(across))
    expected = (1 - math.cos(math.radians(2 * degrees))) / 2
    assert walls.mean() == pytest.approx(expected, abs=0.015)
    assert np.abs(walls - expected).max() < 0.03


@pytest.mark.parametrize("degrees", [10, 30, 60])
def test_c47_the_bottom_of_a_pit(degrees: int) -> None:
    """The walls of a cone take from its lowest sample all but the cosine squared of their elevation."""
    south, east = np.mgrid[-60:61, -60:61]
    ground = Ground((np.hypot(south, east) * math.tan(math.radians(degrees))).astype(np.float32), (1.0, 1.0))
    found = gathered_light(ground, np.ones((121, 121)), (60, 60), 64)
    # The chord between two samples of a row lies above the cone, and most where it is near: 8 % at the first step.
    assert found[0, 0] == pytest.approx(math.sin(math.radians(degrees)) ** 2, abs=0.025)
    assert gathered_light(Ground(np.zeros((121, 121), np.float32), (1.0, 1.0)), np.ones((121, 121)), (60, 60), 64)[0, 0] == 0


def rays(ground: Ground, light: Array, row: int, column: int, azimuths: int, elevations: int) -> float:
    """What one sample gets, by a ray through the middle of every small piece of its hemisphere: no integral is used, nor any sweep."""
    east, north = (float(slope[row, column]) for slope in ground.slopes())
    upright = 1 / math.sqrt(1 + east * east + north * north)
    heights = ground.heights_m.astype(np.float64)
    total = 0.0
    for a in range(azimuths):
        angle = 2 * math.pi * (a + 0.5) / azimuths
        sine, cosine = math.sin(angle), math.cos(angle)
        step = 1 / max(abs(sine) / ground.cell_m[0], abs(cosine) / ground.cell_m[1])
        met, lit = _along(
            heights,
            light,
            row - step * cosine / ground.cell_m[1] * np.arange(1, 200),
            column + step * sine / ground.cell_m[0] * np.arange(1, 200),
        )
        tangents = (met - heights[row, column]) / (step * np.arange(1, len(met) + 1))
        for e in range(elevations):
            elevation = math.pi * (e + 0.5) / elevations - math.pi / 2
            incidence = upright * (math.sin(elevation) - (east * sine + north * cosine) * math.cos(elevation))
            hit = np.flatnonzero(tangents >= math.tan(elevation))
            if incidence <= 0 or (not len(hit) and elevation >= 0):
                continue
            bright = lit[hit[0]] if len(hit) else light.mean()
            total += bright * incidence * math.cos(elevation) * (math.pi / elevations) * (2 * math.pi / azimuths) / math.pi
    return total


def _along(heights: Array, light: Array, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> tuple[Array, Array]:
    """Heights and light at places of which one coordinate is a whole number, up to the edge; between two samples, a straight line."""
    inside = (rows >= 0) & (columns >= 0) & (rows <= heights.shape[0] - 1) & (columns <= heights.shape[1] - 1)
    count = len(inside) if inside.all() else int(np.argmin(inside))
    y, x = rows[:count], columns[:count]
    y0, x0 = np.clip(np.floor(y + 1e-9).astype(int), 0, None), np.clip(np.floor(x + 1e-9).astype(int), 0, None)
    y1, x1 = np.minimum(y0 + 1, heights.shape[0] - 1), np.minimum(x0 + 1, heights.shape[1] - 1)
    fy, fx = y - y0, x - x0
    mixed = [
        grid[y0, x0] * (1 - fy) * (1 - fx) + grid[y1, x0] * fy * (1 - fx) + grid[y0, x1] * (1 - fy) * fx + grid[y1, x1] * fy * fx
        for grid in (heights, light)
    ]
    return mixed[0], mixed[1]


@pytest.mark.parametrize("cell_m", [(10.0, 10.0), (10.0, 25.0)])
def test_rays_through_a_hemisphere_bring_the_same(cell_m: tuple[float, float]) -> None:
    ground = rough(41, cell_m)
    light = np.random.default_rng(4).random(ground.heights_m.shape) + np.arange(41) / 20
    found = gathered_light(ground, light, (16, 16), 48)
    for row, column in ((0, 0), (4, 4), (8, 2), (3, 7)):
        expected = rays(ground, light, row + 16, column + 16, 48, 720)
        assert found[row, column] == pytest.approx(expected, rel=0.02, abs=2e-3)


def test_direct_light_of_a_slope() -> None:
    """A plane that faces the sun gets all of it, one that turns away only the sky."""
    rise = math.tan(math.radians(30))
    heights = np.repeat(-rise * np.arange(20.0)[None, :], 20, axis=0).astype(np.float32)
    ground, codes, sky = Ground(heights, (1.0, 1.0)), np.ones((20, 20), np.uint8), np.full((20, 20), 0.5)
    np.testing.assert_allclose(direct_light(ground, SunPosition(90, 60), codes, sky, 0.2), 1.1, atol=1e-6)
    np.testing.assert_allclose(direct_light(ground, SunPosition(270, 20), codes, sky, 0.2), 0.1, atol=1e-6)
    np.testing.assert_allclose(direct_light(ground, SunPosition(90, 60), 0 * codes, sky, 0.2), 0.1, atol=1e-6)


@pytest.mark.parametrize("radius", [0, 1, 3, 50])
def test_local_means(radius: int) -> None:
    light = np.random.default_rng(2).random((13, 9))
    found = local_mean(light, radius)
    for y in range(13):
        for x in range(9):
            near = light[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]
            assert found[y, x] == pytest.approx(near.mean(), rel=1e-12)


def by_method(results: list[LightResult]) -> dict[str, Any]:
    return {one.method: one for one in results}


def test_what_is_measured_is_what_the_command_runs() -> None:
    """The shares of clipmap light are those of its methods; more rays are closer, and any light than none."""
    ground = ground_of(built_in(160))
    skies, shadows = by_method(measure_skies(ground, 1)), by_method(measure_shadows(ground, SUN, 1))
    for count in AZIMUTHS:
        assert skies[f"clipmap light --sky {count}"].error == pytest.approx(skies[f"{count} azimuths, 16 exact steps"].error, abs=0.02)
    assert shadows["clipmap light --hard"].error == shadows["sweep, 1 line"].error
    assert shadows["clipmap light --certified"].error == shadows["certified"].error == 0
    bounces = by_method(measure_bounces(ground, SUN, 1))
    by_rays = [bounces[f"{count} azimuths of rays"].error for count in GATHERED]
    assert by_rays == sorted(by_rays, reverse=True)
    assert by_rays[-1] < 0.1
    assert bounces["clipmap light --bounce"].error < bounces["none"].error
    assert all(bounces[f"mean within {radius}"].error < bounces["none"].error for radius in RADII)
