"""The main program of the processes that do the jobs of a batch."""

import os
import signal
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NoReturn

from schemas.batch import JobReport
from schemas.errors import ClipmapError
from tiler.batch.jobs import Answer, Build, Built, Check, Checked, Request
from tiler.building.build import build_layer
from tiler.estimate.build import plan_from_headers
from tiler.estimate.memory import build_memory_bytes

_LAST_S: Final = 60.0
"""How long a job may take to end when nobody waits for its answer any more."""


def serve(descriptor: int) -> None:
    """Answer the requests that come through the socket ``descriptor`` until it is closed; the main program of a job's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, _interrupt)
    with Connection(descriptor) as connection, suppress(KeyboardInterrupt, OSError):
        inbox = _Inbox(connection)
        while (request := inbox.take()) is not None:
            answer = _answer(request)
            connection.send(answer)
            if isinstance(answer, Built) and answer.report.outcome == "interrupted":
                return


def _interrupt(number: int, frame: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: what is under way is being ended
    raise KeyboardInterrupt


class _Inbox:
    """Requests as they come; when none can come any more, a job that is at work is interrupted."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._arrived = threading.Semaphore(0)
        self._requests: list[Request | None] = []
        threading.Thread(target=self._listen, name="inbox", daemon=True).start()

    def _listen(self) -> None:
        request: Request | None
        while True:
            try:
                request = self._connection.recv()
            except (EOFError, OSError):
                request = None
            self._requests.append(request)
            self._arrived.release()
            if request is None:
                break
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_LAST_S)
        os._exit(1)

    def take(self) -> Request | None:
        """Return the next request, None if there will be none."""
        self._arrived.acquire()
        return self._requests.pop(0)


def _answer(request: Request) -> Answer:
    if isinstance(request, Check):
        return _check(request)
    return Built(_build(request), _status_bytes("VmRSS"))


def _check(request: Check) -> Checked:
    job = request.job
    settings = job.settings.model_copy(update={"workers": request.workers})
    try:
        plan = plan_from_headers(job.sources, job.output, settings)
        memory = tuple(build_memory_bytes(plan, count) for count in range(1, request.workers + 1))
        return Checked(plan.name, plan.lattice.level_rect(0).area, memory, None)
    except Exception as error:  # a job fails alone
        return Checked(None, 0, (), _reason(error))


def _build(request: Build) -> JobReport:
    job = request.job
    _reset_peak()
    known = {"workers": request.workers}
    try:
        report = build_layer(job.sources, job.output, job.settings.model_copy(update={"workers": request.workers}))
    except KeyboardInterrupt as error:
        return job.report(outcome="interrupted", reason="interrupted", notes=_notes(error), peak_rss_bytes=_status_bytes("VmHWM"), **known)
    except Exception as error:  # a job fails alone
        return job.report(outcome="failed", reason=_reason(error), notes=_notes(error), peak_rss_bytes=_status_bytes("VmHWM"), **known)
    levels = report.manifest.layers[report.layer].levels
    return job.report(
        layer=report.layer,
        outcome=report.outcome,
        blocks=sum(level.stored for level in levels),
        blocks_written=report.blocks_written,
        tasks=report.tasks,
        tasks_kept=report.tasks_kept,
        stored_bytes=sum(level.stored_bytes for level in levels),
        wall_s=report.wall_s,
        peak_rss_bytes=_status_bytes("VmHWM"),
        notes=list(report.remarks),
        **known,
    )


def _reason(error: Exception) -> str:
    if isinstance(error, ClipmapError):
        return str(error)
    if isinstance(error, MemoryError):
        return "not enough memory; use fewer --jobs or --workers, or a smaller --task"
    return f"unexpected error, please report it: {type(error).__name__}: {' '.join(str(error).split())}"


def _notes(error: BaseException) -> list[str]:
    return list(getattr(error, "__notes__", ()))


def _reset_peak() -> None:
    """Let the kernel count the largest resident set anew (``proc_pid_clear_refs(5)``): the process had other jobs before."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _status_bytes(name: str) -> int:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return 0
