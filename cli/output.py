"""How results reach the user: tables for people, JSON for programs, both from the same dictionary."""

import json
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import click

Row = Sequence[str]


def emit_json(result: dict[str, Any]) -> None:
    """Print ``result`` as indented JSON."""
    click.echo(json.dumps(result, indent=2, allow_nan=False))


def emit_pairs(pairs: Iterable[tuple[str, str]]) -> None:
    """Print names and values in two aligned columns."""
    listed = list(pairs)
    width = max((len(name) for name, _ in listed), default=0)
    for name, value in listed:
        click.echo(f"{name:<{width}}  {value}".rstrip())


def emit_table(header: Row, rows: Iterable[Row], left: Collection[int] = (0,)) -> None:
    """Print a table with the columns numbered in ``left`` left-aligned, the others right-aligned."""
    table = [header, *rows]
    widths = [max(len(row[column]) for row in table) for column in range(len(header))]
    for row in table:
        cells = [f"{cell:<{width}}" if n in left else f"{cell:>{width}}" for n, (cell, width) in enumerate(zip(row, widths, strict=True))]
        click.echo("  ".join(cells).rstrip())


def format_bytes(count: int) -> str:
    """Return a number of bytes for people, in powers of 1024."""
    size = float(count)
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if size < 1024 or unit == "TiB":
            break
        size /= 1024
    return f"{count} B" if unit == "B" else f"{size:.1f} {unit}"
