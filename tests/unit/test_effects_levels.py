"""Differences of levels, against the coarser surface sampled by itself."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import UsageError
from tests.reference import effects as reference
from tiler.effects.levels import compare_levels


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.sampled_from([0.0, 0.2]))
def test_levels_differ_as_their_surfaces_do(seed: int, height: int, width: int, voids: float) -> None:
    rng = np.random.default_rng(seed)
    fine, coarse = rng.normal(size=(height, width)), rng.normal(size=(-(-height // 2), -(-width // 2)))
    fine[rng.random(fine.shape) < voids] = np.nan
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    # On an even axis nothing is drawn beyond the last coarse sample.
    drawn = reference.surface(coarse, x / 2, y / 2, "diagonal") - fine
    found = compare_levels(fine, coarse, (10.0, 20.0))
    if np.isnan(drawn).all():
        assert found.height_m == 0
        return
    assert found.height_m == pytest.approx(float(np.nanmax(np.abs(drawn))))
    steepest = max((math.hypot(p, q) for p, q in reference.facet_gradients(drawn, (10.0, 20.0))), default=0.0)
    assert steepest <= found.gradient * (1 + 1e-12)


def test_what_a_level_holds_exactly_does_not_differ() -> None:
    y, x = np.mgrid[0:9, 0:13].astype(np.float64)
    plane = 3 * x - 2 * y + 100
    found = compare_levels(plane, plane[::2, ::2], (1.0, 1.0))
    assert (found.height_m, found.gradient) == (0, 0)


def test_levels_of_other_shapes_are_refused() -> None:
    with pytest.raises(UsageError, match="next coarser"):
        compare_levels(np.zeros((9, 9)), np.zeros((4, 5)), (1.0, 1.0))
