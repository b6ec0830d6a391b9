"""How a layer is cut into tasks: tiers of levels, each cut into windows that can be worked on in any order."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from schemas.lattice import Lattice
from schemas.region import Rect
from tiler.sources import Layout

_BAND: Final = 32768
_SIDE: Final = 4096
_LEAST_SIDE: Final = 2048
_LARGEST_SIDE: Final = 16384
"""Sides of tasks [level-0 samples]. With blocks of 256, of every sample 1/256 or (2048) 1/64 is handed on as float32.

What lies around a task is filtered and, in whole tiles, read once more: of tiles of 512 a task of 4096 reads 1.56 times its samples, one
of 2048 2.25 times. One of 8192 reads 1.27 times, which makes a build to JPEG 4 % faster, with a quarter more memory.
"""
_TASKS_PER_WORKER: Final = 2
"""With fewer tasks for every worker the last of them leaves the others idle for too long; more of them read and filter more halo."""


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

    def blocks(self, side: int) -> Iterator[tuple[int, Rect]]:
        """Yield, per level that the task makes, the rectangle of its blocks of ``side`` samples (columns and rows of blocks)."""
        for step in range(self.tier.count):
            core = self.core.coarsened(step)
            yield self.tier.first + step, Rect(core.x0 // side, core.y0 // side, -(-core.x1 // side), -(-core.y1 // side))

    @property
    def piece(self) -> Rect:
        """The samples of the level above the tier that the task hands on."""
        return self.core.coarsened(self.tier.count)


def choose_task_side(lattice: Lattice, workers: int) -> int:
    """Return the side of a task [level-0 samples] that keeps ``workers`` busy and hands on as little as possible.

    Large blocks need large tasks: a task of four blocks hands on 1/4 of its samples, one of 64 blocks 1/64.
    """
    side = max(_SIDE, min(8 * lattice.block, _LARGEST_SIDE))
    least = max(_LEAST_SIDE, 2 * lattice.block)
    while side > least and -(-lattice.width // side) * -(-lattice.height // side) < _TASKS_PER_WORKER * workers:
        side //= 2
    return side


def plan_tiers(lattice: Lattice, task_side: int) -> list[Tier]:
    """Return the tiers of a pyramid: a task of ``block * 2**k`` samples a side makes k levels, at least one."""
    count = max(1, (task_side // lattice.block).bit_length() - 1)
    return [Tier(first, min(count, lattice.levels - first), first + count < lattice.levels) for first in range(0, lattice.levels, count)]


def _step(lattice: Lattice, tier: Tier, layout: Layout) -> tuple[int, int]:
    """Return the width and height of a task's core."""
    side = lattice.block << tier.count
    return max(side, _BAND // side * side) if layout == "striped" and tier.first == 0 else side, side


def plan_tasks(lattice: Lattice, tier: Tier, layout: Layout, within: Rect | None = None) -> Iterator[Task]:
    """Yield the tasks of a tier in row order: squares, or bands where the source's strips are decoded over their full width.

    A band is at most 32768 samples wide, so that memory stays bounded; wider strips are decoded once per band. ``within`` leaves
    out the tasks whose cores do not meet these samples of the tier's first level.
    """
    step_x, step_y = _step(lattice, tier, layout)
    whole = lattice.level_rect(tier.first)
    wanted = whole if within is None else within & whole
    for y in range(wanted.y0 // step_y * step_y, wanted.y1, step_y):
        for x in range(wanted.x0 // step_x * step_x, wanted.x1, step_x):
            yield Task(tier, Rect(x, y, x + step_x, y + step_y) & whole)


def count_tasks(lattice: Lattice, tiers: Iterable[Tier], layout: Layout) -> int:
    """Return the number of tasks of all tiers."""
    total = 0
    for tier in tiers:
        (width, height), (step_x, step_y) = lattice.level_size(tier.first), _step(lattice, tier, layout)
        total += -(-width // step_x) * -(-height // step_y)
    return total


def plan_block_task(lattice: Lattice, tiers: tuple[Tier, ...], layout: Layout, level: int, core: Rect) -> Task:
    """Return the task that makes the block of ``level`` whose core is ``core``."""
    tier = next(tier for tier in tiers if tier.first <= level < tier.first + tier.count)
    shift = level - tier.first
    corner = Rect(core.x0 << shift, core.y0 << shift, (core.x0 << shift) + 1, (core.y0 << shift) + 1)
    return next(plan_tasks(lattice, tier, layout, corner))
