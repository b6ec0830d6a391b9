"""The accuracy experiments against independent references: what is ideal, what is measured, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.lattice import Registration
from schemas.manifest import KernelName, LayerKind
from tests.reference import kernels as reference_kernels
from tests.reference import pyramid as reference
from tests.reference.pyramid import void_gain_bound
from tests.reference.terrain import photo, terrain
from tiler.accuracy import plain, rivals
from tiler.accuracy.experiments import (
    Candidate,
    default_kernel,
    kernels_of,
    measure_candidates,
    rms_of,
    run_cascade,
    timed,
)
from tiler.accuracy.ideal import MARGIN, band_limited, ideal_level, interior, power_law_terrain
from tiler.accuracy.precision import measure_precision
from tiler.accuracy.response import figures
from tiler.accuracy.sample import Sample, built_in
from tiler.accuracy.voids import measure_voids
from tiler.filters.edges import EdgeRule
from tiler.filters.kernels import DESIGNS, blackman_sinc

Array = NDArray[np.float64]
KINDS: tuple[LayerKind, ...] = ("height", "imagery")
RULES: list[tuple[Registration, EdgeRule]] = [("point", "antisymmetric"), ("area", "mirror")]


def heights(side: int, seed: int = 1) -> Sample:
    return Sample("heights", "height", terrain(side + 1, side + 1, seed).astype(np.float32))


def imagery(side: int) -> Sample:
    return Sample("imagery", "imagery", photo(side, side)[..., :1].astype(np.float32))


@pytest.fixture(scope="module")
def known() -> Sample:
    return built_in(512)


@pytest.fixture(scope="module")
def known_candidates(known: Sample) -> dict[str, Candidate]:
    return {candidate.name: candidate for candidate in measure_candidates(known, runs=1)}


# The ideal level


def wave(cycles: float, places: NDArray[np.floating], edge: EdgeRule, size: int) -> Array:
    """One term of the series that an edge rule makes of a line of ``size`` samples, at any place."""
    if edge == "mirror":
        return np.asarray(np.cos(np.pi * cycles * (places + 0.5) / size), np.float64)
    return np.asarray(np.sin(np.pi * cycles * places / (size - 1)), np.float64)


@pytest.mark.parametrize(("registration", "edge"), RULES)
@pytest.mark.parametrize("level", [1, 2, 3])
def test_ideal_level_keeps_what_it_can_hold_and_nothing_else(registration: Registration, edge: EdgeRule, level: int) -> None:
    size = 129 if edge == "antisymmetric" else 128
    step = 2**level
    places = step * np.arange(-(-size // step)) + ((step - 1) / 2 if registration == "area" else 0.0)
    fine = np.arange(size, dtype=np.float64)
    limit = 128 >> level
    for cycles, gain in ((3, 1.0), (limit - 1, 1.0), (limit, 0.5), (limit + 1, 0.0), (127, 0.0)):
        values = np.outer(wave(cycles, fine, edge, size), wave(2, fine, edge, size))[..., np.newaxis]
        expected = gain * np.outer(wave(cycles, places, edge, size), wave(2, places, edge, size))
        assert np.abs(ideal_level(values, level, registration, edge)[..., 0] - expected).max() < 1e-12


def test_ideal_level_of_a_plane_is_the_plane() -> None:
    y, x = np.mgrid[0:97, 0:65]
    plane = (3.0 * x - 7.0 * y + 100.0)[..., np.newaxis]
    assert np.abs(ideal_level(plane, 3, "point", "antisymmetric") - plane[::8, ::8]).max() < 1e-9


@pytest.mark.parametrize(("registration", "edge"), RULES)
def test_the_border_hardly_matters_inside(registration: Registration, edge: EdgeRule) -> None:
    """What lies beyond a small crop changes its ideal level by a quarter of what the default kernel errs: its rms by 3 %."""
    whole = terrain(769, 769, seed=3)
    start, side = 256, 257
    crop = np.ascontiguousarray(whole[start : start + side, start : start + side])
    alone = ideal_level(crop, 1, registration, edge)
    placed = ideal_level(whole, 1, registration, edge)[start // 2 :, start // 2 :][: alone.shape[0], : alone.shape[1]]
    error = rms_of(interior(plain.halved(crop, blackman_sinc(6, registration), edge) - alone))
    assert rms_of(interior(alone - placed)) < 0.3 * error


def test_the_built_in_terrain_has_the_spectrum_it_claims() -> None:
    values = power_law_terrain(64, exponent=3.0, rms=400.0)
    assert values.shape == (65, 65, 1)
    assert (values[-1] == values[0]).all()
    power = np.abs(np.fft.fft2(values[:-1, :-1, 0])) ** 2
    ratio = power[0, 4] / power[0, 8]
    assert ratio == pytest.approx(2.0**3, rel=1e-9)
    assert power[3, 4] / power[0, 10] == pytest.approx(2.0**3, rel=1e-9)
    assert values[:-1, :-1].std() == pytest.approx(400)


# Kernels and loops


@pytest.mark.parametrize(("registration", "edge"), RULES)
@pytest.mark.parametrize("radius", [1, 3, 6])
def test_plain_and_shipped_levels_agree_with_the_reference(registration: Registration, edge: EdgeRule, radius: int) -> None:
    values = terrain(75, 91).astype(np.float32)
    expected = reference.pyramid(
        values.astype(np.float64), None, 4, kernel="blackman-sinc", radius=radius, registration=registration, edge=edge
    )[1:]
    kernel = blackman_sinc(radius, registration)
    double = plain.levels(values.astype(np.float64), kernel, edge, 3)
    shipped = run_cascade(values, None, kernel, edge, 3)
    scale = float(np.abs(values).max())
    for (reference_level, _), in_double, (in_single, coverage) in zip(expected, double, shipped, strict=True):
        assert coverage is None
        # Taps are rounded to multiples of 2**-23; the reference's are not.
        assert np.abs(in_double - reference_level).max() < 4e-6 * scale
        assert np.abs(in_single - reference_level).max() < 8e-6 * scale


@pytest.mark.parametrize("registration", ["point", "area"])
@pytest.mark.parametrize(("name", "radius"), [("blackman-sinc", 3), ("blackman-sinc", 6), ("lanczos", 4), ("box", 1)])
def test_figures_agree_with_the_reference_design(name: KernelName, radius: int, registration: Registration) -> None:
    found = figures(DESIGNS[name](radius, registration))
    offsets, weights = reference_kernels.taps(name, radius, registration)
    if name == "box" and registration == "point":
        offsets, weights = reference_kernels.positive_taps("point")
    distance = offsets - (0.5 if registration == "area" else 0.0)

    def gain(u: NDArray[np.float64]) -> Array:
        return np.asarray((weights * np.exp(1j * np.pi * np.outer(u, distance))).sum(axis=1).real, np.float64)

    def decibel(u: NDArray[np.float64]) -> float:
        return float(20 * np.log10(np.abs(gain(u)).max()))

    assert found.taps == np.count_nonzero(weights)
    assert found.dc_gain == 1
    assert found.droop_quarter_db == pytest.approx(decibel(np.array([0.25])), abs=1e-3)
    assert found.droop_passband_db == pytest.approx(decibel(np.array([0.4])), abs=1e-3)
    assert found.stopband_db == pytest.approx(decibel(np.linspace(0.6, 1, 5001)), abs=0.01)
    assert found.far_stopband_db == pytest.approx(decibel(np.linspace(0.75, 1, 5001)), abs=0.05)
    assert found.l1_norm == pytest.approx(np.abs(weights).sum() ** 2, rel=1e-5)
    steps = [weights[cut:].sum() for cut in range(len(weights))]
    assert found.step_overshoot_percent == pytest.approx(100 * (max(steps) - 1), abs=1e-3)


def test_no_two_kernels_have_the_same_taps() -> None:
    """Of radius 1 all half-bands are (1, 2, 1) / 4: measured once, as box."""
    for kind, count in (("height", 22), ("imagery", 26)):
        sample = Sample("", "height" if kind == "height" else "imagery", np.zeros((97, 97, 1), np.float32))
        kernels = kernels_of(sample)
        assert len(kernels) == count == len({kernel.weights for kernel in kernels.values()})
        assert "box" in kernels


# Errors


@pytest.mark.parametrize("name", ["box", "blackman-sinc 3", "blackman-sinc 6", "kaiser 3", "lanczos 8"])
def test_measured_errors_are_those_the_spectrum_predicts(known_candidates: dict[str, Candidate], name: str) -> None:
    """By Parseval's theorem, from taps and spectrum alone, without filtering a sample; 4 % for what the border adds to the sharpest."""
    candidate = known_candidates[name]
    first = candidate.errors[0]
    assert candidate.predicted_droop_rms == pytest.approx(first.droop_rms, rel=0.04)
    assert candidate.predicted_alias_rms == pytest.approx(first.alias_rms, rel=0.04)


