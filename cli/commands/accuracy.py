"""``clipmap accuracy``: what accuracy costs in time, measured here and now."""

from pathlib import Path
from typing import Any, get_args

import click

from cli.options import build_settings, parse_bands
from cli.output import emit_json, emit_pairs
from schemas.errors import UsageError
from schemas.settings import HeightEncoding


@click.command(short_help="Measure what accuracy costs in time, on a source or a built-in terrain.")
@click.argument("source", type=click.Path(path_type=Path), required=False)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="Folder of the report, new or of an older report.")
@click.option("--layer", type=click.Choice(["imagery", "height"]), help="What the samples are; guessed where that is safe.")
@click.option("--height-scale", type=float, default=1.0, show_default=True, help="Metres per unit of the source.")
@click.option("--decode", type=click.Choice(get_args(HeightEncoding)), help="Heights are hidden in the source's colours, in this way.")
@click.option("--nodata", type=float, help="Value that marks a void in the source, instead of the one the file declares.")
@click.option("--bands", callback=parse_bands, help="Channels to take, from 1, e.g. 1,2,3.")
@click.option(
    "--crop", type=click.IntRange(96, 4096), default=1024, show_default=True, help="Cells along an edge of the part that is used."
)
@click.option("--runs", type=click.IntRange(1, 1000), default=5, show_default=True, help="How often each halving is timed.")
@click.option("--light", is_flag=True, help="Measure shadows, horizons and the light of the sky as well; takes minutes more.")
@click.option("--spacing", type=float, help="Distance between samples of a source without georeference [m], for --light.")
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def command(source: Path | None, output: Path, crop: int, runs: int, light: bool, as_json: bool, **options: Any) -> None:  # noqa: ANN401 - click's options, checked by BuildSettings
    """Measure error and time of every filter on the middle of SOURCE, and write a report to OUTPUT.

    Levels are compared with ideal ones; OpenImageIO's and GDAL's filters are measured beside. Without SOURCE a built-in terrain is
    used whose spectrum is known. With --light, sweeps of light are compared with rays that were all walked, and scenes are lit with all
    effects and with those that they call for. The report is OUTPUT/index.html, with raw results beside it. Needs the extra
    clipmap[report].

    \b
    clipmap accuracy -o out/accuracy
    clipmap accuracy height.png --layer height --height-scale 0.1 -o out/accuracy
    clipmap accuracy height.png --layer height --height-scale 0.1 --light --spacing 160 -o out/accuracy
    """
    settings = build_settings(options)
    if source is None and settings != build_settings({}):
        raise UsageError("--layer, --height-scale and the like describe a source; name one, or leave them out for the built-in terrain")
    if settings.spacing is not None and not light:
        raise UsageError("--spacing matters to light only; add --light, or leave it out")
    from tiler.accuracy.lightground import light_ground
    from tiler.accuracy.report import measure, prepare_folder, write_report
    from tiler.accuracy.sample import built_in, load_sample

    prepare_folder(output)
    sample = built_in(crop) if source is None else load_sample(source, settings, crop)
    ground = light_ground(source, sample, settings) if light else None
    report = measure(sample, runs, lambda stage: click.echo(f"measuring {stage}", err=True), ground)
    index = write_report(report, output)
    content = report.as_dict()
    if as_json:
        emit_json(
            {"report": str(index)}
            | {key: content[key] for key in ("sample", "findings", "default", "frontier", "default_dominated_by")}
            | ({"light_findings": report.light_findings} if light else {})
        )
        return
    height, width, channels = sample.values.shape
    emit_pairs([("sample", f"{sample.name}, {width} x {height} x {channels}, as {sample.kind}"), ("report", str(index))])
    for sentence in (*sample.remarks, *report.findings, *report.light_findings):
        click.echo(f"- {sentence}")
