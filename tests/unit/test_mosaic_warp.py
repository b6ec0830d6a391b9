"""Files that are not on the grid of a mosaic: exact places, no bleeding voids, no seams, and no trace of how windows were cut."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.warp import reproject
from rasterio.warp import transform as transform_points

from schemas.errors import InputError
from schemas.region import Rect
from tests.contract.picture_files import Pixels, content, windows
from tests.reference.terrain import photo
from tests.unit.mosaic_files import ORIGIN, SYSTEM, heights, opened, whole, write
from tiler.sources import FileInfo, warped
from tiler.sources.files import open_file

FLOAT = np.float32
Floats = NDArray[np.float64]


def lattice_of(info: FileInfo) -> Affine:
    assert info.georeference is not None
    return Affine(*info.georeference.transform)


def centres(width: int, height: int) -> tuple[Floats, Floats]:
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return columns, rows


def spread(transform: Affine, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
    a, b, c, d, e, f = tuple(transform)[:6]
    return a * columns + b * rows + c, d * columns + e * rows + f


def positions(info: FileInfo, crs: str, other: Affine, system: str = SYSTEM) -> tuple[Floats, Floats]:
    """Where the centres of all samples of a mosaic lie on the pixels of a file in ``crs``: PROJ for each of them."""
    xs, ys = spread(lattice_of(info), *centres(info.width, info.height))
    if crs != system:
        found = transform_points(system, crs, xs.ravel(), ys.ravel())
        xs, ys = (np.array(part).reshape(xs.shape) for part in found)
    return spread(~other, xs, ys)


def plane(width: int, height: int) -> Pixels:
    """Heights that say where their pixel lies: column + 1000 * row, of its centre, in float64."""
    columns, rows = centres(width, height)
    return np.asarray(columns + 1000 * rows)[..., np.newaxis]


# Where a file lies that covers the first one's corner, in several systems; EPSG:4267 is another datum, of which PROJ knows many shifts.
PLACES: dict[str, tuple[str, str, Affine]] = {
    "geographic": (SYSTEM, "EPSG:4326", Affine(0.0002, 0, 8.99, 0, -0.0002, 45.16)),
    "web mercator": (SYSTEM, "EPSG:3857", Affine(14, 0, 1_000_500, 0, -14, 5_643_000)),
    "next zone": (SYSTEM, "EPSG:32633", Affine(10, 0, 29_000, 0, -10, 5_013_000)),
    "turned": (SYSTEM, SYSTEM, ORIGIN @ Affine.translation(10, 7) @ Affine.rotation(30) @ Affine.scale(1.1, 0.9)),
    "axes swapped": (SYSTEM, "EPSG:3035", Affine(10, 0, 4_240_000, 0, -10, 2_447_000)),
    "old datum": ("EPSG:4326", "EPSG:4267", Affine(0.0001, 0, -100.01, 0, -0.0001, 40.01)),
}


def placed(folder: Path, place: str, pixels: Pixels, **profile: Any) -> list[Path]:
    """A small first file that only defines the lattice, and a file at one of the ``PLACES``."""
    system, crs, transform = PLACES[place]
    origin = ORIGIN if system == SYSTEM else Affine(0.0001, 0, -100, 0, -0.0001, 40)
    paths = [folder / "first.tif", folder / "second.tif"]
    write(paths[0], np.zeros((2, 2, pixels.shape[2]), pixels.dtype), crs=system, transform=origin)
    write(paths[1], pixels, crs=crs, transform=transform, **profile)
    return paths


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
@pytest.mark.parametrize("place", PLACES)
def test_samples_are_those_of_their_exact_place(place: str, kernel: Any, tmp_path: Path) -> None:
    """A plane is what it is at PROJ's position of every single sample, to 2e-4 pixels; the file covers just what lies within it."""
    pixels = plane(400, 300)
    system, crs, transform = PLACES[place]
    info, found, valid = whole(placed(tmp_path, place, pixels), kernel=kernel)
    across, down = positions(info, crs, transform, system)
    inside = (across > 0) & (across < 400) & (down > 0) & (down < 300)
    # At the very edge rounding decides.
    edge = (np.abs(across - np.clip(across, 0.01, 399.99)) > 0) & (np.abs(across - np.clip(across, -0.01, 400.01)) == 0)
    edge |= (np.abs(down - np.clip(down, 0.01, 299.99)) > 0) & (np.abs(down - np.clip(down, -0.01, 300.01)) == 0)
    corner = info.parts[0].window
    outside = ~inside & ~edge
    outside[corner.y0 : corner.y1, corner.x0 : corner.x1] = False
    assert valid[inside & ~edge].all()
    assert not valid[outside].any()
    safe = (across > 3) & (across < 397) & (down > 3) & (down < 297)
    assert safe.sum() > 20_000
    error = found[..., 0].astype(np.float64) - (across + 1000 * down)
    assert np.abs(error[safe]).max() <= 1001 * 2e-4


