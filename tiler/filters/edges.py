"""What a filter sees beyond the edge of a level.

``antisymmetric`` (heights): point reflection about the outermost sample, ``z[-k] = 2 z[0] - z[k]``, which continues a
ramp exactly; coarse samples on the edge equal their fine ones. ``mirror`` (imagery): reflection about the outer side of
the outermost cell, ``z[-1-k] = z[k]``, which never leaves the range of the image. ``mirror-sample`` (light, normals):
reflection about the outermost sample, ``z[-k] = z[k]``, which never leaves the range either and leaves samples where they
lie; heights that go on antisymmetrically have slopes that go on so. All are repeated where the level is smaller than the kernel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

EdgeRule = Literal["antisymmetric", "mirror", "mirror-sample"]


@dataclass(frozen=True, slots=True)
class Term:
    """An index beyond the edge as ``sign * z[source] + first * z[0] + last * z[n - 1]``."""

    source: int
    sign: int = 1
    first: int = 0
    last: int = 0


def _mirror(index: int, size: int) -> Term:
    place = index % (2 * size)
    return Term(min(place, 2 * size - 1 - place))


def _mirror_sample(index: int, size: int) -> Term:
    place = index % max(2 * (size - 1), 1)
    return Term(min(place, 2 * (size - 1) - place))


def _antisymmetric(index: int, size: int) -> Term:
    if size == 1:
        return Term(0)
    if -size < index < 0:
        return Term(-index, -1, 2, 0)
    period, place = divmod(index, 2 * (size - 1))
    if place < size:
        return Term(place, 1, -2 * period, 2 * period)
    return Term(2 * (size - 1) - place, -1, -2 * period, 2 * period + 2)


_RULES: Final[dict[EdgeRule, Callable[[int, int], Term]]] = {
    "antisymmetric": _antisymmetric,
    "mirror": _mirror,
    "mirror-sample": _mirror_sample,
}


@lru_cache(maxsize=256)
def _terms(rule: EdgeRule, size: int, indices: range) -> tuple[tuple[Term, ...], NDArray[np.intp], bool]:
    """Return what lies at ``indices``, which lines that are, and whether it is these lines as they are.

    Remembered, as a task asks the same for every portion of rows.
    """
    terms = tuple(_RULES[rule](index, size) for index in indices)
    return terms, np.array([term.source for term in terms], np.intp), all(term.sign == 1 and term.last == 0 for term in terms)


def extend(
    values: NDArray[np.float32], coverage: NDArray[np.float32] | None, *, rule: EdgeRule, size: int, origin: int, indices: range
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the lines ``indices`` beyond the edge of an axis of ``size`` lines; values (lines, n, c), coverage (lines, n) or None.

    ``values`` holds the lines from ``origin`` on, among them every one that the reflections need. An extended line is as
    covered as the least covered line it is made of. Sums are taken in float64 and rounded once.
    """
    terms, lines, are_plain = _terms(rule, size, indices)
    source = lines - origin
    if are_plain:
        return values[source], None if coverage is None else coverage[source]
    total = np.array([term.sign for term in terms], np.float64)[:, np.newaxis, np.newaxis] * values[source]
    covered = None if coverage is None else coverage[source]
    for line, factors in ((0, [term.first for term in terms]), (size - 1, [term.last for term in terms])):
        used = np.flatnonzero(factors)
        if used.size == 0:
            continue
        total[used] += np.array(factors, np.float64)[used, np.newaxis, np.newaxis] * values[line - origin]
        if covered is not None and coverage is not None:
            covered[used] = np.minimum(covered[used], coverage[line - origin])
    return total.astype(np.float32), covered
