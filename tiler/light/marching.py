"""The exact march of single rays, over a pyramid of maxima, for what brackets leave undecided. Compiled, outside the GIL.

Heights are lifted and taken along the slope of the sun's rays, as in ``tiler.light.sweeping``: a ray is a straight line at one level,
and a sample is shaded if the terrain on one of the rows that its ray crosses is higher than that.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled
from tiler.light.bracketing import UNDECIDED
from tiler.light.sweeping import (
    CHUNK,
    LIT,
    NOTHING,
    SHADED,
    VOID,
    Codes,
    Float32,
    Float64,
    Lift,
    load_heights,
)

Int64 = NDArray[np.int64]

DARK = 1e18
"""The tangent of a horizon that nothing is seen above. Finite: it is multiplied with slopes of 0."""

FINEST = 2
"""log2 of the rows and columns of the pyramid's finest blocks: smaller ones cost more memory than the steps they save."""


@compiled
def _level(heights: Float32, y: int, x: int, first_row: int, drop: float, lift: Lift) -> float:
    """Return a sample's lifted height; NaN in voids."""
    value = np.float64(heights[y, x])
    value += value - value
    if lift[4] != 0.0:
        distance = lift[0] * (first_row + y - lift[2]) + lift[1] * (x - lift[3])
        value -= distance * distance * lift[4]
    return value


@compiled
def raise_finest(
    heights: Float32, first_row: int, start: int, drop: float, lift: Lift, columns: int, tops: Float64, maxima: Float64
) -> None:
    """Raise the finest blocks of the pyramid of maxima, ``columns`` of them in a row, to rows from ``start`` on, ``heights`` (h, w).

    Heights are along the sun's slope. Blocks are of 2**FINEST rows, and as many columns and the first of the next block. ``tops`` of the
    rows get their maxima, or those of a block's rows up to each.
    """
    height, width = heights.shape
    local = np.empty(CHUNK + 3, np.float64)
    for y in range(height):
        number = (start + y) >> FINEST
        block = maxima[number * columns : (number + 1) * columns]
        for left in range(0, width, CHUNK):
            size = min(CHUNK, width - left)
            load_heights(heights[y], 0, left, size, first_row + start + y, 0, lift, local)
            _raise_blocks(local, size, (first_row + start + y) * drop, block[left >> FINEST : (left + size + 3) >> FINEST])
        tops[start + y] = block.max()


@compiled
def build_coarser(table: Int64, maxima: Float64) -> None:
    """Build the coarser levels of the pyramid from the finest; level n has ``table[n] = (offset, rows, columns)``."""
    for n in range(1, table.shape[0]):
        fine, coarse = table[n - 1], table[n]
        maxima[coarse[0] : coarse[0] + coarse[1] * coarse[2]] = NOTHING
        for j in range(fine[1]):
            for i in range(fine[2]):
                at = coarse[0] + (j >> 1) * coarse[2] + (i >> 1)
                maxima[at] = max(maxima[at], maxima[fine[0] + j * fine[2] + i])


@compiled
def _raise_blocks(heights: Float64, size: int, base: float, block: Float64) -> None:
    """Raise the maxima of a row of the finest blocks to those of ``heights[1:]``, ``size`` of them and the next."""
    side = 1 << FINEST
    for cell in range(block.size):
        top = block[cell]
        for x in range(side + 1):
            value = heights[min(cell * side + x, size) + 1] + base
            top = value if value > top else top
        block[cell] = top


