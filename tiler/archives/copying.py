"""Copying a dataset from one store to another: folders, archives, object stores.

Blocks are compared with their digests on the way. A copy that was interrupted goes on where it stopped: its announcement names what
was being copied (``copy.<form>.<digest>``), so nothing else is taken for its own leftovers. The manifest is written last.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from os import cpu_count
from pathlib import Path
from time import perf_counter
from typing import Final

from schemas.address import BlockAddress
from schemas.blockindex import BlockIndex
from schemas.errors import ClipmapError, NotFoundError, UsageError
from schemas.manifest import MANIFEST_NAME, Layer, Manifest, World, digest
from tiler.archives.writing import ArchiveReport, write_archive
from tiler.checking.checkedread import read_block, read_index
from tiler.stores import Claim, Store
from tiler.stores.archive import ArchiveStore, unfinished
from tiler.stores.dataset import Dataset, read_manifest
from tiler.tasks.engine import run_tasks

Progress = Callable[[int, int], None]
"""Called with (blocks finished, blocks in all)."""

_BATCH_BLOCKS: Final = 64
_REMOTE_WORKERS: Final = 32
"""Threads if a store is reached by URL: they wait for answers most of the time."""


@dataclass(frozen=True, slots=True)
class CopyReport:
    """What a copy did: the manifest at the target, blocks with bytes, how many of them were there already, what was written."""

    manifest: Manifest
    blocks: int
    kept: int
    written_bytes: int
    archives: dict[str, ArchiveReport]
    wall_s: float


def copy_dataset(
    source: Dataset,
    target: Store,
    names: Sequence[str] | None = None,
    *,
    archive: bool = False,
    workers: int | None = None,
    overwrite: bool = False,
    on_progress: Progress = lambda done, total: None,
) -> CopyReport:
    """Copy the layers ``names``, by default all, to ``target``, each into one archive file if ``archive``.

    Layers keep their paths unless these are in use at the target; of a layer with patches the newest blocks are copied. Blocks that
    are there already with the right digest are not written again. Another dataset at the target is replaced with ``overwrite``, and
    served until the new one is complete. Raises InputError if a block of the source is damaged, NotFoundError for an unknown layer,
    UsageError if the target must not be written, StorageError; then the manifest at the target is as it was, and a
    repetition goes on with what was copied.
    """
    started = perf_counter()
    layers = {name: source.manifest.layer(name) for name in (names or source.manifest.layers)}
    if archive and not isinstance(target, ArchiveStore):
        raise UsageError(f"{target.location}: archives are written into a folder of this machine, not into another store")
    _refuse_overlap(source.store, target)
    if workers is None:
        workers = _REMOTE_WORKERS if "://" in source.store.location + target.location else cpu_count() or 1
    with target.exclusive() as claim:
        plan = _plan(source, layers, target, claim, archive, overwrite)
        claim.announce(plan.marker, *plan.fresh, *plan.replaced)
        copier = _Copier(source, target, plan, archive, workers, on_progress)
        try:
            copier.run()
        except BaseException as error:
            if copier.untouched and not plan.resumed:
                claim.announce()
            else:
                error.add_note(f"what was copied is kept in {target.location}; repeat the command to go on with it")
            raise
        _publish(target, plan, claim)
    return CopyReport(plan.manifest, copier.total, copier.kept, copier.written_bytes, copier.archives, perf_counter() - started)


def _refuse_overlap(source: Store, target: Store) -> None:
    """Refuse a target that is the source or lies in it."""
    here, there = (store.location.rstrip("/") for store in (source, target))
    if "://" not in here + there:
        here, there = (str(Path(place).resolve()) for place in (here, there))
    if here == there or there.startswith(f"{here}/"):
        raise UsageError(f"{target.location}: is the dataset to be copied, or lies inside it; choose another place")


@dataclass(frozen=True, slots=True)
class _CopyPlan:
    """What will be at the target. ``checked`` are layers of which blocks may be there; ``replaced`` paths are deleted at the end."""

    manifest: Manifest
    marker: str
    checked: frozenset[str]
    fresh: tuple[str, ...]
    replaced: tuple[str, ...]
    resumed: bool


def _plan(source: Dataset, layers: dict[str, Layer], target: Store, claim: Claim, archive: bool, overwrite: bool) -> _CopyPlan:
    """Decide where every layer goes; raises UsageError if something else is there that may not be replaced."""
    world, published = source.manifest.world, read_manifest(target)
    marker = f"copy.{'archive' if archive else 'blocks'}.{_content_digest(world, layers)}"
    there = {} if published is None else published.layers
    in_use = {path for layer in there.values() for path in layer.paths}
    left = [prefix for prefix in claim.abandoned if prefix not in in_use]
    resumed = marker in claim.abandoned
    kept = {name: there[name] for name, layer in layers.items() if name in there and _same(layer, there[name])}
    kept = {name: layer for name, layer in kept.items() if _has_form(target, layer, archive)}
    same = published is not None and world == published.world and len(kept) == len(there) == len(layers)
    if not resumed:
        _refuse_other(target, claim, published, left, same or overwrite, overwrite)
        for prefix in left:
            target.delete_prefix(prefix)
        left = []
    new: dict[str, Layer] = {}
    for name, layer in layers.items():
        taken = in_use | {other.path for other in new.values()}
        new[name] = kept[name] if name in kept else _moved(layer, _free_path(target, name, layer.path, taken, left))
    used = {path for layer in new.values() for path in layer.paths}
    return _CopyPlan(
        manifest=Manifest.create(generator=source.manifest.generator, world=world, layers=new),
        marker=marker,
        checked=frozenset(name for name, layer in new.items() if name in kept or layer.path in left),
        fresh=tuple(sorted(used - in_use)),
        replaced=tuple(sorted((in_use | set(left) - {marker}) - used)),
        resumed=resumed,
    )


def _refuse_other(target: Store, claim: Claim, published: Manifest | None, left: list[str], welcome: bool, overwrite: bool) -> None:
    """Refuse to replace a dataset, or what another build or copy left unfinished, and anything that is neither."""
    if left and not overwrite:
        raise UsageError(
            f"{target.location}: {claim.predecessor} left something unfinished there ({', '.join(left)}); "
            "finish that, or discard it with --overwrite"
        )
    if published is not None and not welcome:
        raise UsageError(f"{target.location}: another dataset is there, or the same in another form; --overwrite replaces it")
    if published is None and not claim.abandoned and (foreign := target.keys("")):
        raise UsageError(f"{target.location}: not a dataset, and not empty (it holds {foreign[0]}); choose another place")


def _content_digest(world: World, layers: dict[str, Layer]) -> str:
    content = {"world": world.model_dump(mode="json"), "layers": {name: _content(layer) for name, layer in layers.items()}}
    return digest(json.dumps(content, sort_keys=True).encode())


def _content(layer: Layer) -> dict[str, object]:
    """Return what a layer's entry says, apart from where its blocks lie."""
    return layer.model_dump(mode="json", exclude={"path", "patches"})


