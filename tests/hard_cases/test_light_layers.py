"""Hard cases 32 to 57 of light: where each is shown, and those that only a whole layer of light can show.

A layer goes from a file through the stored heights and their place on the Earth to the decoded samples of ``clipmap light``.
"""

import math
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from numpy.typing import NDArray

from cli.main import run
from schemas.settings import LightSettings
from tests.integration.files import settings, write_tiff
from tests.integration.lighting import lit, plain_tiff, rough, samples, store_heights
from tiler.building.build import build_layer
from tiler.building.light import build_light
from tiler.geodesy import ground_spacing_m

SHOWN: Final = {
    32: {
        "hard_cases/test_light.py": ["test_c32_sun_at_the_zenith"],
        "integration/test_light.py": ["test_a_plane_has_the_cosine_of_its_incidence_everywhere"],
    },
    33: {
        "hard_cases/test_light.py": ["test_c33_sun_almost_at_the_zenith"],
    },
    34: {
        "hard_cases/test_light.py": ["test_c34_sun_on_the_horizon_of_a_flat_earth", "test_c34_sun_on_the_horizon_of_a_round_earth"],
        "hard_cases/test_light_layers.py": ["test_c34_a_sun_on_the_horizon_lights_what_faces_it"],
    },
    35: {
        "hard_cases/test_light.py": ["test_c35_sun_below_the_horizon"],
        "integration/test_light.py": ["test_the_sun_under_the_horizon_lights_summits_only"],
        "hard_cases/test_light_layers.py": ["test_c35_summits_are_lit_by_a_sun_below_the_horizon"],
    },
    36: {
        "hard_cases/test_light.py": ["test_c36_sun_of_which_nothing_is_seen"],
        "hard_cases/test_light_layers.py": ["test_c36_the_disc_goes_down"],
    },
    37: {
        "unit/test_shadow.py": ["test_along_rows_columns_and_diagonals_the_sweep_is_exact"],
        "unit/test_horizon.py": ["test_along_rows_columns_and_diagonals_hulls_are_exact"],
        "hard_cases/test_light_layers.py": ["test_c37_to_c39_at_and_beside_the_diagonals"],
    },
    38: {
        "hard_cases/test_light.py": ["test_c38_azimuths_go_round"],
        "hard_cases/test_light_layers.py": ["test_c38_azimuths_of_a_layer"],
    },
    39: {
        "hard_cases/test_light.py": ["test_c39_no_seam_where_the_axes_change_over"],
        "hard_cases/test_light_layers.py": ["test_c37_to_c39_at_and_beside_the_diagonals"],
    },
    40: {
        "hard_cases/test_light.py": ["test_c40_turned_by_a_quarter"],
        "integration/test_light.py": ["test_a_turned_terrain_has_the_turned_light"],
    },
    41: {
        "hard_cases/test_light.py": ["test_c41_plane"],
        "integration/test_light.py": ["test_a_flat_plain_sees_all_of_the_sky_and_nothing_else"],
    },
    42: {
        "hard_cases/test_light.py": ["test_c42_plane_at_the_elevation_of_the_sun"],
        "hard_cases/test_light_layers.py": ["test_c42_a_grazed_plane_is_dark_by_lambert_alone"],
    },
    43: {
        "hard_cases/test_light.py": ["test_c43_spike"],
        "hard_cases/test_light_layers.py": ["test_c51_shadows_of_a_spike_on_the_ground"],
    },
    44: {
        "hard_cases/test_light.py": ["test_c44_cliff"],
        "hard_cases/test_light_layers.py": ["test_c44_no_light_behind_a_cliff_across_blocks"],
    },
    45: {
        "hard_cases/test_light.py": ["test_c45_wall_and_a_line_of_100_000_samples"],
    },
    46: {
        "hard_cases/test_light.py": ["test_c46_cap"],
        "integration/test_light.py": ["test_c46_the_terminator_of_a_dome"],
    },
    47: {
        "integration/test_light.py": ["test_c47_the_sky_from_the_bottom_of_a_conical_pit"],
        "unit/test_accuracy_bounce.py": ["test_c47_the_bottom_of_a_pit"],
    },
    48: {
        "integration/test_light.py": ["test_c48_light_between_the_walls_of_a_valley"],
        "unit/test_accuracy_bounce.py": ["test_c48_one_side_of_a_valley_sees_the_other"],
    },
    49: {
        "unit/test_shadow.py": ["test_bands_give_the_bits_of_one_piece"],
        "unit/test_shadow_certified.py": ["test_bands_and_forgotten_rows_do_not_show"],
        "unit/test_horizon.py": ["test_bands_give_the_bits_of_one_piece"],
        "integration/test_light.py": ["test_nothing_depends_on_workers_tasks_or_how_it_was_cut"],
    },
    50: {
        "hard_cases/test_light.py": ["test_c50_curved_sea"],
    },
    51: {
        "hard_cases/test_light.py": ["test_c51_shadow_of_a_pole_in_cells_of_any_shape"],
        "hard_cases/test_geodesy.py": ["test_c51_unequal_spacing_is_kept_per_axis"],
        "hard_cases/test_light_layers.py": ["test_c51_shadows_of_a_spike_on_the_ground"],
    },
    52: {
        "hard_cases/test_geodesy.py": ["test_c52_geographic_spacing_is_geodesic"],
        "unit/test_light_place.py": ["test_c52_rows_of_a_geographic_grid_have_their_own_width"],
    },
    53: {
        "hard_cases/test_geodesy.py": ["test_c53_pole_row_collapses_without_a_division"],
        "hard_cases/test_light.py": ["test_c53_row_at_a_pole"],
        "hard_cases/test_light_layers.py": ["test_c53_light_up_to_the_pole", "test_c53_light_around_the_pole"],
    },
    54: {
        "hard_cases/test_geodesy.py": ["test_c54_antimeridian_neighbours_are_neighbours"],
        "hard_cases/test_light_layers.py": ["test_c54_light_across_the_antimeridian"],
    },
    55: {
        "hard_cases/test_geodesy.py": ["test_c55_across_the_pole"],
        "hard_cases/test_light_layers.py": ["test_c55_c56_geodesics_that_are_hard"],
    },
    56: {
        "hard_cases/test_geodesy.py": ["test_c56_nearly_antipodal_neighbours"],
        "hard_cases/test_light_layers.py": ["test_c55_c56_geodesics_that_are_hard"],
    },
    57: {
        "hard_cases/test_geodesy.py": ["test_c57_southern_hemisphere_and_south_up"],
        "hard_cases/test_light_layers.py": ["test_c57_light_in_the_south"],
    },
    58: {
        "hard_cases/test_light.py": ["test_c58_large_offsets_of_all_heights"],
        "hard_cases/test_light_layers.py": ["test_c58_offsets_of_heights_and_of_coordinates"],
    },
}
"""By the number of the case, the files and tests that show it."""


