"""A layer as one tiled, mip-mapped OpenEXR file: level for level, rounded up as ours are, down to 1 x 1."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from schemas.errors import StorageError, UsageError
from schemas.light import Normals
from schemas.manifest import Layer, Manifest
from schemas.region import Rect
from tiler.checking.blockreader import DecodedBlock
from tiler.export import Exported, Job
from tiler.export.geotags import filter_text
from tiler.export.pyramid import Pyramid, in_order, tile_count, tiles
from tiler.export.staging import staged
from tiler.samples.transfer import light_of_codes
from tiler.stores.dataset import Dataset

Pixels = NDArray[np.float32]

_MIPMAP_LEVELS: Final = 1
_ROUND_UP: Final = 1
"""OpenEXR's LevelMode and LevelRoundingMode (ImfTileDescription.h)."""
_SMALLEST_TILE: Final = 16
_MAX_SIDE: Final = (1 << 31) - 1
_HALF_MAX: Final = 65504.0
_NAMES: Final = {1: ("Y",), 3: ("R", "G", "B")}
_OF_NORMALS: Final = ("N.X", "N.Y")
"""As renderers name the parts of normals."""


def write_exr(dataset: Dataset, name: str, target: Path, job: Job) -> Exported:
    """Write layer ``name`` to the file ``target``, ZIP-compressed, in tiles of the layer's block side.

    Heights are channel Y in metres, with A (1 valid, 0 void, where Y is 0) if the layer has voids; normals are N.X and N.Y. 8-bit imagery,
    and imagery filtered in linear light, is decoded from sRGB to light, other integers are divided by their largest value; colour is
    premultiplied by A.
    Raises UsageError if half floats cannot hold the values or the layer has two or four colours, InputError or NotFoundError for a damaged
    dataset, StorageError if the file cannot be written.
    """
    pyramid = Pyramid(dataset, name, 1)
    layer = pyramid.layer
    half = layer.dtype == "uint8" if job.settings.half is None else job.settings.half
    _refuse_unfit(layer, name, half)
    convert = _conversion(layer, codes=job.settings.codes)
    side = max(layer.block, _SMALLEST_TILE)
    whole = sum(tile_count(pyramid.rect(level), side) for level in range(pyramid.levels))
    total = Exported(levels=pyramid.levels)
    with staged(target) as temporary:
        file = _MipmapFile(temporary, target, _specification(dataset.manifest, layer, convert, side, half))
        try:
            for level in range(pyramid.levels):
                rect = pyramid.rect(level)
                file.begin_level(level, rect)
                work = partial(_tile, pyramid, convert, level)
                for tile, pixels in in_order(work, tiles(rect, side), job.workers):
                    file.write(tile & rect, pixels)
                    total.encoded += 1
                    job.on_progress(total.encoded, whole)
        finally:
            file.close()
        _require_whole(temporary, target, pyramid.levels - 1)
        total.stored_bytes = temporary.stat().st_size
    return total


def _tile(pyramid: Pyramid, convert: "_Conversion", level: int, rect: Rect) -> tuple[Rect, Pixels]:
    return rect, convert(pyramid.window(level, rect))


class _Conversion:
    """How decoded samples become pixels: channels' names, what the numbers are, and the function."""

    def __init__(self, names: tuple[str, ...], transfer: str, colour: Callable[[NDArray[Any]], Pixels], alpha: str) -> None:
        self.names, self.transfer = names, transfer
        self._colour, self._alpha = colour, alpha

    def __call__(self, block: DecodedBlock) -> Pixels:
        """Return (rows, columns, channels) float32."""
        if self._alpha == "stored":
            top = np.float32(np.iinfo(block.samples.dtype).max)
            alpha = block.samples[..., -1:].astype(np.float32) / top
            return np.concatenate([self._colour(block.samples[..., :-1]) * alpha, alpha], axis=-1)
        colour = self._colour(block.samples)
        return np.concatenate([colour, block.valid[..., np.newaxis].astype(np.float32)], axis=-1) if self._alpha == "mask" else colour


def _conversion(layer: Layer, *, codes: bool) -> _Conversion:
    if layer.normals is not None:
        return _of_normals(layer, layer.normals)
    names = _NAMES[layer.channels - layer.alpha]
    if layer.dtype == "float32":
        voids = layer.statistics.valid < layer.width * layer.height
        units = "metres" if layer.kind == "height" else "as stored"
        return _Conversion((*names, "A") if voids else names, units, lambda samples: samples, "mask" if voids else "")
    names, alpha = ((*names, "A"), "stored") if layer.alpha else (names, "")
    top = int(np.iinfo(layer.dtype).max)
    if not codes and (layer.dtype == "uint8" or layer.filter.linear_light):
        light = light_of_codes(top)
        return _Conversion(names, "light, decoded from sRGB", lambda samples: light[samples], alpha)
    return _Conversion(names, f"codes / {top}", lambda samples: samples.astype(np.float32) / np.float32(top), alpha)