def _same(a: Layer, b: Layer) -> bool:
    return _content(a) == _content(b)


def _stored(layer: Layer) -> int:
    return sum(level.stored for level in layer.levels)


def _has_form(target: Store, layer: Layer, archive: bool) -> bool:
    """Whether a layer at the target lies there as it is to lie there."""
    is_archive = isinstance(target, ArchiveStore) and target.archive_path(layer.path).is_file()
    return is_archive == (archive and _stored(layer) > 0) and not (is_archive and layer.patches)


def _moved(layer: Layer, path: str) -> Layer:
    return Layer.model_validate(layer.model_dump() | {"path": path, "patches": []})


def _free_path(target: Store, name: str, wanted: str, in_use: set[str], left: Sequence[str]) -> str:
    """Return a path where nothing lies but, if an earlier attempt chose it, what that one wrote."""
    number, path = 1, wanted
    while path in in_use or (path not in left and target.keys(path)):
        number += 1
        path = f"{name}.{number}"
    return path


def _publish(target: Store, plan: _CopyPlan, claim: Claim) -> None:
    target.sync()
    if read_manifest(target) != plan.manifest:
        target.write(MANIFEST_NAME, plan.manifest.to_json())
        target.sync()
    for path in plan.replaced:
        target.delete_prefix(path)
    claim.announce()


