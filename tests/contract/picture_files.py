"""Picture and elevation files of every kind that clipmap reads, written by other libraries, with what they hold."""

import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import OpenEXR
import OpenImageIO
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from schemas.region import Rect
from tests.reference.terrain import power_law_field

Pixels = NDArray[Any]
Mask = NDArray[np.bool_]

WIDTH, HEIGHT = 211, 157
"""Prime, so that no tile or strip comes out even."""


@dataclass(frozen=True)
class Written:
    """What a file holds: ``pixels`` (rows, columns, channels), and what its header should say of them."""

    pixels: Pixels
    alpha: int | None = None
    premultiplied: bool = False
    nodata: float | None = None
    mask: Mask | None = None
    tolerance: int = 0


Writer = Callable[[Path], Written]


@dataclass(frozen=True)
class Kind:
    """A kind of file: its suffix, how it can be read, and how to write one."""

    name: str
    suffix: str
    layout: str
    write: Writer

    def __str__(self) -> str:
        return self.name


def content(channels: int, dtype: str, width: int = WIDTH, height: int = HEIGHT, seed: int = 1) -> Pixels:
    """Something like a photograph or a terrain that uses the whole range of ``dtype``; (height, width, channels)."""
    fields = [power_law_field(height + height % 2, width + width % 2, seed + channel, 2.5) for channel in range(channels)]
    field = np.stack(fields, axis=-1)[:height, :width]
    if np.dtype(dtype).kind == "f":
        return (1000 + 300 * field).astype(dtype)
    limits = np.iinfo(dtype)
    middle, spread = (limits.max + limits.min) / 2, (limits.max - limits.min) / 6
    return np.clip(np.rint(middle + spread * field), limits.min, limits.max).astype(dtype)


def write_with_openimageio(path: Path, pixels: Pixels, tile: int = 0, **attributes: Any) -> None:
    rows, columns, channels = pixels.shape
    spec = OpenImageIO.ImageSpec(
        columns, rows, channels, {"float16": "half", "float32": "float", "float64": "double"}.get(str(pixels.dtype), str(pixels.dtype))
    )
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    if tile:
        spec.tile_width = spec.tile_height = tile
        spec.tile_depth = 1
    if attributes.get("alpha_last"):
        spec.alpha_channel = channels - 1
    output = OpenImageIO.ImageOutput.create(str(path))
    assert output is not None, OpenImageIO.geterror()
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    output.close()


def write_with_rasterio(path: Path, pixels: Pixels, mask: Mask | None = None, internal_mask: bool = False, **profile: Any) -> None:
    colours = profile.pop("colorinterp", None)
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal_mask):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        shape = {"height": pixels.shape[0], "width": pixels.shape[1], "count": pixels.shape[2], "dtype": pixels.dtype}
        with rasterio.open(path, "w", **{"driver": "GTiff", **shape, **profile}) as file:
            file.write(np.moveaxis(pixels, -1, 0))
            if colours is not None:
                file.colorinterp = colours
            if mask is not None:
                file.write_mask(mask)


def tiff(path: Path, channels: int = 3, dtype: str = "uint8", tile: int = 0, **attributes: Any) -> Written:
    pixels = content(channels, dtype)
    write_with_openimageio(path, pixels, tile, **attributes)
    return Written(pixels, alpha=3 if channels == 4 else None, premultiplied=channels == 4)


def gdal_tiff(path: Path, channels: int = 3, dtype: str = "uint8", nodata: float | None = None, alpha: str = "", **profile: Any) -> Written:
    pixels = content(channels, dtype)
    if alpha:
        profile |= {
            "ALPHA": alpha,
            "photometric": "RGB",
            "colorinterp": [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha],
        }
    write_with_rasterio(path, pixels, nodata=nodata, **profile)
    return Written(pixels, nodata=nodata, alpha=3 if alpha else None, premultiplied=alpha == "PREMULTIPLIED")


def jpeg_tiff(path: Path, **profile: Any) -> Written:
    write_with_rasterio(path, content(3, "uint8"), compress="JPEG", **profile)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            pixels = np.moveaxis(file.read(), 0, -1)
    return Written(pixels, tolerance=3)


