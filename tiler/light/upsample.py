"""Heights between heights: a grid of W x H samples becomes one of 2W-1 x 2H-1 whose even samples are the old ones. Compiled.

A midpoint is ``(9 (a + b) - (p + q)) / 16`` of the two samples beside it and the two beyond those: the four-point scheme of Dubuc
(1986) and Dyn, Gregory and Levin (1987), exact for cubics; in two dimensions its tensor product. At the edge of the grid, and
beside a void, heights go on antisymmetrically, ``p = 2a - b``, as they do where levels are filtered: ramps stay exact, and where both
``p`` and ``q`` are missing what is left is the mean. A midpoint between a sample and a void is void: no ground is invented.

Sums are float64, rounded to float32 once, and grouped so that a grid that is turned or mirrored has the turned or mirrored midpoints,
bit for bit.
"""

import math
from collections.abc import Callable

import numpy as np

from tiler.compiled import compiled
from tiler.light.sweeping import Float32, Float64

Run = Callable[[Callable[[int, int], None]], None]


@compiled
def _between(p: float, a: float, b: float, q: float) -> float:
    """Return the midpoint of ``a`` and ``b``, between ``p`` and ``q``; NaN is a void."""
    before = 2.0 * a - b if math.isnan(p) else p
    after = 2.0 * b - a if math.isnan(q) else q
    return (9.0 * (a + b) - (before + after)) / 16.0


@compiled
def _lines_between(p: Float64, a: Float64, b: Float64, q: Float64, out: Float64) -> None:
    """Set every sample of ``out`` to what lies between those of ``a`` and ``b``."""
    for x in range(out.size):
        out[x] = _between(p[x], a[x], b[x], q[x])


@compiled
def refine(around: Float32, start: int, stop: int, out: Float32) -> None:
    """Set, in ``out`` (2h or less by one, 2w or less by one), columns ``start`` to ``stop`` of a window and what lies between samples.

    ``around`` (h + 3, w + 3) are the heights [m] of the window, of a row above and a column to the left of it, and of two below and two to
    the right; NaN where they are void or beyond the grid. Sample (y, x) of the window is set at (2y, 2x), what lies between it and the
    next ones to the right and below. A sample depends on its neighbours alone, not on the window.

    A centre is the mean of what rows first and columns first give: where nothing is void they differ by rounding, beside voids by what goes
    on antisymmetrically.
    """
    width = stop - start
    odd = min(width, out.shape[1] // 2 - start)
    heights = np.empty((4, width + 3), np.float64)
    along = np.empty((4, width), np.float64)
    below, by_rows, by_columns = np.empty(width + 3, np.float64), np.empty(width, np.float64), np.empty(width, np.float64)
    for row in range(around.shape[0]):
        # A ring of four rows, so that everything is computed once: ten times as fast as sample by sample.
        first, second, third, newest = (row - 3) % 4, (row - 2) % 4, (row - 1) % 4, row % 4
        line, between, source = heights[newest], along[newest], around[row, start:]
        for x in range(width + 3):
            line[x] = source[x]
        _lines_between(line[:width], line[1:], line[2:], line[3:], between)
        if row < 3:
            continue
        upper = out[2 * (row - 3), 2 * start :]
        for x in range(width):
            upper[2 * x] = np.float32(heights[second, x + 1])
        for x in range(odd):
            upper[2 * x + 1] = np.float32(along[second, x])
        if 2 * (row - 3) + 1 == out.shape[0]:
            return
        _lines_between(heights[first], heights[second], heights[third], line, below)
        _lines_between(along[first], along[second], along[third], between, by_rows)
        _lines_between(below[:width], below[1:], below[2:], below[3:], by_columns)
        lower = out[2 * (row - 3) + 1, 2 * start :]
        for x in range(width):
            lower[2 * x] = np.float32(below[x + 1])
        for x in range(odd):
            lower[2 * x + 1] = np.float32(0.5 * (by_rows[x] + by_columns[x]))


class Refiner:
    """Takes the rows of a grid of ``height`` x ``width`` samples, from the top, and gives those of the finer one as soon as it can."""

    def __init__(self, height: int, width: int) -> None:
        self._height, self._width = height, width
        self._held = np.full((1, width + 3), np.nan, np.float32)
        self._next = 0

    def push(self, rows: Float32, run: Run) -> tuple[int, Float32]:
        """Take the next ``rows`` (n, width) and return the number of the first finer row that they complete, and these rows.

        ``run`` calls a function with the ends of parts of the columns, in whatever threads.
        """
        last = self._next - 1 + len(self._held) + len(rows) == self._height
        added = np.full((len(rows) + 2 * last, self._width + 3), np.nan, np.float32)
        added[: len(rows), 1:-2] = rows
        held = np.concatenate([self._held, added])
        count = max(0, len(held) - 3)
        finer = np.empty((2 * count - last, 2 * self._width - 1), np.float32)
        if count:
            run(lambda start, stop: refine(held, start, stop, finer))
        first, self._next, self._held = 2 * self._next, self._next + count, held[count:].copy()
        return first, finer
