"""``clipmap batch``: many sources, many datasets, one report."""

import os
import re
from typing import Any, Final

import click
from click.core import ParameterSource

from cli.commands.build import command as build
from cli.exit_codes import DONE, FOUND
from cli.jobs import read_jobs
from cli.options import build_settings
from cli.output import emit_json, emit_table, format_bytes
from cli.plan_text import duration
from cli.progress import progress_bar
from schemas.batch import BatchReport, JobReport

_OWN: Final = {"sources", "output", "mosaic", "only_plan", "engine", "scheduler", "workers", "as_json"}
"""Options of ``clipmap build`` that make no sense for many sources, or mean something else here."""
_UNITS: Final = {"": 0, "K": 1, "M": 2, "G": 3, "T": 4}
_SHARE: Final = 0.75
"""Of the memory there is: estimates are not exact, and other programs want some."""


def parse_memory(context: click.Context, parameter: click.Parameter, value: str | None) -> int | None:
    """Return the bytes that ``4G``, ``500M`` or ``1.5 GiB`` means, in powers of 1024; a callback of click."""
    if value is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?", value.strip(), re.IGNORECASE)
    if found is None or float(found[1]) == 0:
        raise click.BadParameter(f"{value!r}: a size like 4G, 500M or 1.5GiB")
    return int(float(found[1]) * 1024 ** _UNITS[found[2].upper()])


@click.command(short_help="Build many datasets, side by side, with one report.")
@click.argument("jobs", metavar="JOBS.toml|SOURCE...", nargs=-1, required=True)
@click.option("-o", "--output", required=True, help="Folder, or URL, that the datasets are made in.")
@click.option("--jobs", "processes", type=click.IntRange(1, 1024), help="Jobs at a time, at most.  [default: one per processor]")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads per job.  [default: processors are shared out]")
@click.option(
    "--memory", metavar="SIZE", callback=parse_memory, help="What all jobs together may take, e.g. 4G.  [default: 3/4 of what is free]"
)
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.pass_context
def command(
    context: click.Context,
    /,
    jobs: tuple[str, ...],
    output: str,
    processes: int | None,
    workers: int | None,
    memory: int | None,
    as_json: bool,
    **options: Any,  # noqa: ANN401 - click's options, checked by BuildSettings
) -> int:
    """Build a dataset of every SOURCE, named after it, in the folder OUTPUT; or do the jobs of a file JOBS.toml.

    SOURCE is a file or a pattern such as 'scenes/**/*.tif'. A file of jobs says more: several layers of one dataset, mosaics, settings
    per job; see docs/BATCH.md. Options given here hold for all jobs, whatever the file says.

    All headers are read first. Then jobs run side by side, as many as stay within the memory by an estimate. A job that fails, or
    whose process dies, fails alone. The same command again does only what is missing.

    The exit status is 0 if all went well, and 1 if any job failed.

    \b
    clipmap batch 'scenes/*.tif' -o out --codec webp:85
    clipmap batch alps.toml -o out --memory 4G
    """
    given = {name: value for name, value in options.items() if context.get_parameter_source(name) == ParameterSource.COMMANDLINE}
    build_settings(given)
    listed = read_jobs(jobs, output, given)
    from tiler.batch.run import Bounds, run_batch
    from tiler.estimate.machine import available_bytes

    if memory is None and (free := available_bytes()) is not None:
        memory = int(_SHARE * free)
    bounds = Bounds(min(processes or len(os.sched_getaffinity(0)), len(listed)), workers, memory)
    with progress_bar("jobs") as on_progress:
        report = run_batch(listed, bounds, on_progress)
    if as_json:
        emit_json(report.model_dump(mode="json"))
    else:
        _show(report, output)
    return FOUND if report.failed else DONE


command.params[-1:-1] = [parameter for parameter in build.params if parameter.name not in _OWN]


def _show(report: BatchReport, folder: str) -> None:
    rows = [_row(job, _above(report), folder) for job in report.jobs]
    emit_table(("source", "dataset", "layer", "outcome", "blocks", "bytes", "time"), rows, left=(0, 1, 2, 3))
    for job in report.jobs:
        for note in job.notes:
            click.echo(f"note: {_source(job)}: {note}", err=True)
        if job.reason is not None:
            click.echo(f"{job.outcome}: {job.reason if job.sources[0] in job.reason else f'{_source(job)}: {job.reason}'}")
    outcomes = [job.outcome for job in report.jobs]
    counts = ", ".join(f"{outcomes.count(outcome)} {outcome}" for outcome in dict.fromkeys(outcomes))
    click.echo(f"{len(report.jobs)} jobs in {duration(report.wall_s)}: {counts}")


def _above(report: BatchReport) -> str:
    """Return the folder that all sources lie in, which the table need not repeat."""
    folders = {os.path.dirname(source) for job in report.jobs for source in job.sources}
    return f"{os.path.commonpath(folders)}/" if len({os.path.isabs(folder) for folder in folders}) == 1 else ""


def _row(job: JobReport, above: str, folder: str) -> tuple[str, ...]:
    dataset = job.dataset.removeprefix(f"{folder.rstrip('/')}/")
    place = _source(job).removeprefix(above), dataset, job.layer or "-", job.outcome
    if job.reason is not None:
        return *place, "-", "-", duration(job.wall_s)
    return *place, str(job.blocks), format_bytes(job.stored_bytes), duration(job.wall_s)


def _source(job: JobReport) -> str:
    more = len(job.sources) - 1
    return f"{job.sources[0]}{f' and {more} more' if more else ''}"
