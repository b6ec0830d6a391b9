"""Trial tasks: windows spread over a source are read, filtered, cut and encoded as a build would do it, and nothing is stored."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import islice
from math import sqrt
from pathlib import Path
from typing import Final

from schemas.errors import NotFoundError, UsageError
from schemas.region import Rect
from tiler.building.plan import Plan
from tiler.estimate.memory import task_windows
from tiler.sources.convert import SampleSource
from tiler.stores import Claim
from tiler.tasks.cut import StageTimes, Target
from tiler.tasks.destination import NewBlocks
from tiler.tasks.engine import run_tasks
from tiler.tasks.partition import Task, Tier
from tiler.tasks.records import RecordBook
from tiler.tasks.stamps import SourceStamps
from tiler.tasks.worker import Done, TaskWorker, Work

_SIDE: Final = 1024
"""Side of a window [samples]: three levels of blocks of 256, in some 50 ms."""
_ROUND: Final = 16
_MOST: Final = 48
_PRECISE: Final = 0.1
"""Windows are tried in rounds of 16, up to 48, until the bytes are known to this share."""
_MOST_SAMPLES: Final = 1 << 25
_MOST_DECODED: Final = 1 << 29
"""Fewer windows of large blocks, and of wide strips that are decoded over their whole width: seconds are enough for a guess."""
_STUDENT: Final = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31)
"""How many standard errors hold the truth 19 times of 20, by degrees of freedom from 1."""
_STUDENT_BEYOND: Final = 2.2


@dataclass(frozen=True, slots=True)
class TriedLevel:
    """What the windows gave of one level: samples, blocks, blocks with bytes, and these bytes."""

    samples: int
    blocks: int
    stored: int
    stored_bytes: int


@dataclass(frozen=True, slots=True)
class Trial:
    """What trial windows gave: per level, and how far the bytes per sample may be off, as a share of them.

    ``windows`` are what the timed tasks read, ``times`` what they took in threads; both are without the first task, which loads or
    compiles the kernels, unless there is no other: ``loading_s`` is what that took longer. ``record_bytes`` is what a task record
    takes beside its blocks.
    """

    levels: list[TriedLevel]
    error: float
    complete: bool
    windows: list[Rect]
    times: StageTimes
    blocks_timed: int
    loading_s: float
    record_bytes: int


class _Nowhere:
    """A store that takes everything and keeps nothing."""

    location = "nowhere"
    scratch = Path()

    def read(self, key: str) -> bytes:
        raise NotFoundError(f"{key}: nothing is kept")

    def write(self, key: str, data: bytes) -> None:
        """Forget ``data``."""

    def delete(self, keys: Iterable[str]) -> None:
        """Do nothing."""

    def delete_prefix(self, prefix: str) -> None:
        """Do nothing."""

    def keys(self, prefix: str) -> list[str]:
        return []

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        raise UsageError("nothing to hold")

    def sync(self) -> None:
        """Do nothing."""


def try_windows(
    plan: Plan, stamps: SourceStamps, threads: int, open_window: Callable[[Rect], AbstractContextManager[SampleSource]] | None = None
) -> Trial:
    """Run tasks on windows spread over the source of ``plan``; raises InputError or StorageError if it cannot be read there.

    ``open_window`` gives a source to read a window of samples from, where that of the plan cannot be read before a build.
    """
    cells = _Cells(plan)
    target = Target(
        _Nowhere(),
        NewBlocks(_Nowhere(), plan.name, plan.name, plan.lattice.levels, plan.codec.suffix),
        plan.lattice,
        plan.block,
        plan.codec,
        plan.linear_light,
    )
    book = RecordBook(_Nowhere(), plan.name)

    def worker(work: Work) -> Done:
        if open_window is None:
            return TaskWorker(plan, target, book, stamps)(work)
        with open_window(task_windows(plan, work.task)[0]) as source:
            return TaskWorker(replace(plan, source=source), target, book, stamps)(work)

    order = cells.spread()
    # Alone, so that its time does not hide in that of the others.
    done = [worker(Work(cells.task(next(order))))]
    step = max(2, min(_ROUND, _MOST_SAMPLES // cells.area, _MOST_DECODED // cells.decoded))
    works = [Work(cells.task(cell)) for cell in islice(order, step - 1)]
    while works:
        done += run_tasks(worker, works, threads)
        if step < _ROUND or len(done) >= _MOST or _error(plan, done, cells.count) <= _PRECISE:
            break
        works = [Work(cells.task(cell)) for cell in islice(order, step)]
    return _summary(plan, done, cells.count)


class _Cells:
    """The windows that a source can be cut into, ``columns`` by ``rows``."""

    def __init__(self, plan: Plan) -> None:
        lattice = plan.lattice
        levels = min(lattice.levels, max(1, (_SIDE // lattice.block).bit_length()))
        self._tier = Tier(0, levels, carry=False)
        self._side = lattice.block << (levels - 1)
        self._whole = lattice.level_rect(0)
        self.columns, self.rows = -(-lattice.width // self._side), -(-lattice.height // self._side)
        self.count = self.columns * self.rows
        self.area = self._side**2
        self.decoded = self._side * (lattice.width if plan.source.info.layout == "striped" else self._side)

    def task(self, cell: tuple[int, int]) -> Task:
        x, y = cell[0] * self._side, cell[1] * self._side
        return Task(self._tier, Rect(x, y, x + self._side, y + self._side) & self._whole)

    def spread(self) -> Iterator[tuple[int, int]]:
        """Yield windows so that the first few are spread over the picture, each once; all of them if there are few."""
        seen: set[tuple[int, int]] = set()
        for step in range(4 * min(self.count, _MOST)):
            across, down = _sobol(step)
            cell = int(across * self.columns), int(down * self.rows)
            if cell not in seen:
                seen.add(cell)
                yield cell
        if self.count <= 4 * _MOST:
            yield from ((x, y) for y in range(self.rows) for x in range(self.columns) if (x, y) not in seen)


def _sobol(number: int) -> tuple[float, float]:
    """Return the first two coordinates of a point of Sobol's sequence, in the middle of its 1/256 of both axes (I. M. Sobol, 1967).

    Of every 16 points one lies in each sixteenth of the width, of the height, and of both in quarters. Eight windows by multiples of
    irrational numbers, tried before, left out a sixth of a picture that was void there.
    """
    across = down = 0
    first = second = 128
    while number:
        if number & 1:
            across, down = across ^ first, down ^ second
        number, first, second = number >> 1, first >> 1, second ^ second >> 1
    return (across + 0.5) / 256, (down + 0.5) / 256


def _summary(plan: Plan, done: Sequence[Done], count: int) -> Trial:
    levels = []
    for level in range(done[0].task.tier.count):
        records = [
            record for each in done for address, record in each.record.entries(each.task, plan.lattice.block) if address.level == level
        ]
        levels.append(
            TriedLevel(
                samples=sum((each.task.core.coarsened(level) & plan.lattice.level_rect(level)).area for each in done),
                blocks=len(records),
                stored=sum(not record.blank for record in records),
                stored_bytes=sum(record.length_bytes for record in records),
            )
        )
    timed = done[1:] or done
    times = StageTimes()
    for each in timed:
        times.add(each.times)
    blocks = [len(each.record.index()) for each in timed]
    return Trial(
        levels=levels,
        error=_error(plan, done, count),
        complete=len(done) == count,
        windows=[each.task.core for each in timed],
        times=times,
        blocks_timed=sum(blocks),
        loading_s=max(0.0, _total_s(done[0].times) - _total_s(times) / len(timed)),
        record_bytes=max(len(each.record.model_dump_json()) - len(each.record.blocks) for each in done),
    )


def _total_s(times: StageTimes) -> float:
    return times.read_s + times.filter_s + times.encode_s + times.write_s


def _error(plan: Plan, done: Sequence[Done], count: int) -> float:
    """Return how far bytes per sample may be off, as a share: that of a ratio of totals, of ``count`` windows without replacement.

    W. G. Cochran, "Sampling Techniques", 3rd edition, section 6.4.
    """
    if len(done) >= count:
        return 0.0
    sizes = [float(sum(record.length_bytes for _, record in each.record.entries(each.task, plan.lattice.block))) for each in done]
    areas = [each.task.core.area for each in done]
    if not any(sizes):
        return 1.0
    ratio = sum(sizes) / sum(areas)
    freedom = len(done) - 1
    spread = sum((size - ratio * area) ** 2 for size, area in zip(sizes, areas, strict=True)) / freedom
    deviation = sqrt(spread * (1 - len(done) / count) / len(done)) / (sum(areas) / len(done)) / ratio
    return deviation * (_STUDENT[freedom - 1] if freedom <= len(_STUDENT) else _STUDENT_BEYOND)
