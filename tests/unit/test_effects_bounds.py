"""No terrain exceeds a bound: against light by brute force, on terrains and suns that nearly reach it."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas import viewbounds
from tests.reference import effects as reference
from tests.unit.effect_terrains import Case, cases
from tiler.effects import bounds
from tiler.effects.statistics import HeightStatistics, measure_heights
from tiler.effects.tiles import lit_tiles, surroundings

Array = NDArray[np.float64]
RADII = (0.0, 0.2666, 2.0)
shares = st.sampled_from([0.0, 0.15, 1.0])
radii = st.sampled_from(RADII)
kinds = st.sampled_from(reference.KINDS)


def measured(case: Case, side: int = 3) -> HeightStatistics:
    return measure_heights([case.z], case.z.shape, case.cell, case.sun, side)


def lit(case: Case, margin_deg: float) -> bool:
    """Whether the bound says that everything within ``margin_deg`` of the sun lights everything."""
    return bool(lit_tiles(measured(case), case.elevation, margin_deg).all())


def slack(case: Case) -> float:
    """What rounding can make of a slope."""
    return 1e-9 * (1 + float(np.nanmax(np.abs(case.z)))) / min(case.cell)


SHEER = Case(np.array([[0.0, 90.0], [0.99, 90.99], [0.0, 90.0]]), (1.0, 1.0), 0.0, 45.0)
"""Less steep toward the sun than the disc's lower edge is high, but so steep across that its flank is hidden."""


@settings(max_examples=400)
@given(case=cases(), radius=radii, kind=kinds)
@example(case=SHEER, radius=2.0, kind="diagonal")
def test_no_shadow_where_none_is_proved(case: Case, radius: float, kind: reference.Kind) -> None:
    """Every point of the disc, not only its top and bottom, is above every horizon."""
    if not lit(case, radius):
        return
    per_row = 1 if np.isnan(case.z).any() else 4
    e = math.radians(case.elevation)
    for turn in np.arange(0, 360, 45) if radius else [0]:
        up, aside = radius * math.sin(math.radians(turn)), radius * math.cos(math.radians(turn))
        # A point of the disc, as a direction; it may lie beyond the zenith.
        x, y, z = 0.0, math.cos(e), math.sin(e)
        y, z = (
            y * math.cos(math.radians(up)) - z * math.sin(math.radians(up)),
            z * math.cos(math.radians(up)) + y * math.sin(math.radians(up)),
        )
        x, y, z = math.sin(math.radians(aside)), y * math.cos(math.radians(aside)), z * math.cos(math.radians(aside))
        azimuth, slope = case.azimuth + math.degrees(math.atan2(x, y)), z / math.hypot(x, y)
        assert np.nanmax(reference.horizons(case.z, case.cell, azimuth, kind, per_row=per_row)) <= slope + slack(case)


def test_what_is_proved_lit_is_often_so() -> None:
    """The proof is sharp: a plane a hair less steep than the sun is high passes, one a hair steeper does not."""
    i, j = np.mgrid[0:40, 0:30].astype(np.float64)
    for azimuth in (0.0, 33.0, 180.0, 270.0):
        a = math.radians(azimuth)
        plane = (j * math.sin(a) - i * math.cos(a)) * math.tan(math.radians(20))
        assert lit(Case(plane * (1 - 1e-6), (1.0, 1.0), azimuth, 20.0), 0.0)
        assert not lit(Case(plane * (1 + 1e-6), (1.0, 1.0), azimuth, 20.0), 0.0)
        assert not lit(Case(plane, (1.0, 1.0), azimuth, 20.0), 0.0), "at the sun's own slope rounding decides, so nothing is proved"


def test_the_slope_toward_the_sun_says_nothing_about_the_discs_flanks() -> None:
    """A wall beside the sun's azimuth hides part of the disc, though no facet rises toward the sun itself."""
    z = np.array([[0.0, 60.0], [0.0, 60.0], [0.0, 60.0], [0.0, 60.0], [0.0, 60.0]])
    case = Case(z, (1.0, 1.0), 0.0, 10.0)
    found = measured(case)
    assert found.toward < math.tan(math.radians(10 - 0.2666))
    assert reference.horizons(z, case.cell, 0.26, "diagonal").max() > math.tan(math.radians(10.1))
    assert not lit(case, 0.2666)


