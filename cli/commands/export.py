"""``clipmap export``: a layer of a dataset in another program's form."""

from pathlib import Path
from typing import Any

import click

from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar


@click.command(short_help="Write a layer as pmtiles, cog, dzi or exr.")
@click.argument("dataset")
@click.argument("form", type=click.Choice(["pmtiles", "cog", "dzi", "exr"]))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="File to write; its suffix is added if it is missing.")
@click.option("--layer", metavar="NAME", help="Layer to write.  [default: the one there is, or that fits]")
@click.option(
    "--half/--float", default=None, help="exr: 16-bit or 32-bit floats.  [default: 16-bit for 8-bit imagery, 32-bit for the rest]"
)
@click.option("--codes", is_flag=True, help="exr: keep sRGB codes, as 0 to 1, instead of decoding them to light.")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads; no effect on the result.  [default: all processors]")
@click.option("--overwrite", is_flag=True, help="Replace what is there, once the new file is whole.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(dataset: str, form: str, output: Path, as_json: bool, **options: Any) -> None:  # noqa: ANN401 - click's options
    """Write a layer of DATASET, a folder or a URL, in another form: every level becomes a level there, none is filtered again.

    pmtiles is an archive of the blocks as they are. cog is a Cloud Optimized GeoTIFF: jpeg and webp blocks as they are, all others
    without further loss. dzi is a Deep Zoom image: a file and a folder of tiles. exr is a tiled, mip-mapped OpenEXR file, imagery in
    linear light.

    The file appears under its name only when it is whole.

    \b
    clipmap export out/alps cog --layer height -o alps-height.tif
    clipmap export out/alps dzi -o www/alps.dzi
    """
    from tiler.export import ExportSettings, export
    from tiler.stores.dataset import open_dataset

    opened = open_dataset(dataset)
    with progress_bar("tiles") as on_progress:
        report = export(opened, form, output, ExportSettings(**options), on_progress)
    done = report.done
    if as_json:
        emit_json(
            {
                "dataset": dataset,
                "version": opened.manifest.version,
                "layer": report.layer,
                "form": report.form,
                "output": str(report.target),
                "levels": done.levels,
                "tiles_copied": done.copied,
                "tiles_encoded": done.encoded,
                "stored_bytes": done.stored_bytes,
                "wall_s": report.wall_s,
            }
        )
        return
    emit_pairs(
        [
            ("layer", f"{report.layer} of {dataset}"),
            ("output", f"{report.target}, {format_bytes(done.stored_bytes)}"),
            ("levels", str(done.levels)),
            ("tiles", f"{done.copied} copied as they are, {done.encoded} encoded"),
            ("time", f"{report.wall_s:.2f} s"),
        ]
    )
