"""What a build learns about its blocks: the block index of every level and the statistics of the finest."""

import threading
from collections.abc import Callable
from math import fsum

import numpy as np

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
        # Minimum, maximum, sum per colour channel of every finest block; NaN for blanks.
        self._finest = np.full((counts[0], 3, colours), np.nan)
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
                    self._finest[number] = block.minima, block.maxima, block.sums
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
            index=digest(self.index(level)),
        )

    def statistics(self) -> Statistics:
        """Return the statistics of level 0; sums are exact (``fsum``), so they do not depend on the order of blocks."""
        seen = self._finest[~np.isnan(self._finest[:, 0, 0])]
        if not len(seen):
            return Statistics(min=[], max=[], mean=[], valid=0)
        return Statistics(
            min=seen[:, 0].min(axis=0).tolist(),
            max=seen[:, 1].max(axis=0).tolist(),
            mean=[fsum(channel) / self._valid for channel in seen[:, 2].T],
            valid=self._valid,
        )
