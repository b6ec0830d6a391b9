"""Where tasks run: on threads of this machine (kernels, codecs and readers release the GIL), or wherever another engine takes them."""

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from tiler.tasks.worker import Done, TaskWorker, Work

Task = TypeVar("Task")
Result = TypeVar("Result")


def run_tasks(work: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Generator[Result]:
    """Yield the results of ``work`` on every task, as they come, with at most ``workers`` at a time.

    Tasks are taken from the iterable only when a worker is free. The first error ends the run once the tasks under way have
    ended, and is raised.
    """
    waiting = iter(tasks)
    running: set[Future[Result]] = set()
    with ThreadPoolExecutor(workers, thread_name_prefix="clipmap") as pool:
        try:
            while True:
                for task in waiting:
                    running.add(pool.submit(work, task))
                    if len(running) >= workers:
                        break
                if not running:
                    return
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            for future in running:
                future.cancel()


class Engine(Protocol):
    """Runs the tasks of a tier; the results do not depend on the engine."""

    def run(self, worker: "TaskWorker", works: Iterable["Work"]) -> Generator["Done"]:
        """Yield what became of every task, as they end; raises the first error. Once it is closed no task is under way."""
        ...


class LocalEngine:
    """Runs tasks on ``workers`` threads of this process."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def run(self, worker: "TaskWorker", works: Iterable["Work"]) -> Generator["Done"]:
        """Yield what became of every task, as they end; raises the first error. Once it is closed no task is under way."""
        return run_tasks(worker, works, self._workers)
