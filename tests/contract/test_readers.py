"""The contract of a reader, run over every kind of file: any window is the slice of the whole picture, from any thread."""

import json
import os
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from schemas.errors import ClipmapError, InputError
from schemas.region import Rect
from tests.contract.picture_files import (
    KINDS,
    Kind,
    Written,
    content,
    file_name,
    png_bytes,
    windows,
    write_with_openimageio,
    write_with_rasterio,
)
from tests.contract.plain_tiff import PLAIN_KINDS
from tiler import rowfile
from tiler.sources import Reader
from tiler.sources.files import open_file


@pytest.fixture(scope="class", params=KINDS + PLAIN_KINDS, ids=str)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Kind, Path, Written]:
    kind: Kind = request.param
    path = tmp_path_factory.mktemp(kind.name) / file_name(kind)
    return kind, path, kind.write(path)


@pytest.fixture
def reader(case: tuple[Kind, Path, Written], tmp_path: Path) -> Iterator[Reader]:
    reader = open_file(case[1], tmp_path)
    yield reader
    reader.close()


class TestContract:
    def test_header(self, case: tuple[Kind, Path, Written], reader: Reader) -> None:
        kind, path, written = case
        info = reader.info
        assert (info.height, info.width, info.channels) == written.pixels.shape
        assert info.dtype == written.pixels.dtype
        assert info.rect == Rect(0, 0, written.pixels.shape[1], written.pixels.shape[0])
        assert (info.path, info.file_bytes) == (path, path.stat().st_size)
        assert info.layout == kind.layout
        assert 1 <= info.chunk_rows <= max(info.height, 512)
        assert (info.alpha, info.premultiplied, info.nodata) == (written.alpha, written.premultiplied, written.nodata)
        assert info.has_mask == (written.mask is not None)

    def test_every_window_is_the_slice_of_the_whole(self, case: tuple[Kind, Path, Written], reader: Reader) -> None:
        """Twelve random windows from four threads at once."""
        written = case[2]

        def check(window: Rect) -> None:
            pixels, mask = reader.read(window)
            rows, columns = slice(window.y0, window.y1), slice(window.x0, window.x1)
            expected = written.pixels[rows, columns]
            assert pixels.dtype == expected.dtype
            assert pixels.shape == expected.shape
            if written.tolerance:
                assert np.abs(pixels.astype(int) - expected).max() <= written.tolerance
            else:
                np.testing.assert_array_equal(pixels, expected)
            assert (mask is None) == (written.mask is None)
            if mask is not None and written.mask is not None:
                assert mask.dtype == np.uint8
                np.testing.assert_array_equal(mask, np.where(written.mask[rows, columns], 255, 0))

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(check, windows(reader.info.width, reader.info.height)))

    @pytest.mark.parametrize("percent", [0.1, 30, 60, 95])
    def test_a_file_cut_off_is_refused(self, case: tuple[Kind, Path, Written], percent: float, tmp_path: Path) -> None:
        """Some libraries fill what is missing with grey or black and say nothing, or only on stderr."""
        _, path, _ = case
        cut = tmp_path / path.name
        cut.write_bytes(path.read_bytes()[: int(path.stat().st_size * percent / 100) + 1])
        for sidecar in path.parent.glob(f"{path.name}.*"):
            (tmp_path / sidecar.name).write_bytes(sidecar.read_bytes())

        def read_all() -> None:
            reader = open_file(cut, tmp_path)
            try:
                reader.read(reader.info.rect)
            finally:
                reader.close()

        with pytest.raises(InputError) as caught:
            read_all()
        assert str(caught.value).startswith(str(cut))
        assert "\n" not in str(caught.value)

    def test_reading_leaves_nothing_behind(self, case: tuple[Kind, Path, Written], reader: Reader, tmp_path: Path) -> None:
        reader.read(Rect(0, 0, 1, 1))
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["tif", "exr"])
@pytest.mark.parametrize("tile", [0, 256])
def test_big_files_are_never_read_whole(suffix: str, tile: int, tmp_path: Path) -> None:
    """Windows of a file of 108 MB raise the process's peak memory by less than a third of that."""
    path = tmp_path / f"big.{suffix}"
    pixels = np.tile(content(3, "uint8", 1500, 1500), (4, 4, 1))
    write_with_openimageio(path, pixels if suffix == "tif" else pixels[..., :1].astype(np.float16), tile, compression="none")
    code = f"""
import json, resource
from pathlib import Path
from schemas.region import Rect
from tiler.sources.files import open_file
reader = open_file(Path({str(path)!r}), Path({str(tmp_path)!r}))
reader.read(Rect(0, 0, 300, 300))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for place in range(300, 5700, 600):
    reader.read(Rect(place, place, place + 300, place + 300))
print(json.dumps([reader.info.layout, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    layout, grown_kib = json.loads(done.stdout)
    assert layout == ("tiled" if tile else "striped")
    assert grown_kib * 1024 < path.stat().st_size / 3


def test_a_spooled_file_beyond_the_memory_limit_lies_in_an_unnamed_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rowfile, "_MEMORY_LIMIT_BYTES", 1000)
    kind = next(kind for kind in KINDS if kind.name == "png-4xuint16")
    path = tmp_path / "picture.png"
    written = kind.write(path)
    descriptors = len(os.listdir("/proc/self/fd"))
    reader = open_file(path, tmp_path)
    assert len(os.listdir("/proc/self/fd")) == descriptors + 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["picture.png"]
    with ThreadPoolExecutor(4) as pool:
        for window, (pixels, _) in zip(windows(211, 157), pool.map(reader.read, windows(211, 157)), strict=True):
            np.testing.assert_array_equal(pixels, written.pixels[window.y0 : window.y1, window.x0 : window.x1])
    reader.close()
    assert len(os.listdir("/proc/self/fd")) == descriptors


def test_a_spooled_file_that_is_damaged_frees_its_scratch_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rowfile, "_MEMORY_LIMIT_BYTES", 1000)
    path = tmp_path / "picture.png"
    KINDS[[kind.name for kind in KINDS].index("png-3xuint8")].write(path)
    path.write_bytes(path.read_bytes()[:-5000])
    descriptors = len(os.listdir("/proc/self/fd"))
    with pytest.raises(InputError):
        open_file(path, tmp_path)
    assert len(os.listdir("/proc/self/fd")) == descriptors


def test_stderr_is_back_after_files_were_spooled_at_the_same_time(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """libpng writes to stderr on its own; each thread silences it while it decodes, whoever ends first."""
    path = tmp_path / "picture.png"
    KINDS[[kind.name for kind in KINDS].index("png-3xuint16")].write(path)
    cut = tmp_path / "cut.png"
    cut.write_bytes(path.read_bytes()[:50_000])

    def spool(number: int) -> None:
        try:
            open_file(cut if number % 3 == 0 else path, tmp_path).close()
        except InputError:
            assert number % 3 == 0

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(spool, range(60)))
    os.write(2, b"still here")
    assert capfd.readouterr().err == "still here"


def jpeg_bomb() -> bytes:
    """A JPEG header that declares 65500 x 65500 RGB pixels, and an end marker."""
    frame = struct.pack(">BHHB", 8, 65500, 65500, 3) + bytes([1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0])
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


BOMBS: dict[str, Callable[[], bytes]] = {
    "bomb.png": lambda: png_bytes(46340, 46340, 8, 2, zlib.compress(bytes(200))),
    "wide.png": lambda: png_bytes(2**31 - 1, 1000, 16, 6, b""),
    "bomb.jpg": jpeg_bomb,
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_few_bytes_cannot_declare_gigapixels(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(BOMBS[name]())
    with pytest.raises(InputError) as caught:
        open_file(path, tmp_path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("empty.tif", b"", "the file is empty"),
        ("note.txt", b"These are the voyages\nof the starship\n", "neither OpenImageIO nor GDAL can read it"),
        ("note.tif", b"These are the voyages\nof the starship\n", "neither OpenImageIO nor GDAL can read it"),
        ("zeros.png", bytes(5000), "neither OpenImageIO nor GDAL can read it"),
        ("noise.exr", np.random.default_rng(1).bytes(5000), "neither OpenImageIO nor GDAL can read it"),
    ],
)
def test_what_is_no_picture_is_refused(name: str, data: bytes, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=sentence) as caught:
        open_file(path, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("missing.tif", "no such file"),
        ("", "is a folder"),
        ("x" * 300, "File name too long"),
        ("a\0b", "null"),
        ("a.tif/b.tif", "Not a directory"),
    ],
)
def test_what_is_no_file_is_refused(name: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(b"x")
    with pytest.raises(InputError, match=sentence):
        open_file(tmp_path / name, tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_without_permission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "secret.tif"
    path.write_bytes(b"x")
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        open_file(path, tmp_path)


@pytest.mark.parametrize("tile", [0, 64])
def test_missing_tiles_are_an_error_of_the_window_that_needs_them(tile: int, tmp_path: Path) -> None:
    """The header is whole and says nothing of compressed sizes, so the file opens; only reading the lost rows fails."""
    path = tmp_path / "cut.tif"
    profile: dict[str, Any] = {"tiled": True, "blockxsize": tile, "blockysize": tile} if tile else {}
    write_with_rasterio(path, content(1, "int16", 500, 500), compress="DEFLATE", **profile)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    reader = open_file(path, tmp_path)
    reader.read(Rect(0, 0, 500, 100))
    with pytest.raises(InputError, match="cannot be read at rows 400 to 500"):
        reader.read(Rect(0, 400, 500, 500))
    reader.read(Rect(0, 0, 500, 100))
    reader.close()


@pytest.mark.parametrize("profile", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 64}, {"interleave": "band"}])
def test_a_file_without_compression_that_is_too_short_does_not_open(profile: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "cut.tif"
    write_with_rasterio(path, content(3, "int16", 500, 500), **profile)
    open_file(path, tmp_path).close()
    path.write_bytes(path.read_bytes()[:1_499_999])
    with pytest.raises(InputError, match="has 1499999 bytes, but its samples alone take 1500000; the file is cut off"):
        open_file(path, tmp_path)


@pytest.mark.parametrize("name", ["tiff-tiled", "png-4xuint16", "jpeg2000-colour", "vrt", "targa"])
def test_more_samples_than_allowed_are_refused_before_any_is_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = next(kind for kind in KINDS if kind.name == name)
    path = tmp_path / file_name(kind)
    samples = kind.write(path).pixels.size
    open_file(path, tmp_path, samples).close()
    for reader in ("SpooledReader", "OiioReader", "RasterioReader"):
        monkeypatch.setattr(f"tiler.sources.files.{reader}", None)
    with pytest.raises(InputError, match=rf"declares 211 x 157 x \d = {samples} samples, more than 5000; .* --max-samples {samples}$"):
        open_file(path, tmp_path, 5000)


def test_channels_of_different_types_are_refused(tmp_path: Path) -> None:
    for number, dtype in enumerate(("uint8", "float32")):
        write_with_rasterio(tmp_path / f"{number}.tif", content(1, dtype))
    bands = "".join(
        f'<VRTRasterBand dataType="{name}" band="{band}"><SimpleSource><SourceFilename relativeToVRT="1">{band - 1}.tif</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>"
        for band, name in ((1, "Byte"), (2, "Float32"))
    )
    path = tmp_path / "mixed.vrt"
    path.write_text(f'<VRTDataset rasterXSize="211" rasterYSize="157">{bands}</VRTDataset>')
    with pytest.raises(InputError, match=r"channels of different types \(uint8, float32\)"):
        open_file(path, tmp_path)


def test_real_files_read_the_same_by_either_library(data_dir: Path, tmp_path: Path) -> None:
    """Windows of every real raster against rasterio's own; those it decodes wrongly or not at all are left out."""
    compared = 0
    for path in sorted(data_dir.rglob("*.[tp][in][fg]")):
        if "truncated" in path.name or "bomb" in path.name or path.stat().st_size > 10_000_000:
            continue
        try:
            reader = open_file(path, tmp_path)
        except ClipmapError as error:
            pytest.fail(f"{path}: {error}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                expected = np.moveaxis(file.read(), 0, -1)
        if expected.shape[2] == reader.info.channels:
            for window in windows(reader.info.width, reader.info.height, 4):
                np.testing.assert_array_equal(reader.read(window)[0], expected[window.y0 : window.y1, window.x0 : window.x1], str(path))
            compared += 1
        reader.close()
    assert compared >= 12
