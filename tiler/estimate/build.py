"""What a build would make and take, from its plan and from trial tasks on a few windows; nothing is written where it would build.

Sizes of levels, numbers of blocks, tasks and files, and bytes of indexes and pieces are exact. Bytes of blocks come from windows that
were encoded, by level, as bytes per sample (a picture's coarser levels have more of them, for they have more detail); levels coarser
than the windows are extrapolated, and matter little: each has a quarter of the samples of the one before.
"""

import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final

from schemas.blockindex import RECORD_BYTES
from schemas.estimates import BuildEstimate, LevelEstimate, SpaceEstimate, Standing
from schemas.region import Rect
from schemas.settings import BuildSettings
from tiler.building.build import refuse_inside
from tiler.building.intent import find_ranges_known
from tiler.building.plan import Plan, plan_layer
from tiler.estimate.machine import available_bytes
from tiler.estimate.memory import SPOOL_BYTES, build_memory_bytes, task_windows
from tiler.estimate.standing import SeenClaim, find_standing, nearest_folder
from tiler.estimate.trial import Trial, try_windows
from tiler.samples.opening import open_headers, open_samples
from tiler.samples.stretch import Ranges, parse_stretch
from tiler.sources import FileInfo
from tiler.sources.convert import SampleSource
from tiler.stores.dataset import read_manifest
from tiler.stores.locate import folder_of, is_remote, open_store
from tiler.tasks.partition import Task, Tier
from tiler.tasks.stamps import SourceStamps

_UNIT_BYTES: Final = 4096
_FILE_S: Final = 0.15e-3
"""To make, fill and rename a file on a local disk."""
_OBJECT_S: Final = 30e-3
"""To put an object into a store in the same region."""
_LOADING_S: Final = 1.0
"""Loading compiled kernels takes no longer; compiling them does, but the trial has left them compiled."""
_PLAN_BYTES: Final = 1500
"""What the first task record, that of the whole build, takes."""
_BYTES_PER_S: Final = 500e6
_EXTRAPOLATED: Final = (0.3, 0.8)
"""How far bytes of levels that were not tried may be off, as a share of them; the second if only level 0 was tried."""
_GROWTH: Final = 1.3
"""By how much bytes per sample grow from level to level if only level 0 was tried."""
_STEEPEST: Final = 2.0
"""Bytes per sample grow or shrink by no more from level to level, however odd the last two that were tried were."""
_FADING: Final = 0.5
"""Each level grows by the root of what the one before grew by: details of 2 samples are more than twice those of 1, then it levels off."""
_EDGE_SHARE: Final = 1.1
"""Bytes per sample do not grow beyond those of raw samples, and what a coded block has besides."""


def plan_from_headers(sources: Sequence[Path], output: str | Path, settings: BuildSettings) -> Plan:
    """Return the plan of a build by what the headers of its sources say; nothing is decoded, and no pixel of it can be read.

    Raises what ``build_layer`` would raise before it reads pixels: UsageError, InputError, MissingExtraError.
    """
    if settings.stretch is not None:
        parse_stretch(settings.stretch)
    store = open_store(output)
    for path in sources:
        refuse_inside(path, store)
    source = open_headers(sources, settings)
    try:
        return plan_layer(source, read_manifest(store), settings)
    finally:
        source.close()


def estimate_build(sources: Sequence[Path], output: str | Path, settings: BuildSettings) -> BuildEstimate:
    """Return what ``build_layer`` with the same arguments would make and take on this machine.

    Reads windows of the source, or all of it if its format cannot be read by window (then through an unnamed file of the temporary
    folder, if it is large) or a stretch by a cut is asked for. Raises UsageError, InputError or StorageError where the build would,
    but for what contradicts the dataset that lies at ``output``: that is part of the answer.
    """
    if settings.stretch is not None:
        parse_stretch(settings.stretch)
    store = open_store(output)
    for path in sources:
        refuse_inside(path, store)
    dataset = read_manifest(store)
    threads = settings.workers or len(os.sched_getaffinity(0))
    started = perf_counter()
    claim = SeenClaim(store, output)

    def known_ranges(source: SampleSource) -> Ranges | None:
        return find_ranges_known(store, claim, dataset, source, settings)

    samples = open_samples(sources, Path(tempfile.gettempdir()), settings, threads, known_ranges)
    opened_s = perf_counter() - started
    try:
        plan = plan_layer(samples, dataset, settings)
        stamps = SourceStamps(samples.info)
        standing = find_standing(store, claim, output, dataset, plan, stamps, settings)
        trial = try_windows(plan, stamps, min(threads, len(os.sched_getaffinity(0))))
    finally:
        samples.close()
    return _Estimator(plan, output, trial, standing).estimate(store.location, opened_s)


