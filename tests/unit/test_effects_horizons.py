"""Bounds hold for light as it is baked: with horizons of hulls along lines and exact near steps, not only with those of a march."""

import math
from typing import TypeVar

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.effect_terrains import Array, Case, cases
from tiler.effects import bounds
from tiler.effects.statistics import measure_heights
from tiler.effects.tiles import lit_tiles, surroundings
from tiler.light.frame import Earth, sine_cosine_deg
from tiler.light.horizons import horizon_tangents
from tiler.light.shading import add_sky

EARTHS = (None, Earth(6_371_008.8), Earth(1e5, 0.0))
UNIT = float(1 << 20)
Sample = TypeVar("Sample", np.float64, np.bool_)


def of_samples(tiles: NDArray[Sample], side: int, shape: tuple[int, ...]) -> NDArray[Sample]:
    """Return what holds for every sample of a map, by the first of the tiles that have it."""
    rows, columns = (np.minimum(np.arange(size) // side, count - 1) for size, count in zip(shape, tiles.shape, strict=True))
    return tiles[np.ix_(rows, columns)]


def heights_of(case: Case) -> NDArray[np.float32]:
    return case.z.astype(np.float32)


@settings(max_examples=200)
@given(case=cases(), steps=st.sampled_from([0, 1, 4, 16]), earth=st.sampled_from(EARTHS), side=st.sampled_from([3, 64]))
def test_no_horizon_is_higher_than_its_bound(case: Case, steps: int, earth: Earth | None, side: int) -> None:
    z = heights_of(case)
    found = measure_heights([z], (z.shape[0], z.shape[1]), case.cell, case.sun, side)
    tangents = horizon_tangents(z, case.cell, case.azimuth, earth, near_steps=steps)
    most = of_samples(surroundings(found).horizon_tan, side, z.shape)
    known = np.isfinite(tangents)
    assert (tangents[known] <= most[known] * (1 + 1e-6) + 1e-7).all()


@settings(max_examples=200)
@given(case=cases(), steps=st.sampled_from([0, 16]), earth=st.sampled_from(EARTHS), disc=st.sampled_from([0.0, 0.2666]))
def test_ground_that_is_proved_lit_sees_the_sun(case: Case, steps: int, earth: Earth | None, disc: float) -> None:
    assume(0 < case.elevation - disc < 85)
    z = heights_of(case)
    found = measure_heights([z], (z.shape[0], z.shape[1]), case.cell, case.sun, 3)
    lit = of_samples(lit_tiles(found, case.elevation, disc), 3, z.shape)
    tangents = horizon_tangents(z, case.cell, case.azimuth, earth, near_steps=steps)
    lowest = math.tan(math.radians(case.elevation - disc))
    assert (tangents[lit & np.isfinite(tangents)] <= lowest * (1 + 1e-6) + 1e-7).all()


def sky(case: Case, steps: int, azimuths: int, hidden: bool) -> Array:
    """Return the share of the sky that every sample sees, directions below the horizontal left out."""
    z = heights_of(case)
    around = np.pad(z, 1, constant_values=np.float32(np.nan))
    cells = np.ascontiguousarray(np.repeat(np.array(case.cell)[:, np.newaxis], z.shape[0], axis=1))
    seen = np.zeros(z.shape, np.uint32)
    for turn in (360 * (n + 0.5) / azimuths for n in range(azimuths)):
        horizon = horizon_tangents(z, case.cell, turn, near_steps=steps) if hidden else np.zeros_like(z)
        add_sky(around, cells, np.fmax(horizon, np.float32(0)), *sine_cosine_deg(turn), seen)
    return seen / (azimuths * UNIT)


@settings(max_examples=100)
@given(case=cases(largest=8), steps=st.sampled_from([0, 16]), azimuths=st.sampled_from([4, 16]))
def test_no_more_sky_is_hidden_than_its_bound(case: Case, steps: int, azimuths: int) -> None:
    z = heights_of(case)
    found = measure_heights([z], (z.shape[0], z.shape[1]), case.cell, case.sun, 3)
    around = surroundings(found)
    hidden, ground = (
        of_samples(np.vectorize(bound, otypes=[np.float64])(around.horizon_tan, around.tilt_tan), 3, z.shape)
        for bound in (bounds.hidden_sky, bounds.seen_ground)
    )
    open_sky, seen = sky(case, steps, azimuths, False), sky(case, steps, azimuths, True)
    valid = np.isfinite(z)
    assert (open_sky - seen <= hidden + 2e-5)[valid].all()
    assert (1 - seen <= ground + 2e-5)[valid].all()
