"""Brackets on what the sun sees: hard shadows that are certain, found by sweeping bounds instead of heights. Compiled, outside the GIL.

What they leave undecided is marched for, see ``tiler.light.marching``. Heights are lifted and taken along the slope of the sun's rays, as
in ``tiler.light.sweeping``.
"""

import math

import numpy as np

from tiler.compiled import compiled
from tiler.light.sweeping import (
    CHUNK,
    LIT,
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

UNDECIDED = 3

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
