"""``clipmap diff``: how two datasets differ."""

import json

import click
from pydantic import JsonValue

from cli.exit_codes import DONE, FOUND
from cli.output import emit_json, emit_pairs, emit_table
from cli.progress import progress_bar
from schemas.findings import DiffReport, FieldDifference, LayerDifference

_LONGEST_VALUE = 60


@click.command(short_help="Compare two datasets: fields, blocks, samples.")
@click.argument("a")
@click.argument("b")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads.  [default: all processors]")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(a: str, b: str, workers: int | None, as_json: bool) -> int:
    """Say how the datasets A and B differ: layers, fields of the manifest, blocks, samples.

    Each is a folder, or a URL of an object store such as s3://bucket/prefix. Blocks are compared by their digests. Where both datasets
    have a layer on the same lattice, the blocks that differ are decoded, and the largest and the root-mean-square difference of their
    samples are told, level by level; so two codecs or filters can be compared. Where blocks lie in the store and which version of
    clipmap wrote them does not count.

    The exit status is 0 if the datasets are the same, 1 if they differ.

    \b
    clipmap diff out/alps out/alps-new
    """
    from tiler.checking.diff import diff
    from tiler.stores.dataset import open_dataset

    datasets = open_dataset(a), open_dataset(b)
    with progress_bar("differing blocks") as on_progress:
        report = diff(*datasets, workers, on_progress)
    if as_json:
        emit_json(report.model_dump(mode="json"))
    else:
        _show(report)
    return DONE if report.same else FOUND


def _show(report: DiffReport) -> None:
    if report.same:
        layers = ", ".join(layer.layer for layer in report.layers)
        blocks = sum(level.blocks for layer in report.layers for level in layer.levels)
        click.echo(f"{report.a} and {report.b} are the same: {blocks} blocks of {layers}")
        return
    pairs = [("a", f"{report.a}, version {report.version_a}"), ("b", f"{report.b}, version {report.version_b}")]
    pairs += [("only in a", ", ".join(report.only_in_a))] * bool(report.only_in_a)
    pairs += [("only in b", ", ".join(report.only_in_b))] * bool(report.only_in_b)
    emit_pairs(pairs)
    if report.world:
        click.echo()
        _show_fields("world", report.world)
    for layer in report.layers:
        click.echo()
        _show_layer(layer)


def _show_layer(layer: LayerDifference) -> None:
    differing = sum(level.differing for level in layer.levels)
    if not layer.fields and not differing:
        click.echo(f"{layer.layer}: the same")
        return
    if layer.fields:
        _show_fields(layer.layer, layer.fields)
    else:
        click.echo(f"{layer.layer}: fields are the same")
    if layer.not_compared:
        click.echo(f"samples were not compared: {layer.not_compared}")
    if layer.levels:
        rows = [
            (
                str(level.level),
                str(level.blocks),
                str(level.differing),
                _number(level.largest),
                _number(level.rms),
                _number(level.valid_in_one),
                " ".join(level.first) + " ..." * (level.differing > len(level.first)),
            )
            for level in layer.levels
        ]
        emit_table(("level", "blocks", "differ", "largest", "rms", "valid in one", "first"), rows, left=(0, 6))


def _show_fields(name: str, fields: list[FieldDifference]) -> None:
    rows = [(name, "a", "b"), *((field.field, _value(field.a), _value(field.b)) for field in fields)]
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    for row in rows:
        click.echo(f"{row[0]:<{widths[0]}}  {row[1]:<{widths[1]}}  {row[2]}".rstrip())


def _value(value: JsonValue) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
