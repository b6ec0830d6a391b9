"""Cast shadows by line sweep: against walked rays, in bands and windows, turned, and how the error falls with the lines."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas.errors import UsageError
from schemas.region import Rect
from tests.reference.shadows import shadow_margins, step_toward
from tests.reference.terrain import power_law_field
from tiler.light.bands import plan_bands, sweep_bands
from tiler.light.certified import CertifiedSweep, certified_shadow
from tiler.light.frame import Earth, SunPosition, curvature_per_m, frame_of, sine_cosine_deg, tangent_deg
from tiler.light.horizons import HorizonSweep
from tiler.light.shadow import HALO, Lines, Rays, ShadowSweep, cast_shadow, sweep_window
from tiler.light.sweeping import LIT, SHADED, VOID, Codes, Float32, Float64
from tiler.light.turning import transposed, turned

AZIMUTHS = st.one_of(st.floats(0, 360), st.sampled_from([0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0, 44.9999999, 45.0000001]))
CELLS = st.sampled_from([(1.0, 1.0), (10.0, 7.0), (1.0, 100.0), (100.0, 1.0)])
EARTHS = st.sampled_from([None, Earth(), Earth(radius_m=5000, refraction=0)])


def rough_terrain(height: int, width: int, seed: int, voids: float = 0.0) -> Float32:
    """Noise of about as many metres as there are between samples, with holes."""
    random = np.random.default_rng(seed)
    heights = random.normal(0, 8, (height, width)).astype(np.float32)
    heights[random.random(heights.shape) < voids] = np.nan
    return heights


@st.composite
def terrains(draw: st.DrawFn) -> Float32:
    return rough_terrain(draw(st.integers(1, 40)), draw(st.integers(1, 40)), draw(st.integers(0, 99)), draw(st.sampled_from([0.0, 0.1])))


def expected_codes(heights: Float32, cell_m: tuple[float, float], azimuth_deg: float, elevation_deg: float) -> Codes:
    return as_codes(shadow_margins(heights.astype(np.float64), step_toward(azimuth_deg, cell_m), math.tan(math.radians(elevation_deg))))


def as_codes(margins: Float64) -> Codes:
    return np.where(np.isnan(margins), VOID, np.where(margins >= 0, LIT, SHADED)).astype(np.uint8)


@pytest.mark.parametrize("azimuth", range(0, 360, 45))
def test_along_rows_columns_and_diagonals_the_sweep_is_exact(azimuth: int) -> None:
    """Lines run through samples there, so nothing is interpolated."""
    for seed, voids in ((1, 0.0), (2, 0.2)):
        heights = rough_terrain(40, 30, seed, voids)
        found = cast_shadow(heights, (10, 10), SunPosition(azimuth, 25))
        assert (found == expected_codes(heights, (10, 10), azimuth, 25)).all()
        assert 0.05 < (found == LIT).mean() < 0.95


def test_the_error_falls_with_the_square_of_the_lines() -> None:
    """Each doubling leaves about a quarter of the wrong samples; the bounds allow for chance."""
    heights = (power_law_field(400, 400, 5, 4.0) * 250).astype(np.float32)
    wrong = dict.fromkeys((1, 2, 4, 8), 0.0)
    for azimuth in (20.0, 107.0, 290.0):
        sun = SunPosition(azimuth, 12)
        exact = certified_shadow(heights, (10, 10), sun)
        assert 0.1 < (exact == LIT).mean() < 0.9
        for lines in wrong:
            wrong[lines] += float((cast_shadow(heights, (10, 10), sun, lines=lines) != exact).mean()) / 3
    assert wrong[1] < 0.01
    assert wrong[2] < wrong[1] / 3
    assert wrong[4] < wrong[2] / 2.5
    assert 0 < wrong[8] < wrong[1] / 25


def test_the_edges_of_the_grid_are_shaded_too() -> None:
    """A wall across the grid: for a sun a little off the columns, lines beside the edge are outside of it for hundreds of rows."""
    heights = np.zeros((300, 9), np.float32)
    heights[0] = 300
    for azimuth in (0.06, 359.94):
        lit = cast_shadow(heights, (1, 1), SunPosition(azimuth, 45)) == LIT
        leaving = slice(0, 8) if azimuth < 1 else slice(1, 9)
        assert not lit[1:, leaving].any()


def split(total: int, parts: list[int]) -> list[tuple[int, int]]:
    """Cut 0..total into pieces of the sizes ``parts``, over and over."""
    edges = [0]
    while edges[-1] < total:
        edges.append(min(total, edges[-1] + parts[(len(edges) - 1) % len(parts)]))
    return list(pairwise(edges))


PARTS = st.lists(st.integers(1, 12), min_size=1, max_size=4)


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, lines=st.sampled_from([1, 2, 3, 7]), parts=PARTS)
def test_bands_give_the_bits_of_one_piece(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, lines: int, parts: list[int]
) -> None:
    whole = ShadowSweep(heights.shape, cell, SunPosition(azimuth, 20), earth, lines=lines)
    rows = turned(heights, whole.frame.turns)
    expected = whole.push(rows)
    banded = ShadowSweep(heights.shape, cell, SunPosition(azimuth, 20), earth, lines=lines)
    found = np.vstack([banded.push(rows[start:stop]) for start, stop in split(rows.shape[0], parts)])
    assert found.tobytes() == expected.tobytes()
    assert banded.voids == whole.voids == np.isnan(heights).sum()


def sweep_windows(rays: Rays, rows: Float32, lines: int, heights: list[int], widths: list[int]) -> Codes:
    """Sweep windows one by one, each with what the windows above it and beside it handed over."""
    codes = np.full(rows.shape, 9, np.uint8)
    columns = split(rows.shape[1], widths)
    order = range(len(columns) - 1, -1, -1) if rays.frame.shift > 0 else range(len(columns))
    above: dict[int, Lines] = {}
    for top, bottom in split(rows.shape[0], heights):
        beside = None
        for n in order:
            left, right = columns[n]
            part = rows[top:bottom, max(0, left - HALO[0]) : right + HALO[1]]
            swept = sweep_window(rays, Rect(left, top, right, bottom), part, lines, above.get(n), beside)
            codes[top:bottom, left:right] = swept.codes
            above[n], beside = swept.below, swept.beside
    return codes


@given(heights=terrains(), azimuth=AZIMUTHS, cell=CELLS, earth=EARTHS, lines=st.sampled_from([1, 2, 3]), tall=PARTS, wide=PARTS)
@example(rough_terrain(30, 30, 1), 44.9999999, (1.0, 1.0), None, 2, [1], [1])
@example(rough_terrain(30, 30, 1), 315.0, (1.0, 1.0), None, 3, [7], [1, 12])
def test_windows_give_the_bits_of_one_piece(
    heights: Float32, azimuth: float, cell: tuple[float, float], earth: Earth | None, lines: int, tall: list[int], wide: list[int]
) -> None:
    whole = ShadowSweep(heights.shape, cell, SunPosition(azimuth, 20), earth, lines=lines)
    rows = turned(heights, whole.frame.turns)
    assert sweep_windows(whole.rays, rows, lines, tall, wide).tobytes() == whole.push(rows).tobytes()


@pytest.mark.parametrize("seed", range(60))
def test_windows_under_any_sun(seed: int) -> None:
    """As above, spread evenly over azimuths, lines and cuts."""
    random = np.random.default_rng(seed)
    heights = rough_terrain(int(random.integers(10, 40)), int(random.integers(10, 40)), seed, 0.02)
    sun = SunPosition(random.uniform(0, 360), random.uniform(5, 40))
    lines = int(random.integers(1, 5))
    whole = ShadowSweep(heights.shape, (10, random.uniform(5, 20)), sun, lines=lines)
    rows = turned(heights, whole.frame.turns)
    found = sweep_windows(whole.rays, rows, lines, random.integers(1, 12, 3).tolist(), random.integers(1, 12, 3).tolist())
    assert found.tobytes() == whole.push(rows).tobytes()


@pytest.mark.parametrize("azimuth", [10, 100, 190, 280])
def test_bands_end_where_blocks_do(azimuth: int) -> None:
    """Of 17 rows and 16 columns in bands of 5, the odd one is the last of the grid, whichever is the first for the sun."""
    frame = frame_of((17, 16), (3, 2), azimuth)
    bands = plan_bands(frame, 5)
    edges = {edge for band in bands for edge in ((band.window.x0, band.window.x1) if frame.turns % 2 else (band.window.y0, band.window.y1))}
    assert edges == {0, 5, 10, 15, frame.rows}
    assert [(band.first, band.stop) for band in bands] == list(pairwise([0, *(band.stop for band in bands)]))


def test_diagonals_and_axes_go_round_with_the_sun() -> None:
    """The choice on a diagonal turns with it; what is a hair off an axis or a diagonal is on it."""
    assert [frame_of((9, 9), (1, 1), azimuth).turns for azimuth in (45, 135, 225, 315)] == [1, 2, 3, 0]
    assert [frame_of((9, 9), (1, 1), azimuth).turns for azimuth in (0, 90, 180, 270)] == [0, 1, 2, 3]
    assert frame_of((9, 9), (1, 1), 180.00000000001).shift == 0
    assert frame_of((9, 9), (1, 1), 45.00000000001).shift == -1
    assert 0 < abs(frame_of((9, 9), (1, 1), 180.001).shift) < 1e-4


def test_wide_rows_are_done_in_pieces_without_a_trace() -> None:
    """Rows are cut every 1024 columns inside the loops: what is 2500 wide is what its turned copy, 2500 high, is."""
    heights = rough_terrain(6, 2500, 3, 0.01)
    for azimuth in (10.5, 349.5, 0.0):
        wide = cast_shadow(heights, (10, 10), SunPosition(azimuth, 20), lines=2)
        expected = expected_codes(heights, (10, 10), azimuth, 20)
        assert (wide != expected).mean() < 0.02
        exact = CertifiedSweep(heights.shape, (10, 10), SunPosition(azimuth, 20)).push(heights)
        assert (exact == expected).all()


@settings(max_examples=30)
@given(heights=terrains(), azimuth=AZIMUTHS, size=st.integers(1, 50))
def test_a_grid_is_read_once_from_the_side_of_the_sun(heights: Float32, azimuth: float, size: int) -> None:
    sun = SunPosition(azimuth, 30)
    sweeps: list[Any] = [ShadowSweep(heights.shape, (3, 2), sun), HorizonSweep(heights.shape, (3, 2), azimuth, near_steps=2)]
    for sweep in sweeps:
        windows, found = [], np.full(heights.shape, 9.0)
        for window, part in sweep_bands(sweep, lambda rect: heights[rect.y0 : rect.y1, rect.x0 : rect.x1], size):
            windows.append(window)
            found[window.y0 : window.y1, window.x0 : window.x1] = part
        assert sum(window.area for window in windows) == heights.size
        interior = {edge for window in windows for edge in ((window.x0, window.x1) if sweep.frame.turns % 2 else (window.y0, window.y1))}
        assert all(edge % size == 0 or edge == sweep.frame.rows for edge in interior)
        if sweep is sweeps[0]:
            assert (found == cast_shadow(heights, (3, 2), sun)).all()


@given(rows=st.integers(1, 30), columns=st.integers(1, 30), azimuth=AZIMUTHS, cell=CELLS, data=st.data())
def test_windows_of_the_frame_are_windows_of_the_grid(
    rows: int, columns: int, azimuth: float, cell: tuple[float, float], data: Any
) -> None:
    grid = np.arange(rows * columns, dtype=np.float32).reshape(rows, columns)
    frame = frame_of(grid.shape, cell, azimuth)
    assert -1 <= frame.shift <= 1
    canonical = turned(grid, frame.turns)
    assert canonical.shape == (frame.rows, frame.columns)
    top, left = data.draw(st.integers(0, frame.rows - 1)), data.draw(st.integers(0, frame.columns - 1))
    bottom, right = data.draw(st.integers(top + 1, frame.rows)), data.draw(st.integers(left + 1, frame.columns))
    window = frame.grid_window((top, bottom), (left, right))
    part = turned(grid[window.y0 : window.y1, window.x0 : window.x1], frame.turns)
    assert (part == canonical[top:bottom, left:right]).all()
    assert plan_bands(frame, 7)[-1].stop == frame.rows


@pytest.mark.parametrize("turns", range(-4, 8))
@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (130, 64), (64, 130), (129, 65)])
def test_turns_are_those_of_numpy(turns: int, shape: tuple[int, int]) -> None:
    grid = np.random.default_rng(1).integers(0, 255, shape)
    heights, codes = grid.astype(np.float32), grid.astype(np.uint8)
    assert (turned(heights, turns) == np.rot90(heights, turns)).all()
    assert (turned(codes, turns) == np.rot90(codes, turns)).all()
    assert turned(heights, turns).flags.c_contiguous
    assert (transposed(heights) == heights.T).all()


def test_sines_are_exact_at_the_angles_that_matter() -> None:
    for quarter in range(-9, 9):
        base = sine_cosine_deg(90 * quarter)
        assert set(map(abs, base)) == {0.0, 1.0}
        for angle in (0.0, 12.25, 30.0, 44.75, 45.0, 60.0, 89.5):
            sine, cosine = sine_cosine_deg(angle)
            for _ in range(quarter % 4):
                sine, cosine = cosine, -sine
            assert sine_cosine_deg(angle + 90 * quarter) == (sine, cosine)
            assert math.isclose(sine, math.sin(math.radians(angle + 90 * quarter)), abs_tol=1e-14)
    assert tangent_deg(45) == 1
    assert tangent_deg(-45) == -1
    assert tangent_deg(90) == math.inf
    assert sine_cosine_deg(30)[0] == 0.5


def test_curvature_is_that_of_the_sphere_less_refraction() -> None:
    assert curvature_per_m(None) == 0
    assert curvature_per_m(Earth(refraction=0)) * 36e3**2 == pytest.approx(
        6_371_008.8 / math.cos(36e3 / 6_371_008.8) - 6_371_008.8, abs=2e-3
    )
    assert curvature_per_m(Earth(refraction=0.13)) == pytest.approx(0.87 * curvature_per_m(Earth(refraction=0)))


@pytest.mark.parametrize(
    "make",
    [
        lambda: SunPosition(math.nan, 10),
        lambda: SunPosition(math.inf, 10),
        lambda: SunPosition(10, 90.5),
        lambda: SunPosition(10, math.nan),
        lambda: Earth(refraction=1),
        lambda: Earth(radius_m=0),
        lambda: frame_of((5, 5), (0.0, 1.0), 10),
        lambda: frame_of((5, 5), (1.0, math.nan), 10),
        lambda: frame_of((0, 5), (1.0, 1.0), 10),
        lambda: frame_of((5, 5), (1.0, 1.0), math.nan),
        lambda: ShadowSweep((5, 5), (1, 1), SunPosition(1, 1), lines=0),
        lambda: ShadowSweep((5, 5), (1, 1), SunPosition(1, 1), lines=65),
        lambda: ShadowSweep((5, 5), (1, 1), SunPosition(1, 1), bias_m=-1),
        lambda: HorizonSweep((5, 5), (1, 1), 10, near_steps=-1),
        lambda: plan_bands(frame_of((5, 5), (1, 1), 10), 0),
    ],
)
def test_impossible_requests_are_refused(make: Any) -> None:
    with pytest.raises(UsageError, match=r"give|must be|no samples"):
        make()


def test_rows_must_fit() -> None:
    sweep = ShadowSweep((4, 5), (1, 1), SunPosition(0, 10))
    for rows in (np.zeros((2, 4), np.float32), np.zeros((2, 5)), np.zeros((5, 5), np.float32), np.zeros(5, np.float32)):
        with pytest.raises(ValueError, match="must be float32 of that width"):
            sweep.push(rows)  # type: ignore[arg-type]
    sweep.push(np.zeros((4, 5), np.float32))
    with pytest.raises(ValueError, match="rows from 4 on"):
        sweep.push(np.zeros((1, 5), np.float32))
    with pytest.raises(ValueError, match="needs heights of"):
        sweep_window(sweep.rays, Rect(0, 0, 2, 2), np.zeros((2, 2), np.float32), 1)
