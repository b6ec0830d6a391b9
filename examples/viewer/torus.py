"""Toroidal addressing: which rectangles of a texture to rewrite when its window moves.

Sample i of a level always lies in slot ``i mod N`` of the texture, floor modulo, so a window that moves keeps the samples
it still needs where they are (Losasso & Hoppe, "Geometry Clipmaps", section 6.1). No other state is needed.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect, exposed_interval

_Sample = TypeVar("_Sample", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Arc:
    """One unbroken span of slots on one axis: ``length`` slots from ``slot``, for the samples from ``start``.

    A full circumference is one span whose samples are rolled by ``roll`` slots, instead of two spans.
    """

    start: int
    slot: int
    length: int
    roll: int = 0


@dataclass(frozen=True, slots=True)
class TorusRect:
    """A rectangle of samples and the rectangle of slots that takes it; no part of it crosses the seam."""

    x: Arc
    y: Arc

    @property
    def source(self) -> Rect:
        """The samples, in coordinates of the level."""
        return Rect(self.x.start, self.y.start, self.x.start + self.x.length, self.y.start + self.y.length)

    @property
    def slots(self) -> tuple[int, int, int, int]:
        """(x, y, width, height) in the texture."""
        return self.x.slot, self.y.slot, self.x.length, self.y.length

    def arrange(self, samples: NDArray[_Sample]) -> NDArray[_Sample]:
        """Return ``samples`` of ``source``, (height, width, ...), in the order of the slots, contiguous in memory."""
        rolled = np.roll(samples, (self.y.roll, self.x.roll), axis=(0, 1)) if self.x.roll or self.y.roll else samples
        return np.ascontiguousarray(rolled)


def arcs(start: int, end: int, side: int) -> tuple[Arc, ...]:
    """Return the spans of slots for the samples ``[start, end)``, at most ``side`` of them, of a torus of ``side`` slots."""
    length = end - start
    if length <= 0:
        return ()
    slot = start % side
    if length == side:
        return (Arc(start, 0, side, roll=slot),)
    if slot + length <= side:
        return (Arc(start, slot, length),)
    first = side - slot
    return Arc(start, slot, first), Arc(start + first, 0, length - first)


def _product(columns: tuple[int, int], rows: tuple[int, int], side: int) -> list[TorusRect]:
    return [TorusRect(x, y) for y in arcs(*rows, side) for x in arcs(*columns, side)]


def update_rects(old: tuple[int, int] | None, new: tuple[int, int], side: int) -> list[TorusRect]:
    """Return what to rewrite when a window of ``side`` samples moves from origin ``old`` to ``new``; all of it if ``old`` is None.

    Every sample of the new window outside the old one is in exactly one rectangle. Of the two ways to cut the L-shape, the
    one with fewer rectangles is taken: at most 4, mostly 3.
    """
    whole_x, whole_y = (new[0], new[0] + side), (new[1], new[1] + side)
    if old is None:
        return _product(whole_x, whole_y, side)
    new_x, kept_x = exposed_interval(old[0], new[0], side)
    new_y, kept_y = exposed_interval(old[1], new[1], side)
    tall = _product(new_x, whole_y, side) + _product(kept_x, new_y, side)
    wide = _product(whole_x, new_y, side) + _product(new_x, kept_y, side)
    return tall if len(tall) <= len(wide) else wide
