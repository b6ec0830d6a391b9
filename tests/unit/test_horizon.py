"""Horizons and the sun's disc above them: against walked rays, in bands, turned, and what the exact steps are worth."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.errors import UsageError
from schemas.region import Rect
from schemas.scene import SUN_RADIUS_DEG
from tests.reference import shadows as reference
from tests.reference.terrain import power_law_field
from tests.unit.test_shadow import AZIMUTHS, CELLS, EARTHS, PARTS, rough_terrain, split, terrains
from tiler.light.disc import disc_coverage
from tiler.light.frame import Earth, SunPosition, curvature_per_m
from tiler.light.horizons import HorizonSweep, angles_deg, horizon_tangents, sines
from tiler.light.shadow import ShadowSweep, local_elevation_deg
from tiler.light.sweeping import Float32, Float64
from tiler.light.turning import turned


def expected_tangents(sweep: HorizonSweep, rows: Float32, earth: Earth | None) -> Float64:
    return reference.horizon_tangents(rows.astype(float), (-1.0, sweep.frame.shift, sweep.frame.step_m), curvature_per_m(earth))


def same(found: Float32, expected: Float64) -> bool:
    """Equal to within a float32, with the same voids, and nothing where there is nothing."""
    return bool(np.allclose(found, expected, rtol=1e-6, atol=1e-6, equal_nan=True))


@settings(max_examples=60)
@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS)
def test_exact_steps_all_the_way_are_walked_rays(heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None) -> None:
    """Hulls are not asked then, and must not get in the way either."""
    sweep = HorizonSweep(heights.shape, cell, azimuth, earth, near_steps=50)
    rows = turned(heights, sweep.frame.turns)
    assert same(sweep.push(rows), expected_tangents(sweep, rows, earth))


@settings(max_examples=60)
@given(heights=terrains(), azimuth=st.sampled_from(range(0, 360, 45)), earth=EARTHS, steps=st.sampled_from([0, 1, 5]))
def test_along_rows_columns_and_diagonals_hulls_are_exact(heights: Float32, azimuth: int, earth: Earth | None, steps: int) -> None:
    sweep = HorizonSweep(heights.shape, (10, 10), azimuth, earth, near_steps=steps)
    rows = turned(heights, sweep.frame.turns)
    assert same(sweep.push(rows), expected_tangents(sweep, rows, earth))


def test_every_exact_step_helps() -> None:
    """The error goes down about as 1 / steps; from degrees to tenths on terrain as rough as this."""
    heights = (power_law_field(150, 150, 5, 4.0) * 120).astype(np.float32)
    for azimuth, earth in ((17.0, None), (250.0, Earth(radius_m=100e3))):
        sweep = HorizonSweep(heights.shape, (10, 10), azimuth, earth)
        rows = turned(heights, sweep.frame.turns)
        expected = np.degrees(np.arctan(expected_tangents(sweep, rows, earth)))
        errors = []
        for steps in (0, 4, 16):
            found = HorizonSweep(heights.shape, (10, 10), azimuth, earth, near_steps=steps).push(rows)
            # the outermost columns look past the edge after a few rows
            errors.append(np.sqrt(np.mean((angles_deg(found) - expected)[1:, 4:-4] ** 2)))
        assert errors[0] < 3
        assert errors[1] < errors[0] / 2
        assert errors[2] < errors[1] / 2
        assert errors[2] > 0, "else this shows nothing"


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, steps=st.sampled_from([0, 1, 4]), parts=PARTS)
def test_bands_give_the_bits_of_one_piece(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, steps: int, parts: list[int]
) -> None:
    whole = HorizonSweep(heights.shape, cell, azimuth, earth, near_steps=steps)
    rows = turned(heights, whole.frame.turns)
    banded = HorizonSweep(heights.shape, cell, azimuth, earth, near_steps=steps)
    found = np.vstack([banded.push(rows[start:stop]) for start, stop in split(rows.shape[0], parts)])
    assert found.tobytes() == whole.push(rows).tobytes()


@given(heights=terrains(), quarters=st.integers(1, 3), azimuth=st.integers(0, 359 * 64), earth=EARTHS)
def test_a_turned_grid_has_the_turned_horizons(heights: Float32, quarters: int, azimuth: int, earth: Earth | None) -> None:
    """Bit for bit; counterclockwise turns of the grid are clockwise ones of the sun, and azimuths of 1/64 degree stay exact."""
    cell = (10.0, 7.0)
    straight = horizon_tangents(heights, cell, azimuth / 64, earth, near_steps=3)
    other = horizon_tangents(
        np.rot90(heights, quarters), cell if quarters == 2 else cell[::-1], azimuth / 64 - 90 * quarters, earth, near_steps=3
    )
    assert np.ascontiguousarray(np.rot90(straight, quarters)).tobytes() == other.tobytes()


def test_bands_of_the_whole_are_pushed_within() -> None:
    """1300 rows are three bands; what they hand over includes hulls, waiting heights and the rows for the exact steps."""
    heights = np.cumsum(rough_terrain(1300, 12, 2), axis=0, dtype=np.float32)
    sweep = HorizonSweep(heights.shape, (10, 10), 10, near_steps=7)
    assert horizon_tangents(heights, (10, 10), 10, near_steps=7).tobytes() == sweep.push(heights).tobytes()


def test_a_hull_with_hundreds_of_corners() -> None:
    """A convex hill keeps every sample on the hull: stacks have room, and searches through them find the same as walking does."""
    rows = np.arange(400, dtype=np.float64)
    hill = np.repeat((1000 - (rows - 100) ** 2 / 40)[:, np.newaxis], 8, axis=1)
    beyond = np.random.default_rng(1).uniform(-1000, 6000, (60, 8))
    heights = np.vstack([hill, beyond]).astype(np.float32)
    for steps in (0, 30):  # the hull is 30 rows behind: none of what lies beyond hides the hill
        sweep = HorizonSweep(heights.shape, (1, 1), 0, near_steps=steps)
        assert same(sweep.push(heights), expected_tangents(sweep, heights, None))
    levels = np.vstack([hill, np.linspace(-1000, 6000, 60)[:, np.newaxis].repeat(8, axis=1)]).astype(np.float32)
    sweep = HorizonSweep(levels.shape, (1, 1), 0, near_steps=50)
    assert same(sweep.push(levels), expected_tangents(sweep, levels, None))


def test_voids_and_infinities_are_no_horizon() -> None:
    heights = np.zeros((5, 3), np.float32)
    heights[1] = np.nan, np.inf, -np.inf
    heights[2, 1] = 10
    found = horizon_tangents(heights, (10, 10), 0, near_steps=2)
    assert np.isnan(found[1]).all()
    assert (found[0] == -np.inf).all()
    assert found[2, 0] == 0
    assert found[3, 1] == pytest.approx(1)
    assert found[4, 1] == pytest.approx(0.5)


def test_sines_and_angles_of_tangents() -> None:
    tangents = np.array([[-np.inf, -1.0, -0.0, 0.0, 1e-30, 1.0, 1e30, np.nan]], np.float32)
    half = math.sqrt(0.5)
    assert np.allclose(sines(tangents), [[-1, -half, 0, 0, 1e-30, half, 1, np.nan]], atol=0, rtol=1e-6, equal_nan=True)
    assert np.allclose(angles_deg(tangents), [[-90, -45, 0, 0, 0, 45, 90, np.nan]], atol=1e-6, equal_nan=True)


@given(st.floats(-0.4, 0.4), st.floats(0, 80))
def test_the_share_of_a_disc_is_its_area_above_the_line(offset_deg: float, horizon_deg: float) -> None:
    """Counted on a grid of 800 by 800 points over the disc."""
    points = (np.arange(800) + 0.5) / 400 - 1
    inside = points[:, np.newaxis] ** 2 + points**2 <= 1
    above = inside & (points[:, np.newaxis] * SUN_RADIUS_DEG + offset_deg >= 0)
    tangents = np.full((1, 1), math.tan(math.radians(horizon_deg)), np.float32)
    horizon = math.degrees(math.atan(float(tangents[0, 0])))
    found = disc_coverage(tangents, horizon + offset_deg)[0, 0]
    assert found == pytest.approx(above.sum() / inside.sum(), abs=3e-3)
    assert found == pytest.approx(disc_coverage(tangents, np.array([[horizon + offset_deg]]))[0, 0], abs=1e-6)


def test_the_ends_of_the_disc() -> None:
    tangents = np.array([[-np.inf, 0.0, 1.0, np.inf, np.nan]], np.float32)
    for elevation in (30.0, np.full((1, 5), 30.0)):
        assert np.allclose(disc_coverage(tangents, elevation), [[1, 1, 0, 0, np.nan]], equal_nan=True)
    assert disc_coverage(tangents, 0.0)[0, 1] == pytest.approx(0.5)
    assert disc_coverage(tangents, 45.0)[0, 2] == pytest.approx(0.5, abs=1e-4)
    assert disc_coverage(tangents, -0.833)[0, 1] == 0
    assert disc_coverage(tangents, 90.0)[0, 2] == 1
    bad: Any
    for bad in (0.0, -1.0, math.nan, 90.0):
        with pytest.raises(UsageError, match="radius"):
            disc_coverage(tangents, 10.0, bad)


@pytest.mark.parametrize("azimuth", [0, 30, 100, 200, 300])
def test_the_sun_is_lower_farther_away_from_it(azimuth: int) -> None:
    """A degree for every 111 km along its azimuth on a round Earth; the same everywhere on a flat one."""
    shape, cell = (5, 9), (20e3, 10e3)
    sun = SunPosition(azimuth, 1)
    earth = Earth(refraction=0)
    round_rays = ShadowSweep(shape, cell, sun, earth).rays
    window = Rect(2, 1, 9, 5)
    rows, columns = np.mgrid[1:5, 2:9]
    toward_m = (columns - 4) * 20e3 * math.sin(math.radians(azimuth)) - (rows - 2) * 10e3 * math.cos(math.radians(azimuth))
    assert np.allclose(local_elevation_deg(round_rays, window), 1 + np.degrees(toward_m / earth.radius_m), atol=2e-3)
    assert np.allclose(local_elevation_deg(ShadowSweep(shape, cell, sun).rays, window), 1)
