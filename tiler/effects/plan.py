"""Verdicts: which effects a scene calls for on a map.

Effects are left out while the sum of their bounds stays within the tolerance, the smallest bounds first, those on which others depend
before these. What is then still simulated may be left out by an estimate, which is marked. What the viewer does is decided one by one.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.effects import EffectName, EffectPlan, PlannedEffect, Verdict
from schemas.errors import UsageError
from schemas.scene import Scene
from schemas.viewbounds import linear_codes
from tiler.effects.candidates import Candidate, MapBounds, PyramidFacts, map_bounds
from tiler.effects.costs import cost_s
from tiler.effects.estimate import Estimates, estimate_effects
from tiler.effects.statistics import HeightStatistics

_FIRST: Final[tuple[EffectName, ...]] = ("shadow", "penumbra", "sky", "bounce")
_THEN: Final[tuple[EffectName, ...]] = ("curvature_sky", "far_occluders", "curvature_shadow", "refraction_sun", "sun_direction")
_PART_OF: Final[dict[EffectName, EffectName]] = {
    "curvature_sky": "sky",
    "far_occluders": "sky",
    "curvature_shadow": "shadow",
    "refraction_path": "curvature_shadow",
}
"""Effects that are nothing without another; of soft shadows the penumbra is a part as well."""
_ESTIMATED: Final[tuple[EffectName, ...]] = ("sky", "bounce")
"""What may be left out by an estimate. Shadows may not: one sample that stands out, which no coarse level has, shades others entirely."""
_FREE_SHARE: Final = 1 / 8
"""Part of the tolerance that an effect which costs nothing may take: it is better spent on one that does."""
_NEARLY: Final = 1 - 1e-6
"""Part of the tolerance that is used; the rest is for rounding."""


@dataclass(slots=True)
class _Ledger:
    """What is left of the tolerances of a bake."""

    codes: float
    sun_deg: float
    left_out_codes: float = 0.0
    left_out_sun_deg: float = 0.0
    verdicts: dict[EffectName, tuple[Verdict, str]] = field(default_factory=dict)

    def leave_out(self, one: Candidate, part: float) -> bool:
        """Book an effect as left out if its bound still fits into a ``part`` of what is left."""
        if one.codes > self.codes * part * _NEARLY or one.sun_deg > self.sun_deg * _NEARLY:
            return False
        self.codes -= one.codes
        self.sun_deg -= one.sun_deg
        self.left_out_codes += one.codes
        self.left_out_sun_deg += one.sun_deg
        return True


def plan_effects(scene: Scene, found: HeightStatistics, facts: PyramidFacts | None = None) -> EffectPlan:
    """Return which effects ``scene`` calls for on the map that ``found`` describes.

    ``facts`` is what is known of coarser levels and of imagery; what is unknown is simulated. Raises UsageError if the statistics were
    measured for another sun, InputError if the scene's sun is only known as a time.
    """
    if scene.sun.direction_deg != found.sun_deg:
        raise UsageError(
            f"the heights were measured for a sun at {found.sun_deg} degrees, not {scene.sun.direction_deg}; measure them again"
        )
    known = facts or PyramidFacts()
    tolerance = _linear(scene, scene.tolerance.codes)
    soft = scene.sun.radius_deg > 0 and scene.effects.penumbra != "off"
    limits = map_bounds(scene, found, known, soft, tolerance * _FREE_SHARE / 2)
    ledger, estimates = _decide(scene, limits, soft, tolerance), None
    if scene.tolerance.estimates and any(ledger.verdicts[name][0] == "run" for name in _ESTIMATED):
        estimates = estimate_effects(scene, found)
        _leave_out_by(estimates, ledger)
    planned = [_planned(scene, found, one, ledger, limits, estimates) for one in limits.bake.values()]
    planned += [_viewed(scene, found, one) for one in limits.view.values()]
    sky_runs = ledger.verdicts["sky"][0] in ("run", "forced on")
    shadow_runs = ledger.verdicts["shadow"][0] in ("run", "forced on")
    return EffectPlan(
        width=found.width,
        height=found.height,
        azimuth_deg=found.sun_deg[0],
        elevation_deg=found.sun_deg[1],
        effects=planned,
        left_out_codes=ledger.left_out_codes,
        left_out_sun_deg=ledger.left_out_sun_deg,
        reach_m=limits.reach_m if shadow_runs else 0.0,
        sky_reach_m=_sky_reach_m(found, limits, ledger) if sky_runs else 0.0,
        estimated=any(verdict == "skip estimated" for verdict, _ in ledger.verdicts.values()),
    )


def tiles_to_run(scene: Scene, found: HeightStatistics, plan: EffectPlan) -> dict[EffectName, NDArray[np.bool_]]:
    """Return, per effect that is simulated and bounded tile by tile, in which of ``found.tiles`` (rows, columns) it has to be.

    Elsewhere all such effects together change less than what ``plan`` left of the tolerance.
    """
    soft = plan.effect("penumbra").runs
    limits = map_bounds(scene, found, PyramidFacts(), soft, 0.0)
    budget = _budget(scene, limits, _linear(scene, scene.tolerance.codes)) - plan.left_out_codes
    running = {name: one for name, one in limits.bake.items() if one.tiles is not None and plan.effect(name).runs}
    allowed = _allowed(running, budget)
    return {name: _needed(one, allowed) for name, one in running.items()}


def _linear(scene: Scene, codes: float) -> float:
    """Return a tolerance as codes of light."""
    return linear_codes(codes) if scene.tolerance.transfer == "srgb" else codes


def _budget(scene: Scene, limits: MapBounds, tolerance: float) -> float:
    """Return what direct light may lack, so that this and its reflection stay within ``tolerance``."""
    return tolerance / (1 + scene.ground.albedo * min(1.0, limits.ground_seen))


def _allowed(running: Collection[EffectName], left: float) -> float:
    """Return what each of the effects that run may lack in a tile; sunlight is either proved whole or not."""
    return left / max(1, len({"sky", "bounce"} & set(running)))


def _needed(one: Candidate, allowed: float) -> NDArray[np.bool_]:
    """Return the tiles in which an effect has to be simulated, one for all if its bound is the same everywhere."""
    if one.tiles is None:
        return np.ones((1, 1), np.bool_)
    return np.asarray(one.tiles > (0.0 if one.effect in ("shadow", "penumbra") else allowed), np.bool_)


def _sky_reach_m(found: HeightStatistics, limits: MapBounds, ledger: _Ledger) -> float:
    return limits.sky_reach_m if ledger.verdicts["far_occluders"][0] == "skip proven" else found.diagonal_m


def _decide(scene: Scene, limits: MapBounds, soft: bool, tolerance: float) -> _Ledger:
    """Return the verdicts on all effects of a bake, by proof."""
    ledger = _Ledger(_budget(scene, limits, tolerance), scene.tolerance.sun_deg)
    parts: dict[EffectName, EffectName] = {**_PART_OF, "penumbra": "shadow"} if soft else _PART_OF
    for group in (_FIRST, _THEN, ("refraction_path",)):
        # An effect that is part of another comes right after it.
        ordered = sorted((limits.bake[name] for name in group), key=lambda one: limits.bake[_together(one.effect, parts)].codes)
        for one in ordered:
            ledger.verdicts[one.effect] = _by_proof(scene, one, ledger, parts.get(one.effect))
    if ledger.verdicts["penumbra"][0] == "forced on" and ledger.verdicts["shadow"][0] == "skip proven":
        ledger.verdicts["shadow"] = ("run", "soft edges are part of shadows")
    return ledger


def _together(effect: EffectName, parts: dict[EffectName, EffectName]) -> EffectName:
    """Return the effect of the first group whose turn it is when that of ``effect`` comes."""
    return parts.get(effect, effect) if effect in _FIRST else effect


def _leave_out_by(estimates: Estimates | None, ledger: _Ledger) -> None:
    """Leave out what estimates allow."""
    left = ledger.codes
    for name in _ESTIMATED:
        if estimates is None or ledger.verdicts[name][0] != "run":
            continue
        estimate = float(getattr(estimates, name))
        if estimate <= left * _NEARLY:
            left -= estimate
            ledger.verdicts[name] = ("skip estimated", "no proof")


def _by_proof(scene: Scene, one: Candidate, ledger: _Ledger, whole: EffectName | None) -> tuple[Verdict, str]:
    """Return the verdict on an effect that may be part of another, and why if its bound does not say it."""
    choice = getattr(scene.effects, one.effect)
    if choice != "auto":
        return ("forced on", "the scene says so") if choice == "on" else ("forced off", "the scene says so, whatever it changes")
    if whole is not None and ledger.verdicts[whole][0] in ("skip proven", "forced off"):
        return "skip proven", f"nothing without {whole}, and counted there"
    spare = _FREE_SHARE if cost_s(one.effect, 1, 1) == 0 else 1.0
    return ("skip proven", "") if ledger.leave_out(one, spare) else ("run", "")


def _planned(
    scene: Scene, found: HeightStatistics, one: Candidate, ledger: _Ledger, limits: MapBounds, estimates: Estimates | None
) -> PlannedEffect:
    verdict, remark = ledger.verdicts[one.effect]
    runs = verdict in ("run", "forced on")
    running = [name for name, (other, _) in ledger.verdicts.items() if other in ("run", "forced on")]
    share = float(_needed(one, _allowed(running, ledger.codes)).mean()) if runs else 0.0
    if verdict == "forced on":
        share = 1.0
    cost = cost_s(one.effect, found.samples, scene.sky.azimuths)
    in_codes = one.unit == "codes"
    return PlannedEffect(
        effect=one.effect,
        stage="bake",
        verdict=verdict,
        bound=one.bound,
        unit=one.unit,
        tolerance=_budget(scene, limits, _linear(scene, scene.tolerance.codes)) if in_codes else scene.tolerance.sun_deg,
        estimate=getattr(estimates, one.effect, None),
        statistic=one.statistic,
        formula=one.formula,
        anchor=one.anchor,
        share=share,
        cost_s=cost,
        saved_s=cost * (1 - share),
        remark=remark,
    )


def _viewed(scene: Scene, found: HeightStatistics, one: Candidate) -> PlannedEffect:
    """Return the verdict on an effect of the viewer, by itself."""
    tolerance = _linear(scene, scene.tolerance.codes) if one.unit == "codes" else scene.tolerance.pixels
    choice = getattr(scene.effects, one.effect)
    verdict: Verdict = "skip proven" if one.bound is not None and one.bound <= tolerance * _NEARLY else "run"
    if choice != "auto":
        verdict = "forced on" if choice == "on" else "forced off"
    runs = verdict in ("run", "forced on")
    cost = cost_s(one.effect, found.samples, scene.sky.azimuths)
    return PlannedEffect(
        effect=one.effect,
        stage="view",
        verdict=verdict,
        bound=one.bound,
        unit=one.unit,
        tolerance=tolerance,
        estimate=None,
        statistic=one.statistic,
        formula=one.formula,
        anchor=one.anchor,
        share=float(runs),
        cost_s=cost,
        saved_s=0.0 if runs else cost,
        remark="" if choice == "auto" else "the scene says so",
    )
