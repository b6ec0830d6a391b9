"""The exact march of single rays, over a pyramid of maxima, and the brackets that leave few rays to be marched. Compiled, outside the GIL.

Heights are lifted and taken along the slope of the sun's rays, as in ``tiler.light.sweeping``: a ray is a straight line at one level,
and a sample is shaded if the terrain on one of the rows that its ray crosses is higher than that.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled
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
    below_horizon,
    darken_beyond_horizon,
    load_heights,
)

Int64 = NDArray[np.int64]

UNDECIDED = 3

DARK = 1e18
"""The tangent of a horizon that nothing is seen above. Finite: it is multiplied with slopes of 0."""

FINEST = 2
"""log2 of the rows and columns of the pyramid's finest blocks: smaller ones cost more memory than the steps they save."""

_EPSILON = 2.0**-50
"""Four roundings of float64: more than positions, levels and interpolation suffer together."""

_NEARLY_WHOLE = 2.0**-30
"""Where a row's offset is that close to a whole number, the march may find a ray on the other side of a sample."""


@compiled
def _near_sample(place: float) -> bool:
    """Whether a place [columns] is so near to a sample that the march may find the ray on the other side of it."""
    return bool(abs(place - np.rint(place)) < _NEARLY_WHOLE)


@compiled
def _raise_beside_samples(heights: Float64, base: float, start: float, upper: Float64, lower: Float64) -> None:
    """Raise the bounds of strips with an end at a sample by the samples all around: rounding decides what a void beside it leaves."""
    for x in range(upper.size):
        before, here, after, following = heights[x], heights[x + 1], heights[x + 2], heights[x + 3]
        for height in (before, here, after):
            upper[x] = max(upper[x], height + base) if height == height else upper[x]  # noqa: PLR0124
        total = before + here + after + following
        if start > -0.5 and total == total:  # noqa: PLR0124
            lower[x] = max(lower[x], min(before, here, after, following) + base)


@compiled
def _raise_exactly(heights: Float64, base: float, upper: Float64, lower: Float64) -> None:
    """Raise the bounds of strips to the samples ``heights[1:]``, where rays run from sample to sample."""
    for x in range(upper.size):
        level = heights[x + 1] + base
        upper[x] = level if level > upper[x] else upper[x]
        lower[x] = level if level > lower[x] else lower[x]


@compiled
def _raise_strips(heights: Float64, base: float, start: float, end: float, upper: Float64, lower: Float64) -> None:
    """Raise the bounds of strips that lie from ``start`` to ``end`` columns off the samples ``heights[1:]``, -1 to 1.

    Between samples the terrain is straight, so its extremes are those at the ends of a strip and at the sample within it. Where
    one of the ends is beside a void there is no lower bound, and the upper one is of what there is.
    """
    near, far = 2 if start > 0.0 else 0, 2 if end > 0.0 else 0
    before, after = heights[near : near + upper.size], heights[far : far + upper.size]
    middle = heights[1 : 1 + upper.size]
    first_share, second_share = abs(start), abs(end)
    inside = start < 0.0 < end
    for x in range(upper.size):
        here = middle[x]
        first = here + first_share * (before[x] - here)
        second = here + second_share * (after[x] - here)
        centre = here if inside else first
        high = first if first > centre else centre
        high = (second if second > high or high != high else high) + base  # noqa: PLR0124
        low = first if first < centre else centre
        low = (second if second < low else low) + ((first - first) + (second - second)) + base
        upper[x] = high if high > upper[x] else upper[x]
        lower[x] = low if low > lower[x] else lower[x]


@compiled
def _decide(heights: Float64, base: float, guard: float, upper: Float64, lower: Float64, codes: Codes) -> None:
    """Set ``codes`` of the samples ``heights[1:]``: shaded for certain, lit for certain, or undecided."""
    for x in range(codes.size):
        height = heights[x + 1]
        level = height + base
        open_sky = level - guard >= upper[x]
        shaded = level + guard < lower[x]
        void = height != height  # noqa: PLR0124
        code = np.uint8(LIT) if open_sky else np.uint8(UNDECIDED)
        code = np.uint8(SHADED) if shaded else code
        codes[x] = np.uint8(VOID) if void else code


