"""What ``clipmap inspect`` prints for people, from the same facts that ``--json`` prints."""

import shutil
import sys
from typing import Any, Final

import click

from cli.light_text import light_pairs
from cli.output import emit_pairs, emit_table, format_bytes
from schemas.facts import BlockFacts, CoverageMap, DatasetFacts, Footprint, LayerFacts, LayerPoint, LevelFacts, PointFacts
from schemas.light import Normals
from schemas.manifest import Filter, Source

_BLANK, _FULL = "··", "██"
_PARTLY: Final = ("░░", "▒▒", "▓▓")
_ASCII: Final = str.maketrans("·░▒▓█", ".-+*#")
"""For terminals without Unicode."""


def show_dataset(facts: DatasetFacts) -> None:
    """Print a dataset and its layers."""
    crs = facts.crs or "no reference system"
    emit_pairs([("dataset", facts.dataset), ("version", facts.version), ("world", f"{_shortened(crs)}, {facts.unit}")])
    for layer in facts.layers:
        click.echo()
        show_layer(layer)


def show_layer(facts: LayerFacts) -> None:
    """Print a layer and its table of levels."""
    bound = facts.max_error
    pad = f" with a pad of {facts.pad}" if facts.pad else ""
    blocks = f"{facts.blocks_stored} stored, {facts.blocks_blank} blank, {facts.block} x {facts.block}{pad}"
    promise = "" if bound is None else ", lossless" if bound == 0 else f", error at most {bound:g}{_unit(facts.sample_unit)}"
    spacing = facts.ground_spacing_m
    pairs = [
        ("layer", f"{facts.layer} ({facts.kind}), {facts.width} x {facts.height} samples, {facts.registration}-registered"),
        ("samples", f"{facts.channels} x {facts.dtype}{', with alpha' if facts.alpha else ''}"),
        ("blocks", f"{blocks}, {facts.codec}{promise}"),
        ("stored", format_bytes(facts.stored_bytes)),
        ("values", _statistics(facts)),
        ("extent", _numbers(facts.extent)),
        ("spacing", "unknown" if spacing is None else f"{_numbers(spacing)} m on the ground, at the centre"),
        ("filter", _filter(facts.filter)),
    ]
    pairs[7:7] = _ground(facts.footprint)
    pairs += [("normals", _normals(facts.normals))] if facts.normals else []
    pairs += [("filled", f"voids up to {facts.fill} samples across")] if facts.fill else []
    pairs += [("enhanced", facts.enhance)] if facts.enhance else []
    pairs += [("updates", f"{facts.patches}, with blocks under paths of their own")] if facts.patches else []
    pairs += [] if facts.light is None else light_pairs(facts.light)
    pairs += [("source", source_text(facts.source))]
    emit_pairs(pairs)
    rows = [
        (
            str(level.level),
            f"{level.width} x {level.height}",
            f"{level.columns} x {level.rows}",
            str(level.stored),
            str(level.blank),
            format_bytes(level.stored_bytes),
        )
        for level in facts.levels
    ]
    emit_table(("level", "samples", "blocks", "stored", "blank", "bytes"), rows)


def _ground(footprint: Footprint | None) -> list[tuple[str, str]]:
    """Say where on the Earth a layer lies, how large it is there, and between which limits its spacing varies."""
    if footprint is None:
        return []
    across = ", across the antimeridian" if footprint.crosses_antimeridian else ", around the pole" if footprint.contains_pole else ""
    degrees = f"{footprint.west_deg:.6g} to {footprint.east_deg:.6g} E, {footprint.south_deg:.6g} to {footprint.north_deg:.6g} N{across}"
    rows, columns = (f"{low:.6g} to {high:.6g} m" for low, high in (footprint.row_spacing_m, footprint.column_spacing_m))
    return [
        ("on Earth", f"{degrees}, {footprint.area_m2 / 1e6:,.6g} km2"),
        ("spacings", f"{rows} along rows, {columns} along columns, over the extent"),
    ]


def show_level(facts: LevelFacts) -> None:
    """Print a level, and a map of which of its blocks hold valid samples."""
    fields = facts.model_dump(exclude={"coverage"})
    ordered = {"dataset": facts.dataset, "layer": facts.layer} | fields
    emit_pairs((name.replace("_", " "), _text(value)) for name, value in ordered.items())
    click.echo()
    for line in coverage_lines(facts.coverage, sys.stdout.encoding or "ascii"):
        click.echo(line)


def show_block(facts: BlockFacts) -> None:
    """Print a block."""
    emit_pairs((name.replace("_", " "), _text(value)) for name, value in facts.model_dump().items())