@dataclass(frozen=True, slots=True)
class Beside:
    """What a build takes before its tasks begin: time, memory that is free again when they do, and scratch files beside the dataset."""

    seconds: float
    memory_bytes: int
    scratch_bytes: int


def estimate_of(plan: Plan, output: str | Path, trial: Trial, standing: Standing, location: str, beside: Beside) -> BuildEstimate:
    """Return what a build of ``plan`` at ``output``, which is called ``location``, would make and take, given a trial of its tasks."""
    return _Estimator(plan, output, trial, standing, beside).estimate(location, beside.seconds)


class _Estimator:
    """From a plan and a trial to an estimate."""

    def __init__(self, plan: Plan, output: str | Path, trial: Trial, standing: Standing, beside: Beside | None = None) -> None:
        self._beside_bytes = beside.memory_bytes if beside else 0
        self._scratch_bytes = beside.scratch_bytes if beside else _scratch_bytes(plan.source.info)
        self._plan, self._output, self._trial, self._standing = plan, output, trial, standing
        self._remote = is_remote(output)
        self._levels = _estimate_levels(plan, trial)

    def estimate(self, location: str, opened_s: float) -> BuildEstimate:
        plan, info = self._plan, self._plan.source.info
        space = self._space()
        time_s = opened_s + self._time_s()
        standing = self._standing
        remaining = 0.0 if standing.act in ("nothing", "refuse") else 1 - standing.tasks_finished / standing.tasks
        memory, available = max(build_memory_bytes(plan, plan.workers), self._beside_bytes), available_bytes()
        return BuildEstimate(
            sources=list(dict.fromkeys(str(part.path) for part in info.parts)) or [str(info.path)],
            dataset=location,
            layer=plan.name,
            kind=plan.block.kind,
            codec=plan.codec.spec,
            width=plan.lattice.width,
            height=plan.lattice.height,
            channels=plan.block.channels,
            block=plan.lattice.block,
            levels=self._levels,
            standing=standing,
            space=space,
            workers=plan.workers,
            memory_bytes=memory,
            available_memory_bytes=available,
            time_s=time_s,
            remaining_s=remaining * time_s,
            warnings=[*_shortages(space, memory, available, standing), *self._remarks(info)],
        )

    def _remarks(self, info: FileInfo) -> list[str]:
        remarks = []
        if _scratch_bytes(info) and not self._remote:
            remarks.append(
                f"{info.path}: its format cannot be read by window: the build decodes it into a scratch file of "
                f"{_gigabytes(_scratch_bytes(info))} in the dataset's folder"
            )
        if self._remote:
            remarks.append(f"the time counts {1e3 * _OBJECT_S:.0f} ms per object that is written; how long the store takes is not known")
        return remarks

    def _space(self) -> SpaceEstimate:
        plan = self._plan
        stored = sum(level.stored for level in self._levels)
        stored_bytes = sum(level.stored_bytes for level in self._levels)
        doubt = self._doubt_bytes()
        channels = plan.source.conversion.channels + plan.source.masked
        carried = [tier for tier in plan.tiers if tier.carry]
        piece_bytes = sum(plan.lattice.level_rect(tier.first + tier.count).area * channels * 4 for tier in carried)
        blocks = sum(level.blocks for level in self._levels)
        # base64 makes 4 characters of 3 bytes.
        record_bytes = _PLAN_BYTES + plan.task_count * self._trial.record_bytes + -(-blocks * RECORD_BYTES * 4 // 3)
        pieces = sum(_task_grid(plan, tier)[0] * _task_grid(plan, tier)[1] for tier in carried)
        files = stored + plan.lattice.levels + plan.task_count + pieces + 2
        # Of the dataset, the layer, its levels, its tasks, those of a tier and those of a row of them.
        folders = 3 + plan.lattice.levels + sum(1 + _task_grid(plan, tier)[1] for tier in plan.tiers)
        room = None if self._remote else _Room.at(nearest_folder(folder_of(self._output)))
        whole = stored_bytes + blocks * RECORD_BYTES + record_bytes + piece_bytes
        scratch = 0 if self._remote else self._scratch_bytes
        return SpaceEstimate(
            stored_bytes=stored_bytes,
            stored_bytes_low=max(stored_bytes - doubt, sum(level.stored_bytes for level in self._trial.levels)),
            stored_bytes_high=stored_bytes + doubt,
            sampled_share=min(1.0, self._trial.levels[0].samples / plan.lattice.level_rect(0).area),
            index_bytes=blocks * RECORD_BYTES,
            record_bytes=record_bytes,
            piece_bytes=piece_bytes,
            files=files,
            folders=0 if self._remote else folders,
            # Half a unit is lost per file, a whole one is taken by a folder.
            occupied_bytes=whole if room is None else whole + scratch + room.unit_bytes * (files // 2 + folders),
            free_bytes=None if room is None else room.free_bytes,
            free_inodes=None if room is None else room.free_inodes,
        )

    def _doubt_bytes(self) -> int:
        tried = sum(level.stored_bytes for level in self._levels if level.encoded)
        rest = sum(level.stored_bytes for level in self._levels if not level.encoded)
        return int(self._trial.error * (tried + rest) + _EXTRAPOLATED[len(self._trial.levels) == 1] * rest)

    def _time_s(self) -> float:
        """Return the time of all tasks: reading by what is decoded, filtering by what is held, encoding and writing by blocks."""
        plan, trial = self._plan, self._trial
        info, first = plan.source.info, plan.tiers[0]
        threads = max(1, min(plan.workers, len(os.sched_getaffinity(0))))
        tried_tier = Tier(0, len(trial.levels), carry=False)
        held = sum(_held(plan, tried_tier, core)[0].area for core in trial.windows)
        read_s = trial.times.read_s / max(1, sum(_decoded_samples(info, _held(plan, tried_tier, core)[0]) for core in trial.windows))
        filter_s = trial.times.filter_s / max(1, held)
        encode_s = trial.times.encode_s / max(1, trial.blocks_timed)
        stored = sum(level.stored for level in self._levels)
        stored_bytes = sum(level.stored_bytes for level in self._levels)
        total = read_s * _all_decoded(plan) + filter_s * sum(_all_held(plan, tier) for tier in plan.tiers)
        total += encode_s * sum(level.blocks for level in self._levels)
        # What writing takes in a trial is the digest.
        total += trial.times.write_s / max(1, trial.blocks_timed) * stored
        total += (_OBJECT_S if self._remote else _FILE_S) * (stored + plan.task_count) + stored_bytes / _BYTES_PER_S
        columns, rows = _task_grid(plan, first)
        # The last tasks of a tier leave threads idle.
        loading_s = min(trial.loading_s, _LOADING_S)
        return loading_s + total * max(1 / threads, -(-columns * rows // threads) / (columns * rows))


@dataclass(frozen=True, slots=True)
class _Room:
    """What a file system can still take; ``free_inodes`` is None where they are not counted."""

    free_bytes: int
    free_inodes: int | None
    unit_bytes: int

    @classmethod
    def at(cls, folder: Path) -> "_Room":
        state = os.statvfs(folder)
        return cls(shutil.disk_usage(folder).free, state.f_favail or None, state.f_frsize or _UNIT_BYTES)


def _estimate_levels(plan: Plan, trial: Trial) -> list[LevelEstimate]:
    lattice = plan.lattice
    levels: list[LevelEstimate] = []
    densities = [level.stored_bytes / level.samples for level in trial.levels]
    density, share, growth = densities[-1], trial.levels[-1].stored / trial.levels[-1].blocks, _GROWTH
    if len(densities) > 1 and densities[-2] > 0:
        growth = min(_STEEPEST, max(1 / _STEEPEST, densities[-1] / densities[-2])) ** _FADING
    raw = plan.block.channels * (4 if plan.block.dtype == "float32" else 2 if plan.block.dtype == "uint16" else 1)
    for level in range(lattice.levels):
        tried = trial.levels[level] if level < len(trial.levels) else None
        if tried is None:
            density, growth = min(density * growth, max(density, _EDGE_SHARE * raw)), growth**_FADING
        else:
            density, share = densities[level], tried.stored / tried.blocks
        (width, height), (columns, rows) = lattice.level_size(level), lattice.block_counts(level)
        exact = tried is not None and trial.complete
        levels.append(
            LevelEstimate(
                level=level,
                width=width,
                height=height,
                columns=columns,
                rows=rows,
                blocks=columns * rows,
                stored=tried.stored if tried is not None and exact else -(-int(share * columns * rows * 1000) // 1000),
                stored_bytes=tried.stored_bytes if tried is not None and exact else round(density * width * height),
                encoded=0 if tried is None else tried.stored,
            )
        )
    return levels


def _held(plan: Plan, tier: Tier, core: Rect) -> list[Rect]:
    return task_windows(plan, Task(tier, core))


def _task_grid(plan: Plan, tier: Tier) -> tuple[int, int]:
    """Return how many columns and rows of tasks a tier has."""
    width, height = plan.lattice.level_size(tier.first)
    columns = sum(1 for _ in plan.tasks(tier, Rect(0, 0, width, 1)))
    return columns, sum(1 for _ in plan.tasks(tier, Rect(0, 0, 1, height)))


def _all_held(plan: Plan, tier: Tier) -> int:
    """Return how many samples all tasks of a tier hold of its first level: windows are columns times rows."""
    width, height = plan.lattice.level_size(tier.first)
    columns = sum(task_windows(plan, task)[0].width for task in plan.tasks(tier, Rect(0, 0, width, 1)))
    return columns * sum(task_windows(plan, task)[0].height for task in plan.tasks(tier, Rect(0, 0, 1, height)))


def _decoded_samples(info: FileInfo, window: Rect) -> int:
    """Return how many samples are decoded for a window: whole tiles, taken as squares, or whole strips."""
    chunk = info.chunk_rows
    if info.layout == "sequential":
        return window.area
    height = -(-window.y1 // chunk) * chunk - window.y0 // chunk * chunk
    if info.layout == "striped":
        return info.width * height
    return (-(-window.x1 // chunk) * chunk - window.x0 // chunk * chunk) * height


def _all_decoded(plan: Plan) -> int:
    tier, info = plan.tiers[0], plan.source.info
    width, height = plan.lattice.level_size(0)
    across = [task_windows(plan, task)[0] for task in plan.tasks(tier, Rect(0, 0, width, 1))]
    down = [task_windows(plan, task)[0] for task in plan.tasks(tier, Rect(0, 0, 1, height))]
    row = sum(_decoded_samples(info, Rect(window.x0, 0, window.x1, info.chunk_rows)) for window in across) / info.chunk_rows
    column = sum(_decoded_samples(info, Rect(0, window.y0, info.chunk_rows, window.y1)) for window in down)
    return round(row * column / (info.width if info.layout == "striped" else info.chunk_rows))


def _scratch_bytes(info: FileInfo) -> int:
    decoded = info.width * info.height * info.channels * info.dtype.itemsize
    return decoded if info.layout == "sequential" and decoded > SPOOL_BYTES else 0


def _gigabytes(count: int) -> str:
    return f"{count / 1e9:.3g} GB"


def _shortages(space: SpaceEstimate, memory: int, available: int | None, standing: Standing) -> list[str]:
    """Return what does not fit, if anything is to be built at all."""
    if standing.act in ("nothing", "refuse"):
        return []
    found = []
    if space.free_bytes is not None and space.occupied_bytes > space.free_bytes:
        found.append(f"does not fit: about {_gigabytes(space.occupied_bytes)} are needed, {_gigabytes(space.free_bytes)} are free there")
    if space.free_inodes is not None and space.files + space.folders > space.free_inodes:
        found.append(
            f"does not fit: {space.files + space.folders} files and folders are needed, the file system has room for {space.free_inodes}; "
            "use a larger --block"
        )
    if available is not None and memory > available:
        found.append(
            f"about {_gigabytes(memory)} of memory are needed, {_gigabytes(available)} are to be had; use fewer --workers or a "
            "smaller --task"
        )
    return found
