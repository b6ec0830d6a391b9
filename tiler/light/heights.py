"""The heights that light falls on: the finest level of a stored layer, decoded once into a scratch file, as it is or twice as fine."""

import math
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np

from schemas.address import BlockAddress
from schemas.light import Density
from schemas.manifest import Layer
from schemas.region import Rect
from tiler.checking.blockreader import BlockReader
from tiler.light.sweeping import Float32
from tiler.light.upsample import Refiner
from tiler.rowfile import RowFile

_VOID: Final = np.float32(np.nan)
_COLUMNS: Final = 1024
"""Columns of heights that a thread refines at once: four rows of them in float64 fit into the first-level cache."""


def refined_size(samples: int, density: Density) -> int:
    """Return how many samples a row or column of so many heights has with midpoints (``density`` 2) or without (1)."""
    return density * (samples - 1) + 1


def refined_layer(layer: Layer, density: Density) -> Layer:
    """Return ``layer`` with the size, transform and spacing of a grid with midpoints; levels and statistics stay those of the heights."""
    if density == 1:
        return layer
    a, b, c, d, e, f = layer.transform
    spacing = layer.ground_spacing_m
    return layer.model_copy(
        update={
            "width": refined_size(layer.width, density),
            "height": refined_size(layer.height, density),
            "transform": (a / density, b / density, c, d / density, e / density, f),
            "ground_spacing_m": None if spacing is None else (spacing[0] / density, spacing[1] / density),
        }
    )


class HeightGrid:
    """Level 0 of a height layer as float32 [m], NaN where it is void; windows from any thread. ``range_m`` is its lowest and highest.

    With a ``density`` of 2 it has 2W-1 x 2H-1 samples, the stored heights and what ``tiler.light.upsample`` predicts between them.
    A grid of 16384 x 16384 takes 1 GiB of scratch, not of memory. Raises InputError if a block is damaged, NotFoundError if one is missing,
    StorageError if there is no room.
    """

    def __init__(self, reader: BlockReader, scratch: Path, workers: int, density: Density = 1) -> None:
        lattice = reader.lattice
        self.shape = refined_size(lattice.height, density), refined_size(lattice.width, density)
        self.block = lattice.block
        self.range_m = (0.0, 0.0)
        self._refiner = Refiner(lattice.height, lattice.width) if density == 2 else None
        self._rows = RowFile(self.shape[1], self.shape[0], 1, np.dtype(np.float32), scratch, self.block)
        try:
            self._fill(reader, workers)
        except BaseException:
            self._rows.close()
            raise

    def _fill(self, reader: BlockReader, workers: int) -> None:
        lattice = reader.lattice
        columns, rows = lattice.block_counts(0)
        ranges: list[tuple[float, float]] = []
        with ThreadPoolExecutor(workers) as pool:
            for y in range(rows):
                top = y * self.block
                strip = np.full((min(self.block, lattice.height - top), lattice.width), _VOID, np.float32)

                def decode(x: int, y: int = y, strip: Float32 = strip) -> tuple[float, float]:
                    return _decode(reader, BlockAddress(0, x, y), strip[:, x * self.block : (x + 1) * self.block])

                ranges += pool.map(decode, range(columns))
                self._write(top, strip, pool, ranges)
        lowest, highest = min(low for low, _ in ranges), max(high for _, high in ranges)
        if lowest <= highest:
            self.range_m = lowest, highest

    def _write(self, top: int, strip: Float32, pool: Executor, ranges: list[tuple[float, float]]) -> None:
        """Write a strip, or the finer rows that it completes, of whose midpoints some lie beyond the ``ranges`` of the heights."""
        if self._refiner is not None:
            width = strip.shape[1]
            starts = range(0, width, _COLUMNS)

            def run(work: Callable[[int, int], None]) -> None:
                for _ in pool.map(lambda start: work(start, min(start + _COLUMNS, width)), starts):
                    pass

            top, strip = self._refiner.push(strip, run)
            if strip.size:
                ranges += pool.map(lambda start: _range(strip[:, 2 * start : 2 * (start + _COLUMNS)]), starts)
        self._rows.write(0, top, strip[..., np.newaxis])

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


def _range(heights: Float32) -> tuple[float, float]:
    """Return the lowest and the highest of heights, inverted if all are void."""
    low, high = float(np.fmin.reduce(heights, axis=None)), float(np.fmax.reduce(heights, axis=None))
    return (math.inf, -math.inf) if math.isnan(low) else (low, high)
