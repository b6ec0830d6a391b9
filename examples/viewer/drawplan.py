"""What the shaders are told each frame: which patches of which level, and where every window is relative to the viewer.

Everything is computed in Python ints and float64; what reaches the GPU are small integers, fractions, and distances from
the viewer, so a picture does not depend on how far from the origin it is taken.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from viewer.footprint import Patch, Shape, patches
from viewer.frame import level_texel
from viewer.morph import STILL, ramp
from viewer.stack import Origin
from viewer.texlod import EVERYWHERE, INSET_PX, NOWHERE

MAX_LEVELS: Final = 22
"""Most levels a window of 511 vertices can have before level-0 distances leave 32 bits."""

Keep = Callable[[int, Sequence[Patch]], Sequence[Patch]]
"""Given a level and its patches, which of them to draw."""

GEOMETRY_LEVEL: Final = np.dtype([("torus", "<i4", 4), ("place", "<i4", 4), ("morph", "<f4", 4)])
"""One geometry level as ``shaders/levels.glsl`` declares it (std140)."""

TEXTURE_LEVEL: Final = np.dtype([("bounds", "<f4", 4), ("edge", "<f4", 4), ("base", "<f4", 4)])
"""One texture level as ``shaders/texlod.glsl`` declares it (std140)."""


@dataclass(frozen=True, slots=True)
class GeometryPlan:
    """One frame of geometry."""

    instances: dict[Shape, NDArray[np.int32]]
    """(x, y, level) of every patch to draw, by mesh."""
    levels: NDArray[np.void]
    """``GEOMETRY_LEVEL`` records, level 0 first."""
    fraction: tuple[float, float]
    """Where the viewer is within its level-0 cell."""


def plan_geometry(viewer: tuple[float, float], origins: Sequence[Origin], active: int, n: int, keep: Keep | None = None) -> GeometryPlan:
    """Return the plan for a viewer in level-0 samples; ``origins`` are those of all levels, ``active`` the finest one drawn."""
    whole = math.floor(viewer[0]), math.floor(viewer[1])
    records = np.zeros(MAX_LEVELS, GEOMETRY_LEVEL)
    last, mask = len(origins) - 1, n
    for level in range(active, last + 1):
        x, y = origins[level]
        here = math.ldexp(viewer[0], -level), math.ldexp(viewer[1], -level)
        level_ramp = ramp(n) if level < last else STILL
        records[level]["torus"] = x & mask, y & mask, (x >> 1) & mask, (y >> 1) & mask
        records[level]["place"] = (x << level) - whole[0], (y << level) - whole[1], 1 << level, min(level + 1, last)
        records[level]["morph"] = here[0] - x, here[1] - y, level_ramp.start, level_ramp.rate
    drawn: dict[Shape, list[tuple[int, int, int]]] = {}
    for level, level_patches in enumerate(patches(n, origins[active:]), active):
        for patch in level_patches if keep is None else keep(level, level_patches):
            drawn.setdefault(patch.shape, []).append((patch.x, patch.y, level))
    instances = {shape: np.array(rows, np.int32) for shape, rows in drawn.items()}
    return GeometryPlan(instances, records, (viewer[0] - whole[0], viewer[1] - whole[1]))


def texture_records(
    viewer: tuple[float, float], origins: Sequence[Origin | None], sizes: Sequence[tuple[int, int]], side: int, registration: str
) -> NDArray[np.void]:
    """Return the ``TEXTURE_LEVEL`` records for a viewer in level-0 texels.

    ``bounds`` is the usable part of the window, ``edge`` the middle of the level's outermost texels, both relative to the
    viewer; ``base`` is the viewer's place on the torus. All in texels of the level.
    """
    records = np.zeros(MAX_LEVELS, TEXTURE_LEVEL)
    for level, (origin, (width, height)) in enumerate(zip(origins, sizes, strict=True)):
        x, y = (level_texel(value, level, registration) for value in viewer)
        bounds = NOWHERE
        if origin is not None:
            low, high = INSET_PX, side - INSET_PX
            bounds = origin[0] + low - x, origin[1] + low - y, origin[0] + high - x, origin[1] + high - y
            if level == len(sizes) - 1:
                bounds = EVERYWHERE
        records[level]["bounds"] = bounds
        records[level]["edge"] = 0.5 - x, 0.5 - y, width - 0.5 - x, height - 0.5 - y
        records[level]["base"] = x % side, y % side, 0.0, 0.0
    return records
