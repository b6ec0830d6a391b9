"""Building a layer from the heights of a dataset, with the same tasks, records and manifest as any other layer."""

import json
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Final, TypeVar

from schemas.errors import NotFoundError
from schemas.manifest import Layer, digest
from schemas.region import Rect
from schemas.settings import BuildSettings, LightSettings, NormalSettings
from tiler.building.build import BuildReport, report_of, up_to_date
from tiler.building.intent import Intent, decide
from tiler.building.layer import LayerBuild, Progress
from tiler.building.leftovers import sweep
from tiler.building.plan import Plan
from tiler.cluster.samplecopy import SampleCopy
from tiler.sources.convert import BakedSource
from tiler.stores import Store
from tiler.stores.dataset import Dataset, read_manifest
from tiler.stores.locate import open_store
from tiler.tasks.engine import Engine, LocalEngine
from tiler.tasks.stamps import SourceStamps

_SHARED: Final = {"codec", "task", "workers", "overwrite", "update", "records", "break_lock"}


class HeightStamps(SourceStamps):
    """The state of the heights, as their dataset knows it: the digest of the index of their finest level."""

    def __init__(self, layer: Layer) -> None:
        self.stamps = [layer.levels[0].index]

    @property
    def paths(self) -> list[str]:
        """No files: the heights lie in the dataset itself."""
        return []

    def of(self, window: Rect) -> str:
        """Return the state of all heights: any of them may shade a ``window``."""
        return digest(self.stamps[0].encode())

    def require_unchanged(self) -> None:
        """Nothing can change them: this build holds the dataset."""


Source = TypeVar("Source", bound=BakedSource)
Opened = tuple[Plan, Source, HeightStamps, BuildSettings]
"""The plan of a layer, its samples, not yet baked, the state of the heights, and what the layer's settings say of any build."""


def build_from_heights(
    output: str | Path,
    break_lock: bool,
    open_layer: Callable[[Dataset], Opened[Source]],
    on_progress: Progress,
    on_stage: Callable[[str], None] = lambda name: None,
    engine: Engine | None = None,
) -> tuple[BuildReport, Source]:
    """Build and publish the layer that ``open_layer`` finds in the dataset at ``output``; return what was done, and the closed source.

    Raises NotFoundError without the dataset, what ``open_layer`` raises, InputError or StorageError.
    """
    started = perf_counter()
    store = open_store(output)
    with store.exclusive(break_lock) as claim:
        manifest = read_manifest(store)
        if manifest is None:
            raise NotFoundError(f"{store.location}: no dataset there; build one with heights first: clipmap build DEM -o {output}")
        dataset = Dataset(store, manifest)
        sweep(dataset, claim)
        plan, source, stamps, settings = open_layer(dataset)
        try:
            intent = decide(store, claim, manifest, plan, stamps, settings)
            if intent.act is None:
                return up_to_date(store, claim, manifest, plan, intent, settings.records, started), source
            copy = _copy_for(engine, store, intent, plan, stamps)
            if copy is None or not copy.holds(source):
                source.bake(on_stage)
            build = LayerBuild(plan, intent, [], store, claim, manifest, stamps, settings, engine or LocalEngine(plan.workers), copy)
            on_stage("blocks" if copy is None else "copy and blocks")
            build.run(on_progress)
            if copy is not None:
                source.stages_s["copy"] = copy.seconds
        finally:
            source.close()
        return report_of(build, intent, claim, perf_counter() - started), source


def _copy_for(engine: Engine | None, store: Store, intent: Intent, plan: Plan, stamps: SourceStamps) -> SampleCopy | None:
    """Return the copy of the samples that an engine needs whose tasks run in other processes; None if they run in this one."""
    if engine is None or isinstance(engine, LocalEngine):
        return None
    return SampleCopy(store, intent.path, "\n".join([plan.digest, json.dumps(plan.place), *stamps.stamps]), plan.workers)


def build_settings(settings: LightSettings | NormalSettings) -> BuildSettings:
    """Return what the settings of such a layer say of any build."""
    return BuildSettings(**settings.model_dump(include=_SHARED))
