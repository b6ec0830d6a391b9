"""Source files for whole builds, and what to look at in the result."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import rasterio
from affine import Affine
from numpy.typing import NDArray

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
