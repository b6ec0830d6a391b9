"""One build of a layer under its claim: runs what is to be run, publishes, and deletes what is superseded."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Final

from schemas.errors import ClipmapError
from schemas.manifest import Manifest
from schemas.settings import BuildSettings
from tiler.building.intent import Intent
from tiler.building.plan import Plan
from tiler.building.publish import Published, publish_layer, publish_update
from tiler.cluster.job import Job, make_target
from tiler.cluster.samplecopy import SampleCopy, delete_copy
from tiler.stores import Claim, Store
from tiler.stores.dataset import Dataset
from tiler.tasks.cut import StageTimes
from tiler.tasks.engine import Engine
from tiler.tasks.ledger import Ledger
from tiler.tasks.partition import Task, Tier
from tiler.tasks.pieces import PieceRef
from tiler.tasks.records import PlanRecord, RecordBook
from tiler.tasks.stamps import SourceStamps
from tiler.tasks.worker import Done, TaskWorker, Work

_LOOK_EVERY_S: Final = 30.0
Progress = Callable[[int, int], None]
"""Called with (blocks finished, blocks in all), from any thread, one call at a time."""


class LayerBuild:
    """A build with an intent that is to build or to update; ``run`` does it, once.

    Afterwards ``manifest`` is the published one, ``changed`` says whether it is new, ``kept`` of the plan's tasks were found
    finished, and ``written`` is how many blocks were stored.

    ``samples`` is the copy of the plan's samples that tasks in other processes read, made here unless it is there; None if they need none.
    """

    def __init__(
        self,
        plan: Plan,
        intent: Intent,
        sources: Sequence[Path],
        store: Store,
        claim: Claim,
        dataset: Manifest | None,
        stamps: SourceStamps,
        settings: BuildSettings,
        engine: Engine,
        samples: SampleCopy | None = None,
    ) -> None:
        # The records of another partition would be of no use, and blocks do not depend on it.
        self.plan = plan if intent.record is None else replace(plan, partition=intent.record.partition)
        self._intent, self._sources, self._store, self._claim = intent, sources, store, claim
        self._dataset, self._stamps, self._settings, self._engine, self._copy = dataset, stamps, settings, engine, samples
        self._book = RecordBook(store, intent.tasks_path)
        self._is_update = intent.act == "update"
        self._is_continued = intent.path in claim.abandoned
        self._next_look = monotonic() + _LOOK_EVERY_S
        self.times = StageTimes()
        self.kept = self.written = self._noted = 0
        self.changed = False
        self.manifest: Manifest | None = dataset

    def run(self, on_progress: Progress) -> None:
        """Build and publish the layer, and delete what is superseded; raises InputError or StorageError."""
        intent = self._intent
        layer = None if self._dataset is None else self._dataset.layers.get(self.plan.name)
        published_paths = [] if layer is None else layer.paths
        # Those of the published layer too: an update drops some, and half-written files under them are nobody's.
        self._claim.announce(*intent.kept, *intent.obsolete, *published_paths, intent.path)
        with self._kept_on_failure():
            published = self._build(on_progress)
        self.manifest, self.changed = published.manifest, published.changed
        self._store.delete(published.superseded_keys)
        named = {path for entry in published.manifest.layers.values() for path in entry.paths}
        # An update that changed nothing leaves an empty path.
        for path in sorted({*intent.obsolete, *published.superseded_paths, intent.path} - named):
            self._store.delete_prefix(path)
        if not self._settings.records:
            self._book.delete()
        self._claim.announce(*intent.kept)

    @property
    def processes_bytes(self) -> int:
        """What processes of this machine in which tasks ran held at most, besides what they shared with this one [bytes]."""
        return int(getattr(self._engine, "peak_bytes", 0))

    @contextmanager
    def _kept_on_failure(self) -> Iterator[None]:
        """Say how much is kept when a build does not end; if no task was finished there is nothing to keep."""
        try:
            yield
        except BaseException as error:
            with suppress(ClipmapError):
                # Of an update every task has a record, that of the published layer if no newer one.
                finished = self._noted if self._is_update else self._book.finished()
                if finished > 0:
                    error.add_note(f"{finished} of {self.plan.task_count} tasks are finished and kept: the same command goes on from there")
                elif not self._is_continued:
                    self._store.delete_prefix(self._intent.path)
                    self._claim.announce(*self._intent.kept, *self._intent.obsolete)
            raise

    def _build(self, on_progress: Progress) -> Published:
        plan, intent = self.plan, self._intent
        record = self._plan_record()
        RecordBook(self._store, intent.path).write_plan(record)
        if self._copy is not None and not self._copy.holds(plan.source):
            self._copy.make(plan.source)
        ledger = Ledger(plan.lattice, plan.source.conversion.channels)
        published = Dataset(self._store, self._dataset) if self._is_update and self._dataset is not None else None
        target = replace(make_target(plan, self._store, intent.path, published), unnamed=True)
        worker = TaskWorker(plan, target, self._book, self._stamps, _Counter(plan, on_progress).add, self._job(record))
        pieces: dict[Task, str] = {}
        for tier in plan.tiers:
            handed_on: dict[Task, str] = {}
            # Closed however the loop ends, so that no task is under way any more when what is kept is counted.
            with closing(self._engine.run(worker, self._works(worker, tier, pieces))) as finished:
                for done in finished:
                    self._note(done, ledger)
                    self._look_at_source()
                    if done.record.piece is not None:
                        handed_on[done.task] = done.record.piece
            pieces = handed_on
        if plan.light is not None or plan.normals is not None:
            # Before the layer is published: until then everything under the path is this build's, however it ends.
            delete_copy(self._store, intent.path)
        self._stamps.require_unchanged()
        self._claim.confirm()
        if published is None:
            return publish_layer(plan, self._store, intent.path, ledger, self._dataset, self._is_continued)
        # Killed after the manifest and before the last plan, the next build must not take the dataset for that of the old source.
        self._book.write_plan(record.model_copy(update={"act": "build", "stamps": []}))
        result = publish_update(plan, self._store, intent.path, ledger, published, self._is_continued)
        self._book.write_plan(record.model_copy(update={"act": "build"}))
        RecordBook(self._store, intent.path).delete()
        return result

    def _look_at_source(self) -> None:
        """Raise InputError if a source file has changed; looked at so often that a build does not go on for hours for nothing."""
        if monotonic() > self._next_look:
            self._stamps.require_unchanged()
            self._next_look = monotonic() + _LOOK_EVERY_S

    def _works(self, worker: TaskWorker, tier: Tier, pieces: dict[Task, str]) -> Iterator[Work]:
        for task in self.plan.tasks(tier):
            yield Work(task, tuple(PieceRef(below, pieces[below]) for below in worker.below(task)))

    def _note(self, done: Done, ledger: Ledger) -> None:
        ledger.enter(done.task, done.record)
        self._noted += 1
        self.times.add(done.times)
        self.kept += done.kept
        self.written += done.written

    def _job(self, record: PlanRecord) -> Job:
        return Job(
            sources=record.sources,
            record=record,
            path=self._intent.path,
            tasks_path=self._intent.tasks_path,
            update=self._is_update,
            version=None if self._dataset is None else self._dataset.version,
            copied=self._copy is not None,
        )

    def _plan_record(self) -> PlanRecord:
        return PlanRecord(
            act="update" if self._is_update else "build",
            signature=self.plan.signature,
            place=self.plan.place,
            partition=self.plan.partition,
            sources=[str(path.absolute()) for path in self._sources],
            stamps=self._stamps.stamps,
            ranges=list(self.plan.source.conversion.stretch or ()),
            light=self.plan.light_settings,
            normals=self.plan.normal_settings,
            settings=self._settings.model_copy(update={"overwrite": False, "update": False, "break_lock": False}),
        )


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
