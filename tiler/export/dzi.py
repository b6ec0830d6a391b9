"""A layer as a Deep Zoom image: ``NAME.dzi`` and the tiles in ``NAME_files/<level>/<column>_<row>.<suffix>``.

Levels are counted from 0, a single pixel, to ``ceil(log2(max(width, height)))``, our level 0; each has the size of the next,
halved and rounded up, as ours have. ``Overlap`` is the number of neighbouring pixels that a tile shows on each side on which it has a
neighbour, so our pad is one (Microsoft, Deep Zoom file format overview; OpenSeadragon, DziTileSource).
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from schemas.address import BlockAddress
from schemas.errors import UsageError
from schemas.region import Rect
from tiler.codecs import BlockFormat, Codec, open_codec
from tiler.export import Exported, Job
from tiler.export.pyramid import Pyramid, in_order, tile_count, tiles
from tiler.export.staging import PREFIX, staged, storage_errors
from tiler.stores.dataset import Dataset
from tiler.stores.directory import DirectoryStore

_NAMESPACE: Final = "http://schemas.microsoft.com/deepzoom/2008"
_PICTURES: Final = ("jpeg", "png", "webp")

_Tile = tuple[int, Rect]


def write_dzi(dataset: Dataset, name: str, target: Path, job: Job) -> Exported:
    """Write layer ``name`` of imagery or light to ``target`` and the folder beside it; the ``.dzi`` comes last.

    Blocks that lie wholly inside their level are copied byte for byte if the codec is jpeg, png or webp; those at the edges are cut to
    the level and encoded again with the same codec. Other codecs become png. Raises UsageError for light in floats, or if something that is
    no folder has the folder's name, InputError or NotFoundError for a damaged dataset, StorageError if something cannot be written.
    """
    if dataset.manifest.layer(name).dtype == "float32":
        raise UsageError(
            f"layer {name!r} holds light in floats, which no picture can: export it as exr or cog, or build it with --codec png"
        )
    pyramid = Pyramid(dataset, name, 1)
    picture = _Picture(pyramid)
    folder = target.with_name(f"{target.stem}_files")
    if os.path.lexists(folder) and not (folder.is_dir() and job.settings.overwrite):
        raise UsageError(f"{folder}: exists already; add --overwrite to replace it, or choose another name")
    total = Exported(levels=pyramid.levels)
    with staged(target) as temporary:
        fresh = folder.with_name(f"{PREFIX}{folder.name}")
        shutil.rmtree(fresh, ignore_errors=True)
        try:
            _write_tiles(picture, fresh, target, total, job)
            temporary.write_bytes(_descriptor(pyramid, picture.suffix))
            total.stored_bytes += temporary.stat().st_size
            DirectoryStore(fresh).sync()
            _replace_folder(fresh, folder, target)
        except BaseException:
            shutil.rmtree(fresh, ignore_errors=True)
            raise
    return total


def _write_tiles(picture: "_Picture", folder: Path, target: Path, total: Exported, job: Job) -> None:
    pyramid, side = picture.pyramid, picture.pyramid.layer.block
    whole = sum(tile_count(pyramid.rect(level), side) for level in range(pyramid.levels))
    for level in range(pyramid.levels):
        (folder / str(pyramid.levels - 1 - level)).mkdir(parents=True)

    def write(tile: _Tile) -> tuple[int, bool]:
        level, rect = tile
        data, copied = picture.tile(level, rect)
        path = folder / str(pyramid.levels - 1 - level) / f"{rect.x0 // side}_{rect.y0 // side}.{picture.suffix}"
        with storage_errors(target):
            path.write_bytes(data)
        return len(data), copied

    for size, copied in in_order(write, _all_tiles(pyramid, side), job.workers):
        total.copied += copied
        total.encoded += not copied
        total.stored_bytes += size
        job.on_progress(total.copied + total.encoded, whole)


def _all_tiles(pyramid: Pyramid, side: int) -> Iterator[_Tile]:
    for level in range(pyramid.levels):
        for rect in tiles(pyramid.rect(level), side):
            yield level, rect


class _Picture:
    """The tiles of a layer as picture files."""

    def __init__(self, pyramid: Pyramid) -> None:
        self.pyramid = pyramid
        layer = pyramid.layer
        self._copies = layer.codec.partition(":")[0] in _PICTURES
        block = BlockFormat(layer.kind, layer.block, layer.channels, layer.dtype, layer.alpha)
        self._codec: Codec = pyramid.codec if self._copies else open_codec("png", block)
        self.suffix = self._codec.suffix

    def tile(self, level: int, core: Rect) -> tuple[bytes, bool]:
        """Return the bytes of a tile whose core is ``core``, and whether they are those of a stored block."""
        pyramid = self.pyramid
        pad, whole = pyramid.layer.pad, pyramid.rect(level)
        if self._copies and pyramid.is_stored(level) and whole.contains(core.grown(pad)):
            side = pyramid.layer.block
            data = pyramid.stored_bytes(BlockAddress(level, core.x0 // side, core.y0 // side))
            if data is not None:
                return data, True
        window = pyramid.window(level, core.grown(pad))
        return self._codec.encode(np.ascontiguousarray(window.samples), None), False


def _descriptor(pyramid: Pyramid, suffix: str) -> bytes:
    layer = pyramid.layer
    image = ET.Element("Image", xmlns=_NAMESPACE, Format=suffix, Overlap=str(layer.pad), TileSize=str(layer.block))
    ET.SubElement(image, "Size", Width=str(layer.width), Height=str(layer.height))
    return bytes(ET.tostring(image, encoding="utf-8", xml_declaration=True)) + b"\n"


def _replace_folder(fresh: Path, folder: Path, target: Path) -> None:
    """Put ``fresh`` in the place of ``folder``; meanwhile there is no ``.dzi`` that would speak of the wrong tiles."""
    target.unlink(missing_ok=True)
    old = folder.with_name(f"{PREFIX}old-{folder.name}")
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        folder.rename(old)
    fresh.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
