"""The contrast of imagery under the taps of its filter: what the bound of filtering codes instead of light rests on.

Blocks are cut into cells, of which the least and the greatest code are kept. The taps of a coarse sample lie within a few neighbouring
cells, so their range is at most that of these cells together.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.manifest import Layer, Level
from tiler.checking.blockreader import BlockReader
from tiler.filters.kernels import DESIGNS
from tiler.stores.dataset import Dataset

Bytes = NDArray[np.uint8]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Contrast:
    """At least the largest range of codes under a filter's taps, of 1, and the largest sum of absolute weights over both axes."""

    local_range: float
    filter_norm: float


class ImageryMeter:
    """Measures the contrast of all imagery of a dataset that holds sRGB codes of 8 bits, on every level that is filtered again.

    ``rows`` is how many rows of blocks that are. Transparent samples, beside which weights are others, count as full contrast.
    """

    def __init__(self, dataset: Dataset) -> None:
        layers = dataset.manifest.layers
        self._readers = [BlockReader(dataset, name) for name, one in layers.items() if one.kind == "imagery" and one.dtype == "uint8"]
        self.rows = sum(level.rows for reader in self._readers for level in _filtered(reader.layer))

    def measure(self, pool: ThreadPoolExecutor, on_progress: Progress = lambda done, total: None) -> Contrast:
        """Return the contrast; ``on_progress`` is told of rows of blocks. Raises InputError or NotFoundError for damaged blocks."""
        largest, norm, done = 0, 1.0, 0
        for reader in self._readers:
            width, weights = _taps(reader.layer)
            norm = max(norm, weights)
            for level in _filtered(reader.layer):
                cells = _LevelCells(reader, level.level, width)
                for row in range(level.rows):
                    # Where the range is full already, nothing can change it.
                    largest = largest if largest == 255 else max(largest, cells.row(row, pool))
                    done += 1
                    on_progress(done, self.rows)
        return Contrast(largest / 255, norm)


def _filtered(layer: Layer) -> list[Level]:
    """Return the levels that are filtered into a coarser one."""
    return layer.levels[:-1]


def _taps(layer: Layer) -> tuple[int, float]:
    """Return how many samples wide a filter is, and the sum of its absolute weights over both axes."""
    offsets, weights = DESIGNS[layer.filter.kernel](layer.filter.radius, layer.registration).taps()
    return int(offsets[-1] - offsets[0]) + 1, float(np.abs(weights).sum()) ** 2


class _LevelCells:
    """The cells of a level, row of blocks by row of blocks from the top."""

    def __init__(self, reader: BlockReader, level: int, width: int) -> None:
        self._reader, self._level = reader, level
        side = reader.lattice.block
        while side // 2 >= max(width - 1, 1):
            side //= 2
        self._side = side
        # A window of taps reaches into so many cells beyond the first.
        self._more = -(-(width - 1) // side)
        self._above: tuple[Bytes, Bytes] | None = None

    def row(self, y: int, pool: ThreadPoolExecutor) -> int:
        """Return the largest range within a row of blocks and across the border to the one above."""
        columns = self._reader.layer.levels[self._level].columns
        parts = list(pool.map(lambda x: self._block(BlockAddress(self._level, x, y)), range(columns)))
        low, high = (np.concatenate([part[which] for part in parts], axis=1) for which in (0, 1))
        if self._above is not None:
            low, high = np.concatenate([self._above[0], low]), np.concatenate([self._above[1], high])
        self._above = low[-self._more :], high[-self._more :]
        for axis in (0, 1):
            for _ in range(self._more):
                low, high = _joined(low, axis, np.minimum), _joined(high, axis, np.maximum)
        return int((high.astype(np.int16) - low).max())

    def _block(self, address: BlockAddress) -> tuple[Bytes, Bytes]:
        """Return the least and the greatest code of every cell of a block, (rows, columns, colours)."""
        core = self._reader.read_core(address)
        colours = self._reader.layer.channels - int(self._reader.layer.alpha)
        size = self._reader.lattice.valid_core(address)
        counts = -(-size.height // self._side), -(-size.width // self._side)
        if core is None or not core.valid.all() or (self._reader.layer.alpha and (core.samples[..., -1] < 255).any()):
            return np.zeros((*counts, colours), np.uint8), np.full((*counts, colours), 255, np.uint8)
        samples = core.samples[..., :colours]
        starts = [np.arange(count) * self._side for count in counts]
        return tuple(  # type: ignore[return-value]
            extreme.reduceat(extreme.reduceat(samples, starts[0], axis=0), starts[1], axis=1) for extreme in (np.minimum, np.maximum)
        )


def _joined(cells: Bytes, axis: int, extreme: np.ufunc) -> Bytes:
    """Return the extremes of each cell and the next one along an axis."""
    moved = np.moveaxis(cells, axis, 0)
    joined = moved.copy()
    extreme(joined[:-1], moved[1:], out=joined[:-1])
    return np.asarray(np.moveaxis(joined, 0, axis))
