"""What a build learns about its blocks: the block index of every level and the statistics of the finest."""

import threading
from collections.abc import Callable
from fractions import Fraction
from math import inf

from schemas.blockindex import RECORD_BYTES, pack_record
from schemas.lattice import Lattice
from schemas.manifest import Level, Statistics, digest, pack_availability
from tiler.cut import CutBlock


class Ledger:
    """Collects finished blocks from any thread and in any order; its results do not depend on that order."""

    def __init__(self, lattice: Lattice, colours: int, on_progress: Callable[[int, int], None]) -> None:
        self._lattice = lattice
        self._on_progress = on_progress
        counts = [columns * rows for columns, rows in map(lattice.block_counts, range(lattice.levels))]
        self._total, self._done = sum(counts), 0
        self._records = [bytearray(count * RECORD_BYTES) for count in counts]
        self._stored = [bytearray(-(-count // 8)) for count in counts]
        self._stored_bytes = [0] * lattice.levels
        self._minima, self._maxima = [inf] * colours, [-inf] * colours
        # Exact, so that the order in which blocks finish cannot matter; a float64 is a fraction.
        self._sums = [Fraction(0)] * colours
        self._valid = 0
        self._lock = threading.Lock()

    def note(self, block: CutBlock) -> None:
        """Enter one finished block."""
        level, number = block.address.level, self._lattice.block_number(block.address)
        with self._lock:
            if not block.record.blank:
                self._records[level][number * RECORD_BYTES : (number + 1) * RECORD_BYTES] = pack_record(block.record)
                self._stored[level][number // 8] |= 1 << number % 8
                self._stored_bytes[level] += block.record.length_bytes
                if level == 0:
                    self._minima = list(map(min, self._minima, block.minima))
                    self._maxima = list(map(max, self._maxima, block.maxima))
                    self._sums = [total + Fraction(part) for total, part in zip(self._sums, block.sums, strict=True)]
                    self._valid += block.record.valid
            self._done += 1
            self._on_progress(self._done, self._total)

    def index(self, level: int) -> bytes:
        """Return the bytes of the block index of ``level``."""
        return bytes(self._records[level])

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
            availability=pack_availability(bytes(self._stored[level]), columns * rows),
            index=digest(self._records[level]),
        )

    def statistics(self) -> Statistics:
        """Return the statistics of level 0."""
        if not self._valid:
            return Statistics(min=[], max=[], mean=[], valid=0)
        means = [float(total / self._valid) for total in self._sums]
        return Statistics(min=self._minima, max=self._maxima, mean=means, valid=self._valid)
