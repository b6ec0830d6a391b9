"""The hot loops of horizons: convex hulls along lines for what is far, exact steps for what is near. Compiled, outside the GIL.

Of all the terrain on a line toward the sun, only the corners of its upper convex hull can be the horizon of anything beyond. Kept
on a stack, the hull takes one push and about one pop per sample (Timonen and Westerholm, "Scalable height field self-shadowing",
2010). Lines lie one column apart and are walked one after the other, so a stack stays in the cache; bands of rows are transposed for that.

Heights are lifted: with t the distance along a line, z - t**2 / 2R sees a lifted horizon t / R too high and is right otherwise.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled
from tiler.light.sweeping import Float32, Float64

Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]

NO_HORIZON = -np.inf

_LINEAR_STEPS = 8
"""Corners tried one by one before the search halves what is left: nearly always the first or second is the one."""


@compiled
def _sees_over(corners: Float64, heights: Float64, top: int, row: float, height: float) -> bool:
    """Whether corner ``top - 1`` of a hull stands at least as high above the horizontal as corner ``top``, seen from (row, height)."""
    return bool((heights[top - 1] - height) * (row - corners[top]) >= (heights[top] - height) * (row - corners[top - 1]))


@compiled
def _horizon_corner(corners: Float64, heights: Float64, size: int, row: float, height: float) -> int:
    """Return which of the ``size`` corners of a hull is the horizon of (row, height): toward it they rise, beyond it they sink."""
    top = size - 1
    for _ in range(_LINEAR_STEPS):
        if top == 0 or not _sees_over(corners, heights, top, row, height):
            return top
        top -= 1
    low, high = 0, top
    while low < high:
        middle = (low + high + 1) // 2
        if _sees_over(corners, heights, middle, row, height):
            high = middle - 1
        else:
            low = middle
    return low


@compiled
def _push_corner(corners: Float64, heights: Float64, size: int, row: float, height: float) -> int:
    """Put (row, height) on a hull of ``size`` corners, in place of those it hides from all that comes; return the new size."""
    while size > 1 and _sees_over(corners, heights, size - 1, row, height):
        size -= 1
    corners[size] = row
    heights[size] = height
    return size + 1


@compiled
def _heights_of_line(
    columns: Float32, line: int, wholes: Int64, rests: Float64, lifts: Float64, shift: float, met: Float64, own: Float64
) -> None:
    """Set the lifted heights that a line meets, row by row, and those from which it looks; NaN where there is none.

    It looks from its own height, not from that of a sample beside it: of two lines' horizons the higher one would be biased. Beside a
    void or the edge of the grid that is the height of the one sample there is.
    """
    width = columns.shape[0]
    for i in range(met.size):
        right = line - wholes[i]
        met[i] = np.nan
        own[i] = np.nan
        if right < 0 or right > width:
            continue
        first = np.float64(columns[right, i]) if right < width else np.nan
        second = np.float64(columns[right - 1, i]) if right > 0 else np.nan
        if (right == 0 and shift > 0.0) or (right == width and shift < 0.0):  # on its way out: see tiler.light.sweeping
            first = second = second if right else first
        height = first if rests[i] == 0.0 else first + rests[i] * (second - first)
        met[i] = height - lifts[i]
        if math.isnan(height) and rests[i] > 0.0:
            height = second if math.isnan(first) else first
        own[i] = height - lifts[i]


@compiled
def _least(lowest: float, curvature: float, distance: float) -> float:
    """Return the lifted height of the lowest ground at a distance along a line; minus infinity if it is not known."""
    return lowest - curvature * distance * distance


@compiled
def walk_lines(
    columns: Float32,
    first_row: int,
    shift: float,
    wholes: Int64,
    rests: Float64,
    step_m: float,
    curvature: float,
    lowest: float,
    delay: int,
    joined: bool,
    first_line: int,
    starts: Int64,
    corner_rows: Int32,
    corner_heights: Float64,
    waiting: Float64,
    new_starts: Int64,
    new_corner_rows: Int32,
    new_corner_heights: Float64,
    new_waiting: Float64,
    far: Float32,
) -> None:
    """Walk all lines through a band of rows, transposed: ``columns`` (w, h); set ``far`` (w, h) to the tangents of the horizons.

    Line n crosses row i ``rests[i]`` to the left of column n - wholes[i]. Only what is more than ``delay`` rows away counts. At the
    outset the hull of line ``first_line + k`` has the corners from ``starts[k]`` to ``starts[k + 1]``; the heights it met on the ``delay``
    rows above, NaN where there was none, wait in ``waiting[k]``. What the band leaves goes into the ``new_`` arrays.

    If the lines are ``joined`` to others, nothing is written before the first of them: that is for whom walks the lines up to it.
    No ground is below ``lowest`` (minus infinity if that is not known): what does not rise above the horizontal of ground that low is no
    corner, and no horizon is lower. On a round Earth a sea is convex, and each of its samples would be one: a stack of thousands per line.
    """
    height = columns.shape[1]
    distances = step_m * np.arange(first_row, first_row + height)
    lifts = curvature * distances * distances
    floor = NO_HORIZON if math.isinf(lowest) else 0.0
    before, here = np.full(height, floor), np.full(height, floor)
    most = np.max(starts[1:] - starts[:-1]) + height + delay
    corners, heights = np.empty(most, np.float64), np.empty(most, np.float64)
    met, own = np.empty(delay + height, np.float64), np.empty(height, np.float64)
    used = 0
    for k in range(starts.size - 1):
        line = first_line + k
        size = starts[k + 1] - starts[k]
        for n in range(size):
            corners[n] = corner_rows[starts[k] + n]
            heights[n] = corner_heights[starts[k] + n]
        met[:delay] = waiting[k]
        _heights_of_line(columns, line, wholes, rests, lifts, shift, met[delay:], own)
        for i in range(height):
            # met[i] is delay rows up: the first that is near here, and the next to be a corner
            here[i] = floor
            row = np.float64(first_row + i)
            if size > 0 and not math.isnan(own[i]):
                top = _horizon_corner(corners, heights, size, row, own[i])
                tangent = (heights[top] - own[i]) / ((row - corners[top]) * step_m) - 2.0 * curvature * distances[i]
                here[i] = max(tangent, floor)
            if met[i] > _least(lowest, curvature, step_m * (row - delay)):
                size = _push_corner(corners, heights, size, row - delay, met[i])
        for n in range(size):
            away = step_m * (first_row + height - corners[n])
            if heights[n] - _least(lowest, curvature, step_m * corners[n]) > curvature * away * away:
                new_corner_rows[used] = np.int32(corners[n])
                new_corner_heights[used] = heights[n]
                used += 1
        new_starts[k + 1] = used
        new_waiting[k] = met[height:]
        if k > 0 or not joined:
            _write_between(before, here, line - 1, wholes, rests, far)
        before, here = here, before


@compiled
def _write_between(before: Float64, here: Float64, line: int, wholes: Int64, rests: Float64, far: Float32) -> None:
    """Set the tangents ``far`` (w, h) of the samples between two lines, ``line`` and the next, from theirs.

    If one of the lines has no horizon, the nearer one decides: a share of infinity is not a number.
    """
    for i in range(before.size):
        x = line - wholes[i]
        if 0 <= x < far.shape[0]:
            tangent = before[i]
            if rests[i] > 0.0:
                tangent += rests[i] * (here[i] - before[i])
                if min(before[i], here[i]) == NO_HORIZON:
                    tangent = before[i] if rests[i] < 0.5 else here[i]
            far[x, i] = np.float32(tangent)


@compiled
def near_steps(heights: Float32, shift: float, step_m: float, curvature: float, steps: int, tangents: Float32) -> None:
    """Raise ``tangents`` (h, w) of the last h rows of ``heights`` to what the next ``steps`` rows toward the sun show; NaN in voids.

    From the sample itself to the terrain between two samples, exactly: it is near the sample that lines beside it are not like it.
    """
    rows, width = heights.shape
    height = tangents.shape[0]
    best = np.empty(width, np.float64)
    own = np.empty(width, np.float64)
    for i in range(height):
        y = rows - height + i
        for x in range(width):
            own[x] = heights[y, x]
            best[x] = tangents[i, x]
        for k in range(1, min(steps, y) + 1):
            place = shift * k
            whole = math.floor(place)
            share = place - whole
            aside = int(whole)
            start = max(0, -aside)
            count = min(width, width - aside - (1 if share > 0.0 else 0)) - start
            if count <= 0:
                continue
            per_metre = 1.0 / (k * step_m)
            dip = k * step_m * curvature
            left = heights[y - k, start + aside : start + aside + count]
            next_one = start + aside + (1 if share > 0.0 else 0)
            right = heights[y - k, next_one : next_one + count]
            looking, found = own[start : start + count], best[start : start + count]
            for x in range(count):
                first = np.float64(left[x])
                tangent = (first + share * (np.float64(right[x]) - first) - looking[x]) * per_metre - dip
                found[x] = tangent if tangent > found[x] else found[x]
        for x in range(width):
            tangents[i, x] = np.float32(best[x] + (own[x] - own[x]))
