"""The heights that light falls on: the finest level of a stored layer, decoded once into a scratch file."""

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np

from schemas.address import BlockAddress
from schemas.region import Rect
from tiler.checking.blockreader import BlockReader
from tiler.light.sweeping import Float32
from tiler.rowfile import RowFile

_VOID: Final = np.float32(np.nan)


class HeightGrid:
    """Level 0 of a height layer as float32 [m], NaN where it is void; windows from any thread. ``range_m`` is its lowest and highest.

    A grid of 16384 x 16384 takes 1 GiB of scratch, not of memory. Raises InputError if a block is damaged, NotFoundError if one is missing,
    StorageError if there is no room.
    """

    def __init__(self, reader: BlockReader, scratch: Path, workers: int) -> None:
        lattice = reader.lattice
        self.shape = lattice.height, lattice.width
        self.block = lattice.block
        self.range_m = (0.0, 0.0)
        self._rows = RowFile(lattice.width, lattice.height, 1, np.dtype(np.float32), scratch)
        try:
            self._fill(reader, workers)
        except BaseException:
            self._rows.close()
            raise

    def _fill(self, reader: BlockReader, workers: int) -> None:
        height, width = self.shape
        columns, rows = reader.lattice.block_counts(0)
        lowest, highest = math.inf, -math.inf
        with ThreadPoolExecutor(workers) as pool:
            for y in range(rows):
                top = y * self.block
                strip = np.full((min(self.block, height - top), width), _VOID, np.float32)

                def decode(x: int, y: int = y, strip: Float32 = strip) -> tuple[float, float]:
                    return _decode(reader, BlockAddress(0, x, y), strip[:, x * self.block : (x + 1) * self.block])

                for low, high in pool.map(decode, range(columns)):
                    lowest, highest = min(lowest, low), max(highest, high)
                self._rows.write(0, top, strip[..., np.newaxis])
        if lowest <= highest:
            self.range_m = lowest, highest

    def read(self, window: Rect) -> Float32:
        """Return the heights (h, w) of a ``window`` of the grid."""
        heights: Float32 = self._rows.read(window)[..., 0]
        return heights

    def read_around(self, window: Rect) -> Float32:
        """Return the heights (h + 2, w + 2) of a ``window`` and of the samples around it; beyond the grid there is nothing, NaN."""
        height, width = self.shape
        seen = window.grown(1) & Rect(0, 0, width, height)
        around = np.full((window.height + 2, window.width + 2), _VOID, np.float32)
        left, top = seen.x0 - window.x0 + 1, seen.y0 - window.y0 + 1
        around[top : top + seen.height, left : left + seen.width] = self.read(seen)
        return around

    def close(self) -> None:
        """Free the scratch file."""
        self._rows.close()


def _decode(reader: BlockReader, address: BlockAddress, out: Float32) -> tuple[float, float]:
    """Put the heights of a block into ``out``; return the lowest and the highest."""
    core = reader.read_core(address)
    if core is None or not core.valid.any():
        return math.inf, -math.inf
    heights = core.samples[..., 0]
    if core.valid.all():
        out[:] = heights
        return float(heights.min()), float(heights.max())
    out[core.valid] = heights[core.valid]
    return float(heights[core.valid].min()), float(heights[core.valid].max())
