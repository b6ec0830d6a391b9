"""Distances on the ground, against facts that can be looked up or worked out by hand."""

from math import cos, radians, sqrt

import pytest

from tiler.geodesy import ground_spacing_m

EQUATOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
E2 = FLATTENING * (2 - FLATTENING)


def degree_east_m(latitude_deg: float) -> float:
    """Length of a degree of longitude: the radius of the parallel, by the textbook formula of the ellipsoid."""
    phi = radians(latitude_deg)
    return radians(1) * EQUATOR_M * cos(phi) / sqrt(1 - E2 * (1 - cos(phi) ** 2))


def degree_north_m(latitude_deg: float) -> float:
    """Length of a degree of latitude: the radius of curvature of the meridian."""
    phi = radians(latitude_deg)
    return radians(1) * EQUATOR_M * (1 - E2) / sqrt(1 - E2 * (1 - cos(phi) ** 2)) ** 3


def at(longitude_deg: float, latitude_deg: float, step_deg: float) -> tuple[float, float] | None:
    """Spacing of a north-up raster in degrees whose sample (0, 0) lies at the place."""
    return ground_spacing_m((step_deg, 0, longitude_deg, 0, -step_deg, latitude_deg), "EPSG:4326", 0, 0)


@pytest.mark.parametrize("latitude", [0.0, 10.0, 45.0, 60.0, -60.0, 80.0])
def test_degrees(latitude: float) -> None:
    step = 1 / 1200
    found = at(20, latitude, step)
    assert found == pytest.approx((step * degree_east_m(latitude), step * degree_north_m(latitude)), rel=1e-6)


def test_a_degree_at_60_north_is_half_as_wide() -> None:
    """55.80 km against 111.32 km on the equator; 111.41 km from north to south."""
    assert at(0, 60, 1e-3) == pytest.approx((55.800, 111.412), abs=1e-3)
    assert at(0, 0, 1e-3) == pytest.approx((111.320, 110.574), abs=1e-3)


def test_across_the_antimeridian() -> None:
    """0.0002 degrees at 10 degrees north are 21.93 m, not once around the earth."""
    east, _ = at(180, 10, 0.0002) or (0, 0)
    assert east == pytest.approx(21.93, abs=0.005)
    assert at(-180, 10, 0.0002) == pytest.approx(at(0, 10, 0.0002))


@pytest.mark.parametrize(("northing", "latitude"), [(0.0, 0.0), (8399737.89, 60.0)])
def test_web_mercator_is_stretched_by_one_over_the_cosine(northing: float, latitude: float) -> None:
    found = ground_spacing_m((100, 0, 1e6, 0, -100, northing), "EPSG:3857", 0, 0)
    assert found is not None
    assert found[0] == pytest.approx(100 * degree_east_m(latitude) / (radians(1) * EQUATOR_M), rel=1e-5)
    assert found == pytest.approx((100 * cos(radians(latitude)),) * 2, rel=0.01)


def test_utm_is_drawn_at_0_9996_on_its_central_meridian() -> None:
    found = ground_spacing_m((30, 0, 500000, 0, -30, 4000000), "EPSG:32618", 0, 0)
    assert found == pytest.approx((30 / 0.9996, 30 / 0.9996), rel=1e-6)


def test_feet() -> None:
    """New York Long Island, US survey feet: 100 ft are 30.48 m."""
    assert ground_spacing_m((100, 0, 984250, 0, -100, 200000), "EPSG:2263", 0, 0) == pytest.approx((30.48, 30.48), rel=1e-3)


def test_rows_and_columns_of_a_rotated_raster() -> None:
    """Columns run north, rows east."""
    step = 1e-3
    found = ground_spacing_m((0, step, 20, step, 0, 60), "EPSG:4326", 0, 0)
    assert found == pytest.approx((step * degree_north_m(60), step * degree_east_m(60)), rel=1e-6)


def test_the_distance_reaches_half_a_sample_to_either_side() -> None:
    """Ten degrees of a meridian from 35 to 45, not from 40 to 50."""
    found = ground_spacing_m((0, 10, 20, 10, 0, 40), "EPSG:4326", 0, 0)
    assert found is not None
    assert found[0] == pytest.approx(sum(degree_north_m(35 + (step + 0.5) / 100) for step in range(1000)) / 100, rel=1e-8)


def test_the_distance_is_that_at_the_sample_asked_for() -> None:
    step = 0.01
    found = ground_spacing_m((step, 0, 0, 0, -step, 80), "EPSG:4326", 1000, 2000)
    assert found == pytest.approx((step * degree_east_m(60), step * degree_north_m(60)), rel=1e-6)


def test_at_the_poles() -> None:
    """On the pole rows have no length, beyond it there is no place."""
    east, south = at(0, 89.9995, 1e-3) or (1e9, 1e9)
    assert 0 < east < 0.01
    assert south == pytest.approx(111.69, abs=0.01)
    assert at(0, 90, 1e-3) is None
    assert at(0, 95, 1e-3) is None


@pytest.mark.parametrize(
    "crs",
    [
        None,
        "EPSG:99999",
        "nonsense",
        'LOCAL_CS["quarry",UNIT["metre",1]]',
        'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]',
    ],
)
def test_without_a_usable_coordinate_system_nothing_is_known(crs: str | None) -> None:
    assert ground_spacing_m((1, 0, 0, 0, -1, 0), crs, 0, 0) is None


def test_where_a_projection_has_no_inverse_nothing_is_known() -> None:
    assert ground_spacing_m((100, 0, 9e7, 0, -100, 9e7), "EPSG:3035", 0, 0) is None
