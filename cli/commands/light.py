"""``clipmap light``: the heights of a dataset under a sun become a layer of light."""

from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click
from pydantic import ValidationError

from cli.engines import open_engine
from cli.light_effects import Wanted, choice_json, choice_pairs, refuse_contradictions, show_light_plan, sun_of, wanted_of
from cli.light_text import effects_text, sun_text
from cli.options import refused
from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar
from cli.scene_file import read_scene
from schemas.errors import UsageError
from schemas.settings import LightSettings

if TYPE_CHECKING:
    from tiler.building.light import LightReport
    from tiler.building.lightplan import EffectChoice
    from tiler.tasks.engine import Engine

    Lit = tuple[LightReport, EffectChoice | None]

Sun = dict[str, Any]


def parse_suns(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> list[Sun]:
    """Return the places of suns given as ``AZ,EL``; a callback of click."""
    suns = []
    for value in values:
        try:
            azimuth, elevation = (float(part) for part in value.split(","))
        except ValueError:
            raise click.BadParameter(f"{value!r}: azimuth and elevation in degrees, separated by a comma, e.g. 270,10") from None
        suns.append({"azimuth_deg": azimuth, "elevation_deg": elevation})
    return suns


def parse_times(context: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> list[Sun]:
    """Return suns given as times in ISO 8601; a callback of click."""
    suns = []
    for value in values:
        try:
            when = datetime.fromisoformat(value)
        except ValueError:
            raise click.BadParameter(f"{value!r}: a time as of ISO 8601 with its offset, e.g. 2026-06-21T05:00:00Z") from None
        if when.tzinfo is None:
            raise click.BadParameter(f"{value!r}: add the offset from UTC, e.g. {value}Z or {value}+02:00")
        suns.append({"when": when})
    return suns


@click.command(short_help="Build a layer of light from a dataset's heights and a sun.")
@click.argument("dataset")
@click.option("--sun", "suns", metavar="AZ,EL", multiple=True, callback=parse_suns, help="The sun's azimuth from true north and elevation.")
@click.option("--when", "times", metavar="ISO8601", multiple=True, callback=parse_times, help="A time; the sun stands where it does then.")
@click.option("--layer", default="light", show_default=True, help="Name of the layer; of several suns NAME_1, NAME_2 and so on.")
@click.option("--from", "height", default="height", show_default=True, help="Layer of heights that the light falls on.")
@click.option("--twice", is_flag=True, help="At twice the heights' resolution: also between them, on predicted ground.")
@click.option("--codec", default="png", show_default=True, help="png, jpeg:Q, webp:Q, raw, exr:half or exr:float.")
@click.option("--bits", type=click.Choice(["8", "16"]), default="8", show_default=True, help="Bits of a sample of png and raw.")
@click.option("--block", type=int, help="Side of a block in samples.  [default: that of the heights]")
@click.option("--soft/--hard", default=False, show_default=True, help="Shadows of the sun's disc, or of a point.")
@click.option("--no-shadows", is_flag=True, help="No cast shadows: only how the ground faces the sun.")
@click.option("--lines", type=int, default=1, show_default=True, help="Lines per sample of hard shadows; twice as many, a quarter wrong.")
@click.option("--certified", is_flag=True, help="Hard shadows without a wrong sample.")
@click.option("--sky", type=int, default=0, show_default=True, metavar="AZIMUTHS", help="Light of the sky, from so many directions; 16.")
@click.option("--share", type=float, default=0.15, show_default=True, help="Light of the open sky, relative to the sun's.")
@click.option("--bounce", is_flag=True, help="Light that the ground reflects once.")
@click.option("--albedo", type=float, default=0.3, show_default=True, help="Share of its light that the ground reflects.")
@click.option("--curvature/--no-curvature", default=True, show_default=True, help="The ground is curved.")
@click.option("--refraction/--no-refraction", default=False, show_default=True, help="The air lifts the sun and bends its rays.")
@click.option(
    "--scene", "scene_file", metavar="SCENE", help="A scene (TOML or JSON) with sun, sky and tolerance, instead of their options."
)
@click.option(
    "--effects",
    type=click.Choice(["all", "auto"]),
    help="Simulate all that is asked for, or of it what heights and sun call for.  [default: all; auto with --scene]",
)
@click.option(
    "--tolerance", type=float, metavar="CODES", help="What --effects auto may leave out, in codes of light, of 255.  [default: 1]"
)
@click.option("--plan", "only_plan", is_flag=True, help="Say which effects are called for and what the build would take; write nothing.")
@click.option("--update", is_flag=True, help="The heights have changed: rebuild only what that changes.")
@click.option("--overwrite", is_flag=True, help="Replace the layer; it is served until the new one is done.")
@click.option("--records/--no-records", default=True, show_default=True, help="Keep what --update needs.")
@click.option("--break-lock", is_flag=True, help="Take over the lock of a build in an object store that gives no sign of life.")
@click.option("--engine", type=click.Choice(["local", "dask"]), default="local", show_default=True, help="Where tasks run.")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Scheduler of the Dask cluster that tasks run on.")
@click.option("--workers", type=int, help="Threads; no effect on the result.  [default: all processors]")
@click.option("--task", type=int, help="Side of a task in samples; no effect on the result.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(
    dataset: str,
    suns: list[Sun],
    times: list[Sun],
    layer: str,
    scene_file: str | None,
    effects: str | None,
    tolerance: float | None,
    only_plan: bool,
    engine: str,
    scheduler: str | None,
    as_json: bool,
    **options: Any,  # noqa: ANN401 - click's options, checked by LightSettings
) -> None:
    """Build a layer of light in DATASET: its heights as a sun shines on them, with the shadows that they cast.

    A sample of light lies on every sample of the heights, with --twice also between them. The layer has a pyramid of its own, filtered in
    linear light. An interrupted build goes on when the same command is given again; if the heights have changed, --update rebuilds what
    that changes.

    --effects auto measures the heights first, and leaves out what is proved to change no sample by more than the tolerance.

    \b
    clipmap light out/alps --sun 270,10
    clipmap light out/alps --when 2026-06-21T05:00:00Z --soft --sky 16 --bounce
    clipmap light out/alps --sun 90,20 --sun 180,45 --sun 270,20 --layer day
    clipmap light out/alps --sun 270,10 --soft --sky 16 --bounce --effects auto --plan
    """
    scene = None if scene_file is None else read_scene(scene_file)
    effects = effects or ("all" if scene is None else "auto")
    refuse_contradictions(click.get_current_context(), scene, effects)
    chosen = [*suns, *times] if scene is None else [sun_of(scene)]
    if not chosen:
        raise UsageError("give a sun: --sun AZ,EL or --when TIME, or --scene SCENE")
    names = [layer] if len(chosen) == 1 else [f"{layer}_{number}" for number in range(1, len(chosen) + 1)]
    settings = [light_settings({**options, **sun, "layer": name}) for name, sun in zip(names, chosen, strict=True)]
    wanted = [wanted_of(each, scene, effects, tolerance) for each in settings]
    if only_plan:
        show_light_plan(dataset, wanted, as_json)
        return
    lit = []
    with open_engine(engine, scheduler) as runner:
        for one in wanted:
            lit.append(_light(dataset, one, runner))
            if not as_json:
                _show(*lit[-1], dataset)
    if as_json:
        version = lit[-1][0].build.manifest.version
        emit_json({"dataset": dataset, "version": version, "layers": [_as_json(*each) for each in lit]})


def _light(dataset: str, wanted: Wanted, engine: "Engine | None") -> "Lit":
    """Build one layer, and return what was done, and what was left out if that was planned."""
    from tiler.building.light import build_light

    with progress_bar("blocks") as on_progress:
        if wanted.scene is None:
            return build_light(dataset, wanted.settings, on_progress, engine=engine), None
        from tiler.building.lightplan import EffectChoice

        choice = EffectChoice(wanted.scene, on_progress)
        report = build_light(dataset, wanted.settings, on_progress, engine=engine, choose=choice)
    return replace(report, stages_s={"plan": choice.wall_s, **report.stages_s}), choice


def light_settings(options: dict[str, Any]) -> LightSettings:
    """Return the settings that the command's options give; raises UsageError that names the option which is wrong."""
    soft, certified, none, twice = (options.pop(name) for name in ("soft", "certified", "no_shadows", "twice"))
    if soft + certified + none > 1:
        raise UsageError("--soft, --certified and --no-shadows are three kinds of shadows; give one")
    shadows = "soft" if soft else "certified" if certified else "none" if none else "hard"
    try:
        return LightSettings(**{**options, "shadows": shadows, "bits": int(options["bits"]), "density": 2 if twice else 1})
    except ValidationError as error:
        raise refused(error, {"azimuth_deg": "sun", "elevation_deg": "sun", "height": "from"}) from error


def _as_json(report: "LightReport", choice: "EffectChoice | None") -> dict[str, Any]:
    build = report.build
    layer = build.manifest.layers[build.layer]
    return {
        "layer": build.layer,
        "outcome": build.outcome,
        "light": report.light.model_dump(mode="json"),
        "tasks": build.tasks,
        "tasks_kept": build.tasks_kept,
        "blocks_written": build.blocks_written,
        "codec": layer.codec,
        "levels": len(layer.levels),
        "blocks_stored": sum(level.stored for level in layer.levels),
        "stored_bytes": sum(level.stored_bytes for level in layer.levels),
        "remarks": list(build.remarks),
        "wall_s": build.wall_s,
        "stages_s": stages_s(report),
        "peak_rss_bytes": build.peak_rss_bytes,
        **({} if choice is None else choice_json(choice)),
    }


def stages_s(report: "LightReport") -> dict[str, float]:
    """Return the seconds per stage: those of the simulation, and what is left for the pyramid and its blocks."""
    build = report.build
    return {**report.stages_s, "blocks": build.wall_s - sum(report.stages_s.values())}


def _show(report: "LightReport", choice: "EffectChoice | None", dataset: str) -> None:
    build = report.build
    layer = build.manifest.layers[build.layer]
    for remark in build.remarks:
        click.echo(f"note: {remark}", err=True)
    pairs = [
        ("layer", f"{build.layer} in {dataset}, {build.outcome}"),
        ("sun", sun_text(report.light)),
        ("effects", effects_text(report.light)),
        *([] if choice is None else choice_pairs(choice)),
        ("samples", f"{layer.width} x {layer.height}, {len(layer.levels)} levels"),
        ("blocks", f"{sum(level.stored for level in layer.levels)} stored, {build.blocks_written} written, {layer.codec}"),
        ("stored", format_bytes(sum(level.stored_bytes for level in layer.levels))),
        ("time", f"{build.wall_s:.2f} s, peak memory {format_bytes(build.peak_rss_bytes)}"),
        ("stages", " · ".join(f"{name} {seconds:.2f} s" for name, seconds in stages_s(report).items())),
    ]
    if report.light.voids:
        pairs.append(("voids", f"{report.light.voids} samples: no light on them, and no shadow of them"))
    emit_pairs(pairs)