@compiled
def _horizon(  # noqa: C901 - one loop, and calls in it would not be inlined
    heights: Float32,
    y: int,
    x: int,
    level: float,
    highest: float,
    first_row: int,
    shift: float,
    step_m: float,
    drop: float,
    slack: float,
    lift: Lift,
    peaks: Float64,
    table: Int64,
    maxima: Float64,
) -> float:
    """Return how much steeper than the sun's slope the horizon of (y, x) at ``level`` is, 0 if it is not, infinity from ``highest`` on.

    The ray is lifted to the highest terrain met so far; what it passes above farther on cannot be the horizon. With a ``highest`` of 0 it
    ends at the first terrain that it meets: the sample is shaded.
    """
    last = heights.shape[1] - 1
    n, k = 0, 1
    sideways = 1 if shift > 0.0 else -1
    steeper = 0.0
    while k <= y:
        row = y - k
        ray = level + steeper * step_m * k
        if peaks[row] + slack <= ray:
            break
        place = x + shift * k
        left = math.floor(place)
        share = place - left
        column = int(left)
        if column < 0 or column > last or (column == last and share > 0.0):
            break
        if n >= 0:
            block_row, cell = row >> (FINEST + n), column >> (FINEST + n)
            at = table[n, 0] + block_row * table[n, 2]
            top = maxima[at + cell]
            beside = cell + sideways
            if shift != 0.0 and 0 <= beside < table[n, 2]:
                top = max(top, maxima[at + beside])
            if top + slack <= ray:
                k = y - (block_row << (FINEST + n)) + 1
                n = min(n + 1, table.shape[0] - 1)
            else:
                n -= 1
            continue
        met = _level(heights, row, column, first_row, drop, lift)
        if share > 0.0:
            met += share * (_level(heights, row, column + 1, first_row, drop, lift) - met)
        met += (first_row + row) * drop
        if met > ray:
            steeper = (met - level) / (step_m * k)
            if steeper >= highest:
                return np.inf
        k += 1
        if row & ((1 << FINEST) - 1) == 0:
            n = 0
    return steeper


@compiled
def march_undecided(
    heights: Float32,
    first_row: int,
    shift: float,
    slope: float,
    step_m: float,
    bias: float,
    slack: float,
    lift: Lift,
    peaks: Float64,
    table: Int64,
    maxima: Float64,
    codes: Codes,
) -> int:
    """Decide the undecided ``codes`` (h, w) of the last h rows of ``heights`` by marching their rays; return how many there were.

    ``first_row`` is the number of the first row of ``heights``; ``slack`` what rounding may add to interpolated heights.
    """
    drop = step_m * slope
    above = heights.shape[0] - codes.shape[0]
    count = 0
    for i in range(codes.shape[0]):
        y = above + i
        for x in range(codes.shape[1]):
            if codes[i, x] == UNDECIDED:
                count += 1
                level = _level(heights, y, x, first_row, drop, lift) + ((first_row + y) * drop + bias)
                steeper = _horizon(heights, y, x, level, 0.0, first_row, shift, step_m, drop, slack, lift, peaks, table, maxima)
                codes[i, x] = LIT if steeper == 0.0 else SHADED
    return count


@compiled
def march_horizons(
    heights: Float32,
    above: int,
    first_row: int,
    shift: float,
    slope: float,
    steepest: float,
    step_m: float,
    slack: float,
    lift: Lift,
    peaks: Float64,
    table: Int64,
    maxima: Float64,
    codes: Codes,
    tangents: Float32,
) -> int:
    """Set ``tangents`` (h, w) of rows from ``above`` on of ``heights`` to those of horizons that rise above the sun's lower edge.

    ``slope`` is that edge's, ``steepest`` that of the upper one; what is UNDECIDED by ``codes`` is marched for. Horizons under the lower
    edge are minus infinity, those over the upper one ``DARK``. Tangents are above the local horizontal. Return how many were marched for.
    """
    drop = step_m * slope
    count = 0
    for i in range(codes.shape[0]):
        y = above + i
        along = lift[0] * (first_row + y - lift[2])
        for x in range(codes.shape[1]):
            code = codes[i, x]
            if code == VOID:
                tangents[i, x] = np.nan
                continue
            if code == UNDECIDED:
                count += 1
                level = _level(heights, y, x, first_row, drop, lift) + (first_row + y) * drop
                steeper = _horizon(
                    heights, y, x, level, steepest - slope, first_row, shift, step_m, drop, slack, lift, peaks, table, maxima
                )
                if 0.0 < steeper < np.inf:
                    away = along + lift[1] * (x - lift[3])
                    tangents[i, x] = slope + steeper - 2.0 * lift[4] * away
                    continue
                code = LIT if steeper == 0.0 else SHADED
            tangents[i, x] = -np.inf if code == LIT else DARK
    return count
