"""Which level of a texture clipmap a fragment takes: the numpy mirror of ``shaders/texlod.glsl``.

The preferred level follows from the size of a pixel in texels, the available one from the windows; near the rim of the
finest window that holds a fragment the level is blended into the next, so that no line shows (Luo & Duan, section 3.2,
with a clamped logarithm, and an inset of one texel because a bilinear fetch reaches half a texel over the seam).
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

INSET_PX: Final = 1.0
"""Rim of a window that is not sampled [texels of its level]."""
BLEND_PX: Final = 24.0
"""Width over which a level fades into the next at the rim of its window [texels of its level]."""

Bounds = tuple[float, float, float, float]
"""(x low, y low, x high, y high) of the usable part of a window, relative to the viewer [texels of its level]."""

EVERYWHERE: Final[Bounds] = (-1e30, -1e30, 1e30, 1e30)
NOWHERE: Final[Bounds] = (1e30, 1e30, -1e30, -1e30)


def preferred_level(dx: tuple[float, float], dy: tuple[float, float]) -> float:
    """Return the level whose texels are a pixel wide, given the steps to the next pixel right and up [level-0 texels]."""
    longest = max(dx[0] ** 2 + dx[1] ** 2, dy[0] ** 2 + dy[1] ** 2, 1e-20)
    return max(0.0, 0.5 * float(np.log2(longest)))


def rim_distance(texel: tuple[float, float], bounds: Bounds, level: int) -> float:
    """Return how far inside the window of ``level`` a fragment lies [texels of the level], negative outside."""
    x, y = texel[0] * 0.5**level, texel[1] * 0.5**level
    return min(x - bounds[0], y - bounds[1], bounds[2] - x, bounds[3] - y)


def available(texel: tuple[float, float], bounds: Sequence[Bounds], first: int) -> tuple[int, float]:
    """Return the first level from ``first`` whose window holds the fragment, and the distance to its rim.

    The last level holds every fragment. All levels are tried because windows that lag behind the viewer need not nest.
    """
    for level in range(first, len(bounds) - 1):
        inside = rim_distance(texel, bounds[level], level)
        if inside >= 0.0:
            return level, inside
    return len(bounds) - 1, 1e30


def choose_levels(texel: tuple[float, float], preferred: float, bounds: Sequence[Bounds]) -> tuple[int, int, float]:
    """Return (level, coarser level, weight of the coarser one) for a fragment at ``texel``, viewer-relative level-0 texels."""
    last = len(bounds) - 1
    preferred = min(preferred, float(last))
    found, inside = available(texel, bounds, int(preferred))
    level = max(preferred, found + min(max(1.0 - inside / BLEND_PX, 0.0), 1.0))
    fine, _ = available(texel, bounds, min(int(level), last))
    coarse, _ = available(texel, bounds, min(int(level) + 1, last))
    return fine, coarse, level - int(level)
