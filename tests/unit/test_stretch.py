"""Stretching 16-bit imagery to 8 bits: exact ranges, voids left out, both ends met, mistakes told."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from schemas.region import Rect
from schemas.settings import BuildSettings
from tests.unit.memory_reader import MemoryReader
from tiler.samples import stretch as subject
from tiler.samples.stretch import StretchedSource, find_ranges, parse_stretch
from tiler.sources.convert import Source, choose_conversion


def opened(pixels: NDArray[Any], mask: NDArray[np.uint8] | None = None, **declared: Any) -> Source:
    reader = MemoryReader(pixels, mask, **declared)
    return Source(reader, choose_conversion(reader.info, BuildSettings(layer="imagery", stretch="2%")))


def noise(height: int, width: int, channels: int = 3, seed: int = 1) -> NDArray[np.uint16]:
    """Few bright samples and many dark ones, as a satellite sees them; every channel with a range of its own."""
    rng = np.random.default_rng(seed)
    return np.minimum(rng.gamma(3, 900, (height, width, channels)) * np.arange(1, channels + 1), 65535).astype(np.uint16)


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=300), st.integers(0, 4999))
def test_a_cut_leaves_out_the_same_number_at_both_ends(samples: list[int], hundredths: int) -> None:
    """Against a sorted list and whole numbers: k = floor(n p / 100) samples lie beyond each end of the range, or share its value."""
    ordered = sorted(samples)
    cut = len(ordered) * hundredths // 10000
    expected = (ordered[cut], ordered[-1 - cut])
    source = opened(np.array(samples, np.uint16).reshape(1, -1, 1))
    stretch = parse_stretch(f"{hundredths / 100:.2f}%")
    if expected[0] == expected[1]:
        with pytest.raises(InputError, match="channel 1 has no range to stretch"):
            find_ranges(source, stretch, 1)
    else:
        assert find_ranges(source, stretch, 1) == (expected,)


@pytest.mark.parametrize(("portion_px", "columns", "chunk_rows"), [(1 << 20, 2048, 1), (500, 64, 16), (64, 7, 3), (1, 1000, 64)])
@pytest.mark.parametrize("layout", ["tiled", "striped", "sequential"])
def test_the_range_does_not_depend_on_how_the_file_is_read(
    layout: str, portion_px: int, columns: int, chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = noise(90, 130)
    expected = tuple((float(np.sort(plane.ravel())[234]), float(np.sort(plane.ravel())[-235])) for plane in np.moveaxis(pixels, -1, 0))
    monkeypatch.setattr(subject, "_PORTION_PX", portion_px)
    monkeypatch.setattr(subject, "_PORTION_COLUMNS", columns)
    for workers in (1, 3):
        reader = MemoryReader(pixels)
        reader.info = type(reader.info)(
            **{name: getattr(reader.info, name) for name in reader.info.__slots__} | {"layout": layout, "chunk_rows": chunk_rows}
        )
        source = Source(reader, choose_conversion(reader.info, BuildSettings(stretch="2%")))
        assert find_ranges(source, parse_stretch("2%"), workers) == expected
        assert sum(window.width * window.height for window in reader.windows) == 90 * 130, "every pixel once"
        if layout == "striped":
            assert all(window.width == 130 for window in reader.windows)


def test_voids_do_not_count() -> None:
    """Nodata, a mask and full transparency: whatever lies under them, the range is that of the rest."""
    pixels = noise(60, 50)
    hidden = np.random.default_rng(2).random((60, 50)) < 0.6
    rest = pixels[~hidden]
    expected = tuple((float(np.sort(plane)[12]), float(np.sort(plane)[-13])) for plane in rest.T)
    assert len(rest) * 0.01 // 1 == 12
    for under in (0, 40000, 65535):
        buried = np.where(hidden[..., np.newaxis], np.uint16(under), pixels)
        mask = np.where(hidden, np.uint8(0), np.uint8(255))
        alpha = np.dstack([buried, np.where(hidden, 0, 65535).astype(np.uint16)])
        stretch = parse_stretch("1%")
        assert find_ranges(opened(buried, mask), stretch, 2) == expected
        assert find_ranges(opened(alpha, alpha=3), stretch, 2) == expected
        assert (pixels != under).any(axis=-1).all()
        assert find_ranges(opened(buried, nodata=float(under)), stretch, 2) == expected


def test_both_ends_are_met_and_what_lies_beyond_is_clipped() -> None:
    pixels = np.array([[[0], [299], [300], [301], [6150], [11999], [12000], [12001], [65535]]], np.uint16)
    source = StretchedSource(opened(pixels), find_ranges(opened(pixels), parse_stretch("300,12000"), 1))
    values, coverage = source.read(Rect(0, 0, 9, 1))
    assert values.dtype == np.float32
    assert coverage is None
    assert values[0, [0, 1, 2, 6, 7, 8], 0].tolist() == [0, 0, 0, 255, 255, 255]
    assert values[0, 3:6, 0] == pytest.approx([255 / 11700, 127.5, 255 * 11699 / 11700])


def test_every_channel_has_its_own_range() -> None:
    pixels = noise(40, 40)
    ranges = find_ranges(opened(pixels), parse_stretch("0%"), 1)
    assert ranges == tuple((float(plane.min()), float(plane.max())) for plane in np.moveaxis(pixels, -1, 0))
    values, _ = StretchedSource(opened(pixels), ranges).read(Rect(3, 5, 30, 31))
    for channel, (low, high) in enumerate(ranges):
        exact = (pixels[5:31, 3:30, channel] - low) * 255 / (high - low)
        assert np.abs(values[..., channel] - exact).max() < 255 * 2**-22


def test_voids_stay_zero_and_the_file_stays_what_it_is() -> None:
    pixels = noise(20, 20)
    pixels[3:9, 4:8] = 7
    plain = opened(pixels, nodata=7)
    source = StretchedSource(plain, ((-500.0, 9000.0),) * 3)
    values, coverage = source.read(source.info.rect)
    assert coverage is not None
    assert not values[coverage == 0].any()
    assert (coverage == 0).sum() == 24
    assert source.masked
    assert source.info.dtype == np.uint16
    assert (source.conversion.dtype, source.conversion.stretch) == ("uint8", ((-500.0, 9000.0),) * 3)


def test_numbers_of_few_bits_are_stretched_as_they_are_in_the_file() -> None:
    pixels = noise(30, 30) >> 4
    assert find_ranges(opened(pixels, bits=12), parse_stretch("0%"), 1) == find_ranges(opened(pixels), parse_stretch("0%"), 1)


@pytest.mark.parametrize(
    "spec", ["2", "%", "-1%", "50%", "nan%", "inf%", "2%,3", "1,2%", "1", "1,2,3", "a,b", "nan,5", "0,inf", "0,1e9", "", ","]
)
def test_what_is_no_stretch(spec: str) -> None:
    with pytest.raises(UsageError, match=rf"--stretch {re.escape(repr(spec))}: expected CUT% from 0% to below 50%, or MIN,MAX"):
        parse_stretch(spec)


@pytest.mark.parametrize("spec", ["5,5", "6,5", "70000,65535", "999999.99999,1000000"])
def test_an_empty_range(spec: str) -> None:
    with pytest.raises(UsageError, match="MIN must be less than MAX"):
        parse_stretch(spec)


def test_nothing_valid_to_stretch() -> None:
    with pytest.raises(InputError, match=r"dem\.tif: has no valid sample, so there is no range to stretch"):
        find_ranges(opened(noise(5, 5), np.zeros((5, 5), np.uint8)), parse_stretch("2%"), 1)


def test_a_channel_of_one_value() -> None:
    pixels = noise(50, 50)
    pixels[..., 1] = 77
    with pytest.raises(InputError, match=r"channel 2 has no range to stretch, its samples are 77; give --stretch MIN,MAX"):
        find_ranges(opened(pixels), parse_stretch("0%"), 1)
    pixels[0, :3, 1] = 500
    with pytest.raises(InputError, match=r"channel 2 .* are 77 but for those cut off"):
        find_ranges(opened(pixels), parse_stretch("2%"), 1)


def test_an_error_while_counting_is_told() -> None:
    class Damaged(MemoryReader):
        def read(self, window: Rect) -> Any:
            raise InputError("dem.tif: cannot be read at rows 0 to 5")

    reader = Damaged(noise(5, 5))
    source = Source(reader, choose_conversion(reader.info, BuildSettings(stretch="2%")))
    with pytest.raises(InputError, match="cannot be read at rows 0 to 5"):
        find_ranges(source, parse_stretch("2%"), 2)
