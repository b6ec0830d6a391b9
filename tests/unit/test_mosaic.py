"""Files on one grid, pasted together: every layout, order, voids, transparency, kinds of samples, and mistakes."""

import os
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rasterio.enums import ColorInterp

from schemas.errors import InputError, UsageError
from schemas.region import Rect
from tests.contract import test_readers
from tests.contract.picture_files import HEIGHT, WIDTH, Kind, Pixels, Written, content, png_bytes, windows, write_with_rasterio
from tests.unit.mosaic_files import ORIGIN, STEP, SYSTEM, cut, heights, opened, quarters, whole, write
from tiler.sources import Part, Reader, pool
from tiler.sources.mosaic import open_mosaic

RGBA = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
TILES: dict[str, Any] = {"tiled": True, "blockxsize": 32, "blockysize": 32}


def complete(path: Path) -> Written:
    pixels = content(3, "uint8")
    cut(path.parent, pixels, quarters(WIDTH, HEIGHT, 9), **TILES)
    return Written(pixels)


def with_a_gap(path: Path) -> Written:
    """Two files with voids, a gap between them, and a third void mark in a file on top."""
    pixels, mask = heights(WIDTH, HEIGHT), np.ones((HEIGHT, WIDTH), np.bool_)
    pixels[20:40, 30:50] = 0
    mask[20:40, 30:50] = mask[:, 90:101] = mask[:70, 150:] = False
    left, right = pixels[:, :90].copy(), pixels[:, 101:].copy()
    left[~mask[:, :90]] = -32768
    right[~mask[:, 101:]] = -9999
    write(path.with_name("0.tif"), left, 0, 0, nodata=-32768)
    write(path.with_name("1.tif"), right, 101, 0, nodata=-9999)
    write(path.with_name("2.tif"), np.full((10, 30, 1), 7, np.int16), 80, 50, nodata=7)
    pixels[~mask] = 0
    return Written(pixels, mask=mask)


def with_alpha(path: Path) -> Written:
    """A file without alpha beside one with it; what is transparent has no colour."""
    pixels = content(4, "uint8")
    pixels[:, :100, 3] = 255
    pixels[30:60, 110:150, 3] = 0
    write(path.with_name("0.tif"), pixels[:, :100, :3])
    write(path.with_name("1.tif"), pixels[:, 100:], 100, 0, colorinterp=RGBA)
    pixels[pixels[..., 3] == 0] = 0
    return Written(pixels, alpha=3)


@pytest.fixture(scope="class", params=[complete, with_a_gap, with_alpha], ids=lambda make: str(make.__name__))
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Kind, Path, Written]:
    kind = Kind(request.param.__name__, "tif", "tiled", request.param)
    path = tmp_path_factory.mktemp(kind.name) / "0.tif"
    return kind, path, kind.write(path)


@pytest.fixture
def reader(case: tuple[Kind, Path, Written]) -> Iterator[Reader]:
    reader = opened(sorted(case[1].parent.iterdir()))
    yield reader
    reader.close()


class TestMosaicContract(test_readers.TestContract):
    """The contract of a reader holds for a mosaic; its files lie beside ``path``, numbered."""

    def test_header(self, case: tuple[Kind, Path, Written], reader: Reader) -> None:
        _, path, written = case
        info, files = reader.info, sorted(path.parent.iterdir())
        assert (info.height, info.width, info.channels, info.dtype) == (*written.pixels.shape, written.pixels.dtype)
        assert (info.path, info.file_bytes, info.layout, info.format) == (
            path,
            sum(file.stat().st_size for file in files),
            "tiled",
            "mosaic",
        )
        assert (info.alpha, info.premultiplied, info.nodata, info.has_mask) == (written.alpha, False, None, written.mask is not None)
        assert [part.path for part in info.parts] == files
        assert info.georeference is not None
        assert (info.georeference.crs, info.georeference.transform) == (SYSTEM, tuple(ORIGIN)[:6])

    @pytest.mark.parametrize("percent", [0.1, 30, 60, 95])
    def test_a_file_cut_off_is_refused(self, case: tuple[Kind, Path, Written], percent: float, tmp_path: Path) -> None:
        """By its own name, whichever of the files it is."""
        for path in sorted(case[1].parent.iterdir()):
            (tmp_path / path.name).write_bytes(path.read_bytes())
        damaged = tmp_path / "1.tif"
        damaged.write_bytes(damaged.read_bytes()[: int(damaged.stat().st_size * percent / 100) + 1])

        def read_all() -> None:
            reader = opened(sorted(tmp_path.iterdir()))
            try:
                reader.read(reader.info.rect)
            finally:
                reader.close()

        with pytest.raises(InputError) as caught:
            read_all()
        assert str(caught.value).startswith(str(damaged))
        assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Sheet:
    """A file of a random layout: where it lies, its void mark, and the seed of its samples."""

    rect: Rect
    void: int | None
    seed: int

    @property
    def pixels(self) -> NDArray[np.int16]:
        return np.random.default_rng(self.seed).integers(-2, 3, (self.rect.height, self.rect.width, 1), np.int16)


