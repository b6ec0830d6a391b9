"""Rectangles, clip regions and update regions, against sets of samples counted one by one."""

from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas.address import BlockAddress
from schemas.errors import UsageError
from schemas.region import ClipRegion, Rect, blocks_in, exposed_interval, update_region

Samples = set[tuple[int, int]]
coordinates = st.integers(-12, 12)
rects = st.builds(Rect, coordinates, coordinates, coordinates, coordinates)


def samples_of(rect: Rect) -> Samples:
    return {(x, y) for x in range(rect.x0, rect.x1) for y in range(rect.y0, rect.y1)}


@settings(max_examples=500)
@given(rects, rects)
def test_rectangles_behave_like_sets(a: Rect, b: Rect) -> None:
    set_a, set_b = samples_of(a), samples_of(b)
    assert samples_of(a & b) == set_a & set_b
    assert samples_of(b & a) == set_a & set_b
    assert a.contains(b) == (set_b <= set_a)
    assert bool(a) == bool(set_a)
    assert a.area == len(set_a)
    if a:
        assert (a.width, a.height) == (len({x for x, _ in set_a}), len({y for _, y in set_a}))


@given(rects, st.integers(-9, 9), st.integers(-9, 9))
def test_shifting_moves_every_sample(rect: Rect, dx: int, dy: int) -> None:
    assert samples_of(rect.shifted(dx, dy)) == {(x + dx, y + dy) for x, y in samples_of(rect)}


@given(rects.filter(bool), st.integers(0, 4))
def test_growing_adds_what_lies_within_the_margin(rect: Rect, margin: int) -> None:
    near = {(x + i, y + j) for x, y in samples_of(rect) for i in range(-margin, margin + 1) for j in range(-margin, margin + 1)}
    assert samples_of(rect.grown(margin)) == near
    assert rect.grown(margin).grown(-margin) == rect


def test_rectangles_are_values() -> None:
    assert Rect(1, 2, 3, 4) == Rect(1, 2, 3, 4)
    assert len({Rect(1, 2, 3, 4), Rect(1, 2, 3, 4)}) == 1


@settings(max_examples=500)
@given(st.integers(1, 9), coordinates, coordinates, st.integers(-14, 14), st.integers(-14, 14))
@example(5, -3, -3, 5, 0)
@example(5, -3, -3, 4, -4)
@example(5, 0, 0, 0, 0)
def test_update_region_is_the_set_difference(side: int, x: int, y: int, dx: int, dy: int) -> None:
    old, new = ClipRegion(2, x, y, side), ClipRegion(2, x + dx, y + dy, side)
    parts = update_region(old, new)
    assert len(parts) <= 2
    assert all(parts), "no empty part"
    covered = [sample for part in parts for sample in samples_of(part)]
    assert len(covered) == len(set(covered)), "parts overlap"
    assert set(covered) == samples_of(new.rect) - samples_of(old.rect)
    kept = max(0, side - abs(dx)) * max(0, side - abs(dy))
    assert sum(part.area for part in parts) == side * side - kept


@pytest.mark.parametrize("old", [None, ClipRegion(1, 0, 0, 8), ClipRegion(2, 0, 0, 4)])
def test_without_a_comparable_old_region_all_is_new(old: ClipRegion | None) -> None:
    new = ClipRegion(2, -3, 5, 8)
    assert update_region(old, new) == (new.rect,)


@given(coordinates, coordinates, st.integers(1, 9))
def test_exposed_and_kept_intervals(old: int, new: int, size: int) -> None:
    exposed, kept = (set(range(*interval)) for interval in exposed_interval(old, new, size))
    before, after = set(range(old, old + size)), set(range(new, new + size))
    assert exposed == after - before
    assert kept == after & before


@settings(max_examples=500)
@given(st.builds(Rect, *[st.integers(-40, 80)] * 4), st.sampled_from([1, 2, 4, 16]))
def test_blocks_in_a_rectangle(rect: Rect, block: int) -> None:
    met = {(y // block, x // block) for x, y in samples_of(rect)}
    expected = [BlockAddress(3, x, y) for y, x in sorted(met) if x >= 0 and y >= 0]
    assert list(blocks_in(rect, 3, block)) == expected


@pytest.mark.parametrize("arguments", [(0, 0, 0, 0), (0, 0, 0, -4), (-1, 0, 0, 4)])
def test_impossible_clip_regions_are_refused(arguments: Any) -> None:
    with pytest.raises(UsageError, match="the side must be positive"):
        ClipRegion(*arguments)


@given(st.integers(-60, 60), st.integers(-60, 60), st.integers(1, 40), st.integers(1, 40), st.integers(0, 5))
def test_coarsened_covers_the_same_ground(x: int, y: int, width: int, height: int, levels: int) -> None:
    rect = Rect(x, y, x + width, y + height).coarsened(levels)
    columns, rows = ({place // 2**levels for place in range(start, start + size)} for start, size in ((x, width), (y, height)))
    assert (rect.x0, rect.x1 - 1, rect.y0, rect.y1 - 1) == (min(columns), max(columns), min(rows), max(rows))
