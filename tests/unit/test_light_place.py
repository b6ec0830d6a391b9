"""Which way a grid of heights lies, and where the sun is: against published numbers and other formulas."""

import math
from datetime import UTC, datetime, timedelta, timezone

import pytest

from schemas.errors import InputError, UsageError
from schemas.manifest import Layer, Transform, World
from tests.schemas.sample_manifest import make_layer
from tiler.geodesy import ground_spacing_m
from tiler.light.place import GridPlace, place_of
from tiler.light.sunposition import refracted_deg, sun_position


def placed(transform: Transform, crs: str | None, width: int = 100, height: int = 100) -> GridPlace:
    spacing = (1.0, 1.0) if crs is None else ground_spacing_m(transform, crs, width / 2, height / 2)
    layer = make_layer(kind="height", width=width, height=height, transform=transform, ground_spacing_m=spacing, registration="point")
    assert isinstance(layer, Layer)
    return place_of(layer, World(crs=crs, unit="metre"), "dem")


@pytest.mark.parametrize(("easting", "sign"), [(250_000.0, -1), (500_000.0, 0), (750_000.0, 1)])
def test_north_is_off_by_the_convergence_of_meridians(easting: float, sign: int) -> None:
    """In UTM grid north lies east of true north in the east of the northern hemisphere: tan g = tan(longitude) sin(latitude)."""
    found = placed((10, 0, easting - 495, 0, -10, 6_651_000), "EPSG:32632")
    assert found.longitude_deg is not None
    assert found.latitude_deg is not None
    expected = math.degrees(math.atan(math.tan(math.radians(found.longitude_deg - 9)) * math.sin(math.radians(found.latitude_deg))))
    off = (found.up_deg + 180) % 360 - 180
    assert off == pytest.approx(expected, abs=0.01)
    assert (abs(off) > 3.5) == bool(sign)
    assert math.copysign(1, off) == sign or not sign
    assert found.on_grid(180, 30).azimuth_deg == pytest.approx(180 - expected, abs=0.01)


@pytest.mark.parametrize(("angle", "mirrored"), [(0, False), (30, False), (200, False), (0, True), (75, True)])
def test_a_rotated_or_mirrored_grid_sees_the_sun_from_its_own_side(angle: float, mirrored: bool) -> None:
    """``angle`` is that of the direction of decreasing rows, clockwise from north; a mirrored grid counts the other way round."""
    sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    right = (-cosine, sine) if mirrored else (cosine, -sine)
    found = placed((right[0], -sine, 0, right[1], -cosine, 0), None)
    assert found.up_deg == pytest.approx(angle)
    sun = found.on_grid(100, 20).azimuth_deg
    assert math.cos(math.radians(sun - (angle - 100 if mirrored else 100 - angle))) == pytest.approx(1)


def test_c52_rows_of_a_geographic_grid_have_their_own_width() -> None:
    """60 arc minutes from 61 to 60 N: samples of a minute are 901 m wide at the top, 930 m at the bottom, 1857 m high."""
    found = placed((1 / 60, 0, 10, 0, -1 / 60, 61), "EPSG:4326", 61, 61)
    assert found.up_deg == pytest.approx(0, abs=1e-9)
    assert found.cells_m[0, 0] == pytest.approx(901.7, abs=0.5)
    assert found.cells_m[0, 60] == pytest.approx(930.0, abs=0.5)
    assert found.cells_m[1] == pytest.approx(1857, abs=0.5)
    assert (found.cells_m[0, 1:] > found.cells_m[0, :-1]).all()


def test_c57_south_of_the_equator_and_rows_that_run_north() -> None:
    south = placed((1 / 60, 0, 10, 0, -1 / 60, -60), "EPSG:4326", 61, 61)
    upward = placed((1 / 60, 0, 10, 0, 1 / 60, -61), "EPSG:4326", 61, 61)
    assert south.cells_m[0, 60] == pytest.approx(901.7, abs=0.5)
    assert upward.handed == -1
    assert upward.up_deg == pytest.approx(180)
    assert upward.cells_m[0, ::-1] == pytest.approx(south.cells_m[0])
    assert upward.on_grid(90, 10).azimuth_deg == pytest.approx(90)
    assert upward.on_grid(0, 10).azimuth_deg == pytest.approx(180)


def test_c53_the_row_at_a_pole_has_no_width_and_c54_the_antimeridian_is_no_seam() -> None:
    polar = placed((1.0, 0, -180, 0, -1.0, 90), "EPSG:4326", 360, 91)
    assert 0 <= polar.cells_m[0, 0] < 1000
    assert (polar.cells_m > 0).all()
    across = placed((0.0002, 0, 179.9, 0, -0.0002, 10), "EPSG:4326", 1001, 100)
    assert across.cell_m[0] == pytest.approx(21.93, abs=0.01)
    assert across.up_deg == pytest.approx(0, abs=1e-6)


def test_oblique_rows_are_refused() -> None:
    with pytest.raises(InputError, match=r"dem: its rows and columns are 120.0 degrees apart"):
        placed((1, 0.5, 0, 0, -math.sqrt(0.75), 0), None)
    with pytest.raises(UsageError, match="dem: nothing says how far apart the samples are"):
        placed((10, 0, 9e9, 0, -10, 9e9), "EPSG:32632")


def test_the_sun_over_colorado() -> None:
    """The worked example of the Solar Position Algorithm (Reda and Andreas, NREL/TP-560-34302, A.5): its topocentric elevation is 39.872046
    before refraction, the azimuth 194.340241, at 1830 m; height moves the sun by some millionths of a degree only."""
    when = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    azimuth, elevation = sun_position(when, -105.1786, 39.742476)
    assert azimuth == pytest.approx(194.340241, abs=2e-3)
    assert elevation == pytest.approx(39.872046, abs=2e-3)


def test_the_sun_of_midsummer_and_the_southern_sky() -> None:
    """At noon of a solstice it stands 90 - latitude + 23.44 degrees high; over the Cape it passes in the north."""
    noon = datetime(2024, 6, 20, 12, 2, tzinfo=UTC)
    assert sun_position(noon, 0, 50)[1] == pytest.approx(63.44, abs=0.02)
    azimuth, elevation = sun_position(noon, 0, -34)
    assert math.cos(math.radians(azimuth)) > 0.9999
    assert elevation == pytest.approx(90 - 34 - 23.44, abs=0.02)
    with pytest.raises(UsageError, match="add the offset from UTC"):
        sun_position(datetime(2024, 6, 20, 12, 0), 0, 0)


@pytest.mark.parametrize(("elevation", "lift_arcmin"), [(0, 28.9), (8, 6.6), (30, 1.75), (90, 0)])
def test_the_air_lifts_the_sun(elevation: float, lift_arcmin: float) -> None:
    assert 60 * (refracted_deg(elevation) - elevation) == pytest.approx(lift_arcmin, abs=0.1)


def test_the_lift_goes_on_below_the_horizon() -> None:
    lifts = [refracted_deg(elevation / 10) - elevation / 10 for elevation in range(-300, 20)]
    assert all(0.25 < lift < 0.8 for lift in lifts)