def test_droop_and_alias_are_the_parts_of_the_error(known_candidates: dict[str, Candidate]) -> None:
    for candidate in known_candidates.values():
        for error in candidate.errors:
            assert error.rms <= error.p999 <= error.largest
            if error.droop_rms is not None and error.alias_rms is not None and error.rms_float64 is not None:
                # They share no frequency but through aliasing, so they are nearly uncorrelated.
                assert np.hypot(error.droop_rms, error.alias_rms) == pytest.approx(error.rms_float64, rel=0.05)


def test_errors_are_those_of_the_reference(known: Sample, known_candidates: dict[str, Candidate]) -> None:
    values = known.values.astype(np.float64)
    levels = reference.pyramid(values, None, 4, kernel="blackman-sinc", radius=6, registration="point", edge="antisymmetric")
    for level, error in enumerate(known_candidates["blackman-sinc 6"].errors, start=1):
        expected = rms_of(interior(levels[level][0] - ideal_level(values, level, "point", "antisymmetric")))
        assert error.level == level
        assert error.rms == pytest.approx(expected, rel=1e-4)
        assert error.rms_float64 == pytest.approx(expected, rel=1e-4)


def test_float16_samples_cost_more_than_float32_ones() -> None:
    """At 2000 m float16 resolves 1 m (0.29 m rms); the kernel's own error is larger, but the rounding must show beside it."""
    sample = heights(160)
    sample = replace(sample, values=sample.values * np.float32(0.02) + np.float32(1500))
    default = next(one for one in measure_candidates(sample, 1) if one.name == "blackman-sinc 6")
    assert default.errors[0].rms_float16 is not None
    assert default.errors[0].rms_float16 > 1.05 * default.errors[0].rms
    too_high = replace(sample, values=sample.values + np.float32(70000))
    assert all(one.errors[0].rms_float16 is None for one in measure_candidates(too_high, 1))


