"""From a file's pixels to samples: guesses, voids, alpha, heights hidden in colour."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.errors import ClipmapError, InputError, UsageError
from schemas.region import Rect
from schemas.settings import BuildSettings
from tests.unit.memory_reader import MemoryReader
from tiler.sources import FileInfo, Pixels
from tiler.sources.convert import Source, choose_conversion


def converted(reader: MemoryReader, **settings: Any) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Samples and coverage of the whole picture."""
    before = reader.read(reader.info.rect)[0].copy()
    values, coverage = Source(reader, choose_conversion(reader.info, BuildSettings(**settings))).read(reader.info.rect)
    assert values.dtype == np.float32
    assert values.flags.c_contiguous
    assert coverage is None or (coverage.dtype == np.float32 and coverage.shape == values.shape[:2])
    np.testing.assert_array_equal(reader.read(reader.info.rect)[0], before, "the reader's pixels were changed")
    return values, coverage


def info(channels: int, dtype: str, **declared: Any) -> FileInfo:
    return MemoryReader(np.zeros((4, 4, channels), dtype), **declared).info


def row(*values: float, dtype: str) -> Pixels:
    return np.array(values, dtype)[np.newaxis, :, np.newaxis]


@pytest.mark.parametrize(
    ("found", "settings", "kind", "colours", "alpha"),
    [
        (info(1, "int16"), {}, "height", (0,), None),
        (info(1, "int32"), {}, "height", (0,), None),
        (info(1, "float32"), {}, "height", (0,), None),
        (info(1, "float64"), {}, "height", (0,), None),
        (info(2, "float32", alpha=1), {}, "height", (0,), 1),
        (info(3, "uint8"), {}, "imagery", (0, 1, 2), None),
        (info(3, "uint16"), {}, "imagery", (0, 1, 2), None),
        (info(4, "uint8", alpha=3), {}, "imagery", (0, 1, 2), 3),
        (info(4, "uint8", alpha=0), {}, "imagery", (1, 2, 3), 0),
        (info(7, "uint16"), {"bands": (5, 3, 2)}, "imagery", (4, 2, 1), None),
        (info(4, "uint8", alpha=3), {"bands": (1, 2, 3)}, "imagery", (0, 1, 2), None),
        (info(4, "uint8", alpha=3), {"bands": (3, 2, 1, 4)}, "imagery", (2, 1, 0), 3),
        (info(1, "uint8"), {"layer": "height"}, "height", (0,), None),
        (info(1, "uint16"), {"layer": "imagery"}, "imagery", (0,), None),
        (info(3, "uint8"), {"bands": (2,), "layer": "height"}, "height", (1,), None),
        (info(3, "uint8"), {"decode": "terrarium"}, "height", (0, 1, 2), None),
        (info(4, "uint8", alpha=3), {"decode": "terrain-rgb", "layer": "height"}, "height", (0, 1, 2), 3),
        (info(3, "uint8"), {"decode": "none"}, "imagery", (0, 1, 2), None),
    ],
)
def test_what_a_file_becomes(found: FileInfo, settings: dict[str, Any], kind: str, colours: tuple[int, ...], alpha: int | None) -> None:
    conversion = choose_conversion(found, BuildSettings(**settings))
    assert (conversion.kind, conversion.colours, conversion.alpha) == (kind, colours, alpha)
    assert conversion.channels == (1 if kind == "height" else len(colours))


@pytest.mark.parametrize(
    ("found", "settings", "error", "sentence"),
    [
        (info(1, "uint8"), {}, UsageError, "say --layer imagery or --layer height"),
        (info(1, "uint16"), {}, UsageError, "say --layer imagery or --layer height"),
        (info(3, "float32"), {}, UsageError, "say --layer imagery or --layer height"),
        (info(2, "uint8"), {}, UsageError, "has 2 channels; choose 1 or 3 with --bands"),
        (info(7, "uint16"), {}, UsageError, "has 7 channels"),
        (info(3, "uint8"), {"bands": (1, 2, 4)}, UsageError, "no channel 4, it has 3"),
        (info(1, "float32"), {"layer": "imagery"}, InputError, "8 or 16 bits without sign"),
        (info(3, "int16"), {"layer": "imagery"}, InputError, "8 or 16 bits without sign"),
        (info(2, "uint8"), {"layer": "imagery"}, InputError, "has 2"),
        (info(3, "uint8"), {"layer": "height"}, InputError, "--decode terrain-rgb"),
        (info(3, "uint16"), {"layer": "height", "decode": "terrarium"}, InputError, "needs 3 channels of uint8, not 3 of uint16"),
        (info(1, "uint8"), {"decode": "terrarium"}, InputError, "needs 3 channels of uint8, not 1"),
        (info(3, "uint8"), {"layer": "imagery", "decode": "terrarium"}, UsageError, "are for heights"),
        (info(3, "uint8"), {"height_scale": 0.1}, UsageError, "are for heights"),
        (info(3, "uint8"), {"height_offset": 5.0}, UsageError, "are for heights"),
        (info(1, "complex64"), {"layer": "height"}, InputError, "complex64"),
        (info(1, "uint8"), {"layer": "height", "nodata": 256}, UsageError, "no sample of uint8 can have that value"),
        (info(1, "int16"), {"nodata": 0.5}, UsageError, "no sample of int16 can have that value"),
    ],
)
def test_what_is_refused(found: FileInfo, settings: dict[str, Any], error: type[ClipmapError], sentence: str) -> None:
    with pytest.raises(error, match=sentence) as caught:
        choose_conversion(found, BuildSettings(**settings))
    assert "\n" not in str(caught.value)


