"""Running the command line in this process, and datasets to run it on."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

from cli.main import run
from schemas.settings import BuildSettings
from tests.contract.picture_files import write_with_rasterio
from tiler.building.build import build_layer

GOLDEN = Path(__file__).parent / "golden"


@dataclass(frozen=True)
class Ran:
    """How a command ended and what it printed, C libraries included."""

    code: int
    out: str
    err: str


Clipmap = Callable[..., Ran]
Golden = Callable[[str, str], None]


@pytest.fixture
def clipmap(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Clipmap:
    """Run the command with the given arguments on a terminal of 110 columns."""
    monkeypatch.setenv("COLUMNS", "110")
    monkeypatch.setenv("LINES", "40")

    def clipmap(*arguments: object) -> Ran:
        capfd.readouterr()
        code = run([str(argument) for argument in arguments])
        return Ran(code, *capfd.readouterr())

    return clipmap


@pytest.fixture
def golden() -> Golden:
    """Compare text with a file under ``golden``; with CLIPMAP_UPDATE_GOLDEN set, write the file instead."""

    def compare(name: str, text: str) -> None:
        path = GOLDEN / name
        if os.environ.get("CLIPMAP_UPDATE_GOLDEN"):
            path.write_text(text, encoding="utf-8")
        assert text == path.read_text(encoding="utf-8"), (
            f"{path.name} differs; if it should, set CLIPMAP_UPDATE_GOLDEN=1 and look at the change"
        )

    return compare


@dataclass(frozen=True)
class Sources:
    """Small source files in one folder."""

    dem: Path
    photo: Path


@pytest.fixture(scope="session")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Sources:
    """A plane of whole metres with a void corner (200 x 150, UTM), and a picture of ramps without georeference."""
    folder = tmp_path_factory.mktemp("sources")
    y, x = np.mgrid[0:150, 0:200]
    heights = (1000 + 2 * x - y).astype(np.int16)[..., np.newaxis]
    heights[100:, 150:] = -32768
    colours = np.stack([x, y, x // 2 + y // 2], axis=-1).astype(np.uint8)
    place = Affine(30, 0, 400000, 0, -30, 5200000)
    write_with_rasterio(folder / "dem.tif", heights, nodata=-32768, crs="EPSG:32632", transform=place)
    write_with_rasterio(folder / "photo.tif", colours)
    return Sources(folder / "dem.tif", folder / "photo.tif")


@pytest.fixture(scope="session")
def survey(sources: Sources, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of both, in raw blocks of 64 x 64, so that its bytes depend on no library; not to be changed."""
    folder = tmp_path_factory.mktemp("datasets") / "survey"
    for source in (sources.dem, sources.photo):
        build_layer(source, folder, BuildSettings(block=64, codec="raw", workers=1))
    return folder
