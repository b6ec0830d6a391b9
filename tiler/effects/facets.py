"""The pass over the heights behind the bounds: range, steepest facet and steepest toward the sun, of every tile. Compiled, outside the GIL.

Only minima and maxima are kept, which do not depend on the order in which rows come.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.compiled import compiled

Heights = NDArray[Any]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

LOW, HIGH, STEEPEST, TOWARD = range(4)
"""What a tile's four numbers are; the third is squared until the pass is over."""


@compiled
def _gap_count(row: Heights, first: int, last: int) -> int:
    """Return how many samples from ``first`` up to before ``last`` are void: NaN or infinite."""
    part = row[first:last]
    count = 0
    for x in range(part.size):
        count += int(not abs(part[x]) < np.inf)
    return count


@compiled
def _larger(a: float, b: float) -> float:
    """Return the larger of two numbers that are not NaN: what a processor does in one step, where Python's ``max`` looks for NaN."""
    return a if a > b else b


@compiled
def _smaller(a: float, b: float) -> float:
    return a if a < b else b


@compiled
def _whole_cells(upper: Heights, lower: Heights, first: int, last: int, sun: Float64, columns: Float64) -> None:
    """Measure the cells between two rows from column ``first`` up to before ``last``, all of whose corners are valid.

    ``sun`` is (1 / cell_x, 1 / cell_y, east, south): the unit vector of its azimuth. Gradients of both triangulations and of the bilinear
    surface lie in the box of the slopes along the cell's four sides; length and slope toward the sun are largest in a corner of it,
    coordinate by coordinate. Results go column by column into ``columns`` (4, w), which a processor does four at a time; one maximum
    over a row takes three times as long.
    """
    per_x, per_y, east, south = sun[0], sun[1], sun[2], sun[3]
    # Slices, as an index that might be negative keeps the loop from being vectorised.
    left0, right0, left1, right1 = upper[first:last], upper[first + 1 : last + 1], lower[first:last], lower[first + 1 : last + 1]
    steepest, toward = columns[STEEPEST, first:last], columns[TOWARD, first:last]
    for x in range(left0.size):
        z00, z01, z10, z11 = np.float64(left0[x]), np.float64(right0[x]), np.float64(left1[x]), np.float64(right1[x])
        a0, a1 = (z01 - z00) * per_x, (z11 - z10) * per_x
        b0, b1 = (z10 - z00) * per_y, (z11 - z01) * per_y
        square = _larger(a0 * a0, a1 * a1) + _larger(b0 * b0, b1 * b1)
        slope = _larger(east * a0, east * a1) + _larger(south * b0, south * b1)
        steepest[x], toward[x] = _larger(steepest[x], square), _larger(toward[x], slope)
    low, high = columns[LOW, first : last + 1], columns[HIGH, first : last + 1]
    top, bottom = upper[first : last + 1], lower[first : last + 1]
    for x in range(top.size):
        above, below = np.float64(top[x]), np.float64(bottom[x])
        low[x], high[x] = _smaller(low[x], _smaller(above, below)), _larger(high[x], _larger(above, below))


@compiled
def _holed_cells(upper: Heights, lower: Heights, first: int, last: int, sun: Float64, found: Float64) -> None:
    """Measure cells of which corners may be void: each side between two valid corners, and each pair of sides that meet.

    A side that ends in a void counts as level, so that the slope along the other is measured on its own.
    """
    a, b = np.zeros(2), np.zeros(2)
    for x in range(first, last):
        z00, z01, z10, z11 = np.float64(upper[x]), np.float64(upper[x + 1]), np.float64(lower[x]), np.float64(lower[x + 1])
        a[0], a[1] = (z01 - z00) * sun[0], (z11 - z10) * sun[0]
        b[0], b[1] = (z10 - z00) * sun[1], (z11 - z01) * sun[1]
        for side in range(2):
            a[side] = a[side] if abs(a[side]) < np.inf else 0.0
            b[side] = b[side] if abs(b[side]) < np.inf else 0.0
        for i in range(2):
            for j in range(2):
                square, slope = a[i] * a[i] + b[j] * b[j], sun[2] * a[i] + sun[3] * b[j]
                found[STEEPEST], found[TOWARD] = max(found[STEEPEST], square), max(found[TOWARD], slope)
        for z in (z00, z01, z10, z11):
            if abs(z) < np.inf:
                found[LOW], found[HIGH] = min(found[LOW], z), max(found[HIGH], z)


@compiled
def _forget(columns: Float64) -> None:
    """Set ``columns`` to those of nothing."""
    columns[LOW], columns[HIGH], columns[STEEPEST], columns[TOWARD] = np.inf, -np.inf, 0.0, -np.inf


@compiled
def _gather(columns: Float64, side: int, tiles: Float64) -> None:
    """Bring a row of ``tiles`` (n, 4) of ``side`` cells up to date with ``columns`` (4, w)."""
    cells = columns.shape[1] - 1
    for n in range(tiles.shape[0]):
        found, first, last = tiles[n], n * side, min((n + 1) * side, cells)
        for x in range(first, last + 1):
            found[LOW], found[HIGH] = min(found[LOW], columns[LOW, x]), max(found[HIGH], columns[HIGH, x])
        for x in range(first, last):
            found[STEEPEST], found[TOWARD] = max(found[STEEPEST], columns[STEEPEST, x]), max(found[TOWARD], columns[TOWARD, x])


@compiled
def measure_cells(rows: Heights, top: int, side: int, sun: Float64, tiles: Float64, voids: Int64) -> None:
    """Measure the cells between consecutive ``rows`` (n + 1, w), the first of which is row ``top`` of the map.

    ``tiles`` (rows, columns, 4) are the numbers of tiles of ``side`` by ``side`` cells, their edges included, and ``voids`` (rows,
    columns) how many voids their cells touch; both are brought up to date.
    """
    cells, count = rows.shape[1] - 1, rows.shape[0] - 1
    columns = np.empty((4, rows.shape[1]))
    _forget(columns)
    for n in range(count):
        upper, lower, y = rows[n], rows[n + 1], (top + n) // side
        for x in range(tiles.shape[1]):
            first, last = x * side, min((x + 1) * side, cells)
            gaps = _gap_count(upper, first, last + 1) + _gap_count(lower, first, last + 1)
            if gaps:
                voids[y, x] += gaps
                _holed_cells(upper, lower, first, last, sun, tiles[y, x])
            else:
                _whole_cells(upper, lower, first, last, sun, columns)
        if n == count - 1 or (top + n + 1) // side != y:
            _gather(columns, side, tiles[y])
            _forget(columns)
