"""Source files shared by the tests of whole builds."""

from pathlib import Path

import numpy as np
import pytest

from tests.integration.files import write_tiff
from tests.reference.terrain import photo, terrain


@pytest.fixture(scope="session")
def height_tiff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pixels = terrain(301, 523, seed=3).astype(np.float32)
    pixels[100:140, 200:260] = np.nan
    return write_tiff(tmp_path_factory.mktemp("height") / "height.tif", pixels)


@pytest.fixture(scope="session")
def photo_tiff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiff(tmp_path_factory.mktemp("photo") / "photo.tif", photo(350, 610, seed=3), tiled=False, blockysize=16)
