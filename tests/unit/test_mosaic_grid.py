"""Where files lie on the lattice of a mosaic: which are copied, how far all reach, and what happens at the antimeridian."""

import itertools
from typing import Any

import numpy as np
import pytest
from affine import Affine
from rasterio.crs import CRS
from rasterio.warp import transform as reproject

from schemas.errors import InputError
from schemas.region import Rect
from tests.unit.mosaic_files import ORIGIN, STEP, SYSTEM, header
from tiler.sources import FileInfo
from tiler.sources.grid import Arrangement, arrange
from tiler.sources.mosaic import _is_covered

NINTH = 1 / 9
"""A spacing [degrees] that has no end in either base, and 3240 of which lead round the Earth."""


def placed(*infos: FileInfo) -> tuple[Arrangement, list[bool]]:
    arrangement = arrange(infos)
    return arrangement, [place.exact for place in arrangement.placements]


def degrees(name: str, west: float, north: float, east: float, south: float, step: float = NINTH, crs: str = "EPSG:4326") -> FileInfo:
    size = round((east - west) / step), round((north - south) / step)
    return header(name, crs, Affine(step, 0, west, 0, -step, north), *size)


@pytest.mark.parametrize(
    ("moved", "exact"),
    [
        (Affine.translation(37, -12), True),
        (Affine.translation(37.0009, -12.0009), True),
        (Affine.translation(37.0011, -12), False),
        (Affine.translation(37, -12.5), False),
        (Affine.translation(37, -12) @ Affine.scale(1 + 9e-7), True),
        (Affine.translation(37, -12) @ Affine.scale(1 + 1.1e-6, 1), False),
        (Affine.translation(37, -12) @ Affine.scale(1, -1), False),
        (Affine.translation(37, -12) @ Affine.rotation(1e-4), False),
        (Affine.translation(37, -12) @ Affine.scale(2), False),
    ],
)
@pytest.mark.parametrize("first", [ORIGIN, ORIGIN @ Affine.scale(1, -1), ORIGIN @ Affine.rotation(30) @ Affine.scale(2, 3)])
def test_files_on_the_first_ones_grid_are_copied(first: Affine, moved: Affine, exact: bool) -> None:
    """North-up, south-up and rotated: what counts is that rows and columns are the same."""
    arrangement, copied = placed(header("a", SYSTEM, first, 100, 80), header("b", SYSTEM, first @ moved, 50, 40))
    assert copied == [True, exact]
    if exact:
        assert [place.rect for place in arrangement.placements] == [Rect(0, 12, 100, 92), Rect(37, 0, 87, 40)]
        assert (arrangement.width, arrangement.height) == (100, 92)
        assert arrangement.grid.transform == pytest.approx(tuple(first @ Affine.translation(0, -12))[:6], abs=1e-6)


def test_the_same_system_in_other_words() -> None:
    written = CRS.from_epsg(32632).to_wkt().replace("WGS 84 / UTM zone 32N", "my zone")
    assert placed(header("a", SYSTEM, ORIGIN, 10, 10), header("b", written, ORIGIN, 10, 10))[1] == [True, True]
    assert placed(header("a", SYSTEM, ORIGIN, 10, 10), header("b", "EPSG:32633", ORIGIN, 10, 10))[1] == [True, False]
    assert placed(header("a", None, ORIGIN, 10, 10), header("b", None, ORIGIN, 10, 10))[1] == [True, True]


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:25833", "EPSG:3035"])
def test_files_of_other_systems_reach_as_far_as_their_outline(crs: str) -> None:
    """EPSG:4326 and EPSG:3035 have their axes the other way round; a 2000 times finer outline says where the file lies."""
    xs, ys = reproject(SYSTEM, crs, [500_000, 700_000], [5_000_000, 4_900_000])
    step = (xs[1] - xs[0]) / 300
    other = header("b", crs, Affine(step, 0, xs[0], 0, -step, ys[0]), 300, 200)
    arrangement, copied = placed(header("a", SYSTEM, ORIGIN, 100, 100), other)
    assert copied == [True, False]
    along = np.linspace(0, 1, 100_000)
    across = np.concatenate([along, along, 0 * along, 0 * along + 1]) * 300
    down = np.concatenate([0 * along, 0 * along + 1, along, along]) * 200
    found = reproject(crs, SYSTEM, (xs[0] + step * across).tolist(), (ys[0] - step * down).tolist())
    columns, rows = (np.array(found[0]) - 500_000) / STEP, (5_000_000 - np.array(found[1])) / STEP
    expected = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
    shift = arrangement.placements[0].rect
    rect = arrangement.placements[1].rect.shifted(-shift.x0, -shift.y0)
    assert np.abs(np.array([rect.x0, rect.y0, rect.x1, rect.y1]) - expected).max() <= 0.75


