"""What differs between two datasets is found, measured and nothing else is."""

import shutil
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError
from schemas.findings import DiffReport, LayerDifference
from tests.integration.files import assemble, settings, write_tiff
from tests.reference.terrain import photo, terrain
from tests.unit.tampering import block_path, change_samples, edit_layer
from tiler.building.build import build_layer
from tiler.checking.diff import diff, field_differences
from tiler.codecs import Mask, Samples
from tiler.stores.dataset import open_dataset

PROVENANCE = {"source.file_bytes", "source.name"}


@pytest.fixture(scope="module")
def heights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pixels = terrain(100, 150, seed=3).astype(np.float32)
    pixels[10:70, 20:90] = np.nan
    return write_tiff(tmp_path_factory.mktemp("source") / "height.tif", pixels)


@pytest.fixture(scope="module")
def built(heights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Heights in lossless blocks of 32: 5 x 4, 3 x 2, 2 x 1 and 1 blocks. Not to be changed."""
    folder = tmp_path_factory.mktemp("built") / "a"
    build_layer(heights, folder, settings(codec="lerc:0"))
    return folder


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(built, tmp_path / "b"))


def compared(a: Path, b: Path, **options: Any) -> DiffReport:
    return diff(open_dataset(a), open_dataset(b), **options)


def only(report: DiffReport) -> LayerDifference:
    (layer,) = report.layers
    return layer


def test_a_dataset_is_the_same_as_itself_and_as_its_copy(built: Path, copy: Path) -> None:
    for other in (built, copy):
        report = compared(built, other)
        assert report.same
        assert [(level.blocks, level.differing) for level in only(report).levels] == [(20, 0), (6, 0), (2, 0), (1, 0)]


def test_where_blocks_lie_does_not_count(built: Path, copy: Path, heights: Path) -> None:
    """A layer that was rebuilt from the same source has another path, so the dataset another version, and the same blocks."""
    build_layer(heights, copy, settings(codec="lerc:0", overwrite=True))
    report = compared(built, copy)
    assert report.version_a != report.version_b
    assert report.same


def test_changed_samples_are_measured(built: Path, copy: Path) -> None:
    """Two samples in two blocks, by 3 m and 4 m: the squares add up over all samples of both blocks that are valid."""

    def change(by: float) -> Any:
        def add(samples: Samples, mask: Mask) -> None:
            row, column = np.argwhere(mask)[-1]
            samples[row, column] += by

        return add

    places = [BlockAddress(0, 4, 0), BlockAddress(0, 3, 2)]
    for address, by in zip(places, (3.0, -4.0), strict=True):
        change_samples(copy, "height", address, change(by))
    dataset = open_dataset(built)
    valid = sum(dataset.record("height", address).valid for address in places)
    report = compared(built, copy)
    assert not report.same
    finest, *coarser = only(report).levels
    assert (finest.differing, finest.first) == (2, ["0/4/0", "0/3/2"])
    assert finest.largest == 4.0
    assert finest.rms == pytest.approx(sqrt((9 + 16) / valid), rel=1e-6)
    assert finest.valid_in_one == 0
    assert [(level.differing, level.largest, level.rms) for level in coarser] == [(0, None, None)] * 3
    assert only(report).fields == []


def test_codecs_are_compared_by_their_samples(built: Path, heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "b", settings(codec="png16:2,-1000", pad=3))
    report = compared(built, tmp_path / "b")
    layer = only(report)
    fields = {"codec", "suffix", "media_type", "max_error", "pad"}
    assert {field.field for field in layer.fields} == fields
    assert {field.field: (field.a, field.b) for field in layer.fields}["codec"] == ("lerc:0", "png16:2,-1000")
    for level in layer.levels:
        a, valid = assemble(open_dataset(built), "height", level.level)
        b, also_valid = assemble(open_dataset(tmp_path / "b"), "height", level.level)
        distance = (a.astype(np.float64) - b)[valid]
        assert (valid == also_valid).all()
        assert level.largest == np.abs(distance).max() <= 1.001
        # Blocks without a valid sample are blank in both and do not differ; all others do.
        assert level.rms == pytest.approx(np.sqrt(np.mean(distance**2)))
        assert level.valid_in_one == 0


def test_voids_are_counted(heights: Path, built: Path, tmp_path: Path) -> None:
    """Filled voids are valid in one dataset only, and blocks that were blank are there."""
    pixels = terrain(100, 150, seed=3).astype(np.float32)
    build_layer(write_tiff(tmp_path / "height.tif", pixels), tmp_path / "b", settings(codec="lerc:0"))
    layer = only(compared(built, tmp_path / "b"))
    assert layer.levels[0].valid_in_one == 60 * 70
    assert layer.levels[0].largest == 0
    reverse = only(compared(tmp_path / "b", built))
    assert [level.valid_in_one for level in reverse.levels] == [level.valid_in_one for level in layer.levels]
    assert {field.field for field in layer.fields} >= {"statistics.valid"}
    assert {field.field for field in layer.fields} - PROVENANCE <= {f"statistics.{name}" for name in ("valid", "min", "max", "mean")}


def test_other_lattices_and_types_are_not_compared(built: Path, heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "b", settings(block=64, codec="lerc:0"))
    layer = only(compared(built, tmp_path / "b"))
    assert (layer.not_compared, layer.levels) == ("the lattices differ", [])
    assert [field.field for field in layer.fields] == ["block"]
    build_layer(write_tiff(tmp_path / "grey.tif", photo(64, 64, seed=1)[..., :1]), tmp_path / "grey", settings(layer="imagery"))
    build_layer(write_tiff(tmp_path / "rgb.tif", photo(64, 64, seed=1)), tmp_path / "rgb", settings(layer="imagery"))
    layer = only(compared(tmp_path / "grey", tmp_path / "rgb"))
    assert layer.not_compared == "the samples are of different types"
    assert [(level.differing, level.largest, level.valid_in_one) for level in layer.levels] == [(4, None, None), (1, None, None)]


def test_layers_and_worlds(built: Path, copy: Path, tmp_path: Path) -> None:
    build_layer(write_tiff(tmp_path / "rgb.tif", photo(64, 64, seed=1)), copy, settings(layer="imagery"))
    report = compared(built, copy)
    assert (report.only_in_a, report.only_in_b, report.same) == ([], ["imagery"], False)
    assert (compared(copy, built).only_in_a, compared(copy, built).only_in_b) == (["imagery"], [])
    elsewhere = write_tiff(tmp_path / "else.tif", terrain(100, 150, seed=3).astype(np.float32), crs="EPSG:32633")
    build_layer(elsewhere, tmp_path / "c", settings(codec="lerc:0"))
    (field,) = compared(built, tmp_path / "c").world
    assert (field.field, field.a, field.b) == ("crs", "EPSG:32632", "EPSG:32633")


def test_a_field_alone_is_a_difference(built: Path, copy: Path) -> None:
    edit_layer(copy, "height", fill=3)
    report = compared(built, copy)
    assert not report.same
    assert [(field.field, field.a, field.b) for field in only(report).fields] == [("fill", 0, 3)]


def test_nested_fields_are_named_with_dots() -> None:
    a = {"one": 1, "inner": {"x": [1, 2], "y": None}, "odd": None}
    b = {"one": 1, "inner": {"x": [1, 3], "y": None}, "odd": {"z": 1}}
    assert [(found.field, found.a, found.b) for found in field_differences(a, b)] == [("inner.x", [1, 2], [1, 3]), ("odd", None, {"z": 1})]


@pytest.mark.parametrize("workers", [1, 6])
def test_threads_change_nothing_and_progress_reaches_the_end(workers: int, built: Path, heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "b", settings(codec="lerc:1"))
    seen: list[tuple[int, int]] = []
    report = compared(built, tmp_path / "b", workers=workers, on_progress=lambda done, total: seen.append((done, total)))
    assert report == compared(built, tmp_path / "b")
    total = sum(level.differing for level in only(report).levels)
    assert seen[-1] == (total, total)


@pytest.mark.parametrize(("damage", "error"), [("flipped", InputError), ("short", InputError), ("gone", NotFoundError)])
def test_a_damaged_block_is_no_difference_but_an_error(damage: str, error: type[Exception], built: Path, copy: Path) -> None:
    address = BlockAddress(0, 4, 0)
    change_samples(copy, "height", address, lambda samples, mask: samples.__setitem__((3, 3), 5))
    path = block_path(copy, "height", address)
    data = path.read_bytes()
    path.write_bytes(data[:-1] if damage == "short" else data[:-1] + bytes([data[-1] ^ 1]))
    if damage == "gone":
        path.unlink()
    with pytest.raises(error, match=path.name):
        compared(built, copy)
