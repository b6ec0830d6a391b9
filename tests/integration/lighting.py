"""Terrains in datasets, and the light on them, for tests."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from schemas.settings import BuildSettings, LightSettings
from tests.integration.files import assemble
from tests.reference.terrain import power_law_field
from tiler.building.build import build_layer
from tiler.building.light import LightReport, build_light
from tiler.stores.dataset import open_dataset

Array = NDArray[np.float64]
CELL_M = 30.0


def plain_tiff(path: Path, heights: NDArray[Any]) -> Path:
    """Write heights as a TIFF without a place in the world."""
    output = OpenImageIO.ImageOutput.create(str(path))
    assert output is not None
    assert output.open(str(path), OpenImageIO.ImageSpec(heights.shape[1], heights.shape[0], 1, "float"))
    assert output.write_image(np.ascontiguousarray(heights, np.float32)[..., np.newaxis])
    output.close()
    return path


def store_heights(folder: Path, heights: NDArray[Any], *, update: bool = False) -> Path:
    """Build ``heights`` as they are, ``CELL_M`` apart, rows from north to south; voids are NaN."""
    source = plain_tiff(folder / "dem.tif", heights)
    settings = BuildSettings(layer="height", codec="raw", block=32, spacing=CELL_M, task=64, update=update)
    build_layer(source, folder / "dataset", settings)
    return folder / "dataset"


def lit(dataset: Path, azimuth: float, elevation: float, **options: Any) -> Array:
    """Build a layer of exact light and return its level 0, NaN where it is void."""
    report = light(dataset, azimuth, elevation, **{"codec": "exr:float", "curvature": False, "overwrite": True, **options})
    return samples(dataset, report)


def light(dataset: Path, azimuth: float, elevation: float, **options: Any) -> LightReport:
    return build_light(dataset, LightSettings(azimuth_deg=azimuth, elevation_deg=elevation, **options))


def samples(dataset: Path, report: LightReport, level: int = 0) -> Array:
    opened = open_dataset(dataset)
    layer = opened.manifest.layer(report.build.layer)
    values, valid = assemble(opened, report.build.layer, level)
    found = np.where(valid, values[..., 0].astype(np.float64), np.nan)
    return np.asarray(found[: layer.levels[level].height, : layer.levels[level].width])


def rough(side: int = 160, seed: int = 5) -> NDArray[np.float32]:
    """Mountains: 1500 m over 5 km."""
    field = power_law_field(side, side, seed, 4.0)
    return np.asarray(400 * field - 400 * field.min(), np.float32)


def toward(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """The unit vector to the sun: east, north, up."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)


def ramp(east: float, north: float, side: int = 40) -> Array:
    rows, columns = np.mgrid[0:side, 0:side]
    return np.asarray(CELL_M * (east * columns - north * rows), np.float64)
