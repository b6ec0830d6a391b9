"""COG: valid by somebody else's judgement, every overview one of our levels, in its place, for two readers."""

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rio_cogeo.cogeo import cog_validate

from tests.integration.export_datasets import HEIGHTS, IMAGERY, KINDS, build, exported, level_samples, the_layer
from tests.integration.files import PLACE
from tests.levels import run_cascade
from tiler.export import tifflayout
from tiler.stores.dataset import open_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("exports")


def opened(path: Path, level: int = 0) -> Any:
    options = {"OVERVIEW_LEVEL": level - 1} if level else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(path, **options)


def validated(path: Path) -> tuple[bool, list[str], list[str]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        valid, errors, remarks = cog_validate(path, strict=True, quiet=True)
        return bool(valid), errors, remarks


def level_in(path: Path, level: int) -> NDArray[Any]:
    with opened(path, level) as file:
        return np.moveaxis(file.read(), 0, -1)


def assert_same_brightness(found: NDArray[Any], expected: NDArray[Any]) -> None:
    """Compare JPEGs with halved colour: GDAL spreads the colour without interpolation, in its own files too (21 codes apart there)."""
    inside = ((found % 255 > 0) & (expected % 255 > 0)).all(axis=-1)
    assert inside.mean() > 0.5
    weights = np.array([0.299, 0.587, 0.114])
    assert np.abs(found[inside] @ weights - expected[inside] @ weights).max() < 2


@pytest.mark.parametrize("kind", KINDS)
def test_every_level_is_an_overview(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}.tif"
    report = exported(folder / kind / "out", "cog", target)
    if layer.width > 1:  # the validator tells overviews apart by their widths
        assert validated(target) == (True, [], [])
    assert report.done.stored_bytes == target.stat().st_size
    for level in range(len(layer.levels)):
        expected, valid = level_samples(dataset, level)
        if layer.kind == "height":
            expected = np.where(valid[..., np.newaxis], expected, np.float32(np.nan))
        found = level_in(target, level)
        assert found.dtype == expected.dtype
        if kind == "jpeg":
            assert_same_brightness(found, expected)
        else:
            np.testing.assert_array_equal(found, expected)
    with opened(target) as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert len(file.overviews(1)) >= len(layer.levels) - 1
        assert file.block_shapes[0] == (max(16, layer.block), max(16, layer.block))


@pytest.mark.parametrize("kind", KINDS)
def test_openimageio_reads_the_same(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}-oiio.tif"
    exported(folder / kind / "out", "cog", target)
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = OpenImageIO.ImageInput.open(str(target), config)
    assert file is not None, OpenImageIO.geterror()
    for level in range(len(layer.levels)):
        expected, valid = level_samples(dataset, level)
        if layer.kind == "height":
            expected = np.where(valid[..., np.newaxis], expected, np.float32(np.nan))
        found = file.read_image(level, 0, 0, layer.channels, layer.dtype.replace("float32", "float"))
        assert found is not None, file.geterror()
        found = np.asarray(found).reshape(expected.shape)
        np.testing.assert_array_equal(found, expected)
    assert not file.seek_subimage(100, 0)
    file.close()


@pytest.mark.parametrize("kind", ["jpeg", "jpeg444", "webp", "webp_rgba"])
def test_blocks_are_tiles_byte_for_byte(kind: str, folder: Path) -> None:
    """No second loss, and nothing is decoded: every stored block of the layer occurs in the file as it is."""
    dataset = open_dataset(build(kind, folder))
    name = the_layer(dataset)
    layer = dataset.manifest.layer(name)
    target = folder / f"{kind}-copied.tif"
    report = exported(folder / kind / "out", "cog", target)
    content = target.read_bytes()
    stored = [dataset.block(name, address) for level in range(len(layer.levels)) for address in layer.lattice.addresses(level)]
    assert all(data in content for data in stored if data is not None)
    assert (report.done.copied, report.done.encoded) == (sum(data is not None for data in stored), stored.count(None))


def test_lossy_blocks_with_a_pad_are_not_encoded_with_loss_again(folder: Path) -> None:
    build("jpeg_pad", folder)
    report = exported(folder / "jpeg_pad" / "out", "cog", folder / "pad.tif")
    with opened(folder / "pad.tif") as file:
        assert file.compression.name == "deflate"
    assert report.done.copied == 0


@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].placed])
def test_it_lies_where_the_source_lay(kind: str, folder: Path) -> None:
    build(kind, folder)
    exported(folder / kind / "out", "cog", folder / f"{kind}-placed.tif")
    with rasterio.open(folder / kind / "source.tif") as source, rasterio.open(folder / f"{kind}-placed.tif") as file:
        assert file.crs == source.crs
        assert file.transform == source.transform == PLACE
        assert file.tags()["AREA_OR_POINT"] == ("Point" if kind in HEIGHTS else "Area")


