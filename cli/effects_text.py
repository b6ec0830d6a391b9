"""A plan of effects, and its proof, for people."""

import click

from cli.output import emit_pairs, emit_table
from schemas.effects import EffectPlan, EffectProof, ProvedEffect
from tiler.effects.text import HEADER, plan_rows, plan_sentences

_SHORT = ("effect", "verdict", "at most", "allowed", "estimate", "saves")
_UNITS = {"codes": "codes", "pixels": "px", "degrees of sun": "deg"}


def show_effects(plan: EffectPlan) -> None:
    """Print verdict, bound and savings of every effect, then what each bound rests on, then what is to be said of them all."""
    columns = [HEADER.index(name) for name in _SHORT]
    rows = plan_rows(plan)
    emit_pairs(
        [
            ("map", f"{plan.width} x {plan.height} samples"),
            ("sun", f"azimuth {plan.azimuth_deg:.2f}, elevation {plan.elevation_deg:.2f} degrees"),
        ]
    )
    click.echo()
    emit_table(_SHORT, [tuple(row[column] for column in columns) for row in rows], left=(0, 1))
    click.echo()
    measured = HEADER.index("measured")
    table = [(row[0], row[measured], f"#{one.anchor}") for row, one in zip(rows, plan.effects, strict=True)]
    emit_table(("effect", "measured", "bound, in docs/EFFECTS.md"), table, left=(0, 1, 2))
    click.echo()
    for sentence in plan_sentences(plan):
        click.echo(sentence)


def show_proof(proof: EffectProof) -> None:
    """Print what each effect changes beside its bound, and whether all holds."""
    rows = [
        (
            one.effect.replace("_", " "),
            one.verdict,
            f"{one.actual:.3g} {_UNITS[one.unit]}",
            "unknown" if one.bound is None else f"{one.bound:.3g} {_UNITS[one.unit]}",
            "holds" if one.holds else "BROKEN",
        )
        for one in (*proof.effects, *proof.view)
    ]
    emit_table(("effect", "verdict", "changes", "at most", "bound"), rows, left=(0, 1, 4))
    click.echo()
    place = f"{proof.width} x {proof.height} samples from column {proof.x0}, row {proof.y0}"
    click.echo(f"Baked with and without every effect: {place}.")
    click.echo(
        f"All effects and the plan's differ by {proof.difference_codes:.3g} codes at most; {proof.allowed_codes:.3g} are tolerated."
        + (f" {proof.samples_over} samples differ by more." if proof.samples_over else "")
    )
    if proof.turned_deg:
        turned = f"What is left out turns the sun by {proof.turned_deg:.3g} degrees where shadows are hard"
        click.echo(f"{turned}; {proof.allowed_deg:.3g} are tolerated.")
    click.echo(_conclusion(proof))


def _conclusion(proof: EffectProof) -> str:
    broken = [one for one in (*proof.effects, *proof.view) if not one.holds]
    if proof.holds:
        return "Every bound holds, and the picture is within the tolerance."
    if broken:
        return f"Broken: {', '.join(map(_broken, broken))}."
    if proof.plan.estimated:
        return "Every bound holds, but what was left out by an estimate is seen; --no-estimate simulates it."
    return "Every bound holds, but the picture is not within the tolerance; what the scene forces off is no part of it."


def _broken(one: ProvedEffect) -> str:
    return f"{one.effect} changes {one.actual:.6g} {one.unit}, its bound is {one.bound:.6g}"
