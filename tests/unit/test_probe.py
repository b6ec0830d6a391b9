"""Values at places, maps of levels and pictures of blocks show what the source held there."""

import shutil
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
from affine import Affine

from schemas.address import BlockAddress
from schemas.errors import NotFoundError, UsageError
from schemas.facts import PointFacts
from tests.integration.files import assemble, settings, write_png, write_tiff
from tests.reference.terrain import photo, terrain
from tests.unit.tampering import block_path, edit_layer, manifest_of
from tiler.building.build import build_layer
from tiler.inspecting.facts import describe_block, describe_level
from tiler.inspecting.preview import preview_png
from tiler.inspecting.probe import probe_geographic, probe_pixel, probe_world
from tiler.stores.dataset import open_dataset

ORIGIN, STEP = (500_000.0, 5_000_000.0), 10.0
"""Place of the corner of the first pixel and size of a pixel, those of ``write_tiff``."""


@pytest.fixture(scope="module")
def pixels() -> Any:
    heights = terrain(90, 140, seed=3).astype(np.float32)
    heights[10:80, 20:100] = np.nan
    return heights


@pytest.fixture(scope="module")
def built(pixels: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Heights and a picture of the same place in lossless blocks of 32. Not to be changed."""
    folder = tmp_path_factory.mktemp("probe")
    build_layer(write_tiff(folder / "height.tif", pixels), folder / "out", settings())
    build_layer(
        write_tiff(folder / "photo.tif", photo(180, 280, seed=3), transform=Affine(5, 0, ORIGIN[0], 0, -5, ORIGIN[1])),
        folder / "out",
        settings(),
    )
    return folder / "out"


def values(facts: PointFacts, layer: str) -> list[list[float] | None]:
    return [sample.value for point in facts.layers if point.layer == layer for sample in point.levels]


@pytest.mark.parametrize(("column", "row"), [(0, 0), (139, 89), (3, 85), (31, 5), (32, 5), (60, 40)])
def test_the_value_of_a_pixel_is_the_sources(column: int, row: int, built: Path, pixels: Any) -> None:
    """The centre of a pixel is where its sample lies, whatever the registration."""
    x, y = ORIGIN[0] + (column + 0.5) * STEP, ORIGIN[1] - (row + 0.5) * STEP
    facts = probe_world(open_dataset(built), x, y, ["height", "imagery"])
    expected = None if np.isnan(pixels[row, column, 0]) else [float(pixels[row, column, 0])]
    height, imagery = facts.layers
    assert height.levels[0].value == expected
    assert (height.levels[0].sample, height.levels[0].block) == ((column, row), f"0/{column // 32}/{row // 32}")
    assert height.position == pytest.approx((column, row))
    assert imagery.levels[0].sample == (2 * column + 1, 2 * row + 1)
    assert imagery.levels[0].value == photo(180, 280, seed=3)[2 * row + 1, 2 * column + 1].tolist()
    by_pixel = probe_pixel(open_dataset(built), column, row, ["height"])
    assert by_pixel.layers[0].levels == height.levels
    assert by_pixel.world == pytest.approx((x, y))


def test_coarser_levels_hold_the_nearest_sample(built: Path) -> None:
    """Sample i of level l lies on sample 2**l i of heights, and covers the 2**l from there on in imagery."""
    dataset = open_dataset(built)
    for name, nearest in (("height", lambda place, scale: int(place / scale + 0.5)), ("imagery", lambda place, scale: place // scale)):
        layer = dataset.manifest.layers[name]
        for column, row in ((7, 86), (layer.width - 1, layer.height - 1), (13, 3)):
            (point,) = probe_pixel(dataset, column, row, [name]).layers
            for sample in point.levels:
                width, height = layer.lattice.level_size(sample.level)
                at = min(nearest(column, 2**sample.level), width - 1), min(nearest(row, 2**sample.level), height - 1)
                whole, valid = assemble(dataset, name, sample.level)
                assert sample.sample == at
                assert sample.value == (whole[at[1], at[0]].astype(float).tolist() if valid[at[1], at[0]] else None)
                assert sample.block == f"{sample.level}/{at[0] // 32}/{at[1] // 32}"


def test_a_place_on_earth(built: Path) -> None:
    """The central meridian of UTM zone 32 is 9 degrees east and has easting 500 km; the dataset's corner lies on it."""
    dataset = open_dataset(built)
    facts = probe_world(dataset, 500_000, 4_999_500, ["height"])
    assert facts.longitude_latitude is not None
    longitude, latitude = facts.longitude_latitude
    assert longitude == pytest.approx(9.0, abs=1e-9)
    # A meridian arc of 4 999 500 m / 0.9996 ends at 45.148° (Snyder 1987, eq. 3-21).
    assert latitude == pytest.approx(45.148, abs=0.002)
    there = probe_geographic(dataset, longitude + 0.001, latitude, ["height"])
    assert there.world[0] == pytest.approx(500_078.6, abs=0.2)
    assert there.world[1] == pytest.approx(4_999_500, abs=0.1)
    assert values(there, "height") == values(probe_world(dataset, *there.world, ["height"]), "height")


@pytest.mark.parametrize("turn", [-360, 0, 360])
def test_longitudes_wrap(turn: int, tmp_path: Path) -> None:
    """A world map from 0 to 360 degrees is asked for a place west of Greenwich, and the other way round."""
    heights = np.add.outer(np.zeros(36), np.arange(72.0)).astype(np.float32)[..., np.newaxis]
    for first, wanted in ((0, 270), (-180, -90)):
        source = write_tiff(tmp_path / f"{first}.tif", heights, crs="EPSG:4326", transform=Affine(5, 0, first, 0, -5, 90))
        build_layer(source, tmp_path / str(first), settings())
        dataset = open_dataset(tmp_path / str(first))
        if -360 <= wanted + turn + 2.5 <= 360:
            facts = probe_geographic(dataset, wanted + turn + 2.5, 42.5, ["height"])
            assert values(facts, "height")[0] == [(wanted - first) / 5]


def test_a_dataset_without_a_reference_system(tmp_path: Path) -> None:
    write_png(tmp_path / "photo.png", photo(40, 50, seed=1))
    build_layer(tmp_path / "photo.png", tmp_path / "out", settings(layer="imagery"))
    dataset = open_dataset(tmp_path / "out")
    with pytest.raises(UsageError, match="no coordinate reference system; use --at-world"):
        probe_geographic(dataset, 9, 45, ["imagery"])
    facts = probe_world(dataset, 3.5, -7.5, ["imagery"])
    assert facts.longitude_latitude is None
    assert values(facts, "imagery")[0] == photo(40, 50, seed=1)[7, 3].tolist()


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (500_000, 5_000_000, True),
        (501_400, 4_999_100, True),
        (499_999, 5_000_000, False),
        (501_401, 4_999_100, False),
        (501_000, 5_000_001, False),
        (501_000, 4_999_099, False),
    ],
)
def test_the_edge_of_the_pixels_is_the_edge(x: float, y: float, inside: bool, built: Path) -> None:
    for name in ("height", "imagery"):
        if inside:
            assert probe_world(open_dataset(built), x, y, [name]).layers[0].levels
        else:
            with pytest.raises(NotFoundError, match=f"lies outside .*: {name} reaches from 5000[0-9]+ .* to 501[0-9]+ "):
                probe_world(open_dataset(built), x, y, [name])


