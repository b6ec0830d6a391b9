"""The geometry of a pyramid by plain counting: halve until done, walk over every sample, subtract sets."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.reference.kernels import Registration, taps

Sample = tuple[int, int]
"""(x, y), counted from the left and from the top."""


def level_sizes(width: int, height: int, block: int) -> list[Sample]:
    """Return (width, height) of every level: halved, rounding up, until one block of side ``block`` holds the level."""
    sizes = [(width, height)]
    while max(sizes[-1]) > block:
        w, h = sizes[-1]
        sizes.append((w - w // 2, h - h // 2))
    return sizes


def blocks_of(samples: set[Sample], block: int) -> set[Sample]:
    """Return the (x, y) of all blocks that own at least one of ``samples``."""
    return {(x // block, y // block) for x, y in samples}


def rectangle(x0: int, y0: int, x1: int, y1: int) -> set[Sample]:
    """Return the samples of the half-open rectangle ``[x0, x1) x [y0, y1)``."""
    return {(x, y) for x in range(x0, x1) for y in range(y0, y1)}


def fine_samples(coarse: set[Sample], kernel: str, radius: int, registration: Registration) -> set[Sample]:
    """Return the samples of the finer level that have a non-zero weight in at least one of the ``coarse`` samples."""
    reach = [int(k) for k, w in zip(*taps(kernel, radius, registration), strict=True) if w != 0]
    return {(2 * x + i, 2 * y + j) for x, y in coarse for i in reach for j in reach}


def window(level: NDArray[Any], x0: int, y0: int, x1: int, y1: int) -> NDArray[Any]:
    """Return ``level[y0:y1, x0:x1]`` as if the edge samples of the level were repeated without end."""
    rows = np.clip(np.arange(y0, y1), 0, level.shape[0] - 1)
    columns = np.clip(np.arange(x0, x1), 0, level.shape[1] - 1)
    result: NDArray[Any] = level[rows][:, columns]
    return result
