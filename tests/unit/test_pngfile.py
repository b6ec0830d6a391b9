"""PNG files: read back by four decoders, filtered as a plain reference does it, never much larger than those of libpng."""

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import imagecodecs
import numpy as np
import OpenImageIO
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.reference import png as reference
from tests.reference.terrain import coast, photo, terrain
from tiler.codecs.pngfile import png_file
from tiler.codecs.pngrows import filter_rows, subtract_average, subtract_paeth

Samples = NDArray[Any]
Content = Literal["noise", "constant", "ramp", "few values", "extremes", "photo"]
CONTENTS: tuple[Content, ...] = ("noise", "constant", "ramp", "few values", "extremes", "photo")


def make(content: Content, rows: int, columns: int, channels: int, dtype: str, seed: int) -> Samples:
    """Return samples (rows, columns, channels) whose rows suit different filters."""
    random, top = np.random.default_rng(seed), np.iinfo(dtype).max
    shape = (rows, columns, channels)
    if content == "constant":
        return np.full(shape, random.integers(top + 1), dtype)
    if content == "ramp":
        y, x, channel = np.indices(shape)
        return np.asarray(y * random.integers(9) + x * random.integers(9) + channel, dtype)
    if content == "few values":
        return random.choice(random.integers(0, top + 1, 3), shape).astype(dtype)
    if content == "extremes":
        return (random.integers(0, 2, shape) * top).astype(dtype)
    if content == "photo":
        side = max(rows, columns, 8)
        colours = photo(side, side, seed % 7)[:rows, :columns]
        return np.asarray(np.concatenate([colours, colours[..., :1]], axis=-1)[..., :channels] * np.asarray(top // 255, dtype))
    return random.integers(0, top + 1, shape).astype(dtype)


pictures = st.builds(
    make,
    st.sampled_from(CONTENTS),
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(1, 4),
    st.sampled_from(["uint8", "uint16"]),
    st.integers(0, 2**32 - 1),
)


def with_libpng(data: bytes) -> Samples:
    found = np.asarray(imagecodecs.png_decode(data))
    return found[..., np.newaxis] if found.ndim == 2 else found


@given(pictures)
@example(make("noise", 1, 1, 1, "uint8", 0))
@example(make("extremes", 40, 1, 4, "uint16", 0))
@example(make("ramp", 1, 40, 2, "uint16", 5))
def test_libpng_and_the_reference_read_the_same_samples(samples: Samples) -> None:
    data = png_file(samples)
    found = with_libpng(data)
    assert found.dtype == samples.dtype
    assert np.array_equal(found, samples)
    taken = reference.take_apart(data)
    assert (taken.rows, taken.columns, taken.channels) == samples.shape
    assert np.array_equal(reference.samples(taken), samples)


@given(pictures)
def test_every_row_has_the_filter_of_the_least_sum(samples: Samples) -> None:
    taken = reference.take_apart(png_file(samples))
    assert taken.filtered == reference.best_filtered(reference.unfiltered(taken), taken.step)


def test_all_five_filters_are_used() -> None:
    """By pictures made for them: a test of filters that are never chosen would test nothing."""
    across, down = np.meshgrid(np.arange(32), np.arange(32))
    noise = np.random.default_rng(1).integers(0, 256, 32)
    mean = np.zeros((32, 32), np.uint8)
    mean[0], mean[:, 0] = noise, noise
    for y in range(1, 32):
        for x in range(1, 32):
            mean[y, x] = (int(mean[y - 1, x]) + int(mean[y, x - 1])) // 2
    made = {0: (across + down) % 2 * 2, 1: 7 * down + 3 * across, 2: noise[across], 3: mean, 4: noise[across] // 2 + 4 * down}
    for number, samples in made.items():
        assert number in {row[0] for row in reference.take_apart(png_file(samples.astype(np.uint8))).filtered}, number


def test_paeth_for_every_three_bytes() -> None:
    """All 16.7 million triples in integers that have room; ties go to the left, then to the one above."""
    a, b = (values.ravel().astype(np.uint8) for values in np.indices((256, 256)))
    row, found = np.zeros(65536, np.uint8), np.empty(65536, np.uint8)
    wide_a, wide_b = a.astype(np.int32), b.astype(np.int32)
    for c in range(256):
        subtract_paeth(row, a, b, np.full(65536, c, np.uint8), found)
        distances = np.abs(np.stack([wide_b - c, wide_a - c, wide_a + wide_b - 2 * c]))
        expected = np.choose(distances.argmin(axis=0), [wide_a, wide_b, c])
        assert np.array_equal(found, (-expected % 256).astype(np.uint8)), c


def test_average_for_every_two_bytes() -> None:
    a, b = (values.ravel().astype(np.uint8) for values in np.indices((256, 256)))
    found = np.empty(65536, np.uint8)
    subtract_average(np.full(65536, 200, np.uint8), a, b, found)
    assert np.array_equal(found, ((200 - (a.astype(np.int32) + b) // 2) % 256).astype(np.uint8))


def test_the_sum_of_sizes_is_of_what_was_written() -> None:
    padded = np.zeros((6, 3 + 90), np.uint8)
    padded[1:, 3:] = np.random.default_rng(2).integers(0, 256, (5, 90))
    filtered = np.empty((5, 91), np.uint8)
    total = filter_rows(padded, 3, filtered)
    assert total == np.abs(filtered[:, 1:].astype(np.int8).astype(int)).sum()


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_openimageio_and_pillow_read_the_same_samples(content: Content, dtype: str, channels: int, tmp_path: Path) -> None:
    """Alpha is not multiplied into colours, also where it is 0. Pillow cuts 16 bits of colour to 8, so it reads 8 only."""
    samples = make(content, 33, 47, channels, dtype, 3)
    path = tmp_path / "block.png"
    path.write_bytes(png_file(samples))
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    handle = OpenImageIO.ImageInput.open(str(path), config)
    assert handle is not None, OpenImageIO.geterror()
    found = handle.read_image(handle.spec().format)
    handle.close()
    assert found is not None
    assert found.dtype == samples.dtype
    assert np.array_equal(found, samples)
    if dtype == "uint8":
        pillow = pytest.importorskip("PIL.Image")
        with pillow.open(BytesIO(path.read_bytes())) as picture:
            picture.load()
            assert picture.mode == ("L", "LA", "RGB", "RGBA")[channels - 1]
            assert np.array_equal(np.asarray(picture).reshape(samples.shape), samples)


def test_the_largest_pictures_pass_the_limits_of_libpng() -> None:
    """One image chunk of 34 MB: libpng limits other chunks to 8 MB, and this one by the size of the picture."""
    samples = make("noise", 2048, 2048, 4, "uint16", 1)
    data = png_file(samples)
    assert len(data) > samples.nbytes
    assert np.array_equal(with_libpng(data), samples)


def test_samples_may_lie_apart_and_in_any_byte_order() -> None:
    samples = make("photo", 32, 24, 3, "uint16", 1)
    data = png_file(samples)
    wide = np.zeros((64, 48, 6), np.uint16)
    wide[::2, 1::2, ::2] = samples
    assert png_file(wide[::2, 1::2, ::2]) == data
    assert png_file(samples.astype(">u2")) == data
    assert png_file(samples[::-1][::-1]) == data
    frozen = samples.copy()
    frozen.flags.writeable = False
    assert png_file(frozen) == data
    assert png_file(samples[..., 0]) == png_file(samples[..., :1])


def test_threads_do_not_disturb_each_other() -> None:
    several = [make(content, 64, 64, 3, "uint8", seed) for seed, content in enumerate(CONTENTS * 8)]
    expected = [png_file(samples) for samples in several]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(png_file, several)) == expected


@pytest.mark.parametrize("place", ["header", "image"])
def test_a_changed_byte_is_refused_by_libpng(place: str) -> None:
    """Both check sums are right, and looked at."""
    data = png_file(make("photo", 32, 32, 3, "uint8", 1))
    offset = 16 if place == "header" else 60
    for bit in range(8):
        damaged = bytearray(data)
        damaged[offset] ^= 1 << bit
        with pytest.raises(imagecodecs.PngError):
            imagecodecs.png_decode(bytes(damaged))


def sizes(picture: Samples, every: int = 1) -> tuple[int, int]:
    """Return the bytes of ``every`` n-th block of 256 x 256 by this encoder, and by libpng with zlib's default level, 6."""
    rows, columns = (range(0, size - 255, 256) for size in picture.shape[:2])
    blocks = [np.ascontiguousarray(picture[y : y + 256, x : x + 256]) for y in rows for x in columns][::every]
    assert blocks
    return sum(len(png_file(block)) for block in blocks), sum(len(imagecodecs.png_encode(block, level=6)) for block in blocks)


def heights16(metres: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.asarray(np.rint((metres[..., 0] - metres.min()) / 0.1).clip(0, 65535), np.uint16)


MADE: dict[str, Callable[[], Samples]] = {
    "photo": lambda: photo(512, 512),
    "photo with opaque alpha": lambda: np.dstack([photo(512, 512), np.full((512, 512), 255, np.uint8)]),
    "mountains": lambda: heights16(terrain(512, 512, exponent=4.0)),
    "coast": lambda: heights16(coast(512, 512)),
    "mountains with voids": lambda: np.dstack(
        [heights16(terrain(512, 512, exponent=4.0)), np.where(terrain(512, 512, seed=2)[..., 0] > 1000, 65535, 0).astype(np.uint16)]
    ),
    "nothing": lambda: np.zeros((512, 512, 4), np.uint8),
    "noise": lambda: make("noise", 512, 512, 3, "uint8", 1),
}


@pytest.mark.parametrize("name", MADE)
def test_no_larger_than_libpng(name: str) -> None:
    ours, libpng = sizes(MADE[name]())
    assert ours <= libpng


REAL = {
    "puget/ps_texture_1k.png": 1,
    "puget/ps_height_1k.png": 1,
    "bluemarble/world_topo_bathy_200411_3x5400x2700.jpg": 4,
    "imagery/naip_rgba_3857.tif": 1,
    "imagery/landsat7_utm18n_uint16_nodata.tif": 1,
    "world/world_land_and_sea_8192_int16.tif": 16,
}


@pytest.mark.parametrize("name", REAL)
def test_no_larger_than_libpng_on_real_pictures(name: str, data_dir: Path) -> None:
    """As a whole; single blocks may be some hundredths larger, those of smooth seas above all."""
    found = OpenImageIO.ImageBuf(str(data_dir / name))
    pixels = found.get_pixels(found.spec().format)
    assert pixels is not None
    if pixels.dtype == np.int16:
        pixels = (pixels.astype(np.int32) + 32768).astype(np.uint16)
    ours, libpng = sizes(pixels[..., 0] if pixels.shape[-1] == 1 else pixels, REAL[name])
    assert ours <= libpng


def test_loops_as_plain_python_write_the_same_file() -> None:
    """What is compiled is what is written; and who imports the codecs to decode does not wait for numba."""
    samples = make("photo", 12, 10, 3, "uint8", 1)
    program = """
import sys
import numpy, tiler.codecs.photo, tiler.codecs.elevation
assert "numba" not in sys.modules
from tiler.codecs.pngfile import png_file
sys.stdout.buffer.write(png_file(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8).reshape(12, 10, 3)))
"""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], input=samples.tobytes(), capture_output=True, env=environment, check=False
    )
    assert run.stderr == b""
    assert run.stdout == png_file(samples)
