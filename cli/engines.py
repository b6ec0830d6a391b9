"""The engine that ``--engine`` and ``--scheduler`` name."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from schemas.errors import UsageError

if TYPE_CHECKING:
    from tiler.tasks.engine import Engine


@contextmanager
def open_engine(name: str, scheduler: str | None) -> Iterator["Engine | None"]:
    """Give the engine; None means this machine's threads. Raises UsageError if the two options contradict each other."""
    if name == "local":
        if scheduler is not None:
            raise UsageError("--scheduler is for --engine dask; add it, or leave out --scheduler")
        yield None
        return
    if scheduler is None:
        raise UsageError("--engine dask needs the address of the scheduler, e.g. --scheduler tcp://head:8786")
    from tiler.cluster.engine import DaskEngine

    with DaskEngine(scheduler, lambda sentence: click.echo(f"note: {sentence}", err=True)) as engine:
        yield engine
