"""Whole builds: from a file to a published dataset, and its guarantees."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from schemas.address import BlockAddress
from schemas.errors import UsageError
from schemas.manifest import digest
from schemas.region import Rect
from tests.integration.files import assemble, decode, settings, tree_digest, write_png, write_tiff
from tests.levels import run_cascade
from tests.reference.terrain import photo, terrain
from tiler.building.build import build_layer
from tiler.codecs import BlockFormat
from tiler.stores.dataset import open_dataset
from tiler.tasks.rounding import round_samples


@pytest.mark.parametrize("name", ["height", "photo"])
def test_bytes_do_not_depend_on_workers_or_tasks(name: str, height_tiff: Path, photo_tiff: Path, tmp_path: Path) -> None:
    source = height_tiff if name == "height" else photo_tiff
    digests = set()
    for index, (workers, task) in enumerate(itertools.product((1, 2, 7), (64, 128, 4096))):
        build_layer(source, tmp_path / str(index), settings(workers=workers, task=task))
        digests.add(tree_digest(tmp_path / str(index)))
    assert len(digests) == 1


@pytest.mark.parametrize(("name", "codec"), [("height", "raw"), ("height", "lerc:0"), ("photo", "raw"), ("photo", "png")])
def test_no_seams(name: str, codec: str, height_tiff: Path, photo_tiff: Path, tmp_path: Path) -> None:
    """Every level put together from its blocks equals the level filtered in one piece, bit for bit."""
    source = height_tiff if name == "height" else photo_tiff
    build_layer(source, tmp_path / "out", settings(codec=codec, task=64))
    dataset = open_dataset(tmp_path / "out")
    (layer_name,) = dataset.manifest.layers
    layer = dataset.manifest.layers[layer_name]
    with rasterio.open(source) as file:
        values = np.moveaxis(file.read(), 0, -1).astype(np.float32)
    coverage = np.isfinite(values[..., 0]).astype(np.float32) if name == "height" else None
    values = np.nan_to_num(values)
    whole = run_cascade(values, coverage, levels=len(layer.levels), kind=layer.kind, radius=layer.filter.radius)
    for level in range(len(layer.levels)):
        _, expected, covered = whole[level]
        rounded, mask = round_samples(expected, covered, BlockFormat(layer.kind, 32, layer.channels, layer.dtype))
        found, valid = assemble(dataset, layer_name, level)
        height, width = expected.shape[:2]
        if mask is not None:
            assert (valid[:height, :width] == mask).all()
            assert not valid[height:].any()
            assert not valid[:, width:].any()
            found = np.where(valid[..., np.newaxis], found, np.float32(0))[:height, :width]
            rounded = np.where(mask[..., np.newaxis], rounded, np.float32(0))
        assert found[:height, :width].tobytes() == rounded.tobytes()


@pytest.mark.parametrize("name", ["height", "photo"])
@pytest.mark.parametrize("pad", [1, 4, 16])
def test_pads_equal_the_neighbours_cores(name: str, pad: int, height_tiff: Path, photo_tiff: Path, tmp_path: Path) -> None:
    """Bit for bit, on every level, for every task size; beyond the level the edge is repeated and void."""
    source = height_tiff if name == "height" else photo_tiff
    build_layer(source, tmp_path / "out", settings(pad=pad, task=64))
    build_layer(source, tmp_path / "large", settings(pad=pad, task=4096, workers=1))
    assert tree_digest(tmp_path / "out") == tree_digest(tmp_path / "large")
    build_layer(source, tmp_path / "bare", settings())
    padded, bare = open_dataset(tmp_path / "out"), open_dataset(tmp_path / "bare")
    (layer_name,) = bare.manifest.layers
    for level in bare.manifest.layers[layer_name].levels:
        whole, valid = assemble(bare, layer_name, level.level)
        for address in padded.manifest.layers[layer_name].lattice.addresses(level.level):
            samples, mask = decode(padded, layer_name, address)
            if not mask.any():
                assert bare.record(layer_name, address).blank
                continue
            around = padded.manifest.layers[layer_name].lattice.core(address).grown(pad)
            seen = around & Rect(0, 0, level.width, level.height)
            inside = np.s_[seen.y0 - around.y0 : seen.y1 - around.y0, seen.x0 - around.x0 : seen.x1 - around.x0]
            there = np.s_[seen.y0 : seen.y1, seen.x0 : seen.x1]
            assert (mask[inside] == valid[there]).all()
            assert samples[inside][valid[there]].tobytes() == whole[there][valid[there]].tobytes()


def test_padding_repeats_the_edge(photo_tiff: Path, tmp_path: Path) -> None:
    build_layer(photo_tiff, tmp_path / "out", settings())
    samples, _ = assemble(open_dataset(tmp_path / "out"), "imagery", 0)
    assert (samples[350:, :610] == samples[349, :610]).all()
    assert (samples[:, 610:] == samples[:, 609:610]).all()


@pytest.mark.parametrize(
    ("dtype", "value", "options"),
    [
        ("uint8", 255, {"layer": "imagery"}),
        ("uint8", 3, {"layer": "height", "height_scale": 0.1}),
        ("uint16", 65535, {"layer": "imagery"}),
        ("uint16", 43798, {"layer": "height", "height_scale": 0.1, "height_offset": -12.5}),
        ("int16", -431, {}),
        ("float32", 8848.86, {}),
        ("float64", 1e9, {}),
    ],
)
def test_a_constant_picture_is_constant_on_every_level(dtype: str, value: float, options: dict[str, Any], tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "constant.tif", np.full((131, 203, 1), value, dtype))
    report = build_layer(source, tmp_path / "out", settings(**options))
    layer = report.manifest.layers[report.layer]
    expected = np.float32(value * options.get("height_scale", 1) + options.get("height_offset", 0))
    for level in layer.levels:
        samples, _ = assemble(open_dataset(tmp_path / "out"), report.layer, level.level)
        assert (samples[: level.height, : level.width] == expected).all()


def test_index_and_statistics_tell_the_truth(height_tiff: Path, tmp_path: Path) -> None:
    build_layer(height_tiff, tmp_path / "out", settings(codec="raw"))
    dataset = open_dataset(tmp_path / "out")
    layer = dataset.manifest.layer("height")
    with rasterio.open(height_tiff) as file:
        values = file.read(1)
    valid = np.isfinite(values)
    statistics = layer.statistics
    assert statistics.valid == valid.sum()
    assert statistics.min == [values[valid].min()]
    assert statistics.max == [values[valid].max()]
    assert statistics.mean[0] == pytest.approx(values[valid].mean(dtype=np.float64), rel=1e-12)
    for address in layer.lattice.addresses(0):
        core = layer.lattice.valid_core(address)
        part = values[core.y0 : core.y1, core.x0 : core.x1]
        record = dataset.record("height", address)
        assert record.valid == np.isfinite(part).sum()
        assert record.blank == (record.valid == 0)
        if (data := dataset.block("height", address)) is not None:
            assert (record.length_bytes, record.digest) == (len(data), digest(data))
            assert (record.min, record.max) == (np.nanmin(part), np.nanmax(part))
    assert list(layer.transform) == [10, 0, 500_005, 0, -10, 4_999_995], "vertices sit in pixel centres"
    assert layer.ground_spacing_m == pytest.approx((10.004, 10.004), abs=1e-3)


def test_blanks_have_no_bytes(tmp_path: Path) -> None:
    pixels = np.zeros((100, 100, 3), np.uint8)
    pixels[40:60, 70:90] = 9
    source = write_tiff(tmp_path / "holes.tif", pixels, nodata=0)
    report = build_layer(source, tmp_path / "out", settings(codec="png"))
    dataset = open_dataset(tmp_path / "out")
    finest = dataset.manifest.layer("imagery").levels[0]
    assert (finest.stored, finest.blank) == (1, 15)
    assert dataset.block("imagery", BlockAddress(0, 0, 0)) is None
    assert len(list((tmp_path / "out/imagery/0").glob("*.png"))) == 1
    assert report.manifest.layer("imagery").alpha


def test_nothing_valid_at_all(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "void.tif", np.full((70, 50, 1), -9999, np.int16), nodata=-9999)
    report = build_layer(source, tmp_path / "out", settings())
    assert report.manifest.layer("height").statistics.valid == 0
    assert all(level.stored == 0 for level in report.manifest.layer("height").levels)
    assert any("no valid sample" in remark for remark in report.remarks)


def test_second_layer_without_georeference_is_spread_over_the_first(tmp_path: Path) -> None:
    heights = tmp_path / "heights.png"
    picture = tmp_path / "picture.png"
    write_png(heights, (terrain(129, 129, seed=1) * 4).astype(np.uint16))
    write_png(picture, photo(256, 256, seed=1))
    out = tmp_path / "out"
    build_layer(heights, out, settings(layer="height", height_scale=0.25, spacing=100, codec="lerc"))
    report = build_layer(picture, out, settings(codec="png"))
    assert list(report.manifest.layers) == ["height", "imagery"]
    assert report.manifest.layer("imagery").transform == (50, 0, 0, 0, -50, 0)
    assert report.manifest.layer("imagery").extent == report.manifest.layer("height").extent == (0, -12800, 12800, 0)
    assert report.manifest.layer("imagery").source.placement == "fitted"


def test_layers_in_different_coordinate_systems_are_refused(height_tiff: Path, tmp_path: Path) -> None:
    build_layer(height_tiff, tmp_path / "out", settings())
    before = tree_digest(tmp_path / "out")
    other = write_tiff(tmp_path / "other.tif", photo(64, 64), crs="EPSG:3857")
    with pytest.raises(UsageError, match=r"EPSG:3857.*EPSG:32632.*gdalwarp"):
        build_layer(other, tmp_path / "out", settings())
    assert tree_digest(tmp_path / "out") == before
