import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from schemas.region import Rect
from viewer.torus import arcs, update_rects

Point = tuple[int, int]


def cells(origin: Point, side: int) -> set[Point]:
    return {(x, y) for x in range(origin[0], origin[0] + side) for y in range(origin[1], origin[1] + side)}


origins = st.tuples(st.integers(-60, 60), st.integers(-60, 60))
sides = st.sampled_from([1, 2, 4, 5, 8, 16])


@given(old=origins, shift=st.tuples(st.integers(-18, 18), st.integers(-18, 18)), side=sides)
@example(old=(0, 0), shift=(0, 0), side=8)
@example(old=(-3, 5), shift=(8, -8), side=8)
@example(old=(-1, -1), shift=(1, 1), side=16)
def test_every_exposed_sample_is_written_once_to_its_own_slot(old: Point, shift: Point, side: int) -> None:
    new = old[0] + shift[0], old[1] + shift[1]
    rects = update_rects(old, new, side)
    assert len(rects) <= 4
    written: list[tuple[Point, Point]] = []
    for rect in rects:
        x, y, width, height = rect.slots
        assert 0 <= x < x + width <= side
        assert 0 <= y < y + height <= side
        source = rect.source
        assert (source.width, source.height) == (width, height)
        samples = np.stack(np.meshgrid(np.arange(source.x0, source.x1), np.arange(source.y0, source.y1)), axis=-1)
        placed = rect.arrange(samples)
        assert placed.flags.c_contiguous
        written += [(tuple(placed[j, i].tolist()), (x + i, y + j)) for j in range(height) for i in range(width)]
    assert [slot for _, slot in written] == [(i % side, j % side) for (i, j), _ in written]
    samples_written = [sample for sample, _ in written]
    assert len(samples_written) == len(set(samples_written))
    assert set(samples_written) == cells(new, side) - cells(old, side)


@given(old=origins, shift=st.tuples(st.integers(-18, 18), st.integers(-18, 18)), side=sides)
def test_the_number_of_samples_is_that_of_the_formula(old: Point, shift: Point, side: int) -> None:
    dx, dy = min(side, abs(shift[0])), min(side, abs(shift[1]))
    written = sum(rect.source.area for rect in update_rects(old, (old[0] + shift[0], old[1] + shift[1]), side))
    assert written == side * dx + side * dy - dx * dy


@given(new=origins, side=sides)
def test_the_first_window_is_one_rectangle(new: Point, side: int) -> None:
    (rect,) = update_rects(None, new, side)
    assert rect.source == Rect(*new, new[0] + side, new[1] + side)
    assert rect.slots == (0, 0, side, side)


def test_no_samples_make_no_arcs() -> None:
    assert arcs(3, 3, 8) == ()
    assert [(arc.slot, arc.length) for arc in arcs(6, 11, 8)] == [(6, 2), (0, 3)]
