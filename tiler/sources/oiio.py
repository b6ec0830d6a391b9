"""Pixels through OpenImageIO: TIFF, OpenEXR, JPEG, PNG and the rest of its formats, about ten times as fast as rasterio."""

import threading
from pathlib import Path

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.region import Rect
from tiler.sources import FileInfo, Layout, Pixels, check_tile

_RANDOM_ACCESS = {"tiff", "openexr"}
_PREMULTIPLIED_BY_DEFAULT = {"tiff", "openexr"}
_DTYPES = {"half": "float16", "float": "float32", "double": "float64", "int": "int32", "uint": "uint32"}
"""OpenImageIO's names of sample types where NumPy has others."""
_STRIP_LIMIT_BYTES = 64 << 20
"""A strip larger than this is decoded once, from top to bottom, instead of again for each window."""


class UnopenedError(InputError):
    """OpenImageIO has no reader for the file, or its reader can make nothing of it."""


def _open(path: Path) -> OpenImageIO.ImageInput:
    # OpenImageIO refuses files that declare more than its limit (32 GiB by default), which is what clipmap is for.
    OpenImageIO.attribute("limits:imagesize_MB", 2**31 - 1)
    # Of its own it would start a thread per processor beside ours, and a process with threads cannot be copied.
    OpenImageIO.attribute("threads", 1)
    OpenImageIO.attribute("exr_threads", -1)
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    handle = OpenImageIO.ImageInput.open(str(path), config)
    if handle is None:
        raise UnopenedError(f"{path}: {_first_line(OpenImageIO.geterror())}")
    return handle


def _first_line(message: str) -> str:
    lines = message.strip().splitlines()
    return lines[0] if lines else "no reason given"


def describe(path: Path) -> FileInfo:
    """Return what OpenImageIO reads from the header; raises UnopenedError if it cannot, InputError if the file is no use."""
    handle = _open(path)
    spec = handle.spec()
    name = str(handle.format_name())
    handle.close()
    dtype = np.dtype(_DTYPES.get(str(spec.format), str(spec.format)))
    if spec.depth > 1 or spec.deep:
        raise InputError(f"{path}: volumes and deep images are not pictures of terrain")
    orientation = spec.get_int_attribute("Orientation", 1)
    alpha = _alpha(spec)
    tiled = spec.tile_width > 0
    chunk = spec.get_int_attribute("tiff:RowsPerStrip", 0) or spec.get_int_attribute("oiio:RowsPerChunk", 1)
    strip_rows = spec.tile_height if tiled else chunk
    check_tile(path, spec.tile_width, spec.tile_height, spec.nchannels * dtype.itemsize)
    strip_bytes = strip_rows * spec.width * spec.nchannels * dtype.itemsize
    layout: Layout = "tiled" if tiled else "striped"
    if name not in _RANDOM_ACCESS or (not tiled and strip_bytes > _STRIP_LIMIT_BYTES):
        layout = "sequential"
    unassociated = spec.get_int_attribute("tiff:UnassociatedAlpha", 0) or spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    return FileInfo(
        path=path,
        format=name,
        width=int(spec.width),
        height=int(spec.height),
        channels=int(spec.nchannels),
        dtype=dtype,
        file_bytes=path.stat().st_size,
        layout=layout,
        chunk_rows=max(1, int(strip_rows)),
        alpha=alpha,
        premultiplied=alpha is not None and name in _PREMULTIPLIED_BY_DEFAULT and not unassociated,
        # Programs show a picture with an orientation that does not exist as it is stored.
        orientation=orientation if 1 <= orientation <= 8 else 1,
    )


def _alpha(spec: OpenImageIO.ImageSpec) -> int | None:
    """Return which channel is alpha; by its name where the number is none of a channel, as with GIF."""
    if spec.alpha_channel < spec.nchannels:
        return int(spec.alpha_channel) if spec.alpha_channel >= 0 else None
    named = [channel for channel, name in enumerate(spec.channelnames) if name.lower() in ("a", "alpha")]
    return named[0] if named else None


class OiioReader:
    """Windows through OpenImageIO, one handle per thread: a shared one would serialise its readers."""

    def __init__(self, info: FileInfo) -> None:
        self.info = info
        self._local = threading.local()

    def _handle(self) -> OpenImageIO.ImageInput:
        handle = getattr(self._local, "handle", None)
        if handle is None:
            handle = self._local.handle = _open(self.info.path)
        return handle

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels) and None; raises InputError if the file cannot be read there."""
        try:
            return self._read(window)
        except MemoryError as error:
            raise InputError(f"{self.info.path}: not enough memory to decode rows {window.y0} to {window.y1}") from error

    def _read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        handle = self._handle()
        spec = handle.spec()
        if spec.tile_width:
            tile_w, tile_h = spec.tile_width, spec.tile_height
            x0, y0 = window.x0 // tile_w * tile_w, window.y0 // tile_h * tile_h
            x1, y1 = min(spec.width, -(-window.x1 // tile_w) * tile_w), min(spec.height, -(-window.y1 // tile_h) * tile_h)
            pixels = handle.read_tiles(
                0, 0, spec.x + x0, spec.x + x1, spec.y + y0, spec.y + y1, spec.z, spec.z + 1, 0, spec.nchannels, spec.format
            )
        else:
            x0, y0 = 0, window.y0
            pixels = handle.read_scanlines(0, 0, spec.y + window.y0, spec.y + window.y1, spec.z, 0, spec.nchannels, spec.format)
        if pixels is None or handle.has_error:
            # A reader may fill what is missing with grey and only leave a message: that is an error here.
            raise InputError(f"{self.info.path}: cannot be read at rows {window.y0} to {window.y1}: {_first_line(handle.geterror())}")
        return pixels[window.y0 - y0 : window.y1 - y0, window.x0 - x0 : window.x1 - x0], None

    def close(self) -> None:
        """Close this thread's handle; those of other threads close with their threads."""
        handle = getattr(self._local, "handle", None)
        if handle is not None:
            handle.close()
            self._local.handle = None