def test_neighbours_across_the_antimeridian_are_neighbours() -> None:
    """In either order, in geographic degrees and in EPSG:3857; the lattice runs on beyond 180 degrees."""
    west, east = degrees("west", 170, 10, 180, 0), degrees("east", -180, 10, -170, 0)
    for one, other, origin in ((west, east, 170), (east, west, -190)):
        arrangement, copied = placed(one, other)
        assert (arrangement.width, arrangement.height, copied) == (180, 90, [True, True])
        assert arrangement.grid.transform[2] == pytest.approx(origin, abs=1e-9)
    edge = np.pi * 6378137
    step = edge / 4096
    tiles = [header(f"{x}", "EPSG:3857", Affine(step, 0, x * edge, 0, -step, step * 64), 64, 64) for x in (-1, 1 - 1 / 64)]
    arrangement, copied = placed(*tiles)
    assert (arrangement.width, copied) == (128, [True, True])


def test_a_row_of_tiles_round_the_earth_stays_as_it_is() -> None:
    """Any order: there is no gap to cut the Earth open, or only one that saves less than half."""
    tiles = [degrees(f"{west}", west, 10, west + 20, 0) for west in range(-180, 180, 20)]
    for order in (tiles, tiles[::-1], tiles[5:] + tiles[:5], tiles[:7] + tiles[11:]):
        arrangement, copied = placed(*order)
        assert [arrangement.width, arrangement.grid.transform[2]] == pytest.approx([3240, -180], abs=1e-9)
        assert all(copied)
        assert {place.turns for place in arrangement.placements} == {0}


def test_a_file_across_the_seam_of_a_world_shows_on_both_of_its_sides() -> None:
    world = degrees("world", -180, 90, 180, -90)
    crossing = degrees("crossing", 175, 10, 185, 0)
    arrangement, copied = placed(world, crossing)
    assert (arrangement.width, arrangement.height, copied) == (3240, 1620, [True, True, True])
    whole = Rect(0, 0, 3240, 1620)
    assert [place.rect & whole for place in arrangement.placements[1:]] == [Rect(0, 720, 45, 810), Rect(3195, 720, 3240, 810)]
    utm = header("utm", "EPSG:32660", Affine(10_000, 0, 600_000, 0, -10_000, 6_000_000), 40, 40)
    arrangement, copied = placed(world, utm)
    assert (arrangement.width, copied) == (3240, [True, False, False])
    assert sum((place.rect & whole).width for place in arrangement.placements[1:]) == pytest.approx(59, abs=3)
    tiles = [degrees(f"{west}", west, 10, west + 20, 0) for west in range(-180, 180, 20)]
    arrangement, copied = placed(*tiles, utm)
    assert [arrangement.width, arrangement.grid.transform[2]] == pytest.approx([3240, -180], abs=1e-9)


def test_a_file_across_the_antimeridian_is_not_as_wide_as_the_earth() -> None:
    utm = header("utm", "EPSG:32660", Affine(10_000, 0, 600_000, 0, -10_000, 6_000_000), 40, 40)
    for first in (degrees("west", 170, 60, 180, 50), degrees("east", -180, 60, -170, 50)):
        arrangement, _ = placed(first, utm)
        assert 90 < arrangement.width < 180


