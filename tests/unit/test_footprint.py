"""Extents, areas and spacings on the ellipsoid, against known figures of the Earth."""

import math

import pytest

from schemas.facts import Footprint
from schemas.lattice import Registration
from schemas.manifest import Layer, Transform
from tests.schemas.sample_manifest import make_manifest
from tiler.inspecting.footprint import measure_footprint

EARTH_M2 = 510_065_621_724_089
"""Area of the WGS 84 ellipsoid (GeographicLib)."""


def footprint(transform: Transform, width: int, height: int, crs: str | None, registration: Registration = "area") -> Footprint | None:
    layer = make_manifest().layers["height"]
    return measure_footprint(
        Layer.model_construct(**{**dict(layer), "transform": transform, "width": width, "height": height, "registration": registration}),
        crs,
    )


def known(*arguments: object) -> Footprint:
    found = footprint(*arguments)  # type: ignore[arg-type]
    assert found is not None
    return found


def test_the_whole_earth() -> None:
    found = known((1.0, 0.0, -180.0, 0.0, -1.0, 90.0), 360, 180, "EPSG:4326")
    assert found.area_m2 == pytest.approx(EARTH_M2, rel=1e-12)
    assert (found.west_deg, found.south_deg, found.east_deg, found.north_deg) == (-180, -90, 180, 90)
    assert not found.crosses_antimeridian
    assert found.row_spacing_m[1] == pytest.approx(111_319.49, abs=0.01)
    assert found.row_spacing_m[0] < 1000


def test_one_degree_at_the_equator() -> None:
    """A cell of one degree between 0 and 1 N, against the closed form of a zone's area on the ellipsoid."""
    found = known((0.1, 0.0, 10.0, 0.0, -0.1, 1.0), 10, 10, "EPSG:4326")
    a, f = 6_378_137.0, 1 / 298.257223563
    e, b, sine = math.sqrt(f * (2 - f)), a * (1 - f), math.sin(math.radians(1))
    zone = b * b / 2 * (sine / (1 - (e * sine) ** 2) + math.log((1 + e * sine) / (1 - e * sine)) / (2 * e))
    assert found.area_m2 == pytest.approx(math.radians(1) * zone, rel=1e-9)


def test_across_the_antimeridian() -> None:
    found = known((0.01, 0.0, 179.0, 0.0, -0.01, 10.0), 200, 100, "EPSG:4326")
    assert found.crosses_antimeridian
    assert (found.west_deg, found.east_deg) == pytest.approx((179, -179))
    same = known((0.01, 0.0, 20.0, 0.0, -0.01, 10.0), 200, 100, "EPSG:4326")
    assert found.area_m2 == pytest.approx(same.area_m2, rel=1e-9)


def test_over_the_pole() -> None:
    found = known((10_000.0, 0.0, -1e6, 0.0, -10_000.0, 1e6), 200, 200, "EPSG:3413")
    assert found.contains_pole
    assert (found.west_deg, found.east_deg, found.north_deg) == (-180, 180, 90)
    assert found.area_m2 == pytest.approx(4.216e12, rel=1e-3)


def test_web_mercator_stretches_towards_the_poles() -> None:
    found = known((1000.0, 0.0, 0.0, 0.0, -1000.0, 15e6), 100, 15_000, "EPSG:3857")
    assert found.row_spacing_m[1] == pytest.approx(1000, rel=1e-3)
    assert found.row_spacing_m[0] == pytest.approx(190, rel=0.05)


def test_a_point_layer_ends_at_its_samples() -> None:
    cells = known((1.0, 0.0, 10.0, 0.0, -1.0, 50.0), 4, 4, "EPSG:4326")
    points = known((1.0, 0.0, 10.0, 0.0, -1.0, 50.0), 5, 5, "EPSG:4326", "point")
    assert (points.east_deg, points.south_deg) == (cells.east_deg, cells.south_deg) == (14, 46)
    assert points.area_m2 == cells.area_m2


@pytest.mark.parametrize("crs", [None, "EPSG:4326"])
def test_unknown_places_have_no_footprint(crs: str | None) -> None:
    assert footprint((1.0, 0.0, 0.0, 0.0, -1.0, 200.0), 10, 10, crs) is None