@given(case=cases(voids=False), radius=radii, share=shares, kind=kinds)
def test_shadow_and_penumbra(case: Case, radius: float, share: float, kind: reference.Kind) -> None:
    horizon = reference.horizons(case.z, case.cell, case.azimuth, kind)
    direct = bounds.code_scale(share) * np.maximum(reference.facing(case.z, case.cell, *case.sun), 0)
    soft, hard = (reference.disc_part(horizon, case.elevation, size) for size in (radius, 0.0))
    lit_point, lit_disc = lit(case, 0.0), lit(case, radius)
    assert (direct * (1 - hard)).max() <= bounds.shadow_codes(lit_point, share) + 1e-9
    assert (direct * np.abs(soft - hard)).max() <= bounds.penumbra_codes(lit_disc, share) + 1e-9


@settings(max_examples=60)
@given(case=cases(voids=False, largest=8), azimuths=st.sampled_from([4, 7, 16]), kind=kinds, share=shares)
def test_sky_and_bounce(case: Case, azimuths: int, kind: reference.Kind, share: float) -> None:
    around = surroundings(measured(case, side=64))
    horizon_tan, tilt = float(around.horizon_tan.max()), float(around.tilt_tan.max())
    found = {a: reference.horizons(case.z, case.cell, a, kind) for a in 360 * (np.arange(azimuths) + 0.5) / azimuths}
    x, y = reference.slopes(case.z, case.cell)
    cosine = 1 / np.sqrt(1 + x * x + y * y)
    # A few directions do not see a slope as even as the sky is; that is no matter of what hides it.
    bare = reference.open_part(case.z, case.cell, {a: np.full_like(case.z, -np.inf) for a in found}, sky_only=True)
    assert azimuths != 16 or np.abs(bare - (1 + cosine) / 2).max() < 0.02
    hidden = bare - reference.open_part(case.z, case.cell, found, sky_only=True)
    uneven = float(np.abs(bare - (1 + cosine) / 2).max()) + 1e-4
    scale = bounds.code_scale(share) * share
    assert (scale * hidden).max() <= bounds.sky_codes(horizon_tan, tilt, share) + scale * uneven
    ground = np.maximum(1 - reference.open_part(case.z, case.cell, found, sky_only=False), 0)
    assert ground.max() <= bounds.seen_ground(horizon_tan, tilt) + 2 * uneven
    assert 255 * 0.3 * ground.max() <= bounds.bounce_codes(horizon_tan, tilt, 0.3) + 255 * 0.6 * uneven


@given(st.floats(0, 50), st.floats(0, 1))
def test_hidden_sky_is_largest_at_an_end(horizon: float, part: float) -> None:
    """Of all grounds up to ``tilt`` under one horizon, level ground or the steepest loses most; never more than all."""
    b = part * math.atan(horizon)
    lost = (1 + math.cos(b)) / 2 - math.cos(b) / (1 + horizon**2)
    assert lost <= bounds.hidden_sky(horizon, horizon) * (1 + 1e-12)
    assert bounds.hidden_sky(horizon, horizon) <= 1 - (1 + horizon**2) ** -1.5 + 1e-12, "not looser than the textbook's"


@settings(max_examples=300)
@given(case=cases(voids=False), radius=radii, kind=kinds, globe=st.sampled_from([30.0, 1e3, 6.4e6]))
def test_curvature_and_shadows(case: Case, radius: float, kind: reference.Kind, globe: float) -> None:
    """On globes so small that the horizon is near; hard shadows lie between those of two suns, soft edges change no more than they may."""
    found = measured(case)
    flat = reference.horizons(case.z, case.cell, case.azimuth, kind)
    curved = reference.horizons(case.z, case.cell, case.azimuth, kind, globe)
    lowered = bounds.lowering_deg(found.relief_m, found.diagonal_m, case.elevation, globe)
    higher = np.tan(np.radians(min(case.elevation + lowered, 89.9999999)))
    slope = math.tan(math.radians(case.elevation))
    assert not ((curved > slope) & ~(flat > slope)).any()
    assert not ((flat > higher + slack(case)) & ~(curved > slope)).any()
    if radius:
        lowest = max(case.elevation - radius, -90)
        lowered = bounds.lowering_deg(found.relief_m, found.diagonal_m, lowest, globe)
        parts = [reference.disc_part(one, case.elevation, radius) for one in (flat, curved)]
        assert 255 * np.abs(parts[0] - parts[1]).max() <= bounds.disc_codes(lowered, radius, 0.0) + 255 * 1e-3 * math.sqrt(slack(case))


