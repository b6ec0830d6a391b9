"""Tiers and tasks: every level is made once, and every sample of a tier's first level belongs to one task."""

from math import ceil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.address import BlockAddress
from schemas.lattice import Lattice
from schemas.region import Rect
from tiler.sources import Layout
from tiler.tasks.partition import choose_task_side, count_tasks, plan_block_task, plan_tasks, plan_tiers

SIZES = st.integers(1, 3000)
LAYOUTS: tuple[Layout, ...] = ("tiled", "striped")


@given(width=SIZES, height=SIZES, block=st.sampled_from([2, 16, 64, 256]), task=st.integers(2, 5000))
def test_every_level_belongs_to_one_tier(width: int, height: int, block: int, task: int) -> None:
    lattice = Lattice(width, height, block)
    tiers = plan_tiers(lattice, task)
    assert [level for tier in tiers for level in range(tier.first, tier.first + tier.count)] == list(range(lattice.levels))
    assert [tier.carry for tier in tiers] == [True] * (len(tiers) - 1) + [False]
    assert all(tier.count >= 1 for tier in tiers)
    assert all(block << tier.count <= max(task, 2 * block) for tier in tiers)


@given(
    width=st.integers(1, 400),
    height=st.integers(1, 400),
    block=st.sampled_from([2, 4, 16]),
    task=st.integers(2, 200),
    layout=st.sampled_from(["tiled", "striped", "sequential"]),
)
def test_every_sample_belongs_to_one_task_of_its_tier(width: int, height: int, block: int, task: int, layout: Layout) -> None:
    lattice = Lattice(width, height, block)
    for tier in plan_tiers(lattice, task):
        columns, rows = lattice.level_size(tier.first)
        count = np.zeros((rows, columns), int)
        for each in plan_tasks(lattice, tier, layout):
            assert each.tier == tier
            assert each.core
            count[each.core.y0 : each.core.y1, each.core.x0 : each.core.x1] += 1
        assert (count == 1).all()


@given(
    width=SIZES, height=SIZES, block=st.sampled_from([16, 64, 256]), task=st.integers(2, 3000), layout=st.sampled_from(["tiled", "striped"])
)
def test_every_block_belongs_to_one_task(width: int, height: int, block: int, task: int, layout: Layout) -> None:
    """A task's core, brought up level by level, ends on edges of blocks, so no two tasks write the same block."""
    lattice = Lattice(width, height, block)
    for tier in plan_tiers(lattice, task):
        tasks = list(plan_tasks(lattice, tier, layout))
        for step in range(tier.count):
            side = block << step
            made = [
                (x, y)
                for each in tasks
                for y in range(each.core.y0 // side, ceil(each.core.y1 / side))
                for x in range(each.core.x0 // side, ceil(each.core.x1 / side))
            ]
            columns, rows = lattice.block_counts(tier.first + step)
            assert sorted(made) == [(x, y) for x in range(columns) for y in range(rows)]


def test_striped_sources_are_read_in_full_rows_but_only_once() -> None:
    lattice = Lattice(5000, 3000, 256)
    first, second = plan_tiers(lattice, 1024)[:2]
    assert {(task.core.x0, task.core.x1) for task in plan_tasks(lattice, first, "striped")} == {(0, 5000)}
    assert {(task.core.width, task.core.height) for task in plan_tasks(lattice, second, "striped")} <= {(1024, 750), (226, 750)}
    assert {task.core.width for task in plan_tasks(lattice, first, "tiled")} == {1024, 5000 % 1024}


def test_tasks_come_in_row_order() -> None:
    lattice = Lattice(3000, 3000, 256)
    corners = [(task.core.y0, task.core.x0) for task in plan_tasks(lattice, plan_tiers(lattice, 512)[0], "tiled")]
    assert corners == sorted(corners)
    assert len(corners) == 36


@pytest.mark.parametrize(
    ("task", "counts"), [(2, [1] * 5), (256, [1] * 5), (512, [1] * 5), (1024, [2, 2, 1]), (2048, [3, 2]), (1 << 40, [5])]
)
def test_levels_per_tier(task: int, counts: list[int]) -> None:
    """A task of 256 * 2**k samples a side makes k levels of blocks of 256, at least one."""
    assert [tier.count for tier in plan_tiers(Lattice(4096, 100, 256), task)] == counts


@pytest.mark.parametrize(
    ("size", "block", "workers", "side"),
    [
        ((100_000, 100_000), 256, 2, 4096),
        ((16384, 16384), 256, 2, 4096),
        ((16384, 16384), 256, 8, 4096),
        ((16384, 16384), 256, 9, 2048),
        ((8192, 8192), 256, 2, 4096),
        ((100, 100), 256, 64, 2048),
        ((100_000, 100_000), 1024, 2, 8192),
        ((100_000, 100_000), 2048, 2, 16384),
        ((8192, 8192), 1024, 2, 4096),
        ((1 << 25, 1 << 25), 4096, 1000, 16384),
        ((8192, 8192), 4096, 4, 8192),
    ],
)
def test_tasks_are_large_where_there_are_enough_of_them(size: tuple[int, int], block: int, workers: int, side: int) -> None:
    assert choose_task_side(Lattice(*size, block), workers) == side


@given(
    size=st.tuples(SIZES, SIZES), side=st.sampled_from([64, 128, 300]), level=st.integers(0, 9), x=st.integers(0, 40), y=st.integers(0, 40)
)
def test_every_block_has_the_task_that_makes_it(size: tuple[int, int], side: int, level: int, x: int, y: int) -> None:
    lattice = Lattice(*size, 32)
    level %= lattice.levels
    columns, rows = lattice.block_counts(level)
    address = BlockAddress(level, x % columns, y % rows)
    tiers = tuple(plan_tiers(lattice, side))
    for layout in LAYOUTS:
        task = plan_block_task(lattice, tiers, layout, level, lattice.core(address))
        made = dict(task.blocks(lattice.block))[level]
        assert made.contains(Rect(address.x, address.y, address.x + 1, address.y + 1))
        assert count_tasks(lattice, tiers, layout) == sum(len(list(plan_tasks(lattice, tier, layout))) for tier in tiers)
