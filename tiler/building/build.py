"""Building a layer: source, plan, tasks, manifest. The manifest is written last and in one step.

Whatever a task has finished is kept until the layer is published, however a build ends: the same command goes on from there.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final, Literal

from schemas.errors import UsageError
from schemas.manifest import Layer, Manifest
from schemas.settings import BuildSettings
from tiler.building.intent import Intent, decide, find_ranges_known
from tiler.building.layer import LayerBuild, Progress
from tiler.building.leftovers import sweep
from tiler.building.plan import Plan, plan_layer
from tiler.samples.opening import open_samples
from tiler.samples.stretch import Ranges, parse_stretch
from tiler.sources.convert import SampleSource
from tiler.stores import Claim, Store
from tiler.stores.dataset import Dataset, read_manifest
from tiler.stores.locate import open_store
from tiler.tasks.cut import StageTimes
from tiler.tasks.engine import Engine, LocalEngine
from tiler.tasks.memory import peak_bytes
from tiler.tasks.records import RecordBook
from tiler.tasks.stamps import SourceStamps

_LEAST_SAMPLES: Final = 16 << 20
"""Of a source whose tasks are run in processes."""
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
        else:
            sweep(Dataset(store, dataset), claim)
        workers = settings.workers or len(os.sched_getaffinity(0))

        def known_ranges(source: SampleSource) -> Ranges | None:
            return find_ranges_known(store, claim, dataset, source, settings)

        samples = open_samples(sources, store.scratch, settings, workers, known_ranges)
        try:
            plan = plan_layer(samples, dataset, settings)
            stamps = SourceStamps(samples.info)
            intent = decide(store, claim, dataset, plan, stamps, settings)
            if intent.act is None and dataset is not None:
                return up_to_date(store, claim, dataset, plan, intent, settings.records, started)
            engine = engine or _engine_for(plan)
            build = LayerBuild(plan, intent, sources, store, claim, dataset, stamps, settings, engine)
            build.run(on_progress)
        finally:
            samples.close()
    return report_of(build, intent, claim, perf_counter() - started)


def up_to_date(store: Store, claim: Claim, dataset: Manifest, plan: Plan, intent: Intent, records: bool, started: float) -> BuildReport:
    """Clear what nobody will continue, and records that are not wanted any more; return the report of a build with nothing to do."""
    if not records:
        RecordBook(store, intent.tasks_path).delete()
    for path in intent.obsolete:
        if path not in {named for layer in dataset.layers.values() for named in layer.paths}:
            store.delete_prefix(path)
    claim.announce(*intent.kept)
    return BuildReport(
        manifest=dataset,
        layer=plan.name,
        outcome="up to date",
        remarks=_remarks(plan, dataset.layers[plan.name]) + intent.remarks,
        times=StageTimes(),
        wall_s=perf_counter() - started,
        megasamples=plan.lattice.width * plan.lattice.height / 1e6,
        peak_rss_bytes=peak_bytes(),
        tasks=plan.task_count,
        tasks_kept=plan.task_count,
        blocks_written=0,
    )


def report_of(build: LayerBuild, intent: Intent, claim: Claim, wall_s: float) -> BuildReport:
    """Return what a finished build did."""
    plan, manifest = build.plan, build.manifest
    if manifest is None:
        raise UsageError("nothing was built")
    continued = f"went on with what {claim.predecessor} had left: {build.kept} of {plan.task_count} tasks were finished"
    outcome: Outcome = "built" if intent.record is None else "continued"
    if intent.act == "update":
        outcome = "updated" if build.changed else "up to date"
    return BuildReport(
        manifest=manifest,
        layer=plan.name,
        outcome=outcome,
        remarks=_remarks(plan, manifest.layers[plan.name]) + intent.remarks + ((continued,) if claim.predecessor and build.kept else ()),
        times=build.times,
        wall_s=wall_s,
        megasamples=plan.lattice.width * plan.lattice.height / 1e6,
        peak_rss_bytes=peak_bytes() + build.processes_bytes,
        tasks=plan.task_count,
        tasks_kept=build.kept,
        blocks_written=build.written,
    )


def _engine_for(plan: Plan) -> Engine:
    """Return what runs the tasks on this machine: processes, unless the source is too small for them to make up for their start."""
    if plan.workers == 1 or plan.lattice.level_rect(0).area < _LEAST_SAMPLES:
        return LocalEngine(plan.workers)
    from tiler.tasks.processes import ProcessEngine  # noqa: PLC0415 - 10 ms of every start

    return ProcessEngine(plan.workers)


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
