"""Where a layer comes to lie, alone and beside others."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.errors import UsageError
from schemas.lattice import Registration
from schemas.manifest import Manifest, Transform, World
from tests.schemas.sample_manifest import make_layer
from tiler.building.placement import place
from tiler.sources import FileInfo, Georeference

UTM = Georeference("EPSG:32618", "metre", (30.0, 0.0, 500000.0, 0.0, -30.0, 4000000.0))


def info(width: int, height: int, georeference: Georeference | None = None) -> FileInfo:
    return FileInfo(Path("dem.tif"), "tiff", width, height, 1, np.dtype(np.int16), 1000, "tiled", 1, georeference=georeference)


def dataset(world: World, **layers: dict[str, Any]) -> Manifest:
    sized = {name: make_layer(**{"width": 10, "height": 10, "path": name, **fields}) for name, fields in layers.items()}
    return Manifest.create(generator="test", world=world, layers=sized)


UTM_WORLD = World(crs="EPSG:32618", unit="metre")


def corner(transform: Transform, column: float, row: float) -> tuple[float, float]:
    a, b, c, d, e, f = transform
    return a * column + b * row + c, d * column + e * row + f


@pytest.mark.parametrize("registration", ["area", "point"])
@pytest.mark.parametrize(
    "transform",
    [
        (30.0, 0.0, 500000.0, 0.0, -30.0, 4000000.0),
        (30.0, 0.0, 500000.0, 0.0, 30.0, 3990000.0),
        (20.0, 15.0, 500000.0, 15.0, -20.0, 4000000.0),
    ],
)
def test_a_vertex_lies_in_the_centre_of_its_pixel(registration: Registration, transform: Transform) -> None:
    """Whole numbers are corners of cells for imagery, samples for heights; so also south-up and rotated."""
    placed = place(info(100, 80, replace(UTM, transform=transform)), registration, None, None, "height")
    assert placed.how == "georeferenced"
    assert placed.world == UTM_WORLD
    shift = 0.5 if registration == "point" else 0.0
    for column, row in ((0, 0), (7, 0), (0, 9), (99, 79)):
        assert corner(placed.transform, column, row) == pytest.approx(corner(transform, column + shift, row + shift))


def test_spacing_in_metres() -> None:
    placed = place(info(100, 80), "point", 160.0, None, "height")
    assert (placed.how, placed.world) == ("spacing", World(crs=None, unit="metre"))
    assert placed.transform == (160.0, 0.0, 0.0, 0.0, -160.0, 0.0)
    assert placed.ground_spacing_m == (160.0, 160.0)


def test_nothing_known() -> None:
    placed = place(info(100, 80), "area", None, None, "imagery")
    assert (placed.how, placed.world) == ("assumed", World(crs=None, unit="unknown"))
    assert placed.transform == (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    assert placed.ground_spacing_m is None


def test_ground_spacing_is_that_at_the_centre() -> None:
    """A strip from the equator to 60 degrees north: what counts is 30 degrees."""
    degrees = Georeference("EPSG:4326", "degree", (0.01, 0.0, 0.0, 0.0, -0.01, 60.0))
    placed = place(info(10, 6000, degrees), "area", None, None, "imagery")
    assert placed.ground_spacing_m == pytest.approx((964.9, 1108.5), abs=0.1)


@pytest.mark.parametrize(
    ("reference", "registration", "size"),
    [
        ({"kind": "height", "registration": "point", "width": 1025, "height": 513}, "area", (1024, 512)),
        ({"kind": "height", "registration": "point", "width": 1025, "height": 513}, "area", (333, 77)),
        ({"kind": "height", "registration": "point", "width": 1025, "height": 513}, "point", (257, 129)),
        ({"kind": "imagery", "registration": "area", "width": 600, "height": 400}, "point", (61, 41)),
        ({"kind": "imagery", "registration": "area", "width": 600, "height": 400}, "area", (1200, 800)),
        ({"kind": "imagery", "registration": "area", "width": 600, "height": 400}, "point", (1, 1)),
    ],
)
def test_a_picture_without_georeference_is_spread_over_the_dataset(
    reference: dict[str, Any], registration: Registration, size: tuple[int, int]
) -> None:
    """Outermost vertices of the one fall on outermost cell edges of the other."""
    transform = (10.0, 1.0, 700.0, 2.0, -20.0, 900.0)
    name = "height" if reference["kind"] == "height" else "imagery"
    there = dataset(UTM_WORLD, **{name: {**reference, "transform": transform}})
    placed = place(info(*size), registration, None, there, "light")
    assert (placed.how, placed.world) == ("fitted", UTM_WORLD)
    gap, reference_gap = (1 if each == "point" else 0 for each in (registration, reference["registration"]))
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        if min(size) > 1 or (x, y) == (0, 0):
            expected = corner(transform, x * (reference["width"] - reference_gap), y * (reference["height"] - reference_gap))
            assert corner(placed.transform, x * (size[0] - gap), y * (size[1] - gap)) == pytest.approx(expected)


def test_heights_are_what_others_are_fitted_to() -> None:
    there = dataset(
        UTM_WORLD,
        height={"kind": "height", "registration": "point", "width": 11, "height": 11, "transform": (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)},
        imagery={"kind": "imagery", "registration": "area", "width": 10, "height": 10, "transform": (9.0, 0.0, 0.0, 0.0, -9.0, 0.0)},
    )
    assert place(info(10, 10), "area", None, there, "light").transform == (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


def test_a_layer_that_is_replaced_has_no_say() -> None:
    there = dataset(World(crs="EPSG:4326", unit="degree"), height={"kind": "height", "registration": "point"})
    assert place(info(9, 9, UTM), "point", None, there, "height").world == UTM_WORLD
    assert place(info(9, 9), "point", None, there, "height").how == "assumed"


@pytest.mark.parametrize(
    ("georeference", "spacing", "world", "sentence"),
    [
        (UTM, 30.0, None, "has a georeference; leave out --spacing"),
        (UTM, None, World(crs="EPSG:4326", unit="degree"), r"is in EPSG:32618 \(metre\), but the dataset is in EPSG:4326 \(degree\)"),
        (None, 10.0, UTM_WORLD, "coordinates without a reference system"),
        (UTM, None, World(crs=None, unit="unknown"), "gdalwarp"),
        (UTM, None, World(crs="GEOGCS" + "x" * 500, unit="degree"), r"x\.\.\. \(degree\)"),
    ],
)
def test_contradictions_are_refused(georeference: Georeference | None, spacing: float | None, world: World | None, sentence: str) -> None:
    there = None if world is None else dataset(world, imagery={"kind": "imagery"})
    with pytest.raises(UsageError, match=sentence) as caught:
        place(info(10, 10, georeference), "point", spacing, there, "height")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)
