"""Kernels, decimation and cascade against the independent float64 reference, and the rules that make seams impossible."""

import os
import subprocess
import sys
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.lattice import Registration
from schemas.manifest import KernelName
from schemas.region import Rect
from tests.levels import KINDS, run_cascade
from tests.reference import kernels as reference_kernels
from tests.reference import pyramid as reference
from tests.reference.terrain import adversarial_heights, photo, terrain
from tiler.codecs import BlockFormat
from tiler.filters.cascade import Coverage, Values
from tiler.filters.kernels import DESIGNS, FIXED_RADIUS, blackman_sinc, covering, frequency_response
from tiler.tasks.rounding import round_samples

# Float32 keeps 24 bits: one halving rounds three times (two passes and the reference sample of each).
ULPS_PER_LEVEL = 4

# Samples that jump over the whole range also show the weights' grid of 2**-23, and levels that overshoot their input: 5.6 at most seen.
ADVERSARIAL_ULPS_PER_LEVEL = 8


def assert_close(found: Values, expected: NDArray[np.float64], level: int, scale: float, ulps: int = ULPS_PER_LEVEL) -> None:
    """Within ``ulps`` units in the last place of ``scale`` per level."""
    bound = ulps * max(level, 1) * float(np.spacing(np.float32(scale)))
    assert np.abs(found - expected).max() <= bound


@pytest.mark.parametrize(("radius", "registration"), list(product(range(1, 17), ("area", "point"))))
def test_kernel_weights_sum_to_exactly_one_in_float32(radius: int, registration: Registration) -> None:
    kernel = blackman_sinc(radius, registration)
    offsets, weights = kernel.taps()
    single = weights.astype(np.float32)
    assert (single == weights).all(), "every weight is a float32"
    for order in (slice(None), slice(None, None, -1)):
        assert np.cumsum(single[order], dtype=np.float32)[-1] == 1
    assert kernel.reach == (-offsets[0], offsets[-1])
    if registration == "point":
        assert weights[offsets == 0] == 0.5
        assert (offsets[offsets != 0] % 2 == 1).all(), "half-band: no even taps"
        assert frequency_response(kernel, np.array([1.0]))[0] == 0


@pytest.mark.parametrize(("radius", "registration"), list(product((1, 2, 3, 6, 8), ("area", "point"))))
def test_kernel_agrees_with_the_reference_design(radius: int, registration: Registration) -> None:
    offsets, weights = blackman_sinc(radius, registration).taps()
    expected_offsets, expected = reference_kernels.taps("blackman-sinc", radius, registration)
    by_offset = dict(zip(expected_offsets.tolist(), expected.tolist(), strict=True))
    assert max(abs(by_offset[offset] - weight) for offset, weight in zip(offsets.tolist(), weights, strict=True)) < 1e-6
    assert set(offsets.tolist()) >= {offset for offset, weight in by_offset.items() if abs(weight) > 1e-8}


def test_published_taps() -> None:
    """The r = 3 half-band as computed independently when clipmap was designed: 1/2, .2843711, -.0360899, .0017188."""
    assert blackman_sinc(3, "point").weights == pytest.approx((0.2843711, -0.0360899, 0.0017188), abs=5e-8)


@pytest.mark.parametrize(("name", "registration"), list(product(DESIGNS, ("area", "point"))))
def test_every_design_agrees_with_its_reference(name: KernelName, registration: Registration) -> None:
    radius = 1 if name in FIXED_RADIUS else 4
    reference_name = f"kaiser:{4 * radius / 3}" if name == "kaiser" else name
    offsets, weights = DESIGNS[name](radius, registration).taps()
    expected_offsets, expected = reference_kernels.taps(reference_name, radius, registration)
    by_offset = {offset: weight for offset, weight in zip(expected_offsets.tolist(), expected.tolist(), strict=True) if weight}
    assert set(by_offset) == set(offsets.tolist())
    assert max(abs(by_offset[offset] - weight) for offset, weight in zip(offsets.tolist(), weights, strict=True)) < 1e-6
    assert weights.sum() == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [0.0, 1.0, 255.0, 8848.86, -430.5, 1e9, 1e-40, -0.0])
