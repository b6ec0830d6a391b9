"""Filling small voids in heights before the pyramid is built, from the valid samples on both sides of them.

A void sample is filled along those of the four lines through it (row, column, both diagonals) on which the void is at most
``across`` samples long: linear interpolation along each line, lines weighed by 1 / length squared. So a sample depends on
what lies within ``across`` of it only, and the result does not depend on how the picture is split. A wider void stays void,
except where a line cuts off a corner of it.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.compiled import compiled
from tiler.sources.convert import DerivedSource, SampleSource

Float32 = NDArray[np.float32]


@compiled
def _steps_to_valid(coverage: Float32, y: int, x: int, dy: int, dx: int, across: int) -> int:
    """Return the number of steps from (y, x) to the first valid sample in a direction, 0 if there is none within ``across``."""
    for step in range(1, across + 1):
        v, u = y + step * dy, x + step * dx
        if v < 0 or u < 0 or v >= coverage.shape[0] or u >= coverage.shape[1]:
            return 0
        if coverage[v, u] > 0:
            return step
    return 0


@compiled
def fill_voids(values: Float32, coverage: Float32, across: int, inner: tuple[int, int, int, int], out: Float32, covered: Float32) -> int:
    """Fill the voids of ``values`` (rows, columns) in rows and columns ``inner`` = (y0, y1, x0, x1) into ``out`` and ``covered``.

    Returns how many samples were filled. Sums are float64.
    """
    count = 0
    for y in range(inner[0], inner[1]):
        for x in range(inner[2], inner[3]):
            j, i = y - inner[0], x - inner[2]
            out[j, i], covered[j, i] = values[y, x], coverage[y, x]
            if coverage[y, x] > 0:
                continue
            total, weights = 0.0, 0.0
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                ahead = _steps_to_valid(coverage, y, x, dy, dx, across)
                behind = _steps_to_valid(coverage, y, x, -dy, -dx, across)
                gap = ahead + behind
                if ahead == 0 or behind == 0 or gap > across + 1:
                    continue
                first = np.float64(values[y + ahead * dy, x + ahead * dx])
                second = np.float64(values[y - behind * dy, x - behind * dx])
                weight = 1.0 / (gap * gap * (dy * dy + dx * dx))
                total += weight * (first * behind + second * ahead) / gap
                weights += weight
            if weights > 0.0:
                out[j, i], covered[j, i] = np.float32(total / weights), np.float32(1)
                count += 1
    return count


class FilledSource(DerivedSource):
    """A source of heights whose voids of up to ``across`` samples are filled."""

    def __init__(self, source: SampleSource, across: int) -> None:
        super().__init__(source)
        self._across = across

    def read(self, window: Rect) -> tuple[Float32, Float32 | None]:
        """Return heights (rows, columns, 1) and coverage of ``window``."""
        around = window.grown(self._across) & self.info.rect
        values, coverage = self._source.read(around)
        inner = (window.y0 - around.y0, window.y1 - around.y0, window.x0 - around.x0, window.x1 - around.x0)
        rows, columns = slice(inner[0], inner[1]), slice(inner[2], inner[3])
        if coverage is None or coverage[rows, columns].all():
            return np.ascontiguousarray(values[rows, columns]), None if coverage is None else np.ascontiguousarray(coverage[rows, columns])
        filled, covered = np.empty((window.height, window.width), np.float32), np.empty((window.height, window.width), np.float32)
        fill_voids(values[..., 0], coverage, self._across, inner, filled, covered)
        return filled[..., np.newaxis], covered
