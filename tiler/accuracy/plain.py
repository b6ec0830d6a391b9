"""Filtering written out plainly in NumPy, in any precision: the yardstick of the compiled loops, and what they are compared with in time.

The sum is the textbook one, over weighted samples, not over differences to a reference sample; in float64 this loses nothing, in
float32 it shows what the differences are for.
"""

import numpy as np
from numpy.typing import NDArray

from tiler.filters.edges import EdgeRule
from tiler.filters.kernels import Kernel

Samples = NDArray[np.floating]


def halved(values: Samples, kernel: Kernel, edge: EdgeRule) -> Samples:
    """Return the next coarser level of ``values`` (h, w, c) in their own precision, (ceil(h / 2), ceil(w / 2), c)."""
    rows = _halved_rows(values, kernel, edge)
    return _halved_rows(rows.swapaxes(0, 1), kernel, edge).swapaxes(0, 1)


def levels(values: Samples, kernel: Kernel, edge: EdgeRule, count: int) -> list[Samples]:
    """Return levels 1 to ``count`` of ``values``, each made from the one before."""
    result: list[Samples] = []
    for _ in range(count):
        values = halved(values, kernel, edge)
        result.append(values)
    return result


def _halved_rows(values: Samples, kernel: Kernel, edge: EdgeRule) -> Samples:
    size = -(-len(values) // 2)
    before, after = kernel.reach
    padded = _extended(values, before, after + 1, edge)
    dtype = values.dtype.type

    def under(offset: int) -> Samples:
        return padded[before + offset : before + offset + 2 * size - 1 : 2]

    total = np.zeros((size, *values.shape[1:]), values.dtype)
    if kernel.registration == "point":
        total += dtype(1 - 2 * sum(kernel.weights)) * under(0)
    for low, high, weight in zip(kernel.low, kernel.high, kernel.weights, strict=True):
        total += dtype(weight) * (under(low) + under(high))
    return total


def _extended(values: Samples, before: int, after: int, edge: EdgeRule) -> Samples:
    margin = ((before, after), *((0, 0),) * (values.ndim - 1))
    if edge == "mirror":
        return np.pad(values, margin, mode="symmetric")
    return np.pad(values, margin, mode="reflect", reflect_type="odd")
