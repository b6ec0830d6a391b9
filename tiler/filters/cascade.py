"""Streaming levels: rows of a window of the finest level go in, rows of every level come out, O(width) memory.

The result of a sample depends on its level's samples only, never on the window: windows overlap by what the kernel
reaches, a level's true edge is extended by the edge rule, and every other sample sees its real neighbours. So cutting a
level into windows of any shape gives the same bits as filtering it in one piece.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import support
from schemas.region import Rect
from tiler.filters.decimate import (
    clamp_to_support,
    coarsen_columns,
    coarsen_partial,
    coarsen_rows,
    coarsen_rows_of_integers,
    flag_partial,
)
from tiler.filters.edges import EdgeRule, extend
from tiler.filters.kernels import Kernel, covering

Values = NDArray[Any]
"""Samples (rows, columns, channels): float32, or whole numbers of 8 or 16 bits as long as nothing has been filtered."""
Coverage = NDArray[np.float32]
Sink = Callable[[int, int, Values, Coverage | None], None]
"""Takes (level, first row, values (rows, columns, channels), coverage (rows, columns), None if it is 1) of a level's window."""


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


class _Rows:
    """Rows of a level that a stage still needs: one array that rows are added to below and taken from above, moved and not made anew.

    ``coverage`` is None while all rows are whole, as those of most elevation models are.
    """

    def __init__(self, columns: int, channels: int) -> None:
        self._columns, self._channels = columns, channels
        self._values: Values = np.empty((0, columns, channels), np.float32)
        self._coverage: Coverage | None = None
        self.count = 0

    @property
    def values(self) -> Values:
        """The rows (count, columns, channels)."""
        return self._values[: self.count]

    @property
    def coverage(self) -> Coverage | None:
        """Their coverage (count, columns), None if it is 1."""
        return None if self._coverage is None else self._coverage[: self.count]

    def add(self, count: int, dtype: np.dtype[Any], covered: bool) -> None:
        """Add ``count`` rows at the bottom, whole and without values; ``covered``: their coverage will be set."""
        needed = self.count + count
        if needed > len(self._values) or self._values.dtype != dtype:
            values = np.empty((needed, self._columns, self._channels), dtype)
            values[: self.count] = self.values
            self._values = values
        if covered and self._coverage is None:
            self._coverage = np.ones(self._values.shape[:2], np.float32)
        if self._coverage is not None and len(self._coverage) < needed:
            self._coverage = np.concatenate([self._coverage[: self.count], np.ones((needed - self.count, self._columns), np.float32)])
        if self._coverage is not None:
            self._coverage[self.count : needed] = 1
        self.count = needed

    def drop(self, count: int) -> None:
        """Forget the first ``count`` rows."""
        self.count -= count
        self._values[: self.count] = self._values[count : count + self.count]
        if self._coverage is not None:
            self._coverage[: self.count] = self._coverage[count : count + self.count]
            if (self._coverage[: self.count] == 1).all():
                self._coverage = None


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
        self._rows = _Rows(self._left + fine.width + self._right, channels)
        self._next = coarse.y0
        self._above = max(0, fine.y0 - (2 * coarse.y0 - self._before))
        self._top = fine.y0 - self._above
        self._awaits_top = self._above > 0

    def push(self, values: Values, coverage: Coverage | None) -> tuple[int, Values, Coverage | None] | None:
        """Take the next rows of the window; return (first row, values, coverage) of the coarse rows that became complete."""
        if self._awaits_top and not self._rows.count:
            self._rows.add(self._above, values.dtype, covered=False)
        self._append(values, coverage)
        bottom = self._top + self._rows.count
        complete = bottom == self._fine.y1
        if self._awaits_top:
            if not complete and bottom <= self._before:
                return None
            self._extend_top()
        if complete:
            self._extend_bottom()
        return self._emit()

    def _append(self, values: Values, coverage: Coverage | None) -> None:
        """Add rows, with the columns beyond the level's left and right edge."""
        first, left, width = self._rows.count, self._left, self._fine.width
        self._rows.add(len(values), values.dtype, covered=coverage is not None)
        place = self._rows.values[first:]
        place[:, left : left + width] = values
        covered = None if coverage is None or self._rows.coverage is None else self._rows.coverage[first:]
        if covered is not None:
            covered[:, left : left + width] = coverage
        for indices, start in ((range(-left, 0), 0), (range(self._size[0], self._size[0] + self._right), left + width)):
            if not indices:
                continue
            strip, strip_covered = extend(
                values.transpose(1, 0, 2),
                None if coverage is None else coverage.T,
                rule=self._recipe.edge,
                size=self._size[0],
                origin=self._fine.x0,
                indices=indices,
            )
            place[:, start : start + len(indices)] = strip.transpose(1, 0, 2)
            if covered is not None and strip_covered is not None:
                covered[:, start : start + len(indices)] = strip_covered.T

    def _extend(self, place: int, indices: range) -> None:
        """Set the rows from ``place`` on to what the edge rule makes of the rows beyond the top or bottom edge."""
        skipped = self._above if self._awaits_top else 0
        coverage = None if self._rows.coverage is None else self._rows.coverage[skipped:]
        strip, covered = extend(
            self._rows.values[skipped:],
            coverage,
            rule=self._recipe.edge,
            size=self._size[1],
            origin=self._top + skipped,
            indices=indices,
        )
        end = place + len(indices)
        if end > self._rows.count:
            self._rows.add(end - self._rows.count, self._rows.values.dtype, covered=False)
        self._rows.values[place:end] = strip
        if covered is not None and self._rows.coverage is not None:
            self._rows.coverage[place:end] = covered

    def _extend_top(self) -> None:
        self._extend(0, range(-self._above, 0))
        self._awaits_top = False

    def _extend_bottom(self) -> None:
        missing = 2 * (self._coarse.y1 - 1) + self._after + 1 - self._fine.y1
        if missing > 0:
            self._extend(self._rows.count, range(self._size[1], self._size[1] + missing))

    def _emit(self) -> tuple[int, Values, Coverage | None] | None:
        bottom = self._top + self._rows.count
        last = min(self._coarse.y1, (bottom - 1 - self._after) // 2 + 1)
        first, count = self._next, last - self._next
        if count <= 0 or (count < _LEAST_ROWS and last < self._coarse.y1):
            return None
        row, column = 2 * first - self._top, 2 * self._coarse.x0 - (self._fine.x0 - self._left)
        values = self._filtered(row, column, count)
        coverage = self._partial(row, column, values)
        if self._recipe.clamp:
            self._clamp(row, column, values)
        self._next = last
        keep = 2 * last - self._before - self._top
        if keep > 0:
            self._rows.drop(keep)
            self._top += keep
        return first, values, coverage

    def _filtered(self, row: int, column: int, count: int) -> Values:
        fine = self._rows.values
        columns, channels = fine.shape[1:]
        halved = np.empty((count, columns * channels), np.float32)
        filter_rows = coarsen_rows if fine.dtype == np.float32 else coarsen_rows_of_integers
        filter_rows(fine.reshape(len(fine), columns * channels), row, self._low, self._high, self._weights, self._twin, halved)
        coarse = np.empty((count, self._coarse.width, channels), np.float32)
        wide = halved.reshape(count, columns, channels)
        coarsen_columns(wide, column, self._low, self._high, self._weights, self._twin, coarse)
        return coarse

    def _partial(self, row: int, column: int, values: Values) -> Coverage | None:
        """Redo the samples that see voids; return the coarse coverage, None if there are none."""
        fine_coverage = self._rows.coverage
        if fine_coverage is None:
            return None
        offsets, weights = self._recipe.kernel.taps()
        flags = np.empty(values.shape[:2], np.uint8)
        if not flag_partial(fine_coverage, row, column, offsets, flags):
            return None
        coverage = np.ones(values.shape[:2], np.float32)
        positive, positive_weights = covering(self._recipe.kernel.registration).taps()
        coarsen_partial(
            self._rows.values, fine_coverage, row, column, offsets, weights, positive, positive_weights, flags, values, coverage
        )
        return coverage

    def _clamp(self, row: int, column: int, values: Values) -> None:
        offsets, _ = self._recipe.kernel.taps()
        inside = (
            max(0, -self._top),
            min(self._rows.count, self._size[1] - self._top),
            self._left,
            self._left + self._fine.width,
        )
        coverage = _NO_COVERAGE if self._rows.coverage is None else self._rows.coverage
        clamp_to_support(self._rows.values, coverage, row, column, offsets, inside, values)


_NO_COVERAGE = np.empty((0, 0), np.float32)
_PUSHED_ROWS: Final = 64
"""Rows filtered at once: few enough for their levels to stay in the second-level cache, and for little memory."""
_LEAST_ROWS: Final = 32
"""Rows that a stage gives at once if it can: on coarse levels, where a row is short, a call would cost more than its work."""


class Cascade:
    """Turns rows of a window of one level into rows of the windows of this and all coarser levels.

    ``windows`` come from ``held_windows``; rows are pushed top to bottom, in portions of any height, as values
    (rows, width, channels), float32 or, if the edge rule mirrors, of 8 or 16 bits, and coverage (rows, width) float32, None where all
    samples are whole, always unless ``recipe.masked``. Void samples must be 0. What the sink is given it may keep.
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
        self._sink(0, self._row, values, coverage)
        self._row += len(values)
        for row in range(0, len(values), _PUSHED_ROWS):
            rows = slice(row, row + _PUSHED_ROWS)
            self._coarsen(values[rows], None if coverage is None else coverage[rows])

    def _coarsen(self, values: Values, coverage: Coverage | None) -> None:
        for level, stage in enumerate(self._stages, start=1):
            emitted = stage.push(values, coverage)
            if emitted is None:
                return
            first, values, coverage = emitted
            self._sink(level, first, values, coverage)
