"""Scenes: what may be said, in TOML and JSON, and what is refused in one sentence."""

import json
import math
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from schemas.effects import EffectName
from schemas.errors import InputError
from schemas.scene import Air, Effects, Ground, Scene, Sky, Sun, Tolerance, Viewer, parse_scene

TOML = """
[sun]
azimuth_deg = 270
elevation_deg = 10
[tolerance]
codes = 0.5
transfer = "srgb"
[effects]
sky = "off"
"""


def test_toml_and_json_say_the_same() -> None:
    scene = parse_scene(TOML, "evening.toml")
    assert scene.sun.direction_deg == (270.0, 10.0)
    assert (scene.tolerance.codes, scene.tolerance.transfer, scene.effects.sky, scene.effects.shadow) == (0.5, "srgb", "off", "auto")
    assert parse_scene(scene.model_dump_json(), "evening.JSON") == scene


def test_a_sun_by_time() -> None:
    scene = parse_scene("[sun]\nwhen = 2026-06-21T05:00:00Z\n", "dawn.toml")
    with pytest.raises(InputError, match="not known yet"):
        _ = scene.sun.direction_deg
    assert scene.with_sun(60.0, 1.5).sun.direction_deg == (60.0, 1.5)
    assert scene.with_sun(60.0, 1.5).sun.radius_deg == scene.sun.radius_deg


@given(st.floats(-1e6, 1e6))
def test_azimuths_are_within_a_turn(azimuth: float) -> None:
    found = Sun(azimuth_deg=azimuth, elevation_deg=0).azimuth_deg
    assert found is not None
    assert 0 <= found < 360
    assert math.isclose(math.cos(math.radians(found)), math.cos(math.radians(azimuth)), abs_tol=1e-6)


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        (TOML, "evening.yaml", "ends in .toml or .json"),
        ("[sun", "a.toml", "not valid TOML"),
        ("{", "a.json", "not valid JSON"),
        ("[" * 100_000, "a.json", "not valid JSON"),
        ("[]", "a.json", "the scene"),
        ("", "a.toml", "sun"),
        ("[sun]\nazimuth_deg = 1\n", "a.toml", "must be given"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 2\nwhen = 2026-06-21T05:00:00Z\n", "a.toml", "not both"),
        ("[sun]\nwhen = 2026-06-21T05:00:00\n", "a.toml", "offset from UTC"),
        ("[sun]\nazimuth_deg = nan\nelevation_deg = 2\n", "a.toml", "sun.azimuth_deg"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 91\n", "a.toml", "sun.elevation_deg"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 1\n[efects]\n", "a.toml", "efects"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 1\n[effects]\nsky = true\n", "a.toml", "effects.sky"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 1\n[ground]\nalbedo = 1\n", "a.toml", "ground.albedo"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 1\n[sky]\nazimuths = 0\n", "a.toml", "sky.azimuths"),
        ("[sun]\nazimuth_deg = 1\nelevation_deg = 1\n[tolerance]\ncodes = 0\n", "a.toml", "tolerance.codes"),
    ],
)
def test_nonsense_is_refused_in_one_sentence(text: str, name: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        parse_scene(text, name)
    assert str(caught.value).startswith(f"{name}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", [Sun, Sky, Ground, Air, Viewer, Tolerance, Effects, Scene])
def test_every_field_says_what_it_means(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        assert field.description or name == "sun", f"{model.__name__}.{name} has no description"


def test_every_effect_can_be_chosen() -> None:
    assert set(get_args(EffectName)) == set(Effects.model_fields)


def test_a_scene_has_a_schema() -> None:
    schema: dict[str, Any] = json.loads(json.dumps(Scene.model_json_schema()))
    assert set(schema["required"]) == {"sun"}
