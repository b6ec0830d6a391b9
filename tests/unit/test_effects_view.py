"""Bounds of the viewer: against points put through a camera, vertices of its own grids, and the noise it would add."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas import viewbounds
from tests.reference import effects as reference
from viewer.morph import alpha, ramp
from viewer.placement import GRID_SIDES, grid_origin

hundredths = st.integers(-100, 100).map(lambda n: n / 100)
metres = st.integers(1, 10_000).map(float)


@settings(max_examples=500)
@given(
    place=st.tuples(hundredths, hundredths),
    distance=metres,
    error=st.integers(1, 900).map(lambda n: n / 1000),
    turn=st.tuples(hundredths, st.integers(0, 628).map(lambda n: n / 100)),
    fov=st.sampled_from([20.0, 60.0, 90.0, 130.0]),
)
@example(place=(1.0, 1.0), distance=1000.0, error=0.01, turn=(0.55, 0.79), fov=90.0)
def test_no_displacement_shows_more(
    place: tuple[float, float], distance: float, error: float, turn: tuple[float, float], fov: float
) -> None:
    """A point anywhere in the picture, displaced in any direction; counted if it is still in the picture."""
    width, height = 1920, 1080
    focal, stretch = viewbounds.focal_px(width, fov), viewbounds.corner_stretch(width, height, fov)
    ray = np.array([place[0] * width / 2, place[1] * height / 2, focal])
    point = ray / np.linalg.norm(ray) * distance
    z, around = turn
    aside = math.sqrt(max(0.0, 1 - z * z))
    moved = point + error * distance * np.array([aside * math.cos(around), aside * math.sin(around), z])
    if moved[2] <= 0:
        return
    before, after = (focal * one[:2] / one[2] for one in (point, moved))
    if abs(after[0]) <= width / 2 and abs(after[1]) <= height / 2:
        shift = float(np.linalg.norm(after - before))
        assert shift <= viewbounds.shift_px(error * distance, distance, focal, stretch) * (1 + 1e-9)


def test_a_corner_shows_more_than_error_over_distance() -> None:
    """In the corner of a wide picture a small displacement shows as up to 1.44 times f e / d: the stretch is needed."""
    focal, stretch = viewbounds.focal_px(1920, 60), viewbounds.corner_stretch(1920, 1080, 60)
    assert stretch == pytest.approx(1.4388, abs=1e-3)
    point = np.array([960.0, 540.0, focal])
    distance = float(np.linalg.norm(point))
    outward = np.array([960.0, 540.0, -(960.0**2 + 540.0**2) / focal])
    moved = point - outward / np.linalg.norm(outward) * distance / 1000
    shift = float(np.linalg.norm(focal * moved[:2] / moved[2] - point[:2]))
    assert 1.4 * focal / 1000 < shift <= viewbounds.shift_px(1.0, 1000.0, focal, stretch)


def test_what_reaches_the_camera_has_no_bound() -> None:
    assert viewbounds.shift_px(10, 10, 1000) == math.inf
    assert viewbounds.shift_px(0, 0, 1000) == 0


@given(st.sampled_from(GRID_SIDES), st.integers(0, 8), st.integers(-(2**20), 2**20).map(lambda n: n / 64), st.integers(0, 2**12))
def test_levels_begin_no_nearer(n: int, level: int, viewer: float, place: int) -> None:
    """Vertices of the viewer's own grids: what they show of the next coarser level counts as much as at the first distance at most."""
    origin = grid_origin(viewer, n, level)
    vertex = place % n
    at = viewer / 2**level - origin
    shown = float(alpha(np.array([vertex]), np.array([0.0]) + at, (at, at), ramp(n))[0])
    distance = abs(vertex - at) * 2**level
    if shown > 0:
        assert shown / distance <= (1 + 1e-9) / viewbounds.first_distance_m(n, 2.0 ** (level + 1))


@given(st.lists(st.integers(0, 1000).map(float), min_size=1, max_size=6), st.sampled_from(GRID_SIDES))
def test_levels_add_up(differences: list[float], grid: int) -> None:
    jump, detail = (one(differences, 10.0, grid, 1000.0) for one in (viewbounds.geomorph_px, viewbounds.level_of_detail_px))
    assert jump <= detail
    for level, difference in enumerate(differences):
        assert jump >= viewbounds.shift_px(difference, viewbounds.first_distance_m(grid, 10.0 * 2 ** (level + 1)), 1000.0)
    assert viewbounds.geomorph_px([], 10.0, grid, 1000.0) == 0


@given(distance=st.integers(0, 10**6).map(float), visibility=metres, brightness=st.integers(0, 255), haze=st.integers(0, 255))
def test_haze(distance: float, visibility: float, brightness: int, haze: int) -> None:
    """Koschmieder: what is seen fades to the haze's own light."""
    left = math.exp(math.log(0.02) * distance / visibility) if distance < 20 * visibility else 0.0
    assert abs(left * brightness + (1 - left) * haze - brightness) <= viewbounds.haze_codes(distance, visibility) + 0.01


@given(codes=st.integers(1, 2540).map(lambda n: n / 10), visibility=metres)
def test_haze_distance_is_the_inverse(codes: float, visibility: float) -> None:
    assert viewbounds.haze_codes(viewbounds.haze_distance_m(codes, visibility), visibility) == pytest.approx(codes)


def test_one_code_of_haze_is_a_thousandth_of_the_visibility() -> None:
    assert viewbounds.haze_distance_m(1, 50_000) == pytest.approx(50.2, abs=0.1)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.sampled_from([0.5, 0.8, 1.0]))
def test_synthesis(seed: int, octaves: int, hurst: float) -> None:
    """Octaves of the largest deviates, with signs chosen at random, refined by the 4-point scheme along both axes."""
    rng = np.random.default_rng(seed)
    z = np.zeros((24, 24))
    for octave in range(1, octaves + 1):
        z = np.apply_along_axis(reference.four_point, 0, np.apply_along_axis(reference.four_point, 1, z))
        z = z + 4.0 * 2 ** (-hurst * octave) * rng.choice([-1.0, 1.0], z.shape)
    assert np.abs(z).max() <= viewbounds.synthesis_amplitude_m(1.0, hurst, octaves, 4.0)


def test_the_four_point_scheme_enlarges_no_more() -> None:
    """Sums of absolute weights of every sample of the first few steps, and how near they come to the constant."""
    norms = []
    columns = np.eye(40)
    for _ in range(9):
        columns = np.apply_along_axis(reference.four_point, 0, columns)
        norms.append(float(np.abs(columns).sum(axis=1).max()))
    assert norms[0] == 1.25
    assert 1.251 < max(norms) <= viewbounds.FOUR_POINT_NORM


@given(st.integers(1, 20_000).map(lambda n: n * 100.0), st.integers(-500, 8848).map(float))
def test_curvature(distance: float, height: float) -> None:
    """The point on a globe against the point on a map, in the plane through both and the centre."""
    radius = 6_371_008.8
    turn = distance / radius
    globe = np.array([(radius + height) * math.sin(turn), (radius + height) * math.cos(turn) - radius])
    moved = float(np.linalg.norm(globe - np.array([distance, height])))
    assert moved <= viewbounds.curvature_shift_m(distance, height, radius) * (1 + 1e-6) + 1e-6