def test_openimageio_halves_about_the_place_it_is_compared_at() -> None:
    """Were it off by half a sample, its Lanczos would err as much as taking every second sample does."""
    sample = imagery(192)
    by_name = {one.name: one for one in measure_candidates(sample, 1)}
    assert by_name["OpenImageIO lanczos3"].errors[0].rms == pytest.approx(by_name["lanczos 3"].errors[0].rms, rel=0.02)
    assert by_name["OpenImageIO box"].errors[0].rms == pytest.approx(by_name["box"].errors[0].rms, rel=1e-3)


def test_levels_get_fewer_on_small_samples() -> None:
    assert [heights(side).level_count for side in (96, 192, 384, 800)] == [1, 2, 3, 3]


def test_times_are_of_every_run() -> None:
    calls: list[str] = []
    times = timed({"a": lambda: calls.append("a"), "b": lambda: sum(range(400_000))}, 3)
    assert [len(runs) for runs in times.values()] == [3, 3]
    assert len(calls) > 100, "what is short is repeated"
    assert min(times["b"]) > 10 * min(times["a"])


# Precision and voids


def test_differences_to_a_reference_sample_keep_precision_at_large_offsets() -> None:
    rungs = measure_precision(heights(192))
    assert {rung.offset for rung in rungs} == {0.0, 1e5, 1e7}
    for rung in rungs:
        assert rung.shipped_largest < 2 * rung.spacing
        assert rung.shipped_rms < 0.7 * rung.plain_rms
        assert 0 < rung.shipped_rms <= rung.shipped_largest


