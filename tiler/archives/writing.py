"""Writing a layer as one PMTiles file.

The file is planned before a block is read; blocks are then read, checked and written in parallel, each at its place. So there is no
second copy of the tiles, as in the writer of the ``pmtiles`` package, which also takes tiles with the same 64-bit hash for the same
tile, works on one thread, and keeps some 220 bytes a tile. Memory: about 150 bytes a stored block while the file is planned, 50
afterwards, and the blocks under way.
"""

import os
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from os import cpu_count
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES, BlockIndex, BlockRecord
from schemas.errors import InputError, StorageError
from schemas.manifest import digest
from tiler.archives.plan import ArchivePlan, plan_archive
from tiler.checking.checkedread import read_block
from tiler.stores.archive import unfinished
from tiler.stores.dataset import Dataset
from tiler.stores.filelock import open_locked
from tiler.stores.tilefile import HEADER_BYTES
from tiler.tasks.engine import run_tasks

Progress = Callable[[int, int], None]
"""Called with (blocks finished, blocks in all)."""

_BATCH_BLOCKS: Final = 32


@dataclass(frozen=True, slots=True)
class ArchiveReport:
    """What was written: tiles are blocks with bytes, contents the different ones among them, entries those of the directories.

    ``reused`` tiles were there from an earlier attempt and do not count in ``written_bytes``.
    """

    tiles: int
    contents: int
    entries: int
    leaves: int
    file_bytes: int
    reused: int
    written_bytes: int
    wall_s: float


def write_archive(
    dataset: Dataset,
    name: str,
    target: Path,
    on_progress: Progress = lambda done, total: None,
    *,
    workers: int | None = None,
    resumable: bool = False,
) -> ArchiveReport:
    """Write the layer ``name`` of ``dataset`` to the PMTiles file ``target``, which appears when it is whole; an old one is replaced.

    Every block is compared with its digest on the way. What an earlier attempt wrote and is right is not written again; if this one
    fails or is interrupted, its part is kept for the next with ``resumable``, else deleted. Raises InputError if a block is damaged
    or the layer has none, UsageError if the format cannot hold the layer, StorageError.
    """
    started = perf_counter()
    plan = plan_archive(dataset, name)
    with _reserved(target, plan, resumable) as (descriptor, resumed):
        writer = _Writer(dataset, name, plan, descriptor, resumed)
        done, total = 0, len(plan.numbers)
        for count in writer.run(workers or cpu_count() or 1):
            done += count
            on_progress(done, total)
    return ArchiveReport(
        tiles=total,
        contents=int(np.count_nonzero(plan.first)),
        entries=plan.entries,
        leaves=plan.leaves,
        file_bytes=plan.file_bytes,
        reused=writer.reused,
        written_bytes=writer.written_bytes + plan.file_bytes - plan.data_bytes,
        wall_s=perf_counter() - started,
    )


@contextmanager
def _reserved(target: Path, plan: ArchivePlan, resumable: bool) -> Iterator[tuple[int, bool]]:
    """Give the descriptor of a file for ``plan`` under a hidden name, and whether an earlier attempt wrote a part of it.

    When the context ends well, the file is completed and renamed to ``target``. Its first bytes are written last, so that what
    a killed process leaves is no archive under any name.
    """
    temporary = unfinished(target)
    try:
        descriptor = open_locked(temporary, lambda taken: StorageError(f"{target}: another process is writing it; wait until it has ended"))
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
    try:
        resumed = _begin(descriptor, plan)
        yield descriptor, resumed
        _write_at(descriptor, plan.head[:HEADER_BYTES], 0)
        os.fsync(descriptor)
        os.replace(temporary, target)
        _sync_folder(target.parent)
    except BaseException as error:
        if not (resumable and os.fstat(descriptor).st_size):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
        raise
    finally:
        os.close(descriptor)


def _begin(descriptor: int, plan: ArchivePlan) -> bool:
    """Size the file and write what is known already; returns whether it was begun for the same plan before."""
    head = plan.head[HEADER_BYTES:]
    resumed = os.fstat(descriptor).st_size == plan.file_bytes and os.pread(descriptor, len(head), HEADER_BYTES) == head
    if not resumed:
        os.ftruncate(descriptor, 0)
        try:
            os.posix_fallocate(descriptor, 0, plan.file_bytes)  # a disk that is too small says so now, not after hours
        except OSError:
            os.ftruncate(descriptor, 0)  # gives back what there was
            raise
    _write_at(descriptor, b"".join(plan.indexes), plan.indexes_offset)
    _write_at(descriptor, head, HEADER_BYTES)
    return resumed


def _write_at(descriptor: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class _Writer:
    """Reads, checks and writes the blocks of a plan, the different ones first, then those that are the same as one of these."""

    def __init__(self, dataset: Dataset, name: str, plan: ArchivePlan, descriptor: int, resumed: bool) -> None:
        self._dataset, self._name, self._plan = dataset, name, plan
        self._descriptor, self._resumed = descriptor, resumed
        self._levels = len(plan.indexes)
        self._columns = [level.columns for level in dataset.manifest.layer(name).levels]
        self._indexes = [BlockIndex(data, len(data) // RECORD_BYTES, name) for data in plan.indexes]
        self.reused = self.written_bytes = 0

    def run(self, workers: int) -> Iterator[int]:
        """Write all tiles; yields how many of them are done."""
        for work, chosen in ((self._write, self._plan.first), (self._compare, ~self._plan.first)):
            tiles = np.flatnonzero(chosen)
            batches = (tiles[begin : begin + _BATCH_BLOCKS].tolist() for begin in range(0, len(tiles), _BATCH_BLOCKS))
            for done, reused, written_bytes in run_tasks(partial(self._each, work), batches, workers):
                self.reused += reused
                self.written_bytes += written_bytes
                yield done

    def _each(self, work: Callable[[BlockAddress, BlockRecord, int], int | None], tiles: list[int]) -> tuple[int, int, int]:
        reused = written_bytes = 0
        for tile in tiles:
            level = self._levels - bisect_right(self._plan.starts, tile)
            number = int(self._plan.numbers[tile])
            y, x = divmod(number, self._columns[level])
            written = work(BlockAddress(level, x, y), self._indexes[level][number], int(self._plan.offsets[tile]))
            reused += written is None
            written_bytes += written or 0
        return len(tiles), reused, written_bytes

    def _write(self, address: BlockAddress, record: BlockRecord, offset: int) -> int | None:
        """Write a block; returns its length, None if it was there already."""
        if self._resumed and digest(os.pread(self._descriptor, record.length_bytes, offset)) == record.digest:
            return None
        _write_at(self._descriptor, read_block(self._dataset, self._name, address, record), offset)
        return record.length_bytes

    def _compare(self, address: BlockAddress, record: BlockRecord, offset: int) -> int:
        """Make sure that a block is byte for byte the one that is stored for it."""
        data = read_block(self._dataset, self._name, address, record)
        if os.pread(self._descriptor, record.length_bytes, offset) != data:
            key = self._dataset.manifest.layer(self._name).block_key(self._name, address)
            raise InputError(f"{self._dataset.store.location}/{key}: has the digest of another block, but not its bytes")
        return 0
