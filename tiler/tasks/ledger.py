"""What a build learns about its blocks: the block index of every level and the statistics of the finest."""

from fractions import Fraction
from math import inf

from schemas.blockindex import RECORD_BYTES, pack_record
from schemas.lattice import Lattice
from schemas.manifest import Level, Statistics, digest, pack_bitmap
from tiler.tasks.partition import Task
from tiler.tasks.records import TaskRecord


class Ledger:
    """Collects the records of finished tasks, in any order; its results do not depend on that order."""

    def __init__(self, lattice: Lattice, colours: int) -> None:
        self._lattice = lattice
        counts = [columns * rows for columns, rows in map(lattice.block_counts, range(lattice.levels))]
        self._records = [bytearray(count * RECORD_BYTES) for count in counts]
        self._stored = [bytearray(-(-count // 8)) for count in counts]
        self._stored_bytes = [0] * lattice.levels
        self._minima, self._maxima = [inf] * colours, [-inf] * colours
        self._sums = [Fraction(0)] * colours
        self._valid = 0

    def enter(self, task: Task, record: TaskRecord) -> None:
        """Enter one finished task."""
        for address, block in record.entries(task, self._lattice.block):
            if block.blank:
                continue
            level, place = address.level, self._lattice.block_number(address)
            self._records[level][place * RECORD_BYTES : (place + 1) * RECORD_BYTES] = pack_record(block)
            self._stored[level][place // 8] |= 1 << place % 8
            self._stored_bytes[level] += block.length_bytes
        if record.valid:
            self._minima = list(map(min, self._minima, record.minima))
            self._maxima = list(map(max, self._maxima, record.maxima))
            self._sums = [total + Fraction(part) for total, part in zip(self._sums, record.sums, strict=True)]
            self._valid += record.valid

    def index(self, level: int) -> bytes:
        """Return the bytes of the block index of ``level``."""
        return bytes(self._records[level])

    def stored(self, level: int) -> bytes:
        """Return the bitmap of the blocks of ``level`` that are stored: row order, lowest bit first."""
        return bytes(self._stored[level])

    def level(self, level: int) -> Level:
        """Return the manifest's entry for ``level``."""
        width, height = self._lattice.level_size(level)
        columns, rows = self._lattice.block_counts(level)
        stored = int.from_bytes(self._stored[level], "little").bit_count()
        return Level(
            level=level,
            width=width,
            height=height,
            columns=columns,
            rows=rows,
            stored=stored,
            blank=columns * rows - stored,
            stored_bytes=self._stored_bytes[level],
            availability=pack_bitmap(bytes(self._stored[level]), columns * rows),
            index=digest(self._records[level]),
        )

    def statistics(self) -> Statistics:
        """Return the statistics of level 0."""
        if not self._valid:
            return Statistics(min=[], max=[], mean=[], valid=0)
        means = [float(total / self._valid) for total in self._sums]
        return Statistics(min=self._minima, max=self._maxima, mean=means, valid=self._valid)
