import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas.errors import UsageError
from viewer.placement import GRID_SIDES, TEXTURE_OVERHANG, check_grid, grid_origin, texture_origin

grids = st.sampled_from(GRID_SIDES)
levels = st.integers(0, 20)
viewers = st.floats(-1e9, 1e9, allow_nan=False)


@given(viewer=viewers, n=grids, level=levels)
def test_a_grid_is_even_and_centred_within_one_sample(viewer: float, n: int, level: int) -> None:
    origin = grid_origin(viewer, n, level)
    assert isinstance(origin, int)
    assert origin % 2 == 0
    assert abs(viewer / 2**level - (origin + (n - 1) / 2)) <= 1 + 1e-4


@given(viewer=viewers, n=grids, level=levels)
@example(viewer=math.nextafter(4.0, 0.0), n=15, level=0)
@example(viewer=-5e-324, n=31, level=3)
def test_neighbouring_levels_nest_at_one_of_two_places(viewer: float, n: int, level: int) -> None:
    m = (n + 1) // 4
    assert grid_origin(viewer, n, level) // 2 - grid_origin(viewer, n, level + 1) in (m - 1, m)


@given(viewer=st.floats(-1e6, 1e6), side=st.sampled_from([64, 256, 1024]), size=st.integers(1, 10**6))
def test_a_texture_window_holds_the_viewer_or_clings_to_the_level(viewer: float, side: int, size: int) -> None:
    origin = texture_origin(viewer, side, size)
    if size + 2 * TEXTURE_OVERHANG <= side:
        assert origin == -TEXTURE_OVERHANG
    else:
        assert -TEXTURE_OVERHANG <= origin <= size + TEXTURE_OVERHANG - side
        if side <= viewer <= size - side:
            assert abs(viewer - (origin + side / 2)) <= side / 32


def test_a_texture_window_moves_in_steps() -> None:
    origins = [texture_origin(viewer, 256, 10_000) for viewer in range(4000, 4100)]
    assert {origin % 8 for origin in origins} == {0}
    assert origins == sorted(origins)


def test_other_grids_are_refused() -> None:
    with pytest.raises(UsageError, match="one of 15, 31, 63, 127, 255, 511"):
        check_grid(100)
    assert check_grid(255) == 255