def test_a_place_in_one_layer_only(built: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(built, tmp_path / "copy"))
    a, b, _, d, e, f = manifest_of(copy).layers["imagery"].transform
    edit_layer(copy, "imagery", transform=(a, b, 500_700.0, d, e, f))
    facts = probe_world(open_dataset(copy), 500_100, 4_999_900, ["height", "imagery"])
    assert [len(layer.levels) for layer in facts.layers] == [4, 0]


def test_places_that_are_none(built: Path) -> None:
    dataset = open_dataset(built)
    for longitude, latitude in ((361, 0), (-361, 0), (0, 91), (0, -91)):
        with pytest.raises(UsageError, match="longitude must be from -360 to 360 degrees, latitude from -90 to 90"):
            probe_geographic(dataset, longitude, latitude, ["height"])
    with pytest.raises(NotFoundError, match=r"lies outside|has no place"):
        probe_geographic(dataset, -171, 0, ["height"])
    with pytest.raises(UsageError, match=r"samples of height, imagery lie in different places; name the layer meant, e\.g\. height"):
        probe_pixel(dataset, 0, 0, ["height", "imagery"])
    for column, row in ((140, 0), (0, 90), (-1, 0), (0, -1)):
        with pytest.raises(NotFoundError, match="lies outside layer 'height', which has 140 x 90 samples"):
            probe_pixel(dataset, column, row, ["height"])


def test_the_map_of_a_level(built: Path, pixels: Any) -> None:
    """Every cell is the share of its samples that are valid, those beyond the level's edge not counted."""
    dataset = open_dataset(built)
    valid = ~np.isnan(pixels[..., 0])
    for cells, step in ((64, 1), (5, 1), (4, 2), (1, 5)):
        coverage = describe_level(dataset, "height", 0, cells).coverage
        assert coverage.blocks_per_cell == step
        side = 32 * step
        expected = [[valid[y : y + side, x : x + side].mean() for x in range(0, 140, side)] for y in range(0, 90, side)]
        assert np.asarray(coverage.valid_share) == pytest.approx(np.asarray(expected))
    assert 0 in np.asarray(describe_level(dataset, "height", 0).coverage.valid_share)


