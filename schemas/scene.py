"""What a scene asks for: sun, sky, ground, air, viewer, what nobody notices, and which effects are wanted; TOML or JSON.

A field that is left out has the default of Earth on a clear day. Light is measured relative to the sun's irradiance on a surface that
faces it; a *code* is 1/255 of the brightest light there can be, sun and open sky on a surface that faces the sun.
"""

import json
import tomllib
from datetime import datetime
from typing import Final, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from schemas.errors import InputError
from schemas.settings import Settings

Choice = Literal["auto", "on", "off"]
Transfer = Literal["linear", "srgb"]

SUN_RADIUS_DEG: Final = 0.2666
"""Angular radius of the sun at its mean distance, 696 000 km over 149.6 million km [degrees]; 0.2711 in January, 0.2621 in July."""
EARTH_RADIUS_M: Final = 6_371_008.8
"""Mean radius of the WGS 84 ellipsoid, (2 a + b) / 3."""


class Sun(Settings):
    """Where the sun stands, as azimuth and elevation or as a time at the dataset's place."""

    azimuth_deg: float | None = Field(default=None, allow_inf_nan=False, description="Clockwise from north [degrees]")
    elevation_deg: float | None = Field(
        default=None, ge=-90, le=90, allow_inf_nan=False, description="Above the horizontal, of the disc's centre [degrees]"
    )
    when: datetime | None = Field(default=None, description="Time with its offset from UTC, instead of azimuth and elevation")
    radius_deg: float = Field(
        default=SUN_RADIUS_DEG,
        ge=0,
        le=5,
        allow_inf_nan=False,
        description="Angular radius of the disc; 0: a point, hard shadows [degrees]",
    )

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        angles = (self.azimuth_deg, self.elevation_deg)
        if self.when is None and None in angles:
            raise ValueError("azimuth_deg and elevation_deg, or when, must be given")
        if self.when is not None and angles != (None, None):
            raise ValueError("azimuth_deg and elevation_deg, or when, must be given, not both")
        if self.when is not None and self.when.tzinfo is None:
            raise ValueError("when must have an offset from UTC, e.g. 2026-06-21T05:00:00Z")
        return self

    @field_validator("azimuth_deg")
    @classmethod
    def _within_a_turn(cls, azimuth: float | None) -> float | None:
        # A remainder just below 0 rounds to 360 itself.
        return None if azimuth is None else azimuth % 360.0 % 360.0

    @property
    def direction_deg(self) -> tuple[float, float]:
        """Azimuth and elevation [degrees]; raises InputError if only a time is known."""
        if self.azimuth_deg is None or self.elevation_deg is None:
            raise InputError(f"the sun's place at {self.when} is not known yet; give azimuth_deg and elevation_deg")
        return self.azimuth_deg, self.elevation_deg


class Sky(Settings):
    """The sky: even light from above the horizontal."""

    share: float = Field(
        default=0.15,
        ge=0,
        le=10,
        allow_inf_nan=False,
        description="Irradiance of the open sky, relative to that of the sun on a facing surface",
    )
    azimuths: int = Field(default=16, ge=4, le=360, description="Directions in which horizons are looked for")


class Ground(Settings):
    """What the ground reflects, and how it is curved."""

    albedo: float = Field(default=0.3, ge=0, lt=1, allow_inf_nan=False, description="Share of the light that is reflected")
    radius_m: float = Field(default=EARTH_RADIUS_M, gt=1, le=1e12, allow_inf_nan=False, description="Radius of the globe [m]")


class Air(Settings):
    """What the air does to light."""

    refraction: float = Field(
        default=0.13, ge=0, le=0.9, allow_inf_nan=False, description="Curvature of a level ray relative to that of the globe"
    )
    visibility_m: float = Field(
        default=50_000.0,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="Distance at which a black object has 2 % contrast against the haze [m]",
    )


