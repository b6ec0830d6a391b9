"""Sources: what a picture or elevation file declares, and windows of its pixels.

``files`` opens a file with the best reader for it; ``convert`` turns raw pixels into float32 samples and coverage.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.manifest import Transform
from schemas.region import Rect

Pixels = NDArray[Any]
Layout = Literal["tiled", "striped", "sequential"]
"""How pixels can be had: any window at the cost of its tiles, full-width bands, or only from top to bottom."""


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where a file says it lies; ``transform`` leads from pixel corners (column, row) to coordinates of ``crs``."""

    crs: str | None
    unit: Literal["metre", "degree", "foot", "us-foot", "unknown"]
    transform: Transform


@dataclass(frozen=True, slots=True)
class Part:
    """A file of a mosaic and the rectangle of the mosaic's pixels outside of which it changes nothing."""

    path: Path
    window: Rect
    files: tuple[Path, ...] = ()
    """What else its pixels come from, as with ``FileInfo.files``."""
    how: str = ""
    """What decides, besides its pixels, what it gives there: its own place and the grid it is resampled to; '' if it is copied."""


@dataclass(frozen=True, slots=True)
class FileInfo:
    """What a file declares, read from its header only."""

    path: Path
    format: str
    width: int
    height: int
    channels: int
    dtype: np.dtype[Any]
    file_bytes: int
    layout: Layout
    chunk_rows: int
    """Rows that are decoded together: a tile's or strip's height."""
    alpha: int | None = None
    """Which channel is alpha, from 0."""
    premultiplied: bool = False
    """Whether colour was multiplied by alpha before it was stored."""
    nodata: float | None = None
    has_mask: bool = False
    compression: str | None = None
    """How the pixels are compressed, as GDAL names it."""
    georeference: Georeference | None = None
    bits: int | None = None
    """Bits that whole numbers use of their type, from the lowest; None: all."""
    orientation: int = 1
    """How stored rows and columns lie in the picture, 1 to 8 as EXIF and TIFF count; 1 is upright."""
    least_bytes: int = 0
    """What the samples take if they are not compressed, 0 if unknown; a smaller file is cut off [bytes]."""
    files: tuple[Path, ...] = ()
    """What else the pixels come from, as GDAL lists it: the files a VRT refers to, a mask, a header or a world file beside the pixels."""
    parts: tuple[Part, ...] = ()
    """The files of a mosaic, lowest first; one that shows on both sides of the antimeridian appears twice. Empty for one file."""

    @property
    def largest(self) -> int:
        """The largest whole number a sample can be; raises ValueError for other types."""
        return int(np.iinfo(self.dtype).max) if self.bits is None else (1 << self.bits) - 1

    @property
    def rect(self) -> Rect:
        """All pixels."""
        return Rect(0, 0, self.width, self.height)


class Reader(Protocol):
    """Windows of a file's raw pixels, from any thread. Every implementation passes ``tests/contract/test_readers.py``."""

    @property
    def info(self) -> FileInfo:
        """What the file declares."""
        ...

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels) of the file's dtype and the file's mask (0 void, 255 valid), None if it has none.

        ``window`` must lie inside the file. Raises InputError if the file cannot be read there.
        """
        ...

    def close(self) -> None:
        """Free handles and scratch files."""
        ...


_TILE_LIMIT_BYTES = 512 << 20
"""A tile is decoded as a whole, by every thread: a larger one is a mistake, or a header made to exhaust the memory."""


def check_tile(path: Path, width: int, height: int, pixel_bytes: int) -> None:
    """Raise InputError if one tile of a file takes more than 512 MiB to decode."""
    tile_bytes = width * height * pixel_bytes
    if tile_bytes > _TILE_LIMIT_BYTES:
        raise InputError(
            f"{path}: each of its tiles of {width} x {height} takes {tile_bytes / 1e9:.1f} GB to decode; "
            "cut it into smaller ones first, e.g. with gdal_translate -co TILED=YES"
        )
