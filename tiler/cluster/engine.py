"""Tasks on a Dask cluster: every worker process opens the job for itself, writes to the shared store, and sends back small records.

The scheduler keeps at most two tasks per thread of the cluster, so its memory does not grow with the picture. It hands the tasks
of a worker that died to others; a task that ran twice writes the same bytes twice.
"""

import logging
import pickle
import queue
import re
import socket
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, suppress
from importlib import import_module
from itertools import islice
from secrets import token_hex
from time import monotonic, sleep
from typing import Any, Final, Self

from schemas.errors import ClipmapError, MissingExtraError, StorageError, UsageError
from tiler.cluster.job import JobRef
from tiler.cluster.worker import Failed, TaskCall, leave_job, retire_jobs
from tiler.stores.directory import DirectoryStore
from tiler.tasks.worker import Done, TaskWorker, Work

_CONNECT_S: Final = 10
_MAX_GREETING_BYTES: Final = 65536
_PATIENCE_S: Final = 120.0
"""How long to wait for a first, or another, worker: about what a cloud takes to start a machine."""
_NOTICE_S: Final = 5.0
"""When to say what is waited for."""
_TASKS_PER_THREAD: Final = 2
"""One that runs and one that waits for it to end: else a thread idles for as long as an answer takes."""
_LEAST_TASKS: Final = 4
"""Submitted even if there is no worker: clusters that grow with the work start workers for them."""
_LOOK_S: Final = 1.0
"""How often the workers are counted anew."""
_WAIT_S: Final = 0.05
_LOGGERS: Final = ("distributed", "tornado", "asyncio", "bokeh")

Notice = Callable[[str], None]


class DaskEngine:
    """Runs tasks on the Dask cluster whose scheduler has the address ``scheduler``, as long as the context lasts.

    Workers need the same clipmap, see the sources under the same paths, and the store under the same path or URL. ``on_notice`` is
    given a sentence when there is something to wait for; without any worker the build ends after ``patience_s`` seconds.

    Entering raises MissingExtraError without ``distributed``, UsageError for what is no address, StorageError if nobody answers there.
    """

    def __init__(self, scheduler: str, on_notice: Notice = lambda sentence: None, patience_s: float = _PATIENCE_S) -> None:
        self._scheduler, self._on_notice, self._patience_s = scheduler, on_notice, patience_s
        self._context = ExitStack()
        self._client: Any = None
        self._job: JobRef | None = None

    def __enter__(self) -> Self:
        distributed = _distributed()
        _check_address(self._scheduler)
        with ExitStack() as context:
            context.enter_context(warnings.catch_warnings())
            # That versions differ is said where it matters: by the worker that would make other blocks.
            warnings.filterwarnings("ignore", module=r"(distributed|dask|tornado)\b")
            _silence()
            self._client = _connected(distributed, self._scheduler)
            self._context = context.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        with self._context, suppress(ClipmapError):
            try:
                if self._job is not None:
                    self._broadcast(leave_job, self._job.token)
            finally:
                self._client.close()

    def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
        """Yield what became of every task, as they end; raises the first error. Once it is closed no task is under way."""
        if worker.job is None:
            raise UsageError("these tasks run on this machine only; leave out --engine dask")
        job = worker.job.post(worker.store)
        if self._job is None or self._job.token != job.token:
            self._job = job
            self._wait_for_others(job)
        shift = _Shift(self._client, self._scheduler, job, self._on_notice, self._patience_s)
        try:
            for done in shift.run(works):
                worker.count(done)
                yield done
            self._clean_up_after(shift.lost, worker)
        finally:
            # An error that ends the run is not to be hidden by another one on the way out.
            with suppress(ClipmapError):
                if shift.busy:
                    self._broadcast(leave_job, job.token)
                    shift.wait()
                worker.store.delete([job.key])

    def _clean_up_after(self, lost: int, worker: TaskWorker) -> None:
        """Delete what workers that are gone may have been writing when they were killed; others have made it anew."""
        if not lost:
            return
        self._on_notice(f"{lost} workers have left {self._scheduler} meanwhile; what they had not finished was done by others")
        if worker.job is not None and isinstance(worker.store, DirectoryStore):
            for prefix in {worker.job.path, worker.job.tasks_path}:
                worker.store.delete_temporaries(prefix)

    def _wait_for_others(self, job: JobRef) -> None:
        """Wait until no task of a build of the same dataset that was killed is under way: it would write beside ours."""
        since, said = monotonic(), False
        while count := sum(self._broadcast(retire_jobs, job.location, job.token)):
            if not said and monotonic() - since > _NOTICE_S:
                said = True
                self._on_notice(f"waiting for {count} tasks of an earlier build of {job.location} that still run on the cluster")
            sleep(_LOOK_S)

    def _broadcast(self, function: Callable[..., int], *arguments: str) -> list[int]:
        """Call a function in every worker process, also in one whose threads are all busy; one that does not answer is left out."""
        try:
            answers: dict[str, Any] = self._client.run(function, *arguments, on_error="ignore")
        except OSError as error:
            raise _lost(self._scheduler) from error
        return [answer for answer in answers.values() if isinstance(answer, int)]