FLOAT_LOWEST = float(np.finfo(np.float32).min)


@pytest.mark.parametrize(
    ("dtype", "void", "nodata"),
    [
        ("int16", -32768, -32768.0),
        ("uint8", 0, 0.0),
        ("uint16", 65535, 65535.0),
        ("int32", -2147483648, -2147483648.0),
        ("float32", 1.70141e38, 1.70141e38),
        ("float32", FLOAT_LOWEST, FLOAT_LOWEST),
        ("float32", FLOAT_LOWEST, -1.7976931348623157e308),
        ("float32", 0.1, 0.1),
        ("float32", np.nan, None),
        ("float32", np.inf, -9999.0),
        ("float64", -1.7976931348623157e308, -1.7976931348623157e308),
        ("float16", -9999, -9999.0),
    ],
)
def test_a_declared_void_has_coverage_0_and_value_0(dtype: str, void: float, nodata: float | None) -> None:
    values, coverage = converted(MemoryReader(row(7, void, 9, dtype=dtype), nodata=nodata), layer="height")
    assert coverage is not None
    assert coverage.tolist() == [[1, 0, 1]]
    assert values[0, :, 0].tolist() == [7, 0, 9]


@pytest.mark.parametrize("scale", [1.0, 0.1, -2.0])
def test_scaling_does_not_move_voids(scale: float) -> None:
    reader = MemoryReader(row(100, -32768, 300, dtype="int16"), nodata=-32768)
    values, coverage = converted(reader, height_scale=scale, height_offset=-50.0)
    assert values[0, :, 0] == pytest.approx([100 * scale - 50, 0, 300 * scale - 50])
    assert coverage is not None
    assert coverage[0].tolist() == [1, 0, 1]


@pytest.mark.parametrize(
    ("dtype", "nodata"), [("uint8", -9999.0), ("uint8", 256.0), ("int16", 1e38), ("int16", -9999.5), ("uint16", np.nan)]
)
def test_a_declared_value_that_no_sample_can_have_marks_nothing(dtype: str, nodata: float) -> None:
    source = Source(
        MemoryReader(row(0, 1, 255, dtype=dtype), nodata=nodata),
        choose_conversion(info(1, dtype, nodata=nodata), BuildSettings(layer="height")),
    )
    assert source.conversion.nodata is None
    assert not source.masked
    assert source.read(Rect(0, 0, 3, 1))[1] is None


@pytest.mark.parametrize(("given", "expected"), [(5.0, [1, 0, 1]), (7.0, [0, 1, 1]), (None, [1, 1, 0]), (float("nan"), None)])
def test_nodata_given_replaces_nodata_declared(given: float | None, expected: list[float] | None) -> None:
    _, coverage = converted(MemoryReader(row(7, 5, -1, dtype="int16"), nodata=-1), nodata=given)
    assert (None if coverage is None else coverage[0].tolist()) == expected


def test_a_colour_is_void_where_all_channels_have_the_value() -> None:
    pixels = np.array([[[0, 0, 0], [0, 5, 0], [1, 2, 3]]], np.uint8)
    values, coverage = converted(MemoryReader(pixels, nodata=0))
    assert coverage is not None
    assert coverage[0].tolist() == [0, 1, 1]
    assert values[0, 1].tolist() == [0, 5, 0]


@pytest.mark.parametrize("settings", [{}, {"height_scale": 0.5, "height_offset": 3.0}])
def test_what_lies_under_voids_cannot_be_seen(settings: dict[str, float]) -> None:
    rng = np.random.default_rng(1)
    heights = rng.uniform(0, 100, (8, 8, 1)).astype(np.float32)
    mask = np.where(rng.random((8, 8)) < 0.5, np.uint8(0), np.uint8(255))
    found = []
    for buried in (0.0, -3.4e38, 3.4e38, np.nan, np.inf):
        pixels = np.where(mask[..., np.newaxis] > 0, heights, np.float32(buried))
        values, coverage = converted(MemoryReader(pixels, mask), **settings)
        assert coverage is not None
        found.append((values.tobytes(), coverage.tobytes()))
    assert len(set(found)) == 1