def test_every_case_is_shown() -> None:
    """The table names tests that there are, for all cases without a gap."""
    assert list(SHOWN) == list(range(32, 59))
    folder = Path(__file__).parents[1]
    for path, names in (named for shown in SHOWN.values() for named in shown.items()):
        there = set(re.findall(r"^def (\w+)\(", (folder / path).read_text(encoding="utf-8"), re.MULTILINE))
        assert set(names) <= there, path


Array = NDArray[np.float64]


def store_at(folder: Path, heights: NDArray[Any], transform: Any, crs: str = "EPSG:4326") -> Path:
    """Build heights that lie at a place on the Earth."""
    folder.mkdir(exist_ok=True)
    source = write_tiff(folder / "dem.tif", np.asarray(heights, np.float32)[..., np.newaxis], transform=transform, crs=crs)
    build_layer(source, folder / "dataset", settings(layer="height", codec="raw", block=32, task=64))
    return folder / "dataset"


def hills(height: int, width: int) -> Array:
    """Smooth ground, so that a grid that lies a hair elsewhere has light that is a hair different."""
    rows, columns = np.mgrid[0:height, 0:width]
    return np.asarray(300 * np.sin(rows / 7) * np.cos(columns / 5) + 3 * columns, np.float64)


def edges(light: Array) -> NDArray[np.bool_]:
    """Samples beside which there is one in the shadow where they are lit, or the other way round."""
    dark = np.pad(light == 0, 1, mode="edge")
    near = [dark[1 + dy : dark.shape[0] - 1 + dy, 1 + dx : dark.shape[1] - 1 + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.asarray(np.any(near, axis=0) & ~np.all(near, axis=0))


def assert_same_but_edges(found: Array, expected: Array, tolerance: float) -> None:
    """Assert that light is the same, but for samples on the outline of shadows, of which few may differ."""
    assert 0.1 < (expected == 0).mean() < 0.9, "else no shadow is compared"
    different = np.abs(found - expected) > tolerance
    assert not (different & ~edges(expected)).any()
    assert different.mean() < 0.01


def test_c34_a_sun_on_the_horizon_lights_what_faces_it(tmp_path: Path) -> None:
    """At 0 degrees a plain gets nothing, a slope toward the sun the sine of its angle, and what is behind anything higher nothing."""
    heights = np.zeros((60, 60))
    heights[:, 20:30] = 30 * np.arange(10)[::-1] * math.tan(math.radians(20))
    heights[:, :20] = heights[0, 20]
    found = lit(store_heights(tmp_path, heights), 90, 0)
    assert (found[:, 31:] == 0).all()
    assert (found[:, :20] == 0).all()
    np.testing.assert_allclose(found[:, 21:29], math.sin(math.radians(20)), atol=1e-6)
    assert (lit(tmp_path / "dataset", 270, 0) == 0).all(), "all of it lies behind the high plain, or as high"


@pytest.mark.parametrize(("elevation", "refraction"), [(-1.0, False), (-2.0, False), (-0.6, True), (-1.5, True)])
@pytest.mark.parametrize("shadows", ["hard", "certified", "soft"])
def test_c35_summits_are_lit_by_a_sun_below_the_horizon(shadows: str, elevation: float, refraction: bool, tmp_path: Path) -> None:
    """Above R (1 / cos el - 1) of a sphere that refraction makes larger, by as much of the disc as is above the sea's horizon."""
    heights = np.repeat(np.linspace(0, 4000, 101)[:, np.newaxis], 40, axis=1)
    dataset = store_heights(tmp_path, heights)
    report = build_light(
        dataset,
        LightSettings(azimuth_deg=0, elevation_deg=elevation, shadows=shadows, refraction=refraction, codec="exr:float", radius_deg=0.2666),
    )
    apparent, radius = report.light.elevation_deg, 6_371_008.8 / (1 - report.light.refraction)
    assert (apparent > elevation) == refraction
    found = samples(dataset, report)[:, 20]
    if apparent >= 0:
        assert (found[1:-1] > 0).all()
        return
    # The sun is lower by the angle between the verticals, the farther a row lies away from it: a quarter of a minute here, 26 m of height.
    local = math.radians(apparent) - np.linspace(-50, 50, 101) * 30 / radius

    def shadow_of_the_earth(angle: Array) -> Array:
        return np.asarray(radius * (1 / np.cos(np.minimum(angle, 0)) - 1), np.float64)

    above = heights[:, 20] - shadow_of_the_earth(local)
    if shadows != "soft":
        assert (found[above > 1] > 0).all()
        assert (found[above < -1] == 0).all()
        return
    disc = math.radians(0.2666)
    assert (found[heights[:, 20] < shadow_of_the_earth(local + disc) - 1] == 0).all()
    whole = heights[:-1, 20] > shadow_of_the_earth(local - disc)[:-1] + 1
    np.testing.assert_allclose(found[:-1][whole], np.sin(math.atan(40 / 30) + local[:-1][whole]), atol=1e-4)
    half = np.abs(above[:-1]) < 20
    assert (found[:-1][half] > 0.3 * math.sin(math.atan(40 / 30))).all()


def test_c36_the_disc_goes_down(tmp_path: Path) -> None:
    """A slope before a flat horizon: half of the disc at 0 degrees, a sliver at -0.25, nothing at -0.2667 nor at -0.833."""
    slope = 30 * np.repeat(np.arange(60)[::-1][:, np.newaxis], 40, axis=1)
    dataset = store_heights(tmp_path, slope)
    shares = []
    for elevation in (0.27, 0.0, -0.25, -0.2667, -0.833):
        found = lit(dataset, 180, elevation, shadows="soft")[30, 20]
        shares.append(found / math.sin(math.radians(45 + elevation)))
    assert shares == pytest.approx([1, 0.5, 0.0092, 0, 0], abs=1e-3)
    assert shares[2] > 0 == shares[3] == shares[4]


@pytest.mark.parametrize("azimuth", [45, 135, 225, 315])
def test_c37_to_c39_at_and_beside_the_diagonals(azimuth: int, tmp_path: Path) -> None:
    """Hard shadows are those that are certified, and a hair beside they differ on outlines only."""
    dataset = store_heights(tmp_path, hills(110, 130))
    at = lit(dataset, azimuth, 20)
    assert at.tobytes() == lit(dataset, azimuth, 20, shadows="certified").tobytes()
    for aside in (-1e-7, 1e-7):
        assert_same_but_edges(lit(dataset, azimuth + aside, 20), at, 1e-6)


def test_c38_azimuths_of_a_layer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whole turns and negative angles make the same layer; what is no angle is a sentence."""
    dataset = store_heights(tmp_path, rough(70))
    expected = lit(dataset, 290.5, 20)
    for azimuth in (290.5 + 720, -69.5):
        assert lit(dataset, azimuth, 20).tobytes() == expected.tobytes()
    for wrong in ("nan,10", "inf,10", "270,nan", "270,91", "270"):
        assert run(["light", str(dataset), "--sun", wrong, "--layer", "more"]) == 2
        error = capsys.readouterr().err
        assert "--sun" in error
        assert "Traceback" not in error


@pytest.mark.parametrize("azimuth", [0, 90, 45, 201])
def test_c42_a_grazed_plane_is_dark_by_lambert_alone(azimuth: int, tmp_path: Path) -> None:
    """The rays lie in the plane: it is not in its own shadow, and gets the cosine of 90 degrees."""
    rise = math.tan(math.radians(30))
    rows, columns = np.mgrid[0:50, 0:50]
    sine, cosine = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    heights = -30 * rise * (sine * columns - cosine * rows)
    assert np.abs(lit(store_heights(tmp_path, heights), azimuth + 180, 30, shadows="none")).max() < 2e-5
    assert (lit(store_heights(tmp_path, heights, update=True), azimuth, 29, shadows="none") > 0.5).all()


def test_c44_no_light_behind_a_cliff_across_blocks(tmp_path: Path) -> None:
    """The shadow of 900 m at 45 degrees is dark from the foot to its end, over the borders of blocks of 32 and tasks of 64."""
    heights = np.zeros((100, 160))
    heights[:, :40] = 900.0
    for options in ({}, {"shadows": "certified"}, {"shadows": "soft"}):
        found = lit(store_heights(tmp_path, heights, update=bool(options)), 270, 45, **options)
        assert (found[:, 41:69] == 0).all()
        assert (found[:, 72:] > 0.7).all()
        assert (found[:, :38] > 0.7).all()


@pytest.mark.parametrize("cell", [(10.0, 10.0), (10.0, 1000.0), (1000.0, 10.0)])
@pytest.mark.parametrize("azimuth", [0.0, 30.0, 135.0, 250.0])
def test_c51_shadows_of_a_spike_on_the_ground(cell: tuple[float, float], azimuth: float, tmp_path: Path) -> None:
    """In metres, away from true north's azimuth: within two samples of the line, and as long as height / tan(elevation)."""
    side, tall = 161, max(30 * min(cell), 3 * max(cell))
    heights = np.zeros((side, side))
    heights[80, 80] = tall
    dataset = store_at(tmp_path, heights, (cell[0], 0, 500_000, 0, -cell[1], 6_651_000), "EPSG:32632")
    report = build_light(
        dataset, LightSettings(azimuth_deg=azimuth, elevation_deg=25, shadows="certified", codec="exr:float", curvature=False)
    )
    found = samples(dataset, report)
    rows, columns = np.nonzero(found == 0)
    assert rows.size
    up = report.light.azimuth_deg - report.light.grid_azimuth_deg
    turn = math.radians(azimuth - up)
    east, south = (columns - 80) * cell[0], (rows - 80) * cell[1]
    away, aside = south * math.cos(turn) - east * math.sin(turn), south * math.sin(turn) + east * math.cos(turn)
    assert np.abs(aside).max() <= 2 * max(abs(cell[0] * math.cos(turn)), abs(cell[1] * math.sin(turn)), min(cell))
    assert away.max() <= tall / math.tan(math.radians(25)) + max(cell)
    assert away.min() >= -2 * max(cell), "beside the spike its own slopes are turned away"


def at_longitude(folder: Path, west: float, south_up: bool = False) -> Path:
    step = 1 / 600
    place = (step, 0, west, 0, step, 9.8) if south_up else (step, 0, west, 0, -step, 10)
    return store_at(folder, hills(120, 140), place)


def test_c54_light_across_the_antimeridian(tmp_path: Path) -> None:
    """From 179.9 E to 179.9 W: the light of the same ground at 10 E, shadows across the seam included."""
    here = lit(at_longitude(tmp_path / "here", 10), 250, 8, curvature=True, sky=8)
    there = lit(at_longitude(tmp_path / "there", 179.9), 250, 8, curvature=True, sky=8)
    np.testing.assert_allclose(there, here, atol=1e-6)
    bare = lit(tmp_path / "there/dataset", 250, 8)
    assert_same_but_edges(bare, lit(tmp_path / "here/dataset", 250, 8), 1e-6)


def test_c57_light_in_the_south(tmp_path: Path) -> None:
    """The mirrored ground south of the equator under the mirrored sun has the mirrored light; rows may run north as well as south."""
    step = 1 / 600
    ground = hills(120, 140)
    north = lit(store_at(tmp_path / "north", ground, (step, 0, 10, 0, -step, 50)), 250, 8)
    south = lit(store_at(tmp_path / "south", ground[::-1], (step, 0, 10, 0, -step, -50 + 120 * step)), 290, 8)
    upward = lit(store_at(tmp_path / "upward", ground[::-1], (step, 0, 10, 0, step, 50 - 120 * step)), 250, 8)
    assert_same_but_edges(south[::-1], north, 1e-5)
    assert_same_but_edges(upward[::-1], north, 1e-5)


@pytest.mark.parametrize("north", [True, False])
def test_c53_light_up_to_the_pole(north: bool, tmp_path: Path) -> None:
    """Samples of the row at a pole are all at one place: light there is finite, and all others have theirs."""
    rows = np.arange(91.0)
    heights = np.repeat((4000 * np.cos(rows / 9))[:, np.newaxis], 180, axis=1)
    heights = heights if north else heights[::-1]
    dataset = store_at(tmp_path, heights, (2, 0, -180, 0, -0.25, 90 if north else -90 + 91 * 0.25))
    for options in ({"shadows": "certified"}, {"shadows": "soft", "sky": 4}):
        found = lit(dataset, 180 if north else 0, 40, **options)
        assert np.isfinite(found).all()
        assert found.min() > 0.3
        assert found.max() <= 1


def test_c53_light_around_the_pole(tmp_path: Path) -> None:
    """In polar stereographic the pole is a place as any other: a cone around it is lit from the side of the sun, and turns with it."""
    rows, columns = np.mgrid[-60:61, -60:61]
    cone = 1000 * np.maximum(0, 40 - np.hypot(rows, columns))
    dataset = store_at(tmp_path, cone, (1000, 0, -60_500, 0, -1000, 60_500), "EPSG:3413")
    found = [lit(dataset, azimuth, 30) for azimuth in (0, 90, 180, 270)]
    assert found[0].std() > 0.1
    for light, turned in zip(found, [*found[1:], found[0]], strict=True):
        np.testing.assert_allclose(np.rot90(light, -1), turned, atol=1e-5)
    facing = [light[90, 60] for light in found]
    assert sorted(facing)[-1] > 2 * sorted(facing)[0]


def test_c55_c56_geodesics_that_are_hard() -> None:
    """223.39 m over the pole from 89.999 N to 89.999 N; 19 944 127.42 m to a place 179.7 degrees off, where iterations fail."""
    over = ground_spacing_m((180, 0, 0, 0, -0.001, 89.999), "EPSG:4326", 0.5, 0)
    assert over is not None
    assert over[0] == pytest.approx(223.39, abs=0.01)
    assert over[1] == pytest.approx(111.69, abs=0.01)
    far = ground_spacing_m((179.7, 1, 0, 0.5, -0.5, 0), "EPSG:4326", 0.5, 0)
    assert far is not None
    assert far[0] == pytest.approx(19_944_127.42, abs=0.01)
    assert Geodesic.WGS84.Inverse(0, 0, 0.5, 179.7)["s12"] == pytest.approx(far[0], abs=1e-6)


def test_c58_offsets_of_heights_and_of_coordinates(tmp_path: Path) -> None:
    """Whole metres on top of 10 million give the same bits; coordinates of 10 million metres those of smaller ones, but for rounding."""
    heights = np.rint(rough(96))
    (tmp_path / "high").mkdir()
    here, high = store_heights(tmp_path, heights), store_heights(tmp_path / "high", heights.astype(np.float64) + 1e7)
    options: list[dict[str, Any]] = [{"shadows": "certified"}, {"shadows": "soft", "sky": 8, "bounce": True}]
    for option in options:
        assert lit(here, 215, 12, **option).tobytes() == lit(high, 215, 12, **option).tobytes()
    ground = hills(100, 100)
    lights = [
        lit(store_at(tmp_path / str(easting), ground, (30, 0, easting, 0, -30, 5e6), "EPSG:3857"), 215, 12, shadows="certified")
        for easting in (0, 10_000_000)
    ]
    assert_same_but_edges(lights[1], lights[0], 1e-6)


def test_it_is_the_light_of_plain_tiffs_too(tmp_path: Path) -> None:
    """Files of this module are what they were made of: heights of a grid in metres have the light of the same grid without a place."""
    heights = rough(70)
    placed = store_at(tmp_path / "placed", heights, (30, 0, 500_000, 0, -30, 30), "EPSG:32631")
    plain_tiff(tmp_path / "dem.tif", heights)
    report = build_light(placed, LightSettings(azimuth_deg=215, elevation_deg=30, codec="exr:float", curvature=False))
    assert report.light.grid_azimuth_deg == pytest.approx(215, abs=1e-3)
    bare = lit(store_heights(tmp_path, heights), 215, 30)
    assert_same_but_edges(samples(placed, report), bare, 2e-3)
