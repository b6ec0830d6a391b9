"""Where the windows of a level lie: integer origins from a float64 viewer, one level at a time.

Origins are Python ints, so that a lattice of 2**40 samples is as exact as one of 2**10.
"""

import math
from typing import Final

from schemas.errors import UsageError
from schemas.region import Rect

GRID_SIDES: Final = (15, 31, 63, 127, 255, 511)
"""Vertices along a side of a geometry level, 2**k - 1; its torus has one sample more."""

FRACTION_BITS: Final = 16
"""Binary places of a level-0 sample to which a viewer is placed."""

TEXTURE_OVERHANG: Final = 2
"""How far a texture window may reach beyond its level [texels]: enough that the level's own edge is never near the window's."""


def check_grid(n: int) -> int:
    """Return ``n`` if it is a possible side of the grid, else raise UsageError."""
    if n not in GRID_SIDES:
        raise UsageError(f"grid {n}: must be one of {', '.join(map(str, GRID_SIDES))} vertices")
    return n


def grid_origin(viewer: float, n: int, level: int) -> int:
    """Return the origin, on one axis, of the grid of ``n`` vertices of ``level`` around ``viewer``, which is in level-0 samples.

    The origin is even, so the grid moves in whole samples of the next coarser level, and the viewer is at most one sample
    off its centre; hence the grids of two neighbouring levels always nest, at offset m - 1 or m with m = (n + 1) / 4, though
    each is placed on its own (Asirvatham & Hoppe, "Terrain Rendering Using GPU-Based Geometry Clipmaps", section 2.3.2).

    This is ``2 floor((viewer / 2**level - (n - 1) / 2 + 1) / 2)``, in integers: rounded otherwise on every level, a viewer
    next to a step could pull two levels apart.
    """
    fixed = math.floor(math.ldexp(viewer, FRACTION_BITS))
    before = ((n - 1) // 2 - 1) << (FRACTION_BITS + level)
    return 2 * ((fixed - before) >> (FRACTION_BITS + level + 1))


def texture_origin(viewer: float, side: int, size: int) -> int:
    """Return the origin, on one axis, of a texture window of ``side`` texels around ``viewer`` in a level of ``size`` texels.

    The window moves in steps of side / 32, which makes uploads fewer and larger, and stays on the level but for
    ``TEXTURE_OVERHANG`` texels. A level that fits into the window has one place only.
    """
    step = max(1, side // 32)
    wanted = math.floor((viewer - side / 2) / step + 0.5) * step
    return max(-TEXTURE_OVERHANG, min(wanted, size + TEXTURE_OVERHANG - side))


def window(origin: tuple[int, int], side: int) -> Rect:
    """The samples of the square window of ``side`` samples at ``origin``."""
    x, y = origin
    return Rect(x, y, x + side, y + side)
