"""Where a file says it lies."""

from pathlib import Path

import pytest
import rasterio
from rasterio.transform import Affine

from schemas.errors import InputError
from tests.contract.picture_files import KINDS, content, write_with_rasterio
from tiler.sources.files import open_file

NORTH_UP = Affine(30, 0, 500000, 0, -30, 4000000)


@pytest.mark.parametrize(
    ("transform", "crs", "unit"),
    [
        (NORTH_UP, "EPSG:32618", "metre"),
        (Affine(30, 0, 500000, 0, 30, 3990000), "EPSG:32618", "metre"),
        (Affine(20, 20, 500000, 20, -20, 4000000), "EPSG:32618", "metre"),
        (Affine(0.01, 0, 10, 0, -0.01, 50), "EPSG:4326", "degree"),
        (Affine(100, 0, 2000000, 0, -100, 600000), "EPSG:2263", "us-foot"),
        (Affine(100, 0, 2000000, 0, -100, 600000), "EPSG:2222", "foot"),
    ],
)
def test_georeference(transform: Affine, crs: str, unit: str, tmp_path: Path) -> None:
    path = tmp_path / "placed.tif"
    write_with_rasterio(path, content(1, "int16"), transform=transform, crs=crs)
    reader = open_file(path, tmp_path)
    found = reader.info.georeference
    assert found is not None
    assert (found.crs, found.unit) == (crs, unit)
    assert found.transform == pytest.approx(tuple(transform)[:6])
    reader.close()


def test_a_local_coordinate_system_is_kept_as_it_is(tmp_path: Path) -> None:
    """A survey in a quarry's own axes: there is no place on earth to give, but metres are metres."""
    path = tmp_path / "quarry.tif"
    write_with_rasterio(path, content(1, "int16"), transform=NORTH_UP, crs='LOCAL_CS["quarry",UNIT["metre",1]]')
    reader = open_file(path, tmp_path)
    assert reader.info.georeference is not None
    assert "quarry" in str(reader.info.georeference.crs)
    assert reader.info.georeference.unit == "metre"
    reader.close()


def test_pixel_is_point_is_moved_to_the_corner(tmp_path: Path) -> None:
    """AREA_OR_POINT=Point: the tie point of the file is the first pixel's centre; a Georeference leads from corners."""
    path = tmp_path / "point.tif"
    write_with_rasterio(path, content(1, "int16"), transform=NORTH_UP, crs="EPSG:32618")
    with rasterio.open(path, "r+") as file:
        file.update_tags(AREA_OR_POINT="Point")
    reader = open_file(path, tmp_path)
    assert reader.info.georeference is not None
    assert reader.info.georeference.transform == pytest.approx((30, 0, 500000, 0, -30, 4000000))
    reader.close()


def test_a_world_file_places_a_picture_without_saying_in_which_system(tmp_path: Path) -> None:
    path = tmp_path / "placed.png"
    KINDS[[kind.name for kind in KINDS].index("png-3xuint8")].write(path)
    (tmp_path / "placed.pgw").write_text("2.0\n0.0\n0.0\n-2.0\n1001.0\n4999.0\n")
    reader = open_file(path, tmp_path)
    assert reader.info.georeference is not None
    assert (reader.info.georeference.crs, reader.info.georeference.unit) == (None, "unknown")
    assert reader.info.georeference.transform == (2.0, 0.0, 1000.0, 0.0, -2.0, 5000.0)
    reader.close()


def test_srtm_lies_where_its_name_says(tmp_path: Path) -> None:
    path = tmp_path / "N27E086.hgt"
    path.write_bytes(content(1, "int16", 1201, 1201).astype(">i2").tobytes())
    reader = open_file(path, tmp_path)
    assert reader.info.georeference is not None
    assert (reader.info.georeference.crs, reader.info.georeference.unit) == ("EPSG:4326", "degree")
    step = 1 / 1200
    assert reader.info.georeference.transform == pytest.approx((step, 0, 86 - step / 2, 0, -step, 28 + step / 2), abs=1e-12)
    reader.close()


def test_a_degenerate_georeference_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flat.tif"
    write_with_rasterio(path, content(1, "int16"), transform=Affine(30, 0, 5, 0, 0, 5), crs="EPSG:32618")
    with pytest.raises(InputError, match="georeference is degenerate"):
        open_file(path, tmp_path)
