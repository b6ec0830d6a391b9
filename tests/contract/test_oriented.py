"""Pictures stored rotated or mirrored are read upright: every orientation, every window, masks, bounded memory."""

import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from schemas.errors import InputError
from schemas.region import Rect
from tests.contract.picture_files import HEIGHT, WIDTH, Pixels, content, windows, write_with_openimageio
from tests.contract.plain_tiff import RGB, tiff_bytes
from tiler import rowfile
from tiler.sources.files import open_file
from tiler.sources.oriented import OrientedReader

ORIENTATIONS = range(1, 9)
FILES: dict[str, dict[str, Any]] = {
    "tiled.tif": {"tile": 64},
    "strips.tif": {"tiff__RowsPerStrip": 10},
    "strips-zip.tif": {"tiff__RowsPerStrip": 16, "compression": "zip"},
    "picture.jpg": {"CompressionQuality": 100, "jpeg__subsampling": "4:4:4"},
    "picture.png": {},
    "tiled-zstd.tif": {"tile": 64, "compression": "zstd"},
}


def upright(stored: Pixels, orientation: int) -> Pixels:
    """Put each stored pixel where the tag says it is to be seen (TIFF 6.0, "Orientation"), by the words of the table there."""
    height, width = stored.shape[:2]
    row, column = np.mgrid[:height, :width]
    from_bottom, from_right = height - 1 - row, width - 1 - column
    places = {
        1: (row, column),  # row 0 is the top, column 0 the left side
        2: (row, from_right),
        3: (from_bottom, from_right),
        4: (from_bottom, column),
        5: (column, row),  # row 0 is the left side, column 0 the top
        6: (column, from_bottom),
        7: (from_right, from_bottom),
        8: (from_right, row),
    }
    picture = np.empty_like(stored if orientation < 5 else stored.swapaxes(0, 1))
    picture[places[orientation]] = stored
    return picture


def reoriented(stored: Pixels, orientation: int) -> Pixels:
    """OpenImageIO's own opinion."""
    spec = OpenImageIO.ImageSpec(stored.shape[1], stored.shape[0], stored.shape[2], str(stored.dtype))
    spec.attribute("Orientation", orientation)
    buffer = OpenImageIO.ImageBuf(spec)
    buffer.set_pixels(OpenImageIO.ROI(0, stored.shape[1], 0, stored.shape[0]), np.ascontiguousarray(stored))
    return np.asarray(OpenImageIO.ImageBufAlgo.reorient(buffer).get_pixels(spec.format))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_the_references_agree(orientation: int) -> None:
    stored = content(3, "uint8")
    np.testing.assert_array_equal(upright(stored, orientation), reoriented(stored, orientation))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_every_window_is_upright(name: str, orientation: int, tmp_path: Path) -> None:
    path = tmp_path / name
    stored = content(3, "uint8")
    write_with_openimageio(path, stored, Orientation=orientation, **FILES[name])
    if name.endswith("jpg"):
        stored = np.asarray(OpenImageIO.ImageBuf(str(path)).get_pixels(OpenImageIO.UINT8))
    expected = upright(stored, orientation)
    reader = open_file(path, tmp_path)
    info = reader.info
    assert (info.height, info.width, info.channels, info.orientation) == (*expected.shape, 1)
    if orientation >= 5:
        assert (info.width, info.height) == (HEIGHT, WIDTH)
    assert isinstance(reader, OrientedReader) == (orientation != 1)
    for window in windows(info.width, info.height, 24):
        np.testing.assert_array_equal(reader.read(window)[0], expected[window.y0 : window.y1, window.x0 : window.x1], str(window))
    reader.close()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("tile", [0, 32])