@st.composite
def sheets(draw: st.DrawFn) -> Sheet:
    x, y = draw(st.integers(-25, 25)), draw(st.integers(-25, 25))
    rect = Rect(x, y, x + draw(st.integers(1, 30)), y + draw(st.integers(1, 30)))
    return Sheet(rect, draw(st.sampled_from([None, -2, 0, 2])), draw(st.integers(0, 99)))


def pasted(layout: list[Sheet]) -> tuple[Rect, Pixels, NDArray[np.bool_]]:
    """The mosaic as it must be: the files written over each other in a picture that is large enough, then cropped."""
    canvas, valid, touched = np.zeros((120, 120, 1), np.int16), *(np.zeros((120, 120), np.bool_) for _ in range(2))
    for sheet in layout:
        box = np.s_[sheet.rect.y0 + 50 : sheet.rect.y1 + 50, sheet.rect.x0 + 50 : sheet.rect.x1 + 50]
        shown = np.ones(sheet.pixels.shape[:2], np.bool_) if sheet.void is None else sheet.pixels[..., 0] != sheet.void
        canvas[box] = np.where(shown[..., np.newaxis], sheet.pixels, canvas[box])
        valid[box] |= shown
        touched[box] = True
    rows, columns = (np.flatnonzero(touched.any(axis=axis)) for axis in (1, 0))
    union = Rect(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    crop = np.s_[union.y0 : union.y1, union.x0 : union.x1]
    return union.shifted(-50, -50), canvas[crop], valid[crop]


@settings(max_examples=60)
@given(layout=st.lists(sheets(), min_size=1, max_size=5), data=st.data())
def test_any_layout_is_what_pasting_gives(layout: list[Sheet], data: st.DataObject) -> None:
    union, expected, valid = pasted(layout)
    with TemporaryDirectory() as folder:
        paths = [
            write(Path(folder) / f"{number}.tif", sheet.pixels, sheet.rect.x0, sheet.rect.y0, nodata=sheet.void)
            for number, sheet in enumerate(layout)
        ]
        reader = opened(paths)
        info = reader.info
        x0, y0 = data.draw(st.integers(0, info.width - 1)), data.draw(st.integers(0, info.height - 1))
        window = Rect(x0, y0, data.draw(st.integers(x0 + 1, info.width)), data.draw(st.integers(y0 + 1, info.height)))
        pixels, mask = reader.read(window)
        reader.close()
    assert info.georeference is not None
    assert info.georeference.transform == tuple(ORIGIN @ Affine.translation(union.x0, union.y0))[:6]
    assert [part.window for part in info.parts] == [sheet.rect.shifted(-union.x0, -union.y0) for sheet in layout]
    here = np.s_[window.y0 : window.y1, window.x0 : window.x1]
    assert (expected.shape[1], expected.shape[0]) == (info.width, info.height)
    assert info.has_mask == (any(sheet.void is not None for sheet in layout) or not valid.all())
    np.testing.assert_array_equal(pixels, expected[here])
    np.testing.assert_array_equal(valid[here], np.ones(pixels.shape[:2], np.bool_) if mask is None else mask == 255)


def test_later_files_lie_on_top(tmp_path: Path) -> None:
    """Three squares, each one pixel further: on the diagonal 1 1 1 ... meets 3 3 3."""
    paths = [write(tmp_path / f"{value}.tif", np.full((20, 20, 1), value, np.int16), value, value) for value in (1, 2, 3)]
    diagonals = {order: np.diagonal(whole([paths[number] for number in order])[1][..., 0]).tolist() for order in ((0, 1, 2), (2, 1, 0))}
    assert diagonals == {(0, 1, 2): [1, 2] + 20 * [3], (2, 1, 0): 20 * [1] + [2, 3]}
    assert (whole([paths[0], paths[1], paths[0], paths[0]])[1][:20, :20] == 1).all(), "one file may come again"


def test_what_is_hidden_is_not_read(tmp_path: Path) -> None:
    """A file that others cover in the window may even be gone."""
    paths = cut(tmp_path, content(3, "uint8"), [Rect(0, 0, 100, 100), Rect(0, 0, 200, 100)])
    reader = opened(paths)
    reader.close()
    paths[0].unlink()
    reader.read(Rect(0, 0, 100, 100))
    reader.close()


def test_masks_of_files_and_nodata_given_by_hand(tmp_path: Path) -> None:
    pixels = content(3, "uint8", 60, 50)
    mask = content(1, "uint8", 60, 50, seed=5)[..., 0] > 120
    below = write(tmp_path / "below.tif", 255 - pixels)
    masked = write(tmp_path / "masked.tif", pixels, mask=mask)
    info, found, valid = whole([below, masked])
    assert valid.all()
    np.testing.assert_array_equal(found, np.where(mask[..., np.newaxis], pixels, 255 - pixels))
    ground = heights(60, 50)
    first, second = write(tmp_path / "a.tif", ground, nodata=5), write(tmp_path / "b.tif", ground, nodata=6)
    value = int(ground[20, 20, 0])
    info, found, valid = whole([first, second], nodata=value)
    assert info.has_mask
    np.testing.assert_array_equal(valid, ground[..., 0] != value)
    with pytest.raises(UsageError, match=r"a\.tif: --nodata 0.5 marks nothing, no sample of int16 can have that value"):
        opened([first, second], nodata=0.5)


def test_floats_that_are_no_numbers_show_what_is_below(tmp_path: Path) -> None:
    upper, lower = content(1, "float32", 50, 40), content(1, "float32", 50, 40, seed=2)
    upper[3:9, 5:9], upper[20, 20:24], upper[21, 20:24] = np.nan, np.inf, -np.inf
    lower[4, 6] = np.nan
    _, found, valid = whole([write(tmp_path / "lower.tif", lower), write(tmp_path / "upper.tif", upper)])
    assert np.argwhere(~valid).tolist() == [[4, 6]]
    lower[4, 6] = 0
    np.testing.assert_array_equal(found, np.where(np.isfinite(upper), upper, lower))


@pytest.mark.parametrize("premultiplied", [False, True])
def test_half_transparent_pixels_are_laid_over(premultiplied: bool, tmp_path: Path) -> None:
    """Porter and Duff's "over", in float64 with premultiplied colours; rounded once."""
    pictures = [content(4, "uint8", 50, 40, seed=seed) for seed in (1, 5)]
    for picture in pictures:
        picture[::3, :, 3], picture[1::3, ::2, 3] = 255, 0
        if premultiplied:
            picture[..., :3] = np.rint(picture[..., :3] * (picture[..., 3:] / 255))
    profile: dict[str, Any] = {
        "photometric": "RGB",
        "colorinterp": RGBA,
        "ALPHA": "PREMULTIPLIED" if premultiplied else "NON-PREMULTIPLIED",
    }
    paths = [write(tmp_path / f"{number}.tif", picture, **profile) for number, picture in enumerate(pictures)]
    info, found, _ = whole(paths)
    assert (info.alpha, info.premultiplied, info.has_mask) == (3, premultiplied, False)
    alphas = [picture[..., 3:] / 255 for picture in pictures]
    colours = [picture[..., :3] * (1 if premultiplied else alpha) for picture, alpha in zip(pictures, alphas, strict=True)]
    alpha = alphas[1] + alphas[0] * (1 - alphas[1])
    colour = colours[1] + colours[0] * (1 - alphas[1])
    straight = colour if premultiplied else np.divide(colour, alpha, out=np.zeros_like(colour), where=alpha > 0)
    assert np.abs(found[..., 3:] - alpha * 255).max() <= 0.5 + 1e-9
    assert np.abs(found[..., :3] - straight).max() <= 0.5 + 1e-9
    opaque = pictures[1][..., 3] == 255
    np.testing.assert_array_equal(found[opaque], pictures[1][opaque])
    hidden = pictures[1][..., 3] == 0
    seen = np.where(pictures[0][..., 3:] > 0, pictures[0], 0)
    np.testing.assert_array_equal(found[hidden], seen[hidden])


def test_premultiplied_beside_straight_becomes_straight(tmp_path: Path) -> None:
    straight = content(4, "uint8", 50, 40)
    straight[..., 3] = np.maximum(straight[..., 3], 1)
    multiplied = straight.copy()
    multiplied[..., :3] = np.rint(straight[..., :3] * (straight[..., 3:] / 255))
    profile: dict[str, Any] = {"photometric": "RGB", "colorinterp": RGBA}
    paths = [
        write(tmp_path / "straight.tif", straight, ALPHA="NON-PREMULTIPLIED", **profile),
        write(tmp_path / "multiplied.tif", multiplied, 50, 0, ALPHA="PREMULTIPLIED", **profile),
    ]
    info, found, _ = whole(paths)
    assert not info.premultiplied
    np.testing.assert_array_equal(found[:, :50], straight)
    shares = straight[..., 3:] / 255
    assert (np.abs(found[:, 50:, :3].astype(float) - straight[..., :3]) <= 0.5 / shares + 0.5 + 1e-9).all()


@pytest.mark.parametrize(
    ("one", "other", "result"), [("int16", "float32", "float32"), ("uint8", "int16", "int16"), ("int16", "int32", "int32")]
)
def test_heights_of_different_types_meet_in_one_that_holds_both(one: str, other: str, result: str, tmp_path: Path) -> None:
    pixels = [(heights(40, 30, seed) % 100).astype(dtype) for seed, dtype in ((1, one), (2, other))]
    info, found, _ = whole([write(tmp_path / "a.tif", pixels[0]), write(tmp_path / "b.tif", pixels[1], 40, 0)])
    assert info.dtype == result
    np.testing.assert_array_equal(found, np.concatenate([part.astype(result) for part in pixels], axis=1))


UNLIKE = {
    "colours": ((3, "uint8"), (1, "uint8"), "has 1 colours, but .*a.tif has 3, and a mosaic holds one kind of samples"),
    "bits": ((3, "uint8"), (3, "uint16"), "has samples of uint16, but .*a.tif has uint8, and a mosaic holds one kind of samples"),
    "grey": ((1, "uint8"), (1, "uint16"), "has samples of uint16, but .*a.tif has uint8"),
}


@pytest.mark.parametrize("name", UNLIKE)
def test_samples_of_different_kinds_are_refused(name: str, tmp_path: Path) -> None:
    *kinds, sentence = UNLIKE[name]
    paths = [write(tmp_path / f"{letter}.tif", content(*kind)) for letter, kind in zip("ab", kinds, strict=True)]
    with pytest.raises(InputError, match=rf"b\.tif: {sentence}") as caught:
        opened(paths)
    assert "\n" not in str(caught.value)


def test_files_without_a_place_are_refused(tmp_path: Path) -> None:
    placed, lost, vague = tmp_path / "placed.tif", tmp_path / "lost.tif", tmp_path / "vague.tif"
    write(placed, heights(20, 20))
    write_with_rasterio(lost, heights(20, 20))
    write(vague, heights(20, 20), 5, 5, crs=None)
    for order in ([placed, lost], [lost, placed]):
        with pytest.raises(InputError, match=r"lost\.tif: has no georeference, so it has no place in a mosaic"):
            opened(order)
    for order in ([placed, vague], [vague, placed]):
        with pytest.raises(InputError, match=r"vague\.tif: has a place but no coordinate reference system, and .*placed\.tif has one"):
            opened(order)
    assert whole([vague, vague])[0].width == 20
    with pytest.raises(UsageError, match="needs one file at least"):
        open_mosaic([], tmp_path, 1)


def test_more_samples_than_allowed_are_refused_with_the_farthest_file(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{name}.tif", heights(20, 20), at, 0) for name, at in (("a", 0), ("stray", 90_000), ("b", 20))]
    with pytest.raises(
        InputError, match=r"a\.tif and 2 more span 90020 x 20 x 1 = 1800400 samples, more than 1000; .*such as .*stray\.tif"
    ):
        opened(paths, 1000)
    opened(paths, 1_800_400).close()
    paths.append(write(tmp_path / "mars.tif", heights(20, 20), transform=Affine(STEP, 0, 1e20, 0, -STEP, 0)))
    with pytest.raises(InputError, match=r"mars\.tif: lies more than 1e\+12 pixels away"):
        opened(paths)


def test_a_file_that_vanishes_or_changes_is_named(tmp_path: Path) -> None:
    paths = cut(tmp_path, content(3, "uint8"), quarters(WIDTH, HEIGHT, 0))
    reader = opened(paths)
    reader.close()
    paths[1].unlink()
    with pytest.raises(InputError, match=r"1\.tif: no such file"):
        reader.read(reader.info.rect)
    write(paths[1], content(3, "uint8", 30, 30), 105, 0)
    with pytest.raises(InputError, match=r"1\.tif: was changed while the mosaic was read; start again"):
        reader.read(reader.info.rect)
    reader.read(Rect(0, 0, 50, 50))
    reader.close()


def test_few_of_many_files_are_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 files from eight threads with a limit of 6: descriptors stay few, and none is left."""
    monkeypatch.setattr(pool, "MAX_OPEN", 6)
    pixels = content(1, "uint8", 200, 200)
    tiles = [Rect(x, y, x + 20, y + 20) for y in range(0, 200, 20) for x in range(0, 200, 20)]
    paths = cut(tmp_path, pixels, tiles)
    before = len(os.listdir("/proc/self/fd"))
    reader = opened(paths)
    most = 0

    def check(window: Rect) -> None:
        nonlocal most
        found, _ = reader.read(window)
        most = max(most, len(os.listdir("/proc/self/fd")))
        np.testing.assert_array_equal(found, pixels[window.y0 : window.y1, window.x0 : window.x1])

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(check, windows(200, 200, 24)))
    assert before < most <= before + (6 + 8) * 9
    reader.close()
    assert len(os.listdir("/proc/self/fd")) <= before + 1


def test_decoded_files_do_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PNG files are decoded as a whole; what is not in use goes when all of them take too much, and comes again."""
    monkeypatch.setattr(pool, "_MEMORY_BYTES", 2 * 20 * 20)
    pixels = content(1, "uint8", 100, 20)
    for number in range(5):
        part = pixels[:, 20 * number : 20 * number + 20, 0]
        rows = b"".join(b"\0" + row.tobytes() for row in part)
        path = tmp_path / f"{number}.png"
        path.write_bytes(png_bytes(20, 20, 8, 0, zlib.compress(rows)))
        path.with_suffix(".pgw").write_text(f"10\n0\n0\n-10\n{5 + 200 * number}\n-5\n")
    reader = opened(sorted(tmp_path.glob("*.png")))
    np.testing.assert_array_equal(reader.read(reader.info.rect)[0], pixels)
    assert len(reader._pool._held) == 2
    reader.close()


def test_palettes_and_turned_files_are_taken_as_they_look(tmp_path: Path) -> None:
    """What ``open_file`` knows of files holds for those of a mosaic."""
    path = tmp_path / "palette.tif"
    indices = content(1, "uint8", 40, 30)
    write(path, indices, photometric="palette")
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {value: (value, 255 - value, value // 2, 255) for value in range(256)})
    info, found, _ = whole([write(tmp_path / "plain.tif", content(3, "uint8", 40, 30), 40, 0), path])
    assert info.parts == (Part(tmp_path / "plain.tif", Rect(40, 0, 80, 30)), Part(path, Rect(0, 0, 40, 30)))
    np.testing.assert_array_equal(found[:, :40], np.concatenate([indices, 255 - indices, indices // 2], axis=-1))
