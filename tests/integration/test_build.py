"""Whole builds: from a file to a published dataset, its guarantees, and what is left when a build does not end."""

import hashlib
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME, digest
from schemas.region import Rect
from schemas.settings import BuildSettings
from tests.reference.terrain import photo, terrain
from tiler.build import build_layer
from tiler.cascade import Cascade, Coverage, Recipe, Values, held_windows
from tiler.codecs import BlockFormat, open_codec
from tiler.cut import round_samples
from tiler.kernels import blackman_sinc
from tiler.stores.dataset import Dataset, open_dataset

Picture = NDArray[Any]
PLACE = Affine(10, 0, 500_000, 0, -10, 5_000_000)


def write_tiff(path: Path, pixels: Picture, **profile: Any) -> Path:
    """Write (rows, columns, channels) as a GeoTIFF, tiled unless told otherwise."""
    profile = {"tiled": True, "blockxsize": 64, "blockysize": 64, "crs": "EPSG:32632", "transform": PLACE, **profile}
    height, width, channels = pixels.shape
    with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=channels, dtype=pixels.dtype.name, **profile) as file:
        file.write(np.moveaxis(pixels, -1, 0))
    return path


def assemble(dataset: Dataset, name: str, level: int) -> tuple[Picture, NDArray[np.bool_]]:
    """Decode all blocks of a level into one picture and its mask, padding included."""
    layer = dataset.manifest.layer(name)
    block = BlockFormat(layer.kind, layer.lattice.stored_side, layer.channels, layer.dtype, layer.alpha)
    codec = open_codec(layer.codec, block)
    columns, rows = layer.lattice.block_counts(level)
    samples = np.zeros((rows * layer.block, columns * layer.block, layer.channels), layer.dtype)
    mask = np.zeros(samples.shape[:2], np.bool_)
    for address in layer.lattice.addresses(level):
        data = dataset.block(name, address)
        if data is not None:
            core = layer.lattice.core(address)
            part, valid = codec.decode(data)
            samples[core.y0 : core.y1, core.x0 : core.x1] = part
            mask[core.y0 : core.y1, core.x0 : core.x1] = True if valid is None else valid
    return samples, mask


def tree_digest(folder: Path) -> str:
    """Digest of all file names and bytes below a folder."""
    total = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        total.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def whole_level(values: Values, coverage: Coverage | None, level: int, kind: str, radius: int) -> tuple[Values, Coverage | None]:
    """Filter the whole picture in one piece and return one level."""
    registration, edge = ("point", "antisymmetric") if kind == "height" else ("area", "mirror")
    height, width, channels = values.shape
    kernel = blackman_sinc(radius, registration)  # type: ignore[arg-type]
    found: list[tuple[Values, Coverage | None]] = []
    windows = held_windows((width, height), Rect(0, 0, width, height), level + 1, kernel.reach)
    recipe = Recipe(kernel, edge, coverage is not None)  # type: ignore[arg-type]
    Cascade((width, height), windows, channels, recipe, lambda n, _, v, c: found.append((v, c)) if n == level else None).push(
        values, coverage
    )
    coverages = [c for _, c in found if c is not None]
    return np.concatenate([v for v, _ in found]), np.concatenate(coverages) if coverages else None


@pytest.fixture(scope="module")
def height_tiff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pixels = terrain(301, 523, seed=3).astype(np.float32)
    pixels[100:140, 200:260] = np.nan
    return write_tiff(tmp_path_factory.mktemp("height") / "height.tif", pixels)


@pytest.fixture(scope="module")
def photo_tiff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiff(tmp_path_factory.mktemp("photo") / "photo.tif", photo(350, 610, seed=3), tiled=False, blockysize=16)


def settings(**options: Any) -> BuildSettings:
    return BuildSettings(**{"block": 32, "codec": "raw", **options})


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
    for level in range(len(layer.levels)):
        expected, covered = whole_level(values, coverage, level, layer.kind, layer.filter.radius)
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
        data = dataset.block("height", address)
        if data is None:
            assert record.blank
        else:
            assert (record.length_bytes, record.digest) == (len(data), digest(data))
            assert (record.min, record.max) == (np.nanmin(part), np.nanmax(part))
    assert layer.transform == (10, 0, 500_005, 0, -10, 4_999_995), "vertices sit in pixel centres"
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


def write_png(path: Path, pixels: Picture) -> None:
    """Write (rows, columns, channels) uint8 or uint16."""
    spec = OpenImageIO.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], pixels.dtype.name)
    output = opened(path, spec)
    assert output.write_image(pixels)
    output.close()


def opened(path: Path, spec: OpenImageIO.ImageSpec) -> OpenImageIO.ImageOutput:
    """Return an OpenImageIO output that is ready to be written."""
    output = OpenImageIO.ImageOutput.create(str(path))
    assert output is not None
    assert output.open(str(path), spec)
    return output


def test_layers_in_different_coordinate_systems_are_refused(height_tiff: Path, tmp_path: Path) -> None:
    build_layer(height_tiff, tmp_path / "out", settings())
    before = tree_digest(tmp_path / "out")
    other = write_tiff(tmp_path / "other.tif", photo(64, 64), crs="EPSG:3857")
    with pytest.raises(UsageError, match=r"EPSG:3857.*EPSG:32632.*gdalwarp"):
        build_layer(other, tmp_path / "out", settings())
    assert tree_digest(tmp_path / "out") == before


