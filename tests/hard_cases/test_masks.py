"""Hard cases of voids: nodata of every kind, alpha, and what a filter with negative lobes does beside them."""

from pathlib import Path

import numpy as np
import pytest

from tests.integration.files import assemble, settings, write_tiff
from tests.levels import KINDS, run_cascade
from tests.reference.kernels import l1_norm, taps
from tests.reference.pyramid import void_gain_bound
from tests.reference.terrain import terrain
from tiler.building.build import build_layer
from tiler.filters.cascade import Coverage, Values
from tiler.stores.dataset import open_dataset

Pair = tuple[Values, Coverage]


def holed(shape: tuple[int, int], valid: dict[tuple[int, int], float]) -> Pair:
    """A void picture but for the given samples."""
    values, coverage = np.zeros((*shape, 1), np.float32), np.zeros(shape, np.float32)
    for place, value in valid.items():
        values[place], coverage[place] = value, 1
    return values, coverage


@pytest.mark.parametrize("kind", KINDS)
def test_c06_single_void(kind: str) -> None:
    """One void in a constant field: the field stays constant on every level; the coarse sample over it is covered in part."""
    values, coverage = np.full((64, 64, 1), 500, np.float32), np.ones((64, 64), np.float32)
    values[30, 30], coverage[30, 30] = 0, 0
    for level, (_, found, covered) in enumerate(run_cascade(values, coverage, levels=4, kind=kind)):
        assert covered is not None
        assert (np.abs(found[covered > 0] - 500) <= 500 * np.finfo(np.float32).eps).all()
        assert (covered > 0).all() or level == 0
        assert covered.min() < 1


@pytest.mark.filterwarnings("error")
def test_c07_all_void(tmp_path: Path) -> None:
    """Every block is blank, statistics are empty, no warning and no 0 / 0."""
    source = write_tiff(tmp_path / "void.tif", np.full((80, 80, 1), np.nan, np.float32))
    report = build_layer(source, tmp_path / "out", settings())
    layer = report.manifest.layer("height")
    assert (layer.statistics.valid, layer.statistics.min) == (0, [])
    assert all(level.stored == 0 for level in layer.levels)


def test_c08_infinities_are_voids(tmp_path: Path) -> None:
    """+inf and -inf are void, and counted as such."""
    pixels = terrain(64, 64).astype(np.float32)
    pixels[3, 3], pixels[40, 40] = np.inf, -np.inf
    source = write_tiff(tmp_path / "inf.tif", pixels)
    report = build_layer(source, tmp_path / "out", settings())
    assert report.manifest.layer("height").statistics.valid == 64 * 64 - 2
    _, valid = assemble(open_dataset(tmp_path / "out"), "height", 0)
    assert not valid[3, 3]
    assert not valid[40, 40]


