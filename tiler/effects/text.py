"""A plan in words: rows of text, which the command line puts into columns."""

from schemas.effects import EffectPlan, PlannedEffect

HEADER = ("effect", "verdict", "at most", "allowed", "estimate", "measured", "formula", "saves")

_UNITS = {"codes": "codes", "pixels": "px", "degrees of sun": "deg"}


def plan_rows(plan: EffectPlan) -> list[tuple[str, ...]]:
    """Return one row of text per effect, in the order of ``HEADER``."""
    return [_row(one) for one in plan.effects]


def plan_sentences(plan: EffectPlan) -> list[str]:
    """Return what is to be said below the rows."""
    total = sum(one.cost_s for one in plan.effects)
    saved = sum(one.saved_s for one in plan.effects)
    said = [
        f"Left out of the bake by proof: at most {plan.left_out_codes:.3g} codes of light"
        + (f" and {plan.left_out_sun_deg:.3g} degrees of the sun's direction" if plan.left_out_sun_deg else "")
        + f", reflections of it aside. Saves about {_time(saved)} of {_time(total)} on one core."
    ]
    if plan.estimated:
        said.append("Some effects are left out by an estimate on a coarse level, not by proof; tolerance.estimates = false simulates them.")
    if plan.reach_m:
        said.append(f"Nothing further than {plan.reach_m:.4g} m away shades anything.")
    said += [f"{one.effect}: {one.remark}." for one in plan.effects if one.remark]
    return said


def _row(one: PlannedEffect) -> tuple[str, ...]:
    unit = _UNITS[one.unit]
    share = f"run in {100 * one.share:.3g} %" if one.verdict == "run" and one.share < 1 else one.verdict
    return (
        one.effect.replace("_", " "),
        share,
        "unknown" if one.bound is None else f"{one.bound:.3g} {unit}",
        f"{one.tolerance:.3g} {unit}",
        "" if one.estimate is None else f"{one.estimate:.3g} {unit}",
        one.statistic,
        one.formula,
        _time(one.saved_s) if one.saved_s else "",
    )


def _time(seconds: float) -> str:
    """Return a time for people."""
    if seconds >= 120:
        return f"{seconds / 60:.3g} min"
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1000 * seconds:.3g} ms"
