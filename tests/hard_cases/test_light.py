"""Hard cases of shadows and horizons. The number in a name is the case's; the docstring states what must come out."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.errors import UsageError
from tests.reference import shadows as reference
from tiler.light.certified import certified_shadow
from tiler.light.disc import disc_coverage
from tiler.light.frame import Earth, SunPosition, frame_of
from tiler.light.horizons import horizon_tangents
from tiler.light.shadow import ShadowSweep, cast_shadow
from tiler.light.sweeping import LIT, SHADED, VOID, Codes, Float32
from tiler.light.turning import turned

AIRLESS = Earth(refraction=0)
BOTH = pytest.mark.parametrize("cast", [cast_shadow, certified_shadow])
AZIMUTHS = (0.0, 17.3, 44.9999999, 45.0, 45.0000001, 90.0, 133.0, 180.0, 224.9, 270.0, 301.0, 359.99)


def noise(height: int, width: int, seed: int = 1) -> Float32:
    return np.random.default_rng(seed).normal(0, 20, (height, width)).astype(np.float32)


def plane(height: int, width: int, value: float = 0.0) -> Float32:
    return np.full((height, width), value, np.float32)


@BOTH
@pytest.mark.parametrize("earth", [None, AIRLESS])
def test_c32_sun_at_the_zenith(cast: Any, earth: Earth | None) -> None:
    """Everything is lit, voids stay void, and no infinity is multiplied by 0."""
    heights = noise(20, 20)
    heights[3, 4], heights[5, 6] = np.nan, np.inf
    codes = cast(heights, (10, 10), SunPosition(33, 90), earth)
    assert codes[3, 4] == codes[5, 6] == VOID
    assert (codes == LIT).sum() == 398


@BOTH
def test_c33_sun_almost_at_the_zenith(cast: Any) -> None:
    """89.999999 degrees: a cliff of 20 km throws a third of a millimetre."""
    heights = noise(20, 20)
    heights[9] = 20_000
    assert (cast(heights, (10, 10), SunPosition(33, 89.999999)) == LIT).all()


@BOTH
def test_c34_sun_on_the_horizon_of_a_flat_earth(cast: Any) -> None:
    """Whatever is lower than anything before it is shaded, at any distance; what is as high is lit."""
    heights = plane(500, 5)
    heights[2, :] = 0.001
    heights[400, :] = 0.001
    codes = cast(heights, (10, 10), SunPosition(0, 0))
    assert (codes[[0, 1, 2, 400]] == LIT).all()
    assert (codes[3:400] == SHADED).all()
    assert (codes[401:] == SHADED).all()


@BOTH
def test_c34_sun_on_the_horizon_of_a_round_earth(cast: Any) -> None:
    """Half of the sea sees it, and of the other half what rises by t**2 / 2R: 784.8 m at 100 km."""
    heights = plane(401, 4)
    heights[300] = 784.0, 785.5, 0.0, np.nan
    codes = cast(heights, (1000, 1000), SunPosition(0, 0), AIRLESS)
    assert (codes[:201] == LIT).all()
    assert codes[300].tolist() == [SHADED, LIT, SHADED, VOID]
    assert (np.delete(codes[201:], 99, axis=0) == SHADED).all()


@BOTH
def test_c35_sun_below_the_horizon(cast: Any) -> None:
    """All dark on a flat Earth; on a round one the summits above R (1 / cos el - 1), 970.5 m at -1 degree, are lit still."""
    heights = plane(3, 3)
    heights[1] = 969.0, 972.0, 500.0
    assert (cast(heights, (10, 10), SunPosition(90, -1)) == SHADED).all()
    codes = cast(heights, (10, 10), SunPosition(0, -1), AIRLESS)
    assert codes.tolist() == [[SHADED] * 3, [SHADED, LIT, SHADED], [SHADED] * 3]
    raised = ShadowSweep(heights.shape, (10, 10), SunPosition(0, -1), AIRLESS, sea_m=100)
    assert (raised.push(heights) == SHADED).all(), "above another sea"


def test_c36_sun_of_which_nothing_is_seen() -> None:
    """At -0.833 degrees no part of the disc is above a level horizon, at 0 half of it, at 0.27 all."""
    level = np.zeros((1, 1), np.float32)
    assert [float(disc_coverage(level, elevation)[0, 0]) for elevation in (-0.833, 0.0, 0.27)] == [0, 0.5, 1]


@BOTH
def test_c38_azimuths_go_round(cast: Any) -> None:
    """Whole turns change nothing; what is no angle is refused."""
    heights = noise(30, 20)
    for azimuth in (0.0, 33.25, 290.5):
        expected = cast(heights, (10, 10), SunPosition(azimuth, 20))
        for turns in (-2, 1, 5):
            assert (cast(heights, (10, 10), SunPosition(azimuth + 360 * turns, 20)) == expected).all()
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(UsageError, match="finite degrees"):
            SunPosition(bad, 20)


def perimeter(codes: Codes) -> Any:
    """Samples with one beside them that is lit where they are not."""
    padded = np.pad(codes, 1, mode="edge")
    near = [padded[1 + dy : padded.shape[0] - 1 + dy, 1 + dx : padded.shape[1] - 1 + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.min(near, axis=0) != np.max(near, axis=0)


@BOTH
@pytest.mark.parametrize("quarter", range(4))
def test_c39_no_seam_where_the_axes_change_over(cast: Any, quarter: int) -> None:
    """A hair to either side of a diagonal: differences only on the outlines of shadows, and few."""
    smooth = 400 * np.sin(np.arange(90)[:, None] / 9) * np.cos(np.arange(80) / 7)
    at = cast(smooth.astype(np.float32), (10, 10), SunPosition(45 + 90 * quarter, 30))
    assert 0.1 < (at == SHADED).mean() < 0.9
    for aside in (-1e-7, 1e-7, -1e-12, 1e-12):
        beside = cast(smooth.astype(np.float32), (10, 10), SunPosition(45 + 90 * quarter + aside, 30))
        inner = (slice(2, -2), slice(2, -2))
        different = (beside != at)[inner]
        assert not (different & ~perimeter(at)[inner]).any()
        assert different.mean() < 0.01


@given(
    quarters=st.integers(1, 3),
    azimuth=st.integers(0, 360 * 64 - 1),
    cell=st.sampled_from([(10.0, 10.0), (10.0, 7.0), (1.0, 100.0)]),
    earth=st.sampled_from([None, Earth(radius_m=20e3)]),
    lines=st.sampled_from([0, 1, 3]),
    seed=st.integers(0, 20),
)
def test_c40_turned_by_a_quarter(
    quarters: int, azimuth: int, cell: tuple[float, float], earth: Earth | None, lines: int, seed: int
) -> None:
    """The shadows of a turned grid under the turned sun are the turned shadows, bit for bit, at azimuths that degrees hold exactly."""
    heights = noise(23, 31, seed)
    heights[5, 6:9] = np.nan

    def cast(grid: Float32, cell_m: tuple[float, float], azimuth_deg: float) -> Codes:
        sun = SunPosition(azimuth_deg, 12)
        return cast_shadow(grid, cell_m, sun, earth, lines=lines) if lines else certified_shadow(grid, cell_m, sun, earth)

    straight = cast(heights, cell, azimuth / 64)
    other = cast(np.rot90(heights, quarters), cell if quarters == 2 else cell[::-1], azimuth / 64 - 90 * quarters)
    assert (np.rot90(straight, quarters) == other).all()


@BOTH
@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_c41_plane(cast: Any, azimuth: float) -> None:
    """All of it is lit without any bias, even by the sun on the horizon; its horizon is exactly level, or the edge of nothing."""
    for value in (0.0, 8848.86, -430.5, 1e7):
        for elevation in (0.0, 1e-9, 30.0):
            assert (cast(plane(40, 50, value), (10, 10), SunPosition(azimuth, elevation)) == LIT).all()
        assert set(np.unique(horizon_tangents(plane(40, 50, value), (10, 10), azimuth, near_steps=2))) <= {0.0, -np.inf}


@BOTH
@pytest.mark.parametrize("azimuth", [0, 90, 180, 270])
def test_c42_plane_at_the_elevation_of_the_sun(cast: Any, azimuth: int) -> None:
    """It falls away from the sun as steeply as the rays do: every ray grazes all of it, and it is lit."""
    ramp = np.repeat(-10 * np.arange(60, dtype=np.float32)[:, None], 60, axis=1)
    assert (cast(np.rot90(ramp, -azimuth // 90), (10, 10), SunPosition(azimuth, 45)) == LIT).all()
    steeper = np.rot90(ramp * np.float32(1.01), -azimuth // 90)
    assert (cast(steeper, (10, 10), SunPosition(azimuth, 45)) == SHADED).sum() == 59 * 60


@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_c43_spike(azimuth: float) -> None:
    """One sample of 1000 m: a shadow of height / tan elevation, pointing away from the sun, of the area under its tent.

    On its row the spike is a tent two columns wide, so the shadow is a triangle, one column wide on the average.
    """
    heights = plane(401, 401)
    heights[200, 200] = 1000
    frame = frame_of(heights.shape, (10, 10), azimuth)
    slope = math.tan(math.radians(35))
    shaded = turned(certified_shadow(heights, (10, 10), SunPosition(azimuth, 35)), frame.turns) == SHADED
    down, right = np.mgrid[-200:201, -200:201]
    tent = 1000 * (1 - np.abs(right + down * frame.shift))
    assert (shaded == ((down > 0) & (tent > np.maximum(down * frame.step_m * slope, 0)))).all()
    assert shaded.sum() == pytest.approx(1000 / slope / frame.step_m, rel=0.3), "where rays drift slowly, few columns are met"
    rows, columns = np.nonzero(certified_shadow(heights, (10, 10), SunPosition(azimuth, 35)) == SHADED)
    sine, cosine = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    away, aside = 10 * ((rows - 200) * cosine - (columns - 200) * sine), 10 * ((rows - 200) * sine + (columns - 200) * cosine)
    assert 1000 / slope * 0.7 < away.max() <= 1000 / slope + 10, "the tip is narrower than a sample"
    assert np.abs(aside).max() < 10


@BOTH
def test_c44_cliff(cast: Any) -> None:
    """100 m at 45 degrees shade nine samples of 10 m and not the tenth, with nothing lit between them."""
    heights = plane(40, 30)
    heights[:10] = 100
    codes = cast(heights, (10, 10), SunPosition(0, 45))
    assert (codes[:10] == LIT).all()
    assert (codes[10:19] == SHADED).all()
    assert (codes[19:] == LIT).all()
    for azimuth in (20.0, 340.0):
        reach = 100 / math.tan(math.radians(30)) * math.cos(math.radians(azimuth)) / 10
        oblique = cast(heights, (10, 10), SunPosition(azimuth, 30))
        inner = oblique[:, 8:22]
        assert (inner[10 : 9 + math.ceil(reach)] == SHADED).all()
        assert (inner[9 + math.ceil(reach) :] == LIT).all()


@BOTH
@pytest.mark.parametrize("offset", [0.0, 1e6, 1e7])
def test_c45_wall_and_a_line_of_100_000_samples(cast: Any, offset: float) -> None:
    """The shadow of a wall 1 km away from the sun's side of the grid is right to the last float32 at its far end, 1000 km away.

    A float32 state is 0.6 m off; here every sample is the float32 next below or above the exact edge of the shadow.
    """
    length, slope = 100_000, Fraction(math.sin(math.radians(0.5)) / math.cos(math.radians(0.5)))
    heights = plane(length, 6, offset - 30_000)
    heights[100] = wall = np.float32(offset + 9000)
    probes = ((101, 0), (50_000, 2), (length - 1, 4))
    for row, column in probes:
        edge = float(Fraction(float(wall)) - (row - 100) * 10 * slope)
        below, above = np.float32(edge), np.float32(edge)
        below = np.nextafter(below, np.float32(-np.inf)) if below >= edge - 1e-6 else below
        above = np.nextafter(above, np.float32(np.inf)) if above <= edge + 1e-6 else above
        heights[row, column : column + 2] = below, above
    codes = cast(heights, (10, 10), SunPosition(0, 0.5))
    for row, column in probes:
        assert codes[row, column : column + 2].tolist() == [SHADED, LIT], row


@pytest.mark.parametrize("azimuth", [0, 30, 45, 200])
def test_c46_cap(azimuth: float) -> None:
    """On a hemisphere the terminator is where the ground falls as steeply as the sun's rays."""
    radius = 150.0
    south, east = np.mgrid[-160:161, -160:161].astype(float)
    height = np.sqrt(np.maximum(radius**2 - south**2 - east**2, 0))
    away = south * math.cos(math.radians(azimuth)) - east * math.sin(math.radians(azimuth))
    codes = certified_shadow(height.astype(np.float32), (1, 1), SunPosition(azimuth, 25))
    near_top = height > 0.6 * radius
    fall = away / np.where(near_top, height, 1)
    slope = math.tan(math.radians(25))
    assert (codes[near_top & (fall < slope - 0.05)] == LIT).all()
    assert (codes[near_top & (fall > slope + 0.05)] == SHADED).all()


