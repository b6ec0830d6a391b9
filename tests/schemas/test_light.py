"""What a manifest must say of layers of light and of normals, and what it leaves out so that older datasets keep their version."""

import json

import pytest
from pydantic import ValidationError

from schemas.light import Light, Normals
from schemas.manifest import Manifest, parse_manifest
from tests.schemas.sample_manifest import GENERATOR, WORLD, make_layer

NORMALS = Normals(height="height", density=2, zero=127, one=127, up_deg=0.5, voids=3)
LIGHT = Light(
    height="height",
    azimuth_deg=270,
    elevation_deg=10,
    grid_azimuth_deg=270,
    when=None,
    shadows="hard",
    lines=1,
    radius_deg=None,
    sky_azimuths=0,
    sky_share=0,
    albedo=0,
    radius_m=None,
    refraction=0,
    voids=0,
)


@pytest.mark.parametrize(
    ("kind", "channels", "alpha", "normals"),
    [("normal", 3, True, None), ("imagery", 3, True, NORMALS), ("normal", 2, True, NORMALS), ("normal", 3, False, NORMALS)],
)
def test_normals_are_two_channels_whose_codes_are_told(kind: str, channels: int, alpha: bool, normals: Normals | None) -> None:
    with pytest.raises(ValidationError, match="'normal'"):
        make_layer(kind, 9, 9, channels=channels, alpha=alpha, normals=normals)  # type: ignore[arg-type]


def test_a_layer_of_normals_is_read_as_it_was_written() -> None:
    for channels, alpha in ((2, False), (3, True)):
        layers = {"normal": make_layer("normal", 9, 9, channels=channels, alpha=alpha, normals=NORMALS)}
        manifest = Manifest.create(generator=GENERATOR, world=WORLD, layers=layers)
        assert parse_manifest(manifest.to_json(), "here") == manifest


def test_what_is_not_there_is_left_out() -> None:
    """Fields that came later: a manifest without them has the digest that it had."""
    assert "normals" not in json.loads(make_layer("height", 9, 9).model_dump_json())
    assert "density" not in json.loads(LIGHT.model_dump_json())
    fine = LIGHT.model_copy(update={"density": 2})
    assert Light.model_validate_json(fine.model_dump_json()) == fine
    with pytest.raises(ValidationError, match="density"):
        Light.model_validate({**LIGHT.model_dump(), "density": 3})
