"""Building a layer: source, plan, tasks, manifest. The manifest is written last and in one step."""

import resource
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np

from schemas.errors import StorageError, UsageError
from schemas.manifest import MANIFEST_NAME, Filter, Layer, Manifest, index_key
from schemas.manifest import Source as SourceEntry
from schemas.region import Rect
from schemas.settings import BuildSettings
from tiler.cascade import Cascade, Coverage, Values, held_windows
from tiler.cut import Cutter, StageTimes, Target
from tiler.engine import run_tasks
from tiler.enhance import EnhancedSource, parse_enhancement
from tiler.fill import FilledSource
from tiler.ledger import Ledger
from tiler.plan import Plan, plan_layer
from tiler.rowfile import RowFile
from tiler.sources.convert import SampleSource, Source, choose_conversion
from tiler.sources.disguise import refuse_disguised_heights
from tiler.sources.files import open_file
from tiler.stores.dataset import read_manifest
from tiler.stores.directory import BuildClaim, DirectoryStore
from tiler.stretch import Stretch, StretchedSource, find_ranges, parse_stretch
from tiler.tasks import Task, plan_tasks
from tiler.transfer import LinearLight

Progress = Callable[[int, int], None]
"""Called with (blocks finished, blocks in all), from any thread, one call at a time."""

_PORTION_ROWS: Final = 256
_PORTION_BYTES: Final = 8 << 20
_MAX_PORTION_ROWS: Final = 1024
_PUSHED_ROWS: Final = 64
"""Rows filtered at once: few enough for their levels to stay in the second-level cache, and for little memory."""


@dataclass(frozen=True, slots=True)
class BuildReport:
    """What a build did: the new manifest, the layer's name, remarks for the user, and what it cost."""

    manifest: Manifest
    layer: str
    remarks: tuple[str, ...]
    times: StageTimes
    wall_s: float
    megasamples: float
    peak_rss_bytes: int


def build_layer(path: Path, output: Path, settings: BuildSettings, on_progress: Progress = lambda done, total: None) -> BuildReport:
    """Build one layer of the dataset in the directory ``output`` from the file ``path``, and publish it.

    The dataset is made if it does not exist. Until the manifest is replaced, readers see the old dataset, or none. Raises
    UsageError, InputError or StorageError; then, and when interrupted, nothing of the unfinished layer is kept.
    """
    started = perf_counter()
    stretch = None if settings.stretch is None else parse_stretch(settings.stretch)
    store = DirectoryStore(output)
    _refuse_inside(path, output)
    with store.exclusive() as claim:
        _delete_unpublished(store, claim.abandoned)
        dataset = read_manifest(store)
        if dataset is None:
            _refuse_foreign(output)
        reader = open_file(path, output, settings.max_samples)
        try:
            source = Source(reader, choose_conversion(reader.info, settings))
            plan = plan_layer(source, dataset, settings)
            if settings.decode is None:
                refuse_disguised_heights(reader, source.conversion)
            plan = replace(plan, source=_prepared(source, settings, stretch, plan.workers))
            manifest, times = _build(plan, store, claim, dataset, on_progress)
        finally:
            reader.close()
    return BuildReport(
        manifest=manifest,
        layer=plan.name,
        remarks=_remarks(plan, manifest.layers[plan.name]),
        times=times,
        wall_s=perf_counter() - started,
        megasamples=plan.lattice.width * plan.lattice.height / 1e6,
        peak_rss_bytes=_peak_rss_bytes(),
    )


def _prepared(source: SampleSource, settings: BuildSettings, stretch: Stretch | None, workers: int) -> SampleSource:
    """Wrap the source in what changes its samples before the pyramid is built; raises UsageError for the wrong kind of layer.

    A stretch by a cut reads the whole file, and raises InputError if there is nothing to stretch.
    """
    if stretch is not None:
        source = StretchedSource(source, find_ranges(source, stretch, workers))
    if settings.fill:
        if source.conversion.kind != "height":
            raise UsageError("--fill is for heights; voids of imagery stay transparent")
        source = FilledSource(source, settings.fill)
    if settings.enhance is not None:
        source = EnhancedSource(source, parse_enhancement(settings.enhance))
    if settings.linear_light:
        if source.conversion.kind != "imagery":
            raise UsageError("--linear-light is for imagery; heights are linear already")
        source = LinearLight(source)
    return source


