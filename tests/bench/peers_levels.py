"""Coarse levels as each program stored them, read by libraries that no program under test reads or writes with."""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import OpenImageIO
import rasterio
from numpy.typing import NDArray

from schemas.address import parse_block_name

BLOCK: Final = 256
Samples = NDArray[Any]


def _image(path: Path) -> Samples:
    """Return the samples of a small picture file, (h, w, c), in the type they are stored in."""
    picture = OpenImageIO.ImageBuf(str(path))
    if picture.has_error:
        raise SystemExit(f"{path}: {picture.geterror()}")
    return np.asarray(picture.get_pixels(picture.spec().format))


def _joined(blocks: dict[tuple[int, int], Samples], side: int) -> Samples:
    """Return a level of ``side`` by ``side`` samples from its blocks by (x, y)."""
    first = next(iter(blocks.values()))
    level = np.zeros((side, side, first.shape[2]), first.dtype)
    for (x, y), block in blocks.items():
        part = block[: min(BLOCK, side - y * BLOCK), : min(BLOCK, side - x * BLOCK)]
        level[y * BLOCK :, x * BLOCK :][: part.shape[0], : part.shape[1]] = part
    return level


def clipmap_level(output: Path, side: int, level: int) -> Samples:
    """Return level ``level`` of the only layer of ``output``/dataset."""
    (layer,) = json.loads((output / "dataset/manifest.json").read_text())["layers"].values()
    blocks = {}
    for path in (output / "dataset" / layer["path"] / str(level)).iterdir():
        if path.suffix in (".png", ".exr"):
            address = parse_block_name(path.name).address
            blocks[address.x, address.y] = _image(path)
    return _joined(blocks, side >> level)


def vips_level(output: Path, side: int, level: int) -> Samples:
    """Return level ``level`` of ``output``/vips_files; Deep Zoom counts levels from that of one pixel."""
    folder = output / "vips_files"
    finest = max(int(path.name) for path in folder.iterdir() if path.name.isdigit())
    blocks = {}
    for path in (folder / str(finest - level)).iterdir():
        x, y = map(int, path.stem.split("_"))
        blocks[x, y] = _image(path)
    return _joined(blocks, side >> level)


def cog_level(output: Path, side: int, level: int) -> Samples:
    """Return overview ``level`` of ``output``/cog.tif."""
    with rasterio.open(output / "cog.tif", overview_level=level - 1) as file:
        samples = np.moveaxis(file.read(), 0, -1)
    if samples.shape[:2] != (side >> level, side >> level):
        raise SystemExit(f"{output / 'cog.tif'}: overview {level} has {samples.shape[:2]} samples")
    return np.asarray(samples)
