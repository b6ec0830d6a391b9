"""Georeferenced files for mosaics, and what a mosaic of files on one grid must hold, pasted together by NumPy alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from schemas.region import Rect
from schemas.settings import MAX_SAMPLES
from tests.contract.picture_files import content, write_with_rasterio
from tiler.sources import FileInfo, Georeference, Pixels
from tiler.sources.mosaic import MosaicReader, open_mosaic

STEP = 10.0
ORIGIN = Affine(STEP, 0, 500_000, 0, -STEP, 5_000_000)
SYSTEM = "EPSG:32632"


def write(path: Path, pixels: Pixels, column: float = 0, row: float = 0, mask: NDArray[np.bool_] | None = None, **profile: Any) -> Path:
    """Write a GeoTIFF whose top-left pixel is (column, row) of the common grid."""
    place = {"crs": SYSTEM, "transform": ORIGIN @ Affine.translation(column, row), **profile}
    write_with_rasterio(path, pixels, mask, internal_mask=True, **place)
    return path


def cut(folder: Path, pixels: Pixels, windows: Sequence[Rect], **profile: Any) -> list[Path]:
    """Write windows of a picture as files that lie where the windows do."""
    return [
        write(folder / f"{number}.tif", pixels[window.y0 : window.y1, window.x0 : window.x1], window.x0, window.y0, **profile)
        for number, window in enumerate(windows)
    ]


def opened(paths: Sequence[Path], max_samples: int = MAX_SAMPLES, **options: Any) -> MosaicReader:
    """Open a mosaic whose scratch folder is that of its first file."""
    reader = open_mosaic(paths, paths[0].parent, max_samples, **options)
    assert isinstance(reader, MosaicReader)
    return reader


def whole(paths: Sequence[Path], **options: Any) -> tuple[FileInfo, Pixels, NDArray[np.bool_]]:
    """The header of a mosaic, all of its pixels, and which of them are valid, by mask or alpha."""
    reader = opened(paths, **options)
    pixels, mask = reader.read(reader.info.rect)
    reader.close()
    if reader.info.alpha is not None:
        return reader.info, pixels, pixels[..., reader.info.alpha] > 0
    return reader.info, pixels, np.ones(pixels.shape[:2], np.bool_) if mask is None else mask == 255


def header(name: str, crs: str | None, transform: Affine, width: int, height: int, **declared: Any) -> FileInfo:
    """The header of a file that does not exist."""
    place = Georeference(crs, "unknown", tuple(transform)[:6])
    declared = {"channels": 1, "dtype": np.dtype(np.int16), "layout": "tiled", "chunk_rows": 1, **declared}
    return FileInfo(path=Path(name), format="GTiff", width=width, height=height, file_bytes=1, georeference=place, **declared)


def quarters(width: int, height: int, overlap: int) -> list[Rect]:
    """Four windows that cover a picture and each other by ``overlap`` on either side of the middle."""
    x, y = width // 2, height // 2
    return [
        Rect(0, 0, x + overlap, y + overlap),
        Rect(x - overlap, 0, width, y + overlap),
        Rect(0, y - overlap, x + overlap, height),
        Rect(x - overlap, y - overlap, width, height),
    ]


def heights(width: int, height: int, seed: int = 1) -> Pixels:
    """Terrain of int16, far from its ends (rows, columns, 1)."""
    return content(1, "int16", width, height, seed) // 8
