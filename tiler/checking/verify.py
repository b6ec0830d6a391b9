"""Whether a dataset holds what it claims: indexes against the manifest, files against the indexes, samples against both.

Nothing is printed and nothing repaired; what is wrong comes back as findings. Memory is bounded: besides the indexes and the list
of files of a layer, about 64 MiB of decoded samples a thread, or nine blocks if these are larger.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from os import cpu_count
from typing import Final

import numpy as np

from schemas.address import BlockAddress
from schemas.blockindex import BlockIndex, BlockRecord
from schemas.errors import InputError, StorageError, UsageError
from schemas.findings import Finding, LayerCheck, VerifyReport
from schemas.region import Rect
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.checking.contents import REBUILD, check_codec, check_files, check_index, check_statistics, decode_checked, finding, read_checked
from tiler.checking.seams import Seam, compare_seam, seam_tolerance
from tiler.stores.dataset import Dataset, read_manifest
from tiler.tasks.engine import run_tasks

Progress = Callable[[int, int], None]
"""Called with (blocks checked, blocks in all)."""

_PATCH_BLOCKS: Final = 16
"""Side of the square of blocks that is one task; with seams a row of blocks around it is decoded as well, at most 27 % more."""
_HELD_BYTES: Final = 64 << 20


@dataclass(frozen=True, slots=True)
class Checks:
    """What is to be checked besides indexes, files and digests."""

    decode: bool = True
    seams: bool = False
    workers: int | None = None


def verify(
    dataset: Dataset, names: Sequence[str] | None = None, checks: Checks = Checks(), on_progress: Progress = lambda done, total: None
) -> VerifyReport:
    """Check the layers ``names``, by default all; findings are sorted by layer, level and block.

    Raises NotFoundError if there is no such layer, UsageError if ``checks`` contradict each other, and StorageError if something
    is wrong because the dataset was rebuilt meanwhile.
    """
    if checks.seams and not checks.decode:
        raise UsageError("--seams compares decoded samples, and --quick decodes nothing; leave out one of them")
    findings: list[Finding] = []
    layers = [_LayerVerifier(dataset, name, checks, findings) for name in (names or dataset.manifest.layers)]
    total = sum(layer.blocks for layer in layers)
    done = 0
    for layer in layers:
        for count in layer.run():
            done += count
            on_progress(done, total)
    if findings and read_manifest(dataset.store) != dataset.manifest:
        raise StorageError(f"{dataset.store.location}: was rebuilt while it was checked; run clipmap verify again")
    return VerifyReport(
        dataset=dataset.store.location,
        version=dataset.manifest.version,
        quick=not checks.decode,
        layers=[layer.summary() for layer in layers],
        findings=sorted(findings, key=_order),
    )


def _order(found: Finding) -> tuple[object, ...]:
    place = (-1 if number is None else number for number in (found.level, found.y, found.x))
    return (found.layer, *place, found.kind, found.file, found.what)


@dataclass(slots=True)
class _Tally:
    """What the tasks of a layer add up to."""

    stored_bytes: int = 0
    seams: int = 0
    largest: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)


class _LayerVerifier:
    """Checks one layer: manifest, indexes and files when it is made, the blocks when it is run."""

    def __init__(self, dataset: Dataset, name: str, checks: Checks, findings: list[Finding]) -> None:
        self._dataset, self._name, self._checks, self._findings = dataset, name, checks, findings
        self._layer = dataset.manifest.layer(name)
        self._lattice = self._layer.lattice
        self._reader: BlockReader | None = None
        if checks.decode:
            try:
                self._reader = BlockReader(dataset, name)
                findings += check_codec(self._reader)
            except InputError as error:
                findings.append(finding("codec", dataset, name, str(error), "upgrade clipmap, or rebuild the layer"))
        self._seams = checks.seams and self._reader is not None and self._lattice.pad > 0
        self._indexes: dict[int, BlockIndex] = {}
        for level in range(self._lattice.levels):
            index, found = check_index(dataset, name, level)
            findings += found
            if index is not None:
                self._indexes[level] = index
        findings += check_statistics(dataset, name, self._indexes.get(0))
        findings += check_files(dataset, name, self._indexes)
        self.blocks = sum(len(index) for index in self._indexes.values())
        self._tally = _Tally()

    def run(self) -> Iterator[int]:
        """Check all blocks; yields the number of blocks of every finished patch."""
        return run_tasks(self._check_patch, self._patches(), self._checks.workers or cpu_count() or 1)

    def summary(self) -> LayerCheck:
        """Return how much was checked."""
        compared = self._tally.seams if self._checks.seams else None
        return LayerCheck(
            layer=self._name,
            blocks=self.blocks,
            stored_bytes=self._tally.stored_bytes,
            decoded=self._reader is not None,
            pad=self._lattice.pad,
            seams_compared=compared,
            seam_tolerance=seam_tolerance(self._layer) if self._seams else None,
            seam_largest=self._tally.largest if compared else None,
        )

    def _patches(self) -> Iterator[tuple[int, Rect]]:
        """Yield rectangles of blocks of a level; narrow ones if three rows of decoded blocks would take too much memory."""
        side = self._lattice.stored_side
        block_bytes = side * side * (self._layer.channels * np.dtype(self._layer.dtype).itemsize + 1)
        across = max(1, min(_PATCH_BLOCKS, _HELD_BYTES // (3 * block_bytes) - 2))
        for level in self._indexes:
            columns, rows = self._lattice.block_counts(level)
            for y in range(0, rows, _PATCH_BLOCKS):
                for x in range(0, columns, across):
                    yield level, Rect(x, y, min(x + across, columns), min(y + _PATCH_BLOCKS, rows))

    def _check_patch(self, task: tuple[int, Rect]) -> int:
        level, own = task
        rows = own.grown(1) & Rect(0, 0, *self._lattice.block_counts(level)) if self._seams else own
        held: dict[BlockAddress, DecodedBlock | None] = {}
        found: list[Finding] = []
        stored_bytes = 0
        for y in range(rows.y0, own.y1 + self._seams):
            for x in range(rows.x0, rows.x1) if y < rows.y1 else ():
                address = BlockAddress(level, x, y)
                is_own = own.contains(Rect(x, y, x + 1, y + 1))
                length, whole = self._check_block(address, found if is_own else [])
                stored_bytes += length if is_own else 0
                if self._seams and (whole is not None or self._record(address).blank):
                    held[address] = whole
            if self._seams and y > own.y0:
                self._check_seams([BlockAddress(level, x, y - 1) for x in range(own.x0, own.x1)], held, found)
                held = {address: whole for address, whole in held.items() if address.y >= y - 1}
        with self._tally.lock:
            self._tally.stored_bytes += stored_bytes
            self._findings += found
        return own.area

    def _record(self, address: BlockAddress) -> BlockRecord:
        return self._indexes[address.level][self._lattice.block_number(address)]

    def _check_block(self, address: BlockAddress, found: list[Finding]) -> tuple[int, DecodedBlock | None]:
        """Return the number of intact bytes and the decoded block, None if it is blank, damaged or not to be decoded."""
        record = self._record(address)
        if record.blank:
            return 0, None
        data = read_checked(self._dataset, self._name, address, record)
        if isinstance(data, Finding):
            found.append(data)
            return 0, None
        whole = None
        if self._reader is not None:
            whole, wrong = decode_checked(self._reader, address, record, data)
            found += [wrong] if wrong else []
        return len(data), whole

    def _check_seams(self, row: list[BlockAddress], held: dict[BlockAddress, DecodedBlock | None], found: list[Finding]) -> None:
        """Compare the borders of a row of blocks with their neighbours; blocks that are damaged are not in ``held``."""
        tolerance = seam_tolerance(self._layer)
        compared, largest = 0, 0.0
        for address in row:
            own = held.get(address)
            if own is None:
                continue
            for neighbour in address.neighbours():
                if neighbour not in held:
                    continue
                seam = compare_seam(self._layer, address, own, neighbour, held[neighbour], tolerance)
                compared, largest = compared + 1, max(largest, seam.largest)
                if seam.first is not None:
                    found.append(finding("seam", self._dataset, self._name, _said(seam), REBUILD, address))
        with self._tally.lock:
            self._tally.seams += compared
            self._tally.largest = max(self._tally.largest, largest)


def _said(seam: Seam) -> str:
    column, row = seam.first or (0, 0)
    by = f", by up to {seam.largest:g}" if seam.largest else ""
    samples = f"{seam.differing} of {seam.compared} samples{by}"
    return f"the border differs from the core of {seam.neighbour} in {samples}, first at sample {column},{row}"
