"""The windows of one layer: where each level's window is, and moving it with as few writes as possible."""

from collections.abc import Callable
from typing import Protocol

from viewer.blocks import BlockKey
from viewer.placement import window
from viewer.pyramid import Planes, Pyramid
from viewer.torus import TorusRect, update_rects

Origin = tuple[int, int]
IsLoaded = Callable[[BlockKey], bool]
"""Whether a block is in the cache; asking counts as using it."""


class Sink(Protocol):
    """What takes the samples: a stack of square toroidal textures, one per level."""

    def write(self, level: int, rect: TorusRect, planes: Planes) -> None:
        """Put the planes of ``rect.source`` into the slots of ``rect``."""
        ...


class ClipStack:
    """Windows of ``side`` x ``side`` samples, one per level of ``pyramid``; their contents go to ``sink``.

    A window is either whole or not there: it moves only when every block of what it newly shows is loaded.
    """

    def __init__(self, pyramid: Pyramid, side: int, sink: Sink) -> None:
        self._pyramid = pyramid
        self._sink = sink
        self.side = side
        self.origins: list[Origin | None] = [None] * pyramid.levels
        self.written_samples = 0

    def exposed(self, level: int, origin: Origin) -> list[TorusRect]:
        """What must be written to move the window of ``level`` to ``origin``; empty if it is there."""
        return update_rects(self.origins[level], origin, self.side)

    def unmet(self, level: int, origin: Origin, is_loaded: IsLoaded) -> list[BlockKey]:
        """Return the blocks that moving the window to ``origin`` needs, empty if all are loaded.

        The loaded ones are among them, since they must stay in the cache until the others have come.
        """
        needed = dict.fromkeys(key for rect in self.exposed(level, origin) for key in self._pyramid.needs(level, rect.source))
        return [] if all(is_loaded(key) for key in needed) else list(needed)

    def around(self, level: int, origin: Origin, margin: int) -> list[BlockKey]:
        """Return the blocks of the window at ``origin`` and of ``margin`` samples around it."""
        return self._pyramid.needs(level, window(origin, self.side).grown(margin))

    def cost(self, level: int, origin: Origin) -> int:
        """Samples that moving the window to ``origin`` writes."""
        return sum(rect.source.area for rect in self.exposed(level, origin))

    def move(self, level: int, origin: Origin) -> bool:
        """Move the window of ``level`` to ``origin``; False, and nothing changed, if a block has gone from the cache meanwhile."""
        contents = [(rect, self._pyramid.planes(level, rect.source)) for rect in self.exposed(level, origin)]
        for _, planes in contents:
            if planes is None:
                return False
        for rect, planes in contents:
            if planes is not None:
                self._sink.write(level, rect, planes)
                self.written_samples += rect.source.area
        self.origins[level] = origin
        return True