@dataclass(slots=True)
class _Copier:
    """Copies the layers of a plan, one after the other."""

    source: Dataset
    target: Store
    plan: _CopyPlan
    archive: bool
    workers: int
    on_progress: Progress
    kept: int = 0
    written_bytes: int = 0
    archives: dict[str, ArchiveReport] = field(default_factory=dict)
    _done: int = 0

    @property
    def total(self) -> int:
        """Blocks with bytes in all layers."""
        return sum(map(_stored, self.plan.manifest.layers.values()))

    @property
    def untouched(self) -> bool:
        """Whether nothing was written so far."""
        if isinstance(self.target, ArchiveStore) and any(unfinished(self.target.archive_path(path)).exists() for path in self.plan.fresh):
            return False
        return not any(self.target.keys(path) for path in self.plan.fresh)

    def run(self) -> None:
        """Copy everything but the manifest."""
        for name, layer in self.plan.manifest.layers.items():
            if self.archive and _stored(layer):
                self._copy_archive(name, layer)
            else:
                self._copy_blocks(name, layer)

    def _copy_archive(self, name: str, layer: Layer) -> None:
        if not isinstance(self.target, ArchiveStore):
            raise TypeError(self.target.location)
        path, before = self.target.archive_path(layer.path), self._done
        if name in self.plan.checked and path.exists() and self._is_whole(name, layer):
            self.kept += _stored(layer)
            return
        self._done = before

        def advance(done: int, total: int) -> None:
            self.on_progress(before + done, self.total)

        report = write_archive(self.source, name, path, advance, workers=self.workers, resumable=True)
        self._done = before + report.tiles
        self.kept += report.reused
        self.archives[name] = report
        self.written_bytes += report.written_bytes

    def _is_whole(self, name: str, layer: Layer) -> bool:
        """Whether an archive at the target holds every block and index as it should."""
        with suppress(ClipmapError):
            return all(there for _, there in self._each_batch(name, layer, self._count_there)) and all(
                self.target.read(layer.index_key(level)) == read_index(self.source, name, level) for level in range(len(layer.levels))
            )
        return False

    def _copy_blocks(self, name: str, layer: Layer) -> None:
        for kept, written_bytes in self._each_batch(name, layer, self._copy_batch):
            self.kept += kept
            self.written_bytes += written_bytes
        for level in range(len(layer.levels)):
            self.target.write(layer.index_key(level), read_index(self.source, name, level))

    def _each_batch(self, name: str, layer: Layer, work: Callable[["_Batch"], tuple[int, int]]) -> Iterator[tuple[int, int]]:
        """Yield the results of ``work`` on all blocks with bytes, some at a time, and tell of the progress."""

        def batches() -> Iterator[_Batch]:
            for level in range(len(layer.levels)):
                index = self.source.index(name, level)
                for begin in range(0, len(index), _BATCH_BLOCKS):
                    yield _Batch(name, layer, level, index, begin)

        def counted(batch: _Batch) -> tuple[int, tuple[int, int]]:
            return len(batch.blocks), work(batch)

        for count, result in run_tasks(counted, batches(), self.workers):
            self._done += count
            self.on_progress(self._done, self.total)
            yield result

    def _count_there(self, batch: "_Batch") -> tuple[int, int]:
        """Return the number of blocks that are at the target, and whether that is all of them."""
        count = sum(self._is_there(batch, address) for address in batch.blocks)
        return count, count == len(batch.blocks)

    def _is_there(self, batch: "_Batch", address: BlockAddress) -> bool:
        try:
            data = self.target.read(batch.layer.block_key(batch.name, address))
        except NotFoundError:
            return False
        return digest(data) == self.source.record(batch.name, address).digest

    def _copy_batch(self, batch: "_Batch") -> tuple[int, int]:
        """Copy the blocks that are not there; returns how many are, and the bytes written."""
        kept = written_bytes = 0
        for address in batch.blocks:
            if batch.name in self.plan.checked and self._is_there(batch, address):
                kept += 1
                continue
            data = read_block(self.source, batch.name, address, self.source.record(batch.name, address))
            self.target.write(batch.layer.block_key(batch.name, address), data)
            written_bytes += len(data)
        return kept, written_bytes


class _Batch:
    """Some blocks of one level that have bytes; ``layer`` is the layer's entry at the target."""

    def __init__(self, name: str, layer: Layer, level: int, index: BlockIndex, begin: int) -> None:
        self.name, self.layer = name, layer
        columns = layer.levels[level].columns
        numbers = range(begin, min(begin + _BATCH_BLOCKS, len(index)))
        self.blocks = [BlockAddress(level, number % columns, number // columns) for number in numbers if not index[number].blank]
