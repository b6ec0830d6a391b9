"""A published anchor: the screen-space errors of Losasso & Hoppe's levels over Puget Sound.

Losasso & Hoppe, "Geometry Clipmaps: Terrain Rendering Using Nested Regular Grids", SIGGRAPH 2004, Table 2: how far a level, drawn
as triangles, is from the finest one, in pixels at the distance where the level begins. A sample spacing g is 3 pixels there (640
pixels across 90 degrees, n = 255), so the error is multiplied by 3 / g. From the finest of four levels to the coarsest they print rms
.15 .15 .14 .12 and 99.9 % .93 .86 .75 .58. Here the same region is sampled at 160 m, and clipmap's filter makes the levels; the figures
below were computed independently, in float64, when clipmap was designed.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.settings import BuildSettings
from tiler.accuracy.experiments import run_cascade
from tiler.filters.kernels import Kernel, blackman_sinc, box
from tiler.sources.convert import Source, choose_conversion
from tiler.sources.files import open_file

Array = NDArray[np.float64]

SPACING_M = 160.0
TRIANGLE_PX = 3.0
RMS_PX = (0.152, 0.157, 0.146, 0.119)
P999_PX = (0.94, 0.83, 0.73, 0.56)


@pytest.fixture(scope="module")
def puget_m(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> NDArray[np.float32]:
    reader = open_file(data_dir / "puget" / "ps_height_1k.png", tmp_path_factory.mktemp("scratch"))
    source = Source(reader, choose_conversion(reader.info, BuildSettings(layer="height", height_scale=0.1)))
    values, _ = source.read(reader.info.rect)
    source.close()
    return values


def triangulated(coarse: Array, step: int, falling: bool) -> Array:
    """The surface of two triangles per cell, at ``step`` places per cell; diagonals fall or rise to the right."""
    if not falling:
        return triangulated(coarse[:, ::-1], step, True)[:, ::-1]
    places = np.arange((len(coarse) - 1) * step + 1)
    cell = np.minimum(places // step, len(coarse) - 2)
    part = (places - cell * step) / step
    y, x, fy, fx = cell[:, np.newaxis], cell[np.newaxis, :], part[:, np.newaxis], part[np.newaxis, :]
    top_left, top_right, bottom_left, bottom_right = coarse[y, x], coarse[y, x + 1], coarse[y + 1, x], coarse[y + 1, x + 1]
    upper = top_left + fx * (top_right - top_left) + fy * (bottom_right - top_right)
    lower = top_left + fy * (bottom_left - top_left) + fx * (bottom_right - bottom_left)
    return np.asarray(np.where(fx >= fy, upper, lower), np.float64)


def screen_errors_px(finest: NDArray[np.float32], kernel: Kernel, falling: bool) -> list[Array]:
    """Absolute errors of levels 1 to 4 [px]."""
    errors: list[Array] = []
    for level, (values, _) in enumerate(run_cascade(finest, None, kernel, "antisymmetric", 4), start=1):
        surface = triangulated(values[..., 0].astype(np.float64), 2**level, falling)
        errors.append(np.abs(surface - finest[..., 0]) * TRIANGLE_PX / (SPACING_M * 2**level))
    return errors


@pytest.mark.parametrize("falling", [True, False], ids=["falling", "rising"])
def test_screen_space_errors_of_puget_sound(puget_m: NDArray[np.float32], falling: bool) -> None:
    errors = screen_errors_px(puget_m, blackman_sinc(6, "point"), falling)
    assert [float(np.sqrt(np.mean(error**2))) for error in errors] == pytest.approx(RMS_PX, rel=0.05)
    assert [float(np.percentile(error, 99.9)) for error in errors] == pytest.approx(P999_PX, rel=0.10)


def test_a_box_filter_would_not_pass(puget_m: NDArray[np.float32]) -> None:
    rms = [float(np.sqrt(np.mean(error**2))) for error in screen_errors_px(puget_m, box(1, "point"), True)]
    assert rms[1:] != pytest.approx(RMS_PX[1:], rel=0.05)
