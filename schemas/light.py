"""What layers of light and of normals hold, and how it was found: parts of the manifest."""

from typing import Literal

from pydantic import Field

from schemas.model import Model

Density = Literal[1, 2]
"""Samples along a row or a column per height: 2 puts one between two heights."""


class LeftOut(Model):
    """One effect that was asked for, and left out as it changes less than anyone notices."""

    effect: str = Field(description="The effect, by its name in docs/EFFECTS.md")
    bound: float | None = Field(ge=0, description="The most it can change anywhere, proved; null if that has no limit")
    unit: Literal["codes", "degrees of sun"] = Field(
        description="Unit of the bound: codes of light, or an angle by which the sun is turned"
    )
    estimated: bool = Field(description="Whether it was left out by an estimate, so that its bound is above the tolerance")


class Light(Model):
    """What light a layer of kind ``light`` holds, and how it was found.

    A sample is the light on the ground relative to the brightest there can be, sun and open sky on a surface that faces the sun: the sun's
    light times the share of the sun that is seen and the cosine of its incidence, plus ``sky_share`` times the share of the sky that is
    seen, plus what the ground reflects, all over ``1 + sky_share``. Whole numbers hold its sRGB encoding, see ``filter.linear_light``.
    """

    height: str = Field(description="Name of the layer whose heights the light falls on")
    density: Density = Field(
        default=1,
        exclude_if=lambda density: density == 1,
        description="Samples of light per sample of the heights along a row or a column; of 2 every other one lies between two heights, on "
        "ground that the four-point scheme predicts. Left out if 1",
    )
    azimuth_deg: float = Field(description="The sun's azimuth at the layer's centre, clockwise from true north [degrees]")
    elevation_deg: float = Field(description="The sun's elevation there, as it was simulated [degrees]")
    grid_azimuth_deg: float = Field(description="The same azimuth, clockwise from the direction of decreasing rows [degrees]")
    when: str | None = Field(description="Time at which the sun stands there, ISO 8601; null if azimuth and elevation were given")
    shadows: Literal["none", "hard", "certified", "soft"] = Field(
        description="Cast shadows: none, those of a point, those of a point without a wrong sample, those of the sun's disc"
    )
    lines: int | None = Field(description="Lines per sample of hard shadows; null for others")
    radius_deg: float | None = Field(description="Angular radius of the sun's disc; null if it is a point [degrees]")
    sky_azimuths: int = Field(
        ge=0, description="Azimuths in which horizons were looked for; 0: none, so that only a sample's own slope hides sky from it"
    )
    sky_share: float = Field(ge=0, description="Light of the open sky, relative to that of the sun on a facing surface")
    albedo: float = Field(ge=0, lt=1, description="Share of its light that the ground reflects, once; 0: nothing")
    radius_m: float | None = Field(description="Radius of the Earth; null for a flat one [m]")
    refraction: float = Field(ge=0, lt=1, description="Curvature of a level ray relative to that of the Earth; 0: no air")
    voids: int = Field(ge=0, description="Void samples of the heights: they have no light, and shade nothing")
    left_out: list[LeftOut] = Field(
        default=[],
        exclude_if=lambda left_out: not left_out,
        description="Effects that were asked for and change less than the tolerance, so that they were not simulated; left out if empty",
    )


class Normals(Model):
    """What the two channels of a layer of kind ``normal`` are.

    The horizontal part (x, y) of the unit vector across the ground: x in the direction of increasing columns, y in that of decreasing
    rows, each ``(sample - zero) / one``; ``z = sqrt(1 - x² - y²)`` points up. On coarser levels x and y are means of those below.
    """

    height: str = Field(description="Name of the layer whose heights these are the normals of")
    density: Density = Field(description="Normals per sample of the heights along a row or a column; of 2 every other one lies between two")
    zero: int = Field(ge=0, description="Sample that means 0")
    one: int = Field(gt=0, description="By how much a sample that means 1 is greater than zero")
    up_deg: float = Field(
        description="Azimuth of the direction of decreasing rows at the layer's centre, clockwise from true north [degrees]"
    )
    voids: int = Field(ge=0, description="Void samples of the heights: they have no normal")