@pytest.mark.parametrize("radius", [1, 3, 6])
def test_constant_is_bit_constant_on_every_level(kind: str, value: float, radius: int) -> None:
    constant = np.full((137, 201, 1), value, np.float32)
    for _, values, _ in run_cascade(constant, None, levels=8, kind=kind, radius=radius, portion=50):
        assert (values == np.float32(value)).all()


@pytest.mark.parametrize("radius", [1, 2, 3, 6])
def test_height_ramp_keeps_its_value_everywhere(radius: int) -> None:
    """Coarse sample i sits on fine sample 2i; antisymmetric reflection continues a ramp, so edges are exact too."""
    y, x = np.mgrid[0:301, 0:401]
    ramp = (3.7 * x + 1.3 * y + 5).astype(np.float32)[..., np.newaxis]
    for level, (_, values, _) in enumerate(run_cascade(ramp, None, levels=6, radius=radius)):
        step = 2**level
        expected = (3.7 * step * np.arange(values.shape[1]) + 1.3 * step * np.arange(values.shape[0])[:, np.newaxis] + 5)[..., np.newaxis]
        inside = np.s_[: (300 // step) + 1, : (400 // step) + 1]
        assert_close(values[inside], expected[inside], level, float(ramp.max()))


@pytest.mark.parametrize("radius", [1, 2, 3, 6])
def test_imagery_ramp_keeps_its_value_away_from_the_border(radius: int) -> None:
    """The centre of coarse cell i is at fine coordinate 2i + 1/2: half-pixel shifts would show as a constant offset."""
    y, x = np.mgrid[0:512, 0:768]
    ramp = (0.25 * x + 0.125 * y).astype(np.float32)[..., np.newaxis]
    for level, (_, values, _) in enumerate(run_cascade(ramp, None, levels=4, kind="imagery", radius=radius)):
        step, margin = 2**level, 4 * radius
        centre = (step - 1) / 2
        columns, rows = step * np.arange(values.shape[1]) + centre, step * np.arange(values.shape[0]) + centre
        expected = (0.25 * columns + 0.125 * rows[:, np.newaxis])[..., np.newaxis]
        inside = np.s_[margin:-margin, margin:-margin]
        assert_close(values[inside], expected[inside], level, float(ramp.max()))


def test_checkerboard_vanishes_exactly() -> None:
    """A half-band kernel has a response of exactly 0 at the Nyquist frequency, in float32 too."""
    board = (1 - 2 * (np.indices((96, 128)).sum(axis=0) % 2)).astype(np.float32)[..., np.newaxis]
    coarse = run_cascade(board, None, levels=2)[1][1]
    assert (coarse[6:-6, 6:-6] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("offset", "noise"), [(0.0, 1.0), (8848.0, 1.0), (1e7, 1.0), (0.0, 1e30), (0.0, 1e-30)])
def test_levels_agree_with_float64(kind: str, offset: float, noise: float) -> None:
    registration, edge = KINDS[kind]
    rng = np.random.default_rng(5)
    values = (offset + noise * rng.normal(size=(75, 90, 2))).astype(np.float32)
    expected = reference.pyramid(values.astype(np.float64), None, 5, kernel="blackman-sinc", radius=6, registration=registration, edge=edge)
    for level, (_, found, _) in enumerate(run_cascade(values, None, levels=5, kind=kind)):
        assert_close(found, expected[level][0], level, float(np.abs(values).max()), ADVERSARIAL_ULPS_PER_LEVEL)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("case", sorted(adversarial_heights(48, 52)))
def test_every_kernel_agrees_with_float64_on_adversarial_data(kind: str, name: KernelName, case: str) -> None:
    registration, edge = KINDS[kind]
    radius = 1 if name in FIXED_RADIUS else 3
    values = adversarial_heights(48, 52)[case].astype(np.float32)
    reference_name = f"kaiser:{4 * radius / 3}" if name == "kaiser" else name
    expected = reference.pyramid(
        values.astype(np.float64), None, 4, kernel=reference_name, radius=radius, registration=registration, edge=edge
    )
    for level, (_, found, _) in enumerate(run_cascade(values, None, levels=4, kind=kind, radius=radius, name=name)):
        assert_close(found, expected[level][0], level, float(np.abs(values).max()) + 1e-30, ADVERSARIAL_ULPS_PER_LEVEL)


@pytest.mark.parametrize("kind", KINDS)
def test_levels_do_not_shift(kind: str) -> None:
    """A wave that every level can hold keeps its phase: less than 0.001 sample of the level, six levels deep.

    A box-filtered level read as if its samples sat on every second one would be off by a quarter of a coarse sample per level.
    """
    size, wave_px = 2048, 512.0
    shift = 0.5 if kind == "imagery" else 0.0
    x = np.arange(size) + shift
    line = np.sin(2 * np.pi * x / wave_px + 0.3)
    values = np.broadcast_to(line.astype(np.float32)[np.newaxis, :, np.newaxis], (4, size, 1)).copy()
    for level, (_, found, _) in enumerate(run_cascade(values, None, levels=7, kind=kind, radius=6)):
        step = 2**level
        place = (np.arange(found.shape[1]) + shift) * step
        inside = slice(len(place) // 4, len(place) // 4 + round(wave_px / step))
        carrier = np.exp(-2j * np.pi * place[inside] / wave_px)
        phase = np.angle((found[0, inside, 0] * carrier).sum() * 1j)
        assert abs((phase - 0.3) * wave_px / (2 * np.pi)) / step < 0.001


@pytest.mark.parametrize("top", [255, 65535])
def test_no_level_is_biased(top: int) -> None:
    """Stored means stay within 0.01 of a code of the float32 means for ten levels; truncation would cost half a code at once.

    24 lines of a natural spectrum, 2**19 samples long: 12288 samples of rounding error remain on level 10, of which the mean
    strays by 0.0026.
    """
    frequency = np.fft.rfftfreq(2**19)[1:]
    rng = np.random.default_rng(6)
    block = BlockFormat("imagery", 64, 1, "uint8" if top == 255 else "uint16")
    bias = np.zeros(11)
    for _ in range(24):
        phases = np.exp(2j * np.pi * rng.random(frequency.size))
        line = np.fft.irfft(np.concatenate([[0], phases * frequency**-0.6]))
        values = (top * (0.5 + 0.1 * line / line.std())).astype(np.float32)
        levels = run_cascade(np.rint(values)[np.newaxis, :, np.newaxis], None, levels=11, kind="imagery", radius=3)
        for level, (_, found, _) in enumerate(levels):
            bias[level] += float((round_samples(found, None, block)[0].astype(np.float64) - found).mean()) / 24
    assert np.abs(bias).max() < 0.01
    assert np.abs(bias - 0.5).min() > 0.4, "truncation would show"


def test_kernels_give_the_same_without_compilation() -> None:
    """The loops as plain Python (NUMBA_DISABLE_JIT) pass the same checks: what is compiled is what is written."""
    chosen = "constant_is_bit or voids_agree or clamp_keeps or half_transparency or checkerboard"
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", f"({chosen}) and not without_compilation", __file__],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-3000:]
    assert " passed" in result.stdout


def test_large_offset_costs_no_accuracy() -> None:
    """Sums relative to a reference sample: at 1e7 (unit in the last place 1) the error stays below one unit."""
    values = (1e7 + np.random.default_rng(3).normal(size=(64, 64, 1))).astype(np.float32)
    expected = reference.pyramid(
        values.astype(np.float64), None, 2, kernel="blackman-sinc", radius=6, registration="point", edge="antisymmetric"
    )
    assert np.abs(run_cascade(values, None, levels=2)[1][1] - expected[1][0]).max() <= 1.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("void_share", [0.01, 0.3, 0.7, 0.95])
def test_voids_agree_with_float64(kind: str, void_share: float) -> None:
    registration, edge = KINDS[kind]
    rng = np.random.default_rng(11)
    coverage = (rng.random((60, 70)) >= void_share).astype(np.float32)
    values = (rng.uniform(100, 200, (60, 70, 3)) * coverage[..., np.newaxis]).astype(np.float32)
    expected = reference.pyramid(
        values.astype(np.float64), coverage.astype(np.float64), 4, kernel="blackman-sinc", radius=3, registration=registration, edge=edge
    )
    for level, (_, found, covered) in enumerate(run_cascade(values, coverage, levels=4, kind=kind, radius=3)):
        expected_coverage = expected[level][1]
        assert covered is not None
        assert expected_coverage is not None
        assert np.abs(covered - expected_coverage).max() < 1e-6
        assert ((covered > 0) == (expected_coverage > 0)).all()
        # The blend's slope in W (at most 3.75 per unit) carries the coverage's rounding into values.
        assert np.abs(found - expected[level][0]).max() < 2e-3


def test_thirty_percent_random_voids_leave_no_hole() -> None:
    """GDAL 3.6's Lanczos overview of this is 99 % void; a windowed sinc over voids without a guard leaves the range by far."""
    rng = np.random.default_rng(2)
    coverage = (rng.random((256, 256)) >= 0.3).astype(np.float32)
    values = (rng.uniform(1, 256, (256, 256, 1)) * coverage[..., np.newaxis]).astype(np.float32)
    for level, (_, found, covered) in enumerate(run_cascade(values, coverage, levels=5)):
        assert covered is not None
        if level:
            assert (covered > 0).all()
            assert found.min() > -60
            assert found.max() < 320


@pytest.mark.parametrize("kind", KINDS)
def test_what_lies_far_from_voids_is_not_changed_by_them(kind: str) -> None:
    """Windows without a void under their taps give the same bits as if the picture had no mask at all."""
    values = terrain(128, 160, seed=1).astype(np.float32)
    coverage = np.ones(values.shape[:2], np.float32)
    coverage[60:70, 70:80] = 0
    holed = np.where(coverage[..., np.newaxis] > 0, values, np.float32(0))
    plain, masked = (run_cascade(v, c, levels=2, kind=kind)[1] for v, c in ((values, None), (holed, coverage)))
    far: NDArray[np.bool_] = np.ones(plain[1].shape[:2], np.bool_)
    far[30 - 7 : 35 + 7, 35 - 7 : 40 + 7] = False
    assert (plain[1][far] == masked[1][far]).all()
    assert not np.array_equal(plain[1], masked[1])


def test_opaque_colour_beside_transparent_colour_leaves_no_fringe() -> None:
    coverage = np.zeros((64, 64), np.float32)
    coverage[:, :31] = 1
    values = np.zeros((64, 64, 3), np.float32)
    values[:, :31] = (200, 0, 0)
    for _, found, covered in run_cascade(values, coverage, levels=4, kind="imagery", radius=3):
        assert covered is not None
        assert np.abs(found[covered > 0] - np.array([200, 0, 0])).max() < 1e-3
        assert (found[covered == 0] == 0).all()


def test_even_half_transparency_is_as_sharp_as_opacity() -> None:
    """2026-11-22: the guard compared W itself, so a constant alpha of 0.5 fell back to the box filter (4.6 codes rms off)."""
    values = photo(96, 96, seed=4).astype(np.float32)
    opaque = run_cascade(values, None, levels=3, kind="imagery", radius=3)[2][1]
    half = run_cascade(values, np.full((96, 96), 0.5, np.float32), levels=3, kind="imagery", radius=3)[2][1]
    assert np.abs(opaque - half).max() < 1e-3


@st.composite
def pictures(draw: st.DrawFn) -> tuple[Values, Coverage | None, str, int, int]:
    """A picture, perhaps with voids, its kind, a kernel radius and a number of levels."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    height, width, channels = draw(st.integers(1, 80)), draw(st.integers(1, 80)), draw(st.integers(1, 3))
    values = (1000 + rng.normal(size=(height, width, channels))).astype(np.float32)
    void_share = draw(st.sampled_from([None, 0.02, 0.3, 0.95]))
    coverage = None if void_share is None else (rng.random((height, width)) >= void_share).astype(np.float32)
    if coverage is not None:
        values[coverage == 0] = 0
    return values, coverage, draw(st.sampled_from(sorted(KINDS))), draw(st.integers(1, 6)), draw(st.integers(2, 5))


@given(picture=pictures(), side=st.sampled_from([16, 32]), portion=st.integers(1, 40), pad=st.integers(0, 5), clamp=st.booleans())
@example(picture=(np.ones((1, 1, 1), np.float32), None, "height", 6, 5), side=16, portion=1, pad=0, clamp=False)
def test_any_window_gives_the_bits_of_the_whole(
    picture: tuple[Values, Coverage | None, str, int, int], side: int, portion: int, pad: int, clamp: bool
) -> None:
    """No seams, by construction: every window, however small and however it is fed, sees its real neighbours."""
    values, coverage, kind, radius, levels = picture
    height, width = values.shape[:2]
    whole = run_cascade(values, coverage, levels=levels, kind=kind, radius=radius, clamp=clamp)
    for y, x in product(range(0, height, side), range(0, width, side)):
        core = Rect(x, y, min(x + side, width), min(y + side, height))
        parts = run_cascade(values, coverage, levels=levels, kind=kind, radius=radius, core=core, pad=pad, clamp=clamp, portion=portion)
        for (held, found, covered), (_, expected, expected_covered) in zip(parts, whole, strict=True):
            window = np.s_[held.y0 : held.y1, held.x0 : held.x1]
            assert found.tobytes() == expected[window].tobytes()
            if covered is not None and expected_covered is not None:
                assert covered.tobytes() == expected_covered[window].tobytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("void_share", [0.0, 0.3])
def test_clamp_keeps_samples_in_the_range_of_their_support(kind: str, void_share: float) -> None:
    """Cliffs ring by 6 % of their height without it; the range is that of the valid samples under the taps, found by brute force."""
    rng = np.random.default_rng(6)
    values = np.where(rng.random((40, 50, 2)) < 0.5, 0, 1000).astype(np.float32)
    coverage = (rng.random((40, 50)) >= void_share).astype(np.float32)
    values[coverage == 0] = 0
    plain, clamped = (
        run_cascade(values, coverage if void_share else None, levels=2, kind=kind, radius=3, clamp=clamp)[1] for clamp in (False, True)
    )
    offsets, _ = blackman_sinc(3, KINDS[kind][0]).taps()
    assert (plain[1].min(), plain[1].max()) != (clamped[1].min(), clamped[1].max()), "the input rings"
    for j, i in np.ndindex(clamped[1].shape[:2]):
        rows, columns = ([index for index in 2 * place + offsets if 0 <= index < size] for place, size in ((j, 40), (i, 50)))
        support = values[np.ix_(rows, columns)][coverage[np.ix_(rows, columns)] > 0]
        if len(support):
            assert (clamped[1][j, i] == np.clip(plain[1][j, i], support.min(axis=0), support.max(axis=0))).all()


@pytest.mark.parametrize("turn", [np.flipud, np.fliplr, lambda picture: picture.swapaxes(0, 1)])
def test_imagery_symmetry(turn: Callable[[Values], Values]) -> None:
    """Mirroring commutes with filtering bit for bit; transposing up to rounding, as rows are filtered before columns."""
    values = photo(64, 64, seed=9).astype(np.float32)
    straight = run_cascade(values, None, levels=3, kind="imagery", radius=3)
    turned = run_cascade(np.ascontiguousarray(turn(values)), None, levels=3, kind="imagery", radius=3)
    for (_, found, _), (_, expected, _) in zip(turned, straight, strict=True):
        assert np.abs(found - turn(expected)).max() <= 4 * np.spacing(np.float32(255))


@pytest.mark.parametrize("registration", ["area", "point"])
def test_covering_kernel_is_positive_and_smallest(registration: Registration) -> None:
    offsets, weights = covering(registration).taps()
    assert weights.sum() == 1
    assert (weights > 0).all()
    assert len(offsets) == (2 if registration == "area" else 3)