def test_c50_curved_sea() -> None:
    """Every sample of a lifted sea is a corner of its hull: 3000 of them overflow nothing, and the horizon is the dip of the next."""
    for azimuth in (0.0, 20.0):
        tangents = horizon_tangents(plane(3000, 40), (10, 10), azimuth, AIRLESS, near_steps=0)
        step_m = frame_of((3000, 40), (10, 10), azimuth).step_m
        seen = np.isfinite(tangents)
        assert seen[1:, :20].all()
        assert np.allclose(tangents[seen], -step_m / (2 * AIRLESS.radius_m), rtol=1e-3, atol=1e-9)


@BOTH
@pytest.mark.parametrize("cell", [(1e-3, 1e-3), (1e5, 1e5), (1.0, 100.0), (100.0, 1.0), (30.0, 55.0)])
def test_c51_shadow_of_a_pole_in_cells_of_any_shape(cast: Any, cell: tuple[float, float]) -> None:
    """It points away from the sun on the ground, not on the grid: within a cell of the line at the true azimuth."""
    for azimuth in (10.0, 60.0, 125.0, 200.0, 320.0):
        heights = plane(201, 201)
        heights[100, 100] = 40 * min(cell)
        rows, columns = np.nonzero(cast(heights, cell, SunPosition(azimuth, 40)) == SHADED)
        assert rows.size
        south_m, east_m = (rows - 100) * cell[1], (columns - 100) * cell[0]
        sine, cosine = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
        frame = frame_of(heights.shape, cell, azimuth)
        across_m = cell[1] if frame.turns % 2 else cell[0]
        assert (south_m * cosine - east_m * sine > -across_m).all()
        assert (south_m * cosine - east_m * sine).max() > 0
        assert np.abs(south_m * sine + east_m * cosine).max() <= 2 * across_m


