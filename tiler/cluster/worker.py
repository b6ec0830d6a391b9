"""What a worker process of a cluster does: opens the jobs that it is given tasks of, once each, and runs the tasks on its threads."""

import ctypes
import os
import pickle
import sys
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Final

from schemas.errors import ClipmapError, UsageError
from tiler.cluster.job import JobRef, OpenJob, open_job
from tiler.tasks.worker import Done, TaskWorker, Work

_MAX_IDLE: Final = 2
"""Jobs kept open while no thread works on them: builds that share a cluster take turns."""
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
"""Numbers of glibc's malloc.h."""
_REMEMBERED: Final = 1000
"""Jobs of which it is remembered that they have ended; a task of one may be in the queue, but not for long."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A task that ended in an error meant for the user, and on which worker."""

    error: ClipmapError
    worker: str


Outcome = Done | Failed | None
"""What became of a task; None if its job had ended before it began."""


class TaskCall:
    """A task on its way to a worker: to unpickle it is to run it.

    So what is submitted is ``pickle.loads`` and bytes, which a scheduler understands that has no clipmap.
    """

    def __init__(self, ref: JobRef, work: Work) -> None:
        self._ref, self._work = ref, work

    def __reduce__(self) -> tuple[Callable[[JobRef, str, bytes], Outcome], tuple[JobRef, str, bytes]]:
        # The work apart, so that another version is noticed before it is misunderstood.
        return run_task, (self._ref, version("clipmap"), pickle.dumps(self._work))


def run_task(ref: JobRef, built_by: str, work: bytes) -> Outcome:
    """Run a pickled ``Work`` of a job in this process."""
    try:
        if built_by != version("clipmap"):
            raise UsageError(
                f"the build runs with clipmap {built_by}, a worker with {version('clipmap')}; install the same on all machines"
            )
        with _DESK.use(ref) as worker:
            return None if worker is None else worker(pickle.loads(work))
    except ClipmapError as error:
        return Failed(error, _this_worker())


def leave_job(token: str) -> int:
    """Begin no more tasks of a job, and close its sources as soon as none runs; returns how many run."""
    return _DESK.leave(lambda ref: ref.token == token, token)


def retire_jobs(location: str, token: str) -> int:
    """Leave all jobs of the store at ``location`` but the one with ``token``; returns how many of their tasks run."""
    return _DESK.leave(lambda ref: ref.location == location and ref.token != token)


def _keep_freed_memory() -> None:
    """Let malloc keep freed memory, as it does anywhere else; Dask's nanny has it given back at once (MALLOC_TRIM_THRESHOLD_).

    Our arrays of some MiB come and go all the time: that every one is mapped anew and filled with zeros makes tasks take 2.1 times as
    long. The mmap threshold is what glibc's own adaptation leads to, at most; it adapts no more once a threshold was set.
    """
    if "MALLOC_TRIM_THRESHOLD_" in os.environ:
        with suppress(AttributeError, OSError):  # a C library without it
            libc = ctypes.CDLL(None)
            libc.mallopt(_M_MMAP_THRESHOLD, 32 << 20)
            libc.mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def _this_worker() -> str:
    """Return who we are, as the cluster's log calls us."""
    distributed: Any = sys.modules.get("distributed")
    try:
        name = f"worker {distributed.get_worker().address}"
    except (AttributeError, ValueError):  # not called by a worker
        name = f"process {os.getpid()}"
    return f"{name} on {os.uname().nodename}"


@dataclass(slots=True)
class _Held:
    """A job, its open sources if a thread has opened them, and how many threads work on it."""

    job: OpenJob | None = None
    threads: int = 0
    opening: threading.Lock = field(default_factory=threading.Lock)


class _Desk:
    """The jobs that this process works on, for all its threads."""

    def __init__(self) -> None:
        self._held: OrderedDict[JobRef, _Held] = OrderedDict()
        self._ended: deque[str] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()

    @contextmanager
    def use(self, ref: JobRef) -> Iterator[TaskWorker | None]:
        """Give the worker of a job, open as long as the context lasts; None if the job has ended. Raises as ``open_job`` does."""
        with self._lock:
            if ref.token in self._ended:
                held = None
            else:
                held = self._held.setdefault(ref, _Held())
                held.threads += 1
                self._held.move_to_end(ref)
        if held is None:
            yield None
            return
        try:
            with held.opening:
                if held.job is None:
                    held.job = open_job(ref)
                    _keep_freed_memory()
            yield held.job.worker
        finally:
            with self._lock:
                held.threads -= 1
            self._close_idle()

    def leave(self, which: Callable[[JobRef], bool], *tokens: str) -> int:
        """Begin no more tasks of the jobs ``which`` and of those with ``tokens``, which may not be open yet; return how many run."""
        with self._lock:
            left = [ref for ref in self._held if which(ref)]
            self._ended.extend({*tokens, *(ref.token for ref in left)} - set(self._ended))
            running = sum(self._held[ref].threads for ref in left)
        self._close_idle()
        return running

    def _close_idle(self) -> None:
        closing = []
        with self._lock:
            idle = [ref for ref, held in self._held.items() if held.threads == 0]
            kept = [ref for ref in idle if ref.token not in self._ended][-_MAX_IDLE:]
            closing = [self._held.pop(ref) for ref in idle if ref not in kept]
        for held in closing:
            if held.job is not None:
                held.job.close()


_DESK: Final = _Desk()