@settings(max_examples=60)
@given(case=cases(voids=False, largest=8), azimuths=st.sampled_from([4, 7, 16]), kind=kinds, globe=st.sampled_from([30.0, 1e3, 1e5]))
def test_curvature_and_sky(case: Case, azimuths: int, kind: reference.Kind, globe: float) -> None:
    found = measured(case)
    turns = 360 * (np.arange(azimuths) + 0.5) / azimuths
    flat, curved = ({a: reference.horizons(case.z, case.cell, a, kind, radius) for a in turns} for radius in (math.inf, globe))
    seen = [reference.open_part(case.z, case.cell, one, sky_only=True) for one in (flat, curved)]
    bound = bounds.curvature_sky_codes(found.relief_m, found.diagonal_m, found.steepest, azimuths, 0.15, globe)
    gained = seen[1] - seen[0]
    assert gained.min() >= -1e-4
    assert bounds.code_scale(0.15) * 0.15 * gained.max() <= bound + 1e-2


def test_a_slope_gains_more_sky_by_curvature_than_level_ground() -> None:
    """A slope of 45 degrees that faces a range 2000 m high, just beyond the horizon: 18 times relief / R, which is level ground's bound."""
    globe, range_m, azimuths = 6.4e6, 2000.0, 16
    z = np.tile(-np.arange(3.0), (3, 1))
    seen = []
    for horizon in (math.sqrt(range_m / (2 * globe)), 0.0):  # flat, then sunk by d / 2 R
        turns = 360 * (np.arange(azimuths) + 0.5) / azimuths
        around = {a: np.full_like(z, horizon if math.sin(math.radians(a)) > 0 else -np.inf) for a in turns}
        seen.append(reference.open_part(z, (1.0, 1.0), around, sky_only=True)[1, 1])
    gained = seen[1] - seen[0]
    assert gained > 15 * range_m / globe
    assert gained <= bounds.curvature_sky_codes(range_m, 1e6, 1.0, azimuths, 1.0, globe) / bounds.code_scale(1.0)


@settings(max_examples=60)
@given(case=cases(voids=False, largest=8), kind=kinds, steps=st.integers(1, 6))
def test_far_occluders(case: Case, kind: reference.Kind, steps: int) -> None:
    """Looking no further than some distance hides at most so much less of the sky."""
    found = measured(case)
    distance = steps * min(case.cell)
    turns = 360 * (np.arange(7) + 0.5) / 7
    everything = {a: reference.horizons(case.z, case.cell, a, kind) for a in turns}
    near = {a: near_horizons(case, a, kind, distance) for a in turns}
    more = reference.open_part(case.z, case.cell, near, sky_only=True) - reference.open_part(case.z, case.cell, everything, sky_only=True)
    bound = bounds.far_sky_codes(found.relief_m, distance, found.steepest, 7, 0.15)
    assert bounds.code_scale(0.15) * 0.15 * more.max() <= bound + 1e-2


def near_horizons(case: Case, azimuth: float, kind: reference.Kind, distance: float) -> Array:
    """Return horizons of ground up to ``distance`` metres."""
    a = math.radians(azimuth)
    dx, dy = math.sin(a) / case.cell[0], -math.cos(a) / case.cell[1]
    step = 1 / max(abs(dx), abs(dy)) / 4
    rows, columns = np.mgrid[0 : case.z.shape[0], 0 : case.z.shape[1]].astype(np.float64)
    steepest = np.full(case.z.shape, -np.inf)
    for n in range(1, 4 * max(case.z.shape) + 1):
        if n * step < distance:
            steepest = np.fmax(
                steepest, (reference.surface(case.z, columns + n * step * dx, rows + n * step * dy, kind) - case.z) / (n * step)
            )
    return steepest


@given(case=cases(voids=False), radius=st.sampled_from([0.2666, 2.0]), kind=kinds)
def test_refraction_of_the_sun(case: Case, radius: float, kind: reference.Kind) -> None:
    lift = bounds.refraction_deg(case.elevation)
    horizon = reference.horizons(case.z, case.cell, case.azimuth, kind)
    light = [
        np.maximum(reference.facing(case.z, case.cell, case.azimuth, e), 0) * reference.disc_part(horizon, e, radius)
        for e in (case.elevation, min(case.elevation + lift, 90))
    ]
    bound = bounds.disc_codes(lift, radius, 0.0) + bounds.turned_sun_codes(lift, 0.0)
    assert 255 * np.abs(light[0] - light[1]).max() <= bound + 1e-6