@pytest.mark.parametrize(
    "first", [ORIGIN @ Affine.scale(1, -1), ORIGIN @ Affine.rotation(-20) @ Affine.scale(1, 1.2)], ids=["south-up", "turned"]
)
def test_the_lattice_may_lie_as_it_likes(first: Affine, tmp_path: Path) -> None:
    crs, transform = PLACES["geographic"][1:]
    paths = [write(tmp_path / "first.tif", np.zeros((2, 2, 1)), transform=first), tmp_path / "second.tif"]
    write(paths[1], plane(200, 150), crs=crs, transform=transform)
    info, found, valid = whole(paths)
    across, down = positions(info, crs, transform)
    safe = (across > 3) & (across < 197) & (down > 3) & (down < 147)
    assert valid[safe].all()
    assert safe.sum() > 20_000
    assert np.abs(found[..., 0] - (across + 1000 * down))[safe].max() <= 1001 * 2e-4


@pytest.mark.parametrize("place", PLACES)
def test_any_window_is_the_slice_of_the_whole_bit_for_bit(place: str, tmp_path: Path) -> None:
    """From four threads at once, with holes, larger than one chunk."""
    pixels = content(1, "float32", 900, 800)
    pixels[100:180, 300:420] = np.nan
    reader = opened(placed(tmp_path, place, pixels))
    expected, mask = reader.read(reader.info.rect)
    assert mask is not None
    assert reader.info.width > warped.CHUNK_COLUMNS
    assert reader.info.height > warped.CHUNK_ROWS

    def check(window: Rect) -> None:
        found, covered = reader.read(window)
        here = np.s_[window.y0 : window.y1, window.x0 : window.x1]
        assert found.tobytes() == np.ascontiguousarray(expected[here]).tobytes()
        assert covered is not None
        np.testing.assert_array_equal(covered, mask[here])

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(check, windows(reader.info.width, reader.info.height, 16)))
    reader.close()


@pytest.mark.parametrize(("kernel", "dtype"), [("bilinear", "float32"), ("cubic", "uint8")])
def test_the_same_as_one_pass_of_gdal_over_the_whole(kernel: str, dtype: str, tmp_path: Path) -> None:
    """``rasterio.warp.reproject`` with its own guess of positions, right to 1/8 pixel: equal but for the slope of that."""
    pixels = content(3 if dtype == "uint8" else 1, dtype, 500, 400)
    paths = placed(tmp_path, "geographic", pixels)
    info, found, valid = whole(paths, kernel=kernel)
    expected = np.zeros((pixels.shape[2], info.height, info.width), dtype)
    with rasterio.open(paths[1]) as file:
        source = np.asarray(file.read())
    place: dict[str, Any] = {"src_transform": PLACES["geographic"][2], "src_crs": "EPSG:4326", "dst_transform": lattice_of(info)}
    reproject(source, expected, **place, dst_crs=SYSTEM, resampling=Resampling[kernel], XSCALE=1, YSCALE=1)
    across, down = positions(info, "EPSG:4326", PLACES["geographic"][2])
    safe = valid & (across > 3) & (across < 497) & (down > 3) & (down < 397)
    steps = max(float(np.abs(np.diff(pixels.astype(float), axis=axis)).max()) for axis in (0, 1))
    difference = np.abs(found.astype(float) - np.moveaxis(expected, 0, -1))[safe]
    assert difference.max() <= 2 * steps / 8 + 1
    assert difference.mean() < 0.02 * steps


