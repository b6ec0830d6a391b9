"""Verdicts: what is left out together stays within the tolerance, on any terrain, and the plan says why."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas import viewbounds
from schemas.effects import EffectName, EffectPlan
from schemas.errors import InputError, UsageError
from schemas.scene import Effects, Ground, Scene, Sun, Tolerance
from tests.reference import effects as reference
from tests.unit.effect_terrains import Array, Case, cases
from tiler.effects import bounds
from tiler.effects.candidates import PyramidFacts
from tiler.effects.plan import plan_effects, tiles_to_run
from tiler.effects.statistics import HeightStatistics, measure_heights
from tiler.effects.text import HEADER, plan_rows, plan_sentences
from tiler.terrain import make_island

AZIMUTHS = tuple(360 * (n + 0.5) / 16 for n in range(16))


def measured(case: Case, side: int | None = None) -> HeightStatistics:
    return measure_heights([case.z], case.z.shape, case.cell, case.sun, side)


def scene_of(case: Case, **parts: Any) -> Scene:
    azimuth, elevation = case.sun
    sun = parts.pop("sun", None) or Sun(azimuth_deg=azimuth, elevation_deg=elevation)
    return Scene(sun=sun, **parts)


def rolling(relief: float, side: int = 60, cell: float = 10.0, elevation: float = 40.0) -> Case:
    """Gentle hills."""
    i, j = np.mgrid[0:side, 0:side] / side
    return Case(relief / 2 * (np.sin(7 * i) * np.cos(5 * j)), (cell, cell), 200.0, elevation)


def light(case: Case, scene: Scene, runs: dict[EffectName, bool]) -> Array:
    """Return the codes of every sample by brute force with some effects, reflected light aside."""
    share, radius = scene.sky.share, scene.sun.radius_deg if runs["penumbra"] else 0.0
    elevation = case.elevation + (bounds.refraction_deg(case.elevation) if runs["refraction_sun"] else 0.0)
    globe = scene.ground.radius_m / (1 - scene.air.refraction * runs["refraction_path"])
    sun = np.maximum(reference.facing(case.z, case.cell, case.azimuth, elevation), 0)
    if runs["shadow"]:
        bent = globe if runs["curvature_shadow"] else math.inf
        sun = sun * reference.disc_part(reference.horizons(case.z, case.cell, case.azimuth, radius_m=bent), elevation, radius)
    nothing = np.full_like(case.z, -np.inf)
    found = dict.fromkeys(AZIMUTHS, nothing)
    if runs["sky"]:
        bent = globe if runs["curvature_sky"] else math.inf
        found = {a: reference.horizons(case.z, case.cell, a, radius_m=bent) for a in AZIMUTHS}
    return bounds.code_scale(share) * (sun + share * reference.open_part(case.z, case.cell, found, sky_only=True))


@settings(max_examples=150)
@given(
    case=cases(voids=False, largest=7),
    codes=st.sampled_from([0.3, 1.0, 10.0]),
    globe=st.sampled_from([6_371_008.8, 1e5]),
    soft=st.booleans(),
)
def test_what_is_left_out_is_within_the_tolerance(case: Case, codes: float, globe: float, soft: bool) -> None:
    """All effects against those of the plan, light by brute force; hard edges that move are counted in degrees, not in light."""
    sun = Sun(azimuth_deg=case.azimuth, elevation_deg=case.elevation, radius_deg=0.2666 if soft else 0.0)
    scene = scene_of(case, sun=sun, ground=Ground(radius_m=globe), tolerance=Tolerance(codes=codes, estimates=False))
    plan = plan_effects(scene, measured(case, 3))
    runs = {one.effect: one.runs for one in plan.effects}
    everything = dict.fromkeys(runs, True)
    assert plan.left_out_codes <= codes
    assert not plan.estimated
    if plan.left_out_sun_deg:
        assert plan.left_out_sun_deg <= scene.tolerance.sun_deg
        return
    different = np.abs(light(case, scene, everything) - light(case, scene, runs)).max()
    assert different <= plan.left_out_codes + 0.02


def test_a_plain_needs_nothing_but_its_slopes() -> None:
    case = rolling(5.0, elevation=40.0)
    plan = plan_effects(scene_of(case), measured(case))
    baked = [one for one in plan.effects if one.stage == "bake"]
    assert [one.verdict for one in baked] == ["skip proven"] * len(baked)
    assert plan.left_out_codes < 1
    assert plan.effect("shadow").bound == 0
    assert (plan.reach_m, plan.sky_reach_m) == (0, 0)
    saved = {one.effect: one.saved_s for one in baked}
    assert saved["sky"] > saved["penumbra"] > saved["shadow"] > 0


def test_mountains_need_everything() -> None:
    case = rolling(2000.0, elevation=8.0)
    plan = plan_effects(scene_of(case), measured(case))
    for name in ("shadow", "penumbra", "sky", "bounce", "refraction_sun"):
        assert plan.effect(name).verdict == "run"
    assert 0 < plan.reach_m <= 2000 / math.tan(math.radians(8 - 0.2666 - 0.01)) + 1


def test_the_scene_has_the_last_word() -> None:
    case = rolling(20.0)
    scene = scene_of(case, effects=Effects(sky="on", shadow="off", haze="off", geomorph="on"))
    plan = plan_effects(scene, measured(case))
    verdicts = {one.effect: one.verdict for one in plan.effects}
    assert (verdicts["sky"], verdicts["shadow"], verdicts["haze"], verdicts["geomorph"]) == (
        "forced on",
        "forced off",
        "forced off",
        "forced on",
    )
    assert plan.effect("sky").share == 1
    hills = rolling(2000.0, elevation=8.0)
    forced = plan_effects(scene_of(hills, effects=Effects(shadow="off", penumbra="off")), measured(hills))
    assert forced.effect("curvature_shadow").verdict == "skip proven", "nothing without shadows"
    assert forced.effect("refraction_path").verdict == "skip proven"


def test_hard_shadows_are_judged_by_the_suns_direction() -> None:
    case = rolling(2000.0, elevation=20.0)
    sun = Sun(azimuth_deg=200.0, elevation_deg=20.0, radius_deg=0.0)
    tight, loose = (plan_effects(scene_of(case, sun=sun, tolerance=Tolerance(sun_deg=degrees)), measured(case)) for degrees in (1e-5, 0.2))
    assert tight.effect("curvature_shadow").unit == "degrees of sun"
    assert tight.effect("curvature_shadow").verdict == "run"
    assert loose.effect("curvature_shadow").verdict == "skip proven"
    assert loose.left_out_sun_deg > 0
    assert plan_effects(scene_of(case), measured(case)).effect("curvature_shadow").unit == "codes"


def test_estimates_are_marked_and_have_to_be_allowed() -> None:
    """Hills so gentle that the sky they hide is nothing, but not by proof: in a pit as steep all around it would be seen."""
    case = rolling(500.0, side=1000, elevation=40.0)
    proved, estimated = (plan_effects(scene_of(case, tolerance=Tolerance(estimates=yes)), measured(case)) for yes in (False, True))
    assert (proved.effect("sky").verdict, proved.effect("sky").estimate, proved.estimated) == ("run", None, False)
    assert estimated.effect("sky").verdict == "skip estimated"
    assert estimated.estimated
    assert any("estimate" in sentence for sentence in plan_sentences(estimated))
    assert proved.effect("shadow").verdict == estimated.effect("shadow").verdict


def test_one_sheer_sample_ends_proofs_and_estimates() -> None:
    """A coarse level does not show it, but it is known of the finest; a few tiles are simulated."""
    case = rolling(20.0, side=1000, elevation=40.0)
    case.z[501, 500] += 60.0
    plan = plan_effects(scene_of(case, tolerance=Tolerance(estimates=True)), measured(case))
    assert [plan.effect(name).verdict for name in ("shadow", "penumbra", "sky", "bounce")] == ["run"] * 4
    assert plan.effect("shadow").share < 0.1


def test_tiles_left_out_are_lit() -> None:
    """On an island in a wide sea: samples of tiles that need no shadow, sky or reflection are as bright without as with them."""
    z = np.zeros((80, 140))
    z[:25, :25] = 0.04 * make_island(24, 20.0).heights_m
    case = Case(z, (20.0, 20.0), 300.0, 10.0)
    scene = scene_of(case, tolerance=Tolerance(estimates=False, codes=2.0))
    found = measured(case, 8)
    plan = plan_effects(scene, found)
    tiles = tiles_to_run(scene, found, plan)
    assert {"shadow", "penumbra", "sky", "bounce"} <= set(tiles)
    assert 0 < tiles["shadow"].mean() < 0.5
    assert tiles["sky"].mean() < 1
    assert plan.effect("shadow").share == pytest.approx(tiles["shadow"].mean())
    spared = ~np.kron(tiles["shadow"] | tiles["penumbra"], np.ones((8, 8), np.bool_))[:79, :139]
    horizon = reference.horizons(z, case.cell, 300.0)[:79, :139]
    assert (horizon[spared] <= math.tan(math.radians(10.0 - scene.sun.radius_deg))).all()
    sky = ~np.kron(tiles["sky"], np.ones((8, 8), np.bool_))[:79, :139]
    turns = {a: reference.horizons(z, case.cell, a, per_row=1)[:79, :139] for a in AZIMUTHS[::4]}
    seen = reference.open_part(z[:79, :139], case.cell, turns, sky_only=True)
    assert bounds.code_scale(0.15) * 0.15 * (1 - seen[sky]).max() <= 2.0


def test_levels_and_imagery() -> None:
    case = rolling(20.0)
    facts = PyramidFacts(differences_m=(0.01, 0.02), gradient_difference=1e-3, local_range=0.001, detail_sigma_m=1e-4)
    plan = plan_effects(scene_of(case), measured(case), facts)
    for name in ("geomorph", "normal_map", "linear_filter", "synthesis"):
        assert plan.effect(name).verdict == "skip proven"
    unknown = plan_effects(scene_of(case), measured(case))
    for name in ("geomorph", "normal_map", "linear_filter", "synthesis"):
        one = unknown.effect(name)  # type: ignore[arg-type]
        assert (one.verdict, one.bound) == ("run", None), "nothing is proved by what was not measured"
    rough = plan_effects(scene_of(case), measured(case), PyramidFacts(differences_m=(50.0,), detail_sigma_m=100.0))
    assert rough.effect("geomorph").verdict == "run"
    assert rough.effect("synthesis").verdict == "run"


def test_srgb_codes_are_dearer() -> None:
    """An sRGB code next to black is a twelfth of a code of light."""
    case = rolling(60.0)
    linear, encoded = (
        plan_effects(scene_of(case, tolerance=Tolerance(transfer=transfer)), measured(case)) for transfer in ("linear", "srgb")
    )
    assert linear.effect("sky").tolerance / encoded.effect("sky").tolerance == pytest.approx(12.92, rel=0.01)
    assert viewbounds.srgb_codes(encoded.left_out_codes) <= 1


def test_a_plan_is_a_document_and_a_table() -> None:
    case = rolling(500.0)
    plan = plan_effects(scene_of(case), measured(case))
    assert EffectPlan.model_validate_json(plan.model_dump_json()) == plan
    rows = plan_rows(plan)
    assert [row[0].replace(" ", "_") for row in rows] == [one.effect for one in plan.effects]
    assert {len(row) for row in rows} == {len(HEADER)}
    assert all("\n" not in cell for row in rows for cell in row)
    with pytest.raises(KeyError):
        plan.effect("fog")  # type: ignore[arg-type]


def test_statistics_of_another_sun_are_refused() -> None:
    case = rolling(20.0)
    with pytest.raises(UsageError, match="measure them again"):
        plan_effects(scene_of(case, sun=Sun(azimuth_deg=0.0, elevation_deg=40.0)), measured(case))
    with pytest.raises(InputError, match="not known yet"):
        plan_effects(Scene.model_validate({"sun": {"when": "2026-06-21T05:00:00Z"}}), measured(case))


@pytest.mark.parametrize("elevation", [-90.0, -5.0, 0.0, 0.1, 90.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (9, 9)])
def test_odd_suns_and_maps_have_plans(elevation: float, shape: tuple[int, int]) -> None:
    z = np.zeros(shape)
    z[-1, -1] = 5.0
    case = Case(z, (1.0, 1.0), 0.0, elevation)
    plan = plan_effects(scene_of(case), measured(case))
    assert len(plan.effects) == 16
    assert elevation > 0 or plan.effect("penumbra").verdict == "run" or shape == (1, 1)
