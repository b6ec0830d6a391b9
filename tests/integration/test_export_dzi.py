"""DZI: files, names and sizes as viewers expect them, blocks copied as they are, levels down to a single pixel."""

import shutil
import subprocess
from dataclasses import dataclass
from math import ceil, log
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import imagecodecs
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.errors import StorageError, UsageError
from tests.integration.export_datasets import IMAGERY, KINDS, build, exported, level_samples, the_layer
from tests.integration.files import tree_digest, write_png
from tests.reference.terrain import photo
from tiler.stores.dataset import open_dataset

NAMESPACE = "{http://schemas.microsoft.com/deepzoom/2008}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("exports")


@dataclass(frozen=True)
class Viewer:
    """A Deep Zoom image as OpenSeadragon sees it: floating-point scales, tiles counted from them, bounds with overlap."""

    width: int
    height: int
    tile: int
    overlap: int
    suffix: str
    tiles_url: str

    @classmethod
    def of(cls, path: Path) -> "Viewer":
        image = ET.parse(path).getroot()
        assert image.tag == f"{NAMESPACE}Image"
        size = image.find(f"{NAMESPACE}Size")
        assert size is not None
        return cls(
            width=int(size.attrib["Width"]),
            height=int(size.attrib["Height"]),
            tile=int(image.attrib["TileSize"]),
            overlap=int(image.attrib["Overlap"]),
            suffix=image.attrib["Format"],
            tiles_url=str(path)[: str(path).rindex(".")] + "_files/",
        )

    @property
    def max_level(self) -> int:
        return ceil(log(max(self.width, self.height)) / log(2))

    def scale(self, level: int) -> float:
        return float(1 / 2 ** (self.max_level - level))

    def num_tiles(self, level: int) -> tuple[int, int]:
        scale = self.scale(level)
        return ceil(scale * self.width / self.tile), ceil(scale * self.height / self.tile)

    def url(self, level: int, x: int, y: int) -> Path:
        return Path(f"{self.tiles_url}{level}/{x}_{y}.{self.suffix}")

    def bounds(self, level: int, x: int, y: int) -> tuple[int, int, int, int]:
        """(left, top, width, height) in pixels of the level, which a viewer rounds up to whole ones."""
        edges = []
        for number, extent in ((x, self.width), (y, self.height)):
            scaled = ceil(extent * self.scale(level))
            first = 0 if number == 0 else self.tile * number - self.overlap
            size = self.tile + (1 if number == 0 else 2) * self.overlap
            edges.append((first, min(size, scaled - first)))
        (left, width), (top, height) = edges
        return left, top, width, height


def decoded(path: Path) -> NDArray[Any]:
    pixels = np.asarray(imagecodecs.imread(path))
    return pixels[..., np.newaxis] if pixels.ndim == 2 else pixels


def all_tiles(viewer: Viewer) -> list[tuple[int, int, int]]:
    return [
        (level, x, y)
        for level in range(viewer.max_level + 1)
        for y in range(viewer.num_tiles(level)[1])
        for x in range(viewer.num_tiles(level)[0])
    ]


@pytest.mark.parametrize("kind", IMAGERY)
def test_a_viewer_finds_every_tile_and_nothing_else(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}.dzi"
    report = exported(folder / kind / "out", "dzi", target)
    viewer = Viewer.of(target)
    assert (viewer.width, viewer.height, viewer.tile, viewer.overlap) == (layer.width, layer.height, layer.block, layer.pad)
    assert report.done.levels == viewer.max_level + 1
    tiles = all_tiles(viewer)
    files = [path for path in (folder / f"{kind}_files").rglob("*") if path.is_file()]
    assert sorted(files) == sorted(viewer.url(*tile) for tile in tiles)
    assert report.done.stored_bytes == sum(path.stat().st_size for path in [*files, target])
    assert report.done.copied + report.done.encoded == len(files)
    levels = [level_samples(dataset, level)[0] for level in range(len(layer.levels))]
    for tile in tiles:
        left, top, width, height = viewer.bounds(*tile)
        found = decoded(viewer.url(*tile))
        assert found.shape[:2] == (height, width)
        ours = viewer.max_level - tile[0]
        if ours < len(levels):
            expected = levels[ours][top : top + height, left : left + width]
            if found.shape != expected.shape:  # an opaque webp
                expected = expected[..., : found.shape[-1]]
            lossless = layer.codec in ("png", "raw") or layer.codec == "rgb565"
            # Cut and encoded again, a lossy tile changes once more, by about as much as the first time.
            assert np.abs(found.astype(float) - expected).mean() <= (0 if lossless else 8)


