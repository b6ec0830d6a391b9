"""Heights between heights: exact for cubics, against a slow float64 reference, and independent of how the grid is cut or turned."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.reference import midpoints
from tests.reference.terrain import power_law_field
from tiler.light.sweeping import Float32
from tiler.light.upsample import Refiner

Line = NDArray[np.float64]


def refined(heights: NDArray[np.float32], ends: list[int] | None = None, columns: int = 1024) -> Float32:
    """Push ``heights`` in strips that end at ``ends``, refined ``columns`` at a time."""
    height, width = heights.shape

    def run(work: Callable[[int, int], None]) -> None:
        for start in range(0, width, columns):
            work(start, min(start + columns, width))

    refiner, parts, row = Refiner(height, width), [], 0
    for start, stop in pairwise([0, *(ends or []), height]):
        first, rows = refiner.push(heights[start:stop], run)
        assert first == row
        row += len(rows)
        parts.append(rows)
    return np.concatenate(parts)


def rough(height: int, width: int, voids: float = 0.0, seed: int = 0) -> NDArray[np.float32]:
    field = np.asarray(500 * power_law_field(max(height, 8), max(width, 8), seed, 3.0)[:height, :width] + 1000, np.float32)
    field[np.random.default_rng(seed).random(field.shape) < voids] = np.nan
    return field


@pytest.mark.parametrize("voids", [0.0, 0.02, 0.3, 0.8])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 2), (23, 31)])
def test_midpoints_are_those_of_the_rule(size: tuple[int, int], voids: float) -> None:
    heights = rough(*size, voids)
    found = refined(heights)
    assert found.dtype == np.float32
    assert found.shape == (2 * size[0] - 1, 2 * size[1] - 1)
    np.testing.assert_array_equal(found[::2, ::2], heights, "the heights themselves must stay")
    np.testing.assert_allclose(found, midpoints.refined(heights.astype(np.float64)), rtol=1e-7)


def test_cubics_are_exact_away_from_the_edge_and_planes_everywhere() -> None:
    """Whole numbers, so that nothing is rounded."""
    x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))

    def cubic(x: Line, y: Line) -> Line:
        return np.asarray((x - 20) ** 3 - 3 * (x - 7) ** 2 * (y - 11) + x * y + 2 * (y - 15) ** 3 + 8848, np.float64)

    fine_x, fine_y = np.meshgrid(np.arange(79) / 2, np.arange(59) / 2)
    found = refined(cubic(x, y).astype(np.float32))
    np.testing.assert_array_equal(found[2:-2, 2:-2], cubic(fine_x, fine_y)[2:-2, 2:-2])
    plane = refined((16 * x - 48 * y + 10_000_000).astype(np.float32))
    np.testing.assert_array_equal(plane, 16 * fine_x - 48 * fine_y + 10_000_000)


def test_voids_do_not_grow_by_a_height_and_nothing_is_invented_in_them() -> None:
    heights = rough(20, 20, seed=2)
    heights[7, 9] = np.nan
    void = np.isnan(refined(heights))
    assert void[13:16, 17:20].all()
    assert void.sum() == 9, "the sample and the eight midpoints around it, half a step away"


def test_one_sided_slopes_beside_a_void_are_those_of_a_ramp() -> None:
    """Where only two heights are left side by side, their midpoint is the mean: the slope of light there stays what it was."""
    heights = np.full((5, 6), np.nan, np.float32)
    heights[2, 2:4] = 100, 108
    assert refined(heights)[4, 4:7].tolist() == [100, 104, 108]


@given(ends=st.lists(st.integers(1, 32), unique=True).map(sorted), columns=st.integers(1, 40), voids=st.sampled_from([0.0, 0.1]))
def test_nothing_depends_on_strips_and_parts(ends: list[int], columns: int, voids: float) -> None:
    heights = rough(33, 37, voids, seed=4)
    assert refined(heights, ends, columns).tobytes() == refined(heights).tobytes()


@pytest.mark.parametrize("voids", [0.0, 0.1])
@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_or_mirrored_grid_has_the_turned_or_mirrored_midpoints(turns: int, voids: float) -> None:
    """Bit for bit, or light would depend on how a grid lies. Heights of different sizes, so that sums are rounded."""
    heights = rough(31, 24, voids, seed=7) * np.float32(np.pi)
    heights[::3] *= np.float32(1e-4)
    found = refined(heights)
    np.testing.assert_array_equal(np.rot90(refined(np.ascontiguousarray(np.rot90(heights, turns))), -turns), found)
    np.testing.assert_array_equal(refined(np.ascontiguousarray(heights[:, ::-1]))[:, ::-1], found)