def test_masks_turn_with_the_picture(tile: int, orientation: int, tmp_path: Path) -> None:
    path = tmp_path / "masked.tif"
    stored = content(3, "uint8")
    mask = content(1, "uint8", seed=5)[..., 0] > 120
    write_with_openimageio(path, stored, tile, Orientation=orientation)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(f"{path}.msk", "w", driver="GTiff", width=WIDTH, height=HEIGHT, count=1, dtype="uint8") as file:
            file.write(np.where(mask, np.uint8(255), np.uint8(0))[np.newaxis])
            file.update_tags(INTERNAL_MASK_FLAGS_1="2", INTERNAL_MASK_FLAGS_2="2", INTERNAL_MASK_FLAGS_3="2")
    reader = open_file(path, tmp_path)
    expected, covered = upright(stored, orientation), upright(mask, orientation)
    for window in windows(reader.info.width, reader.info.height):
        pixels, found = reader.read(window)
        rows, columns = slice(window.y0, window.y1), slice(window.x0, window.x1)
        np.testing.assert_array_equal(pixels, expected[rows, columns])
        assert found is not None
        np.testing.assert_array_equal(found, np.where(covered[rows, columns], 255, 0))
    reader.close()


def test_few_bits_and_orientation(tmp_path: Path) -> None:
    stored = content(3, "uint16") >> 4
    path = tmp_path / "turned.tif"
    path.write_bytes(tiff_bytes(stored, 12, RGB, t274=[8]))
    reader = open_file(path, tmp_path)
    np.testing.assert_array_equal(reader.read(reader.info.rect)[0], upright(stored, 8))
    assert reader.info.bits == 12
    reader.close()


@pytest.mark.parametrize("orientation", [0, 9, 77])
def test_orientations_that_do_not_exist_mean_none(orientation: int, tmp_path: Path) -> None:
    stored = content(3, "uint8")
    path = tmp_path / "odd.tif"
    path.write_bytes(tiff_bytes(stored, 8, RGB, t274=[orientation]))
    reader = open_file(path, tmp_path)
    np.testing.assert_array_equal(reader.read(reader.info.rect)[0], stored)
    reader.close()


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_georeference_beside_an_orientation_is_refused(orientation: int, tmp_path: Path) -> None:
    path = tmp_path / "placed.tif"
    write_with_openimageio(path, content(3, "uint8"), Orientation=orientation)
    path.with_suffix(".tfw").write_text("10\n0\n0\n-10\n500005\n4999995\n")
    with pytest.raises(InputError, match=rf"georeference and is stored rotated or mirrored \(orientation {orientation}\)"):
        open_file(path, tmp_path)


@pytest.mark.parametrize("tile", [0, 256])
@pytest.mark.parametrize("orientation", [3, 6])
def test_a_big_turned_file_is_never_in_memory_whole(orientation: int, tile: int, tmp_path: Path) -> None:
    """Columns of a striped file of 108 MB come from a scratch file, columns of a tiled one from its tiles."""
    path = tmp_path / "big.tif"
    write_with_openimageio(path, np.tile(content(3, "uint8", 1500, 1500), (4, 4, 1)), tile, compression="none", Orientation=orientation)
    code = f"""
import json, resource
from pathlib import Path
from schemas.region import Rect
from tiler.sources.files import open_file
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
reader = open_file(Path({str(path)!r}), Path({str(tmp_path)!r}))
for y in range(0, 6000, 150):
    reader.read(Rect(0, y, 6000, y + 150))
print(json.dumps([reader.info.layout, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before]))
"""
    assert 1.5 * rowfile._MEMORY_LIMIT_BYTES < 108e6
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    layout, grown_kib = json.loads(done.stdout)
    assert layout == ("tiled" if tile else "striped" if orientation == 3 else "sequential")
    assert grown_kib * 1024 < path.stat().st_size / 2


def test_closing_closes_the_file_below(tmp_path: Path) -> None:
    class Below:
        closed = 0

        def close(self) -> None:
            self.closed += 1

        def read(self, window: Rect) -> Any:
            raise InputError(f"rows {window.y0} to {window.y1}")

    path = tmp_path / "turned.tif"
    write_with_openimageio(path, content(3, "uint8"), 64, Orientation=3)
    below: Any = Below()
    below.info = open_file(path, tmp_path).info
    reader = OrientedReader(below, 3)
    with pytest.raises(InputError, match="rows 147 to 157"):
        reader.read(Rect(0, 0, 5, 10))
    reader.close()
    assert below.closed == 1
