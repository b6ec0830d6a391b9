"""Half-open rectangles on the integer lattice, clip regions, and the update region between two clip regions."""

from collections.abc import Iterator
from dataclasses import dataclass

from schemas.address import BlockAddress
from schemas.errors import UsageError


@dataclass(frozen=True, order=True, slots=True)
class Rect:
    """A half-open rectangle ``[x0, x1) x [y0, y1)``; empty if either side is; coordinates may be negative."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Number of columns, 0 if empty."""
        return max(0, self.x1 - self.x0)

    @property
    def height(self) -> int:
        """Number of rows, 0 if empty."""
        return max(0, self.y1 - self.y0)

    @property
    def area(self) -> int:
        """Number of samples."""
        return self.width * self.height

    def __bool__(self) -> bool:
        return self.x1 > self.x0 and self.y1 > self.y0

    def __and__(self, other: "Rect") -> "Rect":
        return Rect(max(self.x0, other.x0), max(self.y0, other.y0), min(self.x1, other.x1), min(self.y1, other.y1))

    def contains(self, other: "Rect") -> bool:
        """Whether every sample of ``other`` is also in this rectangle; an empty ``other`` always is."""
        if not other:
            return True
        return self.x0 <= other.x0 and self.y0 <= other.y0 and other.x1 <= self.x1 and other.y1 <= self.y1

    def shifted(self, dx: int, dy: int) -> "Rect":
        """The same rectangle moved by ``(dx, dy)``."""
        return Rect(self.x0 + dx, self.y0 + dy, self.x1 + dx, self.y1 + dy)

    def coarsened(self, levels: int) -> "Rect":
        """The samples that stand for this rectangle ``levels`` levels coarser; the upper ends are rounded up."""
        return Rect(self.x0 >> levels, self.y0 >> levels, -(-self.x1 >> levels), -(-self.y1 >> levels))

    def grown(self, margin: int) -> "Rect":
        """The rectangle with ``margin`` samples added on each side (removed, if negative)."""
        return Rect(self.x0 - margin, self.y0 - margin, self.x1 + margin, self.y1 + margin)


@dataclass(frozen=True, slots=True)
class ClipRegion:
    """The square of ``side`` by ``side`` samples of one level that a client holds; (x, y) is its top-left sample."""

    level: int
    x: int
    y: int
    side: int

    def __post_init__(self) -> None:
        if self.side <= 0 or self.level < 0:
            raise UsageError(f"clip region of side {self.side} on level {self.level}: the side must be positive, the level not negative")

    @property
    def rect(self) -> Rect:
        """The samples of the region."""
        return Rect(self.x, self.y, self.x + self.side, self.y + self.side)


def exposed_interval(old: int, new: int, size: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the (exposed, kept) half-open intervals when a window of ``size`` moves from ``old`` to ``new`` on an axis."""
    shift = new - old
    if abs(shift) >= size:
        return (new, new + size), (new, new)
    if shift > 0:
        return (old + size, new + size), (new, old + size)
    return (new, old), (old, new + size)


def update_region(old: ClipRegion | None, new: ClipRegion) -> tuple[Rect, ...]:
    """Return the samples of ``new`` that are not in ``old`` as at most two disjoint rectangles.

    This is the L-shaped update region of Losasso & Hoppe 2004, section 6.1: a full-height strip of new columns, then a
    strip of new rows over the kept columns. All of ``new`` if there is no ``old`` or it lies on another level or has
    another side.
    """
    if old is None or (old.level, old.side) != (new.level, new.side):
        return (new.rect,)
    new_x, kept_x = exposed_interval(old.x, new.x, new.side)
    new_y, _ = exposed_interval(old.y, new.y, new.side)
    columns = Rect(new_x[0], new.y, new_x[1], new.y + new.side)
    rows = Rect(kept_x[0], new_y[0], kept_x[1], new_y[1])
    return tuple(rect for rect in (columns, rows) if rect)


def blocks_in(rect: Rect, level: int, block: int) -> Iterator[BlockAddress]:
    """Yield the addresses, in row order, of the blocks of side ``block`` that meet ``rect``; negative ones are left out."""
    if not rect:
        return
    for y in range(max(0, rect.y0 // block), -(-rect.y1 // block)):
        for x in range(max(0, rect.x0 // block), -(-rect.x1 // block)):
            yield BlockAddress(level, x, y)