def test_voids_do_not_bleed(tmp_path: Path) -> None:
    """All that is valid is 100; what lies under a void is 30000 away from that. Voids stay where they are, to half a pixel."""
    pixels = np.full((300, 400, 1), 100, np.int16)
    holes = content(1, "uint8", 400, 300)[..., 0] > 170
    pixels[holes] = -32768
    for kernel in ("bilinear", "cubic"):
        info, found, valid = whole(placed(tmp_path, "geographic", pixels, nodata=-32768), kernel=kernel)
        across, down = positions(info, "EPSG:4326", PLACES["geographic"][2])
        inside = (across > 1) & (across < 399) & (down > 1) & (down < 299)
        for place in (across, down):
            inside &= np.abs(place - np.rint(place)) > 1e-3
        assert set(np.unique(found[valid])) <= {0, 100}, "0: of the first file"
        nearest = ~holes[np.clip(down.astype(int), 0, 299), np.clip(across.astype(int), 0, 399)]
        np.testing.assert_array_equal(valid[inside], nearest[inside])


def test_transparent_colours_do_not_bleed_and_half_transparent_ones_stay(tmp_path: Path) -> None:
    pixels = np.full((300, 400, 4), (10, 200, 30, 255), np.uint8)
    pixels[100:200, :200] = (255, 0, 255, 0)
    pixels[100:200, 200:] = (10, 200, 30, 77)
    colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    info, found, valid = whole(placed(tmp_path, "geographic", pixels, colorinterp=colours))
    assert info.alpha == 3
    assert set(map(tuple, np.unique(found[valid][..., :3], axis=0))) == {(10, 200, 30)}
    across, down = positions(info, "EPSG:4326", PLACES["geographic"][2])
    for column, alpha in ((100, 0), (300, 77)):
        there = (np.abs(down - 150) < 40) & (np.abs(across - column) < 80)
        assert set(found[there][:, 3]) == {alpha}


def test_neighbours_meet_without_a_gap(tmp_path: Path) -> None:
    """Tiles of a file in another zone against the file in one piece: no void between them, and the same but along the seams."""
    pixels = heights(400, 300)
    first, one = placed(tmp_path, "next zone", pixels)
    transform = PLACES["next zone"][2]
    tiles = []
    for x in range(0, 400, 100):
        for y in range(0, 300, 100):
            path = tmp_path / f"{x}-{y}.tif"
            place = transform @ Affine.translation(x, y)
            tiles.append(write(path, pixels[y : y + 100, x : x + 100], crs="EPSG:32633", transform=place))
    info, expected, valid = whole([first, one])
    tiled, found, covered = whole([first, *tiles])
    assert tiled.georeference == info.georeference
    np.testing.assert_array_equal(covered, valid)
    across, down = positions(info, "EPSG:32633", transform)
    seam = (np.abs(across - np.rint(across / 100) * 100) < 1) | (np.abs(down - np.rint(down / 100) * 100) < 1)
    difference = np.abs(found.astype(int) - expected)[~seam]
    assert difference.max() <= 1
    assert (difference > 0).mean() < 2e-3
    slope = max(float(np.abs(np.diff(pixels.astype(float), axis=axis)).max()) for axis in (0, 1))
    assert np.abs(found.astype(float) - expected).max() <= 2 * slope


def test_half_a_pixel_beside_the_grid_is_the_mean_of_four(tmp_path: Path) -> None:
    """Bilinear, by NumPy; with and without a coordinate reference system."""
    pixels = content(1, "float32", 60, 50)
    for crs in (SYSTEM, None):
        first = write(tmp_path / "first.tif", np.zeros((50, 60, 1), FLOAT), crs=crs)
        info, found, _ = whole([first, write(tmp_path / "second.tif", pixels, 0.5, 0.5, crs=crs)])
        assert [part.window for part in info.parts] == [Rect(0, 0, 60, 50), Rect(0, 0, 60, 50)]
        mean = (pixels[:-1, :-1] + pixels[:-1, 1:] + pixels[1:, :-1] + pixels[1:, 1:]) / 4
        np.testing.assert_allclose(found[1:50, 1:60], mean, rtol=1e-6)


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
def test_finer_files_are_averaged(kernel: Any, tmp_path: Path) -> None:
    """A checkerboard eight times as fine becomes grey, not a pattern; a plane stays in place."""
    rows, columns = np.mgrid[:800, :800]
    board = np.where((rows + columns) % 2, 250, 50).astype(np.uint8)[..., np.newaxis]
    step = Affine.translation(10, 10) @ Affine.scale(0.125)
    first = write(tmp_path / "first.tif", np.zeros((5, 5, 1), np.uint8))
    _, found, _ = whole([first, write(tmp_path / "board.tif", board, transform=ORIGIN @ step)], kernel=kernel)
    assert np.abs(found[15:105, 15:105, 0].astype(int) - 150).max() <= 1
    slope = (columns * 0.125).astype(FLOAT)[..., np.newaxis]
    first = write(tmp_path / "first.tif", np.zeros((5, 5, 1), FLOAT))
    _, found, _ = whole([first, write(tmp_path / "slope.tif", slope, transform=ORIGIN @ step)], kernel=kernel)
    np.testing.assert_allclose(found[15:105, 15:105, 0], np.arange(5, 95)[np.newaxis] + 0.4375 + np.zeros((90, 1)), atol=0.01)


