"""Bounds are as small as they can be: a case for each that reaches it, or that would break the next simpler one."""

import math

import numpy as np
import pytest

from tests.reference import effects as reference
from tiler.effects import bounds
from tiler.effects.statistics import measure_heights
from tiler.effects.tiles import surroundings

AZIMUTHS = [360 * (n + 0.5) / 16 for n in range(16)]


def test_a_point_differs_from_a_disc_by_almost_a_half() -> None:
    """Level ground before a wall whose top is a hair above the middle of a high sun."""
    z = np.zeros((1, 8))
    z[0, 6] = 3 * math.tan(math.radians(80.0001))
    z = np.repeat(z, 3, axis=0)
    horizon = reference.horizons(z, (1.0, 1.0), 90.0)[1, 3]
    soft, hard = (float(reference.disc_part(horizon, 80.0, radius)) for radius in (0.2666, 0.0))
    light = reference.facing(z, (1.0, 1.0), 90.0, 80.0)[1, 3]
    assert 0.97 < light * abs(soft - hard) * bounds.code_scale(0.15) / bounds.penumbra_codes(False, 0.15) <= 1


@pytest.mark.parametrize("horizon", [0.1, 1.0, 10.0])
def test_level_ground_in_a_pit_reaches_the_bounds(horizon: float) -> None:
    """As much sky is hidden, and as much ground seen, as the bounds say."""
    around = {a: np.full((3, 3), horizon) for a in AZIMUTHS}
    seen = reference.open_part(np.zeros((3, 3)), (1.0, 1.0), around, sky_only=True)[1, 1]
    assert 1 - seen == pytest.approx(bounds.hidden_sky(horizon, 0.0), abs=1e-5)
    assert 1 - seen == pytest.approx(bounds.seen_ground(horizon, 0.0), abs=1e-5)


def test_a_summit_at_the_reach_sinks_as_far_as_it_may() -> None:
    slope, relief, globe = math.tan(math.radians(10)), 1000.0, 6.4e6
    distance = relief / slope
    sunk = math.degrees(math.atan(slope) - math.atan(slope - distance / (2 * globe)))
    assert sunk == pytest.approx(bounds.lowering_deg(relief, 1e9, 10.0, globe), rel=1e-3)


def test_a_horizon_in_the_middle_of_the_disc_changes_most() -> None:
    parts = [float(reference.disc_part(np.array(math.tan(math.radians(10 + turn))), 10.0, 0.2666)) for turn in (-0.001, 0.001)]
    assert bounds.code_scale(0.15) * (parts[0] - parts[1]) == pytest.approx(bounds.disc_codes(0.002, 0.2666, 0.15), rel=1e-4)


def test_sky_on_another_slope_counts_besides_sun() -> None:
    """A slope that turns out of the sun's plane of shade and toward the zenith at once."""
    p, step = 0.2447, 1e-4
    e = math.atan(p)
    lights = []
    for slope in (p, p - step):
        root = math.sqrt(1 + slope * slope)
        lights.append(max(0.0, (math.sin(e) - slope * math.cos(e)) / root) + (1 + 1 / root) / 2)
    changed = bounds.code_scale(1.0) * (lights[1] - lights[0])
    assert bounds.code_scale(1.0) * step < changed <= bounds.normal_map_codes(step, 1.0)


def test_the_kink_of_the_srgb_curve_counts() -> None:
    """Around 0.04045 codes a ten-thousandth apart differ by more than the curve's curvature allows."""

    def light(y: float) -> float:
        return y / 12.92 if y <= 0.04045 else ((y + 0.055) / 1.055) ** 2.4

    low, high = 0.04045 - 2e-4, 0.04045 + 2e-4
    error = 255 * abs((light(low) + light(high)) / 2 - light((low + high) / 2))
    assert 255 * 3.0188 / 8 * (high - low) ** 2 < error <= bounds.gamma_filter_codes(high - low, 1.0)


def test_a_tile_two_off_is_one_tile_away() -> None:
    """Two samples among voids, one on the edge of its tile: 5 cells apart, in tiles of 4."""
    z = np.full((13, 1), np.nan)
    z[8], z[3] = 0.0, 100.0
    bound = surroundings(measure_heights([z], z.shape, (1.0, 1.0), (0.0, 10.0), 4)).horizon_tan
    assert reference.horizons(z, (1.0, 1.0), 0.0, per_row=1)[8, 0] == 20
    assert 20 <= bound[2, 0] < 26


def test_refined_heights_are_steeper_and_wider_by_so_much() -> None:
    """What docs/EFFECTS.md says of the 4-point scheme, on heights chosen to be enlarged."""
    rng = np.random.default_rng(4)
    steeper = wider = 0.0
    for _ in range(300):
        z = rng.choice([0.0, 1.0], (8, 8))
        fine = np.apply_along_axis(reference.four_point, 0, np.apply_along_axis(reference.four_point, 1, z))
        coarse = max(float(np.abs(np.diff(z, axis=axis)).max()) for axis in (0, 1))
        steeper = max(steeper, *(2 * float(np.abs(np.diff(fine, axis=axis)).max()) / coarse for axis in (0, 1)))
        wider = max(wider, float(np.ptp(fine)))
    assert 1.25 < steeper <= 1.25**2
    assert 1.2 < wider <= 1.25**2