def test_an_existing_layer_is_replaced_only_when_told(height_tiff: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = build_layer(height_tiff, out, settings())
    with pytest.raises(UsageError, match="--overwrite"):
        build_layer(height_tiff, out, settings(codec="lerc"))
    second = build_layer(height_tiff, out, settings(codec="lerc", overwrite=True))
    third = build_layer(height_tiff, out, settings(overwrite=True))
    assert first.manifest.version != second.manifest.version
    assert [report.manifest.layer("height").path for report in (first, second, third)] == ["height", "height.2", "height"]
    assert sorted(path.name for path in out.iterdir()) == ["height", MANIFEST_NAME]
    assert tree_digest(out) == tree_digest_of_fresh(height_tiff, tmp_path / "fresh")


def tree_digest_of_fresh(source: Path, out: Path) -> str:
    build_layer(source, out, settings())
    return tree_digest(out)


def test_a_reader_of_the_old_version_sees_it_until_the_new_one_is_done(height_tiff: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    build_layer(height_tiff, out, settings())
    before = assemble(open_dataset(out), "height", 0)[0]
    seen = []

    def look(done: int, total: int) -> None:
        if done == total // 2:
            seen.append(assemble(open_dataset(out), "height", 0)[0])

    build_layer(height_tiff, out, settings(overwrite=True, height_offset=100.0, workers=1), look)
    assert (seen[0] == before).all()
    assert not np.array_equal(assemble(open_dataset(out), "height", 0)[0], before)


def test_a_folder_with_other_things_is_left_alone(height_tiff: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/height").write_text("precious")
    with pytest.raises(UsageError, match="not a dataset, and not empty"):
        build_layer(height_tiff, tmp_path / "mine", settings())
    assert (tmp_path / "mine/height").read_text() == "precious"
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["height"]


def test_a_failed_build_leaves_nothing(tmp_path: Path) -> None:
    """The tiles at the end of the file are cut off: noticed only when they are read, long after blocks were stored."""
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 3 // 4])
    with pytest.raises(InputError, match=r"cut\.tif"):
        build_layer(source, tmp_path / "out", settings(workers=1, task=64))
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_a_sentence(height_tiff: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = itertools.count()
    rename = os.replace

    def replace(old: Any, new: Any) -> None:
        if next(calls) == 40:
            raise OSError(28, os.strerror(28))
        rename(old, new)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(StorageError, match="No space left on device"):
        build_layer(height_tiff, tmp_path / "out", settings())
    assert not (tmp_path / "out").exists()


def test_two_builds_exclude_each_other(height_tiff: Path, tmp_path: Path) -> None:
    refused = []

    def intrude(done: int, total: int) -> None:
        if done == 1:
            with pytest.raises(StorageError, match=rf"another build is writing here \(process {os.getpid()}\)") as error:
                build_layer(height_tiff, tmp_path / "out", settings())
            refused.append(error)

    build_layer(height_tiff, tmp_path / "out", settings(workers=1), intrude)
    assert len(refused) == 1
    open_dataset(tmp_path / "out")


BUILD = "import sys; from cli.main import run; sys.exit(run(sys.argv[1:]))"


def test_kill_leaves_no_dataset_that_opens_as_complete(tmp_path: Path) -> None:
    """``kill -9`` at random moments; then the same command makes the same dataset as an undisturbed build."""
    source = write_tiff(tmp_path / "photo.tif", photo(1024, 1024, seed=8))
    arguments = [sys.executable, "-c", BUILD, "build", str(source), "--block", "32", "--task", "64", "--codec", "png"]
    subprocess.run([*arguments, "-o", str(tmp_path / "whole")], check=True, capture_output=True)
    chance, killed, out = random.Random(20261122), 0, tmp_path / "killed"
    for _ in range(6):
        process = subprocess.Popen([*arguments, "-o", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        blocks = chance.randrange(1, 600)
        while process.poll() is None and len(list(out.glob("imagery/*/*.png"))) < blocks:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if (out / MANIFEST_NAME).exists():
            break
        killed += 1
        with pytest.raises(NotFoundError, match=r"not a dataset|no dataset"):
            open_dataset(out)
    assert killed, "no build was caught in the act"
    if not (out / MANIFEST_NAME).exists():
        subprocess.run([*arguments, "-o", str(out)], check=True, capture_output=True)
    assert tree_digest(out / "imagery") == tree_digest(tmp_path / "whole/imagery")
    assert (out / MANIFEST_NAME).read_bytes() == (tmp_path / "whole" / MANIFEST_NAME).read_bytes()


def test_interrupt_leaves_nothing(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(1024, 1024, seed=8))
    arguments = [
        sys.executable,
        "-c",
        BUILD,
        "build",
        str(source),
        "--block",
        "32",
        "--task",
        "64",
        "--codec",
        "png",
        "-o",
        str(tmp_path / "o"),
    ]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list((tmp_path / "o").glob("imagery/0/*.png")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.strip() == "clipmap: interrupted"
    assert not (tmp_path / "o").exists()


def test_memory_is_bounded_by_the_rows_in_flight(tmp_path: Path) -> None:
    """8192 x 8192 RGB is 201 MB raw and 805 MB as float32; the build's peak must stay under 400 MB."""
    side = 8192
    source = tmp_path / "large.tif"
    spec = OpenImageIO.ImageSpec(side, side, 3, "uint8")
    spec.tile_width = spec.tile_height = 512
    spec.attribute("compression", "none")
    output = opened(source, spec)
    tile = photo(512, 512, seed=5)
    for y, x in itertools.product(range(0, side, 512), range(0, side, 512)):
        assert output.write_tile(x, y, 0, tile)
    output.close()
    result = subprocess.run(
        [sys.executable, "-c", BUILD, "build", str(source), "-o", str(tmp_path / "out"), "--workers", "2", "--json"],
        check=True,
        capture_output=True,
        text=True,
    )
    report = json.loads(result.stdout)
    assert report["peak_rss_bytes"] < 400e6
    assert report["blocks_stored"] == 1024 + 256 + 64 + 16 + 4 + 1