def test_a_chunk_that_needs_too_many_pixels_is_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Into the same samples but for rounding; and where that does not help, a sentence."""
    paths = placed(tmp_path, "geographic", photo(600, 700))
    _, expected, _ = whole(paths)
    monkeypatch.setattr(warped, "_SOURCE_LIMIT_PX", 5000)
    _, found, _ = whole(paths)
    assert np.abs(found.astype(int) - expected).max() <= 1, "positions are interpolated to 1e-4 pixels, from other ones"
    assert (found != expected).mean() < 1e-3
    monkeypatch.setattr(warped, "_SOURCE_LIMIT_PX", 10)
    with pytest.raises(InputError, match=r"second\.tif: is too fine for this mosaic"):
        whole(paths)


def test_a_file_across_the_antimeridian_shows_on_both_sides_of_a_world(tmp_path: Path) -> None:
    """Values are latitudes and longitudes of the file's pixels: the world must show them where they lie."""
    transform = Affine(10_000, 0, 600_000, 0, -10_000, 6_000_000)
    found = transform_points("EPSG:32660", "EPSG:4326", *(part.ravel() for part in spread(transform, *centres(40, 40))))
    longitudes, latitudes = (np.array(part).reshape(40, 40) for part in found)
    values = (np.mod(longitudes, 360) + latitudes / 1000).astype(FLOAT)[..., np.newaxis]
    world = write(
        tmp_path / "world.tif", np.full((360, 720, 1), np.nan, FLOAT), crs="EPSG:4326", transform=Affine(0.5, 0, -180, 0, -0.5, 90)
    )
    info, pixels, valid = whole([world, write(tmp_path / "utm.tif", values, crs="EPSG:32660", transform=transform)])
    assert (info.width, info.height) == (720, 360)
    row, column = np.nonzero(valid)
    assert {0, 719} <= set(column.tolist())
    expected = np.mod(-180 + (column + 0.5) / 2, 360) + (90 - (row + 0.5) / 2) / 1000
    assert np.abs(pixels[row, column, 0] - expected).max() < 0.16, "a pixel of the file, at whose edge nothing is left to interpolate"
    assert row.size > 60


def test_hidden_heights_are_not_resampled(tmp_path: Path) -> None:
    paths = placed(tmp_path, "geographic", content(3, "uint8", 50, 40))
    with pytest.raises(
        InputError, match=r"second\.tif: is not on the grid of .*first\.tif, and heights hidden in colour cannot be resampled"
    ):
        opened(paths, encoded=True)
    opened([paths[0], paths[0]], encoded=True).close()


def test_errors_in_mid_file_name_the_file(tmp_path: Path) -> None:
    paths = placed(tmp_path, "geographic", content(3, "uint8", 400, 400), compress="DEFLATE", tiled=True, blockxsize=64, blockysize=64)
    paths[1].write_bytes(paths[1].read_bytes()[:-20_000])
    reader = opened(paths)
    with pytest.raises(InputError, match=r"second\.tif: cannot be read at rows") as caught:
        reader.read(reader.info.rect)
    assert "\n" not in str(caught.value)
    reader.close()


def test_threads_share_one_opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that many threads want at once is opened once."""
    counted, lock = [], threading.Lock()

    def counting(*arguments: Any) -> Any:
        with lock:
            counted.append(arguments[0])
        return open_file(*arguments)

    monkeypatch.setattr("tiler.sources.pool.open_file", counting)
    paths = placed(tmp_path, "geographic", content(1, "int16", 300, 300))
    reader = opened(paths)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(reader.read, windows(reader.info.width, reader.info.height, 24)))
    assert sorted(counted) == sorted(paths)
    reader.close()