def show_point(facts: PointFacts) -> None:
    """Print what every layer holds at a place, level by level."""
    pairs = [("dataset", facts.dataset)]
    if facts.longitude_latitude is not None:
        pairs.append(("place", _geographic(*facts.longitude_latitude)))
    crs = f" in {_shortened(facts.crs)}" if facts.crs else ""
    emit_pairs([*pairs, ("world", f"{_numbers(facts.world)}{crs}")])
    for layer in facts.layers:
        click.echo()
        _show_layer_point(layer)


def _show_layer_point(layer: LayerPoint) -> None:
    column, row = layer.position
    if not layer.levels:
        click.echo(f"{layer.layer}: the place lies outside")
        return
    click.echo(f"{layer.layer}: column {column:.9g}, row {row:.9g}")
    rows = [
        (
            str(point.level),
            f"{point.sample[0]},{point.sample[1]}",
            "void" if point.value is None else f"{_numbers(point.value)}{_unit(layer.unit)}",
            point.block,
            point.name,
        )
        for point in layer.levels
    ]
    emit_table(("level", "sample", "value", "block", "name"), rows, left=(0, 3, 4))


def coverage_cells() -> int:
    """Return how many cells of a coverage map fit on a line of the terminal."""
    return max(8, shutil.get_terminal_size().columns // 2)


def coverage_lines(coverage: CoverageMap, encoding: str) -> list[str]:
    """Return a coverage map as text that ``encoding`` has, two characters a cell, and its key."""
    lines = ["".join(_mark(share) for share in row) for row in coverage.valid_share]
    cell = "" if coverage.blocks_per_cell == 1 else f"; a mark is {coverage.blocks_per_cell} x {coverage.blocks_per_cell} blocks"
    lines += [f"{_FULL} all valid  {_PARTLY[2]}{_PARTLY[1]}{_PARTLY[0]} partly  {_BLANK} blank{cell}"]
    return lines if encoding.lower().startswith("utf") else [line.translate(_ASCII) for line in lines]


def _mark(share: float) -> str:
    """Return two characters for the share of valid samples; full and blank only if it is so for the last sample."""
    if share in (0, 1):
        return _FULL if share else _BLANK
    return _PARTLY[min(int(share * len(_PARTLY)), len(_PARTLY) - 1)]


def _normals(normals: Normals) -> str:
    between = ", and between them" if normals.density == 2 else ""
    return f"of {normals.height}{between}: (sample - {normals.zero}) / {normals.one} is x, to the right, and y, upward on the grid"


def _filter(kernel: Filter) -> str:
    clamp = ", clamped to the range under the taps" if kernel.clamp == "local" else ""
    light = ", in linear light" if kernel.linear_light else ""
    return f"{kernel.kernel}, radius {kernel.radius}, {kernel.edge} edge, {kernel.void} voids{clamp}{light}"


def _text(value: Any) -> str:  # noqa: ANN401 - any JSON value
    if value is None or value == []:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    return " ".join(_text(item) for item in value) if isinstance(value, list | tuple) else str(value)


def _statistics(facts: LayerFacts) -> str:
    statistics = facts.statistics
    if not statistics.valid:
        return "none valid"
    void = "" if facts.valid_share == 1 else f", {100 * (1 - facts.valid_share):.2g} % void"
    low, high, mean = map(_numbers, (statistics.min, statistics.max, statistics.mean))
    return f"{low} to {high}, mean {mean}{_unit(facts.sample_unit)}{void}"


def source_text(source: Source) -> str:
    """Return where a layer came from, in one line."""
    nodata = "" if source.nodata is None else f", nodata {source.nodata:g}"
    decode = "" if source.decode is None else f", decoded as {source.decode}"
    scale = "" if (source.scale, source.offset) == (1.0, 0.0) else f", x {source.scale:g} + {source.offset:g}"
    ranges = [] if source.stretch is None else [f"{low:g} to {high:g}" for low, high in source.stretch]
    stretch = f", stretched from {' and '.join(dict.fromkeys(ranges))}" if ranges else ""
    samples = f"{source.channels} x {source.dtype}"
    more = f" and {source.files - 1} more" if source.files > 1 else ""
    return f"{source.name}{more}, {source.format}, {samples}{nodata}{decode}{scale}{stretch}, {source.placement}"


def _geographic(longitude: float, latitude: float) -> str:
    return f"{abs(latitude):.6f} {'S' if latitude < 0 else 'N'}  {abs(longitude):.6f} {'W' if longitude < 0 else 'E'}"


def _unit(unit: str | None) -> str:
    return " m" if unit == "metre" else ""


def _numbers(values: tuple[float, ...] | list[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _shortened(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
