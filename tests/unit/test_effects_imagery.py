"""Contrast of stored imagery: at least that under every tap of the filter, on all levels, and so is what filtering codes changes."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.settings import BuildSettings
from tests.contract.picture_files import write_with_rasterio
from tiler.building.build import build_layer
from tiler.checking.blockreader import BlockReader
from tiler.effects import bounds
from tiler.effects.imagery import Contrast, ImageryMeter
from tiler.filters.kernels import DESIGNS
from tiler.stores.dataset import Dataset, open_dataset


def photo(height: int, width: int, contrast: float, seed: int = 3) -> NDArray[np.uint8]:
    """Smooth colours, and somewhere an edge."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / 40
    z = 0.5 + 0.1 * contrast * np.stack([np.sin(x + y), np.cos(x), np.sin(y)], axis=-1) + rng.normal(size=(height, width, 1)) * 0.004
    z[height // 2 :, width // 3 :] += 0.25 * contrast
    return np.asarray(np.clip(255 * z, 0, 255).astype(np.uint8))


def built(folder: Path, samples: NDArray[np.uint8], **settings: Any) -> Dataset:
    write_with_rasterio(folder / "photo.tif", samples)
    build_layer(folder / "photo.tif", folder / "out", BuildSettings(codec="raw", workers=1, **settings))
    return open_dataset(folder / "out")


def measured(dataset: Dataset) -> Contrast:
    with ThreadPoolExecutor(2) as pool:
        return ImageryMeter(dataset).measure(pool)


def stored(dataset: Dataset, level: int) -> NDArray[np.float64]:
    """All colours of a level, of 1."""
    reader = BlockReader(dataset, "imagery")
    facts = reader.layer.levels[level]
    rows = []
    for y in range(facts.rows):
        cores = [reader.read_core(BlockAddress(level, x, y)) for x in range(facts.columns)]
        rows.append(np.concatenate([core.samples for core in cores if core is not None], axis=1))
    return np.concatenate(rows).astype(np.float64) / 255


def light(codes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(codes <= 0.04045, codes / 12.92, ((np.maximum(codes, 0) + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("block", [16, 64])
@pytest.mark.parametrize(("contrast", "kernel", "radius"), [(1.0, "blackman-sinc", 3), (0.2, "blackman-sinc", 6), (0.4, "box", 1)])
def test_no_filter_sees_more(tmp_path: Path, block: int, contrast: float, kernel: str, radius: int) -> None:
    dataset = built(tmp_path, photo(90, 121, contrast), block=block, filter=kernel, radius=radius)
    found = measured(dataset)
    layer = dataset.manifest.layer("imagery")
    offsets, weights = DESIGNS[layer.filter.kernel](layer.filter.radius, layer.registration).taps()
    width = int(offsets[-1] - offsets[0]) + 1
    assert found.filter_norm == pytest.approx(np.abs(np.outer(weights, weights)).sum())
    largest, changed, loose = 0.0, 0.0, 0.0
    for level in range(len(layer.levels) - 1):
        codes = stored(dataset, level)
        if min(codes.shape[:2]) < width:
            continue
        windows = sliding_window_view(codes, (width, width), axis=(0, 1))
        largest = max(largest, float((windows.max(axis=(-1, -2)) - windows.min(axis=(-1, -2))).max()))
        loose = max(loose, float(np.ptp(codes, axis=(0, 1)).max()))
        taps = np.outer(weights, weights)
        changed = max(changed, 255 * float(np.abs((light(windows) * taps).sum((-1, -2)) - light((windows * taps).sum((-1, -2)))).max()))
    assert largest - 1e-12 <= found.local_range <= loose + 1e-12
    assert changed <= bounds.gamma_filter_codes(found.local_range, found.filter_norm)


def test_full_contrast_ends_the_search_and_no_imagery_has_none(tmp_path: Path) -> None:
    black = np.zeros((100, 100, 3), np.uint8)
    black[40, 50] = 255
    dataset = built(tmp_path, black, block=32)
    assert measured(dataset).local_range == 1.0
    assert ImageryMeter(dataset).rows == 4 + 2


def test_transparency_counts_as_full_contrast(tmp_path: Path) -> None:
    grey = np.full((100, 100, 4), 128, np.uint8)
    grey[..., 3] = 255
    assert measured(built(tmp_path, grey, block=32)).local_range == 0.0
    (tmp_path / "other").mkdir()
    grey[70, 70, 3] = 254
    assert measured(built(tmp_path / "other", grey, block=32)).local_range == 1.0
