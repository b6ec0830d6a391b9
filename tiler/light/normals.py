"""Normals of stored heights as the samples of a layer. The loop is compiled, outside the GIL."""

import math
import threading
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128

from schemas.light import Normals
from schemas.manifest import SampleType, digest
from schemas.region import Rect
from tiler.checking.blockreader import BlockReader
from tiler.compiled import compiled
from tiler.light.heights import HeightGrid, refined_layer
from tiler.light.lightsource import height_info
from tiler.light.shading import gradient
from tiler.light.sweeping import Float32, Float64
from tiler.sources import Pixels
from tiler.sources.convert import Conversion


@compiled
def find_normals(around: Float32, cells_m: Float64, zero: float, one: float, out: Float32) -> None:
    """Set ``out`` (h, w, 2) to ``zero + one * (x, y)`` of the unit normals of a window; 0 where it is void.

    ``around`` (h + 2, w + 2) are its heights [m] and those around it, NaN where void or beyond the grid, ``cells_m`` (2, h) the distances
    [m] between them along rows and columns. x is the direction of increasing columns, y that of decreasing rows. Slopes are those of
    ``tiler.light.shading``, so that ``n · s`` is the light on the same sample.
    """
    height, width = out.shape[:2]
    for y in range(height):
        cell_x, cell_y = cells_m[0, y], cells_m[1, y]
        for x in range(width):
            if math.isnan(around[y + 1, x + 1]):
                out[y, x, 0] = out[y, x, 1] = np.float32(0)
                continue
            right, up = gradient(around, y, x, cell_x, cell_y)
            upright = 1.0 / math.sqrt(1.0 + (right * right + up * up))
            out[y, x, 0] = np.float32(zero - one * (right * upright))
            out[y, x, 1] = np.float32(zero - one * (up * upright))


class NormalSource:
    """The normals of a stored height layer, on every sample of its level 0 and, at twice the density, between them.

    Samples are those that ``normals`` describes, float32 and not rounded. ``bake`` must be called before they are read; ``stages_s`` are
    the seconds it took.
    """

    def __init__(self, reader: BlockReader, normals: Normals, cells_m: Float64, dtype: SampleType, scratch: Path, workers: int) -> None:
        layer = reader.layer
        self.info = height_info(reader.name, refined_layer(layer, normals.density))
        self.conversion = Conversion("normal", (0, 1), None, False, None, None, 1.0, 0.0, dtype)
        self.masked = layer.statistics.valid < layer.width * layer.height
        self.stages_s: dict[str, float] = {}
        self._reader, self.normals, self._cells_m, self._scratch, self._workers = reader, normals, cells_m, scratch, workers
        self._local = threading.local()
        self._grid: HeightGrid | None = None

    def bake(self, on_stage: Callable[[str], None] = lambda name: None) -> None:
        """Decode the heights; ``on_stage`` is told that this begins. Raises InputError or StorageError."""
        on_stage("heights")
        started = perf_counter()
        self._grid = HeightGrid(self._reader, self._scratch, self._workers, self.normals.density)
        self.stages_s["heights"] = perf_counter() - started

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return normals (rows, columns, 2) and coverage (rows, columns), None unless ``masked``."""
        if self._grid is None:
            raise ValueError("normals are read before heights are")
        around = self._grid.read_around(window)
        found = np.empty((window.height, window.width, 2), np.float32)
        cells_m = np.ascontiguousarray(self._cells_m[:, window.y0 : window.y1])
        find_normals(around, cells_m, float(self.normals.zero), float(self.normals.one), found)
        valid = ~np.isnan(around[1:-1, 1:-1])
        if hasher := getattr(self._local, "hasher", None):
            hasher.update(found)
            hasher.update(np.packbits(valid))
        return found, valid.astype(np.float32) if self.masked else None

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return the same, without a coverage that is all 1."""
        found, coverage = self.read(window)
        return found, None if coverage is None or (coverage == 1).all() else coverage

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread."""
        self._local.hasher = xxh3_128()

    def digest(self) -> str:
        """Return the digest of the normals that this thread has read since ``begin``."""
        return digest(self._local.hasher.digest())

    def close(self) -> None:
        """Free the scratch file."""
        if self._grid is not None:
            self._grid.close()