UNPLACEABLE: dict[str, tuple[FileInfo, FileInfo, str]] = {
    "pole": (
        degrees("world", -180, 90, 180, -90),
        header("arctic", "EPSG:3413", Affine(10_000, 0, -200_000, 0, -10_000, 200_000), 40, 40),
        "holds a pole, which EPSG:4326, the system of world, cannot show in one piece",
    ),
    "beyond": (
        header("web", "EPSG:3857", ORIGIN, 10, 10),
        degrees("odd", 0, 91, 20, 80),
        "reaches beyond what EPSG:3857, the system of web, can show",
    ),
    "world in a zone": (
        header("zone", SYSTEM, ORIGIN, 10, 10),
        degrees("world", -180, 90, 180, -90),
        "is torn apart in EPSG:32632, the system of zone",
    ),
    "torn": (
        header("plate", "ESRI:54030", Affine(1000, 0, 0, 0, -1000, 0), 100, 100),
        header("utm", "EPSG:32660", Affine(10_000, 0, 600_000, 0, -10_000, 6_000_000), 40, 40),
        "is torn apart in ESRI:54030, the system of plate",
    ),
}


@pytest.mark.parametrize("name", UNPLACEABLE)
def test_what_the_first_files_system_cannot_show_is_refused(name: str) -> None:
    first, other, sentence = UNPLACEABLE[name]
    with pytest.raises(InputError, match=rf"^{other.path}: {sentence}"):
        arrange([first, other])


def test_a_world_is_cut_to_the_square_of_web_mercator() -> None:
    """Its poles lie 12 squares away there, as far as rounding lets them be seen at all."""
    arrangement, _ = placed(header("web", "EPSG:3857", Affine(1e5, 0, 0, 0, -1e5, 0), 10, 10), degrees("world", -180, 90, 180, -90))
    assert (arrangement.width, arrangement.height) == (400, 400)
    assert arrangement.grid.transform[5] == 2e7


def test_long_and_bent_files_are_not_torn() -> None:
    """A strip of 20000 x 30 pixels, and a conic map of a continent."""
    strip = header("strip", "EPSG:32633", Affine(10, 0, 400_000, 0, -10, 5_000_000), 20_000, 30)
    continent = header("europe", "EPSG:3035", Affine(10_000, 0, 2_600_000, 0, -10_000, 5_400_000), 450, 400)
    arrange([header("zone", SYSTEM, ORIGIN, 10, 10), strip])
    arrange([header("lambert", "EPSG:3034", Affine(5000, 0, 4_000_000, 0, -5000, 3_000_000), 10, 10), continent])


def test_ten_thousand_files_are_arranged() -> None:
    tiles = [
        header(f"{x} {y}", SYSTEM, ORIGIN @ Affine.translation(50 * x, 30 * y), 50, 30) for x, y in itertools.product(range(100), repeat=2)
    ]
    arrangement, copied = placed(*tiles)
    assert (arrangement.width, arrangement.height, all(copied)) == (5000, 3000, True)


def covered_by_counting(whole: Rect, rects: Any) -> bool:
    seen = np.zeros((whole.height, whole.width), np.bool_)
    for x0, y0, x1, y1 in np.maximum(rects, 0):
        seen[y0:y1, x0:x1] = True
    return bool(seen.all())


def test_gaps_are_found() -> None:
    rng, whole, found = np.random.default_rng(1), Rect(0, 0, 12, 9), []
    for _ in range(400):
        corners = rng.integers(-2, 6, (rng.integers(1, 9), 2))
        rects = np.concatenate([corners, corners + rng.integers(1, 14, corners.shape)], axis=1)
        found.append(_is_covered(whole, rects))
        assert found[-1] == covered_by_counting(whole, rects)
    assert 10 < sum(found) < 390
