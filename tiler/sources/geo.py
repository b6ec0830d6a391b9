"""What rasterio knows: georeference, nodata and masks of every file GDAL understands, and pixels where OpenImageIO has no reader."""

import logging
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.env import get_gdal_config, set_gdal_config
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from schemas.errors import InputError
from schemas.region import Rect
from tiler.sources import FileInfo, Georeference, Layout, Pixels, check_tile

_UNITS = {"degree": "degree", "metre": "metre", "meter": "metre", "m": "metre", "foot": "foot", "us survey foot": "us-foot"}
_FAILURES = (RasterioError, CPLE_BaseError, MemoryError)
"""What rasterio raises on damaged files; where it reads more than pixels, GDAL's own errors come through as they are."""
_OPENING = threading.Lock()
"""Filters of warnings belong to the process: two threads that change and restore them would let one through, or lose one."""
_LEAST_CACHE_BYTES = 64 << 20
"""Some rows of tiles of 512 under a task of 4096; with less every tile would be decoded for every portion of rows."""
_WHOLE_IMAGE_DRIVERS = {"PNG", "JPEG", "GIF", "BMP", "WEBP"}
"""Drivers whose files can only be decoded from top to bottom."""


def _open(path: Path) -> Any:  # noqa: ANN401 - rasterio has no types
    # Without a handler Python prints GDAL's own messages to stderr; ours say the same in one sentence.
    logging.getLogger("rasterio").addHandler(logging.NullHandler())
    with _OPENING, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(path)


def share_cache(processes: int) -> None:
    """Let GDAL keep decoded tiles in so small a part of the memory that as many ``processes`` keep no more than one would."""
    set_gdal_config("GDAL_CACHEMAX", max(_LEAST_CACHE_BYTES, int(get_gdal_config("GDAL_CACHEMAX")) // processes))


def describe(path: Path) -> FileInfo | None:
    """Return what rasterio reads from the header of ``path``, None if no driver of GDAL can make sense of the file."""
    try:
        with _open(path) as dataset:
            return _info(path, dataset)
    except CRSError as error:
        raise InputError(f"{path}: its coordinate reference system cannot be understood; repair it with gdal_edit.py -a_srs") from error
    except _FAILURES:
        return None


def _info(path: Path, dataset: Any) -> FileInfo | None:  # noqa: ANN401
    if dataset.count == 0:
        return None
    if len(set(dataset.dtypes)) > 1:
        raise InputError(f"{path}: channels of different types ({', '.join(dataset.dtypes)}); choose with gdal_translate -b")
    flags = dataset.mask_flag_enums[0]
    block_rows, block_columns = dataset.block_shapes[0]
    alphas = [channel for channel, meaning in enumerate(dataset.colorinterp) if meaning == ColorInterp.alpha]
    layout: Layout = "tiled" if block_columns < dataset.width or block_rows >= dataset.height else "striped"
    dtype = np.dtype(dataset.dtypes[0])
    bits = int(dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8 * dtype.itemsize))
    if dataset.driver == "GTiff" and block_columns < dataset.width:
        check_tile(path, block_columns, block_rows, dataset.count * dtype.itemsize)
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    return FileInfo(
        path=path,
        format=str(dataset.driver),
        width=int(dataset.width),
        height=int(dataset.height),
        channels=int(dataset.count),
        dtype=dtype,
        file_bytes=path.stat().st_size,
        layout="sequential" if dataset.driver in _WHOLE_IMAGE_DRIVERS else layout,
        chunk_rows=int(block_rows),
        alpha=alphas[0] if alphas else None,
        nodata=None if dataset.nodata is None else float(dataset.nodata),
        has_mask=MaskFlags.per_dataset in flags and MaskFlags.alpha not in flags,
        compression=structure.get("COMPRESSION"),
        georeference=_georeference(dataset),
        files=tuple(file for file in map(Path, dataset.files) if file != path and file.is_file()),
        bits=bits if dtype.kind == "u" and bits < 8 * dtype.itemsize else None,
        least_bytes=dataset.width * dataset.height * dataset.count * bits // 8 if _is_plain(path, dataset, structure) else 0,
    )


def _is_plain(path: Path, dataset: Any, structure: dict[str, str]) -> bool:  # noqa: ANN401
    """Whether every sample that GDAL counts takes its place in the file, which is not so for every colour space."""
    if dataset.driver == "netCDF":
        with path.open("rb") as file:
            return file.read(3) == b"CDF"
    tiff = dataset.driver == "GTiff" and structure.get("SOURCE_COLOR_SPACE") in (None, "CMYK")
    return dataset.driver == "ENVI" or (tiff and "COMPRESSION" not in structure)


def _georeference(dataset: Any) -> Georeference | None:  # noqa: ANN401
    transform = dataset.transform
    if dataset.crs is None and transform.is_identity:
        return None
    if dataset.driver == "PNM" and len(dataset.files) == 1:
        return None  # GDAL 3.10 gives uninitialised numbers for a portable pixmap without a world file
    crs, unit = dataset.crs, "unknown"
    name = None
    if crs is not None:
        authority = crs.to_authority()
        name = ":".join(authority) if authority else crs.to_wkt()
        unit = _UNITS.get(str(crs.units_factor[0]).lower(), "unknown")
    a, b, c, d, e, f = (float(value) for value in tuple(transform)[:6])
    if not np.isfinite([a, b, c, d, e, f]).all() or a * e - b * d == 0:
        raise InputError(f"{dataset.name}: the georeference is degenerate (a pixel has no area); repair it with gdal_edit.py -a_ullr")
    return Georeference(name, unit, (a, b, c, d, e, f))  # type: ignore[arg-type]  # unit is one of the literals by construction


class RasterioReader:
    """Windows through rasterio, one handle per thread (GDAL handles must not be shared)."""

    def __init__(self, info: FileInfo) -> None:
        self.info = info
        self._local = threading.local()
        self._handles: list[Any] = []
        self._lock = threading.Lock()

    def _handle(self) -> Any:  # noqa: ANN401
        handle = getattr(self._local, "handle", None)
        if handle is None:
            handle = self._local.handle = _open(self.info.path)
            with self._lock:
                self._handles.append(handle)
        return handle

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels) and mask or None; raises InputError if the file cannot be read."""
        area = Window(window.x0, window.y0, window.width, window.height)
        try:
            handle = self._handle()
            pixels = np.moveaxis(handle.read(window=area), 0, -1)
            mask = handle.dataset_mask(window=area) if self.info.has_mask else None
        except _FAILURES as error:
            raise self._unreadable(window, error) from error
        return pixels, mask

    def read_mask(self, window: Rect) -> NDArray[np.uint8]:
        """Return the file's mask (rows, columns), 0 void and 255 valid; raises InputError if it cannot be read."""
        try:
            mask: NDArray[np.uint8] = self._handle().dataset_mask(window=Window(window.x0, window.y0, window.width, window.height))
        except _FAILURES as error:
            raise self._unreadable(window, error) from error
        return mask

    def _unreadable(self, window: Rect, error: BaseException) -> InputError:
        # rasterio says no more than "Read failed": the first cause of the chain is GDAL's own word.
        while error.__cause__ is not None:
            error = error.__cause__
        reason = " ".join(str(error).split()) or "no reason given"
        return InputError(f"{self.info.path}: cannot be read at rows {window.y0} to {window.y1}: {reason}")

    def close(self) -> None:
        """Close the handles of all threads."""
        with self._lock:
            while self._handles:
                self._handles.pop().close()