@compiled
def bracket_rows(
    heights: Float32,
    first_row: int,
    shift: float,
    slope: float,
    step_m: float,
    bias: float,
    highest: float,
    lift: Lift,
    first_strip: int,
    upper: Float64,
    lower: Float64,
    codes: Codes,
) -> None:
    """Set ``codes`` (h, w) of whole rows of the frame, ``heights`` (h, w), to SHADED or LIT where that is certain, else UNDECIDED.

    Strips lie between neighbouring lines of a sweep, m of them per column, and the ray of a sample stays within one strip all the way.
    ``upper`` and ``lower`` (m, n) are the largest bounds of the terrain met in each strip from number ``first_strip``, and are carried on.
    ``highest`` is at least the size of every height so far: rays that pass the bounds by less than rounding can move them stay undecided.
    """
    height, width = codes.shape
    drop = step_m * slope
    strips = upper.shape[0]
    local = np.empty(CHUNK + 4, np.float64)
    along_columns = shift == math.floor(shift)
    for i in range(height):
        number = first_row + i
        offset = shift * number
        whole = math.floor(offset)
        rest = offset - whole
        base = number * drop
        origin = int(whole) - first_strip
        own = min(int(rest * strips), strips - 1)
        guard = _EPSILON * (highest * (1.0 + 2.0 * (abs(shift) * number + width)) + abs(base))
        for start in range(0, width, CHUNK):
            size = min(CHUNK, width - start)
            load_heights(heights[i], 0, start, size, number, 0, lift, local)
            local[size + 3] = np.nan
            at = origin + start
            _decide(local, base + bias, guard, upper[own, at : at + size], lower[own, at : at + size], codes[i, start : start + size])
            count = size + 1 if start + size == width else size
            for n in range(strips):
                begin, end = n / strips - rest, (n + 1) / strips - rest
                high, low = upper[n, at : at + count], lower[n, at : at + count]
                if along_columns:
                    _raise_exactly(local, base, high, low)
                    break
                if _near_sample(begin) or _near_sample(end):
                    _raise_beside_samples(local, base, begin, high, low)
                else:
                    _raise_strips(local, base, begin, end, high, low)


@compiled
def range_of(heights: Float32) -> tuple[float, float]:
    """Return the lowest and the highest number of ``heights`` (h, w), infinity and minus infinity if there is none."""
    width = heights.shape[1]
    low, high = np.full(width, np.inf, np.float32), np.full(width, -np.inf, np.float32)
    for y in range(heights.shape[0]):
        row = heights[y]
        for x in range(width):
            value = row[x]
            value += value - value  # infinity becomes NaN, a void
            low[x] = value if value < low[x] else low[x]
            high[x] = value if value > high[x] else high[x]
    return low.min(), high.max()


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
def _is_shaded(
    heights: Float32,
    y: int,
    x: int,
    level: float,
    first_row: int,
    shift: float,
    drop: float,
    slack: float,
    lift: Lift,
    peaks: Float64,
    table: Int64,
    maxima: Float64,
) -> bool:
    """Whether terrain on a row above ``y`` is higher than the ray from (y, x) at ``level``."""
    last = heights.shape[1] - 1
    n, k = 0, 1
    sideways = 1 if shift > 0.0 else -1
    while k <= y:
        row = y - k
        if peaks[row] + slack <= level:
            return False
        place = x + shift * k
        left = math.floor(place)
        share = place - left
        column = int(left)
        if column < 0 or column > last or (column == last and share > 0.0):
            return False
        if n >= 0:
            block_row, cell = row >> (FINEST + n), column >> (FINEST + n)
            at = table[n, 0] + block_row * table[n, 2]
            top = maxima[at + cell]
            beside = cell + sideways
            if shift != 0.0 and 0 <= beside < table[n, 2]:
                top = max(top, maxima[at + beside])
            if top + slack <= level:
                k = y - (block_row << (FINEST + n)) + 1
                n = min(n + 1, table.shape[0] - 1)
            else:
                n -= 1
            continue
        met = _level(heights, row, column, first_row, drop, lift)
        if share > 0.0:
            met += share * (_level(heights, row, column + 1, first_row, drop, lift) - met)
        if met + (first_row + row) * drop > level:
            return True
        k += 1
        if row & ((1 << FINEST) - 1) == 0:
            n = 0
    return False


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
                shaded = _is_shaded(heights, y, x, level, first_row, shift, drop, slack, lift, peaks, table, maxima)
                codes[i, x] = SHADED if shaded else LIT
    return count


@compiled
def darken_rows(heights: Float32, first_row: int, slope: float, ground: float, lift: Lift, codes: Codes) -> None:
    """Shade what a round Earth alone hides from the sun in ``codes`` (h, w) of whole rows of the frame; voids stay void."""
    width = codes.shape[1]
    local = np.empty(CHUNK + 3, np.float64)
    for i in range(codes.shape[0]):
        number = first_row + i
        if not below_horizon(number, 0, width, slope, lift):
            continue
        for start in range(0, width, CHUNK):
            size = min(CHUNK, width - start)
            load_heights(heights[i], 0, start, size, number, 0, lift, local)
            away = lift[0] * (number - lift[2]) + lift[1] * (start - lift[3])
            darken_beyond_horizon(local, slope, away, lift[1], ground, lift, codes[i, start : start + size])


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

    As ``_is_shaded``, with a ray that is lifted to the highest terrain met so far; what it passes above farther on cannot be the horizon.
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
