"""A layer as a Cloud Optimized GeoTIFF: level 0 is the image, every other level an overview."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import imagecodecs
import numpy as np

from schemas.address import BlockAddress
from schemas.errors import InputError
from schemas.region import Rect
from tiler.codecs import Samples
from tiler.export import Exported, Job
from tiler.export.geotags import geotiff_tags
from tiler.export.pyramid import Pyramid, in_order, tile_count, tiles
from tiler.export.staging import staged
from tiler.export.tifflayout import SUBFILE_TYPE, SUBSAMPLING, CogFile, LevelTiles, Tag, longs, shorts
from tiler.stores.dataset import Dataset

_COPIED: Final = {"jpeg": "JPEG", "webp": "WEBP"}
"""Codecs whose blocks are tiles of a TIFF as they are, by the name GDAL gives them."""
_LARGEST_WITHOUT_OVERVIEW: Final = 512
"""Side in samples up to which readers do without an overview (the limit of GDAL's and rio-cogeo's validators)."""
_SMALLEST_TILE: Final = 16
"""Sides of tiles are multiples of 16 (TIFF 6.0, section 15)."""
_DEFLATE_LEVEL: Final = 6


@dataclass(frozen=True, slots=True)
class _TileForm:
    """What the tiles are: GDAL's creation options for their tags, and whether stored blocks are tiles as they are."""

    options: dict[str, Any]
    copied: bool
    side: int
    encode: Callable[[Samples], bytes]


def write_cog(dataset: Dataset, name: str, target: Path, job: Job) -> Exported:
    """Write layer ``name`` to the file ``target``.

    Blocks of jpeg and webp without a pad, but for light in webp, become tiles byte for byte; all others are decoded and stored without
    further loss (DEFLATE, with the predictor for their type). Voids of heights are NaN, which is declared as nodata; alpha stays alpha, not
    premultiplied. Raises InputError or NotFoundError for a damaged dataset, StorageError if the file cannot be written.
    """
    pyramid = Pyramid(dataset, name, _LARGEST_WITHOUT_OVERVIEW)
    form = _choose_form(pyramid)
    tags, overview_tags = geotiff_tags(dataset.manifest, pyramid.layer, form.options)
    if form.copied and pyramid.layer.codec.startswith("jpeg") and pyramid.layer.channels == 3:
        subsampling = {SUBSAMPLING: _jpeg_subsampling(pyramid)}
        tags, overview_tags = tags | subsampling, overview_tags | subsampling
    rects = [pyramid.rect(level) for level in range(pyramid.levels)]
    counts = [tile_count(rect, form.side) for rect in rects]
    levels = [
        LevelTiles(rect.width, rect.height, overview_tags | {SUBFILE_TYPE: longs(1)} if level else tags, counts[level])
        for level, rect in enumerate(rects)
    ]
    total = Exported(levels=pyramid.levels)
    with staged(target) as temporary, temporary.open("r+b") as file:
        cog = CogFile(file, levels, form.side, _at_most_bytes(pyramid, form, sum(counts)))
        for level in range(pyramid.levels - 1, -1, -1):
            cog.write_level(level, _counted(pyramid, form, level, total, job, sum(counts)))
        cog.finish()
        file.flush()
        total.stored_bytes = file.seek(0, 2)
    return total


def _counted(pyramid: Pyramid, form: _TileForm, level: int, total: Exported, job: Job, tiles_in_all: int) -> Iterator[bytes]:
    """Yield the bytes of all tiles of a level in row order, and keep count."""
    for data, copied in in_order(partial(_tile, pyramid, form, level), tiles(pyramid.rect(level), form.side), job.workers):
        total.copied += copied
        total.encoded += not copied
        job.on_progress(total.copied + total.encoded, tiles_in_all)
        yield data


def _tile(pyramid: Pyramid, form: _TileForm, level: int, rect: Rect) -> tuple[bytes, bool]:
    """Return the bytes of a tile, and whether they are those of a stored block."""
    if form.copied and pyramid.is_stored(level):
        data = pyramid.stored_bytes(BlockAddress(level, rect.x0 // form.side, rect.y0 // form.side))
        if data is not None:
            return data, True
    window = pyramid.window(level, rect)
    samples = window.samples
    if pyramid.layer.dtype == "float32":
        samples = np.where(window.valid[..., np.newaxis], samples, np.float32(np.nan))
    missing = ((0, form.side - samples.shape[0]), (0, form.side - samples.shape[1]), (0, 0))
    return form.encode(np.pad(samples, missing, mode="edge")), False


def _choose_form(pyramid: Pyramid) -> _TileForm:
    layer, codec = pyramid.layer, pyramid.layer.codec.partition(":")[0]
    side = max(layer.block, _SMALLEST_TILE)
    # Light in WebP is three equal channels, and would be one in the TIFF.
    alike = codec != "webp" or layer.channels - layer.alpha == 3
    if codec in _COPIED and alike and layer.pad == 0 and side == layer.block:
        options = {"compress": _COPIED[codec]}
        if codec == "jpeg" and layer.channels == 3:
            options["photometric"] = "YCBCR"
        return _TileForm(options, copied=True, side=side, encode=lambda samples: pyramid.codec.encode(samples, None))
    floating = layer.dtype == "float32"
    return _TileForm({"compress": "DEFLATE", "predictor": 3 if floating else 2}, copied=False, side=side, encode=_deflate)


def _deflate(samples: Samples) -> bytes:
    """Return a tile (side, side, channels) compressed with DEFLATE after TIFF's predictor for its type (Technical Note 3 for floats)."""
    predict = imagecodecs.floatpred_encode if samples.dtype.kind == "f" else imagecodecs.delta_encode
    return bytes(imagecodecs.deflate_encode(predict(np.ascontiguousarray(samples), axis=-2).tobytes(), level=_DEFLATE_LEVEL))


def _at_most_bytes(pyramid: Pyramid, form: _TileForm, count: int) -> int:
    """Return what all tiles can take at most: copies what they take, others what they hold and 1 % (DEFLATE never grows by more)."""
    layer = pyramid.layer
    copies = sum(level.stored for level in layer.levels) if form.copied else 0
    copied_bytes = sum(level.stored_bytes for level in layer.levels) if form.copied else 0
    tile_bytes = form.side**2 * layer.channels * np.dtype(layer.dtype).itemsize
    return copied_bytes + int((count - copies) * (tile_bytes * 1.01 + 1000))


def _jpeg_subsampling(pyramid: Pyramid) -> Tag:
    """Return the field that says how much coarser colour is stored than brightness, read in a frame header (ITU-T T.81, B.2.2)."""
    address = BlockAddress(pyramid.lattice.levels - 1, 0, 0)
    data = pyramid.stored_bytes(address) or b""
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if 0xC0 <= marker <= 0xC2 and place + 12 <= len(data):
            factors = data[place + 11]
            return shorts(factors >> 4, factors & 15)
        place += 2 + length
    raise InputError(f"block {address} has no JPEG frame header; it is damaged, rebuild the layer")
