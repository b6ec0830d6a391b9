"""Hard cases of geodesy: what a sample measures on the ground, where spheres and degrees mislead."""

from pathlib import Path

import numpy as np
import pytest

from tests.integration.files import settings, write_tiff
from tests.reference.terrain import terrain
from tiler.building.build import build_layer
from tiler.geodesy import ground_spacing_m

STEP = 0.0002777777777777778
"""One arc second."""


@pytest.mark.parametrize(
    ("latitude", "east_m", "north_m"),
    [(60.0, 15.50000, 30.94715), (0.0, 30.92208, 30.71548), (80.0, 5.38708, 31.01722), (-60.0, 15.50000, 30.94715)],
)
def test_c52_geographic_spacing_is_geodesic(latitude: float, east_m: float, north_m: float) -> None:
    """An arc second at 60 N is 15.50000 m wide on WGS 84; a sphere gives 15.44376 m, the 111320 m rule 15.46111 m."""
    found = ground_spacing_m((STEP, 0, 10, 0, -STEP, latitude), "EPSG:4326", 0, 0)
    assert found == pytest.approx((east_m, north_m), abs=2e-3)


def test_c53_pole_row_collapses_without_a_division() -> None:
    """At the pole east-west spacing is 0; beyond it there is no place: unknown, not a number made up."""
    near = ground_spacing_m((STEP, 0, 10, 0, -STEP, 90 - STEP), "EPSG:4326", 0, 0)
    assert near is not None
    assert 0 < near[0] < 0.01
    assert ground_spacing_m((1, 0, 0, 0, -1, 90), "EPSG:4326", 0, 0) is None


def test_c54_antimeridian_neighbours_are_neighbours() -> None:
    """179.9999 and -179.9999 at 10 N are 21.93 m apart, not once around the Earth."""
    found = ground_spacing_m((0.0002, 0, 180, 0, -0.0002, 10), "EPSG:4326", 0, 0)
    assert found is not None
    assert found[0] == pytest.approx(21.93, abs=0.01)


def test_c55_across_the_pole() -> None:
    """In polar stereographic (true at 70 N) a kilometre at the pole is 1031 m on the ground, along both axes, and the pole is no seam."""
    found = ground_spacing_m((1000, 0, 0, 0, -1000, 0), "EPSG:3413", 0, 0)
    assert found is not None
    assert found == pytest.approx((found[0], found[0]), rel=1e-9)
    assert found[0] == pytest.approx(1031.1, abs=0.5)


def test_c56_nearly_antipodal_neighbours() -> None:
    """Samples 179.5 degrees apart: the geodesic converges (iterations that start from a sphere do not), at most half around the Earth."""
    found = ground_spacing_m((179.5, 0, 0, 0, -0.5, 0.25), "EPSG:4326", 0, 0)
    assert found is not None
    assert 19_900_000 < found[0] < 20_004_000


def test_c57_southern_hemisphere_and_south_up() -> None:
    """Signs do not matter: the same spacing north and south of the equator, and with rows from south to north."""
    spacings = [ground_spacing_m((STEP, 0, 10, 0, sign * STEP, latitude), "EPSG:4326", 0, 0) for sign in (1, -1) for latitude in (45, -45)]
    assert all(spacing == pytest.approx(spacings[0], rel=1e-9) for spacing in spacings)


def test_web_mercator_stretch() -> None:
    """At 60 N ten metres of EPSG:3857 are N cos(60) / a = 5.0126 m of parallel and M cos(60) / a = 5.0042 m of meridian."""
    found = ground_spacing_m((10, 0, 0, 0, -10, 8_399_737.89), "EPSG:3857", 0, 0)
    assert found == pytest.approx((5.01260, 5.00417), abs=1e-4)


def test_c51_unequal_spacing_is_kept_per_axis(tmp_path: Path) -> None:
    """Cells of 1 by 100 metres: both spacings are in the manifest, along rows and along columns."""
    source = write_tiff(tmp_path / "cells.tif", terrain(40, 40).astype(np.float32), transform=(1.0, 0.0, 500_000.0, 0.0, -100.0, 5e6))
    report = build_layer(source, tmp_path / "out", settings())
    spacing = report.manifest.layer("height").ground_spacing_m
    assert spacing is not None
    assert spacing == pytest.approx((1.0004, 100.04), rel=1e-4)
