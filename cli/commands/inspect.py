"""``clipmap inspect``: what is in a dataset, a layer, a level or a block."""

from pathlib import Path
from typing import Any

import click

from cli.exit_codes import FOUND
from cli.output import emit_json, emit_pairs, emit_table, format_bytes
from tiler.inspection import Facts, describe_block, describe_dataset, describe_layer, describe_level, parse_target
from tiler.stores.dataset import open_dataset


@click.command(short_help="Show a dataset, a level or a block.")
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("target", required=False)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def command(dataset: Path, target: str | None, as_json: bool) -> int:
    """Show what is in DATASET, or in one part of it. Nothing is decoded.

    TARGET is a layer, a level, or a block by address or by name. A block's bytes are compared with their digest; the
    exit status is 1 if they differ.

    \b
    clipmap inspect out/puget
    clipmap inspect out/puget height/1
    clipmap inspect out/puget height/1/0/2
    clipmap inspect out/puget height-1-12.lerc
    """
    opened = open_dataset(dataset)
    if target is None:
        facts, show = describe_dataset(opened), _show_dataset
    else:
        name, level, address = parse_target(opened, target)
        if level is None:
            facts, show = describe_layer(opened, name), _show_layer
        elif address is None:
            facts, show = describe_level(opened, name, level), _show_pairs
        else:
            facts, show = describe_block(opened, name, address), _show_pairs
    if as_json:
        emit_json(facts)
    else:
        show(facts)
    return 0 if facts.get("intact", True) else FOUND


def _show_dataset(facts: Facts) -> None:
    crs = facts["crs"] or "no reference system"
    emit_pairs([("dataset", facts["dataset"]), ("version", facts["version"]), ("world", f"{_shortened(crs)}, {facts['unit']}")])
    for layer in facts["layers"]:
        click.echo()
        _show_layer(layer)


def _show_layer(facts: Facts) -> None:
    kernel, source = facts["filter"], facts["source"]
    bound = facts["max_error"]
    blocks = f"{facts['blocks_stored']} stored, {facts['blocks_blank']} blank, {facts['block']} x {facts['block']}"
    promise = "" if bound is None else ", lossless" if bound == 0 else f", error at most {bound:g}{_unit(facts)}"
    emit_pairs(
        [
            (
                "layer",
                f"{facts['layer']} ({facts['kind']}), {facts['width']} x {facts['height']} samples, {facts['registration']}-registered",
            ),
            ("samples", f"{facts['channels']} x {facts['dtype']}{', with alpha' if facts['alpha'] else ''}"),
            ("blocks", f"{blocks}, {facts['codec']}{promise}"),
            ("stored", format_bytes(facts["stored_bytes"])),
            ("values", _statistics(facts)),
            ("extent", _numbers(facts["extent"])),
            (
                "spacing",
                "unknown" if facts["ground_spacing_m"] is None else f"{_numbers(facts['ground_spacing_m'])} m on the ground, at the centre",
            ),
            ("filter", f"{kernel['kernel']}, radius {kernel['radius']}, {kernel['edge']} edge, {kernel['void']} voids"),
            ("source", f"{source['name']}, {source['format']}, {source['channels']} x {source['dtype']}{_origin(source)}"),
        ]
    )
    rows = [
        (
            str(level["level"]),
            f"{level['width']} x {level['height']}",
            f"{level['columns']} x {level['rows']}",
            str(level["stored"]),
            str(level["blank"]),
            format_bytes(level["stored_bytes"]),
        )
        for level in facts["levels"]
    ]
    emit_table(("level", "samples", "blocks", "stored", "blank", "bytes"), rows)


def _show_pairs(facts: Facts) -> None:
    emit_pairs((name.replace("_", " "), _text(value)) for name, value in facts.items())


def _text(value: Any) -> str:  # noqa: ANN401 - any JSON value
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    return " ".join(_text(item) for item in value) if isinstance(value, list) else str(value)


def _statistics(facts: Facts) -> str:
    statistics = facts["statistics"]
    if not statistics["valid"]:
        return "none valid"
    void = "" if facts["valid_share"] == 1 else f", {100 * (1 - facts['valid_share']):.2g} % void"
    low, high, mean = (_numbers(statistics[name]) for name in ("min", "max", "mean"))
    return f"{low} to {high}, mean {mean}{_unit(facts)}{void}"


def _origin(source: Facts) -> str:
    nodata = "" if source["nodata"] is None else f", nodata {source['nodata']:g}"
    decode = "" if source["decode"] is None else f", decoded as {source['decode']}"
    scale = "" if (source["scale"], source["offset"]) == (1.0, 0.0) else f", x {source['scale']:g} + {source['offset']:g}"
    return f"{nodata}{decode}{scale}, {source['placement']}"


def _unit(facts: Facts) -> str:
    return " m" if facts["sample_unit"] == "metre" else ""


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _shortened(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
