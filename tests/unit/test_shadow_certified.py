"""Certified shadows: the codes of the exact march, everywhere, whatever the bands and whatever is kept of the past."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st

from tests.reference.shadows import shadow_margins
from tests.reference.terrain import power_law_field
from tests.unit.test_shadow import AZIMUTHS, CELLS, EARTHS, PARTS, as_codes, rough_terrain, split, terrains
from tiler.light.certified import CertifiedSweep, certified_shadow, reach_rows
from tiler.light.frame import Earth, SunPosition
from tiler.light.shadow import ShadowSweep
from tiler.light.sweeping import LIT, SHADED, VOID, Float32
from tiler.light.turning import turned


@pytest.fixture(scope="module", autouse=True)
def _no_room_to_spare() -> Iterator[None]:
    """So that rows are forgotten in grids as small as these."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tiler.light.terrainkept._SPARE_BYTES", 0)
        yield


def check_against_walked_rays(sweep: CertifiedSweep, heights: Float32) -> None:
    """Same step, same places: off only where a ray touches the terrain to within rounding, which sums in another order see differently."""
    rows = turned(heights, sweep.frame.turns)
    found = sweep.push(rows)
    margins = shadow_margins(rows.astype(float), (-1.0, sweep.frame.shift, sweep.frame.step_m), sweep.rays.slope)
    assert (np.abs(margins[found != as_codes(margins)]) < 1e-9).all()
    assert ((found == VOID) == np.isnan(rows)).all()


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, elevation=st.sampled_from([3.0, 20.0, 60.0]))
def test_every_sample_is_what_a_walked_ray_finds(heights: Float32, azimuth: float, cell: tuple[float, float], elevation: float) -> None:
    check_against_walked_rays(CertifiedSweep(heights.shape, cell, SunPosition(azimuth, elevation)), heights)


@given(
    seed=st.integers(0, 50),
    shift=st.sampled_from([(1, 2), (1, 3), (2, 3), (3, 4)]),
    voids=st.sampled_from([0.0, 0.15, 0.5]),
    quarter=st.integers(0, 3),
)
def test_rays_that_run_through_samples_again_and_again(seed: int, shift: tuple[int, int], voids: float, quarter: int) -> None:
    """Shifts of 1/2, 1/3, 2/3: rays hit samples exactly, or pass them by a rounding, with voids beside them and edges."""
    heights = np.rint(rough_terrain(32, 32, seed, voids))
    azimuth = math.degrees(math.atan(shift[0] / shift[1])) + 90 * quarter
    check_against_walked_rays(CertifiedSweep(heights.shape, (10, 10), SunPosition(azimuth, 15)), heights)


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, parts=PARTS, elevation=st.sampled_from([-0.5, 5.0, 30.0]))
def test_bands_and_forgotten_rows_do_not_show(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, parts: list[int], elevation: float
) -> None:
    sun = SunPosition(azimuth, elevation)
    whole = CertifiedSweep(heights.shape, cell, sun, earth)
    rows = turned(heights, whole.frame.turns)
    expected = whole.push(rows)
    valid = heights[~np.isnan(heights)]
    known = (float(valid.min()), float(valid.max())) if valid.size else (0.0, 0.0)
    for range_m in (None, known):
        banded = CertifiedSweep(heights.shape, cell, sun, earth, range_m=range_m)
        found = np.vstack([banded.push(rows[start:stop]) for start, stop in split(rows.shape[0], parts)])
        assert found.tobytes() == expected.tobytes()
        assert banded.voids == np.isnan(heights).sum()


