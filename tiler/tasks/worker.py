"""Running one task: reads its window in portions, filters, cuts and stores its blocks, hands its piece on, writes its record."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Final

import numpy as np

from schemas.errors import InputError, NotFoundError
from schemas.manifest import digest
from schemas.region import Rect
from tiler.building.plan import Plan
from tiler.filters.cascade import Cascade, Coverage, Values, held_windows
from tiler.stores import Store
from tiler.tasks.cut import CutBlock, Cutter, StageTimes, Target
from tiler.tasks.measure import measure
from tiler.tasks.overlap import read_all
from tiler.tasks.partition import Task
from tiler.tasks.pieces import PieceReader, PieceRef, PieceWriter
from tiler.tasks.records import RecordBook, TaskRecord
from tiler.tasks.rounding import round_samples
from tiler.tasks.stamps import SourceStamps

if TYPE_CHECKING:
    from tiler.cluster.job import Job

_PORTION_ROWS: Final = 256
_PORTION_BYTES: Final = 8 << 20
_MAX_PORTION_ROWS: Final = 1024
_LEAST_PUSHED_ROWS: Final = 256
"""Rows handed on at once, in whole rows of blocks: these are then cut out of what was read, without a copy in between."""


def portion_rows(width: int, channels: int, chunk_rows: int) -> int:
    """Return how many rows of ``width`` samples a task reads at once, of a source that decodes ``chunk_rows`` rows together."""
    affordable = _PORTION_BYTES // (width * channels * 4)
    return min(max(1, min(affordable, _PORTION_ROWS) // chunk_rows) * chunk_rows, _MAX_PORTION_ROWS)


def _slices(window: Rect, step: int) -> Iterator[slice]:
    """Yield the rows of ``window``, counted from its top, that lie between multiples of ``step``."""
    y = window.y0
    while y < window.y1:
        end = min(window.y1, (y // step + 1) * step)
        yield slice(y - window.y0, end - window.y0)
        y = end


@dataclass(frozen=True, slots=True)
class Work:
    """A task and the pieces of the tier below that it reads; a task of the first tier reads the source, and has none."""

    task: Task
    pieces: tuple[PieceRef, ...] = ()


@dataclass(frozen=True, slots=True)
class Done:
    """A finished task: its record, what it cost, whether an earlier run had done it already, and how many blocks were written."""

    task: Task
    record: TaskRecord
    times: StageTimes
    kept: bool
    written: int


class TaskWorker:
    """Runs tasks of one layer, from several threads; ``on_block`` is told how many more blocks are finished.

    A task whose record holds (same plan, same input, its blocks where they belong) is not run again.
    """

    def __init__(
        self,
        plan: Plan,
        target: Target,
        book: RecordBook,
        stamps: SourceStamps,
        on_block: Callable[[int], None] = lambda count: None,
        job: "Job | None" = None,
    ) -> None:
        self._plan, self._target, self._book, self._stamps = plan, target, book, stamps
        self.on_block = on_block
        self.job = job
        """What other processes need to know to run the same tasks; None if none may."""

    @property
    def store(self) -> Store:
        """Where blocks and records go."""
        return self._target.store

    def count(self, done: Done) -> None:
        """Count the blocks of a task that another process has run."""
        self.on_block(len(done.record.index()))

    def warm(self) -> None:
        """Load what tasks call, kernels mostly, without a sample of the source: a copy of this process then need not."""
        plan, side = self._plan, 64
        lean = plan.block.dtype if plan.recipe.edge == "mirror" and not plan.recipe.masked and not plan.linear_light else "float32"
        windows = held_windows((side, side), Rect(0, 0, side, side), [0] * 3, plan.recipe.kernel.reach)

        def sink(level: int, first: int, values: Values, coverage: Coverage | None) -> None:
            samples, _ = round_samples(values, coverage, plan.block, plan.linear_light)
            measure(samples, None, plan.block.channels - plan.block.alpha)

        values = np.zeros((side, side, plan.source.conversion.channels), lean)
        Cascade((side, side), windows, values.shape[2], plan.recipe, sink).push(values, None)
        plan.codec.encode(np.zeros((plan.block.side, plan.block.side, plan.block.channels), plan.block.dtype), None)

    def __call__(self, work: Work) -> Done:
        """Run a task, or find that its record holds; raises InputError or StorageError."""
        held = self._book.read(work.task)
        kept = None if held is None else self._still_valid(work, held)
        if kept is None:
            return self.run(work)
        self.on_block(len(kept.index()))
        return Done(work.task, kept, StageTimes(), kept=True, written=0)

    def _still_valid(self, work: Work, held: TaskRecord) -> TaskRecord | None:
        """Return the task's record, with its present stamp, if input and output are what it says."""
        if held.plan != self._plan.digest:
            return None
        stamp = self._stamp(work)
        fresh = held
        if held.stamp != stamp:
            if work.task.tier.first or self._content(work.task) != held.content:
                return None
            fresh = held.model_copy(update={"stamp": stamp})
        if not all(
            self._target.destination.holds(address, record) for address, record in held.entries(work.task, self._plan.lattice.block)
        ):
            return None
        if fresh is not held:
            self._book.write(work.task, fresh)
        return fresh

    def _windows(self, task: Task) -> list[Rect]:
        """Return the samples of every level of the tier, and of the level above it if that is handed on, which a task holds."""
        plan, tier = self._plan, task.tier
        pads = [plan.lattice.pad] * tier.count + [0] * tier.carry
        return held_windows(plan.lattice.level_size(tier.first), task.core, pads, plan.recipe.kernel.reach)

    def _stamp(self, work: Work) -> str:
        if work.task.tier.first == 0:
            return self._stamps.of(self._windows(work.task)[0])
        return digest("\n".join(f"{piece.task.core} {piece.digest}" for piece in work.pieces).encode())

    def _content(self, task: Task) -> str:
        """Return the digest of what a task of the first tier would read."""
        self._plan.source.begin()
        for window in self._portions(task, self._windows(task)[0]):
            self._plan.source.read_lean(window)
        return self._plan.source.digest()

    def _portions(self, task: Task, whole: Rect) -> Iterator[Rect]:
        """Yield the windows in which a task reads: whole tiles, or each would be decoded twice, but no more memory than needed."""
        rows = portion_rows(whole.width, self._plan.source.conversion.channels, 1 if task.tier.first else self._plan.source.info.chunk_rows)
        y = whole.y0
        while y < whole.y1:
            end = min(whole.y1, (y // rows + 1) * rows)
            yield Rect(whole.x0, y, whole.x1, end)
            y = end

    def run(self, work: Work) -> Done:
        """Run a task whatever its record says."""
        plan, task, tier = self._plan, work.task, work.task.tier
        blocks: list[CutBlock] = []

        def on_block(block: CutBlock) -> None:
            blocks.append(block)
            self.on_block(1)

        windows = self._windows(task)
        cutter = Cutter(self._target, tier.first, task.core, on_block)
        piece = PieceWriter(task, plan.source.conversion.channels, plan.recipe.masked) if tier.carry else None

        def sink(step: int, first: int, values: Values, coverage: Coverage | None) -> None:
            if step < tier.count:
                cutter.take(tier.first + step, first, values, coverage, windows[step].x0)
            elif piece is not None:
                piece.take(first, values, coverage, windows[step].x0)

        cascade = Cascade(plan.lattice.level_size(tier.first), windows, plan.source.conversion.channels, plan.recipe, sink)
        try:
            content = self._push(work, cascade, windows[0], cutter.times)
        finally:
            # Also when the task fails: nothing may be on its way any more when what is left is looked at, or deleted.
            cutter.finish()
        stamp = self._stamp(work)
        handed_on = None if piece is None else piece.data()
        record = TaskRecord.of(
            task, blocks, plan=plan.digest, stamp=stamp, content=content or stamp, piece=None if handed_on is None else digest(handed_on)
        )
        if handed_on is not None:
            self._book.write_piece(task, handed_on)
        self._book.write(task, record)
        return Done(task, record, cutter.times, kept=False, written=cutter.written)

    def _push(self, work: Work, cascade: Cascade, whole: Rect, times: StageTimes) -> str:
        """Push the task's window through the cascade; return the digest of what was read of the source, '' if nothing was."""
        plan, first = self._plan, work.task.tier.first
        samples = plan.source if first == 0 else PieceReader(work.pieces, self._load, plan.source.conversion.channels, plan.recipe.masked)
        plan.source.begin()
        started = perf_counter()
        for window in self._portions(work.task, whole):
            before_read = perf_counter()
            values, coverage = samples.read_lean(window)
            times.read_s += perf_counter() - before_read
            for rows in _slices(window, max(plan.lattice.block, _LEAST_PUSHED_ROWS)):
                cascade.push(values[rows], None if coverage is None else coverage[rows])
        times.filter_s = perf_counter() - started - times.read_s - times.encode_s - times.write_s
        return "" if first else plan.source.digest()

    def _load(self, pieces: Sequence[PieceRef]) -> list[bytes]:
        """Return the bytes of pieces; one that is lost or damaged is made again by the task that it came from, on this thread."""
        found = read_all(self._target.store, self._stored_piece, pieces)
        return [self._made_again(piece) if data is None else data for piece, data in zip(pieces, found, strict=True)]

    def _stored_piece(self, piece: PieceRef) -> bytes | None:
        try:
            data = self._book.read_piece(piece.task)
        except NotFoundError:
            return None
        return data if digest(data) == piece.digest else None

    def _made_again(self, piece: PieceRef) -> bytes:
        self.run(Work(piece.task, self.pieces(piece.task)))
        data = self._stored_piece(piece)
        if data is None:
            raise InputError(
                f"{self._plan.source.info.path}: does not give the samples again that it gave before; run clipmap build again, with "
                "--update if the layer is finished"
            )
        return data

    def ensure(self, task: Task) -> TaskRecord:
        """Return a task's record; one that is missing or of another plan is made by running the task."""
        held = self._book.read(task)
        if held is not None and held.plan == self._plan.digest:
            return held
        return self.run(Work(task, self.pieces(task))).record

    def pieces(self, task: Task) -> tuple[PieceRef, ...]:
        """Return the pieces that a task reads, as the records of the tier below say."""
        return tuple(PieceRef(below, self.ensure(below).piece or "") for below in self.below(task))

    def below(self, task: Task) -> list[Task]:
        """Return the tasks of the tier below whose pieces a task reads; none for the first tier."""
        number = self._plan.tiers.index(task.tier)
        if number == 0:
            return []
        lower = self._plan.tiers[number - 1]
        window = self._windows(task)[0]
        wanted = Rect(window.x0 << lower.count, window.y0 << lower.count, window.x1 << lower.count, window.y1 << lower.count)
        return list(self._plan.tasks(lower, wanted))
