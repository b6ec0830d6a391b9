"""How far a level is from the next finer one: what bounds of geomorphs and of normals rest on."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from tiler.effects.statistics import measure_heights


@dataclass(frozen=True, slots=True)
class LevelDifference:
    """Largest differences of a level drawn as triangles to the next finer one; those of several windows are the largest of each."""

    height_m: float
    """Absolute difference of heights [m]; 0 if no sample is valid on both."""
    gradient: float
    """At least the length of the difference of slopes, as vectors."""
    squares_m2: float
    """Sum of the squares of differences of heights [m2]."""
    samples: int
    """Number of samples that are valid on both."""


def compare_levels(fine_m: NDArray[Any], coarse_m: NDArray[Any], cell_m: tuple[float, float]) -> LevelDifference:
    """Return how far heights ``coarse_m`` (ceil(h / 2), ceil(w / 2)) [m] drawn as triangles are from ``fine_m`` (h, w) [m].

    NaN is void; coarse sample i lies on fine sample 2 i, ``cell_m`` is the distance of fine samples along a row and a column [m]. Windows
    of a level begin at even samples and share a row or column with the next. Triangles are cut from corner (0, 0) to corner (1, 1), on
    all levels, so both surfaces are linear on every triangle of the finer one. Raises UsageError if the shapes do not fit.
    """
    height, width = fine_m.shape
    if coarse_m.shape != (-(-height // 2), -(-width // 2)):
        raise UsageError(f"a level of {coarse_m.shape} samples is not the next coarser one of {fine_m.shape}")
    rows, columns = height - 1 + height % 2, width - 1 + width % 2
    y, x = np.arange(rows), np.arange(columns)
    coarse = coarse_m.astype(np.float64)
    # A vertex lies on the middle of an edge of the coarser mesh, which for an odd one in both axes is the diagonal.
    first, second = coarse[np.ix_(y >> 1, x >> 1)], coarse[np.ix_((y + 1) >> 1, (x + 1) >> 1)]
    difference = 0.5 * (first + second) - fine_m[:rows, :columns]
    valid = difference[np.isfinite(difference)]
    if not valid.size:
        return LevelDifference(0.0, 0.0, 0.0, 0)
    found = measure_heights([difference], (rows, columns), cell_m, (0.0, 90.0))
    return LevelDifference(max(found.high_m, -found.low_m), found.steepest, float(valid @ valid), valid.size)
