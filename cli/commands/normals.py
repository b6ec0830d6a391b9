"""``clipmap normals``: the normals of a dataset's heights become a layer."""

from typing import TYPE_CHECKING, Any

import click
from pydantic import ValidationError

from cli.engines import open_engine
from cli.options import refused
from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar
from schemas.settings import NormalSettings

if TYPE_CHECKING:
    from tiler.building.normals import NormalReport


@click.command(short_help="Build a layer of normals from a dataset's heights.")
@click.argument("dataset")
@click.option("--layer", default="normal", show_default=True, help="Name of the layer.")
@click.option("--from", "height", default="height", show_default=True, help="Layer of heights whose normals are stored.")
@click.option("--twice", is_flag=True, help="At twice the heights' resolution: also between them, on predicted ground.")
@click.option("--codec", default="png", show_default=True, help="png, raw, exr:half or exr:float.")
@click.option("--bits", type=click.Choice(["8", "16"]), default="8", show_default=True, help="Bits of a sample of png and raw.")
@click.option("--block", type=int, help="Side of a block in samples.  [default: that of the heights]")
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
    engine: str,
    scheduler: str | None,
    as_json: bool,
    **options: Any,  # noqa: ANN401 - click's options, checked by NormalSettings
) -> None:
    """Build a layer of normals in DATASET: which way the ground faces, sample on sample with its heights.

    Two channels hold the horizontal part of the unit normal, to the right and upward on the grid; on coarser levels the mean of it. An
    interrupted build goes on when the same command is given again; if the heights have changed, --update rebuilds what that changes.

    \b
    clipmap normals out/alps
    clipmap normals out/alps --twice --codec exr:half --layer fine
    """
    settings = normal_settings(options)
    from tiler.building.normals import build_normals

    with open_engine(engine, scheduler) as runner, progress_bar("blocks") as on_progress:
        report = build_normals(dataset, settings, on_progress, runner)
    if as_json:
        emit_json(_as_json(report, dataset))
    else:
        _show(report, dataset)


def normal_settings(options: dict[str, Any]) -> NormalSettings:
    """Return the settings that the command's options give; raises UsageError that names the option which is wrong."""
    density = 2 if options.pop("twice") else 1
    try:
        return NormalSettings(**{**options, "density": density, "bits": int(options["bits"])})
    except ValidationError as error:
        raise refused(error, {"height": "from"}) from error


def _as_json(report: "NormalReport", dataset: str) -> dict[str, Any]:
    build = report.build
    layer = build.manifest.layers[build.layer]
    return {
        "dataset": dataset,
        "version": build.manifest.version,
        "layer": build.layer,
        "outcome": build.outcome,
        "normals": report.normals.model_dump(mode="json"),
        "tasks": build.tasks,
        "tasks_kept": build.tasks_kept,
        "blocks_written": build.blocks_written,
        "codec": layer.codec,
        "levels": len(layer.levels),
        "blocks_stored": sum(level.stored for level in layer.levels),
        "stored_bytes": sum(level.stored_bytes for level in layer.levels),
        "remarks": list(build.remarks),
        "wall_s": build.wall_s,
        "stages_s": _stages_s(report),
        "peak_rss_bytes": build.peak_rss_bytes,
    }


def _stages_s(report: "NormalReport") -> dict[str, float]:
    """Return the seconds per stage: decoding the heights, and all the rest."""
    return {**report.stages_s, "blocks": report.build.wall_s - sum(report.stages_s.values())}


def _show(report: "NormalReport", dataset: str) -> None:
    build, normals = report.build, report.normals
    layer = build.manifest.layers[build.layer]
    for remark in build.remarks:
        click.echo(f"note: {remark}", err=True)
    pairs = [
        ("layer", f"{build.layer} in {dataset}, {build.outcome}"),
        ("samples", f"{layer.width} x {layer.height}, {len(layer.levels)} levels"),
        (
            "codes",
            f"(sample - {normals.zero}) / {normals.one} is x, to the right, and y, upward on the grid; up is {normals.up_deg:.2f} degrees",
        ),
        ("blocks", f"{sum(level.stored for level in layer.levels)} stored, {build.blocks_written} written, {layer.codec}"),
        ("stored", format_bytes(sum(level.stored_bytes for level in layer.levels))),
        ("time", f"{build.wall_s:.2f} s, peak memory {format_bytes(build.peak_rss_bytes)}"),
        ("stages", " · ".join(f"{name} {seconds:.2f} s" for name, seconds in _stages_s(report).items())),
    ]
    if normals.voids:
        pairs.append(("voids", f"{normals.voids} samples of the heights: no normals there"))
    emit_pairs(pairs)
