"""The short ways for samples without voids, and for imagery that is stored as it is read, lead to the same bits as the long ones."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.region import Rect
from schemas.settings import BuildSettings
from tests.levels import run_cascade
from tests.unit.memory_reader import MemoryReader
from tiler.codecs import BlockFormat
from tiler.filters.decimate import coarsen_rows, coarsen_rows_of_integers
from tiler.filters.kernels import DESIGNS, FIXED_RADIUS
from tiler.sources.convert import Source, choose_conversion
from tiler.sources.whole import take_whole
from tiler.tasks.measure import measure
from tiler.tasks.rounding import round_samples

HIGHEST = 1e30


def source(pixels: NDArray[Any], declared: dict[str, Any] | None = None, **settings: Any) -> Source:
    reader = MemoryReader(pixels, **(declared or {}))
    return Source(reader, choose_conversion(reader.info, BuildSettings(**settings)))


@given(
    side=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    dtype=st.sampled_from(["uint8", "uint16", "int16", "float32", "float64"]),
    share=st.sampled_from([0.0, 0.0, 0.1, 1.0]),
    nodata=st.sampled_from([None, -9999.0, 7.0]),
    seed=st.integers(0, 99),
)
def test_heights_read_lean_are_the_same(side: tuple[int, int], dtype: str, share: float, nodata: float | None, seed: int) -> None:
    random = np.random.default_rng(seed)
    pixels = random.integers(0, 200, (*side, 1)).astype(dtype)
    pixels[random.random(side) < share] = 7
    found = source(pixels, {"nodata": nodata}, layer="height")
    window = Rect(0, 0, side[1], side[0])
    values, coverage = found.read(window)
    lean, lean_coverage = found.read_lean(window)
    assert lean.dtype == np.float32
    assert lean.tobytes() == values.tobytes()
    if lean_coverage is None:
        assert coverage is None or (coverage == 1).all()
    else:
        assert coverage is not None
        assert lean_coverage.tobytes() == coverage.tobytes()


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 3])
def test_imagery_is_read_as_it_is_stored(dtype: str, channels: int) -> None:
    pixels = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (20, 30, channels), dtype, endpoint=True)
    lean, coverage = source(pixels, layer="imagery").read_lean(Rect(2, 3, 25, 19))
    assert coverage is None
    assert lean.dtype == dtype
    np.testing.assert_array_equal(lean, pixels[3:19, 2:25])


def test_imagery_that_is_not_stored_as_it_is_read_becomes_float() -> None:
    """Twelve bits are spread over sixteen, and what is transparent has no colour."""
    twelve = np.full((4, 4, 1), 4095, np.uint16)
    values, _ = source(twelve, {"bits": 12}, layer="imagery").read_lean(Rect(0, 0, 4, 4))
    assert values.dtype == np.float32
    assert (values == 65535).all()
    transparent = np.full((4, 4, 4), 9, np.uint8)
    transparent[..., 3] = 0
    values, coverage = source(transparent, {"alpha": 3}).read_lean(Rect(0, 0, 4, 4))
    assert (values == 0).all()
    assert coverage is not None
    assert (coverage == 0).all()


@pytest.mark.parametrize("special", [np.nan, np.inf, -np.inf, 1.1e30, -1.1e30, -9999.0])
def test_heights_with_a_special_value_are_not_whole(special: float) -> None:
    heights = np.random.default_rng(2).normal(0, 1000, (9, 33)).astype(np.float32)
    assert take_whole(heights, -9999.0, HIGHEST) is not None
    for place in ((0, 0), (8, 32), (4, 17)):
        marred = heights.copy()
        marred[place] = special
        assert take_whole(marred, -9999.0, HIGHEST) is None


def test_negative_zero_becomes_zero_and_denormals_stay() -> None:
    heights = np.array([[-0.0, 1e-40, -1e-40, 5.0]], np.float32)
    taken = take_whole(heights, None, HIGHEST)
    assert taken is not None
    assert taken.tobytes() == np.array([[0.0, 1e-40, -1e-40, 5.0]], np.float32).tobytes()


def test_absurd_heights_are_still_refused() -> None:
    pixels = np.full((4, 4, 1), 3.4e38, np.float32)
    with pytest.raises(InputError, match="is no height"):
        source(pixels, layer="height").read_lean(Rect(0, 0, 4, 4))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("registration", ["area", "point"])
@pytest.mark.parametrize("width", [1, 5, 1023, 1024, 2500])
def test_whole_numbers_are_filtered_to_the_same_bits(dtype: str, name: Any, registration: Any, width: int) -> None:
    kernel = DESIGNS[name](1 if name in FIXED_RADIUS else 3, registration)
    before, after = kernel.reach
    low, high = np.array(kernel.low, np.int64), np.array(kernel.high, np.int64)
    weights = np.array(kernel.weights, np.float32)
    twin = 1 if registration == "area" else 0
    fine = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (before + after + 12, width), dtype, endpoint=True)
    expected, found = np.empty((5, width), np.float32), np.empty((5, width), np.float32)
    coarsen_rows(fine.astype(np.float32), before, low, high, weights, twin, expected)
    coarsen_rows_of_integers(fine, before, low, high, weights, twin, found)
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_a_pyramid_of_whole_numbers_has_the_bits_of_one_of_floats(dtype: str) -> None:
    picture = np.random.default_rng(4).integers(0, np.iinfo(dtype).max, (77, 53, 3), dtype, endpoint=True)
    floats = run_cascade(picture.astype(np.float32), None, levels=5, kind="imagery", radius=3, portion=9)
    for (_, values, _), (_, expected, _) in zip(
        run_cascade(picture, None, levels=5, kind="imagery", radius=3, portion=9), floats, strict=True
    ):
        np.testing.assert_array_equal(values, expected)


@given(portion=st.integers(1, 40), hole=st.tuples(st.integers(0, 59), st.integers(0, 44)), seed=st.integers(0, 99))
def test_rows_without_coverage_are_whole(portion: int, hole: tuple[int, int], seed: int) -> None:
    """Portions that say nothing of coverage give the bits of portions that say it is 1, in any mixture with others that have voids."""
    random = np.random.default_rng(seed)
    values = random.normal(0, 100, (60, 45, 1)).astype(np.float32)
    coverage = np.ones((60, 45), np.float32)
    coverage[hole] = 0
    values[hole] = 0
    said = run_cascade(values, coverage, levels=4, radius=2, portion=portion)
    left_out = run_cascade(values, coverage, levels=4, radius=2, portion=portion, lean=True)
    for (_, found, found_coverage), (_, expected, expected_coverage) in zip(left_out, said, strict=True):
        assert found.tobytes() == expected.tobytes()
        assert found_coverage is not None
        assert expected_coverage is not None
        assert found_coverage.tobytes() == expected_coverage.tobytes()


@given(values=st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=40))
def test_rounding_is_to_even_within_the_range(values: list[float]) -> None:
    samples = np.array(values, np.float32).reshape(1, -1, 1)
    found, mask = round_samples(samples, None, BlockFormat("imagery", 256, 1, "uint8"))
    assert mask is None
    np.testing.assert_array_equal(found[0, :, 0], [min(max(round(value), 0), 255) for value in samples.ravel().tolist()])


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("valid", [None, "all", "some", "none"])
def test_measured_as_numpy_does(dtype: str, valid: str | None) -> None:
    random = np.random.default_rng(5)
    samples = random.integers(0, 200, (23, 17, 4)).astype(dtype)
    masks = {"all": np.ones((23, 17), np.bool_), "some": random.random((23, 17)) < 0.5, "none": np.zeros((23, 17), np.bool_)}
    mask = None if valid is None else masks[valid]
    count, found = measure(samples[:, ::-1], None if mask is None else mask[:, ::-1], 3)
    chosen = samples[..., :3].reshape(-1, 3) if mask is None else samples[mask][:, :3]
    assert count == len(chosen)
    if count:
        np.testing.assert_array_equal(found, [chosen.min(axis=0), chosen.max(axis=0), chosen.sum(axis=0, dtype=np.float64)])
