"""A grid with what lies between its samples, by the rule's own words, one line after the other in float64."""

from itertools import pairwise

import numpy as np

from tests.reference.kernels import Array


def between(line: Array) -> Array:
    """Return a line with its midpoints; what is missing on one side is the point reflection of the other."""
    found = []
    for number, (a, b) in enumerate(pairwise(line)):
        p = line[number - 1] if number else np.nan
        q = line[number + 2] if number + 2 < len(line) else np.nan
        p = 2 * a - b if np.isnan(p) else p
        q = 2 * b - a if np.isnan(q) else q
        found += [a, -p / 16 + 9 * a / 16 + 9 * b / 16 - q / 16]
    return np.array([*found, line[-1]])


def refined(heights: Array) -> Array:
    """Return ``heights`` (h, w), NaN where void, with midpoints (2h - 1, 2w - 1): the mean of rows first and columns first."""
    rows_first = np.apply_along_axis(between, 0, np.apply_along_axis(between, 1, heights))
    columns_first = np.apply_along_axis(between, 1, np.apply_along_axis(between, 0, heights))
    return np.asarray((rows_first + columns_first) / 2, np.float64)