def test_a_turned_layer_and_one_in_degrees_keep_their_places(tmp_path: Path) -> None:
    from tests.integration.files import settings, write_tiff
    from tests.reference.terrain import terrain
    from tiler.building.build import build_layer

    pixels = terrain(40, 50, seed=1).astype(np.float32)
    turned = Affine.translation(500_000, 5_000_000) @ Affine.rotation(30) @ Affine.scale(10, -10)
    for name, crs, transform in (("turned", "EPSG:32632", turned), ("degrees", "EPSG:4326", Affine(0.001, 0, 7, 0, -0.001, 46))):
        source = write_tiff(tmp_path / f"{name}.tif", pixels, crs=crs, transform=transform)
        build_layer([source], tmp_path / name, settings())
        exported(tmp_path / name, "cog", tmp_path / f"{name}-cog.tif")
        with rasterio.open(tmp_path / f"{name}-cog.tif") as file:
            assert file.crs.to_string() == crs
            assert file.transform.almost_equals(transform, 1e-9)
            assert validated(tmp_path / f"{name}-cog.tif") == (True, [], [])


def test_without_a_place_none_is_claimed(folder: Path) -> None:
    build("png_rgba", folder)
    exported(folder / "png_rgba" / "out", "cog", folder / "nowhere.tif")
    with opened(folder / "nowhere.tif") as file:
        assert file.crs is None
        assert file.transform == Affine.identity()


def test_voids_are_nodata_and_alpha_is_alpha(folder: Path) -> None:
    dataset = open_dataset(build("lerc", folder))
    exported(folder / "lerc" / "out", "cog", folder / "voids.tif")
    with rasterio.open(folder / "voids.tif") as file:
        assert np.isnan(file.nodata)
        assert file.units == ("metre",)
        assert (file.dataset_mask() == level_samples(dataset, 0)[1] * 255).all()
    with rasterio.open(folder / "voids.tif", OVERVIEW_LEVEL=1) as file:
        assert (file.dataset_mask() == level_samples(dataset, 2)[1] * 255).all()
    dataset = open_dataset(build("png_rgba", folder))
    exported(folder / "png_rgba" / "out", "cog", folder / "alpha.tif")
    with opened(folder / "alpha.tif") as file:
        assert file.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        assert (file.dataset_mask() == level_samples(dataset, 0)[0][..., 3]).all()
    unassociated = 2
    assert tifflayout.read_tags((folder / "alpha.tif").read_bytes())[338] == tifflayout.shorts(unassociated)


def test_an_image_of_one_block_gets_the_overviews_it_lacks(folder: Path) -> None:
    """700 x 300 in one block: readers want an overview, and get the level our own filter makes of the block."""
    dataset = open_dataset(build("one_block", folder))
    exported(folder / "one_block" / "out", "cog", folder / "one.tif")
    assert len(dataset.manifest.layer("imagery").levels) == 1
    values = level_samples(dataset, 0)[0].astype(np.float32)
    (_, made, _) = run_cascade(values, None, levels=2, kind="imagery", radius=3)[1]
    found = level_in(folder / "one.tif", 1)
    assert found.shape == (150, 350, 3)
    assert (found == np.clip(np.rint(made), 0, 255)).all()
    with opened(folder / "one.tif") as file:
        assert file.overviews(1) == [2]


