"""Lattice geometry, against a reference that halves the image again and again until one block is left."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas.address import BlockAddress
from schemas.errors import NotFoundError, UsageError
from schemas.lattice import Lattice, support
from schemas.region import Rect

BLOCKS = [2**k for k in range(1, 13)]
PRIMES = [2, 3, 5, 7, 31, 127, 257, 1009, 8191, 65537, 104729, 2147483647]


@dataclass(frozen=True)
class ReferenceLevel:
    """One level as the reference has it."""

    size: tuple[int, int]
    blocks: tuple[int, int]


def multiples_needed(length: int, block: int) -> int:
    """Number of blocks that cover ``length`` samples."""
    quotient, remainder = divmod(length, block)
    return quotient + (1 if remainder else 0)


def halved(length: int) -> int:
    """Samples left when every second one is kept, the first included."""
    return length // 2 + length % 2


def reference_levels(width: int, height: int, block: int) -> list[ReferenceLevel]:
    """Levels from the finest to the first that fits one block."""
    levels = []
    while True:
        blocks = multiples_needed(width, block), multiples_needed(height, block)
        levels.append(ReferenceLevel((width, height), blocks))
        if blocks == (1, 1):
            return levels
        width, height = halved(width), halved(height)


def check(width: int, height: int, block: int) -> None:
    lattice = Lattice(width, height, block)
    reference = reference_levels(width, height, block)
    assert lattice.levels == len(reference)
    for number, level in enumerate(reference):
        assert lattice.level_size(number) == level.size
        assert lattice.block_counts(number) == level.blocks
        padded = lattice.padded_size(number)
        assert all(side % block == 0 and 0 <= side - length < block for side, length in zip(padded, level.size, strict=True))
        assert lattice.level_rect(number) == Rect(0, 0, *level.size)
    assert lattice.block_counts(lattice.levels - 1) == (1, 1)
    # The quadtree is wide enough for the finest level.
    assert max(reference[0].blocks) <= 2 ** (len(reference) - 1)


sizes = st.one_of(
    st.integers(1, 5000),
    st.integers(1, 2**45),
    st.builds(lambda power, change: max(1, 2**power + change), st.integers(0, 45), st.integers(-2, 2)),
    st.sampled_from(PRIMES),
)


@settings(max_examples=3000)
@given(sizes, sizes, st.sampled_from(BLOCKS))
@example(1, 1, 2)
@example(2, 100_000, 2)
@example(100_000, 2, 4096)
@example(2**31 + 1, 1, 256)
@example(2**45, 2**45, 2)
def test_sizes_against_repeated_halving(width: int, height: int, block: int) -> None:
    check(width, height, block)


@pytest.mark.parametrize("block", [2, 4, 8])
def test_every_small_size(block: int) -> None:
    for width in range(1, 70):
        for height in range(1, 70):
            check(width, height, block)


@pytest.mark.parametrize("block", BLOCKS)
def test_around_powers_of_two(block: int) -> None:
    for power in range(34):
        for width in (2**power - 1, 2**power, 2**power + 1):
            if width:
                check(width, 1, block)
                check(3, width, block)


@pytest.mark.parametrize(
    ("width", "height", "block", "levels"),
    [
        (256, 256, 256, 1),
        (257, 256, 256, 2),
        (512, 512, 256, 2),
        (513, 1, 256, 3),
        (1, 16385, 256, 8),
        (2**40, 1, 2, 40),
        (2**33, 9, 256, 26),
    ],
)
def test_level_counts_known_by_hand(width: int, height: int, block: int, levels: int) -> None:
    assert Lattice(width, height, block).levels == levels


def test_more_levels_than_bits_in_a_word() -> None:
    lattice = Lattice(2**70 + 1, 5, 2)
    assert lattice.levels == 71
    assert lattice.level_size(70) == (2, 1)
    assert lattice.core(BlockAddress(0, 2**69, 2)) == Rect(2**70, 4, 2**70 + 2, 6)


@settings(max_examples=60)
@given(st.integers(1, 90), st.integers(1, 90), st.sampled_from([2, 4, 8, 16]))
def test_cores_partition_every_level(width: int, height: int, block: int) -> None:
    lattice = Lattice(width, height, block)
    for level in range(lattice.levels):
        seen = Counter[tuple[int, int]]()
        for number, address in enumerate(lattice.addresses(level)):
            assert lattice.block_number(address) == number
            assert lattice.contains(address)
            assert lattice.check(address) is address
            valid = lattice.valid_core(address)
            assert valid, "a block without a sample does not exist"
            assert lattice.core(address).contains(valid)
            assert (lattice.core(address).width, lattice.core(address).height) == (block, block)
            seen.update((x, y) for x in range(valid.x0, valid.x1) for y in range(valid.y0, valid.y1))
        level_width, level_height = lattice.level_size(level)
        assert seen == Counter((x, y) for x in range(level_width) for y in range(level_height))


def test_blocks_come_in_row_order() -> None:
    lattice = Lattice(5, 3, 2)
    assert [(address.x, address.y) for address in lattice.addresses(0)] == [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)]


@settings(max_examples=300)
@given(sizes, sizes, st.sampled_from(BLOCKS), st.data())
def test_addresses_outside_are_refused(width: int, height: int, block: int, data: st.DataObject) -> None:
    lattice = Lattice(width, height, block)
    level = data.draw(st.integers(0, lattice.levels + 1))
    if level >= lattice.levels:
        address = BlockAddress(level, 0, 0)
        message = f"levels run from 0 to {lattice.levels - 1}"
    else:
        columns, rows = lattice.block_counts(level)
        x, y = data.draw(st.sampled_from([(columns, 0), (0, rows), (columns, rows), (columns + 2**40, rows - 1)]))
        address, message = BlockAddress(level, x, y), f"{columns} x {rows} blocks"
    assert not lattice.contains(address)
    with pytest.raises(NotFoundError, match=message):
        lattice.check(address)


@pytest.mark.parametrize("level", [-1, 3])
def test_levels_outside_are_refused(level: int) -> None:
    lattice = Lattice(1000, 900, 256)
    for geometry in (lattice.level_size, lattice.level_rect, lattice.block_counts, lattice.padded_size):
        with pytest.raises(NotFoundError, match="levels run from 0 to 2"):
            geometry(level)


@given(st.integers(-50, 50), st.integers(-50, 50), st.integers(1, 6), st.integers(1, 6), st.integers(0, 9), st.integers(0, 9))
def test_support_is_the_union_of_the_filters_reach(x: int, y: int, width: int, height: int, before: int, after: int) -> None:
    rect = support(Rect(x, y, x + width, y + height), (before, after))
    columns = {2 * i + offset for i in range(x, x + width) for offset in range(-before, after + 1)}
    rows = {2 * j + offset for j in range(y, y + height) for offset in range(-before, after + 1)}
    assert (rect.x0, rect.x1 - 1, rect.y0, rect.y1 - 1) == (min(columns), max(columns), min(rows), max(rows))


@given(st.sampled_from(BLOCKS), st.data())
def test_stored_side_holds_the_pad_twice(block: int, data: st.DataObject) -> None:
    pad = data.draw(st.integers(0, block // 2))
    assert Lattice(10, 10, block, "point", pad).stored_side == block + pad + pad


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1), "0 x 1 samples is empty"),
        ((1, -3), "1 x -3 samples is empty"),
        ((9, 9, 0), "power of two"),
        ((9, 9, 1), "power of two"),
        ((9, 9, 100), "power of two"),
        ((9, 9, -256), "power of two"),
        ((9, 9, 8192), "power of two from 2 to 4096"),
        ((9, 9, 256, "corner"), "registration 'corner'"),
        ((9, 9, 256, "area", -1), "pad -1"),
        ((9, 9, 256, "area", 129), "pad 129: must be between 0 and half the block side"),
    ],
)
def test_impossible_lattices_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Lattice(*arguments)
