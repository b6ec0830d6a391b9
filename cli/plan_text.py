"""What ``clipmap build --plan`` prints: what the build would make and take."""

from collections.abc import Sequence
from pathlib import Path

import click

from cli.output import emit_json, emit_pairs, emit_table, format_bytes
from schemas.estimates import BuildEstimate, SpaceEstimate
from schemas.settings import BuildSettings


def show_plan(sources: Sequence[Path], output: str, settings: BuildSettings, as_json: bool) -> None:
    """Print what a build with these arguments would make and take; nothing is written at ``output``."""
    from tiler.estimate.build import estimate_build

    estimate = estimate_build(sources, output, settings)
    if as_json:
        emit_json(estimate.model_dump(mode="json"))
        return
    show_estimate(estimate)


def show_estimate(estimate: BuildEstimate, more: Sequence[tuple[str, str]] = ()) -> None:
    """Print an estimate for people, and ``more`` pairs of name and text below it."""
    for warning in estimate.warnings:
        click.echo(f"note: {warning}", err=True)
    _show_levels(estimate)
    click.echo()
    emit_pairs([*_pairs(estimate), *more])


def _show_levels(estimate: BuildEstimate) -> None:
    rows = [
        (
            str(level.level),
            f"{level.width} x {level.height}",
            f"{level.columns} x {level.rows}",
            str(level.blocks),
            f"{'' if level.encoded else '~ '}{format_bytes(level.stored_bytes)}",
            str(level.encoded) if level.encoded else "-",
        )
        for level in estimate.levels
    ]
    emit_table(("level", "samples", "blocks", "in all", "bytes", "tried"), rows)


def _pairs(estimate: BuildEstimate) -> list[tuple[str, str]]:
    space = estimate.space
    blocks = sum(level.blocks for level in estimate.levels)
    stored = sum(level.stored for level in estimate.levels)
    blank = f", about {blocks - stored} of them blank" if stored < blocks else ""
    available = "" if estimate.available_memory_bytes is None else f" of {format_bytes(estimate.available_memory_bytes)} to be had"
    tasks = estimate.standing.tasks
    return [
        ("layer", f"{estimate.layer} in {estimate.dataset}"),
        ("standing", estimate.standing.sentence),
        ("blocks", f"{blocks}{blank}, {estimate.codec}"),
        ("bytes", _bytes(space)),
        ("beside", f"{_beside(space)} for {tasks} task{'s' * (tasks != 1)}"),
        ("files", f"{space.files}" + (f" and {space.folders} folders" if space.folders else " objects")),
        ("space", _room(space)),
        ("memory", f"about {format_bytes(estimate.memory_bytes)}{available}"),
        ("time", _time(estimate)),
    ]


def _bytes(space: SpaceEstimate) -> str:
    if space.stored_bytes_low == space.stored_bytes_high:
        return f"{format_bytes(space.stored_bytes)}; all of the source was tried"
    between = f"{format_bytes(space.stored_bytes_low)} to {format_bytes(space.stored_bytes_high)}"
    percent = 100 * space.sampled_share
    share = f"{percent:.0f}" if percent >= 1 else f"{percent:.1g}"
    return f"about {format_bytes(space.stored_bytes)}, {between} 19 times of 20; {share} % of the source was tried"


def _beside(space: SpaceEstimate) -> str:
    return (
        f"{format_bytes(space.index_bytes)} of indexes, {format_bytes(space.record_bytes)} of records and "
        f"{format_bytes(space.piece_bytes)} of pieces"
    )


def _room(space: SpaceEstimate) -> str:
    needed = f"{format_bytes(space.occupied_bytes)} with all of these"
    return needed if space.free_bytes is None else f"{needed}, {format_bytes(space.free_bytes)} are free"


def _time(estimate: BuildEstimate) -> str:
    workers = f"with {estimate.workers} worker{'s' * (estimate.workers > 1)}"
    whole = f"about {duration(estimate.time_s)} {workers}"
    if estimate.remaining_s == estimate.time_s:
        return whole
    return f"{whole}, of which {duration(estimate.remaining_s)} are left" if estimate.remaining_s else f"nothing; in full {whole}"


def duration(seconds: float) -> str:
    """Return a time span for people: '0.4 s', '12 s', '3 min 20 s', '5 h 10 min', '3 d 4 h'."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    whole = round(seconds)
    for size, name, rest, rest_name in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            return f"{whole // size} {name} {whole % size // rest} {rest_name}"
    raise AssertionError(seconds)