@pytest.mark.parametrize(("elevation", "minutes"), [(0.0, 28.98), (8.0, 6.6), (30.0, 1.75), (90.0, 0.0)])
def test_refraction_is_the_almanacs(elevation: float, minutes: float) -> None:
    """Saemundsson's formula agrees with the Nautical Almanac within 0.07 minutes of arc."""
    assert 60 * bounds.refraction_deg(elevation) == pytest.approx(minutes, abs=0.1)


def test_refraction_falls_with_the_suns_elevation() -> None:
    lifts = [bounds.refraction_deg(e) for e in np.linspace(-90, 90, 2000)]
    assert all(a >= b for a, b in pairwise(lifts))


hundredths = st.integers(-200, 200).map(lambda n: n / 100)


@given(st.integers(0, 200), st.integers(0, 62), hundredths, hundredths, st.integers(0, 90), shares)
def test_normals_of_another_level(tenths: int, turn: float, dx: float, dy: float, elevation: int, share: float) -> None:
    """Sun and open sky on a slope and on one that differs from it."""
    e = math.radians(elevation)
    sun = np.array([math.cos(e), 0.0, math.sin(e)])
    slope, turn, lights = tenths / 10, turn / 10, []
    for x, y in ((slope * math.cos(turn), slope * math.sin(turn)), (slope * math.cos(turn) + dx, slope * math.sin(turn) + dy)):
        normal = np.array([-x, -y, 1.0]) / math.sqrt(1 + x * x + y * y)
        lights.append(max(0.0, float(normal @ sun)) + share * (1 + normal[2]) / 2)
    assert bounds.code_scale(share) * abs(lights[0] - lights[1]) <= bounds.normal_map_codes(math.hypot(dx, dy), share) + 1e-9


def decoded(y: Array) -> Array:
    """Light of sRGB values, IEC 61966-2-1."""
    return np.where(y <= 0.04045, y / 12.92, ((np.maximum(y, 0) + 0.055) / 1.055) ** 2.4)


@settings(max_examples=300)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.integers(2, 9),
    span=st.sampled_from([1.0, 0.3, 0.01, 1e-4]),
    lobes=st.sampled_from([0.0, 0.1, 0.5]),
)
@example(seed=0, size=2, span=1.0, lobes=0.0)
def test_filtering_in_gamma_space(seed: int, size: int, span: float, lobes: float) -> None:
    """Weighted means of codes against those of light, with negative lobes as a windowed sinc has, also around the curve's kink."""
    rng = np.random.default_rng(seed)
    low = rng.choice([0.0, 0.04045 - span / 2, rng.uniform(0, 1)])
    values = np.clip(low + span * rng.choice([0.0, 1.0, rng.random()], size), 0, 1)
    weights = rng.random(size) + 0.01
    weights = weights * (1 - 2 * (rng.random(size) < lobes))
    if abs(weights.sum()) < 0.2:
        return
    weights /= weights.sum()
    norm = float(np.abs(weights).sum())
    light = np.clip((weights * decoded(values)).sum(), 0, 1)
    code = float(decoded(np.clip((weights * values).sum(), 0, 1)))
    norm = 1.0 if norm < 1 + 1e-12 else norm
    assert 255 * abs(light - code) <= bounds.gamma_filter_codes(float(np.ptp(values)), norm) + 1e-5


@given(st.floats(0, 255), st.floats(0, 255))
def test_encoding_stretches_no_difference_more_than_next_to_black(a: float, b: float) -> None:
    difference = abs(viewbounds.srgb_codes(a) - viewbounds.srgb_codes(b))
    assert difference <= viewbounds.srgb_codes(abs(a - b)) + 1e-5
    assert viewbounds.linear_codes(viewbounds.srgb_codes(a)) == pytest.approx(a, abs=1e-5)


def test_a_sun_turned_with_the_vertical() -> None:
    """Over 200 km the vertical turns by 0.9 degrees from the middle, on any ellipsoid like the Earth's by at most 0.6 % more."""
    assert bounds.sun_direction_deg(200_000, 6_371_008.8) == pytest.approx(0.8993, rel=0.01)
    assert bounds.sun_direction_deg(200_000, 6_371_008.8) > math.degrees(100_000 / 6_335_439)
