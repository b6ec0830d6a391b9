"""Making damaged blocks and indexes again, from the source, by the tasks that made them; nothing else is written.

What is restored has the digest that the manifest vouches for, so a repaired dataset is byte for byte the one that was published.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError
from schemas.findings import Finding, VerifyReport
from schemas.manifest import digest
from schemas.settings import LightSettings, NormalSettings
from tiler.building.plan import Plan, plan_layer
from tiler.checking.verify import Checks, verify
from tiler.samples.opening import open_samples
from tiler.sources.convert import BakedSource, SampleSource
from tiler.stores.dataset import Dataset, read_manifest
from tiler.tasks.cut import Target
from tiler.tasks.destination import DamagedBlocks
from tiler.tasks.engine import run_tasks
from tiler.tasks.ledger import Ledger
from tiler.tasks.partition import Task, plan_block_task
from tiler.tasks.records import PlanRecord, RecordBook
from tiler.tasks.stamps import SourceStamps
from tiler.tasks.worker import TaskWorker, Work

_BLOCK_DAMAGE: Final = {"missing", "length", "digest", "unreadable"}
_INDEX_DAMAGE: Final = {"index", "unreadable"}
Progress = Callable[[int, int], None]


def verify_and_repair(
    dataset: Dataset, names: Sequence[str] | None, checks: Checks, on_progress: Progress = lambda done, total: None
) -> VerifyReport:
    """Check layers as ``verify`` does, restore damaged indexes and blocks, and check again.

    The report has the findings that are left, those that were mended, and why others could not be. Keeps builds out meanwhile.
    Raises what ``verify`` raises, and StorageError if the dataset cannot be written.
    """
    with dataset.store.exclusive() as claim:
        # So that the next build clears what a repair that is killed leaves half-written.
        claim.announce(*claim.abandoned, *(path for layer in dataset.manifest.layers.values() for path in layer.paths))
        if read_manifest(dataset.store) != dataset.manifest:
            raise StorageError(f"{dataset.store.location}: was rebuilt meanwhile; run clipmap verify again")
        before = report = verify(dataset, names, checks, on_progress)
        notes: list[str] = []
        if any(_is_index(found) for found in before.findings):
            # Blocks under a damaged index were not checked yet.
            notes += _each_layer(dataset, before, checks, _Repair.restore_indexes)
            report = verify(Dataset(dataset.store, dataset.manifest), names, checks)
        fresh = Dataset(dataset.store, dataset.manifest)
        notes += _each_layer(fresh, report, checks, _Repair.restore_blocks)
        found = {_key(each): each for each in [*before.findings, *report.findings]}
        after = verify(Dataset(dataset.store, dataset.manifest), names, checks) if found else report
        dataset.store.sync()
        claim.announce(*claim.abandoned)
    left = {_key(each) for each in after.findings}
    repaired = [each.model_copy(update={"remedy": "restored"}) for key, each in found.items() if key not in left]
    return after.model_copy(update={"repaired": repaired, "notes": list(dict.fromkeys(notes))})


def _key(found: Finding) -> tuple[object, ...]:
    return found.layer, found.level, found.x, found.y, found.file


def _is_index(found: Finding) -> bool:
    return found.kind in _INDEX_DAMAGE and found.x is None and found.level is not None


def _each_layer(dataset: Dataset, report: VerifyReport, checks: Checks, restore: Callable[["_Repair"], None]) -> list[str]:
    """Run ``restore`` on every layer with findings; return why what could not be restored."""
    notes = []
    for name in dict.fromkeys(found.layer for found in report.findings):
        findings = [found for found in report.findings if found.layer == name]
        try:
            repair = _Repair(dataset, name, findings, checks.workers or 1)
            try:
                restore(repair)
            finally:
                repair.close()
        except ClipmapError as error:
            notes.append(f"{name}: nothing could be restored: {error}")
        else:
            notes += repair.notes
    return notes


class _Repair:
    """The means to make parts of one layer again: its plan, from the records of its build, and its source.

    Raises InputError if there are none. ``notes`` says what could not be restored, and why.
    """

    def __init__(self, dataset: Dataset, name: str, findings: list[Finding], workers: int) -> None:
        self._dataset, self._name, self._findings, self._workers = dataset, name, findings, workers
        self._layer = dataset.manifest.layer(name)
        self._book = RecordBook(dataset.store, self._layer.path)
        self.notes: list[str] = []
        record = self._book.plan()
        if record is None:
            raise InputError("there are no records of how the layer was built; rebuild it (clipmap build --overwrite)")
        self._source: SampleSource
        if record.light is not None:
            plan, self._source, self._stamps = _lit_again(dataset, record.light, workers)
        elif record.normals is not None:
            plan, self._source, self._stamps = _found_again(dataset, record.normals, workers)
        else:
            self._source = _reopened(dataset, record, workers)
            plan, self._stamps = plan_layer(self._source, dataset.manifest, record.settings), SourceStamps(self._source.info)
        self._plan = replace(plan, partition=record.partition)
        # Of other versions of libraries the same bytes are likely, and whether they are is checked block by block.
        if difference := record.explain(self._plan.signature, ignored=self._plan.libraries):
            self.close()
            raise InputError(f"the layer cannot be made again as it was ({difference}); rebuild it (clipmap build --overwrite)")

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def _worker(self, destination: DamagedBlocks) -> TaskWorker:
        plan = self._plan
        target = Target(self._dataset.store, destination, plan.lattice, plan.block, plan.codec, plan.linear_light)
        return TaskWorker(plan, target, self._book, self._stamps)

    def restore_indexes(self) -> None:
        """Put the indexes together from the task records again."""
        levels = {found.level for found in self._findings if _is_index(found)}
        worker = self._worker(DamagedBlocks(self._dataset, self._name, ()))
        ledger = Ledger(self._plan.lattice, self._source.conversion.channels)
        for tier in self._plan.tiers:
            if levels & set(range(tier.first, tier.first + tier.count)):
                for task in self._plan.tasks(tier):
                    ledger.enter(task, worker.ensure(task))
        for level in sorted(level for level in levels if level is not None):
            data = ledger.index(level)
            if digest(data) == self._layer.levels[level].index:
                self._dataset.store.write(self._layer.index_key(level), data)
            else:
                self.notes.append(f"{self._name}: the index of level {level} cannot be restored, the task records are newer; {_UPDATE}")

    def restore_blocks(self) -> None:
        """Make damaged blocks again, and delete the files of blank ones."""
        damaged: set[BlockAddress] = set()
        for found in self._findings:
            if found.level is None or found.x is None or found.y is None:
                continue
            address = BlockAddress(found.level, found.x, found.y)
            if found.kind == "stray":
                self._dataset.store.delete([found.file])
            elif found.kind in _BLOCK_DAMAGE:
                damaged.add(address)
        destination = DamagedBlocks(self._dataset, self._name, damaged)
        worker = self._worker(destination)

        def run(task: Task) -> None:
            try:
                worker.run(Work(task, worker.pieces(task)))
            except InputError as error:
                self.notes.append(f"{self._name}: not all could be restored: {error}")

        for _ in run_tasks(run, _tasks_of(self._plan, damaged), self._workers):
            pass
        for address in sorted(destination.differing):
            self.notes.append(f"{self._name}/{address}: cannot be restored, the source gives another block now; {_UPDATE}")


_UPDATE: Final = "bring the source back as it was, or run clipmap build --update"


def _reopened(dataset: Dataset, record: PlanRecord, workers: int) -> SampleSource:
    """Open the source that the layer was built from."""
    try:
        return open_samples(
            [Path(path) for path in record.sources],
            dataset.store.scratch,
            record.settings,
            workers,
            lambda source: tuple(record.ranges) or None,
        )
    except NotFoundError as error:
        raise InputError(str(error)) from error


def _lit_again(dataset: Dataset, settings: LightSettings, workers: int) -> tuple[Plan, SampleSource, SourceStamps]:
    """Return the plan of a layer of light and the light itself, simulated anew on the dataset's heights."""
    from tiler.building.light import open_light  # noqa: PLC0415 - a fifth of a second that other layers need not wait for

    return _baked(*open_light(dataset, settings.model_copy(update={"workers": workers})))


def _found_again(dataset: Dataset, settings: NormalSettings, workers: int) -> tuple[Plan, SampleSource, SourceStamps]:
    """Return the plan of a layer of normals and the normals themselves, found anew on the dataset's heights."""
    from tiler.building.normals import open_normals  # noqa: PLC0415 - as above

    return _baked(*open_normals(dataset, settings.model_copy(update={"workers": workers})))


def _baked(plan: Plan, source: BakedSource, stamps: SourceStamps) -> tuple[Plan, SampleSource, SourceStamps]:
    """Bake a source, and close it if that fails."""
    try:
        source.bake()
    except BaseException:
        source.close()
        raise
    return plan, source, stamps


def _tasks_of(plan: Plan, blocks: set[BlockAddress]) -> list[Task]:
    """Return the tasks that make ``blocks``, each once, in the order of the tiers."""
    found = {plan_block_task(plan.lattice, plan.tiers, plan.partition.layout, each.level, plan.lattice.core(each)) for each in blocks}
    return sorted(found, key=lambda task: (task.tier.first, task.core))