def test_a_block_is_decoded_and_measured(built: Path, pixels: Any) -> None:
    facts, decoded = describe_block(open_dataset(built), "height", BlockAddress(0, 4, 2))
    part = pixels[64:90, 128:140, 0].astype(np.float64)
    assert decoded is not None
    assert (decoded.samples[..., 0] == part).all()
    assert (facts.decoded_min, facts.decoded_max) == ([part.min()], [part.max()])
    assert facts.decoded_mean == pytest.approx([part.mean()])
    facts, decoded = describe_block(open_dataset(built), "imagery", BlockAddress(0, 0, 0))
    assert facts.decoded_mean == pytest.approx(photo(180, 280, seed=3)[:32, :32].mean(axis=(0, 1)).tolist())


def test_a_blank_and_a_damaged_block_have_no_samples(built: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(built, tmp_path / "copy"))
    facts, decoded = describe_block(open_dataset(copy), "height", BlockAddress(0, 1, 1))
    assert (facts.blank, facts.intact, facts.decoded_min, decoded) == (True, True, None, None)
    path = block_path(copy, "height", BlockAddress(0, 4, 0))
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    facts, decoded = describe_block(open_dataset(copy), "height", BlockAddress(0, 4, 0))
    assert (facts.blank, facts.intact, facts.decoded_min, decoded) == (False, False, None, None)


def drawn(folder: Path, name: str, address: BlockAddress) -> Any:
    dataset = open_dataset(folder)
    _, decoded = describe_block(dataset, name, address)
    assert decoded is not None
    return imagecodecs.png_decode(preview_png(dataset.manifest.layers[name], address.level, decoded))


def test_a_picture_is_drawn_as_it_is(built: Path) -> None:
    picture = drawn(built, "imagery", BlockAddress(0, 8, 5))
    assert (picture == photo(180, 280, seed=3)[160:, 256:]).all()


def test_sixteen_bits_are_stretched_between_percentiles(tmp_path: Path) -> None:
    pixels = np.linspace(1000, 3000, 32 * 32 * 3).reshape(32, 32, 3).astype(np.uint16)
    pixels[0, 0] = 65535
    build_layer(write_tiff(tmp_path / "deep.tif", pixels), tmp_path / "out", settings(layer="imagery"))
    picture = drawn(tmp_path / "out", "imagery", BlockAddress(0, 0, 0))
    assert (picture.dtype, picture.shape) == (np.uint8, (32, 32, 3))
    assert (picture[0, 0] == 255).all()
    assert abs(int(picture[16, 0, 0]) - 128) <= 2
    assert np.count_nonzero(picture == 0) / picture.size == pytest.approx(0.02, abs=0.005)


def test_voids_of_heights_are_transparent_and_light_comes_from_the_upper_left(tmp_path: Path) -> None:
    """A roof with a ridge from north to south: its western side is bright, its eastern one dark, the void has no colour."""
    ramp = np.minimum(np.arange(32), 31 - np.arange(32)).astype(np.float32) * 8
    pixels = np.broadcast_to(ramp, (32, 32))[..., np.newaxis].copy()
    pixels[20:24, 4:8] = np.nan
    build_layer(write_tiff(tmp_path / "roof.tif", pixels), tmp_path / "out", settings())
    grey, alpha = np.moveaxis(drawn(tmp_path / "out", "height", BlockAddress(0, 0, 0)), -1, 0)
    assert (alpha == np.where(np.isnan(pixels[..., 0]), 0, 255)).all()
    west, east = grey[2:18, 3:13].astype(int), grey[2:18, 28:18:-1].astype(int)
    assert (west > east + 40).all()


@pytest.mark.parametrize("flat", [True, False])
def test_heights_without_a_spacing_are_grey_from_lowest_to_highest(flat: bool, tmp_path: Path) -> None:
    pixels = np.arange(32 * 32, dtype=np.uint16).reshape(32, 32, 1) * (not flat)
    write_png(tmp_path / "height.png", pixels)
    build_layer(tmp_path / "height.png", tmp_path / "out", settings(layer="height"))
    picture = drawn(tmp_path / "out", "height", BlockAddress(0, 0, 0))
    assert picture.shape == (32, 32)
    assert (np.diff(picture.ravel().astype(int)) >= 0).all()
    assert (picture.min() == picture.max()) == flat
    if not flat:
        assert (picture[0, 0], picture[-1, -1]) == (round(0.3 * 255), round(0.8 * 255))
