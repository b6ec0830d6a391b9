"""Which effects ``clipmap light`` simulates: what options and a scene ask for, and what a plan leaves of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import click
from click.core import ParameterSource

from cli.light_text import left_out_texts
from cli.output import emit_json
from cli.plan_text import duration, show_estimate
from cli.progress import progress_bar
from schemas.errors import UsageError
from schemas.scene import Scene
from schemas.settings import LightSettings

if TYPE_CHECKING:
    from schemas.effects import EffectPlan
    from tiler.building.lightplan import EffectChoice

_DECIDED: Final = {
    "suns": "--sun",
    "times": "--when",
    "soft": "--soft or --hard",
    "no_shadows": "--no-shadows",
    "sky": "--sky",
    "share": "--share",
    "bounce": "--bounce",
    "albedo": "--albedo",
    "curvature": "--curvature or --no-curvature",
    "refraction": "--refraction or --no-refraction",
    "tolerance": "--tolerance",
}
"""Options for which a scene has fields, by their parameters."""
DEFAULT_CODES: Final = 1.0
_WORTH_S: Final = 1e-3
"""Less is not worth a word."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """One layer of light: everything that is asked for, and the scene by which it is planned, None if all of it is simulated."""

    settings: LightSettings
    scene: Scene | None


def refuse_contradictions(context: click.Context, scene: Scene | None, effects: str) -> None:
    """Raise UsageError if an option was given that says what a scene says, or a tolerance where nothing is planned."""
    given = {name for name in _DECIDED if context.get_parameter_source(name) is ParameterSource.COMMANDLINE}
    if scene is None:
        if "tolerance" in given and effects == "all":
            raise UsageError("--tolerance is what --effects auto may leave out; add --effects auto, or leave it out")
        return
    if given:
        option = next(words for name, words in _DECIDED.items() if name in given)
        raise UsageError(f"{option}: the scene says that; leave it out, or change the scene")
    if context.params.get("certified") and scene.sun.radius_deg > 0 and scene.effects.penumbra != "off":
        raise UsageError("--certified is for the shadows of a point; the scene's sun is a disc, which sun.radius_deg = 0 changes")


def sun_of(scene: Scene) -> dict[str, Any]:
    """Return the sun of a scene as fields of LightSettings."""
    return {"azimuth_deg": scene.sun.azimuth_deg, "elevation_deg": scene.sun.elevation_deg, "when": scene.sun.when}


def wanted_of(settings: LightSettings, scene: Scene | None, effects: str, codes: float | None) -> Wanted:
    """Return what is asked for by ``settings``, or by a ``scene`` where it says something; raises UsageError."""
    if scene is None and effects == "all":
        # The planner takes a fifth of a second to load.
        return Wanted(settings, None)
    from tiler.building.lightplan import scene_of, settings_of

    if scene is not None:
        return Wanted(settings_of(scene, settings), scene if effects == "auto" else None)
    return Wanted(settings, scene_of(settings, DEFAULT_CODES if codes is None else codes))


def choice_pairs(choice: "EffectChoice") -> list[tuple[str, str]]:
    """Return lines on what was left out, why, and what that saves."""
    from tiler.building.lightplan import saved_s

    if choice.plan is None or choice.chosen is None:
        return []
    saved = saved_s(choice.plan, choice.chosen)
    texts = zip(choice.chosen.left_out, left_out_texts(choice.chosen.left_out), strict=True)
    lines = [text + (f"; saves about {_brief(saved[one.effect])}" if saved[one.effect] >= _WORTH_S else "") for one, text in texts]
    if choice.keeps_more:
        lines.append("more could be: the layer that is there has effects that are not called for; --overwrite builds it without them")
    elif not lines:
        lines.append("nothing: none of the effects is proved to be too small to be seen")
    return [("left out" if number == 0 else "", line) for number, line in enumerate(lines)]


def _asked(plan: "EffectPlan") -> "EffectPlan":
    """Return a plan without what is no matter of a bake, or is not asked for."""
    return plan.model_copy(update={"effects": [one for one in plan.effects if one.stage == "bake" and one.verdict != "forced off"]})


def _brief(seconds: float) -> str:
    return duration(seconds) if seconds >= 1 else f"{1000 * seconds:.3g} ms"


def choice_json(choice: "EffectChoice") -> dict[str, Any]:
    """Return the plan and what it saves, for JSON."""
    from tiler.building.lightplan import saved_s

    if choice.plan is None or choice.chosen is None:
        return {}
    return {"effects": {"plan": choice.plan.model_dump(mode="json"), "saved_s": saved_s(choice.plan, choice.chosen)}}


def show_light_plan(dataset: str, wanted: Sequence[Wanted], as_json: bool) -> None:
    """Print which effects every layer calls for, and what its build would make and take; nothing is written at ``dataset``."""
    from cli.effects_text import show_effects
    from tiler.building.lightplan import EffectChoice
    from tiler.estimate.light import estimate_light

    documents = []
    for number, one in enumerate(wanted):
        with progress_bar("rows of blocks") as on_progress:
            choice = None if one.scene is None else EffectChoice(one.scene, on_progress)
            estimate = estimate_light(dataset, one.settings, choice)
        if as_json:
            documents.append((choice_json(choice) if choice else {}) | {"build": estimate.model_dump(mode="json")})
            continue
        if number:
            click.echo()
        if choice is not None and choice.plan is not None:
            show_effects(_asked(choice.plan))
            click.echo()
        show_estimate(estimate, choice_pairs(choice) if choice else [])
    if as_json:
        emit_json({"dataset": dataset, "layers": documents})