class Viewer(Settings):
    """The camera that will look at it."""

    width_px: int = Field(default=1920, ge=1, le=1 << 16, description="Width of the picture [pixels]")
    height_px: int = Field(default=1080, ge=1, le=1 << 16, description="Height of the picture [pixels]")
    fov_deg: float = Field(default=60.0, gt=0, lt=179, allow_inf_nan=False, description="Horizontal field of view [degrees]")
    grid: int = Field(default=255, ge=15, le=1023, description="Vertices along a side of a level's grid")
    clearance_m: float = Field(
        default=100.0, gt=0, le=1e9, allow_inf_nan=False, description="Least distance between the camera and the ground [m]"
    )
    detail_octaves: int = Field(default=4, ge=0, le=16, description="Octaves of synthetic detail below the data")
    largest_deviate: float = Field(
        default=4.0, gt=0, le=100, allow_inf_nan=False, description="Largest entry of the noise table, in standard deviations"
    )


class Tolerance(Settings):
    """What nobody notices, for everything that is left out together."""

    codes: float = Field(default=1.0, gt=0, le=255, allow_inf_nan=False, description="Difference of light [codes, of 255]")
    pixels: float = Field(default=0.5, gt=0, le=1e4, allow_inf_nan=False, description="Shift on the screen, for each effect [pixels]")
    sun_deg: float = Field(
        default=0.02, gt=0, le=90, allow_inf_nan=False, description="Error of the sun's direction where its shadows are hard [degrees]"
    )
    transfer: Transfer = Field(default="linear", description="Whether codes are of light itself or of its sRGB encoding")
    estimates: bool = Field(
        default=False, description="Whether hidden sky and reflected light may be left out by an estimate where a proof fails"
    )


class Effects(Settings):
    """Which effects are simulated: 'auto' where the scene calls for it, 'on' and 'off' whatever it calls for."""

    shadow: Choice = Field(default="auto", description="Cast shadows")
    penumbra: Choice = Field(default="auto", description="The sun as a disc instead of a point")
    sky: Choice = Field(default="auto", description="What hides part of the sky")
    bounce: Choice = Field(default="auto", description="Light reflected once by other ground")
    curvature_shadow: Choice = Field(default="auto", description="Curvature of the globe between ground and what shades it")
    curvature_sky: Choice = Field(default="auto", description="Curvature of the globe between ground and what hides the sky")
    refraction_sun: Choice = Field(default="auto", description="The sun seen higher than it stands")
    refraction_path: Choice = Field(default="auto", description="Rays bent between ground and what shades it")
    sun_direction: Choice = Field(default="auto", description="The sun's direction of each place instead of one for the whole map")
    far_occluders: Choice = Field(default="auto", description="What hides the sky beyond a distance")
    haze: Choice = Field(default="auto", description="Light scattered between ground and camera")
    geomorph: Choice = Field(default="auto", description="Levels that blend into the next coarser one")
    synthesis: Choice = Field(default="auto", description="Synthetic detail below the data")
    normal_map: Choice = Field(default="auto", description="Normals of the finest level instead of the next coarser one's")
    curvature_view: Choice = Field(default="auto", description="Curvature of the globe between camera and ground")
    linear_filter: Choice = Field(default="auto", description="Filtering imagery as light instead of as sRGB codes")


class Scene(Settings):
    """All of it."""

    sun: Sun
    sky: Sky = Field(default=Sky(), description="The sky")
    ground: Ground = Field(default=Ground(), description="The ground")
    air: Air = Field(default=Air(), description="The air")
    viewer: Viewer = Field(default=Viewer(), description="The camera")
    tolerance: Tolerance = Field(default=Tolerance(), description="What nobody notices")
    effects: Effects = Field(default=Effects(), description="Which effects are wanted")

    def with_sun(self, azimuth_deg: float, elevation_deg: float) -> "Scene":
        """Return the scene with its sun at a place [degrees], for instance where a calculation says it is at ``sun.when``."""
        sun = Sun(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_deg=self.sun.radius_deg)
        return self.model_copy(update={"sun": sun})


def parse_scene(text: str, name: str) -> Scene:
    """Return the scene that the content of a file says; ``name`` is the file's, its suffix ``.json`` or ``.toml`` says which it is.

    Raises InputError, one sentence, if it is not valid.
    """
    suffix = name.rpartition(".")[2].lower()
    if suffix not in ("json", "toml"):
        raise InputError(f"{name}: a scene is a file that ends in .toml or .json")
    try:
        content = json.loads(text) if suffix == "json" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name}: is not valid {suffix.upper()}: {error}") from error
    try:
        return Scene.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the scene"
        raise InputError(f"{name}: {place}: {first['msg'].removeprefix('Value error, ')}") from error
