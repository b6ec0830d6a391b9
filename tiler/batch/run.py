"""Many jobs, one after the other and side by side: within a bound on memory, each in a process that may die alone."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from time import perf_counter
from typing import Final

from schemas.batch import BatchReport, JobReport
from tiler.batch.jobs import Build, Built, Check, Checked, Job, JobProcess, Request, explain_death
from tiler.estimate.machine import PROCESS_BYTES
from tiler.stores.locate import is_remote

Progress = Callable[[int, int], None]
"""Called with (jobs done, jobs in all)."""

_KEEPS_TOO_MUCH_BYTES: Final = 2 * PROCESS_BYTES
"""A process that keeps more than this after a job is replaced: what its allocator has not given back, others could use."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a batch may use at once: processes, threads of a job (None: processors are shared out), and memory (None: no bound)."""

    processes: int
    workers: int | None
    memory_bytes: int | None


def run_batch(jobs: Sequence[Job], bounds: Bounds, on_progress: Progress = lambda done, total: None) -> BatchReport:
    """Do all jobs and return what became of each; a job that fails, or whose process dies, fails alone.

    First the headers of all sources are read: what cannot be done is known before anything is built. Jobs for one dataset run in the
    order given; if one fails, those after it are not begun, as its layer decides where theirs lie. When interrupted, jobs under way
    end at their next task and keep what is finished; the interrupt gets notes that say so.
    """
    started = perf_counter()
    batch = _Batch(jobs, bounds, on_progress)
    try:
        batch.check()
        batch.build()
    except BaseException as error:
        for note in batch.interrupt():
            error.add_note(note)
        raise
    finally:
        batch.close()
    reports = batch.reports()
    failed = sum(report.reason is not None for report in reports)
    return BatchReport(jobs=reports, failed=failed, wall_s=perf_counter() - started, memory_bytes=bounds.memory_bytes)


@dataclass(slots=True)
class _Running:
    """A job at work."""

    number: int
    memory_bytes: int
    started: float
    workers: int


