"""Pieces put together give the level that they were cut from, for any window, with each piece loaded once."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.lattice import Lattice
from schemas.manifest import digest
from schemas.region import Rect
from tiler.tasks.partition import Task, plan_tasks, plan_tiers
from tiler.tasks.pieces import PieceReader, PieceRef, PieceWriter


@given(
    size=st.tuples(st.integers(1, 150), st.integers(1, 150)),
    channels=st.integers(1, 4),
    masked=st.booleans(),
    portion=st.integers(1, 40),
    corners=st.tuples(*[st.floats(0, 1)] * 4),
)
def test_any_window_is_that_of_the_level(
    size: tuple[int, int], channels: int, masked: bool, portion: int, corners: tuple[float, float, float, float]
) -> None:
    lattice = Lattice(*size, 8)
    tier = plan_tiers(lattice, 32)[0]
    width, height = lattice.level_size(tier.count) if tier.carry else (1, 1)
    if not tier.carry:
        return
    random = np.random.default_rng(1)
    level = random.standard_normal((height, width, channels)).astype(np.float32)
    coverage = random.random((height, width)).astype(np.float32) if masked else None
    stored: dict[Task, bytes] = {}
    for task in plan_tasks(lattice, tier, "tiled"):
        writer = PieceWriter(task, channels, masked)
        held = task.piece.grown(3) & Rect(0, 0, width, height)
        for y in range(held.y0, held.y1, portion):
            rows = np.s_[y : min(y + portion, held.y1), held.x0 : held.x1]
            writer.take(y, level[rows], None if coverage is None else coverage[rows], held.x0)
        stored[task] = writer.data()
    x0, x1 = sorted(int(corner * (width - 1)) for corner in corners[:2])
    y0, y1 = sorted(int(corner * (height - 1)) for corner in corners[2:])
    loads: Counter[Task] = Counter()

    def load(pieces: Sequence[PieceRef]) -> list[bytes]:
        loads.update(piece.task for piece in pieces)
        return [stored[piece.task] for piece in pieces]

    reader = PieceReader([PieceRef(task, digest(data)) for task, data in stored.items()], load, channels, masked)
    for y in range(y0, y1 + 1, portion):
        window = Rect(x0, y, x1 + 1, min(y + portion, y1 + 1))
        values, covered = reader.read_lean(window)
        assert (values == level[window.y0 : window.y1, window.x0 : window.x1]).all()
        expected = None if coverage is None else coverage[window.y0 : window.y1, window.x0 : window.x1]
        if expected is None or covered is None:
            assert covered is None
            assert expected is None or (expected == 1).all()
        else:
            assert (covered == expected).all()
    assert set(loads.values()) <= {1}
    assert all(task.piece & Rect(x0, y0, x1 + 1, y1 + 1) for task in loads)


def test_a_piece_is_little_endian_float32_in_row_order() -> None:
    task = next(plan_tasks(Lattice(64, 64, 8), plan_tiers(Lattice(64, 64, 8), 32)[0], "tiled"))
    writer = PieceWriter(task, 1, masked=True)
    values = np.arange(64, dtype=np.float32).reshape(8, 8, 1)
    writer.take(0, values, np.ones((8, 8), np.float32), 0)
    assert writer.data() == np.stack([values[..., 0], np.ones((8, 8))], axis=-1).astype("<f4").tobytes()


@pytest.mark.parametrize("left", [-20, 30])
def test_rows_beside_the_piece_are_dropped(left: int) -> None:
    task = next(plan_tasks(Lattice(64, 64, 8), plan_tiers(Lattice(64, 64, 8), 32)[0], "tiled"))
    writer = PieceWriter(task, 1, masked=False)
    writer.take(0, np.ones((8, 8, 1), np.float32), None, 0)
    before = writer.data()
    writer.take(0, np.zeros((8, 8, 1), np.float32), None, left)
    assert writer.data() == before
