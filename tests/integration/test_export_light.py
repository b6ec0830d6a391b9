"""Layers of light in other programs' forms: the same light, void where it is void."""

from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import rasterio

from schemas.errors import UsageError
from tests.integration.export_datasets import exported
from tests.integration.lighting import Array, light, rough, samples, store_heights


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Light over ground with a void, as floats, as 8 bits and as 16 bits."""
    heights = rough(150)
    heights[40:60, 70:90] = np.nan
    place = store_heights(tmp_path_factory.mktemp("light"), heights)
    kinds: dict[str, dict[str, Any]] = {"floats": {"codec": "exr:float"}, "codes": {}, "fine": {"bits": 16}}
    for name, options in kinds.items():
        light(place, 250, 20, layer=name, **options)
    return place


def in_exr(path: Path) -> tuple[Array, Array]:
    with OpenEXR.File(str(path)) as file:
        channels = {name: np.array(channel.pixels, np.float64) for name, channel in file.parts[0].channels.items()}
    return channels["Y"], channels["A"]


@pytest.mark.parametrize(("name", "tolerance"), [("floats", 0.0), ("fine", 3e-5), ("codes", 6e-3)])
def test_exr_holds_the_light_itself(name: str, tolerance: float, dataset: Path, tmp_path: Path) -> None:
    expected = samples(dataset, light(dataset, 250, 20, layer="floats", codec="exr:float"))
    exported(dataset, "exr", tmp_path / "light.exr", layer=name)
    found, alpha = in_exr(tmp_path / "light.exr")
    np.testing.assert_array_equal(alpha == 0, np.isnan(expected))
    np.testing.assert_allclose(found, np.nan_to_num(expected), atol=tolerance)


def test_a_cog_of_floats_has_the_samples_and_no_others(dataset: Path, tmp_path: Path) -> None:
    expected = samples(dataset, light(dataset, 250, 20, layer="floats", codec="exr:float"))
    exported(dataset, "cog", tmp_path / "light.tif", layer="floats")
    with rasterio.open(tmp_path / "light.tif") as file:
        assert np.isnan(file.nodata)
        np.testing.assert_array_equal(file.read(1), expected.astype(np.float32))


@pytest.mark.parametrize("name", ["codes", "fine"])
def test_deep_zoom_has_codes_and_transparency(name: str, dataset: Path, tmp_path: Path) -> None:
    exported(dataset, "dzi", tmp_path / "light.dzi", layer=name)
    tile = imagecodecs.imread(tmp_path / "light_files/8/1_1.png")
    floats = samples(dataset, light(dataset, 250, 20, layer="floats", codec="exr:float"))[32:64, 32:64]
    top = np.iinfo(tile.dtype).max
    np.testing.assert_array_equal(tile[..., -1] == 0, np.isnan(floats))
    encoded = top * np.where(floats <= 0.0031308, 12.92 * floats, 1.055 * np.abs(floats) ** (1 / 2.4) - 0.055)
    assert np.nanmax(np.abs(np.where(np.isnan(floats), np.nan, tile[..., 0]) - encoded)) <= 0.51


def test_pictures_cannot_hold_floats(dataset: Path, tmp_path: Path) -> None:
    """2026-11-23: the refusal spoke of the codec png and of imagery, which nobody had asked for."""
    with pytest.raises(
        UsageError, match="layer 'floats' holds light in floats, which no picture can: export it as exr or cog, or build it"
    ):
        exported(dataset, "dzi", tmp_path / "light.dzi", layer="floats")
    assert not list(tmp_path.iterdir())
