"""Building a layer: source, plan, tasks, manifest. The manifest is written last and in one step.

Whatever a task has finished is kept until the layer is published, however a build ends: the same command goes on from there.
"""

import os
import resource
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Literal

from schemas.errors import ClipmapError, UsageError
from schemas.manifest import Layer, Manifest
from schemas.settings import BuildSettings
from tiler.cut import StageTimes
from tiler.engine import Engine, LocalEngine
from tiler.intent import can_be_continued, decide, find_ranges_known, layer_of
from tiler.job import Job, make_target
from tiler.ledger import Ledger
from tiler.pieces import PieceRef
from tiler.plan import Plan, plan_layer
from tiler.publish import Published, find_superseded, publish_layer, publish_update
from tiler.records import PlanRecord, RecordBook
from tiler.samples import open_samples
from tiler.sources.convert import SampleSource
from tiler.stamps import SourceStamps
from tiler.stores import Claim, Store
from tiler.stores.dataset import Dataset, read_manifest
from tiler.stores.locate import open_store
from tiler.stretch import Ranges, parse_stretch
from tiler.tasks import Task, Tier
from tiler.worker import Done, TaskWorker, Work

Progress = Callable[[int, int], None]
"""Called with (blocks finished, blocks in all), from any thread, one call at a time."""
Outcome = Literal["built", "continued", "updated", "up to date"]


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What a build did: the manifest, the layer's name, remarks for the user, and what it cost.

    ``tasks_kept`` of ``tasks`` were found finished; ``blocks_written`` is how many blocks' bytes were stored.
    """

    manifest: Manifest
    layer: str
    outcome: Outcome
    remarks: tuple[str, ...]
    times: StageTimes
    wall_s: float
    megasamples: float
    peak_rss_bytes: int
    tasks: int
    tasks_kept: int
    blocks_written: int


def build_layer(
    sources: Path | Sequence[Path],
    output: str | Path,
    settings: BuildSettings,
    on_progress: Progress = lambda done, total: None,
    engine: Engine | None = None,
) -> BuildReport:
    """Build one layer of the dataset at ``output``, a folder or a URL, from the file (or, as a mosaic, files) ``sources``, and publish it.

    The dataset is made if it does not exist; a build that did not end is continued. Until the manifest is replaced, readers see
    the old dataset, or none. Raises UsageError, InputError or StorageError; then, and when interrupted, finished tasks are kept.
    """
    started = perf_counter()
    sources = [sources] if isinstance(sources, Path) else list(sources)
    if settings.stretch is not None:
        parse_stretch(settings.stretch)
    store = open_store(output)
    for path in sources:
        refuse_inside(path, store)
    with store.exclusive(settings.break_lock) as claim:
        dataset = read_manifest(store)
        if dataset is None:
            refuse_foreign(store, claim)
        workers = settings.workers or _processors()

        def known_ranges(source: SampleSource) -> Ranges | None:
            return find_ranges_known(store, claim, dataset, source, settings)

        samples = open_samples(sources, store.scratch, settings, workers, known_ranges)
        try:
            plan = plan_layer(samples, dataset, settings)
            engine = engine or LocalEngine(plan.workers)
            build = _Build(plan, sources, store, claim, dataset, SourceStamps(samples.info), settings, engine)
            build.run(on_progress)
        finally:
            samples.close()
    return build.report(perf_counter() - started)


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _peak_rss_bytes() -> int:
    """Return the largest resident set this process has had; ``getrusage`` would count a parent's, inherited by fork."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def refuse_inside(path: Path, store: Store) -> None:
    """Refuse a source that lies in the dataset: a rebuild deletes the folder of the layer it replaces."""
    folder = Path(store.location)
    if path.exists() and path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(f"{path}: lies inside {folder}, where the dataset is to be; move one of them")


def refuse_foreign(store: Store, claim: Claim) -> None:
    """Refuse a place that holds something else than a dataset or an unfinished one, of which there is no need to list the blocks."""
    foreign = () if claim.abandoned else sorted({key.partition("/")[0] for key in store.keys("")})
    if foreign:
        raise UsageError(f"{store.location}: not a dataset, and not empty (it holds {foreign[0]}); choose another folder for -o")


