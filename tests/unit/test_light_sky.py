"""The open sky: what is below the horizontal is none of it; and horizons above the horizontal, by threads and with forgotten corners."""

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.region import Rect
from tests.reference.shadows import horizon_tangents, step_toward
from tests.unit.test_light_zones import Grid
from tests.unit.test_shadow import AZIMUTHS, CELLS, EARTHS, PARTS, rough_terrain, split, terrains
from tiler.light.frame import Earth
from tiler.light.horizons import HorizonSweep
from tiler.light.place import GridPlace
from tiler.light.sweeping import Float32, Float64
from tiler.light.turning import turned
from tiler.light.visibility import TOP, sky_shares

CELL_M = 30.0
POOL = ThreadPoolExecutor(3)


def sky_of(heights: Float64, earth: Earth | None, tmp_path: Path, azimuths: int = 32) -> Float64:
    """Return the share of the sky that is seen, 0 to 1."""
    grid = Grid(np.asarray(heights, np.float32))
    place = GridPlace(np.full((2, heights.shape[0]), CELL_M), (CELL_M, CELL_M), 0.0, 1, None, None)
    shares = sky_shares(grid, place, azimuths, earth, 2, tmp_path)
    return np.asarray(shares.read(Rect(0, 0, heights.shape[1], heights.shape[0]))[..., 0] / TOP, np.float64)


@pytest.mark.parametrize("earth", [None, Earth()])
@pytest.mark.parametrize("slope_deg", [0.0, 20.0, 60.0])
def test_a_slope_sees_the_sky_above_the_horizontal(slope_deg: float, earth: Earth | None, tmp_path: Path) -> None:
    """Of the half sphere over a tilted plane the part above the horizontal is worth (1 + cos slope) / 2: ground fills the rest."""
    columns = np.arange(60.0)[np.newaxis].repeat(50, axis=0)
    found = sky_of(CELL_M * math.tan(math.radians(slope_deg)) * columns, earth, tmp_path)
    np.testing.assert_allclose(found, (1 + math.cos(math.radians(slope_deg))) / 2, atol=3e-3)


def test_a_summit_sees_all_of_the_sky_and_no_more(tmp_path: Path) -> None:
    """However far down its horizon lies. What it sees below the horizontal is no sky, so nothing is reflected up to it either."""
    rows, columns = np.mgrid[-40:41, -40:41]
    found = sky_of(3000 - CELL_M * 1.2 * np.hypot(rows, columns), Earth(), tmp_path)
    assert found[40, 40] == pytest.approx(1.0, abs=1e-4)
    # its side is a plane in front, and lower on all others
    assert found[40, 70] == pytest.approx((1 + 1 / math.hypot(1, 1.2)) / 2, abs=5e-3)


def test_a_dome_sees_as_much_as_its_tangent_planes(tmp_path: Path) -> None:
    """A cap of a sphere rises nowhere above its own tangent planes: a sample sees (1 + cos slope) / 2."""
    rows, columns = np.mgrid[-60:61, -60:61].astype(np.float64)
    heights = CELL_M * np.sqrt(120.0**2 - rows**2 - columns**2)
    found = sky_of(heights, None, tmp_path)[5:-5, 5:-5]
    cosine = (heights / (CELL_M * 120.0))[5:-5, 5:-5]
    np.testing.assert_allclose(found, (1 + cosine) / 2, atol=3e-3)


def test_the_sky_of_rough_ground_is_that_of_walked_horizons(tmp_path: Path) -> None:
    """With 16 exact steps to half a code of 8 bits at rms; without, it was 2.4 on such ground."""
    heights = rough_terrain(90, 90, 3).astype(np.float64) * 3
    found = sky_of(heights, None, tmp_path, 16)
    around = np.pad(heights, 1, mode="reflect", reflect_type="odd")
    right, up = (around[1:-1, 2:] - around[1:-1, :-2]) / (2 * CELL_M), (around[:-2, 1:-1] - around[2:, 1:-1]) / (2 * CELL_M)
    total = np.zeros(heights.shape)
    for azimuth in (np.arange(16) + 0.5) * 22.5:
        own = right * math.sin(math.radians(azimuth)) + up * math.cos(math.radians(azimuth))
        tangents = horizon_tangents(heights, step_toward(float(azimuth), (CELL_M, CELL_M)))
        angle = np.pi / 2 - np.arctan(np.maximum(np.maximum(tangents, own), 0))
        total += (np.sin(angle) ** 2 - own * (angle - np.sin(angle) * np.cos(angle))) / np.sqrt(1 + right**2 + up**2)
    off = 255 * (found - np.maximum(total / 16, 0))[2:-2, 2:-2]
    assert np.sqrt((off**2).mean()) < 0.5


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, parts=PARTS)
def test_corners_that_nobody_sees_above_the_horizontal_can_be_forgotten(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, parts: list[int]
) -> None:
    """Bands forget what a whole sweep keeps; threads walk lines apart. The bits are the same."""
    valid = heights[~np.isnan(heights)]
    lowest = float(valid.min()) if valid.size else 0.0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tiler.light.horizons._LINES", 3)
        patch.setattr("tiler.light.horizons._NEAR_ROWS", 2)
        for known in (None, lowest):
            whole = HorizonSweep(heights.shape, cell, azimuth, earth, near_steps=2, lowest_m=known)
            rows = turned(heights, whole.frame.turns)
            banded = HorizonSweep(heights.shape, cell, azimuth, earth, near_steps=2, lowest_m=known, pool=POOL)
            found = np.vstack([banded.push(rows[start:stop]) for start, stop in split(rows.shape[0], parts)])
            assert found.tobytes() == whole.push(rows).tobytes()


@given(heights=terrains(), azimuth=st.sampled_from([0, 45, 90, 225, 270]), earth=EARTHS)
def test_horizons_above_the_horizontal_are_the_same(heights: Float32, azimuth: float, earth: Earth | None) -> None:
    """Along rows, columns and diagonals each sample has a line of its own: those above the horizontal are as they are without a floor."""
    valid = heights[~np.isnan(heights)]
    lowest = float(valid.min()) if valid.size else 0.0
    every = HorizonSweep(heights.shape, (10, 10), azimuth, earth, near_steps=1)
    above = HorizonSweep(heights.shape, (10, 10), azimuth, earth, near_steps=1, lowest_m=lowest)
    rows = turned(heights, every.frame.turns)
    np.testing.assert_array_equal(above.push(rows), np.maximum(every.push(rows), np.float32(0)))
