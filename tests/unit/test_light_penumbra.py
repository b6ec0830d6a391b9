"""Horizons where they cut the sun's disc: those of walked rays, whatever the bands and whatever is kept of the past."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.reference.shadows import horizon_tangents
from tests.reference.terrain import power_law_field
from tests.unit.test_shadow import AZIMUTHS, CELLS, EARTHS, PARTS, split, terrains
from tiler.light import marching
from tiler.light.frame import Earth, SunPosition, curvature_per_m
from tiler.light.penumbra import PenumbraSweep, can_march
from tiler.light.shadow import local_elevation_deg, rays_of
from tiler.light.sweeping import Float32
from tiler.light.turning import turned

DARK = float(np.float32(marching.DARK))
POOL = ThreadPoolExecutor(3)


@pytest.fixture(scope="module", autouse=True)
def _no_room_to_spare() -> Iterator[None]:
    """So that rows are forgotten in grids as small as these."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tiler.light.terrainkept._SPARE_BYTES", 0)
        yield


def range_of(heights: Float32) -> tuple[float, float]:
    valid = heights[~np.isnan(heights)]
    return (float(valid.min()), float(valid.max())) if valid.size else (0.0, 0.0)


@given(
    heights=terrains(),
    azimuth=st.integers(0, 359 * 8).map(lambda turn: turn / 8),
    cell=CELLS,
    earth=st.sampled_from([None, Earth()]),
    elevation=st.sampled_from([-0.2, 3.0, 20.0, 60.0]),
    radius=st.sampled_from([0.2666, 2.0, 10.0]),
)
def test_horizons_in_the_disc_are_exact_and_others_are_beyond_it(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, elevation: float, radius: float
) -> None:
    sun = SunPosition(azimuth, elevation)
    sweep = PenumbraSweep(heights.shape, cell, sun, radius, earth, range_m=range_of(heights))
    rays = rays_of(heights.shape, cell, sun, earth)
    rows = turned(heights, rays.frame.turns)
    found = sweep.push(rows).astype(np.float64)
    expected = horizon_tangents(rows.astype(float), (-1.0, rays.frame.shift, rays.frame.step_m), curvature_per_m(earth))
    local = np.rot90(local_elevation_deg(rays, rays.frame.grid_window((0, rays.frame.rows))), rays.frame.turns)
    lower, upper = np.tan(np.radians(local - radius)), np.tan(np.radians(local + radius))
    valid = ~np.isnan(rows)
    assert (np.isnan(found) == ~valid).all()
    inside = valid & (found > -np.inf) & (found < DARK)
    # Between samples the ground is straight here, and curved there: by this much, seen from the next row.
    off = 1e-6 + curvature_per_m(earth) * max(cell) ** 2 / min(cell)
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-5, atol=off)
    assert (expected[valid & (found == -np.inf)] < lower[valid & (found == -np.inf)] + 1e-5 + off).all()
    assert (expected[valid & (found == DARK)] > upper[valid & (found == DARK)] - 1e-5 - off).all()


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, parts=PARTS, elevation=st.sampled_from([-0.5, 5.0, 30.0]))
def test_bands_and_forgotten_rows_do_not_show(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, parts: list[int], elevation: float
) -> None:
    sun = SunPosition(azimuth, elevation)
    whole = PenumbraSweep(heights.shape, cell, sun, 1.0, earth, range_m=range_of(heights))
    rows = turned(heights, whole.frame.turns)
    banded = PenumbraSweep(heights.shape, cell, sun, 1.0, earth, range_m=range_of(heights), pool=POOL)
    found = np.vstack([banded.push(rows[start:stop]) for start, stop in split(rows.shape[0], parts)])
    assert found.tobytes() == whole.push(rows).tobytes()


def test_few_rays_are_marched() -> None:
    heights = np.asarray(20 * power_law_field(400, 400, 1, 3.6), np.float32)
    sweep = PenumbraSweep(heights.shape, (10, 10), SunPosition(20, 15), 0.2666, range_m=range_of(heights))
    tangents = sweep.push(heights)
    assert 0 < (np.isfinite(tangents) & (tangents < DARK)).sum() < sweep.marched < 0.05 * heights.size


@pytest.mark.parametrize(("elevation", "side", "expected"), [(89.0, 100, False), (10.0, 100, True), (0.1, 100, True), (0.1, 20_000, False)])
def test_what_does_not_fit_into_memory_is_not_marched(elevation: float, side: int, expected: bool) -> None:
    assert can_march((side, side), (10, 10), SunPosition(20, elevation), 0.2666, Earth(), None, (0, 3000)) == expected
