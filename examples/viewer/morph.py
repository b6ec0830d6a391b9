"""How a level turns into the next coarser one towards its rim: the numpy mirror of ``shaders/morph.glsl``.

At the rim of a level every vertex lies on the coarser surface (alpha 1), at its inner boundary it is untouched (alpha 0);
so neighbouring levels share their edges exactly (Losasso & Hoppe, section 4.2, with the width n / 10 that the printed
"10n" stands for).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.viewbounds import MORPH_SLACK

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Ramp:
    """Alpha on one axis is ``clamp((distance - start) * rate, 0, 1)``, distances from the viewer in samples of the level."""

    start: float
    rate: float


STILL = Ramp(0.0, 0.0)
"""No morph: the coarsest level."""


def ramp(n: int) -> Ramp:
    """Return the ramp of a grid of n x n vertices.

    The viewer may be one sample off the centre, which ``start`` pays for: alpha is 1 on the whole rim and 0 on the inner
    boundary for every viewer that ``placement.grid_origin`` allows, as n / 10 <= (n - 1) / 4 - 3 / 2 for n >= 15. ``MORPH_SLACK``
    of the width is given away so that alpha reaches 1 in float32 too.
    """
    width = n / 10
    return Ramp((n - 1) / 2 - width - 1, 1 / (width * (1 - MORPH_SLACK)))


def alpha(x: Floats, y: Floats, viewer: tuple[float, float], level_ramp: Ramp) -> Floats:
    """Return alpha at grid coordinates ``x``, ``y`` for a viewer in grid coordinates."""
    distance: Floats = np.maximum(np.abs(x - viewer[0]), np.abs(y - viewer[1]))
    return np.clip((distance - level_ramp.start) * level_ramp.rate, 0.0, 1.0)


def coarse_height(coarse: Floats, x: NDArray[np.int64], y: NDArray[np.int64]) -> Floats:
    """Return the coarser surface at samples (x, y) of the finer level; ``coarse`` holds the coarser level from its sample (0, 0).

    A vertex lies on the middle of an edge of the coarser mesh, whose ends are averaged; the edge through an odd-odd vertex is
    the diagonal of its quad.
    """
    x0, y0, odd_x, odd_y = x >> 1, y >> 1, x & 1, y & 1
    middle: Floats = 0.5 * (coarse[y0, x0] + coarse[y0 + odd_y, x0 + odd_x])
    return middle


def morphed(fine: Floats, coarse: Floats, weight: Floats) -> Floats:
    """Return ``fine`` at weight 0, ``coarse`` at weight 1, both exactly."""
    return np.where(weight >= 1.0, coarse, fine * (1.0 - weight) + coarse * weight)