@pytest.mark.parametrize(("dtype", "full"), [("uint8", 255), ("uint16", 65535), ("float32", 1)])
def test_alpha_becomes_coverage(dtype: str, full: float) -> None:
    pixels = np.array([[[10, 0], [20, full], [30, full * 0.6]]]).astype(dtype)
    values, coverage = converted(MemoryReader(pixels, alpha=1), layer="height")
    assert coverage is not None
    assert coverage[0] == pytest.approx([0, 1, 0.6], abs=1e-4)
    assert values[0, :, 0].tolist() == [0, 20, 30]


def test_alpha_outside_its_range_is_cut_to_it() -> None:
    pixels = np.array([[[10, -2], [20, 7], [30, np.nan], [40, np.inf]]], np.float32)
    _, coverage = converted(MemoryReader(pixels, alpha=1))
    assert coverage is not None
    assert coverage[0].tolist() == [0, 1, 0, 1]


def test_mask_and_alpha_both_count() -> None:
    pixels = np.array([[[9, 9, 9, 255], [9, 9, 9, 51], [9, 9, 9, 255]]], np.uint8)
    _, coverage = converted(MemoryReader(pixels, np.array([[255, 255, 0]], np.uint8), alpha=3))
    assert coverage is not None
    assert coverage[0] == pytest.approx([1, 0.2, 0])


def test_premultiplied_colour_is_divided_by_alpha() -> None:
    pixels = np.array([[[100, 50, 0, 255], [50, 25, 0, 128], [0, 0, 0, 0], [9, 9, 9, 0]]], np.uint8)
    values, _ = converted(MemoryReader(pixels, alpha=3, premultiplied=True))
    assert values[0, 0].tolist() == [100, 50, 0]
    assert values[0, 1] == pytest.approx([50 * 255 / 128, 25 * 255 / 128, 0])
    assert not values[0, 2:].any()
    plain, _ = converted(MemoryReader(pixels, alpha=3))
    assert plain[0, 1].tolist() == [50, 25, 0]


@pytest.mark.parametrize(
    ("encoding", "colour", "height"),
    [
        ("terrarium", (128, 0, 0), 0.0),
        ("terrarium", (0, 0, 0), -32768.0),
        ("terrarium", (162, 144, 128), 8848.5),
        ("terrarium", (127, 255, 255), -1 / 256),
        ("terrain-rgb", (1, 134, 160), 0.0),
        ("terrain-rgb", (0, 0, 0), -10000.0),
        ("terrain-rgb", (2, 224, 65), 8848.1),
        ("terrain-rgb", (1, 134, 159), -0.1),
    ],
)
def test_known_colours_decode_to_known_heights(encoding: str, colour: tuple[int, int, int], height: float) -> None:
    values, coverage = converted(MemoryReader(np.array([[colour]], np.uint8)), layer="height", decode=encoding)
    assert values.shape == (1, 1, 1)
    assert values[0, 0, 0] == np.float32(height)
    assert coverage is None


def test_voids_of_decoded_heights_are_0_too() -> None:
    pixels = np.array([[[1, 134, 160, 255], [1, 134, 160, 0]]], np.uint8)
    values, coverage = converted(MemoryReader(pixels, alpha=3), decode="terrain-rgb", height_offset=5.0)
    assert values[0, :, 0].tolist() == [5, 0]
    assert coverage is not None
    assert coverage[0].tolist() == [1, 0]


def test_whole_numbers_that_float32_cannot_hold_are_refused() -> None:
    values, _ = converted(MemoryReader(row(2**24, -(2**24), dtype="int32")))
    assert values[0, :, 0].tolist() == [2**24, -(2**24)]
    for number in (2**24 + 1, -(2**24) - 1, -(2**31)):
        with pytest.raises(InputError, match="would be rounded"):
            converted(MemoryReader(row(0, number, dtype="int32")))
    converted(MemoryReader(row(0, -(2**31), dtype="int32"), nodata=-(2.0**31)))


@pytest.mark.parametrize(
    ("dtype", "value", "settings"),
    [("float64", 1e30, {"height_scale": 1e9}), ("float32", -9e29, {"height_scale": 1e9}), ("float32", 0, {"height_offset": 1e39})],
)
def test_values_beyond_float32_are_refused(dtype: str, value: float, settings: dict[str, float]) -> None:
    with pytest.raises(InputError, match="beyond the range of float32; if they mark voids, say so with --nodata"):
        converted(MemoryReader(row(1, value, dtype=dtype)), **settings)


