"""Tasks in processes of this machine: copies of this one, forked when everything is imported, compiled and understood.

Threads share Python's lock: with two of them the part of a task that is Python, and every call of a kernel, waits for the other's
(1.4 to 1.6 times as long). A copy has a lock of its own, and shares with the process that it comes from whatever neither has changed.
"""

import ctypes
import gc
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from multiprocessing.connection import Connection, Pipe, wait
from time import monotonic, sleep
from typing import Any, Final, NoReturn

from schemas.errors import ClipmapError, StorageError
from tiler.sources.geo import share_cache
from tiler.tasks.engine import run_tasks
from tiler.tasks.memory import own_peak_bytes
from tiler.tasks.worker import Done, TaskWorker, Work

_PARENTS_BUSINESS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that reach every process of a terminal or a service; what becomes of the tasks then is decided in one place."""
_PR_SET_PDEATHSIG: Final = 1
"""Of Linux's prctl.h."""
_LOOKS: Final = 5
_TELL_EVERY_S: Final = 0.1
"""How often a process says how many blocks it has finished."""


@dataclass(frozen=True, slots=True)
class _Failed:
    """A task that ended in an error."""

    error: BaseException


@dataclass(frozen=True, slots=True)
class _Left:
    """A process that ends: what it held in memory at most besides what it shares with the one it comes from [bytes]."""

    peak_bytes: int


_Answer = int | Done | _Failed | _Left
"""What a process says: so many more blocks are finished, a task is done or failed, or it ends."""


def can_fork() -> bool:
    """Whether this process can be copied: on Linux, as long as it has one thread, libraries' own included.

    A thread is not copied, but a lock that it holds is, for ever locked; macOS's own libraries do not outlive a fork.
    """
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    for _ in range(_LOOKS):
        with suppress(OSError):
            if len(os.listdir("/proc/self/task")) == 1:
                return True
        sleep(0.001)  # to Python a thread has ended a moment before it has for the system
    return False