@pytest.mark.parametrize(
    ("dtype", "nodata", "beside"),
    [
        ("int16", -9999, -9998),
        ("int16", -32768, -32767),
        ("int16", 32767, 32766),
        ("uint16", 0, 1),
        ("uint8", 255, 254),
        ("float32", -9999.0, -9998.9),
        ("float32", 1.70141e38, 12.0),
        ("float32", float(np.finfo(np.float32).min), 12.0),
        ("float64", -1e30, 12.0),
    ],
)
def test_c09_nodata_is_compared_in_the_files_own_type(dtype: str, nodata: float, beside: float, tmp_path: Path) -> None:
    """Exactly the samples with the value are void; a neighbouring value is not."""
    pixels = np.full((40, 40, 1), 100, dtype)
    pixels[5:9, 5:9], pixels[20:24, 20:24] = nodata, beside
    source = write_tiff(tmp_path / "nodata.tif", pixels, nodata=float(np.dtype(dtype).type(nodata)))
    report = build_layer(source, tmp_path / "out", settings(layer="height"))
    assert report.manifest.layer("height").statistics.valid == 40 * 40 - 16
    samples, valid = assemble(open_dataset(tmp_path / "out"), "height", 0)
    assert not valid[5:9, 5:9].any()
    assert (samples[20:24, 20:24] == np.float32(beside)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_c10_isolated_sample_survives_as_itself(kind: str) -> None:
    """One valid sample in a void: the coarse samples over it have its value, the others are void, nothing is amplified."""
    values, coverage = holed((40, 40), {(20, 20): 1234.5})
    for _, found, covered in run_cascade(values, coverage, levels=5, kind=kind):
        assert covered is not None
        assert (covered > 0).any()
        assert (found[covered > 0] == np.float32(1234.5)).all()
        assert (found[covered == 0] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_c11_only_negative_lobes_are_covered(kind: str) -> None:
    """Samples under negative weights only: the coarse sample is void or within the range of what is valid, never amplified."""
    offsets, weights = taps("blackman-sinc", 6, KINDS[kind][0])
    negative = [20 + int(offset) for offset in offsets[weights < 0]]
    values, coverage = holed((42, 42), {(row, column): 10.0 + row for row in negative for column in negative})
    _, found, covered = run_cascade(values, coverage, levels=2, kind=kind)[1]
    assert covered is not None
    assert covered[10, 10] == 0
    assert found[covered > 0].min() >= values[coverage > 0].min() - 1e-3
    assert found[covered > 0].max() <= values[coverage > 0].max() + 1e-3


def test_c12_weights_that_cancel() -> None:
    """W near 0 with covered neighbours: the covering mean decides, no division by nearly nothing."""
    rng = np.random.default_rng(12)
    for _ in range(200):
        coverage = (rng.random((14, 14)) < 0.15).astype(np.float32)
        values = (rng.uniform(1, 2, (14, 14, 1)) * coverage[..., np.newaxis]).astype(np.float32)
        _, found, covered = run_cascade(values, coverage, levels=2, kind="imagery", radius=3)[1]
        assert covered is not None
        assert np.abs(found).max() <= 2 * void_gain_bound(l1_norm("blackman-sinc", 3, "area"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius", [3, 6])
def test_c13_gain_is_bounded(kind: str, radius: int) -> None:
    """GDAL's cubic overview once turned a maximum of 92 into 9329; here the gain stays under the proved bound for any mask."""
    rng = np.random.default_rng(13)
    bound = void_gain_bound(l1_norm("blackman-sinc", radius, KINDS[kind][0]))
    for share in (0.05, 0.3, 0.5, 0.8):
        coverage = (rng.random((96, 96)) < share).astype(np.float32)
        coverage[:24] = coverage[-24:] = 1  # an edge rule may make larger samples of its own: keep it out of sight
        coverage[:, :24] = coverage[:, -24:] = 1
        signs = np.where(rng.random((96, 96, 1)) < 0.5, -92, 92)
        inside = np.zeros((96, 96, 1))
        inside[24:-24, 24:-24] = signs[24:-24, 24:-24]
        values = (inside * coverage[..., np.newaxis]).astype(np.float32)
        _, found, _ = run_cascade(values, coverage, levels=2, kind=kind, radius=radius)[1]
        assert np.abs(found).max() <= 92 * bound * (1 + 1e-6)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_c14_random_voids_leave_no_hole(share: float) -> None:
    """Level 2 and coarser have no void at all, and keep near the range of the input."""
    rng = np.random.default_rng(14)
    coverage = (rng.random((256, 256)) >= share).astype(np.float32)
    values = (rng.uniform(1, 256, (256, 256, 1)) * coverage[..., np.newaxis]).astype(np.float32)
    for level, (_, found, covered) in enumerate(run_cascade(values, coverage, levels=5)):
        assert covered is not None
        if level >= 2:
            assert (covered > 0).all()
            assert found.min() > -80
            assert found.max() < 340


def test_c15_void_at_the_edge() -> None:
    """A reflected void is void: beyond the edge nothing is made from it, and the coarse edge is void where its support is."""
    values, coverage = np.full((48, 48, 1), 200, np.float32), np.ones((48, 48), np.float32)
    values[:6], coverage[:6] = 0, 0
    _, found, covered = run_cascade(values, coverage, levels=2)[1]
    assert covered is not None
    assert (covered[:2] == 0).all()
    assert (covered[4:] == 1).all()
    assert np.abs(found[covered > 0] - 200).max() < 1e-3


def test_c17_sentinels_never_reach_a_result(tmp_path: Path) -> None:
    """-1e30 as nodata beside heights: no coarse sample is anywhere near it."""
    pixels = terrain(96, 96).astype(np.float32)
    low, high = float(pixels.min()), float(pixels.max())
    pixels[40:50, 40:50] = -1e30
    source = write_tiff(tmp_path / "sentinel.tif", pixels, nodata=-1e30)
    build_layer(source, tmp_path / "out", settings())
    dataset = open_dataset(tmp_path / "out")
    for level in dataset.manifest.layer("height").levels:
        samples, valid = assemble(dataset, "height", level.level)
        assert samples[valid].min() > low - (high - low)
        assert samples[valid].max() < high + (high - low)


@pytest.mark.parametrize("hidden", [np.nan, 1e38, -1e38, np.inf, 255.0])
def test_what_lies_under_a_mask_changes_no_bit(hidden: float, tmp_path: Path) -> None:
    """Any value under a declared void gives the same bytes."""
    pixels = terrain(100, 100).astype(np.float32)
    pixels[30:50, 60:90] = np.nan
    other = pixels.copy()
    other[30:50, 60:90] = hidden
    expected = build_layer(write_tiff(tmp_path / "nan.tif", pixels), tmp_path / "nan", settings())
    found = build_layer(write_tiff(tmp_path / "hidden.tif", other, nodata=hidden), tmp_path / "hidden", settings())
    assert [level.index for level in expected.manifest.layer("height").levels] == [
        level.index for level in found.manifest.layer("height").levels
    ]


def test_c62_random_colour_under_alpha_zero_leaves_no_fringe(tmp_path: Path) -> None:
    """Opaque red beside transparent noise: every coarse sample with any alpha is red, as if the noise were not there."""
    rng = np.random.default_rng(62)
    pixels = rng.integers(0, 256, (128, 128, 4), dtype=np.uint8)
    pixels[..., 3] = 0
    pixels[20:90, 30:100] = (210, 10, 20, 255)
    source = write_tiff(tmp_path / "fringe.tif", pixels, photometric="RGB", alpha="YES")
    build_layer(source, tmp_path / "out", settings(codec="png"))
    dataset = open_dataset(tmp_path / "out")
    for level in dataset.manifest.layer("imagery").levels:
        samples, _ = assemble(dataset, "imagery", level.level)
        opaque = samples[..., 3] > 0
        assert (samples[opaque][:, :3] == (210, 10, 20)).all()
        void = ~opaque[: level.height, : level.width]
        assert (samples[: level.height, : level.width][void] == 0).all()
