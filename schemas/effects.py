"""Which effects a scene calls for and why: the document that a plan of effects is."""

from typing import Literal

from pydantic import Field

from schemas.manifest import Model

EffectName = Literal[
    "shadow",
    "penumbra",
    "sky",
    "bounce",
    "curvature_shadow",
    "curvature_sky",
    "refraction_sun",
    "refraction_path",
    "sun_direction",
    "far_occluders",
    "normal_map",
    "linear_filter",
    "haze",
    "geomorph",
    "synthesis",
    "curvature_view",
]
Verdict = Literal["skip proven", "skip estimated", "run", "forced on", "forced off"]
Unit = Literal["codes", "pixels", "degrees of sun"]
Stage = Literal["bake", "view"]


class PlannedEffect(Model):
    """One effect: whether it is simulated, and what that rests on."""

    effect: EffectName
    stage: Stage = Field(description="Whether it is simulated when light is baked, or when it is looked at")
    verdict: Verdict
    bound: float | None = Field(ge=0, description="The most it can change anywhere, proved; null if that was not measured or has no limit")
    unit: Unit = Field(description="Unit of bound, estimate and tolerance")
    tolerance: float = Field(
        ge=0, description="What may be left out: of a bake all effects together, reflections of what is missing included; of a view each"
    )
    estimate: float | None = Field(ge=0, description="What it changes on a coarse level; null if that was not asked for")
    statistic: str = Field(description="What was measured, with its value")
    formula: str = Field(description="The bound as a formula of docs/EFFECTS.md")
    anchor: str = Field(description="Heading in docs/EFFECTS.md that proves it")
    share: float = Field(ge=0, le=1, description="Share of the map's tiles that need the effect; 0 if it is not simulated")
    cost_s: float = Field(ge=0, description="Processor time it would take on the whole map, estimated [seconds]")
    saved_s: float = Field(ge=0, description="Of that, what is saved [seconds]")
    remark: str = Field(description="Why the verdict is what it is, if the bound does not say it; else empty")

    @property
    def runs(self) -> bool:
        """Whether the effect is simulated."""
        return self.verdict in ("run", "forced on")


class EffectPlan(Model):
    """All effects of a scene over one map."""

    width: int = Field(description="Columns of the map [samples]")
    height: int = Field(description="Rows of the map [samples]")
    azimuth_deg: float = Field(description="Azimuth of the sun [degrees]")
    elevation_deg: float = Field(description="Elevation of the sun [degrees]")
    effects: list[PlannedEffect]
    left_out_codes: float = Field(ge=0, description="The most that everything left out of the bake by proof changes together [codes]")
    left_out_sun_deg: float = Field(ge=0, description="The most by which it turns the sun where shadows are hard, together [degrees]")
    reach_m: float = Field(ge=0, description="Nothing further off shades anything [m]")
    sky_reach_m: float = Field(ge=0, description="What hides the sky need not be looked for further off [m]")
    estimated: bool = Field(description="Whether something is left out by an estimate, so that the sums are no proof")

    def effect(self, name: EffectName) -> PlannedEffect:
        """Return the plan of one effect; raises KeyError if it is not in the plan."""
        for planned in self.effects:
            if planned.effect == name:
                return planned
        raise KeyError(name)