def test_c53_row_at_a_pole() -> None:
    """Where meridians meet samples are no distance apart, and an azimuth means nothing: refused, not divided by."""
    with pytest.raises(UsageError, match="collapse at a pole"):
        cast_shadow(plane(3, 3), (0.0, 30.0), SunPosition(10, 20))


@BOTH
@pytest.mark.parametrize("azimuth", [0.0, 21.0, 300.0])
def test_c58_large_offsets_of_all_heights(cast: Any, azimuth: float) -> None:
    """Whole metres stay whole metres on top of 10 million of them: the same shadows."""
    heights = np.rint(noise(60, 60, 3))
    sun = SunPosition(azimuth, 17.123)
    assert (cast(heights + np.float32(1e7), (10, 10), sun) == cast(heights, (10, 10), sun)).all()


@BOTH
def test_voids_cast_nothing_and_stay_void(cast: Any) -> None:
    """A tower with a void on top casts what its valid samples do; infinite heights are voids, not towers."""
    for nothing in (np.nan, np.inf, -np.inf):
        heights = plane(30, 30)
        heights[10, 10:20] = nothing
        for azimuth in (0.0, 30.0, 200.0):
            codes = cast(heights, (10, 10), SunPosition(azimuth, 10))
            assert (codes == VOID).sum() == 10
            assert (codes == LIT).sum() == 890
    assert (cast(plane(4, 4, np.nan), (1, 1), SunPosition(3, 3)) == VOID).all()