class _Batch:
    """The jobs, the processes, and which does which."""

    def __init__(self, jobs: Sequence[Job], bounds: Bounds, on_progress: Progress) -> None:
        self._jobs, self._bounds, self._on_progress = jobs, bounds, on_progress
        self._reports: dict[int, JobReport] = {}
        self._checked: dict[int, Checked] = {}
        self._running: dict[JobProcess, _Running] = {}
        self._idle: dict[JobProcess, int] = {}
        self._before = _predecessors(jobs)
        self._processors = len(os.sched_getaffinity(0))
        on_progress(0, len(jobs))

    def reports(self) -> list[JobReport]:
        """Return what became of the jobs, in their order."""
        return [self._reports[number] for number in range(len(self._jobs))]

    def check(self) -> None:
        """Learn what every job needs; those that cannot be done have failed."""
        waiting = list(range(len(self._jobs)))
        limit = self._bounds.memory_bytes
        most = min(self._bounds.processes, self._bounds.processes if limit is None else max(1, limit // PROCESS_BYTES))
        while waiting or self._running:
            while waiting and (process := self._process(most)) is not None:
                number = waiting.pop(0)
                request = Check(self._jobs[number], self._bounds.workers or self._processors)
                self._give(process, request, _Running(number, PROCESS_BYTES, perf_counter(), 1))
            for process, running, answer in self._answers():
                if isinstance(answer, Checked):
                    self._checked[running.number] = answer
                    self._idle[process] = PROCESS_BYTES
                reason = answer.reason if isinstance(answer, Checked) else explain_death(process.end())
                if reason is not None:
                    self._enter(running.number, self._jobs[running.number].report(outcome="failed", reason=reason))
        self._refuse_twins()

    def _refuse_twins(self) -> None:
        """Refuse a second job for a layer: it would find the first one's, and take it for an old state of its own."""
        first: dict[tuple[str, str | None], Job] = {}
        for number, job in enumerate(self._jobs):
            if number in self._reports:
                continue
            twin = first.setdefault((_place(job), self._checked[number].layer), job)
            if twin is not job:
                reason = (
                    f"{job.name} and {twin.name} both become the layer {self._checked[number].layer!r} of {job.output}; give one of them "
                    "another output"
                )
                self._enter(number, job.report(outcome="failed", reason=reason))

    def build(self) -> None:
        """Do the jobs."""
        while len(self._reports) < len(self._jobs):
            begun = True
            while begun:
                begun = any(self._begin(number) for number in self._waiting())
            for process, running, answer in self._answers():
                if isinstance(answer, Built):
                    self._keep(process, answer.resident_bytes, over=answer.report.outcome == "interrupted")
                    report = answer.report
                else:
                    report = self._jobs[running.number].report(outcome="failed", reason=explain_death(process.end()))
                self._enter(
                    running.number,
                    report.model_copy(
                        update={
                            "wall_s": report.wall_s or perf_counter() - running.started,
                            "memory_bytes": running.memory_bytes,
                            "workers": running.workers,
                        }
                    ),
                )

    def _waiting(self) -> list[int]:
        """Return the jobs that have not begun, the largest first: begun last, it would run alone while processors are idle."""
        at_work = {running.number for running in self._running.values()}
        waiting = [number for number in range(len(self._jobs)) if number not in self._reports and number not in at_work]
        return sorted(waiting, key=lambda number: -self._checked[number].samples)

    def _begin(self, number: int) -> bool:
        """Begin a job, or find that it cannot be done; False if it has to wait."""
        job, before = self._jobs[number], self._before[number]
        if before is not None:
            if before not in self._reports:
                return False
            if self._reports[before].reason is not None:
                reason = f"not begun, as the job before it for {job.output} has failed: {self._jobs[before].name}"
                self._enter(number, job.report(outcome="not begun", reason=reason))
                return True
        memory = self._checked[number].memory_bytes
        workers = self._workers(memory)
        if workers == 0:
            self._enter(number, job.report(outcome="failed", reason=self._too_large(memory[0])))
            return True
        if len(self._running) >= self._bounds.processes or not self._make_room(memory[workers - 1]):
            return False
        process = self._process(self._bounds.processes)
        if process is None:
            return False
        self._give(process, Build(job, workers), _Running(number, memory[workers - 1], perf_counter(), workers))
        return True

    def _workers(self, memory: Sequence[int]) -> int:
        """Return how many threads a job gets: its share, or fewer if so many would not stay within the bound even alone."""
        limit = self._bounds.memory_bytes
        beside = max(1, min(self._bounds.processes, len(self._running) + len(self._waiting())))
        share = self._bounds.workers or max(1, self._processors // beside)
        return next((count for count in range(share, 0, -1) if limit is None or memory[count - 1] <= limit), 0)

    def _too_large(self, least_bytes: int) -> str:
        limit = self._bounds.memory_bytes or 0
        return (
            f"needs about {least_bytes >> 20} MiB of memory with one worker, more than the {limit >> 20} MiB that the batch may use; "
            "give more with --memory, or a smaller --task"
        )

    def _make_room(self, needed_bytes: int) -> bool:
        """Whether a job that needs so much can begin now; processes without work are ended for it, but for the one that does it."""
        limit = self._bounds.memory_bytes
        if limit is None:
            return True
        used = sum(running.memory_bytes for running in self._running.values())
        if used + needed_bytes > limit:
            return False
        for process in list(self._idle)[1:]:
            if used + needed_bytes + sum(list(self._idle.values())[1:]) <= limit:
                break
            del self._idle[process]
            process.end()
        return True

    def _process(self, most: int) -> JobProcess | None:
        """Return a process without work, a new one if there may be more, else None."""
        for process in self._idle:
            del self._idle[process]
            return process
        return JobProcess() if len(self._running) < most else None

    def _give(self, process: JobProcess, request: Request, running: _Running) -> None:
        """Let a process begin with a request; one that has died meanwhile, without work, is replaced."""
        if not process.ask(request):
            process.end()
            process = JobProcess()
            process.ask(request)
        self._running[process] = running

    def _keep(self, process: JobProcess, resident_bytes: int, over: bool) -> None:
        if over or resident_bytes > _KEEPS_TOO_MUCH_BYTES:
            process.end()
        else:
            self._idle[process] = resident_bytes

    def _answers(self) -> list[tuple[JobProcess, _Running, Checked | Built | None]]:
        """Wait until a process answers or dies; return all that have."""
        if not self._running:
            return []
        ready = set(wait([process.connection for process in self._running]))
        found = [process for process in self._running if process.connection in ready]
        return [(process, self._running.pop(process), process.answer()) for process in found]

    def _enter(self, number: int, report: JobReport) -> None:
        self._reports[number] = report
        self._on_progress(len(self._reports), len(self._jobs))

    def interrupt(self) -> list[str]:
        """End what is under way at the next task; return what is done and what is kept, for people."""
        notes = []
        for process in self._running:
            process.interrupt()
        for process, running in list(self._running.items()):
            answer = process.answer()
            if isinstance(answer, Built):
                job, report = self._jobs[running.number], answer.report
                self._reports[running.number] = report
                notes += [f"{job.name}: {note}" for note in report.notes if report.reason is not None]
        done = sum(report.reason is None for report in self._reports.values())
        return [*notes, f"{done} of {len(self._jobs)} jobs are done; the same command does the rest"]

    def close(self) -> None:
        """End all processes; those still at work, after a second interrupt, at once."""
        for process in self._idle:
            process.end()
        for process in self._running:
            process.end(kill=True)


def _place(job: Job) -> str:
    return job.output if is_remote(job.output) else str(Path(job.output).absolute())


def _predecessors(jobs: Sequence[Job]) -> list[int | None]:
    """Return, for every job, the last one before it for the same dataset."""
    last: dict[str, int] = {}
    found: list[int | None] = []
    for number, job in enumerate(jobs):
        found.append(last.get(_place(job)))
        last[_place(job)] = number
    return found
