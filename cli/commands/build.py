"""``clipmap build``: one source file becomes one layer of a dataset."""

from pathlib import Path
from typing import Any, get_args

import click

from cli.options import build_settings, parse_bands
from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar
from schemas.manifest import KernelName
from schemas.settings import MAX_SAMPLES


@click.command(short_help="Build a layer of a dataset from a source image or elevation model.")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Dataset to make or to add the layer to.")
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
@click.option("--workers", type=int, help="Threads; no effect on the result.  [default: all processors]")
@click.option("--task", type=int, default=2048, show_default=True, help="Side of a task in samples; no effect on the result.")
@click.option("--overwrite", is_flag=True, help="Replace the layer if the dataset has it; the old one is served until the new one is done.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(source: Path, output: Path, as_json: bool, **options: Any) -> None:  # noqa: ANN401 - click's options, checked by BuildSettings
    """Build a layer of the dataset OUTPUT from the file SOURCE.

    SOURCE is any raster that OpenImageIO or GDAL reads. Its georeference, nodata value, mask and alpha are honoured.
    Run it once per layer: a source without georeference is spread over the extent the dataset already has.

    \b
    clipmap build dem.tif -o out/alps
    clipmap build photo.tif -o out/alps
    clipmap build height.png --layer height --height-scale 0.1 --spacing 160 -o out/puget
    """
    settings = build_settings(options)
    from tiler.build import build_layer

    with progress_bar("blocks") as on_progress:
        report = build_layer(source, output, settings, on_progress)
    layer = report.manifest.layers[report.layer]
    seconds_per_megasample = {
        stage: getattr(report.times, f"{stage}_s") / report.megasamples for stage in ("read", "filter", "encode", "write")
    }
    if as_json:
        emit_json(
            {
                "dataset": str(output),
                "version": report.manifest.version,
                "layer": report.layer,
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
            ("layer", f"{report.layer} in {output}"),
            ("samples", f"{layer.width} x {layer.height}, {len(layer.levels)} levels"),
            ("blocks", f"{sum(level.stored for level in layer.levels)} stored, {blank} blank, {layer.codec}"),
            ("stored", format_bytes(sum(level.stored_bytes for level in layer.levels))),
            ("time", f"{report.wall_s:.2f} s, peak memory {format_bytes(report.peak_rss_bytes)}"),
            ("ms/Msample", stages),
        ]
    )