def _distributed() -> Any:  # noqa: ANN401 - an extra: its types are not there without it
    try:
        return import_module("distributed")
    except ModuleNotFoundError as error:
        raise MissingExtraError("--engine dask needs Dask's distributed: pip install 'clipmap[dask]'") from error


def _check_address(scheduler: str) -> None:
    """Raise UsageError for what Dask would take for an address and wait for, StorageError if something else than Dask answers there."""
    found = re.fullmatch(r"(?:(tcp|tls)://)?([\w.-]+|\[[0-9A-Fa-f:.%\w]+\]):(\d{1,5})", scheduler)
    if found is None or not 0 < int(found[3]) < 65536:
        raise UsageError(f"--scheduler {scheduler!r}: is no address of a Dask scheduler; it is like tcp://head:8786")
    if found[1] == "tls":
        return
    try:
        with socket.create_connection((found[2].strip("[]"), int(found[3])), timeout=_CONNECT_S) as connection:
            greeting = connection.recv(8)
    except ConnectionError:
        return  # it may be starting
    except OSError:
        greeting = b""
    # A scheduler speaks first, a frame of some dozen bytes that begins with its length. Of its own dashboard, Dask reads for ever.
    if not 0 < int.from_bytes(greeting, "little") < _MAX_GREETING_BYTES:
        raise _unanswered(scheduler)


