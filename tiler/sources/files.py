"""Opening a file: which reader it gets, and whether its declared size can be true."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.errors import InputError
from schemas.settings import MAX_SAMPLES
from tiler.sources import FileInfo, Reader, geo, oiio
from tiler.sources.geo import RasterioReader
from tiler.sources.masked import MaskedReader
from tiler.sources.oiio import OiioReader
from tiler.sources.oriented import TRANSPOSING, OrientedReader
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


def open_file(path: Path, scratch: Path | None, max_samples: int = MAX_SAMPLES) -> Reader:
    """Open ``path`` for windowed reading; only its header is read, unless its format cannot be read by window.

    Such a file is decoded once into memory or into ``scratch``; if that is None it is not, and only the reader's ``info`` is of use.
    Raises InputError if the file does not exist, is of no known format, damaged, or declares more samples than ``max_samples`` or
    than its bytes can hold.
    """
    _check_readable(path)
    geographic = geo.describe(path)
    if geographic is not None:
        _check_declared_size(geographic, max_samples)
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
    _check_declared_size(picture, max_samples)
    if geographic is not None and geographic.georeference is not None and picture.orientation != 1:
        raise InputError(
            f"{path}: has a georeference and is stored rotated or mirrored (orientation {picture.orientation}), so its place is not "
            "certain; write it upright, or without one of the two"
        )
    reader = _stored(picture, geographic, scratch)
    return reader if picture.orientation == 1 else OrientedReader(reader, picture.orientation)


def _stored(picture: FileInfo, geographic: FileInfo | None, scratch: Path | None) -> Reader:
    """Return a reader of rows and columns as they are stored."""
    if picture.orientation in TRANSPOSING and picture.layout == "striped":
        # A column of a striped file costs as much as the whole.
        picture = replace(picture, layout="sequential")
    if geographic is None:
        return _windowed(OiioReader(picture), scratch)
    if _only_gdal_decodes(geographic, picture):
        layout = picture.layout if picture.orientation in TRANSPOSING else geographic.layout
        reader = _windowed(RasterioReader(replace(geographic, premultiplied=picture.premultiplied, layout=layout)), scratch)
    else:
        reader = _windowed(OiioReader(_located(picture, geographic)), scratch)
    return reader if isinstance(reader, RasterioReader) or not geographic.has_mask else MaskedReader(reader, RasterioReader(geographic))


def _only_gdal_decodes(geographic: FileInfo, picture: FileInfo) -> bool:
    if (geographic.width, geographic.height) != (picture.width, picture.height):
        return True
    # OpenImageIO 3.2 returns uninitialised memory for tiled float64 TIFF, without an error, and multiplies 9 to 15 bits up to 16.
    return picture.format == "tiff" and (
        picture.dtype == np.float64 or geographic.compression not in _SHARED_COMPRESSIONS or (geographic.bits or 0) > 8
    )


def _check_readable(path: Path) -> None:
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"{str(path)!a}: the name is not UTF-8, and GDAL cannot open such files; rename it") from error
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
    picture = replace(picture, files=geographic.files)
    if geographic.channels != picture.channels:
        return replace(picture, has_mask=geographic.has_mask, georeference=georeference)
    alpha = geographic.alpha if picture.alpha is None else picture.alpha
    return replace(picture, nodata=geographic.nodata, has_mask=geographic.has_mask, georeference=georeference, alpha=alpha)


def _windowed(reader: Reader, scratch: Path | None) -> Reader:
    return SpooledReader(reader, scratch) if scratch is not None and reader.info.layout == "sequential" else reader


def _check_complete(info: FileInfo) -> None:
    """Refuse a cut-off file of plain numbers: GDAL reads what is missing as zeros and says nothing."""
    if info.file_bytes < info.least_bytes:
        raise InputError(
            f"{info.path}: has {info.file_bytes} bytes, but its samples alone take {info.least_bytes}; the file is cut off"
            f"{', or sparse: then write it in full with gdal_translate' if info.format == 'GTiff' else ''}"
        )


def _check_declared_size(info: FileInfo, max_samples: int) -> None:
    samples = info.width * info.height * info.channels
    declared = samples * info.dtype.itemsize
    if info.format.lower() in _BOUNDED_EXPANSION and declared > _MAX_EXPANSION * info.file_bytes:
        raise InputError(
            f"{info.path}: declares {info.width} x {info.height} x {info.channels} samples ({declared / 1e9:.1f} GB) "
            f"in {info.file_bytes} bytes; the file is damaged or malicious"
        )
    if samples > max_samples:
        raise InputError(
            f"{info.path}: declares {info.width} x {info.height} x {info.channels} = {samples} samples, more than {max_samples}; "
            f"if that is what it holds, give --max-samples {samples}"
        )