@pytest.mark.parametrize(
    ("dtype", "value", "said"),
    [
        ("float32", 3.4028234663852886e38, "3.4028235e+38"),
        ("float32", FLOAT_LOWEST, "-3.4028235e+38"),
        ("float32", 1.70141e38, "1.70141e+38"),
        ("float32", -1e32, "-1e+32"),
        ("float64", -1.7976931348623157e308, "-1.7976931348623157e+308"),
        ("float64", 1e300, "1e+300"),
    ],
)
def test_c23_a_float_that_is_no_height_is_refused_until_it_is_given_as_nodata(dtype: str, value: float, said: str) -> None:
    """The value is told so that it can be copied, and then marks the same samples."""
    pixels = row(100, value, 300, dtype=dtype)
    with pytest.raises(InputError, match="is no height; if it marks voids, give --nodata") as caught:
        converted(MemoryReader(pixels))
    assert str(caught.value) == f"dem.tif: {said} is no height; if it marks voids, give --nodata {said}"
    values, coverage = converted(MemoryReader(pixels), nodata=float(said))
    assert values[0, :, 0].tolist() == [100, 0, 300]
    assert coverage is not None
    assert coverage.tolist() == [[1, 0, 1]]
    masked, _ = converted(MemoryReader(pixels, np.array([[255, 0, 255]], np.uint8)))
    assert masked[0, :, 0].tolist() == [100, 0, 300]


@pytest.mark.parametrize("value", [9.9e29, -9.9e29])
def test_a_float_that_is_still_a_height(value: float) -> None:
    assert converted(MemoryReader(row(0, value, dtype="float32")))[0][0, 1, 0] == np.float32(value)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("settings", [{}, {"height_scale": 2.0}, {"height_scale": -2.0}])
def test_c22_negative_zero_becomes_zero(dtype: str, settings: dict[str, float]) -> None:
    values, _ = converted(MemoryReader(row(-0.0, 0.0, 3, -3, dtype=dtype)), **settings)
    assert not np.signbit(values[0, :2, 0]).any()
    assert values[0, 2:, 0].tolist() == [3 * settings.get("height_scale", 1), -3 * settings.get("height_scale", 1)]


def test_a_float64_too_small_for_float32_becomes_zero_without_sign() -> None:
    values, _ = converted(MemoryReader(row(-1e-300, dtype="float64")))
    assert values.tobytes() == bytes(4)


@pytest.mark.parametrize("bits", [9, 10, 12, 14, 15])
def test_imagery_of_few_bits_is_scaled_to_all_of_its_type(bits: int) -> None:
    """To n * 65535 / (2**bits - 1), rounded to float32 here and to a whole number when it is stored."""
    top = 2**bits - 1
    numbers = np.arange(top + 1, dtype=np.uint16).reshape(1, -1, 1)
    values, _ = converted(MemoryReader(numbers, bits=bits), layer="imagery")
    exact = [Fraction(n * 65535, top) for n in range(top + 1)]
    assert all(abs(Fraction(float(found)) - wanted) <= wanted / 2**24 for found, wanted in zip(values[0, :, 0], exact, strict=True))
    heights, _ = converted(MemoryReader(numbers, bits=bits), layer="height")
    np.testing.assert_array_equal(heights, numbers)


def test_alpha_and_nodata_of_few_bits_are_numbers_of_the_file() -> None:
    pixels = np.array([[[4095, 1000, 0, 4095], [4095, 0, 0, 0], [7, 7, 7, 4095], [0, 0, 0, 819]]], np.uint16)
    values, coverage = converted(MemoryReader(pixels, bits=12, alpha=3, nodata=7))
    assert coverage is not None
    assert coverage[0] == pytest.approx([1, 0, 0, 0.2])
    assert values[0, :, 0].tolist() == [65535, 0, 0, 0]
    assert values[0, 0, 1] == pytest.approx(1000 * 65535 / 4095)


@pytest.mark.parametrize(
    ("found", "settings", "sentence"),
    [
        (info(3, "uint8"), {}, "8 bits already"),
        (info(1, "uint16"), {"layer": "height"}, "--stretch is for imagery"),
        (info(1, "float32"), {}, "--stretch is for imagery"),
        (info(3, "uint8"), {"decode": "terrarium"}, "--stretch is for imagery"),
    ],
)
def test_what_cannot_be_stretched(found: FileInfo, settings: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        choose_conversion(found, BuildSettings(stretch="2%", **settings))


def test_int16_heights_are_exact() -> None:
    pixels = np.arange(-32768, 32768, dtype=np.int16).reshape(256, 256, 1)
    values, coverage = converted(MemoryReader(pixels))
    assert np.array_equal(values, pixels)
    assert coverage is None
