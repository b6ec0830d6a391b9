"""docs/FORMAT.md is enough to read a dataset: a reader written from it alone, without a line of clipmap, reads what a build wrote."""

import hashlib
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

from schemas.settings import BuildSettings
from tiler.building.build import build_layer

WIDTH, HEIGHT, BLOCK = 75, 42, 16
ORIGIN, SPACING_M = (400_000.0, 5_000_000.0), 25.0


def blake2b_128(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


class FormatReader:
    """Reads datasets whose blocks are ``raw``, section by section of the document."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest: dict[str, Any] = json.loads((folder / "manifest.json").read_bytes())
        assert self.manifest["format"] == "clipmap"
        assert self.manifest["format_version"] == 1
        content = {key: self.manifest[key] for key in ("layers", "world")}
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        assert self.manifest["version"] == blake2b_128(text.encode("ascii"))

    def levels(self, name: str) -> Iterator[tuple[int, NDArray[Any], NDArray[np.bool_]]]:
        """Every level of a layer with its samples and which of them are valid."""
        layer = self.manifest["layers"][name]
        count = 1 + max(0, math.ceil(math.log2(max(layer["width"], layer["height"]) / layer["block"])))
        assert len(layer["levels"]) == count
        for level in range(count):
            size = math.ceil(layer["width"] / 2**level), math.ceil(layer["height"] / 2**level)
            entry = layer["levels"][level]
            assert (entry["level"], entry["width"], entry["height"]) == (level, *size)
            yield level, *self._level(name, layer, level, count)

    def _level(self, name: str, layer: dict[str, Any], level: int, count: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        entry, block = layer["levels"][level], layer["block"]
        columns, rows = math.ceil(entry["width"] / block), math.ceil(entry["height"] / block)
        folder = self.folder / layer["path"] / str(level)
        index = (folder / "index.bin").read_bytes()
        assert blake2b_128(index) == entry["index"]
        assert len(index) == 32 * columns * rows
        samples = np.zeros((rows * block, columns * block, layer["channels"]), layer["dtype"])
        valid = np.zeros(samples.shape[:2], np.bool_)
        names = {"index.bin"}
        for y in range(rows):
            for x in range(columns):
                digest, length, marked, low, high = struct.unpack_from("<16sIIff", index, 32 * (y * columns + x))
                if not length:
                    assert (digest, marked, low, high) == (bytes(16), 0, 0.0, 0.0)
                    continue
                digits = count - 1 - level
                y_up = 2**digits - 1 - y
                code = "".join(str((x >> b & 1) + 2 * (y_up >> b & 1)) for b in reversed(range(digits)))
                names.add(f"{name}-{level}{'-' if code else ''}{code}.{layer['suffix']}")
                data = (folder / f"{name}-{level}{'-' if code else ''}{code}.{layer['suffix']}").read_bytes()
                assert (len(data), hashlib.blake2b(data, digest_size=16).digest()) == (length, digest)
                place = np.s_[y * block : (y + 1) * block, x * block : (x + 1) * block]
                samples[place], valid[place] = self._raw(data, layer)
                inside = valid[place][: entry["height"] - y * block, : entry["width"] - x * block]
                values = samples[place][: entry["height"] - y * block, : entry["width"] - x * block][inside]
                assert (marked, low, high) == (inside.sum(), values.min(), values.max())
        assert {path.name for path in folder.iterdir()} == names, "blanks have no file, and nothing else lies there"
        return samples[: entry["height"], : entry["width"]], valid[: entry["height"], : entry["width"]]

    @staticmethod
    def _raw(data: bytes, layer: dict[str, Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        side, dtype = layer["block"] + 2 * layer["pad"], np.dtype(layer["dtype"]).newbyteorder("<")
        plain = side * side * layer["channels"] * dtype.itemsize
        samples = np.frombuffer(data[:plain], dtype).reshape(side, side, layer["channels"])
        if len(data) == plain:
            return samples, np.ones((side, side), np.bool_)
        bits = np.frombuffer(data[plain:], np.uint8)
        return samples, np.array([bits[n // 8] >> (n % 8) & 1 for n in range(side * side)], np.bool_).reshape(side, side)


@pytest.fixture(scope="module")
def heights() -> NDArray[np.float32]:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(800 + 5 * rows - 3 * columns + 40 * np.sin(columns / 9) * np.cos(rows / 7), np.float32)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, heights: NDArray[np.float32]) -> Path:
    folder = tmp_path_factory.mktemp("format")
    profile = {"driver": "GTiff", "width": WIDTH, "height": HEIGHT, "crs": "EPSG:32633"}
    transform = Affine(SPACING_M, 0, ORIGIN[0], 0, -SPACING_M, ORIGIN[1])
    stored = heights.copy()
    stored[:20, :35] = np.nan
    with rasterio.open(folder / "dem.tif", "w", count=1, dtype="float32", transform=transform, nodata=np.nan, **profile) as file:
        file.write(stored, 1)
    picture = np.random.default_rng(3).integers(0, 256, (3, HEIGHT, WIDTH), np.uint8)
    with rasterio.open(folder / "photo.tif", "w", count=3, dtype="uint8", photometric="rgb", transform=transform, **profile) as file:
        file.write(picture)
    np.save(folder / "picture.npy", np.moveaxis(picture, 0, -1))
    for name, kind in (("dem.tif", "height"), ("photo.tif", "imagery")):
        build_layer(folder / name, folder / "dataset", BuildSettings.model_validate({"layer": kind, "codec": "raw", "block": BLOCK}))
    return folder / "dataset"


def test_every_block_of_imagery_is_found_and_whole(dataset: Path) -> None:
    levels = list(FormatReader(dataset).levels("imagery"))
    assert len(levels) == 4
    _, samples, valid = levels[0]
    np.testing.assert_array_equal(samples, np.load(dataset.parent / "picture.npy"))
    assert valid.all()
    assert levels[-1][1].shape == (6, 10, 3)


def test_voids_are_void_and_blanks_are_blank(dataset: Path, heights: NDArray[np.float32]) -> None:
    reader = FormatReader(dataset)
    _, samples, valid = next(reader.levels("height"))
    void = np.zeros_like(valid)
    void[:20, :35] = True
    np.testing.assert_array_equal(valid, ~void)
    np.testing.assert_array_equal(samples[..., 0][valid], heights[valid])
    finest = reader.manifest["layers"]["height"]["levels"][0]
    assert finest["blank"] == 2, "16 x 32 samples of the void cover two blocks of 16 x 16"


def test_a_coarse_sample_lies_where_the_document_says(dataset: Path, heights: NDArray[np.float32]) -> None:
    """Point registration: sample i of level l is sample 2^l i of level 0; smooth terrain keeps its height there.

    0.2 m are allowed: the filter and the rows that voids come near cost 0.07 m, a quarter of a sample off would be 1.9 m.
    """
    levels = {level: (samples[..., 0], valid) for level, samples, valid in FormatReader(dataset).levels("height")}
    samples, valid = levels[1]
    below = heights[::2, ::2]
    well_inside = np.zeros_like(valid)
    well_inside[16:, 24:] = True
    assert np.abs(samples - below)[valid & well_inside].max() < 0.2


def test_world_coordinates_of_both_registrations(dataset: Path) -> None:
    layers = FormatReader(dataset).manifest["layers"]
    for name, offset in (("imagery", 0.5), ("height", 0.0)):
        a, b, c, d, e, f = layers[name]["transform"]
        column, row = 3 + offset, 5 + offset
        world = a * column + b * row + c, d * column + e * row + f
        assert world == pytest.approx((ORIGIN[0] + 3.5 * SPACING_M, ORIGIN[1] - 5.5 * SPACING_M), abs=1e-6), name