@pytest.mark.parametrize("kind", ["jpeg", "jpeg_pad", "webp_rgba", "png_rgba", "png_rgba_pad", "png_rgba16"])
def test_blocks_inside_are_copied_byte_for_byte(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    name = the_layer(dataset)
    layer = dataset.manifest.layer(name)
    target = folder / f"{kind}-copied.dzi"
    report = exported(folder / kind / "out", "dzi", target)
    viewer = Viewer.of(target)
    copied = 0
    for level, x, y in all_tiles(viewer):
        _, _, width, height = viewer.bounds(level, x, y)
        ours = viewer.max_level - level
        if ours >= len(layer.levels) or (width, height) != (layer.block + 2 * layer.pad,) * 2:
            continue
        stored = dataset.block(name, BlockAddress(ours, x, y))
        assert viewer.url(level, x, y).read_bytes() == stored or stored is None
        copied += stored is not None
    assert report.done.copied == copied > 0


def test_blank_blocks_are_transparent(folder: Path) -> None:
    dataset = open_dataset(build("png_rgba", folder))
    exported(folder / "png_rgba" / "out", "dzi", folder / "blank.dzi")
    assert dataset.block("imagery", BlockAddress(0, 0, 0)) is None
    viewer = Viewer.of(folder / "blank.dzi")
    assert not decoded(viewer.url(viewer.max_level, 0, 0)).any()


def test_the_single_pixel_is_the_mean(tmp_path: Path) -> None:
    from tests.integration.files import settings
    from tiler.building.build import build_layer

    write_png(tmp_path / "flat.png", np.full((70, 50, 3), (10, 200, 77), np.uint8))
    build_layer([tmp_path / "flat.png"], tmp_path / "out", settings(codec="png"))
    exported(tmp_path / "out", "dzi", tmp_path / "flat")
    for level in range(8):
        assert (decoded(tmp_path / "flat_files" / str(level) / "0_0.png") == (10, 200, 77)).all()


@pytest.mark.skipif(shutil.which("vips") is None, reason="libvips-tools is not installed")
@pytest.mark.parametrize(("kind", "overlap"), [("light", 0), ("png_rgba_pad", 2)])
def test_the_layout_is_that_of_vips(kind: str, overlap: int, folder: Path, tmp_path: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    exported(folder / kind / "out", "dzi", tmp_path / "ours.dzi")
    source = tmp_path / "picture.png"
    source.write_bytes(imagecodecs.png_encode(level_samples(dataset, 0)[0]))
    command: list[str | Path] = [
        "vips",
        "dzsave",
        source,
        tmp_path / "theirs",
        "--tile-size",
        "32",
        "--overlap",
        str(overlap),
        "--suffix",
        ".png",
    ]
    subprocess.run(command, check=True, capture_output=True)
    names = [
        sorted(
            path.relative_to(tmp_path / f"{who}_files").as_posix() for path in (tmp_path / f"{who}_files").rglob("*.*") if path.is_file()
        )
        for who in ("ours", "theirs")
    ]
    theirs = [name for name in names[1] if not name.startswith("vips-properties")]
    assert names[0] == theirs
    for name in theirs:
        assert decoded(tmp_path / "ours_files" / name).shape[:2] == decoded(tmp_path / "theirs_files" / name).shape[:2]
    ours, other = ET.parse(tmp_path / "ours.dzi").getroot(), ET.parse(tmp_path / "theirs.dzi").getroot()
    assert (ours.tag, ours.attrib) == (other.tag, other.attrib)
    assert [(part.tag, part.attrib) for part in ours] == [(part.tag, part.attrib) for part in other]
    finest = max(int(name.split("/")[0]) for name in theirs)
    for name in theirs:
        if name.startswith(f"{finest}/"):
            assert (decoded(tmp_path / "ours_files" / name) == decoded(tmp_path / "theirs_files" / name)).all()


def test_heights_are_refused(folder: Path, tmp_path: Path) -> None:
    build("lerc", folder)
    with pytest.raises(UsageError, match="heights and normals are no pictures; export them as cog or exr"):
        exported(folder / "lerc" / "out", "dzi", tmp_path / "heights.dzi")
    assert not list(tmp_path.iterdir())


def test_replacing(folder: Path, tmp_path: Path) -> None:
    build("jpeg", folder)
    exported(folder / "jpeg" / "out", "dzi", tmp_path / "a.dzi")
    fresh = tree_digest(tmp_path)
    with pytest.raises(UsageError, match="exists already"):
        exported(folder / "jpeg" / "out", "dzi", tmp_path / "a.dzi")
    (tmp_path / "a_files" / "stray.txt").write_text("old")
    (tmp_path / "a.dzi").unlink()
    with pytest.raises(UsageError, match="a_files: exists already"):
        exported(folder / "jpeg" / "out", "dzi", tmp_path / "a.dzi")
    exported(folder / "jpeg" / "out", "dzi", tmp_path / "a.dzi", overwrite=True)
    assert tree_digest(tmp_path) == fresh


def test_the_descriptor_comes_last(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While tiles are written nothing has its final name; when a tile cannot be written nothing is left."""
    build("jpeg", folder)
    seen: list[set[str]] = []
    write = Path.write_bytes

    def watched(path: Path, data: bytes) -> int:
        seen.append({entry.name for entry in tmp_path.iterdir()})
        if path.name == "3_2.jpg":
            raise OSError(28, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", watched)
    with pytest.raises(StorageError, match="No space left on device"):
        exported(folder / "jpeg" / "out", "dzi", tmp_path / "a.dzi")
    assert all(name.startswith(".tmp-") for names in seen for name in names)
    assert not list(tmp_path.iterdir())


def test_other_codecs_become_png(folder: Path) -> None:
    assert {"rgb565", "raw_small"} <= set(KINDS)
    build("rgb565", folder)
    report = exported(folder / "rgb565" / "out", "dzi", folder / "png.dzi")
    assert Viewer.of(folder / "png.dzi").suffix == "png"
    assert report.done.copied == 0


def test_a_photo_of_one_block(tmp_path: Path) -> None:
    from tests.integration.files import settings
    from tiler.building.build import build_layer

    write_png(tmp_path / "one.png", photo(20, 31, seed=1))
    build_layer([tmp_path / "one.png"], tmp_path / "out", settings(codec="png"))
    exported(tmp_path / "out", "dzi", tmp_path / "one.dzi")
    assert sorted(path.name for path in (tmp_path / "one_files").iterdir()) == ["0", "1", "2", "3", "4", "5"]
    assert (decoded(tmp_path / "one_files" / "5" / "0_0.png") == photo(20, 31, seed=1)).all()