def _of_normals(layer: Layer, normals: Normals) -> _Conversion:
    """Return x and y themselves, whatever their codes; they are not multiplied by the mask."""
    voids = layer.statistics.valid < layer.width * layer.height

    def convert(samples: NDArray[Any]) -> Pixels:
        found = (samples[..., :2] - np.float32(normals.zero)) / np.float32(normals.one)
        return np.where(samples[..., 2:] > 0, found, np.float32(0)) if layer.alpha else found

    return _Conversion((*_OF_NORMALS, "A") if voids else _OF_NORMALS, "x and y of unit normals", convert, "mask" if voids else "")


def _refuse_unfit(layer: Layer, name: str, half: bool) -> None:
    if layer.kind != "normal" and layer.channels - layer.alpha not in _NAMES:
        raise UsageError(f"layer {name!r} has {layer.channels - layer.alpha} colours, and exr holds 1 or 3; export it as cog")
    if max(layer.width, layer.height) > _MAX_SIDE:
        raise UsageError(f"layer {name!r} has a side of more than {_MAX_SIDE} samples, which exr cannot hold; export it as cog")
    extremes = [abs(value) for value in (*layer.statistics.min, *layer.statistics.max)]
    if half and layer.dtype == "float32" and max(extremes, default=0.0) > _HALF_MAX:
        raise UsageError(f"layer {name!r} has values up to {max(extremes):g}, and half floats end at {_HALF_MAX:g}; leave --half out")


def _specification(manifest: Manifest, layer: Layer, convert: _Conversion, side: int, half: bool) -> OpenImageIO.ImageSpec:
    """Return what OpenImageIO writes into the header; what has no place of its own in OpenEXR goes into attributes ``clipmap:*``."""
    spec = OpenImageIO.ImageSpec(layer.width, layer.height, len(convert.names), "half" if half else "float")
    spec.tile_width = spec.tile_height = side
    spec.tile_depth = 1
    spec.channelnames = convert.names
    spec.alpha_channel = convert.names.index("A") if "A" in convert.names else -1
    attributes: dict[str, str | int] = {
        "compression": "zip",
        "openexr:levelmode": _MIPMAP_LEVELS,
        "openexr:roundingmode": _ROUND_UP,
        "textureformat": "Plain Texture",
        "wrapmodes": "clamp,clamp",
        "DateTime": "",
        "Software": manifest.generator,
        "clipmap:version": manifest.version,
        "clipmap:crs": manifest.world.crs or "",
        "clipmap:worldunit": manifest.world.unit,
        "clipmap:transform": " ".join(map(repr, layer.transform)),
        "clipmap:registration": layer.registration,
        "clipmap:placement": layer.source.placement,
        "clipmap:filter": filter_text(layer),
        "clipmap:codec": layer.codec,
        "clipmap:values": convert.transfer,
    }
    for key, value in attributes.items():
        spec.attribute(key, value)
    return spec


class _MipmapFile:
    """Writes the levels of a tiled OpenEXR file one after the other through OpenImageIO; raises StorageError."""

    def __init__(self, path: Path, target: Path, spec: OpenImageIO.ImageSpec) -> None:
        self._path, self._target, self._spec = path, target, spec
        output = OpenImageIO.ImageOutput.create("openexr")
        if output is None:
            raise StorageError(f"{target}: this OpenImageIO cannot write OpenEXR: {OpenImageIO.geterror()}")
        self._output = output

    def begin_level(self, level: int, rect: Rect) -> None:
        """Go on to the next level, of the size of ``rect``."""
        self._spec.width = self._spec.full_width = rect.width
        self._spec.height = self._spec.full_height = rect.height
        self._require(self._output.open(str(self._path), self._spec, "AppendMIPLevel" if level else "Create"))

    def write(self, rect: Rect, pixels: Pixels) -> None:
        """Write the tile at ``rect``: (rows, columns, channels) float32; half if the file is, rounded to nearest."""
        packed = np.ascontiguousarray(pixels)
        self._require(self._output.write_tiles(rect.x0, rect.x1, rect.y0, rect.y1, 0, 1, packed))

    def close(self) -> None:
        """End the file, whole or not: OpenImageIO leaves one with levels open until its object goes."""
        del self._output

    def _require(self, done: bool) -> None:
        if not done:
            raise StorageError(f"{self._target}: cannot be written: {self._output.geterror().strip()}")


def _require_whole(path: Path, target: Path, last: int) -> None:
    """Raise StorageError unless the last level can be read: nobody tells when the end of the file could not be written."""
    written = OpenImageIO.ImageInput.open(str(path))
    if written is None or written.read_image(0, last, 0, written.spec().nchannels) is None:
        OpenImageIO.geterror()
        raise StorageError(f"{target}: was not written whole; is the disk full?")
