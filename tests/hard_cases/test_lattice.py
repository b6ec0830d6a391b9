"""Hard cases of integer geometry: sizes, levels, windows that move on a torus."""

import itertools
import random

import pytest

from schemas.address import BlockAddress, address_of, quadcode
from schemas.blockindex import RECORD_BYTES
from schemas.lattice import Lattice
from schemas.region import ClipRegion, Rect, update_region
from viewer.torus import arcs


@pytest.mark.parametrize("size", [2**n + d for n in range(1, 13) for d in (-1, 0, 1)] + [3, 5, 7, 97, 101, 997, 7919])
def test_c26_sizes_about_powers_of_two_and_primes(size: int) -> None:
    """Level count is 1 + ceil(log2(size / block)), found here by halving; extents are exact: no sample lost or made up."""
    lattice = Lattice(size, 1, 16)
    levels, width = 1, size
    while width > 16:
        width = (width + 1) // 2
        levels += 1
    assert lattice.levels == levels
    for level in range(levels):
        width, height = lattice.level_size(level)
        assert (width - 1) * 2**level < size <= width * 2**level
        assert height == 1


def test_c27_more_than_31_levels() -> None:
    """2**40 samples in blocks of 2 have 40 levels; shifts and codes stay exact far beyond 32 bits."""
    lattice = Lattice(2**40, 3, 2)
    assert lattice.levels == 40
    last = BlockAddress(0, 2**39 - 1, 1)
    assert lattice.contains(last)
    assert lattice.block_number(last) == 2 * 2**39 - 1
    assert address_of(quadcode(last, 40), 40) == last
    assert lattice.level_size(39) == (2, 1)


def test_c28_block_numbers_beyond_32_bits() -> None:
    """70000 x 70000 in blocks of 2: number and place in the index of the last block are beyond 2**32."""
    lattice = Lattice(70_000, 70_000, 2)
    number = lattice.block_number(BlockAddress(0, 34_999, 34_999))
    assert number == 35_000 * 35_000 - 1
    assert number * RECORD_BYTES > 2**32


@pytest.mark.parametrize("origin", [-1, -5, -256, -257, -(2**31), -(2**31) - 1, 2**40 + 3])
def test_c29_negative_places_on_the_torus(origin: int) -> None:
    """-1 mod 5 is 4, not -1: every place of a window lands in its own slot, below zero and beyond 31 bits."""
    slots = [slot for arc in arcs(origin, origin + 5, 256) for slot in range(arc.slot, arc.slot + arc.length)]
    assert slots == [(origin + index) % 256 for index in range(5)]


def test_c30_a_move_by_more_than_the_window_refills_it() -> None:
    """Nothing is kept, nothing twice."""
    old = ClipRegion(3, -10, 4, 16)
    for dx, dy in ((16, 0), (0, -16), (17, 3), (-40, 40)):
        new = ClipRegion(3, old.x + dx, old.y + dy, 16)
        rects = update_region(old, new)
        assert sum(rect.area for rect in rects) == 256
        assert len({(x, y) for r in rects for x in range(r.x0, r.x1) for y in range(r.y0, r.y1)}) == 256


def test_c31_area_of_the_update_region() -> None:
    """n^2 - (n - |dx|)(n - |dy|) for every move inside the window."""
    for dx, dy in itertools.product(range(-8, 9), repeat=2):
        rects = update_region(ClipRegion(0, 100, -50, 8), ClipRegion(0, 100 + dx, -50 + dy, 8))
        assert sum(rect.area for rect in rects) == 64 - (8 - min(8, abs(dx))) * (8 - min(8, abs(dy)))


def test_c31_update_rectangles_do_not_overlap() -> None:
    chance = random.Random(31)
    for _ in range(300):
        old = ClipRegion(0, chance.randint(-50, 50), chance.randint(-50, 50), 12)
        new = ClipRegion(0, old.x + chance.randint(-14, 14), old.y + chance.randint(-14, 14), 12)
        for first, second in itertools.combinations(update_region(old, new), 2):
            assert not first & second
        assert all(Rect(new.x, new.y, new.x + 12, new.y + 12).contains(rect) for rect in update_region(old, new))
