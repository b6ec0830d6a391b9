"""What a plan of effects switches off in the settings of a layer of light, and which scene these settings are."""

from itertools import product
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.effects import EffectName, EffectPlan, PlannedEffect, Verdict
from schemas.errors import UsageError
from schemas.scene import Scene
from schemas.settings import LightSettings
from tiler.building.lightplan import saved_s, scene_of, settings_for, settings_of

SKIP: tuple[Verdict, ...] = ("skip proven", "skip estimated", "forced off")
EVERYTHING: dict[str, Any] = {"shadows": "soft", "sky": 16, "bounce": True, "refraction": True}


def settings(**options: Any) -> LightSettings:
    return LightSettings(**{"azimuth_deg": 200.0, "elevation_deg": 30.0, **options})


def planned(effect: EffectName, verdict: Verdict) -> PlannedEffect:
    return PlannedEffect(
        effect=effect,
        stage="bake",
        verdict=verdict,
        bound=0.125,
        unit="degrees of sun" if effect == "sun_direction" else "codes",
        tolerance=1.0,
        estimate=None,
        statistic="",
        formula="",
        anchor="",
        share=1.0,
        cost_s=2.0,
        saved_s=0.0,
        remark="",
    )


def plan(verdicts: dict[str, Verdict], elevation: float = 30.0) -> EffectPlan:
    """A plan in which everything runs but for ``verdicts``."""
    return EffectPlan(
        width=9,
        height=9,
        azimuth_deg=200.0,
        elevation_deg=elevation,
        effects=[planned(name, verdicts.get(name, "run")) for name in get_args(EffectName)],
        left_out_codes=0.0,
        left_out_sun_deg=0.0,
        reach_m=0.0,
        sky_reach_m=0.0,
        estimated="skip estimated" in verdicts.values(),
    )


def skipped(*names: str) -> EffectPlan:
    return plan(dict.fromkeys(names, "skip proven"))


ALL = tuple(name for name in get_args(EffectName) if planned(name, "run"))


def test_what_runs_stays() -> None:
    asked = settings(**EVERYTHING)
    assert settings_for(skipped(), asked) == asked


def test_what_is_left_out_is_switched_off_and_noted() -> None:
    asked = settings(**EVERYTHING)
    chosen = settings_for(skipped(*ALL), asked)
    assert (chosen.shadows, chosen.sky, chosen.open_sky, chosen.bounce, chosen.curvature, chosen.refraction) == (
        "none",
        0,
        True,
        False,
        False,
        False,
    )
    # What is part of something that is gone as a whole is not counted twice.
    assert [one.effect for one in chosen.left_out] == ["shadow", "penumbra", "sky", "bounce", "sun_direction", "refraction_sun"]
    assert {one.bound for one in chosen.left_out} == {0.125}
    assert {one.effect: one.unit for one in chosen.left_out}["sun_direction"] == "degrees of sun"
    assert not any(one.estimated for one in chosen.left_out)
    assert saved_s(skipped(*ALL), chosen) == dict.fromkeys([one.effect for one in chosen.left_out], 2.0)
    untouched = {name for name in LightSettings.model_fields if getattr(asked, name) == getattr(chosen, name)}
    assert set(LightSettings.model_fields) - untouched == {
        "shadows", "sky", "open_sky", "bounce", "curvature", "refraction", "left_out"
    }  # fmt: skip


def test_a_disc_without_soft_edges_is_a_point() -> None:
    chosen = settings_for(skipped("penumbra"), settings(shadows="soft"))
    assert chosen.shadows == "hard"
    assert [one.effect for one in chosen.left_out] == ["penumbra"]
    assert settings_for(skipped("penumbra"), settings(shadows="certified")).shadows == "certified"
    assert settings_for(skipped("shadow"), settings(shadows="soft")).shadows == "soft", "edges alone are of no use"


def test_horizons_are_kept_for_what_the_ground_reflects() -> None:
    chosen = settings_for(skipped("sky", "curvature_shadow", "curvature_sky", "sun_direction"), settings(sky=8, bounce=True))
    assert (chosen.sky, chosen.open_sky, chosen.bounce, chosen.curvature) == (8, False, True, True)
    assert chosen.left_out == ()


def test_estimates_are_marked() -> None:
    chosen = settings_for(plan({"sky": "skip estimated", "bounce": "skip estimated"}), settings(sky=8, bounce=True))
    assert {one.effect: one.estimated for one in chosen.left_out} == {"sky": True, "bounce": True}


@pytest.mark.parametrize(("elevation", "curved"), [(30.0, False), (0.3, True), (0.0, True), (-5.0, True)])
def test_a_sun_at_the_horizon_keeps_the_globe(elevation: float, curved: bool) -> None:
    """Beyond the map the horizon of a globe lies lower than that of a plane, which no bound is about."""
    low = plan(dict.fromkeys(("curvature_shadow", "curvature_sky", "sun_direction"), "skip proven"), elevation)
    assert settings_for(low, settings(shadows="soft")).curvature == curved


