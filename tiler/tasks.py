"""How a layer is cut into tasks: tiers of levels, each cut into windows that can be worked on in any order."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from schemas.lattice import Lattice
from schemas.region import Rect
from tiler.sources import Layout

_BAND: Final = 32768


@dataclass(frozen=True, slots=True)
class Tier:
    """Levels made in one go from the samples of the first of them; ``carry``: the level above is kept for the next tier."""

    first: int
    count: int
    carry: bool


@dataclass(frozen=True, slots=True)
class Task:
    """One window of a tier: ``core`` are the samples of the tier's first level whose blocks, and theirs above, it makes."""

    tier: Tier
    core: Rect


def plan_tiers(lattice: Lattice, task_side: int) -> list[Tier]:
    """Return the tiers of a pyramid: a task of ``block * 2**k`` samples a side makes k levels, at least one."""
    count = max(1, (task_side // lattice.block).bit_length() - 1)
    return [Tier(first, min(count, lattice.levels - first), first + count < lattice.levels) for first in range(0, lattice.levels, count)]


def plan_tasks(lattice: Lattice, tier: Tier, layout: Layout) -> Iterator[Task]:
    """Yield the tasks of a tier in row order: squares, or bands where the source's strips are decoded over their full width.

    A band is at most 32768 samples wide, so that memory stays bounded; wider strips are decoded once per band.
    """
    side = lattice.block << tier.count
    width, height = lattice.level_size(tier.first)
    step = max(side, _BAND // side * side) if layout == "striped" and tier.first == 0 else side
    for y in range(0, height, side):
        for x in range(0, width, step):
            yield Task(tier, Rect(x, y, min(x + step, width), min(y + side, height)))
