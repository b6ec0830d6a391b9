"""Streaming levels: rows of a window of the finest level go in, rows of every level come out, O(width) memory.

The result of a sample depends on its level's samples only, never on the window: windows overlap by what the kernel
reaches, a level's true edge is extended by the edge rule, and every other sample sees its real neighbours. So cutting a
level into windows of any shape gives the same bits as filtering it in one piece.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import support
from schemas.region import Rect
from tiler.filters.decimate import clamp_to_support, coarsen_columns, coarsen_partial, coarsen_rows, flag_partial
from tiler.filters.edges import EdgeRule, extend
from tiler.filters.kernels import Kernel, covering

Values = NDArray[np.float32]
Coverage = NDArray[np.float32]
Sink = Callable[[int, int, Values, Coverage | None], None]
"""Takes (level, first row, values (rows, columns, channels), coverage (rows, columns) or None) of a level's window."""


def halve(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the next coarser level."""
    return -(-size[0] // 2), -(-size[1] // 2)


def held_windows(size: tuple[int, int], core: Rect, pads: Sequence[int], reach: tuple[int, int]) -> list[Rect]:
    """Return, per level, the samples a window must hold so that each level covers its share of ``core`` and its pad around it.

    ``size`` is (width, height) of the finest level and ``core`` its samples wanted, aligned to ``2**(levels - 1)`` except
    at the right and bottom edge; ``pads`` has one entry per level, finest first; ``reach`` is the kernel's. The finest window is
    ``core`` plus the halo of all levels.
    """
    levels = len(pads)
    sizes = [size]
    for _ in range(levels - 1):
        sizes.append(halve(sizes[-1]))
    windows: list[Rect] = []
    for level in range(levels - 1, -1, -1):
        whole = Rect(0, 0, *sizes[level])
        own = (core.coarsened(level) & whole).grown(pads[level]) & whole
        if windows:
            seen = support(windows[-1], reach) & whole
            own = Rect(min(own.x0, seen.x0), min(own.y0, seen.y0), max(own.x1, seen.x1), max(own.y1, seen.y1))
        windows.append(own)
    return windows[::-1]


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a level becomes the next: kernel, edge rule, whether samples may be void and whether they stay in their support's range."""

    kernel: Kernel
    edge: EdgeRule
    masked: bool
    clamp: bool = False


class _Stage:
    """One halving: takes rows of a window of the finer level, gives rows of a window of the coarser one."""

    def __init__(self, size: tuple[int, int], fine: Rect, coarse: Rect, channels: int, recipe: Recipe) -> None:
        self._recipe = recipe
        self._size, self._fine, self._coarse = size, fine, coarse
        kernel = recipe.kernel
        self._before, self._after = kernel.reach
        self._low, self._high = np.array(kernel.low, np.int64), np.array(kernel.high, np.int64)
        self._weights = np.array(kernel.weights, np.float32)
        self._twin = 1 if kernel.registration == "area" else 0
        self._left = max(0, fine.x0 - (2 * coarse.x0 - self._before))
        self._right = max(0, 2 * (coarse.x1 - 1) + self._after + 1 - fine.x1)
        columns = self._left + fine.width + self._right
        self._values = np.empty((0, columns, channels), np.float32)
        self._coverage = np.empty((0, columns), np.float32) if recipe.masked else None
        self._top = fine.y0
        self._next = coarse.y0
        self._top_missing = max(0, fine.y0 - (2 * coarse.y0 - self._before))

    def push(self, values: Values, coverage: Coverage | None) -> tuple[int, Values, Coverage | None] | None:
        """Take the next rows of the window; return (first row, values, coverage) of the coarse rows that became complete."""
        self._append(*self._widened(values, coverage))
        bottom = self._top + len(self._values)
        complete = bottom == self._fine.y1
        if self._top_missing:
            if not complete and bottom <= self._before:
                return None
            self._extend_top()
        if complete:
            self._extend_bottom()
        return self._emit()

    def _widened(self, values: Values, coverage: Coverage | None) -> tuple[Values, Coverage | None]:
        """Add the columns beyond the level's left and right edge."""
        for indices, at_start in ((range(-self._left, 0), True), (range(self._size[0], self._size[0] + self._right), False)):
            if not indices:
                continue
            turned = values.transpose(1, 0, 2)
            strip, covered = extend(
                turned,
                None if coverage is None else coverage.T,
                rule=self._recipe.edge,
                size=self._size[0],
                origin=self._fine.x0 - (0 if at_start else self._left),
                indices=indices,
            )
            parts = [strip.transpose(1, 0, 2), values]
            values = np.concatenate(parts if at_start else parts[::-1], axis=1)
            if coverage is not None and covered is not None:
                coverage = np.concatenate([covered.T, coverage] if at_start else [coverage, covered.T], axis=1)
        return values, coverage

    def _append(self, values: Values, coverage: Coverage | None) -> None:
        self._values = np.concatenate([self._values, values]) if len(self._values) else values
        if self._coverage is not None and coverage is not None:
            self._coverage = np.concatenate([self._coverage, coverage]) if len(self._coverage) else coverage

    def _beyond(self, indices: range) -> tuple[Values, Coverage | None]:
        return extend(self._values, self._coverage, rule=self._recipe.edge, size=self._size[1], origin=self._top, indices=indices)

    def _extend_top(self) -> None:
        values, coverage = self._beyond(range(-self._top_missing, 0))
        self._values = np.concatenate([values, self._values])
        if self._coverage is not None and coverage is not None:
            self._coverage = np.concatenate([coverage, self._coverage])
        self._top -= self._top_missing
        self._top_missing = 0

    def _extend_bottom(self) -> None:
        missing = 2 * (self._coarse.y1 - 1) + self._after + 1 - self._fine.y1
        if missing > 0:
            self._append(*self._beyond(range(self._size[1], self._size[1] + missing)))

    def _emit(self) -> tuple[int, Values, Coverage | None] | None:
        bottom = self._top + len(self._values)
        last = min(self._coarse.y1, (bottom - 1 - self._after) // 2 + 1)
        first, count = self._next, last - self._next
        if count <= 0:
            return None
        row, column = 2 * first - self._top, 2 * self._coarse.x0 - (self._fine.x0 - self._left)
        values = self._filtered(row, column, count)
        coverage = self._partial(row, column, values)
        if self._recipe.clamp:
            self._clamp(row, column, values)
        self._next = last
        keep = 2 * last - self._before - self._top
        if keep > 0:
            self._values = self._values[keep:].copy()
            self._coverage = None if self._coverage is None else self._coverage[keep:].copy()
            self._top += keep
        return first, values, coverage

    def _filtered(self, row: int, column: int, count: int) -> Values:
        columns, channels = self._values.shape[1:]
        halved = np.empty((count, columns * channels), np.float32)
        flat = self._values.reshape(len(self._values), columns * channels)
        coarsen_rows(flat, row, self._low, self._high, self._weights, self._twin, halved)
        coarse = np.empty((count, self._coarse.width, channels), np.float32)
        wide = halved.reshape(count, columns, channels)
        coarsen_columns(wide, column, self._low, self._high, self._weights, self._twin, coarse)
        return coarse

    def _partial(self, row: int, column: int, values: Values) -> Coverage | None:
        """Redo the samples that see voids; return the coarse coverage."""
        if self._coverage is None:
            return None
        offsets, weights = self._recipe.kernel.taps()
        flags = np.empty(values.shape[:2], np.uint8)
        coverage = np.ones(values.shape[:2], np.float32)
        if flag_partial(self._coverage, row, column, offsets, flags):
            positive, positive_weights = covering(self._recipe.kernel.registration).taps()
            coarsen_partial(
                self._values, self._coverage, row, column, offsets, weights, positive, positive_weights, flags, values, coverage
            )
        return coverage

    def _clamp(self, row: int, column: int, values: Values) -> None:
        offsets, _ = self._recipe.kernel.taps()
        inside = (
            max(0, -self._top),
            min(len(self._values), self._size[1] - self._top),
            self._left,
            self._left + self._fine.width,
        )
        coverage = _NO_COVERAGE if self._coverage is None else self._coverage
        clamp_to_support(self._values, coverage, row, column, offsets, inside, values)


_NO_COVERAGE = np.empty((0, 0), np.float32)


class Cascade:
    """Turns rows of a window of one level into rows of the windows of this and all coarser levels.

    ``windows`` come from ``held_windows``; rows are pushed top to bottom, in portions of any height, as values
    (rows, width, channels) float32 and coverage (rows, width) float32, None unless ``recipe.masked``. Void samples must be 0.
    """

    def __init__(self, size: tuple[int, int], windows: Sequence[Rect], channels: int, recipe: Recipe, sink: Sink) -> None:
        self._sink = sink
        self._row = windows[0].y0
        self._stages: list[_Stage] = []
        for fine, coarse in pairwise(windows):
            self._stages.append(_Stage(size, fine, coarse, channels, recipe))
            size = halve(size)

    def push(self, values: Values, coverage: Coverage | None) -> None:
        """Take the next rows of the finest window and hand every level's complete rows to the sink."""
        first, level = self._row, 0
        self._row += len(values)
        self._sink(0, first, values, coverage)
        for level, stage in enumerate(self._stages, start=1):
            emitted = stage.push(values, coverage)
            if emitted is None:
                return
            first, values, coverage = emitted
            self._sink(level, first, values, coverage)