def masked(path: Path, driver: str, channels: int = 3, internal: bool = False, **profile: Any) -> Written:
    pixels = content(channels, "uint8")
    mask = power_law_field(HEIGHT + 1, WIDTH + 1, 9, 3.0)[:HEIGHT, :WIDTH] > -0.4
    write_with_rasterio(path, pixels, mask, internal, driver=driver, **profile)
    return Written(pixels, mask=mask)


def png(path: Path, channels: int, dtype: str = "uint8") -> Written:
    pixels = content(channels, dtype)
    path.write_bytes(imagecodecs.png_encode(pixels[..., 0] if channels == 1 else pixels))
    return Written(pixels, alpha=channels - 1 if channels in (2, 4) else None)


def png_bytes(width: int, height: int, depth: int, colour: int, data: bytes, *chunks: tuple[bytes, bytes]) -> bytes:
    """Return a PNG put together by hand: any header, any chunks before the data (PNG specification, section 5)."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [(b"IHDR", header), *chunks, (b"IDAT", data), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def palette_png(path: Path, transparent: bool) -> Written:
    indices = content(1, "uint8")[..., 0] // 8
    palette = np.random.default_rng(1).integers(0, 256, (32, 3), dtype=np.uint8)
    palette[5] = 7, 7, 7
    palette[20] = 5, 5, 5
    rows = b"".join(b"\0" + row.tobytes() for row in indices)
    alphas = np.full(32, 255, np.uint8)
    alphas[5] = 0
    chunks = [(b"PLTE", palette.tobytes())] + [(b"tRNS", alphas.tobytes())] * transparent
    path.write_bytes(png_bytes(WIDTH, HEIGHT, 8, 3, zlib.compress(rows), *chunks))
    table = np.concatenate([palette, alphas[:, np.newaxis]], axis=-1) if transparent else palette
    return Written(table[indices], alpha=3 if transparent else None)


def jpeg(path: Path, channels: int) -> Written:
    pixels = content(channels, "uint8")
    data = imagecodecs.jpeg8_encode(pixels[..., 0] if channels == 1 else pixels, level=95)
    path.write_bytes(data)
    return Written(np.asarray(imagecodecs.jpeg8_decode(data)).reshape(HEIGHT, WIDTH, channels), tolerance=3)


def webp(path: Path) -> Written:
    pixels = content(3, "uint8")
    path.write_bytes(imagecodecs.webp_encode(pixels, lossless=True))
    return Written(pixels)


def exr(path: Path, dtype: str, names: str, tile: int = 0) -> Written:
    pixels = content(len(names), dtype)
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.tiledimage if tile else OpenEXR.scanlineimage}
    if tile:
        header["tiles"] = tiles = OpenEXR.TileDescription()
        tiles.xSize = tiles.ySize = tile
    with OpenEXR.File(header, {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}) as file:
        file.write(str(path))
    alpha = names.find("A") if "A" in names else None
    return Written(pixels, alpha=alpha, premultiplied=alpha is not None)


def jpeg2000(path: Path, channels: int, dtype: str) -> Written:
    pixels = content(channels, dtype)
    write_with_rasterio(path, pixels, driver="JP2OpenJPEG", QUALITY="100", REVERSIBLE="YES")
    return Written(pixels)


def hgt(path: Path) -> Written:
    """SRTM: 1201 x 1201 big-endian int16, no header; the name says where it lies, -32768 is void."""
    pixels = content(1, "int16", 1201, 1201)
    pixels[100:300, 400:450] = -32768
    path.write_bytes(pixels.astype(">i2").tobytes())
    return Written(pixels, nodata=-32768)


def vrt(path: Path) -> Written:
    pixels = content(3, "uint8")
    halves = (pixels[:, :100], pixels[:, 100:])
    sources = []
    for number, half in enumerate(halves):
        name = f"{path.stem}-{number}.tif"
        write_with_rasterio(path.with_name(name), half)
        size = f'xSize="{half.shape[1]}" ySize="{HEIGHT}"'
        sources.append((name, f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{100 * number}" yOff="0" {size}/>'))
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{band}">'
        + "".join(
            f'<SimpleSource><SourceFilename relativeToVRT="1">{name}</SourceFilename><SourceBand>{band}</SourceBand>{where}</SimpleSource>'
            for name, where in sources
        )
        + "</VRTRasterBand>"
        for band in (1, 2, 3)
    )
    path.write_text(f'<VRTDataset rasterXSize="{WIDTH}" rasterYSize="{HEIGHT}">{bands}</VRTDataset>')
    return Written(pixels)


def other(path: Path, driver: str, channels: int = 1, dtype: str = "int16", nodata: float | None = None) -> Written:
    """A file that one of GDAL's less common drivers copies from a TIFF; ``nodata`` is what the driver declares by itself."""
    pixels = content(channels, dtype)
    source = path.with_suffix(".tiff")
    write_with_rasterio(source, pixels, transform=Affine(1, 0, 0, 0, -1, 0))
    rasterio.shutil.copy(source, path, driver=driver)
    source.unlink()
    return Written(pixels, nodata=nodata)


