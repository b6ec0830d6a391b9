"""Which effects a scene calls for and why: the document that a plan of effects is."""

from typing import Literal

from pydantic import Field

from schemas.model import Model

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


class ProvedEffect(Model):
    """One effect of a bake, baked with and without: what it changes, beside what it can."""

    effect: EffectName
    verdict: Verdict
    unit: Unit = Field(description="Unit of bound and actual")
    bound: float | None = Field(ge=0, description="The most it can change anywhere, by the plan")
    actual: float = Field(ge=0, description="The most it changes on the samples that were baked, reflections of it aside")
    holds: bool = Field(description="Whether it changes no more than its bound, up to the rounding of a bake")


class EffectProof(Model):
    """A plan put to the proof: all effects that are baked, with and without, on a window of the map."""

    plan: EffectPlan
    x0: int = Field(ge=0, description="First column of the window [samples]")
    y0: int = Field(ge=0, description="First row of the window [samples]")
    width: int = Field(ge=1, description="Columns of the window [samples]")
    height: int = Field(ge=1, description="Rows of the window [samples]")
    effects: list[ProvedEffect]
    view: list[ProvedEffect] = Field(default=[], description="Effects of the viewer, as far as they can be told on the window")
    difference_codes: float = Field(
        ge=0, description="Largest difference of the window's picture with all effects to that by the plan [codes of the scene's transfer]"
    )
    allowed_codes: float = Field(gt=0, description="The scene's tolerance [codes]")
    samples_over: int = Field(ge=0, description="Samples whose difference is more than the tolerance")
    turned_deg: float = Field(ge=0, description="By how much what is left out turns the sun where shadows are hard, together [degrees]")
    allowed_deg: float = Field(gt=0, description="The scene's tolerance of that [degrees]")
    holds: bool = Field(description="Whether every bound holds, and the picture and the sun are within the tolerance")

    def with_view(self, view: list[ProvedEffect]) -> "EffectProof":
        """Return the proof with that of the viewer's effects."""
        return self.model_copy(update={"view": view, "holds": self.holds and all(one.holds for one in view)})
