"""What a GeoTIFF says besides its tiles: sample format, photometry, georeference, nodata. GDAL writes it into a template of one tile."""

import warnings
from typing import Any, Final

from rasterio import Env
from rasterio.enums import ColorInterp
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from schemas.errors import InputError
from schemas.manifest import Layer, Manifest
from tiler.export.tifflayout import HEIGHT, JPEG_TABLES, TILE_BYTES, TILE_HEIGHT, TILE_OFFSETS, TILE_WIDTH, WIDTH, Tag, read_tags

_OF_THE_LAYOUT: Final = {WIDTH, HEIGHT, TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS, TILE_BYTES, JPEG_TABLES}
_OF_LEVEL_0: Final = {306, 305, 33550, 33922, 34264, 34735, 34736, 34737, 42112}
"""Software, date, the georeference and GDAL's own metadata: the first directory speaks for all."""


def geotiff_tags(manifest: Manifest, layer: Layer, compression: dict[str, Any]) -> tuple[dict[int, Tag], dict[int, Tag]]:
    """Return the fields of level 0 and those of every other level, all but sizes, tiles and the mark of an overview.

    ``compression`` are GDAL's creation options. Raises InputError if the dataset's coordinate system cannot be written.
    """
    transform = Affine(*layer.transform)
    if layer.registration == "point":
        # GDAL's transforms lead from pixel corners, whatever the file says: a sample's place is its pixel's centre.
        transform @= Affine.translation(-0.5, -0.5)
    placed = layer.source.placement != "assumed"
    colours = layer.channels - layer.alpha
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": 16,
        "height": 16,
        "count": layer.channels,
        "dtype": layer.dtype,
        "tiled": True,
        "blockxsize": 16,
        "blockysize": 16,
        "photometric": "RGB" if colours == 3 else "MINISBLACK",
        # GDAL takes the first channel that is no colour for alpha, and normals have two: of them it is told below.
        "ALPHA": "NON-PREMULTIPLIED" if layer.alpha and colours != 2 else "NO",
        "SPARSE_OK": True,
        "BIGTIFF": "NO",
        "ENDIANNESS": "LITTLE",
        "nodata": float("nan") if layer.dtype == "float32" else None,
        **({"crs": manifest.world.crs, "transform": transform} if placed else {}),
        **compression,
    }
    try:
        with warnings.catch_warnings(), Env(), MemoryFile() as memory:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with memory.open(**profile) as file:
                file.update_tags(**_metadata(manifest, layer))
                if layer.kind == "height":
                    file.units = ("metre",)
                if layer.alpha:
                    file.colorinterp = [*file.colorinterp[:colours], ColorInterp.alpha]
            tags = {code: tag for code, tag in read_tags(memory.read()).items() if code not in _OF_THE_LAYOUT}
    except (CRSError, RasterioError, ValueError) as error:
        raise InputError(f"the place of the layer cannot be written into a GeoTIFF: {error}") from error
    return tags, {code: tag for code, tag in tags.items() if code not in _OF_LEVEL_0}


def _metadata(manifest: Manifest, layer: Layer) -> dict[str, str]:
    """Return what is kept of the manifest, as GDAL's metadata items."""
    # Without a coordinate system the mark of point samples would be all there is of one, and be read as an unknown local system.
    registration = {"AREA_OR_POINT": layer.registration.capitalize()} if manifest.world.crs else {}
    return {
        **registration,
        "TIFFTAG_SOFTWARE": manifest.generator,
        "CLIPMAP_VERSION": manifest.version,
        "CLIPMAP_FILTER": filter_text(layer),
        "CLIPMAP_CODEC": layer.codec,
    }


def filter_text(layer: Layer) -> str:
    """Return how the layer's coarser levels were made, for people."""
    made = layer.filter
    light = ", in linear light" if made.linear_light else ""
    return f"{made.kernel}, radius {made.radius}{', clamped to the local range' * (made.clamp == 'local')}{light}"