def pixmap(path: Path, channels: int) -> Written:
    pixels = content(channels, "uint8")
    write_with_openimageio(path, pixels)
    return Written(pixels)


def special_floats(path: Path) -> Written:
    pixels = content(1, "float32")
    pixels[3:30, 5:50] = np.nan
    pixels[60, 60:70], pixels[61, 60:70] = np.inf, -np.inf
    write_with_rasterio(path, pixels, tiled=True, blockxsize=64, blockysize=64)
    return Written(pixels)


KINDS = [
    Kind("tiff-tiled", "tif", "tiled", partial(tiff, tile=64)),
    Kind("tiff-one-tile", "tif", "tiled", partial(tiff, tile=256)),
    Kind("tiff-strips-of-1", "tif", "striped", partial(tiff, tiff__RowsPerStrip=1)),
    Kind("tiff-strips-of-10", "tif", "striped", partial(tiff, tiff__RowsPerStrip=10)),
    Kind("tiff-strips-of-64", "tif", "striped", partial(tiff, tiff__RowsPerStrip=64, compression="zip")),
    Kind("tiff-single-strip", "tif", "striped", partial(tiff, tiff__RowsPerStrip=HEIGHT, compression="lzw")),
    Kind("tiff-uncompressed", "tif", "striped", partial(tiff, tiff__RowsPerStrip=16, compression="none")),
    Kind("tiff-planar-strips", "tif", "striped", partial(tiff, planarconfig="separate", tiff__RowsPerStrip=16)),
    Kind("tiff-planar-tiles", "tif", "tiled", partial(gdal_tiff, interleave="band", tiled=True, blockxsize=32, blockysize=32)),
    Kind("tiff-big", "tif", "tiled", partial(gdal_tiff, BIGTIFF="YES", tiled=True, blockxsize=64, blockysize=64)),
    Kind("tiff-big-endian", "tif", "striped", partial(gdal_tiff, dtype="uint16", ENDIANNESS="BIG")),
    Kind(
        "tiff-deflate-predictor",
        "tif",
        "tiled",
        partial(gdal_tiff, dtype="float32", compress="DEFLATE", predictor=3, tiled=True, blockxsize=64, blockysize=64, channels=1),
    ),
    Kind("tiff-lzw-predictor", "tif", "striped", partial(gdal_tiff, dtype="int16", compress="LZW", predictor=2, channels=1)),
    Kind("tiff-zstd", "tif", "striped", partial(gdal_tiff, compress="ZSTD")),
    Kind("tiff-lerc", "tif", "striped", partial(gdal_tiff, compress="LERC", dtype="float32", channels=1)),
    Kind("tiff-jpeg-strips", "tif", "striped", partial(jpeg_tiff, photometric="YCBCR")),
    Kind("tiff-jpeg-rgb", "tif", "striped", partial(jpeg_tiff, photometric="RGB")),
    Kind("tiff-jpeg-tiles", "tif", "tiled", partial(jpeg_tiff, photometric="YCBCR", tiled=True, blockxsize=64, blockysize=64)),
    *(
        Kind(f"tiff-{channels}x{dtype}", "tif", "striped", partial(gdal_tiff, channels=channels, dtype=dtype))
        for channels, dtype in (
            (1, "uint8"),
            (2, "uint8"),
            (1, "int8"),
            (3, "uint16"),
            (1, "int16"),
            (1, "uint32"),
            (1, "int32"),
            (1, "float32"),
            (3, "float32"),
            (1, "float64"),
        )
    ),
    Kind("tiff-alpha-associated", "tif", "striped", partial(gdal_tiff, channels=4, alpha="PREMULTIPLIED")),
    Kind("tiff-alpha-unassociated", "tif", "striped", partial(gdal_tiff, channels=4, alpha="NON-PREMULTIPLIED")),
    Kind("tiff-alpha-associated-lerc", "tif", "striped", partial(gdal_tiff, channels=4, alpha="PREMULTIPLIED", compress="LERC")),
    Kind("tiff-oiio-alpha", "tif", "tiled", partial(tiff, channels=4, tile=64, dtype="uint16", alpha_last=1)),
    Kind("tiff-nodata", "tif", "striped", partial(gdal_tiff, channels=1, dtype="int16", nodata=-32768)),
    Kind("tiff-special-floats", "tif", "tiled", special_floats),
    Kind("tiff-mask-file", "tif", "tiled", partial(masked, driver="GTiff", tiled=True, blockxsize=64, blockysize=64)),
    Kind("tiff-mask-inside", "tif", "striped", partial(masked, driver="GTiff", internal=True)),
    Kind("png-mask-file", "png", "sequential", partial(masked, driver="PNG")),
    *(
        Kind(f"png-{channels}x{dtype}", "png", "sequential", partial(png, channels=channels, dtype=dtype))
        for channels in (1, 2, 3, 4)
        for dtype in ("uint8", "uint16")
    ),
    Kind("png-palette", "png", "sequential", partial(palette_png, transparent=False)),
    Kind("png-palette-transparent", "png", "sequential", partial(palette_png, transparent=True)),
    Kind("jpeg-grey", "jpg", "sequential", partial(jpeg, channels=1)),
    Kind("jpeg-colour", "jpg", "sequential", partial(jpeg, channels=3)),
    Kind("webp", "webp", "sequential", webp),
    *(
        Kind(
            f"exr-{dtype}-{names}-{tile or 'rows'}",
            "exr",
            "tiled" if tile else "striped",
            partial(exr, dtype=dtype, names=names, tile=tile),
        )
        for dtype, names, tile in (
            ("float16", "Y", 0),
            ("float32", "Y", 0),
            ("float32", "Y", 64),
            ("float16", "RGBA", 64),
            ("float32", "RGB", 0),
        )
    ),
    Kind("jpeg2000-colour", "jp2", "tiled", partial(jpeg2000, channels=3, dtype="uint8")),
    Kind("jpeg2000-int16", "jp2", "tiled", partial(jpeg2000, channels=1, dtype="int16")),
    Kind("srtm", "hgt", "striped", hgt),
    Kind("envi", "img", "striped", partial(other, driver="ENVI", channels=2)),
    Kind("netcdf", "nc", "striped", partial(other, driver="netCDF", dtype="float32", nodata=9.969209968386869e36)),
    Kind("surfer", "grd", "striped", partial(other, driver="GSBG", dtype="float32", nodata=1.701410009187828e38)),
    Kind("portable-pixmap", "ppm", "sequential", partial(pixmap, channels=3)),
    Kind("portable-greymap", "pgm", "sequential", partial(pixmap, channels=1)),
    Kind("targa", "tga", "sequential", partial(pixmap, channels=3)),
    Kind("vrt", "vrt", "tiled", vrt),
]


def file_name(kind: Kind) -> str:
    return "N27E086.hgt" if kind.suffix == "hgt" else f"{kind.name}.{kind.suffix}"


def windows(width: int, height: int, count: int = 12) -> list[Rect]:
    """The whole, its corners, single pixels, rows and columns, and random windows of ``width`` x ``height`` pixels."""
    rng = np.random.default_rng(width)
    found = [Rect(0, 0, width, height), Rect(0, 0, 1, 1), Rect(width - 1, height - 1, width, height)]
    found += [Rect(0, height // 2, width, height // 2 + 1), Rect(width // 2, 0, width // 2 + 1, height)]
    for _ in range(count):
        (x0, x1), (y0, y1) = (sorted(rng.choice(size + 1, 2, replace=False)) for size in (width, height))
        found.append(Rect(int(x0), int(y0), int(x1), int(y1)))
    return found
