"""``clipmap build``: one source, or a mosaic of several, becomes one layer of a dataset."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from cli.engines import open_engine
from cli.options import build_settings, parse_bands
from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar
from schemas.manifest import KernelName
from schemas.settings import MAX_SAMPLES

if TYPE_CHECKING:
    from tiler.building.build import BuildReport


@click.command(short_help="Build a layer of a dataset from a source image or elevation model.")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, help="Dataset to make or to add the layer to: a folder or a URL.")
@click.option("--layer", type=click.Choice(["imagery", "height"]), help="What the samples are; guessed where that is safe.")
@click.option(
    "--codec", help="jpeg:Q, png, webp:Q, rgb565 or raw for imagery; lerc:E, png16[:SCALE,OFFSET], exr:float, exr:half or raw for heights."
)
@click.option("--block", type=int, default=256, show_default=True, help="Side of a block in samples, a power of two.")
@click.option(
    "--filter",
    type=click.Choice(get_args(KernelName)),
    default="blackman-sinc",
    show_default=True,
    help="Kernel that makes coarser levels.",
)
@click.option("--radius", type=int, help="Kernel radius in coarse samples.  [default: 6 for heights, 3 for imagery]")
@click.option(
    "--clamp",
    type=click.Choice(["none", "local"]),
    default="none",
    show_default=True,
    help="local: no ringing; coarse samples stay in the range of those under their taps.",
)
@click.option("--pad", type=int, default=0, show_default=True, help="Stored border of every block, in samples, copied from its neighbours.")
@click.option("--linear-light", is_flag=True, help="Filter sRGB imagery in linear light: fine patterns keep their brightness.")
@click.option(
    "--enhance",
    metavar="wavelet[:GAIN]",
    help="Amplify fine details of imagery before the pyramid is built; a gain of 1 changes nothing, 1.5 is usual.",
)
@click.option(
    "--stretch",
    metavar="CUT%|MIN,MAX",
    help="Make 8 bits of 16-bit imagery: 2% cuts so much off both ends of every colour channel; MIN,MAX is one range for all.",
)
@click.option("--fill", type=int, default=0, metavar="SAMPLES", help="Fill voids of heights that are at most so many samples across.")
@click.option("--spacing", type=float, help="Metres between samples, for a source without georeference.")
@click.option("--height-scale", type=float, default=1.0, show_default=True, help="Metres per unit of the source.")
@click.option("--height-offset", type=float, default=0.0, show_default=True, help="Metres added after scaling.")
@click.option(
    "--decode",
    type=click.Choice(["terrarium", "terrain-rgb", "none"]),
    help="Heights are hidden in the source's colours, in this way; none: it is a picture, even if it looks like hidden heights.",
)
@click.option("--nodata", type=float, help="Value that marks a void, instead of the one the file declares.")
@click.option("--bands", callback=parse_bands, help="Channels to take, from 1, e.g. 1,2,3.")
@click.option(
    "--max-samples",
    type=int,
    default=MAX_SAMPLES,
    show_default=True,
    help="Refuse a source whose header declares more samples, all channels counted.",
)
@click.option("--mosaic", is_flag=True, help="Put several georeferenced sources on one lattice, later ones on top.")
@click.option("--update", is_flag=True, help="The source has changed: rebuild only what that changes.")
@click.option("--overwrite", is_flag=True, help="Replace the layer, finished or not; a finished one is served until the new one is done.")
@click.option("--plan", "only_plan", is_flag=True, help="Say what the build would make and take, and write nothing.")
@click.option("--records/--no-records", default=True, show_default=True, help="Keep what --update and verify --repair need.")
@click.option("--break-lock", is_flag=True, help="Take over the lock of a build in an object store that gives no sign of life.")
@click.option("--engine", type=click.Choice(["local", "dask"]), default="local", show_default=True, help="Where tasks run.")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Scheduler of the Dask cluster that tasks run on.")
@click.option("--workers", type=int, help="Tasks at a time; no effect on the result.  [default: all processors]")
@click.option("--task", type=int, help="Side of a task in samples; no effect on the result.  [default: 4096, or 2048 for small sources]")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(
    sources: tuple[Path, ...],
    output: str,
    only_plan: bool,
    engine: str,
    scheduler: str | None,
    as_json: bool,
    **options: Any,  # noqa: ANN401 - click's options, checked by BuildSettings
) -> None:
    """Build a layer of the dataset OUTPUT from the file SOURCE, or from several with --mosaic.

    SOURCE is any raster that OpenImageIO or GDAL reads. Its georeference, nodata value, mask and alpha are honoured.
    Run it once per layer: a source without georeference is spread over the extent the dataset already has.

    A build that was interrupted goes on where it stopped when the same command is given again. When the layer is there already,
    nothing is done if source and settings are the same; if the source has changed, --update rebuilds what that changes.

    \b
    clipmap build dem.tif -o out/alps
    clipmap build photo.tif -o out/alps
    clipmap build height.png --layer height --height-scale 0.1 --spacing 160 -o out/puget
    clipmap build north.tif south.tif --mosaic -o s3://bucket/alps
    """
    settings = build_settings(options)
    if only_plan:
        from cli.plan_text import show_plan

        show_plan(sources, output, settings, as_json)
        return
    with progress_bar("blocks") as on_progress, open_engine(engine, scheduler) as runner:
        from tiler.building.build import build_layer

        report = build_layer(sources, output, settings, on_progress, runner)
    show_report(report, output, as_json)


def show_report(report: "BuildReport", output: str, as_json: bool) -> None:
    """Print what a build did."""
    layer = report.manifest.layers[report.layer]
    seconds_per_megasample = {
        stage: getattr(report.times, f"{stage}_s") / report.megasamples for stage in ("read", "filter", "encode", "write")
    }
    if as_json:
        emit_json(
            {
                "dataset": output,
                "version": report.manifest.version,
                "layer": report.layer,
                "outcome": report.outcome,
                "tasks": report.tasks,
                "tasks_kept": report.tasks_kept,
                "blocks_written": report.blocks_written,
                "codec": layer.codec,
                "levels": len(layer.levels),
                "blocks_stored": sum(level.stored for level in layer.levels),
                "blocks_blank": sum(level.blank for level in layer.levels),
                "stored_bytes": sum(level.stored_bytes for level in layer.levels),
                "remarks": list(report.remarks),
                "wall_s": report.wall_s,
                "peak_rss_bytes": report.peak_rss_bytes,
                "thread_seconds_per_megasample": seconds_per_megasample,
            }
        )
        return
    for remark in report.remarks:
        click.echo(f"note: {remark}", err=True)
    blank = sum(level.blank for level in layer.levels)
    stages = " · ".join(f"{stage} {1e3 * seconds:.2f}" for stage, seconds in seconds_per_megasample.items())
    emit_pairs(
        [
            ("layer", f"{report.layer} in {output}, {_outcome(report)}"),
            ("samples", f"{layer.width} x {layer.height}, {len(layer.levels)} levels"),
            ("blocks", f"{sum(level.stored for level in layer.levels)} stored, {blank} blank, {layer.codec}"),
            ("stored", format_bytes(sum(level.stored_bytes for level in layer.levels))),
            ("time", f"{report.wall_s:.2f} s, peak memory {format_bytes(report.peak_rss_bytes)}"),
            ("ms/Msample", stages),
        ]
    )


def _outcome(report: "BuildReport") -> str:
    match report.outcome:
        case "continued":
            return f"continued: {report.tasks_kept} of {report.tasks} tasks were finished"
        case "updated":
            return f"updated: {report.tasks - report.tasks_kept} of {report.tasks} tasks run, {report.blocks_written} blocks written"
        case outcome:
            return outcome