asked_settings = st.builds(
    settings,
    shadows=st.sampled_from(["none", "hard", "certified", "soft"]),
    sky=st.sampled_from([0, 4, 16]),
    bounce=st.booleans(),
    curvature=st.booleans(),
    refraction=st.booleans(),
)


@given(asked_settings, st.dictionaries(st.sampled_from(ALL), st.sampled_from(SKIP)))
def test_a_plan_only_takes_away(asked: LightSettings, verdicts: dict[str, Verdict]) -> None:
    """Nothing that was not asked for is simulated, nothing that runs is missing, and planning again changes nothing."""
    made = plan(verdicts)
    chosen = settings_for(made, asked)
    ranks = {"none": 0, "hard": 1, "certified": 1, "soft": 2}
    assert ranks[chosen.shadows] <= ranks[asked.shadows]
    for name in ("sky", "bounce", "curvature", "refraction"):
        assert getattr(chosen, name) in (getattr(asked, name), 0)
    runs = {one.effect: one.runs for one in made.effects}
    assert not (runs["shadow"] and asked.shadows != "none" and chosen.shadows == "none")
    assert not (runs["penumbra"] and asked.shadows == "soft" != chosen.shadows)
    assert not (runs["sky"] and asked.sky and not chosen.sky)
    assert not (runs["bounce"] and asked.bounce and not chosen.bounce)
    assert chosen.open_sky == (asked.sky > 0 and not chosen.sky), "the sky's light is never left out, only what hides it"
    assert all(not runs[one.effect] for one in made.effects if one.effect in {gone.effect for gone in chosen.left_out})
    assert settings_for(made, chosen).model_copy(update={"left_out": chosen.left_out}) == chosen


def test_settings_are_a_scene() -> None:
    """What is not asked for is off, so that it takes nothing of the tolerance."""
    for shadows, sky, bounce in product(("none", "hard", "soft"), (0, 8), (False, True)):
        asked = settings(shadows=shadows, sky=sky, bounce=bounce, share=0.2, albedo=0.4)
        scene = scene_of(asked, 0.5)
        assert scene.tolerance.codes == 0.5
        assert not scene.tolerance.estimates
        assert (scene.sun.radius_deg > 0) == (shadows == "soft")
        assert scene.sky.share == (0.2 if sky else 0.0)
        assert scene.ground.albedo == (0.4 if bounce else 0.0)
        off = {name for name in ("shadow", "penumbra", "sky", "bounce") if getattr(scene.effects, name) == "off"}
        expected = {"shadow": shadows != "none", "penumbra": shadows == "soft", "sky": sky > 0, "bounce": bounce}
        assert off == {name for name, wanted in expected.items() if not wanted}
        again = settings_of(scene, settings(share=0.2, albedo=0.4))
        assert again == asked


def test_a_scene_decides_what_is_asked_for() -> None:
    text = {"sun": {"azimuth_deg": 10, "elevation_deg": 20, "radius_deg": 0.3}, "sky": {"azimuths": 32, "share": 0.1}}
    scene = Scene.model_validate(text)
    asked = settings_of(scene, settings(codec="exr:half"))
    assert (asked.azimuth_deg, asked.elevation_deg, asked.shadows, asked.radius_deg) == (10, 20, "soft", 0.3)
    assert (asked.sky, asked.share, asked.bounce, asked.albedo, asked.curvature, asked.refraction) == (32, 0.1, True, 0.3, True, True)
    assert asked.codec == "exr:half"
    without = Scene.model_validate({**text, "effects": {"penumbra": "off", "sky": "off", "bounce": "off"}})
    hard = settings_of(without, settings())
    assert (hard.shadows, hard.sky, hard.open_sky, hard.bounce) == ("hard", 0, True, False)
    point = Scene.model_validate({"sun": {"azimuth_deg": 1, "elevation_deg": 2, "radius_deg": 0}, "sky": {"share": 0}})
    assert settings_of(point, settings(shadows="certified")).shadows == "certified"
    assert (settings_of(point, settings()).sky, settings_of(point, settings()).open_sky) == (0, False)


@pytest.mark.parametrize(
    ("part", "says"),
    [
        ({"ground": {"radius_m": 3.39e6}}, "ground.radius_m: light is simulated on the Earth"),
        ({"air": {"refraction": 0.2}}, "air.refraction"),
    ],
)
def test_scenes_that_light_cannot_be_simulated_for(part: dict[str, Any], says: str) -> None:
    scene = Scene.model_validate({"sun": {"azimuth_deg": 10, "elevation_deg": 20}, **part})
    with pytest.raises(UsageError, match=says):
        settings_of(scene, settings())


@pytest.mark.parametrize("codes", [0.0, -1.0, 256.0, float("nan"), float("inf")])
def test_what_is_no_tolerance(codes: float) -> None:
    with pytest.raises(UsageError, match="codes of light are more than 0, up to 255"):
        scene_of(settings(), codes)


def test_too_few_azimuths() -> None:
    with pytest.raises(UsageError, match="needs at least 4 azimuths"):
        scene_of(settings(sky=3), 1.0)
