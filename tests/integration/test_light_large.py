"""Layers of light on maps so large that the sun stands elsewhere at each end, from the file to the stored sample."""

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine

from schemas.settings import BuildSettings
from tests.integration.lighting import light, samples
from tests.reference.sunrays import seen_from, sun_vector
from tests.reference.terrain import power_law_field
from tiler.building.build import build_layer

WIDTH, HEIGHT, CELL_DEG, WEST, NORTH = 320, 160, 0.125, 160.0, 68.0
"""40 degrees of longitude across the antimeridian, 48 to 68 N."""


def geographic_dataset(folder: Path, relief_m: float) -> tuple[Path, np.ndarray]:
    field = power_law_field(WIDTH, WIDTH, 3, 3.2)[:HEIGHT]
    heights = np.asarray(relief_m * (field - field.min()) / np.ptp(field), np.float32)
    transform = Affine(CELL_DEG, 0, WEST - CELL_DEG / 2, 0, -CELL_DEG, NORTH + CELL_DEG / 2)
    shape = {"width": WIDTH, "height": HEIGHT, "count": 1, "dtype": "float32"}
    with rasterio.open(folder / "dem.tif", "w", driver="GTiff", crs="EPSG:4326", transform=transform, **shape) as file:
        file.write(heights, 1)
    build_layer(folder / "dem.tif", folder / "dataset", BuildSettings(layer="height", codec="raw", block=32, task=64))
    return folder / "dataset", heights


def test_a_plain_is_lit_by_the_sun_of_every_place(tmp_path: Path) -> None:
    """Level ground at height 0 has the sine of the sun's elevation there: over 40 degrees of longitude that changes by more than 20."""
    dataset, _ = geographic_dataset(tmp_path, 0.0)
    found = samples(dataset, light(dataset, 230, 20, codec="exr:float"))
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].reshape(2, -1)
    longitudes, latitudes = np.radians(WEST + CELL_DEG * columns), np.radians(NORTH - CELL_DEG * rows)
    centre = WEST + CELL_DEG * (WIDTH - 1) / 2, NORTH - CELL_DEG * (HEIGHT - 1) / 2
    elevations = seen_from(longitudes, latitudes, sun_vector(*centre, 230, 20))[1].reshape(HEIGHT, WIDTH)
    assert np.ptp(elevations) > 20
    np.testing.assert_allclose(found, np.sin(np.radians(elevations)), atol=1e-4)


def test_zones_do_not_depend_on_workers_or_tasks(tmp_path: Path) -> None:
    dataset, _ = geographic_dataset(tmp_path, 14_000.0)
    options = {"codec": "exr:float", "overwrite": True, "sky": 4, "bounce": True}
    for shadows in ("hard", "certified", "soft"):
        found = {
            samples(dataset, light(dataset, 230, 12, shadows=shadows, workers=workers, task=task, **options)).tobytes()
            for workers, task in ((1, 32), (2, 128), (3, 64))
        }
        assert len(found) == 1


def test_light_has_no_step_between_zones(tmp_path: Path) -> None:
    """Without shadows neighbours on smooth ground differ by no more than the ground between them explains."""
    dataset, heights = geographic_dataset(tmp_path, 500.0)
    found = samples(dataset, light(dataset, 230, 30, codec="exr:float", shadows="none"))
    plain_steps = np.abs(np.diff(found, axis=1))
    ground_steps = np.abs(np.diff(np.gradient(heights.astype(float), axis=1), axis=1))
    flat = ground_steps < np.quantile(ground_steps, 0.2)
    assert plain_steps[flat].max() < 0.02