@pytest.mark.parametrize("earth", [None, Earth(), Earth(radius_m=5000, refraction=0)])
@pytest.mark.parametrize("voids", [0.0, 0.1])
@pytest.mark.parametrize("azimuth", [3.1, 29.2, 44.9, 78.3, 101.0, 163.7, 222.2, 290.0, 348.5])
def test_many_lines_come_to_the_same(azimuth: float, earth: Earth | None, voids: float) -> None:
    """An independent way to the same shadows, curvature and all, but for the edges: 64 lines leave few wrong, most beside voids."""
    heights = rough_terrain(150, 150, 7, voids)
    fine = ShadowSweep(heights.shape, (10, 7), SunPosition(azimuth, 20), earth, lines=64)
    exact = CertifiedSweep(heights.shape, (10, 7), SunPosition(azimuth, 20), earth)
    rows = turned(heights, fine.frame.turns)
    assert (fine.push(rows) != exact.push(rows))[:, 2:-2].mean() < (0.005 if voids else 0.002)


def test_few_rays_are_marched() -> None:
    heights = (power_law_field(300, 300, 5, 4.0) * 200).astype(np.float32)
    sweep = CertifiedSweep(heights.shape, (10, 10), SunPosition(20, 15))
    codes = sweep.push(heights)
    assert 0.1 < (codes == LIT).mean() < 0.95
    assert 0 < sweep.marched < 0.05 * heights.size


def test_rows_beyond_reach_are_let_go() -> None:
    """100 m of relief under a sun at 45 degrees reach 100 m: of 2000 rows of 10 m, eleven are kept, blocks of 4, and the last band."""
    sun = SunPosition(0, 45)
    heights = np.random.default_rng(1).uniform(0, 100, (2000, 8)).astype(np.float32)
    sweep = CertifiedSweep(heights.shape, (10, 10), sun, range_m=(0, 100))
    assert reach_rows(sweep.rays, 100) == 11
    found = np.vstack([sweep.push(heights[start : start + 50]) for start in range(0, 2000, 50)])
    assert 11 <= sweep._kept.heights.shape[0] <= 11 + 3 + 50
    assert sweep._kept.first % 4 == 0
    assert (found == certified_shadow(heights, (10, 10), sun)).all()
    with pytest.raises(ValueError, match="was said to have 0 to 100"):
        CertifiedSweep(heights.shape, (10, 10), sun, range_m=(0, 100)).push(heights + 50)


def test_reach_on_a_round_earth() -> None:
    """4000 m are seen from the coast at 242 km by the level sun, with refraction (sqrt(2 R h)); less far if it stands higher."""
    level = CertifiedSweep((4000, 2), (100, 100), SunPosition(0, 0), Earth(), reference=(3999, 0))
    assert reach_rows(level.rays, 4000) * 100 == pytest.approx(242e3, rel=0.01)
    high = CertifiedSweep((4000, 2), (100, 100), SunPosition(0, 5), Earth(), reference=(3999, 0))
    assert reach_rows(high.rays, 4000) * 100 == pytest.approx(4000 / math.tan(math.radians(5)), rel=0.05)
    flat = CertifiedSweep((4000, 2), (100, 100), SunPosition(0, 0))
    assert reach_rows(flat.rays, 4000) == 4000


def test_a_plain_under_the_level_sun_is_decided_in_no_time() -> None:
    """Every ray grazes the whole plain: the pyramid of maxima must skip what is as high as the ray."""
    heights = np.full((600, 600), 3.7, np.float32)
    heights[0, 300] = np.nan
    sweep = CertifiedSweep(heights.shape, (10, 10), SunPosition(20, 0))
    codes = sweep.push(heights)
    assert set(np.unique(codes)) == {LIT, VOID}
    assert sweep.marched > 300_000
    heights[0] = 4
    assert (certified_shadow(heights, (10, 10), SunPosition(0, 0))[1:] == SHADED).all()


def test_the_himalaya_with_its_voids(data_dir: Path) -> None:
    """SRTM around Mount Everest, a fifth of it void here, sun at 20 degrees in the north-west."""
    with rasterio.open(data_dir / "dem" / "mt_everest_90m.tif") as file:
        read = file.read(1)[150:400, 550:850].astype(np.float32)
    heights = np.where(read == -32768, np.float32(np.nan), read)
    sweep = CertifiedSweep(heights.shape, (81, 92), SunPosition(300, 20))
    check_against_walked_rays(sweep, heights)
    assert sweep.voids == np.isnan(heights).sum() > 10_000
