"""Source files for whole builds, and what to look at in the result."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import rasterio
from affine import Affine
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.settings import BuildSettings
from tiler.codecs import BlockFormat, open_codec
from tiler.stores.dataset import Dataset

Picture = NDArray[Any]
PLACE = Affine(10, 0, 500_000, 0, -10, 5_000_000)


def write_tiff(path: Path, pixels: Picture, **profile: Any) -> Path:
    """Write (rows, columns, channels) as a GeoTIFF, tiled unless told otherwise."""
    profile = {"tiled": True, "blockxsize": 64, "blockysize": 64, "crs": "EPSG:32632", "transform": PLACE, **profile}
    height, width, channels = pixels.shape
    with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=channels, dtype=pixels.dtype.name, **profile) as file:
        file.write(np.moveaxis(pixels, -1, 0))
    return path


def decode(dataset: Dataset, name: str, address: BlockAddress) -> tuple[Picture, NDArray[np.bool_]]:
    """Decode a block with its pad; a blank is void everywhere."""
    layer = dataset.manifest.layer(name)
    side = layer.lattice.stored_side
    data = dataset.block(name, address)
    if data is None:
        return np.zeros((side, side, layer.channels), layer.dtype), np.zeros((side, side), np.bool_)
    samples, mask = open_codec(layer.codec, BlockFormat(layer.kind, side, layer.channels, layer.dtype, layer.alpha)).decode(data)
    return samples, np.ones((side, side), np.bool_) if mask is None else mask


def assemble(dataset: Dataset, name: str, level: int) -> tuple[Picture, NDArray[np.bool_]]:
    """Decode all blocks of a level into one picture and its mask, padding included."""
    layer = dataset.manifest.layer(name)
    columns, rows = layer.lattice.block_counts(level)
    samples = np.zeros((rows * layer.block, columns * layer.block, layer.channels), layer.dtype)
    mask = np.zeros(samples.shape[:2], np.bool_)
    core = np.s_[layer.pad : layer.pad + layer.block, layer.pad : layer.pad + layer.block]
    for address in layer.lattice.addresses(level):
        there = layer.lattice.core(address)
        part, valid = decode(dataset, name, address)
        samples[there.y0 : there.y1, there.x0 : there.x1] = part[core]
        mask[there.y0 : there.y1, there.x0 : there.x1] = valid[core]
    return samples, mask


def tree_digest(folder: Path) -> str:
    """Digest of all file names and bytes of a dataset or a layer; task records, which say when and from where it was built, left out."""
    total = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and "tasks" not in path.relative_to(folder).parts):
        total.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


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


def settings(**options: Any) -> BuildSettings:
    return BuildSettings(**{"block": 32, "codec": "raw", **options})