def _connected(distributed: Any, scheduler: str) -> Any:  # noqa: ANN401
    # In two steps: a client that could not be made would wait 20 s for itself when it is deleted, and print a traceback.
    client = distributed.Client.__new__(distributed.Client)
    try:
        client.__init__(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except OSError as error:
        client.status = "closed"
        raise _unanswered(scheduler) from error
    except (TypeError, ValueError, RuntimeError) as error:
        client.status = "closed"
        raise UsageError(f"--scheduler {scheduler}: Dask cannot use this address: {error}") from error
    return client


def _silence() -> None:
    """Take away the handlers by which distributed writes to stderr when it is imported; who wants its log adds one to the root."""
    for name in [*_LOGGERS, *(name for name in logging.root.manager.loggerDict if name.startswith(tuple(f"{top}." for top in _LOGGERS)))]:
        logger = logging.getLogger(name)
        for handler in [handler for handler in logger.handlers if isinstance(handler, logging.StreamHandler)]:
            logger.removeHandler(handler)
            logger.propagate = True
        if name in _LOGGERS and not logger.handlers:
            logger.addHandler(logging.NullHandler())


def _unanswered(scheduler: str) -> StorageError:
    return StorageError(
        f"{scheduler}: no Dask scheduler answers there within {_CONNECT_S} s; start one with dask scheduler, or correct --scheduler"
    )


def _lost(scheduler: str) -> StorageError:
    return StorageError(f"{scheduler}: the connection to the scheduler was lost, or it has dropped the tasks; see its log")


class _Shift:
    """The tasks of one tier on their way to the cluster and back."""

    def __init__(self, client: Any, scheduler: str, job: JobRef, on_notice: Notice, patience_s: float) -> None:  # noqa: ANN401
        self._client, self._scheduler, self._job = client, scheduler, job
        self._on_notice, self._patience_s = on_notice, patience_s
        self._running: set[Any] = set()
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.lost = 0
        self._workers: dict[str, int] = {}
        self._threads = 0
        self._looked_s = self._last_seen_s = monotonic()
        self._said = False

    @property
    def busy(self) -> bool:
        """Whether tasks are under way."""
        return bool(self._running)

    def run(self, works: Iterable[Work]) -> Iterator[Done]:
        """Yield what became of every task; raises the first error, with the worker's name in a note."""
        waiting = iter(works)
        self._look()
        while True:
            room = max(_LEAST_TASKS, _TASKS_PER_THREAD * self._threads) - len(self._running)
            for work in islice(waiting, max(0, room)):
                self._submit(work)
            if not self._running:
                self._look()
                return
            if monotonic() - self._looked_s > _LOOK_S:
                self._look()
            yield from self._results(self._next_ended())

    def wait(self) -> None:
        """Return when no task is under way any more; what has not begun is to be left by the workers."""
        # Not by those announced as ended: an interrupt may have come after one was taken from the queue, and before it was noted.
        while self._running:
            self._running = {future for future in self._running if not future.done()}
            if monotonic() - self._looked_s > _LOOK_S:
                self._look()
            if not self._threads:
                break
            sleep(_WAIT_S)
        self._client.cancel(list(self._running))
        self._running.clear()

    def _submit(self, work: Work) -> None:
        task = work.task
        key = f"clipmap-{task.tier.first}-{task.core.x0}-{task.core.y0}-{token_hex(4)}"
        future = self._client.submit(pickle.loads, pickle.dumps(TaskCall(self._job, work)), key=key, pure=False)
        self._wait_for([future])

    def _wait_for(self, futures: list[Any]) -> None:
        self._running.update(futures)
        for future in futures:
            future.add_done_callback(self._ended.put)

    def _look(self) -> None:
        """Count the threads of the cluster; raises StorageError if the scheduler is gone, or there was no worker for too long."""
        self._looked_s = monotonic()
        try:
            workers: dict[str, int] = self._client.nthreads()
        except (OSError, RuntimeError) as error:  # the latter of a client that has given up
            raise _lost(self._scheduler) from error
        self.lost += len(self._workers.keys() - workers.keys())
        self._workers, self._threads = workers, sum(workers.values())
        if self._threads:
            self._last_seen_s, self._said = self._looked_s, False
        missing_s = self._looked_s - self._last_seen_s
        if missing_s > self._patience_s:
            raise StorageError(f"{self._scheduler}: has had no worker for {missing_s:.0f} s; start some with dask worker {self._scheduler}")
        if missing_s > _NOTICE_S and not self._said:
            self._said = True
            self._on_notice(f"{self._scheduler} has no worker; waiting for one to start")

    def _next_ended(self) -> list[Any]:
        """Return the futures that have ended, after at most a second."""
        found = []
        try:
            found.append(self._ended.get(timeout=_LOOK_S))
            while True:
                found.append(self._ended.get_nowait())
        except queue.Empty:
            pass
        self._running.difference_update(found)
        return found

    def _results(self, futures: list[Any]) -> Iterator[Done]:
        finished = [future for future in futures if future.status == "finished"]
        lost = [future for future in futures if future.status in ("lost", "pending")]
        for future in futures:
            if future not in finished and future not in lost:
                raise self._failure(future)
        if lost:
            # The worker died that had the result, and Dask has the task run again: its record holds, so that takes no time.
            sleep(_WAIT_S)
            self._wait_for(lost)
        try:
            outcomes = self._client.gather(finished)
        except Exception as error:
            raise self._explained(error) from error
        for outcome in outcomes:
            if isinstance(outcome, Failed):
                outcome.error.add_note(f"the error came from {outcome.worker}")
                raise outcome.error
            if outcome is not None:
                yield outcome

    def _failure(self, future: Any) -> BaseException:  # noqa: ANN401
        error = future.exception() if future.status == "error" else None
        return _lost(self._scheduler) if error is None else self._explained(error)

    def _explained(self, error: BaseException) -> BaseException:
        match type(error).__name__, error:
            case "KilledWorker", _:
                return StorageError(
                    f"{self._scheduler}: {getattr(error, 'allowed_failures', 0) + 1} workers died one after the other at the same task; "
                    "see their logs, and if memory ran out give them more, fewer threads, or a smaller --task"
                )
            case (("FutureCancelledError" | "CancelledError" | "FuturesCancelledError"), _):
                return _lost(self._scheduler)
            case _, ModuleNotFoundError() | AttributeError():
                return StorageError(f"{self._scheduler}: a worker has no clipmap, or another one; install the same on all ({error})")
        return error
