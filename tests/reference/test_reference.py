"""The reference pyramid is right: exact identities, a loop over the 2-D definition, and the proven bound."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.reference.edges import Edge, extend
from tests.reference.kernels import Array, Registration, frequency_response, l1_norm, positive_taps, taps
from tests.reference.pyramid import coarsen, guard_blend, pyramid, quantise, stored_alpha, void_gain_bound
from tests.reference.terrain import adversarial_heights, adversarial_masks, impulse, ramp, terrain

BLACKMAN = "blackman-sinc"
Setting = tuple[Registration, Edge, int]
HEIGHTS: Setting = ("point", "antisymmetric", 6)
IMAGERY: Setting = ("area", "mirror", 3)
LIGHT: Setting = ("point", "mirror-sample", 3)
SETTINGS = pytest.mark.parametrize(("registration", "edge", "radius"), [HEIGHTS, IMAGERY, LIGHT, ("point", "mirror", 3)])


@SETTINGS
def test_a_cosine_comes_out_scaled_by_the_response(registration: Registration, edge: Edge, radius: int) -> None:
    u, n = 0.3, 96
    shift = 0.5 if registration == "area" else 0.0
    fine = np.cos(np.pi * u * (np.arange(n) - shift))
    values, _ = coarsen(np.tile(fine[None, :, None], (4, 1, 1)), None, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    inner = slice(radius, n // 2 - radius)
    expected = frequency_response(BLACKMAN, radius, registration, u) * np.cos(2 * np.pi * u * np.arange(n // 2))
    assert values[0, inner, 0] == pytest.approx(expected[inner], abs=1e-14)


# Edges


def test_antisymmetric_edge_by_hand() -> None:
    values = np.array([1.0, 2.0, 5.0])[:, None, None]
    extended, cover = extend(values, np.array([1.0, 0.5, 0.25])[:, None, None], (3, 3), "antisymmetric")
    # 2*1-2=0, 2*1-5=-3, then z[3] = 2*5-2 = 8, so z[-3] = 2*1-8 = -6; right: 8, 9, z[5] = 2*5-z[-1] = 10.
    assert extended[:, 3, 0].tolist() == [-6, -3, 0, 1, 2, 5, 8, 9, 10]
    assert cover[:, 3, 0].tolist() == [0.25, 0.25, 0.5, 1, 0.5, 0.25, 0.25, 0.25, 0.25]


def test_mirror_edge_by_hand() -> None:
    values = np.array([1.0, 2.0, 5.0])[None, :, None]
    extended, cover = extend(values, values / 5, (4, 8), "mirror")
    assert extended[0, :, 0].tolist() == [5, 5, 2, 1, 1, 2, 5, 5, 2, 1, 1, 2, 5, 5, 2]
    assert cover[0, :, 0].tolist() == (extended[0, :, 0] / 5).tolist()


def test_sample_mirror_edge_by_hand() -> None:
    values, cover = np.array([[[3.0], [5.0], [9.0]]]), np.array([[[1.0], [0.5], [0.0]]])
    extended, weight = extend(values, cover, (2, 5), "mirror-sample")
    assert extended[0, :, 0].tolist() == [9, 5, 3, 5, 9, 5, 3, 5, 9, 5]
    assert weight[0, :, 0].tolist() == [0, 0.5, 1, 0.5, 0, 0.5, 1, 0.5, 0, 0.5]


@pytest.mark.parametrize("edge", ["antisymmetric", "mirror", "mirror-sample"])
def test_a_single_sample_is_repeated(edge: Edge) -> None:
    extended, _ = extend(np.full((1, 1, 2), 7.0), np.ones((1, 1, 1)), (5, 6), edge)
    assert extended.shape == (12, 12, 2)
    assert (extended == 7.0).all()


def test_axes_may_be_extended_in_either_order() -> None:
    rng = np.random.default_rng(5)
    values, cover = rng.standard_normal((4, 3, 1)), rng.random((4, 3, 1))
    extended, extended_cover = extend(values, cover, (7, 8), "antisymmetric")
    swapped, swapped_cover = extend(values.swapaxes(0, 1), cover.swapaxes(0, 1), (7, 8), "antisymmetric")
    assert extended == pytest.approx(swapped.swapaxes(0, 1), abs=1e-12)
    assert extended_cover.tolist() == swapped_cover.swapaxes(0, 1).tolist()


# Reduction without voids


@given(height=st.integers(1, 40), width=st.integers(1, 40))
def test_every_level_is_half_rounded_up(height: int, width: int) -> None:
    levels = pyramid(np.zeros((height, width, 1)), None, 4, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")
    assert [values.shape for values, _ in levels] == [(-(-height >> n), -(-width >> n), 1) for n in range(4)]


@SETTINGS
def test_a_constant_stays(registration: Registration, edge: Edge, radius: int) -> None:
    levels = pyramid(np.full((21, 34, 2), 8848.86), None, 6, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    for values, coverage in levels:
        assert values == pytest.approx(np.full(values.shape, 8848.86), rel=1e-14)
        assert coverage is None


@given(height=st.integers(2, 40), width=st.integers(2, 40), radius=st.integers(1, 8))
def test_planes_and_twists_stay_up_to_the_edge_of_heights(height: int, width: int, radius: int) -> None:
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    surface = (3.0 - 2.0 * row + 5.0 * column + 0.25 * row * column)[:, :, None]
    values, _ = coarsen(surface, None, kernel=BLACKMAN, radius=radius, registration="point", edge="antisymmetric")
    assert values == pytest.approx(surface[::2, ::2], abs=1e-9)


def test_a_plane_stays_inside_imagery_and_sits_between_the_samples() -> None:
    plane = ramp(60, 50, right=3.0, down=-2.0, start=10.0)
    values, _ = coarsen(plane, None, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")
    expected = ramp(30, 25, right=6.0, down=-4.0, start=10.0 + 1.5 - 1.0)
    assert values[3:-3, 3:-3] == pytest.approx(expected[3:-3, 3:-3], abs=1e-11)
    assert values[0, 0] != pytest.approx(expected[0, 0], abs=1e-3)  # the mirror bends a plane at the edge


@SETTINGS
def test_every_inner_sample_counts_a_quarter(registration: Registration, edge: Edge, radius: int) -> None:
    for row, column in itertools.product((30, 31), repeat=2):
        values, _ = coarsen(impulse(60, 64, row, column), None, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
        assert values.sum() == pytest.approx(0.25, abs=1e-15)


def test_an_impulse_shows_the_taps() -> None:
    offsets, weights = taps(BLACKMAN, 3, "area")
    values, _ = coarsen(impulse(40, 40, 20, 21), None, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")
    kernel = dict(zip(offsets.tolist(), weights.tolist(), strict=True))
    expected = [[kernel.get(20 - 2 * i, 0.0) * kernel.get(21 - 2 * j, 0.0) for j in range(20)] for i in range(20)]
    assert values[:, :, 0] == pytest.approx(np.array(expected), abs=1e-17)


def test_imagery_of_even_size_keeps_its_mean() -> None:
    image = np.random.default_rng(2).random((32, 18, 3))
    values, _ = coarsen(image, None, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")
    assert values.mean(axis=(0, 1)) == pytest.approx(image.mean(axis=(0, 1)), abs=1e-14)


@pytest.mark.parametrize("registration", ["area", "point"])
def test_a_checkerboard_becomes_its_mean(registration: Registration) -> None:
    board = adversarial_heights(64, 64)["checkerboard"]
    values, _ = coarsen(board, None, kernel=BLACKMAN, radius=6, registration=registration, edge="mirror")
    assert values[6:-6, 6:-6] == pytest.approx(np.zeros((20, 20, 1)), abs=1e-11)


# Voids


def loop(values: Array, cover: Array, kernel: str, setting: Setting) -> tuple[Array, Array]:
    """``coarsen`` written as the definition reads: a double sum per output sample, plain Python numbers."""
    registration, edge, radius = setting
    sharp, positive = taps(kernel, radius, registration), positive_taps(registration)
    before, after = -int(sharp[0][0]), int(sharp[0][-1])
    z, c = extend(np.where(cover[:, :, None] > 0, values, 0.0), cover[:, :, None], (before, after), edge)
    height, width = -(-values.shape[0] // 2), -(-values.shape[1] // 2)
    result, result_cover = np.zeros((height, width, values.shape[2])), np.zeros((height, width))

    def sums(taps_1d: tuple[np.typing.NDArray[np.int64], Array], i: int, j: int, k: int) -> tuple[float, float, bool, float]:
        covered = weighted = peak = 0.0
        complete = True
        for (dy, wy), (dx, wx) in itertools.product(zip(*taps_1d, strict=True), repeat=2):
            here = float(c[before + 2 * i + dy, before + 2 * j + dx, 0])
            covered += wy * wx * here
            weighted += wy * wx * here * float(z[before + 2 * i + dy, before + 2 * j + dx, k])
            complete &= here == 1 or wy * wx == 0
            peak = max(peak, here) if wy * wx != 0 else peak
        return covered, weighted, complete, peak

    for i, j, k in np.ndindex(result.shape):
        w, n, complete, peak = sums(sharp, i, j, k)
        wp, p, _, _ = sums(positive, i, j, k)
        result_cover[i, j] = wp
        if wp == 0:
            continue
        u = min(1.0, max(0.0, (w / peak - 0.5) / 0.4))
        t = u * u * (3 - 2 * u)
        result[i, j, k] = n if complete else p / wp if w / peak <= 0.5 else (1 - t) * p / wp + t * n / w
    return result, result_cover


@pytest.mark.parametrize("setting", [HEIGHTS, IMAGERY, ("point", "antisymmetric", 1), ("area", "mirror", 2)])
@pytest.mark.parametrize("valid", [0.2, 0.7, 0.98])
def test_voids_follow_the_definition(setting: Setting, valid: float) -> None:
    rng = np.random.default_rng(11)
    values = rng.standard_normal((9, 14, 2))
    mask = rng.random((9, 14)) < valid
    for cover in (mask.astype(np.float64), mask * rng.random((9, 14))):
        expected, expected_cover = loop(values, cover, BLACKMAN, setting)
        registration, edge, radius = setting
        found, found_cover = coarsen(values, cover, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
        assert found == pytest.approx(expected, abs=1e-12)
        assert found_cover == pytest.approx(expected_cover, abs=1e-15)


@SETTINGS
def test_full_coverage_is_the_plain_filter(registration: Registration, edge: Edge, radius: int) -> None:
    values = terrain(33, 47)
    plain, _ = coarsen(values, None, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    found, cover = coarsen(values, np.ones((33, 47)), kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    assert found.tolist() == plain.tolist()
    assert cover is not None
    assert (cover == 1).all()


def test_far_from_a_void_the_result_is_the_plain_filter() -> None:
    values, cover = terrain(64, 64), np.ones((64, 64))
    cover[32, 32] = 0.0
    setting: Setting = HEIGHTS
    plain, _ = coarsen(values, None, kernel=BLACKMAN, radius=6, registration=setting[0], edge=setting[1])
    found, found_cover = coarsen(values, cover, kernel=BLACKMAN, radius=6, registration=setting[0], edge=setting[1])
    changed = (found != plain)[:, :, 0]
    # Fine row 32 has a weight in coarse row 16 (centre) only: all other even taps of a half-band are 0.
    assert np.argwhere(changed).tolist() == [[16, 16]]
    assert found_cover is not None
    assert found_cover[16, 16] == 0.75
    assert (found_cover == 1).sum() == 32 * 32 - 1


@SETTINGS
@pytest.mark.parametrize("name", adversarial_masks(4, 4))
def test_a_constant_with_voids_stays_where_it_is_covered(registration: Registration, edge: Edge, radius: int, name: str) -> None:
    cover = adversarial_masks(37, 52)[name].astype(np.float64)
    values = np.full((37, 52, 1), -417.25)
    for found, level_cover in pyramid(values, cover, 6, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge):
        assert level_cover is not None
        assert level_cover.min() >= 0
        assert level_cover.max() <= 1
        assert found[level_cover > 0] == pytest.approx(-417.25, rel=1e-13)
        assert not found[level_cover == 0].any()


@SETTINGS
def test_what_lies_under_a_void_does_not_matter(registration: Registration, edge: Edge, radius: int) -> None:
    cover = adversarial_masks(40, 40)["random 50 %"].astype(np.float64)
    values = terrain(40, 40)
    spoiled = np.where(cover[:, :, None] > 0, values, np.nan)
    clean, _ = coarsen(values, cover, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    found, _ = coarsen(spoiled, cover, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    assert found.tolist() == clean.tolist()


def test_one_valid_sample_gives_its_value_and_its_share_of_coverage() -> None:
    cover = np.zeros((64, 64))
    cover[33, 20] = 1.0
    values = np.full((64, 64, 1), 255.0)
    values[33, 20] = 7.0
    for level, (found, level_cover) in enumerate(pyramid(values, cover, 7, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")):
        assert level_cover is not None
        assert np.argwhere(level_cover > 0).tolist() == [[33 >> level, 20 >> level]]
        assert level_cover.sum() == 4.0**-level
        assert found[33 >> level, 20 >> level, 0] == 7.0


def test_imagery_of_even_size_keeps_its_covered_area() -> None:
    cover = adversarial_masks(64, 32)["slanted swath"].astype(np.float64)
    _, found = coarsen(np.zeros((64, 32, 1)), cover, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")
    assert found is not None
    assert found.mean() == cover.mean()


def test_transparent_green_beside_opaque_red_does_not_bleed() -> None:
    image = np.zeros((32, 32, 3))
    image[:, :13, 0], image[:, 13:, 1] = 255.0, 255.0
    alpha = np.zeros((32, 32))
    alpha[:, :13] = 1.0
    for colour, level_alpha in pyramid(image, alpha, 5, kernel=BLACKMAN, radius=3, registration="area", edge="mirror"):
        assert level_alpha is not None
        assert not colour[:, :, 1:].any()
        assert colour[level_alpha > 0, 0] == pytest.approx(255.0, abs=1e-10)


@SETTINGS
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), valid=st.floats(0.02, 0.99), fractional=st.booleans())
def test_random_voids_stay_within_the_bound(
    *, registration: Registration, edge: Edge, radius: int, seed: int, valid: float, fractional: bool
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.choice([-1.0, 1.0], (24, 20, 1))
    cover = np.where(rng.random((24, 20)) < valid, rng.random((24, 20)) if fractional else 1.0, 0.0)
    found, _ = coarsen(values, cover, kernel=BLACKMAN, radius=radius, registration=registration, edge=edge)
    reflected = 9.0 if edge == "antisymmetric" else 1.0  # 2 z0 - z triples, once per axis
    bound = void_gain_bound(l1_norm(BLACKMAN, radius, registration))
    assert np.abs(found).max() <= reflected * bound * (1 + 1e-12)


@pytest.mark.parametrize(("radius", "registration"), [(3, "point"), (6, "point"), (3, "area"), (6, "area")])
def test_the_bound_is_attained_and_never_passed(radius: int, registration: Registration) -> None:
    """Uncover positive weights bit by bit under z = sign w: the gain climbs to the bound, where W is 0.867, and falls again."""
    offsets, weights = taps(BLACKMAN, radius, registration)
    kernel = np.outer(weights, weights)
    n, centre = 8 * radius, 2 * radius
    at = 2 * centre + offsets
    values = np.ones((n, n, 1))
    values[np.ix_(at, at)] = np.where(kernel < 0, -1.0, 1.0)[:, :, None]
    bound, gains = void_gain_bound(weight_norm := l1_norm(BLACKMAN, radius, registration)), []
    for target in np.linspace(0.45, 1.0, 111):
        positive = kernel.clip(min=0)
        kept = 1 - (1 - target) / positive.sum()  # the same share of every positive weight
        cover = np.ones((n, n))
        cover[np.ix_(at, at)] = np.where(kernel > 0, kept, 1.0)
        found, _ = coarsen(values, cover, kernel=BLACKMAN, radius=radius, registration=registration, edge="mirror")
        gains.append(abs(float(found[centre, centre, 0])))
    assert max(gains) == pytest.approx(bound, rel=1e-4)
    assert max(gains) <= bound
    assert bound <= 2 * weight_norm**2
    assert gains[-1] == pytest.approx(weight_norm**2)


def test_a_mask_of_whole_samples_comes_close_to_the_bound() -> None:
    offsets, weights = taps(BLACKMAN, 6, "point")
    kernel = np.outer(weights, weights)
    cover, values = np.ones((60, 60)), np.ones((60, 60, 1))
    at = 30 + offsets
    values[np.ix_(at, at)] = np.where(kernel < 0, -1.0, 1.0)[:, :, None]
    covered = 1.0
    for i, j in zip(*np.unravel_index(np.argsort(-kernel, axis=None), kernel.shape), strict=True):
        if kernel[i, j] > 0 and covered - kernel[i, j] >= 0.867:
            covered -= kernel[i, j]
            cover[at[i], at[j]] = 0.0
    found, _ = coarsen(values, cover, kernel=BLACKMAN, radius=6, registration="point", edge="mirror")
    bound = void_gain_bound(l1_norm(BLACKMAN, 6, "point"))
    assert 0.999 * bound <= abs(float(found[15, 15, 0])) <= bound


def test_the_guard_holds_where_plain_normalisation_explodes() -> None:
    offsets, weights = taps(BLACKMAN, 6, "point")
    kernel = np.outer(weights, weights)
    at = 30 + offsets
    window = np.where(kernel < 0, 1.0, (0.01 - kernel.clip(max=0).sum()) / kernel.clip(min=0).sum())
    signs = np.where(kernel < 0, -1.0, 1.0)
    assert (kernel * window * signs).sum() / (kernel * window).sum() > 80
    cover, values = np.ones((60, 60)), np.ones((60, 60, 1))
    cover[np.ix_(at, at)], values[np.ix_(at, at)] = window, signs[:, :, None]
    found, _ = coarsen(values, cover, kernel=BLACKMAN, radius=6, registration="point", edge="mirror")
    assert found[15, 15, 0] == pytest.approx(1.0, abs=1e-14)  # nothing but the positive kernel


def test_guard_is_a_smooth_step() -> None:
    assert guard_blend(np.array([-3.0, 0.5, 0.7, 0.9, 1.4])) == pytest.approx([0, 0, 0.5, 1, 1], abs=1e-15)


def test_bad_input_is_refused() -> None:
    values, cover = np.zeros((4, 4, 1)), np.ones((4, 4))
    for bad_values, bad_cover, words in (
        (values[:, :, 0], None, "float64"),
        (values, cover[:3], "coverage"),
        (values, 2 * cover, "coverage"),
        (values, np.nan * cover, "coverage"),
        (np.nan * values, cover, "finite"),
    ):
        with pytest.raises(ValueError, match=words):
            coarsen(bad_values, bad_cover, kernel=BLACKMAN, radius=3, registration="area", edge="mirror")


# Rounding


def test_rounding_is_to_nearest_even_and_clipped() -> None:
    values = np.array([-0.5, 0.5, 1.5, 2.5, 254.5, 255.5, 1e9, -1e9])
    assert quantise(values, np.uint8).tolist() == [0, 0, 2, 2, 254, 255, 255, 0]
    assert quantise(np.array([-32768.5, -1.5, 32767.5]), np.int16).tolist() == [-32768, -2, 32767]
    assert stored_alpha(np.array([0.0, 0.25, 1.0]), np.uint16).tolist() == [0, 16384, 65535]