class ProcessEngine:
    """Runs tasks in ``workers`` processes, or on as many threads where there can be none (``can_fork``) or is only one task.

    A process that dies ends the run by a StorageError; the others finish their tasks. When this process dies, they are killed.
    ``peak_bytes`` is what the processes held in memory at most besides what they share with this one.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self.peak_bytes = 0

    def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
        """Yield what became of every task, as they end; raises the first error. Once it is closed no task is under way."""
        waiting = iter(works)
        first = list(islice(waiting, self._workers))
        works = chain(first, waiting)
        if len(first) < 2 or not can_fork():
            yield from run_tasks(worker, works, self._workers)
            return
        worker.warm()
        crew = _Crew(worker, len(first))
        try:
            hired = sum(crew.hire() for _ in first)
            yield from crew.run(works) if hired else run_tasks(worker, works, self._workers)
        finally:
            crew.dismiss()
            self.peak_bytes = max(self.peak_bytes, crew.peak_bytes)


@dataclass(eq=False, slots=True)
class _Hand:
    """A process at work, seen from the one that started it."""

    process: int
    connection: Connection
    busy: bool = False


class _Crew:
    """The processes of one run."""

    def __init__(self, worker: TaskWorker, size: int) -> None:
        self._worker, self._size = worker, size
        self._hands: list[_Hand] = []
        self.peak_bytes = 0

    def hire(self) -> bool:
        """Start a process; False if the system gives none."""
        ours, theirs = Pipe()
        # Blocked, or an interrupt could be the copy's before it has learned to leave that to us, or find a process that nobody notes.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _PARENTS_BUSINESS)
        try:
            process = _forked()
            if process == 0:
                # Of the others too: as long as anybody holds the other end, nobody learns that we have died.
                held = [ours, *(hand.connection for hand in self._hands)]
                _be_a_hand(self._worker, theirs, held, self._size)
            self._hands.append(_Hand(process, ours))
        except OSError:  # too many processes, or too little memory
            ours.close()
            return False
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        return True

    def run(self, works: Iterator[Work]) -> Iterator[Done]:
        """Hand out the tasks and yield what became of them; raises the first error."""
        for hand in self._hands:
            self._give(hand, works)
        while busy := [hand.connection for hand in self._hands if hand.busy]:
            ready = set(wait(busy))
            for hand in self._hands:
                if hand.connection not in ready:
                    continue
                answer = self._heard(hand)
                if isinstance(answer, Done):
                    self._give(hand, works)
                    yield answer

    def _give(self, hand: _Hand, works: Iterator[Work]) -> None:
        for work in works:
            with suppress(OSError):  # it has died: that is noticed when it does not answer
                hand.connection.send(work)
            hand.busy = True
            return
        hand.busy = False

    def _heard(self, hand: _Hand) -> _Answer:
        """Return what a process says; raises the error of its task, StorageError if it says nothing more."""
        try:
            answer: _Answer = hand.connection.recv()
        except (EOFError, OSError):
            hand.busy = False
            raise self._explained(hand) from None
        match answer:
            case int():
                self._worker.on_block(answer)
            case _Failed(error):
                hand.busy = False
                raise error
            case _Left(peak_bytes):
                self.peak_bytes += peak_bytes
        return answer

    def _explained(self, hand: _Hand) -> StorageError:
        self._hands.remove(hand)
        hand.connection.close()
        status = os.waitstatus_to_exitcode(os.waitpid(hand.process, 0)[1])
        where = f"{self._worker.store.location}: one of the build's processes"
        if status == -signal.SIGKILL:
            return StorageError(f"{where} was killed, most often because the machine had no memory left; try fewer --workers")
        if status < 0:
            return StorageError(f"{where} crashed ({signal.Signals(-status).name}), perhaps over a damaged source; try --workers 1")
        return StorageError(f"{where} ended unexpectedly, with exit status {status}; try --workers 1")

    def dismiss(self) -> None:
        """Let every process end its task, and wait until it has; an interrupt meanwhile kills them."""
        try:
            for hand in self._hands:
                with suppress(OSError):
                    hand.connection.send(None)
            for hand in list(self._hands):
                self._wait_for(hand)
        except BaseException:
            for hand in self._hands:
                with suppress(ProcessLookupError, ChildProcessError):  # it has ended, and that was noted
                    os.kill(hand.process, signal.SIGKILL)
                    os.waitpid(hand.process, 0)
                hand.connection.close()
            raise

    def _wait_for(self, hand: _Hand) -> None:
        # What a task comes to that was under way when another one failed is in the store, or is done again: nobody asks for it here.
        with suppress(EOFError, OSError):
            while not isinstance(answer := hand.connection.recv(), _Left):
                if isinstance(answer, int):
                    self._worker.on_block(answer)
            self.peak_bytes += answer.peak_bytes
        os.waitpid(hand.process, 0)
        self._hands.remove(hand)
        hand.connection.close()


def _forked() -> int:
    """Copy this process; what there is of Python's objects is not looked at for garbage in the copy.

    Looking writes to them, and what one of two processes writes to is copied. Returns what ``os.fork`` does; raises OSError.
    """
    frozen = gc.get_freeze_count()
    gc.freeze()
    process = -1
    try:
        process = os.fork()
    finally:
        if process and not frozen:
            gc.unfreeze()
    return process


def _be_a_hand(worker: TaskWorker, connection: Connection, held: list[Connection], size: int) -> NoReturn:
    """Do in a new process what it is for, one of ``size``, and end it; what the one it comes from had still to do is not for it."""
    status = 1
    with suppress(BaseException):
        die_with_parent = ctypes.CDLL(None).prctl
        die_with_parent(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        for each in held:
            each.close()
        for number in _PARENTS_BUSINESS:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _PARENTS_BUSINESS)
        share_cache(size)
        # On a thread of its own: sources have a handle of each file per thread, and those of the first one are shared with others.
        thread = threading.Thread(target=_work, args=(worker, connection))
        thread.start()
        thread.join()
        status = 0
    os._exit(status)


def _work(worker: TaskWorker, connection: Connection) -> None:
    """Run the tasks that come, until None does or nobody is there any more."""
    tally = _Tally(connection.send)
    worker.on_block = tally.add
    with suppress(EOFError, OSError):
        while (work := connection.recv()) is not None:
            answer = _outcome(worker, work)
            tally.tell()
            connection.send(answer)
        connection.send(_Left(own_peak_bytes()))


def _outcome(worker: TaskWorker, work: Work) -> Done | _Failed:
    try:
        return worker(work)
    except BaseException as error:
        if not isinstance(error, ClipmapError):  # a mistake of ours: where it was made would be lost on the way
            error.add_note("".join(traceback.format_exception(error)))
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # one that cannot be sent; what it says can
            return _Failed(RuntimeError("".join(traceback.format_exception(error))))
        return _Failed(error)


class _Tally:
    """Counts finished blocks and says so from time to time."""

    def __init__(self, tell: Callable[[Any], None]) -> None:
        self._tell = tell
        self._count, self._next_s = 0, 0.0

    def add(self, count: int) -> None:
        """Count more blocks."""
        self._count += count
        if monotonic() > self._next_s:
            self.tell()

    def tell(self) -> None:
        """Say how many there are that have not been told."""
        if self._count:
            self._tell(self._count)
        self._count, self._next_s = 0, monotonic() + _TELL_EVERY_S
