"""Jobs of a batch, and the processes in which they run: each does many, so that kernels are loaded once, and may die without harm.

A process is a new interpreter that gets one end of a socket pair. It answers one request after the other, and ends when the other end
is closed, which the kernel does however the process of the batch ends. What it does is in ``tiler.batch.server``.
"""

import signal
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from socket import socketpair
from typing import Any, Final

from schemas.batch import JobReport
from schemas.settings import BuildSettings

_PROGRAM: Final = "import sys; from tiler.batch.server import serve; serve(int(sys.argv[1]))"


@dataclass(frozen=True, slots=True)
class Job:
    """One layer to build."""

    sources: tuple[Path, ...]
    output: str
    settings: BuildSettings

    @property
    def name(self) -> str:
        """The sources for messages."""
        more = len(self.sources) - 1
        return f"{self.sources[0]}{f' and {more} more' if more else ''}"

    def report(self, **fields: Any) -> JobReport:  # noqa: ANN401 - fields of the report
        """Return a report of this job in which everything not given is nothing."""
        nothing: dict[str, Any] = dict.fromkeys(
            ("blocks", "blocks_written", "tasks", "tasks_kept", "stored_bytes", "wall_s", "workers", "memory_bytes", "peak_rss_bytes"), 0
        )
        known = {"sources": [str(path) for path in self.sources], "dataset": self.output, "layer": None, "reason": None, "notes": []}
        return JobReport(**(nothing | known | fields))


@dataclass(frozen=True, slots=True)
class Check:
    """Ask what a job needs, by the headers of its sources, with 1 to ``workers`` threads."""

    job: Job
    workers: int


@dataclass(frozen=True, slots=True)
class Checked:
    """What a job needs: the layer it makes, of so many samples, and memory by number of threads from 1; or why it cannot be done."""

    layer: str | None
    samples: int
    memory_bytes: tuple[int, ...]
    reason: str | None


@dataclass(frozen=True, slots=True)
class Build:
    """Ask to do a job, with so many threads."""

    job: Job
    workers: int


@dataclass(frozen=True, slots=True)
class Built:
    """What became of a job, and what the process keeps in memory afterwards."""

    report: JobReport
    resident_bytes: int


Request = Check | Build
Answer = Checked | Built


class JobProcess:
    """A process that does jobs, seen from the process of the batch."""

    def __init__(self) -> None:
        ours, theirs = socketpair()
        # Ctrl-C reaches all processes of a terminal; what a job does then is the batch's decision. A blocked signal stays blocked
        # in the new program until it is ready for it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", *_warnings(), "-c", _PROGRAM, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        self.connection = Connection(ours.detach())
        self.pid = self._process.pid

    def ask(self, request: Request) -> bool:
        """Send a request; return whether the process is there to get it."""
        try:
            self.connection.send(request)
        except OSError:
            return False
        return True

    def answer(self) -> Answer | None:
        """Wait for the answer and return it; None if the process has died instead."""
        try:
            answer: Answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        return answer

    def interrupt(self) -> None:
        """Ask the process to end its job at the next task; it answers, and ends."""
        self._process.terminate()

    def end(self, kill: bool = False) -> int:
        """Let the process end, or kill it; return its exit status, the negative number of the signal that ended it."""
        self.connection.close()
        if kill:
            self._process.kill()
        return self._process.wait()


def _warnings() -> list[str]:
    return [f"-W{option}" for option in sys.warnoptions]


def explain_death(status: int) -> str:
    """Return why a job failed whose process ended with ``status`` before it answered."""
    kept = "what it had finished is kept: the same command goes on from there"
    if status == -signal.SIGKILL:
        return f"its process was killed, most often because the machine had no memory left; {kept}, with fewer --jobs or --workers"
    if status < 0:
        return f"its process crashed ({signal.Signals(-status).name}), perhaps over a damaged source; {kept}"
    return f"its process ended unexpectedly, with exit status {status}; {kept}"