@pytest.mark.parametrize("kind", ["jpeg", "lerc"])
def test_tiles_are_framed_as_the_structural_metadata_says(kind: str, folder: Path) -> None:
    """GDAL reads a tile with one request: its size is in the 4 bytes before it, its last 4 bytes come twice, rows follow each other."""
    dataset = open_dataset(build(kind, folder))
    exported(folder / kind / "out", "cog", folder / "framed.tif", overwrite=True)
    content = (folder / "framed.tif").read_bytes()
    start = content.index(b"GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\n") + 43
    assert content[start : start + 140].endswith(b"KNOWN_INCOMPATIBLE_EDITION=NO\n ")
    last_end = None
    layer = dataset.manifest.layer(the_layer(dataset))
    for level in range(len(layer.levels) - 1, -1, -1):
        options = {} if level == 0 else {"ovr": level - 1}
        with opened(folder / "framed.tif") as file:
            for address in layer.lattice.addresses(level):
                place = f"{address.x}_{address.y}"
                offset = int(file.get_tag_item(f"BLOCK_OFFSET_{place}", "TIFF", bidx=1, **options))
                size = int(file.get_tag_item(f"BLOCK_SIZE_{place}", "TIFF", bidx=1, **options))
                assert int.from_bytes(content[offset - 4 : offset], "little") == size
                assert content[offset + size : offset + size + 4] == content[offset + size - 4 : offset + size]
                assert last_end in (None, offset - 4)
                last_end = offset + size + 4
    assert last_end == len(content)


@pytest.mark.parametrize("kind", ["jpeg", "lerc", "png_rgba16"])
def test_bigtiff(kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build(kind, folder)
    exported(folder / kind / "out", "cog", folder / "classic.tif", overwrite=True)
    monkeypatch.setattr(tifflayout, "_CLASSIC_LIMIT_BYTES", 1000)
    exported(folder / kind / "out", "cog", folder / "big.tif", overwrite=True)
    assert (folder / "classic.tif").read_bytes()[2] == 42
    assert (folder / "big.tif").read_bytes()[2] == 43
    assert validated(folder / "big.tif") == (True, [], [])
    for level in range(3):
        assert level_in(folder / "big.tif", level).tobytes() == level_in(folder / "classic.tif", level).tobytes()


def test_the_bytes_do_not_depend_on_workers(folder: Path) -> None:
    build("png_rgba", folder)
    contents = set()
    for workers in (1, 2, 5):
        exported(folder / "png_rgba" / "out", "cog", folder / "workers.tif", workers=workers, overwrite=True)
        contents.add((folder / "workers.tif").read_bytes())
    assert len(contents) == 1


def test_the_validators_command_agrees(folder: Path) -> None:
    build("lerc", folder)
    exported(folder / "lerc" / "out", "cog", folder / "command.tif", overwrite=True)
    rio = Path(sys.executable).with_name("rio")
    done = subprocess.run([rio, "cogeo", "validate", "--strict", folder / "command.tif"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "is a valid cloud optimized GeoTIFF" in done.stdout


def test_it_builds_back_into_the_same_dataset(folder: Path, tmp_path: Path) -> None:
    """What the file says of place, registration, voids and values is all a build needs."""
    from tests.integration.files import settings
    from tiler.building.build import build_layer

    dataset = open_dataset(build("raw_heights_pad", folder))
    exported(folder / "raw_heights_pad" / "out", "cog", tmp_path / "back.tif")
    build_layer([tmp_path / "back.tif"], tmp_path / "again", settings(block=64, pad=4))
    again = open_dataset(tmp_path / "again")
    one, other = dataset.manifest.layer("height"), again.manifest.layer("height")
    assert one.transform == other.transform
    assert [level.index for level in one.levels] == [level.index for level in other.levels]


def test_all_kinds_are_covered() -> None:
    assert {"jpeg", "webp", "png_rgba"} <= set(IMAGERY)
    assert {"lerc", "raw_heights_pad", "full_heights"} == set(HEIGHTS)
