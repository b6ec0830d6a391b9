"""Taps and responses are right: published figures and exact identities."""

import itertools

import numpy as np
import pytest

from tests.reference.kernels import Array, Registration, frequency_response, l1_norm, taps

BLACKMAN = "blackman-sinc"
ALL_TAPS = [
    (kernel, radius, registration)
    for kernel, radii in ((BLACKMAN, range(1, 17)), ("lanczos", (2, 3)), ("kaiser:4", (3,)), ("kaiser:8", (6,)), ("box", (1,)))
    for radius, registration in itertools.product(radii, ("area", "point"))
]


def decibel(response: Array) -> Array:
    return np.asarray(20 * np.log10(np.abs(response)), np.float64)


def test_published_taps_of_the_half_band_of_radius_3() -> None:
    offsets, weights = taps(BLACKMAN, 3, "point")
    assert offsets.tolist() == list(range(-5, 6))
    half = [0.5, 0.2843711, 0, -0.0360899, 0, 0.0017188]
    assert weights == pytest.approx(half[:0:-1] + half, abs=5.1e-8)


def test_published_taps_between_two_samples_of_radius_1() -> None:
    # By hand: x = 0.5 and 1.5, t = x / 2; sinc 0.9003163, 0.3001054; window 0.7735534, 0.0664466.
    offsets, weights = taps(BLACKMAN, 1, "area")
    assert offsets.tolist() == [-1, 0, 1, 2]
    inner, outer = 0.9003163 * 0.7735534, 0.3001054 * 0.0664466
    assert weights[2:] == pytest.approx([inner / (inner + outer) / 2, outer / (inner + outer) / 2], abs=1e-7)


def test_simple_kernels() -> None:
    assert taps("box", 1, "area")[1].tolist() == [0, 0.5, 0.5, 0]
    assert taps("triangle", 1, "point")[1].tolist() == [0.25, 0.5, 0.25]
    assert taps("triangle", 1, "area")[1].tolist() == [0.125, 0.375, 0.375, 0.125]


@pytest.mark.parametrize(("kernel", "radius", "registration"), ALL_TAPS)
def test_taps_are_symmetric_and_sum_to_exactly_one(kernel: str, radius: int, registration: Registration) -> None:
    offsets, weights = taps(kernel, radius, registration)
    assert len(weights) == 4 * radius - (registration == "point")
    assert np.diff(offsets).tolist() == [1] * (len(offsets) - 1)
    assert weights.tolist() == weights[::-1].tolist()
    assert sum(weights.tolist()) == sum(sorted(weights.tolist())) == 1.0


@pytest.mark.parametrize(("kernel", "radius"), [(kernel, radius) for kernel, radius, registration in ALL_TAPS if registration == "point"])
def test_half_band_is_exact(kernel: str, radius: int) -> None:
    offsets, weights = taps(kernel, radius, "point")
    assert weights[offsets == 0].tolist() == [0.5]
    assert not weights[(offsets % 2 == 0) & (offsets != 0)].any()
    assert weights[offsets % 2 == 1].sum() == 0.5


@pytest.mark.parametrize(
    ("kernel", "radius", "registration", "words"),
    [("sinc", 3, "area", "unknown"), ("box", 2, "area", "radius 1"), (BLACKMAN, 0, "point", "at least 1")],
)
def test_kernels_that_do_not_exist(kernel: str, radius: int, registration: Registration, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        taps(kernel, radius, registration)


@pytest.mark.parametrize(("kernel", "radius", "registration"), ALL_TAPS)
def test_response_at_zero_and_at_fine_nyquist(kernel: str, radius: int, registration: Registration) -> None:
    zero, nyquist = frequency_response(kernel, radius, registration, [0.0, 1.0])
    assert zero == pytest.approx(1.0, abs=1e-15)
    assert abs(nyquist) < 1e-15
    offsets, weights = taps(kernel, radius, registration)
    assert (weights * np.where(offsets % 2 == 0, 1, -1)).sum() == 0.0


def test_half_band_response_is_antisymmetric_about_coarse_nyquist() -> None:
    u = np.linspace(0, 0.5, 11)
    both = frequency_response(BLACKMAN, 6, "point", u) + frequency_response(BLACKMAN, 6, "point", 1 - u)
    assert both == pytest.approx(np.ones(11), abs=1e-15)


@pytest.mark.parametrize(
    ("kernel", "radius", "registration", "quarter_db", "two_fifths_db", "l1"),
    [
        (BLACKMAN, 2, "point", -1.17, -3.47, 1.029),
        (BLACKMAN, 3, "point", -0.44, -2.64, 1.144),
        (BLACKMAN, 4, "point", -0.10, -1.91, 1.238),
        (BLACKMAN, 6, "point", -0.002, -0.89, 1.369),
        (BLACKMAN, 8, "point", 0.001, -0.34, 1.462),
        (BLACKMAN, 3, "area", -0.44, -2.64, 1.230),
        (BLACKMAN, 6, "area", -0.003, -0.89, 1.543),
        ("box", 1, "area", -0.69, -1.84, 1.0),
        ("triangle", 1, "point", -1.38, -3.68, 1.0),
        ("lanczos", 3, "point", 0.10, -1.69, 1.272),
        ("lanczos", 3, "area", 0.10, -1.69, 1.403),
        ("kaiser:4", 3, "point", 0.007, -1.67, 1.268),
        ("kaiser:8", 6, "area", 0.0, -0.80, 1.560),
    ],
)
def test_response_and_norm_figures(
    *, kernel: str, radius: int, registration: Registration, quarter_db: float, two_fifths_db: float, l1: float
) -> None:
    at_quarter, at_two_fifths = decibel(frequency_response(kernel, radius, registration, [0.25, 0.40]))
    fine = abs(quarter_db) < 0.01
    assert at_quarter == pytest.approx(quarter_db, abs=0.00051 if fine else 0.0051)
    assert at_two_fifths == pytest.approx(two_fifths_db, abs=0.0051)
    assert l1_norm(kernel, radius, registration) == pytest.approx(l1, abs=0.00051)
