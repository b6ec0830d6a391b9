"""What a build learns about its blocks: the block index of every level and the statistics of the finest."""

from fractions import Fraction
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import Lattice
from schemas.manifest import Level, Statistics, digest, pack_bitmap
from tiler.tasks.partition import Task
from tiler.tasks.records import TaskRecord

_RECORD: Final = np.dtype([("digest", "V16"), ("length_bytes", "<u4"), ("valid", "<u4"), ("min", "<f4"), ("max", "<f4")])
"""An entry of a block index, as ``schemas.blockindex`` has it."""


class Ledger:
    """Collects the records of finished tasks, in any order; its results do not depend on that order."""

    def __init__(self, lattice: Lattice, colours: int) -> None:
        self._lattice = lattice
        shapes = [(rows, columns) for columns, rows in map(lattice.block_counts, range(lattice.levels))]
        self._records = [np.zeros(shape, _RECORD) for shape in shapes]
        self._minima, self._maxima = [inf] * colours, [-inf] * colours
        self._sums = [Fraction(0)] * colours
        self._valid = 0

    def enter(self, task: Task, record: TaskRecord) -> None:
        """Enter one finished task."""
        entries = np.frombuffer(record.index().data, _RECORD)
        for level, blocks in task.blocks(self._lattice.block):
            part, entries = entries[: blocks.area], entries[blocks.area :]
            self._records[level][blocks.y0 : blocks.y1, blocks.x0 : blocks.x1] = part.reshape(blocks.height, blocks.width)
        if record.valid:
            self._minima = list(map(min, self._minima, record.minima))
            self._maxima = list(map(max, self._maxima, record.maxima))
            self._sums = [total + Fraction(part) for total, part in zip(self._sums, record.sums, strict=True)]
            self._valid += record.valid

    def index(self, level: int) -> bytes:
        """Return the bytes of the block index of ``level``."""
        return self._records[level].tobytes()

    def _is_stored(self, level: int) -> NDArray[np.bool_]:
        stored: NDArray[np.bool_] = self._records[level]["length_bytes"] > 0
        return stored

    def stored(self, level: int) -> bytes:
        """Return the bitmap of the blocks of ``level`` that are stored: row order, lowest bit first."""
        return np.packbits(self._is_stored(level), bitorder="little").tobytes()

    def level(self, level: int) -> Level:
        """Return the manifest's entry for ``level``."""
        width, height = self._lattice.level_size(level)
        columns, rows = self._lattice.block_counts(level)
        stored = int(self._is_stored(level).sum())
        return Level(
            level=level,
            width=width,
            height=height,
            columns=columns,
            rows=rows,
            stored=stored,
            blank=columns * rows - stored,
            stored_bytes=int(self._records[level]["length_bytes"].sum(dtype=np.int64)),
            availability=pack_bitmap(self.stored(level), columns * rows),
            index=digest(self.index(level)),
        )

    def statistics(self) -> Statistics:
        """Return the statistics of level 0."""
        if not self._valid:
            return Statistics(min=[], max=[], mean=[], valid=0)
        means = [float(total / self._valid) for total in self._sums]
        return Statistics(min=self._minima, max=self._maxima, mean=means, valid=self._valid)