class _Build:
    """One build under its claim."""

    def __init__(
        self,
        plan: Plan,
        sources: Sequence[Path],
        store: Store,
        claim: Claim,
        dataset: Manifest | None,
        stamps: SourceStamps,
        settings: BuildSettings,
        engine: Engine,
    ) -> None:
        self._sources, self._store, self._claim, self._dataset = sources, store, claim, dataset
        self._stamps, self._settings, self._engine = stamps, settings, engine
        self._layer = None if dataset is None else dataset.layers.get(plan.name)
        self._sweep(plan.name)
        self._intent = decide(store, claim, dataset, plan, stamps, settings)
        record = self._intent.record
        # The records of another partition would be of no use, and blocks do not depend on it.
        self.plan = plan if record is None else replace(plan, partition=record.partition)
        self._book = RecordBook(store, self._intent.tasks_path)
        self._times = StageTimes()
        self._noted = self._kept = self._written = 0
        self._changed = False
        self.manifest = dataset

    def _sweep(self, name: str) -> None:
        """Delete what an update that was published, and then killed, did not come to delete."""
        if self._layer is not None and set(self._claim.abandoned) & {patch.path for patch in self._layer.patches}:
            self._store.delete(find_superseded(self._store, name, self._layer))

    def run(self, on_progress: Progress) -> None:
        """Do what is to be done, and delete what is superseded."""
        intent = self._intent
        foreign = [path for path in self._claim.abandoned if layer_of(path) != self.plan.name]
        others = [path for path in foreign if can_be_continued(self._store, self._dataset, path)]
        obsolete = [path for path in self._claim.abandoned if path not in others and path != intent.path]
        if intent.act != "nothing":
            replaced = self._layer.paths if self._layer is not None and intent.act == "build" else []
            self._claim.announce(*others, *obsolete, *replaced, intent.path)
            with self._kept_on_failure(others):
                published = self._build(on_progress)
            self.manifest, self._changed = published.manifest, published.changed
            self._store.delete(published.superseded_keys)
            obsolete += published.superseded_paths
        self._delete(obsolete)
        self._claim.announce(*others)

    def _delete(self, paths: Sequence[str]) -> None:
        """Delete of ``paths`` those that no manifest names; an update that changed nothing leaves an empty one."""
        named = set() if self.manifest is None else {path for layer in self.manifest.layers.values() for path in layer.paths}
        for path in {*paths, self._intent.path} - named:
            self._store.delete_prefix(path)
        if not self._settings.records and self._intent.act != "nothing":
            self._book.delete()

    @contextmanager
    def _kept_on_failure(self, others: Sequence[str]) -> Iterator[None]:
        """Say how much is kept when a build does not end; if no task was finished there is nothing to keep."""
        try:
            yield
        except BaseException as error:
            with suppress(ClipmapError):
                # Of an update every task has a record, that of the published layer if no newer one.
                finished = self._book.finished() if self._intent.act == "build" else self._noted
                if finished > 0:
                    error.add_note(f"{finished} of {self.plan.task_count} tasks are finished and kept: the same command goes on from there")
                elif self._intent.act == "build" and self._intent.record is None:
                    self._store.delete_prefix(self._intent.path)
                    self._claim.announce(*others)
            raise

    def _build(self, on_progress: Progress) -> Published:
        plan, intent = self.plan, self._intent
        record = self._plan_record()
        RecordBook(self._store, intent.path).write_plan(record)
        ledger = Ledger(plan.lattice, plan.source.conversion.channels)
        counter = _Counter(plan, on_progress)
        published = None if self._dataset is None else Dataset(self._store, self._dataset)
        target = make_target(plan, self._store, intent.path, published if intent.act == "update" else None)
        worker = TaskWorker(plan, target, self._book, self._stamps, counter.add, self._job(record))
        pieces: dict[Task, str] = {}
        for tier in plan.tiers:
            handed_on: dict[Task, str] = {}
            # Closed however the loop ends, so that no task is under way any more when what is kept is counted.
            with closing(self._engine.run(worker, self._works(worker, tier, pieces))) as finished:
                for done in finished:
                    self._note(done, ledger)
                    if done.record.piece is not None:
                        handed_on[done.task] = done.record.piece
            pieces = handed_on
        self._stamps.require_unchanged()
        self._claim.confirm()
        if intent.act == "update" and published is not None:
            # Killed after the manifest and before the last line, the next build must not take the dataset for that of the old source.
            self._book.write_plan(record.model_copy(update={"stamps": []}))
            result = publish_update(plan, self._store, intent.path, ledger, published)
            self._book.write_plan(record)
            RecordBook(self._store, intent.path).delete()
            return result
        return publish_layer(plan, self._store, intent.path, ledger, self._dataset)

    def _works(self, worker: TaskWorker, tier: Tier, pieces: dict[Task, str]) -> Iterator[Work]:
        for task in self.plan.tasks(tier):
            yield Work(task, tuple(PieceRef(below, pieces[below]) for below in worker.below(task)))

    def _note(self, done: Done, ledger: Ledger) -> None:
        ledger.enter(done.task, done.record)
        self._noted += 1
        self._times.add(done.times)
        self._kept += done.kept
        self._written += done.written

    def _job(self, record: PlanRecord) -> Job:
        intent = self._intent
        return Job(
            sources=[str(path.absolute()) for path in self._sources],
            record=record,
            path=intent.path,
            tasks_path=intent.tasks_path,
            update=intent.act == "update",
            version=None if self._dataset is None else self._dataset.version,
        )

    def _plan_record(self) -> PlanRecord:
        return PlanRecord(
            signature=self.plan.signature,
            place=self.plan.place,
            partition=self.plan.partition,
            sources=self._stamps.paths,
            stamps=self._stamps.stamps,
            ranges=list(self.plan.source.conversion.stretch or ()),
            settings=self._settings.model_copy(update={"overwrite": False, "update": False, "break_lock": False}),
        )

    def report(self, wall_s: float) -> BuildReport:
        """Return what was done."""
        plan, manifest = self.plan, self.manifest
        if manifest is None:
            raise UsageError("nothing was built")
        return BuildReport(
            manifest=manifest,
            layer=plan.name,
            outcome=self._outcome(),
            remarks=_remarks(plan, manifest.layers[plan.name]) + self._continued(),
            times=self._times,
            wall_s=wall_s,
            megasamples=plan.lattice.width * plan.lattice.height / 1e6,
            peak_rss_bytes=_peak_rss_bytes(),
            tasks=plan.task_count,
            tasks_kept=self._kept if self._intent.act != "nothing" else plan.task_count,
            blocks_written=self._written,
        )

    def _outcome(self) -> Outcome:
        if self._intent.act == "update":
            return "updated" if self._changed else "up to date"
        if self._intent.act == "nothing":
            return "up to date"
        return "built" if self._intent.record is None else "continued"

    def _continued(self) -> tuple[str, ...]:
        if self._intent.act == "nothing" or self._claim.predecessor is None or not self._kept:
            return ()
        return (f"went on with what {self._claim.predecessor} had left: {self._kept} of {self.plan.task_count} tasks were finished",)


class _Counter:
    """Counts finished blocks from any thread."""

    def __init__(self, plan: Plan, on_progress: Progress) -> None:
        counts = (plan.lattice.block_counts(level) for level in range(plan.lattice.levels))
        self._total, self._done = sum(columns * rows for columns, rows in counts), 0
        self._on_progress = on_progress
        self._lock = threading.Lock()

    def add(self, count: int) -> None:
        """Count more blocks; a piece that had to be made again counts its task's blocks twice."""
        with self._lock:
            self._done = min(self._done + count, self._total)
            self._on_progress(self._done, self._total)


def _remarks(plan: Plan, layer: Layer) -> tuple[str, ...]:
    """Return what the user should know although nothing is wrong."""
    remarks = []
    name = plan.source.info.path.name
    if plan.placement.how == "fitted":
        remarks.append(f"{name} has no georeference: spread over the dataset's extent")
    if plan.placement.how == "assumed":
        remarks.append(f"{name} has no georeference and no --spacing: samples lie one unit apart")
    if layer.statistics.valid == 0:
        remarks.append(f"{name} has no valid sample: every block is blank")
    return tuple(remarks)