@pytest.mark.parametrize("kind", KINDS)
def test_voids(kind: LayerKind) -> None:
    sample = heights(128) if kind == "height" else imagery(128)
    results = {(one.pattern, one.share, one.filter.split()[0] + one.filter.split()[1][:7]): one for one in measure_voids(sample)}
    ours, gdal = "clipmapblackma", "GDALlanczos"
    whole = results["scattered", 0.0, ours]
    expected = next(one for one in measure_candidates(sample, 1) if one.name == f"blackman-sinc {default_kernel(sample).radius}")
    assert (whole.hole_share, whole.lost_share) == (0, 0)
    assert whole.rms == pytest.approx(expected.errors[0].rms, rel=1e-6)
    assert whole.whole_rms == whole.rms
    assert all(one.lost_share == 0 for key, one in results.items() if key[2] == ours)
    assert results["scattered", 0.3, gdal].lost_share > 0.9, "what GDAL issues 14560 and 14572 are about"
    assert results["scattered", 0.0, gdal].lost_share == 0
    assert results["scattered", 0.3, "GDALaverage"].lost_share == 0
    for one in results.values():
        assert 0 <= one.lost_share <= one.hole_share <= 1
        assert (one.rms is None) == (one.hole_share == 1)


def test_void_figures_by_hand() -> None:
    """A void of 3 x 3 around a coarse vertex leaves one hole; the samples that see it overshoot no more than the bound says."""
    values = terrain(65, 65).astype(np.float32)
    coverage = np.ones((65, 65), np.float32)
    coverage[31:34, 31:34] = 0
    values[coverage == 0] = 0
    kernel = blackman_sinc(6, "point")
    coarse, covered = run_cascade(values, coverage, kernel, "antisymmetric", 1)[0]
    assert covered is not None
    assert (covered == 0).sum() == 1
    assert covered[16, 16] == 0
    bound = void_gain_bound(reference_kernels.l1_norm("blackman-sinc", 6, "point")) * np.abs(values).max()
    assert np.abs(interior(coarse)).max() <= bound


def test_gdal_overviews_mark_their_voids() -> None:
    values = np.arange(64, dtype=np.float32).reshape(8, 8)
    valid = np.ones((8, 8), np.bool_)
    valid[:2, :2] = False
    coarse, held = rivals.gdal_overview(values, valid, "average")
    assert held.sum() == 15
    assert not held[0, 0]
    assert coarse[3, 3] == values[6:, 6:].mean()


def test_margins_hold_every_reach() -> None:
    """Radius 8 sees 15 samples of the finer level: with all levels added up less than the margin in coarse samples."""
    size = 257
    impulse = np.zeros((size, size, 1))
    impulse[0] = 1.0
    for level, values in enumerate(plain.levels(impulse, blackman_sinc(8, "point"), "mirror", 3), start=1):
        assert np.count_nonzero(values), level
        assert not interior(values).any()
    assert MARGIN == 16


@pytest.mark.parametrize("edge", ["antisymmetric", "mirror"])
@pytest.mark.parametrize(("cycles", "gain"), [(31, 1.0), (32, 0.5), (33, 0.0)])
def test_band_limited_halves_what_lies_at_the_limit(edge: EdgeRule, cycles: int, gain: float) -> None:
    """Droop and alias share it. On the level itself it does not show: there it is 0 at every sample."""
    size = 129 if edge == "antisymmetric" else 128
    line = wave(cycles, np.arange(size, dtype=np.float64), edge, size)
    values = np.outer(line, np.ones(size))[..., np.newaxis]
    assert np.abs(band_limited(values, 2, edge) - gain * values).max() < 1e-12