def _peak_rss_bytes() -> int:
    """Return the largest resident set this process has had; ``getrusage`` would count a parent's, inherited by fork."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _refuse_inside(path: Path, output: Path) -> None:
    """Refuse a source that lies in the dataset: a rebuild deletes the folder of the layer it replaces."""
    if path.resolve().is_relative_to(output.resolve()) and path.exists():
        raise UsageError(f"{path}: lies inside {output}, where the dataset is to be; move one of them")


def _refuse_foreign(output: Path) -> None:
    """Refuse a folder that holds something else than a dataset."""
    if foreign := sorted(entry.name for entry in output.iterdir() if not entry.name.startswith(".")):
        raise UsageError(f"{output}: not a dataset, and not empty (it holds {foreign[0]}); choose another folder for -o")


def _delete_unpublished(store: DirectoryStore, prefixes: Sequence[str]) -> None:
    """Delete of the announced ``prefixes`` what the manifest does not name: never finished, or replaced."""
    dataset = read_manifest(store)
    published = set() if dataset is None else {layer.path for layer in dataset.layers.values()}
    for prefix in prefixes:
        if prefix not in published:
            store.delete_prefix(prefix)


def _build(
    plan: Plan, store: DirectoryStore, claim: BuildClaim, dataset: Manifest | None, on_progress: Progress
) -> tuple[Manifest, StageTimes]:
    output = Path(store.location)
    replaced = dataset.layers[plan.name].path if dataset is not None and plan.name in dataset.layers else None
    path = _unused_path(plan.name, replaced, output)
    announced = [path] if replaced is None else [path, replaced]
    claim.announce(*announced)
    target = Target(store, path, plan.name, plan.lattice, plan.block, plan.codec, plan.linear_light)
    ledger = Ledger(plan.lattice, plan.source.conversion.channels, on_progress)
    try:
        times = _run_tiers(plan, target, ledger, output)
        manifest = _publish(plan, target, ledger, dataset)
    except BaseException:
        with suppress(StorageError):
            _delete_unpublished(store, announced)
        raise
    _delete_unpublished(store, announced)
    return manifest, times


def _unused_path(name: str, replaced: str | None, output: Path) -> str:
    """Return a prefix that no version so far had and that nothing lies under.

    A reader of an old manifest then finds old blocks or none, never new ones, and nobody's files are in the way.
    """
    count = 1 if replaced is None else int(replaced.partition(".")[2] or 1) + 1
    while (output / (path := name if count == 1 else f"{name}.{count}")).exists():
        count += 1
    return path


class _Carried:
    """The float32 samples of a level that lies between two tiers, with their coverage as one more channel."""

    def __init__(self, size: tuple[int, int], channels: int, masked: bool, scratch: Path) -> None:
        self._masked = masked
        self._channels = channels
        self._rows = RowFile(*size, channels + masked, np.dtype(np.float32), scratch)
        self.close = self._rows.close

    def write(self, x: int, y: int, values: Values, coverage: Coverage | None) -> None:
        """Keep samples with their top-left one at (x, y)."""
        self._rows.write(x, y, values if coverage is None else np.concatenate([values, coverage[..., np.newaxis]], axis=-1))

    def read(self, window: Rect) -> tuple[Values, Coverage | None]:
        """Return values (rows, columns, channels) and coverage of a window."""
        rows = self._rows.read(window)
        if not self._masked:
            return rows, None
        return np.ascontiguousarray(rows[..., : self._channels]), np.ascontiguousarray(rows[..., self._channels])


Samples = SampleSource | _Carried


def _run_tiers(plan: Plan, target: Target, ledger: Ledger, scratch: Path) -> StageTimes:
    times = StageTimes()
    samples: Samples = plan.source
    for tier in plan.tiers:
        carried = None
        if tier.carry:
            size = plan.lattice.level_size(tier.first + tier.count)
            carried = _Carried(size, plan.source.conversion.channels, plan.recipe.masked, scratch)
        try:
            work = _TaskRunner(plan, target, ledger, samples, carried)
            for part in run_tasks(work, plan_tasks(plan.lattice, tier, plan.source.info.layout), plan.workers):
                times.add(part)
        finally:
            if isinstance(samples, _Carried):
                samples.close()
        if carried is not None:
            samples = carried
    return times


class _TaskRunner:
    """Runs one task: reads its window in portions, filters, cuts and stores its blocks, keeps its piece for the next tier."""

    def __init__(self, plan: Plan, target: Target, ledger: Ledger, samples: Samples, carried: _Carried | None) -> None:
        self._plan, self._target, self._ledger = plan, target, ledger
        self._samples, self._carried = samples, carried

    def __call__(self, task: Task) -> StageTimes:
        """Run ``task``; returns the seconds it took by stage."""
        plan, tier = self._plan, task.tier
        size = plan.lattice.level_size(tier.first)
        pads = [plan.lattice.pad] * tier.count + [0] * tier.carry
        windows = held_windows(size, task.core, pads, plan.recipe.kernel.reach)
        cutter = Cutter(self._target, tier.first, task.core, self._ledger.note)

        def sink(step: int, first: int, values: Values, coverage: Coverage | None) -> None:
            if step < tier.count:
                cutter.take(tier.first + step, first, values, coverage, windows[step].x0)
            elif self._carried is not None:
                self._carried.write(windows[step].x0, first, values, coverage)

        cascade = Cascade(size, windows, plan.source.conversion.channels, plan.recipe, sink)
        whole, times = windows[0], cutter.times
        portion_rows = self._portion_rows(whole.width)
        started = perf_counter()
        y = whole.y0
        while y < whole.y1:
            end = min(whole.y1, (y // portion_rows + 1) * portion_rows)
            before_read = perf_counter()
            values, coverage = self._samples.read(Rect(whole.x0, y, whole.x1, end))
            times.read_s += perf_counter() - before_read
            for row in range(0, end - y, _PUSHED_ROWS):
                rows = slice(row, row + _PUSHED_ROWS)
                cascade.push(values[rows], None if coverage is None else coverage[rows])
            y = end
        times.filter_s = perf_counter() - started - times.read_s - times.encode_s - times.write_s
        return times

    def _portion_rows(self, width: int) -> int:
        """Return how many rows are read at once: whole tiles, or each would be decoded twice, but no more memory than needed."""
        chunk = self._plan.source.info.chunk_rows
        affordable = _PORTION_BYTES // (width * self._plan.source.conversion.channels * 4)
        return min(max(1, min(affordable, _PORTION_ROWS) // chunk) * chunk, _MAX_PORTION_ROWS)


def _publish(plan: Plan, target: Target, ledger: Ledger, dataset: Manifest | None) -> Manifest:
    for level in range(plan.lattice.levels):
        target.store.write(index_key(target.path, level), ledger.index(level))
    layers = {} if dataset is None else dict(dataset.layers)
    layers[plan.name] = _layer_entry(plan, target, ledger)
    manifest = Manifest.create(generator=f"clipmap {version('clipmap')}", world=plan.placement.world, layers=layers)
    target.store.sync()
    target.store.write(MANIFEST_NAME, manifest.to_json())
    target.store.sync()
    return manifest


def _layer_entry(plan: Plan, target: Target, ledger: Ledger) -> Layer:
    kernel = plan.recipe.kernel
    return Layer(
        kind=plan.block.kind,
        path=target.path,
        registration=plan.lattice.registration,
        width=plan.lattice.width,
        height=plan.lattice.height,
        block=plan.lattice.block,
        pad=plan.lattice.pad,
        channels=plan.block.channels,
        alpha=plan.block.alpha,
        dtype=plan.block.dtype,
        unit="metre" if plan.block.kind == "height" else None,
        codec=plan.codec.spec,
        suffix=plan.codec.suffix,
        media_type=plan.codec.media_type,
        max_error=plan.codec.max_error,
        transform=plan.placement.transform,
        ground_spacing_m=plan.placement.ground_spacing_m,
        filter=Filter(
            kernel=kernel.name,
            radius=kernel.radius,
            edge=plan.recipe.edge,
            clamp="local" if plan.recipe.clamp else "none",
            linear_light=plan.linear_light,
        ),
        source=_source_entry(plan),
        fill=plan.fill,
        enhance=plan.enhance,
        statistics=ledger.statistics(),
        levels=[ledger.level(level) for level in range(plan.lattice.levels)],
    )


def _source_entry(plan: Plan) -> SourceEntry:
    info, conversion = plan.source.info, plan.source.conversion
    return SourceEntry(
        name=info.path.name,
        format=info.format,
        width=info.width,
        height=info.height,
        channels=info.channels,
        dtype=info.dtype.name,
        file_bytes=info.file_bytes,
        nodata=conversion.nodata,
        decode=conversion.decode,
        scale=conversion.scale,
        offset=conversion.offset,
        stretch=None if conversion.stretch is None else list(conversion.stretch),
        placement=plan.placement.how,
    )


def _remarks(plan: Plan, layer: Layer) -> tuple[str, ...]:
    """Return what the user should know although nothing is wrong."""
    remarks = []
    if plan.placement.how == "fitted":
        remarks.append(f"{plan.source.info.path.name} has no georeference: spread over the dataset's extent")
    if plan.placement.how == "assumed":
        remarks.append(f"{plan.source.info.path.name} has no georeference and no --spacing: samples lie one unit apart")
    if layer.statistics.valid == 0:
        remarks.append(f"{plan.source.info.path.name} has no valid sample: every block is blank")
    return tuple(remarks)
