"""What a filter sees beyond the edge of a level, by the definition of the rule, one sample at a time."""

from typing import Literal

import numpy as np

from tests.reference.kernels import Array

Edge = Literal["antisymmetric", "mirror", "mirror-sample"]
"""``antisymmetric``: reflection through the edge sample, for heights. ``mirror``: half-sample mirror, for imagery. ``mirror-sample``:
mirror at the edge sample, for light and normals."""


def extend(values: Array, coverage: Array, margin: tuple[int, int], edge: Edge) -> tuple[Array, Array]:
    """Return ``values`` (h, w, c) and ``coverage`` (h, w, 1) with ``margin`` = (before, after) samples added on both axes.

    Rows are added first, column by column, then columns to the result.
    """
    values, coverage = _extend_rows(values, coverage, margin, edge)
    values, coverage = _extend_rows(values.swapaxes(0, 1), coverage.swapaxes(0, 1), margin, edge)
    return values.swapaxes(0, 1), coverage.swapaxes(0, 1)


def _extend_rows(values: Array, coverage: Array, margin: tuple[int, int], edge: Edge) -> tuple[Array, Array]:
    before, after = margin
    row = {"antisymmetric": _antisymmetric_row, "mirror": _mirrored_row, "mirror-sample": _folded_row}[edge]
    rows = [row(values, coverage, m) for m in range(-before, len(values) + after)]
    return np.stack([value for value, _ in rows]), np.stack([cover for _, cover in rows])


def _antisymmetric_row(values: Array, coverage: Array, m: int) -> tuple[Array, Array]:
    """Row ``m``: z[-k] = 2 z[0] - z[k] and z[n-1+k] = 2 z[n-1] - z[n-1-k], again and again until inside.

    It is worth as much as the least covered of the rows it is made of. A single row is repeated.
    """
    last = len(values) - 1
    if last == 0:
        return values[0], coverage[0]
    if 0 <= m <= last:
        return values[m], coverage[m]
    end, reflected = (0, -m) if m < 0 else (last, 2 * last - m)
    value, cover = _antisymmetric_row(values, coverage, reflected)
    return 2 * values[end] - value, np.minimum(coverage[end], cover)


def _mirrored_row(values: Array, coverage: Array, m: int) -> tuple[Array, Array]:
    """Row ``m``: z[-1-k] = z[k] and z[n+k] = z[n-1-k], again and again until inside."""
    n = len(values)
    if 0 <= m < n:
        return values[m], coverage[m]
    return _mirrored_row(values, coverage, -1 - m if m < 0 else 2 * n - 1 - m)


def _folded_row(values: Array, coverage: Array, m: int) -> tuple[Array, Array]:
    """Row ``m``: z[-k] = z[k] and z[n-1+k] = z[n-1-k], again and again until inside. A single row is repeated."""
    last = len(values) - 1
    if last == 0 or 0 <= m <= last:
        return values[min(max(m, 0), last)], coverage[min(max(m, 0), last)]
    return _folded_row(values, coverage, -m if m < 0 else 2 * last - m)
