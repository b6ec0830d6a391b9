"""The per-frame update: coarse to fine, under a budget, drawing only what is whole.

Geometry level l is active when its window is exactly where the viewer wants it and level l + 1 is active. A level whose
blocks are not there yet, or that the budget leaves behind, stays inactive with all finer ones, and the finest active level
fills its own centre (Asirvatham & Hoppe, section 2.4). Texture windows may lag: each says what it holds, and a fragment
takes the finest level that has it.
"""

import math
from dataclasses import dataclass

from viewer.blocks import BlockKey
from viewer.frame import level_texel
from viewer.placement import grid_origin, texture_origin
from viewer.pyramid import Pyramid
from viewer.stack import ClipStack, IsLoaded, Origin


@dataclass(frozen=True, slots=True)
class Urgency:
    """A wanted block: coarse levels first, heights before imagery, what is needed now before what may be needed next."""

    ahead: bool
    depth: int
    layer: int


@dataclass(frozen=True, slots=True)
class Update:
    """What an update did and wants."""

    active: int
    """Finest active geometry level; the number of levels if none is."""
    wanted: tuple[tuple[Urgency, BlockKey], ...]
    """Blocks to load."""
    behind: bool
    """Whether the budget, not the data, held something back."""

    @property
    def settled(self) -> bool:
        """Whether every window is where the viewer wants it."""
        return not self.behind and all(urgency.ahead for urgency, _ in self.wanted)


class GeometryClipmap:
    """Windows of heights; the grid of ``n`` vertices uses all but one row and column of a window of n + 1 samples."""

    def __init__(self, stack: ClipStack, is_loaded: IsLoaded) -> None:
        self._stack = stack
        self._is_loaded = is_loaded
        self.n = stack.side - 1

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self._stack.origins)

    def wanted_origin(self, viewer: tuple[float, float], level: int) -> Origin:
        """Where the window of ``level`` belongs for a viewer in level-0 samples."""
        return grid_origin(viewer[0], self.n, level), grid_origin(viewer[1], self.n, level)

    def update(self, viewer: tuple[float, float], finest: int, budget: int | None) -> Update:
        """Move the windows from the coarsest level to ``finest``, writing about ``budget`` samples (None: all).

        The first level that has to move always does, or a small budget would never get anywhere.
        """
        stack, spent, behind = self._stack, 0, False
        active = self.levels
        wanted: list[tuple[Urgency, BlockKey]] = []
        for level in reversed(range(min(finest, self.levels - 1), self.levels)):
            origin = self.wanted_origin(viewer, level)
            depth = self.levels - 1 - level
            unmet = stack.unmet(level, origin, self._is_loaded)
            wanted += [(Urgency(ahead=False, depth=depth, layer=0), key) for key in unmet]
            wanted += [(Urgency(ahead=True, depth=depth, layer=0), key) for key in stack.around(level, origin, self.n // 4)]
            if unmet or active > level + 1:
                continue
            cost = stack.cost(level, origin)
            if budget is not None and spent and cost and spent + cost > budget:
                behind = True
            elif not cost or stack.move(level, origin):
                spent, active = spent + cost, level
            else:
                behind = True
        return Update(active, tuple(wanted), behind)

    def height_cut_off(self, height_m: float, spacing_m: float, pixels_per_radian: float) -> int:
        """Return the finest level worth drawing from ``height_m`` above the ground.

        Losasso & Hoppe (section 4.1) drop a level when the viewer is higher than 0.4 n of its samples. Here it stays as long
        as its samples are a pixel apart straight below, which on today's screens is longer.
        """
        reach = max(0.4 * self.n, pixels_per_radian)
        return finest_level(height_m / (reach * spacing_m), self.levels)


class TextureClipmap:
    """Windows of imagery around the viewer, each holding what it holds until it can move."""

    def __init__(self, stack: ClipStack, pyramid: Pyramid, registration: str, is_loaded: IsLoaded) -> None:
        self._stack = stack
        self._pyramid = pyramid
        self._registration = registration
        self._is_loaded = is_loaded

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self._pyramid.levels

    @property
    def side(self) -> int:
        """Side of a window [texels]."""
        return self._stack.side

    @property
    def origins(self) -> list[Origin | None]:
        """Where the windows are."""
        return self._stack.origins

    def wanted_origin(self, viewer: tuple[float, float], level: int) -> Origin:
        """Where the window of ``level`` belongs for a viewer in level-0 texels."""
        extent = self._pyramid.extent(level)
        x, y = (level_texel(value, level, self._registration) for value in viewer)
        return texture_origin(x, self.side, extent.width), texture_origin(y, self.side, extent.height)

    def update(self, viewer: tuple[float, float], finest: int, budget: int | None) -> Update:
        """Move the windows from the coarsest level to ``finest``, writing about ``budget`` texels (None: all)."""
        stack, spent, behind = self._stack, 0, False
        wanted: list[tuple[Urgency, BlockKey]] = []
        for level in reversed(range(min(finest, self.levels - 1), self.levels)):
            origin = self.wanted_origin(viewer, level)
            if origin == stack.origins[level]:
                continue
            unmet = stack.unmet(level, origin, self._is_loaded)
            cost = stack.cost(level, origin)
            if unmet:
                wanted += [(Urgency(ahead=False, depth=self.levels - 1 - level, layer=1), key) for key in unmet]
            elif (budget is not None and spent and spent + cost > budget) or not stack.move(level, origin):
                behind = True
            else:
                spent += cost
        return Update(self.levels, tuple(wanted), behind)


def finest_level(samples: float, levels: int) -> int:
    """Return the finest of ``levels`` levels worth having when level 0 is finer than needed by the factor ``samples``."""
    if samples <= 1.0:
        return 0
    return min(levels - 1, math.ceil(math.log2(samples)))
