"""How much memory a build takes at its peak, by what its plan says.

The model adds up the arrays that the threads of a build hold at the same time, each as large as the code makes it, to what a process
takes before it works, which was measured. tests/unit/test_memory.py holds it against real builds.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from schemas.blockindex import RECORD_BYTES
from schemas.region import Rect
from tiler.building.plan import Plan
from tiler.estimate.machine import PROCESS_BYTES, total_bytes
from tiler.filters.cascade import held_windows
from tiler.tasks.partition import Task, Tier
from tiler.tasks.worker import portion_rows

_PUSHED_ROWS: Final = 64 + 24
"""Rows that a level keeps for its filter: those pushed at once, and those under the taps."""
SPOOL_BYTES: Final = 64 << 20
"""A picture that must be decoded as a whole is kept in memory up to this size, else in a scratch file (``tiler.rowfile``)."""
_GDAL_SHARE: Final = 0.05
"""GDAL keeps decoded tiles in up to this share of the machine's memory; they were seen to take a third more than they count."""
_UNCACHED: Final = {"tiff", "openexr", "clipmap"}
"""Formats of which nothing that is decoded is kept: those that OpenImageIO reads, and heights of a dataset for light."""


def build_memory_bytes(plan: Plan, workers: int) -> int:
    """Return the expected largest resident set of a process that builds ``plan`` with ``workers`` threads [bytes]."""
    at_once = max(min(workers, _task_count(plan, tier)) * size for tier, size in zip(plan.tiers, _tier_bytes(plan), strict=True))
    return PROCESS_BYTES + _source_bytes(plan) + _ledger_bytes(plan) + at_once


def _task_count(plan: Plan, tier: Tier) -> int:
    columns = sum(1 for _ in plan.tasks(tier, Rect(0, 0, plan.lattice.width, 1)))
    rows = sum(1 for _ in plan.tasks(tier, Rect(0, 0, 1, plan.lattice.height)))
    return columns * rows


def task_windows(plan: Plan, task: Task) -> list[Rect]:
    """Return the samples that a task holds of every level of its tier, and of the level it hands on."""
    pads = [plan.lattice.pad] * task.tier.count + [0] * task.tier.carry
    return held_windows(plan.lattice.level_size(task.tier.first), task.core, pads, plan.recipe.kernel.reach)


def _tier_bytes(plan: Plan) -> Iterator[int]:
    """Yield what one thread holds of a task, per tier [bytes]."""
    for number, tier in enumerate(plan.tiers):
        row = list(plan.tasks(tier, Rect(0, 0, plan.lattice.width, 1)))
        widest = max(row, key=lambda task: task_windows(plan, task)[0].width)
        yield _task_bytes(plan, widest) + (_pieces_bytes(plan, widest, plan.tiers[number - 1]) if number else 0)


def _task_bytes(plan: Plan, task: Task) -> int:
    width = task_windows(plan, task)[0].width
    info, conversion, masked = plan.source.info, plan.source.conversion, plan.source.masked
    finest = task.tier.first == 0
    floats = 4 * (conversion.channels + masked)
    rows = portion_rows(width, conversion.channels, info.chunk_rows if finest else 1)
    decoded = 0
    if finest:
        columns = info.width if info.layout == "striped" else min(info.width, width + 1024)
        decoded = rows * columns * info.channels * info.dtype.itemsize
    samples = rows * width * floats
    # The rows of the finest level, once more while they are appended to, and those of all coarser ones, each half as wide.
    filtered = 3 * _PUSHED_ROWS * width * floats
    strips = 2 * (plan.lattice.stored_side + _PUSHED_ROWS) * width * (plan.block.channels * np.dtype(plan.block.dtype).itemsize + masked)
    piece = 2 * task.piece.area * floats if task.tier.carry else 0
    # What was read is converted and masked by array operations that make a copy each; enhancement reads ahead as well.
    copies = 3 + (finest and (plan.linear_light + 5 * (plan.enhance is not None)))
    return 2 * decoded + copies * samples + filtered + strips + piece


def _pieces_bytes(plan: Plan, task: Task, below: Tier) -> int:
    """Return what a task holds of the pieces it reads: two rows of them, each with a neighbour at both ends."""
    first = next(plan.tasks(below)).piece
    width = min(plan.lattice.level_size(task.tier.first)[0], task.core.width + 2 * first.width)
    return 2 * width * first.height * 4 * (plan.source.conversion.channels + plan.source.masked)


def _source_bytes(plan: Plan) -> int:
    """Return what the reader keeps for all threads: a picture decoded as a whole, if it is small, or GDAL's tiles."""
    info = plan.source.info
    decoded = info.width * info.height * info.channels * info.dtype.itemsize
    if info.layout == "sequential":
        return decoded if decoded <= SPOOL_BYTES else 0
    return 0 if info.format in _UNCACHED else int(1.3 * min(decoded, _GDAL_SHARE * total_bytes()))


def _ledger_bytes(plan: Plan) -> int:
    """Return what the block index of all levels takes, and the copy of a level that is written."""
    counts = [columns * rows for columns, rows in map(plan.lattice.block_counts, range(plan.lattice.levels))]
    return (sum(counts) + counts[0]) * RECORD_BYTES
