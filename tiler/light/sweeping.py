"""The hot loops of cast shadows: rows in, lit or shaded out, the state of the lines carried along. Compiled, outside the GIL.

Lines run toward the sun, ``lines`` of them per sample, one column apart or less; line n crosses row r at column n - shift * r, to the
right of it by a share of a column for the further lines of a sample. A line's level is the largest height it has met, heights taken
along the slope of the sun's rays: height + row * drop. A sample lies in shadow where the level between the two lines beside it
exceeds its own. Row numbers are absolute and levels are float64, so a candidate for a level is the same number wherever a grid is split.

Down-sun the lines leave the grid by its left or right edge. They go on for one column along the samples of the edge, because those lie
between a line inside and one outside, and would be lit for as long as the outer one meets nothing: for 900 rows at 0.06 degrees.

No fast-math flag: results must not depend on how a loop was vectorised, and comparisons with NaN, which is how voids are
written, must stay false. A line with a void beside it meets nothing there.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Codes = NDArray[np.uint8]

Lift = tuple[float, float, float, float, float]
"""Row_m, column_m, reference_row and reference_column of the frame [m, samples]; curvature_per_m of the Earth."""

SHADED = 0
LIT = 1
VOID = 2

NOTHING = -1e300
"""The level of a line that has met nothing. Finite: a share 0 of infinity is not a number."""

CHUNK = 1024
"""Columns done at once: their heights (8 KiB) and levels (8 KiB per line) stay in the first-level cache."""


@compiled
def load_heights(row: Float32, halo: int, start: int, size: int, number: int, first_column: int, lift: Lift, out: Float64) -> None:
    """Set ``out[k]``, k up to ``size + 2``, to the lifted height of column ``start - 1 + k``; NaN outside of ``row`` and for no number.

    Column 0 is ``row[halo]``. The lift of a sample is the drop of the Earth's surface at its distance from the reference: on lifted
    heights, curved ground under a sun of parallel rays becomes flat ground under a sun of one slope.
    """
    first, last = max(start - 1, -halo), min(start + size + 2, row.size - halo)
    skip = first - start + 1
    count = max(last - first, 0)
    out[:skip] = np.nan
    out[skip + count : size + 3] = np.nan
    values = row[first + halo : first + halo + count]
    inside = out[skip : skip + count]
    if lift[4] == 0.0:
        for x in range(count):
            value = np.float64(values[x])
            inside[x] = value + (value - value)  # infinity becomes NaN, a void
    else:
        along = lift[0] * (number - lift[2])
        for x in range(count):
            value = np.float64(values[x])
            distance = along + lift[1] * (first_column + first + x - lift[3])
            inside[x] = value + (value - value) - distance * distance * lift[4]


@compiled
def _judge(heights: Float64, base: float, near: Float64, far: Float64, share: float, codes: Codes) -> int:
    """Set ``codes`` of the samples ``heights[1:]`` by the levels of the lines to their left and right; return how many are void."""
    voids = 0
    for x in range(codes.size):
        level = near[x] + share * (far[x] - near[x])
        height = heights[x + 1]
        void = height != height  # noqa: PLR0124
        codes[x] = np.uint8(height + base >= level) + np.uint8(2) * np.uint8(void)
        voids += 1 if void else 0
    return voids


@compiled
def _raise(levels: Float64, heights: Float64, at: int, toward: int, share: float, base: float) -> None:
    """Raise ``levels`` to what their lines meet: ``share`` of the way from ``heights[at]`` to ``heights[toward]``, and so on."""
    if share == 0.0:
        for x in range(levels.size):
            level = heights[at + x] + base
            levels[x] = level if level > levels[x] else levels[x]
    else:
        here, there = heights[at : at + levels.size], heights[toward : toward + levels.size]
        for x in range(levels.size):
            level = here[x] + share * (there[x] - here[x]) + base
            levels[x] = level if level > levels[x] else levels[x]


@compiled
def _raise_lines(levels: Float64, at: int, count: int, heights: Float64, rest: float, base: float) -> None:
    """Raise ``count`` of the ``levels`` (m, n) from ``at``, the first line of each ``rest`` to its left, to what ``heights[1:]`` shows."""
    lines = levels.shape[0]
    for n in range(lines):
        place = n / lines - rest
        met = levels[n, at : at + count]
        if place > 0.0:
            _raise(met, heights, 1, 2, place, base)
        else:
            _raise(met, heights, 1, 0, -place, base)


@compiled
def _continue_right_edge(heights: Float64, size: int, columns: int, shift: float) -> None:
    """Let the terrain of ``heights[1:]`` go on beyond its last column, of so many, if that is the edge by which lines leave the grid."""
    if shift < 0.0 and columns <= size + 1:
        heights[columns + 1] = heights[columns]


@compiled
def darken_beyond_horizon(heights: Float64, slope: float, distance: float, step: float, ground: float, lift: Lift, codes: Codes) -> None:
    """Shade the samples for which a round Earth without any terrain hides the sun.

    ``heights`` are lifted; sample x is ``distance + x * step`` metres away from the reference, where the sun's ``slope`` is given. It is
    smaller by distance / R there, and where it is negative only what rises by slope**2 R / 2 above ``ground`` sees the sun.
    """
    curvature = lift[4]
    for x in range(codes.size):
        away = distance + x * step
        local = slope - 2.0 * curvature * away
        if local < 0.0 and heights[x + 1] + curvature * away * away < ground + local * local / (4.0 * curvature):
            codes[x] = SHADED


@compiled
def below_horizon(number: int, first_column: int, width: int, slope: float, lift: Lift) -> bool:
    """Whether the sun is below the horizontal at either end of a row of a frame on a round Earth."""
    along = lift[0] * (number - lift[2])
    left = along + lift[1] * (first_column - lift[3])
    right = along + lift[1] * (first_column + width - 1 - lift[3])
    return lift[4] > 0.0 and slope < 2.0 * lift[4] * max(left, right)


@compiled
def _hand_over(levels: Float64, leaving: Float64, first: int, last: int) -> None:
    """Copy the levels of lines ``first`` to ``last``, as they are before they meet the row at hand."""
    for n in range(first, last + 1):
        for line in range(levels.shape[0]):
            leaving[line, n] = levels[line, n]


@compiled
def sweep_rows(
    heights: Float32,
    halo: int,
    first_row: int,
    first_column: int,
    shift: float,
    slope: float,
    step_m: float,
    bias: float,
    ground: float,
    lift: Lift,
    first_line: int,
    levels: Float64,
    leaving: Float64,
    codes: Codes,
) -> int:
    """Sweep ``heights`` (h, halo + w + up to 2) and set ``codes`` (h, w); return how many samples are void.

    Row 0 and column ``halo`` of ``heights`` are row ``first_row`` and column ``first_column`` of the frame. ``levels`` (m, n) are the
    lines from number ``first_line``, as they enter the window; they are left as they leave it. ``leaving`` (m, n) gets the lines as they
    were when they reached the neighbour on the side that lies down-sun.
    """
    height, width = codes.shape
    lines = levels.shape[0]
    drop = step_m * slope
    local = np.empty(CHUNK + 3, np.float64)
    side = 0 if shift > 0.0 else width
    voids = 0
    reached = 0
    for i in range(height):
        number = first_row + i
        offset = shift * number
        whole = math.floor(offset)
        rest = offset - whole
        base = number * drop
        origin = first_column + int(whole) - first_line
        if i == 0:
            _hand_over(levels, leaving, origin + side, origin + side)
        elif origin > reached:
            _hand_over(levels, leaving, reached + 1 + side, origin + side)
        elif origin < reached:
            _hand_over(levels, leaving, origin + side, reached - 1 + side)
        reached = origin
        line = int(rest * lines)
        share = rest * lines - line
        if line >= lines:  # the product was rounded up
            line, share = 0, 0.0
            origin_of_receivers = origin + 1
        else:
            origin_of_receivers = origin
        further, beyond = (0, 1) if line + 1 == lines else (line + 1, 0)
        dark = below_horizon(number, first_column, width, slope, lift)
        for start in range(0, width, CHUNK):
            size = min(CHUNK, width - start)
            load_heights(heights[i], halo, start, size, number, first_column, lift, local)
            if shift > 0.0 and start == halo == 0:
                local[0] = local[1]
            _continue_right_edge(local, size, heights.shape[1] - halo - start, shift)
            at = origin_of_receivers + start
            near, far = levels[line, at : at + size], levels[further, at + beyond : at + beyond + size]
            row = codes[i, start : start + size]
            voids += _judge(local, base + bias, near, far, share, row)
            if dark:
                away = lift[0] * (number - lift[2]) + lift[1] * (first_column + start - lift[3])
                darken_beyond_horizon(local, slope, away, lift[1], ground, lift, row)
            count = size + 1 if start + size == width else size
            _raise_lines(levels, origin + start, count, local, rest, base)
    return voids
