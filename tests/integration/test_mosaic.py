"""Real files cut into pieces and put together again, as a reader and as a dataset."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.warp import reproject, transform_bounds
from rasterio.windows import Window

from schemas.region import Rect
from schemas.settings import MAX_SAMPLES, BuildSettings
from tests.integration.files import assemble
from tests.reference.terrain import terrain
from tests.unit.mosaic_files import quarters, write
from tiler.building.build import build_layer
from tiler.sources import Reader
from tiler.sources.convert import Source, choose_conversion
from tiler.sources.files import open_file
from tiler.sources.mosaic import open_mosaic
from tiler.stores.dataset import open_dataset

REAL = [
    "imagery/naip_rgba_3857.tif",
    "imagery/landsat7_utm18n_uint16_nodata.tif",
    "imagery/rgb_mask.tif",
    "imagery/rgba_alpha.tif",
    "dem/mt_everest_90m.tif",
    "dem/slovenia_lidar_nan.tif",
]


def cut(path: Path, window: Rect, output: Path) -> Path:
    """Write a window of a file, with its place, its mask and its alpha."""
    area = Window(window.x0, window.y0, window.width, window.height)
    with rasterio.open(path) as file:
        profile = {key: value for key, value in file.profile.items() if "block" not in key and key != "tiled"}
        profile |= {"width": window.width, "height": window.height, "transform": file.transform @ Affine.translation(window.x0, window.y0)}
        masked = rasterio.enums.MaskFlags.per_dataset in file.mask_flag_enums[0] and file.count == 3
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(output, "w", **profile) as piece:
            piece.write(file.read(window=area))
            piece.colorinterp = file.colorinterp
            if masked:
                piece.write_mask(file.dataset_mask(window=area))
    return output


def pieces(path: Path, folder: Path) -> list[Path]:
    with rasterio.open(path) as file:
        windows = quarters(file.width, file.height, 23)
    return [cut(path, window, folder / f"{number}.tif") for number, window in enumerate(windows)]


def samples(reader: Reader) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a build sees of all of a file: samples and their coverage."""
    source = Source(reader, choose_conversion(reader.info, BuildSettings()))
    values, coverage = source.read(reader.info.rect)
    source.close()
    return values, np.ones(values.shape[:2], np.float32) if coverage is None else coverage


