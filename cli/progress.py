"""The progress bar of long work."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Final

_DRAW_EVERY_S: Final = 0.1


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on stderr if that is a terminal; gives a function to call with (done, total)."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    # Drawn when there is something new: a thread that draws it anew all the time would keep builds from using processes.
    with Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False) as bar:
        task = bar.add_task(what, total=None)
        drawn_s = -_DRAW_EVERY_S

        def update(done: int, total: int) -> None:
            nonlocal drawn_s
            due = monotonic() - drawn_s >= _DRAW_EVERY_S
            drawn_s = monotonic() if due else drawn_s
            bar.update(task, completed=done, total=total, refresh=due)

        yield update
