"""Opening a file: which reader it gets, and whether its declared size can be true."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.errors import InputError
from tiler.sources import FileInfo, Reader, geo, oiio
from tiler.sources.geo import RasterioReader
from tiler.sources.masked import MaskedReader
from tiler.sources.oiio import OiioReader
from tiler.sources.spool import SpooledReader

_MAX_EXPANSION = 2000
"""Largest credible ratio of decoded to stored bytes: deflate reaches 1032, JPEG about 1000 on a constant picture."""
_BOUNDED_EXPANSION = {"png", "jpeg", "bmp", "gif", "pnm", "targa", "tga", "dpx", "cineon"}
_BETTER_WITH_RASTERIO = {"jpeg2000", "JP2OpenJPEG", "JP2KAK", "JP2ECW"}
"""Formats that OpenImageIO decodes as a whole and GDAL by window."""
_SHARED_COMPRESSIONS = {None, "LZW", "DEFLATE", "PACKBITS", "JPEG", "CCITTRLE", "CCITTFAX3", "CCITTFAX4"}
"""Compressions of TIFF that OpenImageIO decodes as well as GDAL. It lacks the newer ones (ZSTD, LERC, ...), and leaves the missing
parts of "YCbCr JPEG" black without an error."""
_PICTURE_DRIVERS = {"PNG", "JPEG", "GIF", "BMP", "TGA"}
"""GDAL drivers for formats of which OpenImageIO has the last word: it notices truncation."""


def open_file(path: Path, scratch: Path) -> Reader:
    """Open ``path`` for windowed reading; only its header is read, unless its format cannot be read by window.

    Such a file is decoded once into memory or into ``scratch``. Raises InputError if the file does not exist, is of no known
    format, damaged, or declares more pixels than its bytes can hold.
    """
    _check_readable(path)
    geographic = geo.describe(path)
    if geographic is not None:
        _check_declared_size(geographic)
        _check_complete(geographic)
        if geographic.format in _BETTER_WITH_RASTERIO:
            return RasterioReader(geographic)
    try:
        picture = oiio.describe(path)
    except oiio.UnopenedError as error:
        if geographic is None:
            raise InputError(f"{error}; neither OpenImageIO nor GDAL can read it") from error
        if geographic.format in _PICTURE_DRIVERS:
            raise
        return _windowed(RasterioReader(geographic), scratch)
    _check_declared_size(picture)
    if geographic is None:
        return _windowed(OiioReader(picture), scratch)
    if _only_gdal_decodes(geographic, picture):
        return _windowed(RasterioReader(replace(geographic, premultiplied=picture.premultiplied)), scratch)
    reader = _windowed(OiioReader(_located(picture, geographic)), scratch)
    return MaskedReader(reader, RasterioReader(geographic)) if geographic.has_mask else reader


def _only_gdal_decodes(geographic: FileInfo, picture: FileInfo) -> bool:
    if (geographic.width, geographic.height) != (picture.width, picture.height):
        return True
    # OpenImageIO 3.2 returns uninitialised memory for tiled float64 TIFF, without an error.
    return picture.format == "tiff" and (picture.dtype == np.float64 or geographic.compression not in _SHARED_COMPRESSIONS)


def _check_readable(path: Path) -> None:
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder; give one image or elevation file")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is no ordinary file; give one image or elevation file")
        with path.open("rb") as file:
            if not file.read(1):
                raise InputError(f"{path}: the file is empty")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _located(picture: FileInfo, geographic: FileInfo) -> FileInfo:
    """Add what only GDAL reads from the header: nodata, mask, georeference, and an alpha channel OpenImageIO does not name.

    Channels that differ in number are a palette, which OpenImageIO resolves: then GDAL's nodata value is an index, not a colour.
    """
    georeference = geographic.georeference
    if geographic.channels != picture.channels:
        return replace(picture, has_mask=geographic.has_mask, georeference=georeference)
    alpha = geographic.alpha if picture.alpha is None else picture.alpha
    return replace(picture, nodata=geographic.nodata, has_mask=geographic.has_mask, georeference=georeference, alpha=alpha)


def _windowed(reader: Reader, scratch: Path) -> Reader:
    return SpooledReader(reader, scratch) if reader.info.layout == "sequential" else reader


def _check_complete(info: FileInfo) -> None:
    """Refuse a cut-off file of plain numbers: GDAL reads what is missing as zeros and says nothing."""
    with info.path.open("rb") as file:
        plain = info.format == "ENVI" or (info.format == "netCDF" and file.read(3) == b"CDF")
    declared = info.width * info.height * info.channels * info.dtype.itemsize
    if plain and info.file_bytes < declared:
        raise InputError(f"{info.path}: has {info.file_bytes} bytes, but its samples alone take {declared}; the file is cut off")


def _check_declared_size(info: FileInfo) -> None:
    declared = info.width * info.height * info.channels * info.dtype.itemsize
    if info.format.lower() in _BOUNDED_EXPANSION and declared > _MAX_EXPANSION * info.file_bytes:
        raise InputError(
            f"{info.path}: declares {info.width} x {info.height} x {info.channels} samples ({declared / 1e9:.1f} GB) "
            f"in {info.file_bytes} bytes; the file is damaged or malicious"
        )