@pytest.mark.parametrize("name", REAL)
def test_overlapping_quarters_are_the_whole_again(name: str, data_dir: Path, tmp_path: Path) -> None:
    mosaic = open_mosaic(pieces(data_dir / name, tmp_path), tmp_path, MAX_SAMPLES)
    whole = open_file(data_dir / name, tmp_path)
    assert (mosaic.info.width, mosaic.info.height, mosaic.info.dtype) == (whole.info.width, whole.info.height, whole.info.dtype)
    assert mosaic.info.georeference is not None
    assert whole.info.georeference is not None
    assert mosaic.info.georeference.crs == whole.info.georeference.crs
    assert mosaic.info.georeference.transform == pytest.approx(whole.info.georeference.transform, rel=1e-12)
    for found, expected in zip(samples(mosaic), samples(whole), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("name", "crs", "mean"),
    [
        ("imagery/naip_rgba_3857.tif", "EPSG:32611", 3),
        ("dem/mt_everest_90m.tif", "EPSG:32645", 5),
        ("dem/slovenia_lidar_nan.tif", "EPSG:3857", 0.02),
    ],
)
def test_a_quarter_that_was_elsewhere_comes_back_close(name: str, crs: str, mean: float, data_dir: Path, tmp_path: Path) -> None:
    """Resampled into another system and back: a mean difference of 3 codes, 5 m between peaks 90 m apart, 2 cm of lidar."""
    parts: Any = pieces(data_dir / name, tmp_path)
    with rasterio.open(parts[3]) as file:
        left, bottom, right, top = transform_bounds(file.crs, crs, *file.bounds)
        place = Affine((right - left) / file.width, 0, left, 0, (bottom - top) / file.height, top)
        with rasterio.open(tmp_path / "away.tif", "w", **{**file.profile, "crs": crs, "transform": place}) as away:
            away.colorinterp = file.colorinterp
            reproject(rasterio.band(file, file.indexes), rasterio.band(away, file.indexes), resampling=Resampling.bilinear)
    mosaic = open_mosaic([*parts[:3], tmp_path / "away.tif"], tmp_path, MAX_SAMPLES)
    whole = open_file(data_dir / name, tmp_path)
    home = mosaic.info.parts[0].window
    shown = np.s_[home.y0 : home.y0 + whole.info.height, home.x0 : home.x0 + whole.info.width]
    (found, covered), (expected, valid) = samples(mosaic), samples(whole)
    found, covered = found[shown], covered[shown]
    both = (covered > 0) & (valid > 0)
    assert both.sum() > 0.99 * (valid > 0).sum()
    moved = np.zeros_like(both)
    moved[whole.info.height // 2 - 30 :, whole.info.width // 2 - 30 :] = True
    np.testing.assert_array_equal(found[both & ~moved], expected[both & ~moved])
    assert np.abs(found - expected)[both & moved].mean() <= mean


def test_a_real_file_across_the_antimeridian(data_dir: Path, tmp_path: Path) -> None:
    """UTM zone 60 at 180 degrees beside a world of two-degree pixels, and beside a tile on either side."""
    scene = data_dir / "imagery/utm60n_dateline_uint16.tif"
    first = tmp_path / "first.tif"
    with rasterio.open(scene) as file:
        count = file.count
    for west, width in ((-180, 3600), (170, 100), (-180, 100)):
        place = Affine(0.1, 0, west, 0, -0.1, 90)
        profile = {"width": width, "height": 1800, "count": count, "dtype": "uint16", "crs": "EPSG:4326", "transform": place, "nodata": 0}
        with rasterio.open(first, "w", driver="GTiff", compress="DEFLATE", **profile) as file:
            file.write(np.zeros((count, 1800, width), np.uint16))
        mosaic = open_mosaic([first, scene], tmp_path, MAX_SAMPLES)
        assert mosaic.info.width <= 3600
        assert mosaic.info.width in range(100, 200) or width == 3600
        _, mask = mosaic.read(mosaic.info.rect)
        assert mask is not None
        columns = np.flatnonzero(mask.any(axis=0))
        assert columns.size < 100
        if width == 3600:
            assert {0, 3599} <= set(columns.tolist())
        else:
            assert (np.diff(columns) == 1).all()
        mosaic.close()


def test_hundreds_of_files(tmp_path: Path) -> None:
    """One row of a large mosaic opens only the files it meets, and few at once."""
    pixels = np.arange(300 * 8 * 8, dtype=np.int32).reshape(8, 2400, 1) % 30_000
    paths = []
    for number in range(300):
        part = pixels[:, 8 * number : 8 * number + 8].astype(np.int16)
        paths.append(write(tmp_path / f"{number}.tif", part, 8 * number))
    reader = open_mosaic(paths, tmp_path, MAX_SAMPLES)
    assert len(os.listdir("/proc/self/fd")) < 200
    found, mask = reader.read(reader.info.rect)
    assert mask is None
    np.testing.assert_array_equal(found, pixels)
    assert len(os.listdir("/proc/self/fd")) < 200
    reader.close()


def test_a_dataset_of_a_mosaic_does_not_depend_on_workers_or_tasks(tmp_path: Path) -> None:
    """Three files, one of them of another zone; every level, sample for sample."""
    paths = [
        write(tmp_path / "west.tif", terrain(300, 260, seed=3).astype(np.float32)),
        write(tmp_path / "east.tif", terrain(300, 260, seed=4).astype(np.float32), 250, 40),
    ]
    place = Affine(12, 0, 29_400, 0, -12, 5_012_000)
    paths.append(write(tmp_path / "zone.tif", terrain(250, 250, seed=5).astype(np.float32), crs="EPSG:32633", transform=place))
    expected = None
    for workers, task in ((1, 4096), (3, 64), (2, 128)):
        output = tmp_path / f"out-{workers}"
        build_layer(paths, output, BuildSettings(block=32, codec="raw", mosaic=True, workers=workers, task=task))
        dataset = open_dataset(output)
        layer = dataset.manifest.layers["height"]
        levels = [assemble(dataset, "height", level) for level in range(len(layer.levels))]
        assert 0 < layer.statistics.valid < layer.width * layer.height
        expected = expected or levels
        for (samples_found, mask), (samples_expected, mask_expected) in zip(levels, expected, strict=True):
            np.testing.assert_array_equal(samples_found, samples_expected)
            np.testing.assert_array_equal(mask, mask_expected)