@BOTH
def test_bias_lights_what_is_shaded_by_less(cast: Any) -> None:
    heights = plane(20, 4)
    heights[5] = 1.0
    codes = [cast(heights, (1, 1), SunPosition(0, 45), bias_m=bias) for bias in (0.0, 0.5)]
    assert (codes[0] == LIT).all(), "one metre ends exactly at the next sample"
    heights[5] = 2.0
    assert (cast(heights, (1, 1), SunPosition(0, 45)) == SHADED).sum() == 4
    assert (cast(heights, (1, 1), SunPosition(0, 45), bias_m=1.5) == LIT).all()


@BOTH
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (2, 1500)])
def test_grids_as_small_as_they_get(cast: Any, shape: tuple[int, int]) -> None:
    heights = noise(*shape)
    for azimuth in AZIMUTHS:
        step = reference.step_toward(azimuth, (10, 10))
        codes = cast(heights, (10, 10), SunPosition(azimuth, 30))
        unshaded = reference.shadow_margins(heights.astype(float), step, math.tan(math.radians(30))) == math.inf
        assert codes.shape == shape
        if cast is certified_shadow:
            assert (codes[unshaded] == LIT).all() or azimuth == 359.99


def test_reference_and_kernels_share_nothing() -> None:
    """The oracle must not import what it judges."""
    with open(str(reference.__file__)) as file:
        assert "import tiler" not in (text := file.read())
    assert "from tiler" not in text
