"""What other programs make of the same samples: OpenImageIO's resize, and GDAL's overviews through rasterio.

Both take samples as cells, so their coarse samples lie between fine ones, also for heights, and are compared with the ideal there.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import OpenImageIO
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.io import MemoryFile

Values = NDArray[np.float32]

OIIO_FILTERS: Final = ("blackman-harris", "lanczos3", "box")
GDAL_METHODS: Final[dict[str, Resampling]] = {
    "lanczos": Resampling.lanczos,
    "cubic": Resampling.cubic,
    "average": Resampling.average,
}
_NODATA: Final = -1e6
_CELLS: Final = rasterio.Affine(1, 0, 1, 0, -1, 1)
"""A georeference of no meaning, as rasterio warns of files that have none."""


def oiio_halving(values: Values, name: str) -> Callable[[], Any]:
    """Return what halves ``values`` (h, w, c), both sides even, with an OpenImageIO filter on one thread; gives an ImageBuf."""
    height, width = values.shape[:2]
    buffer = OpenImageIO.ImageBuf(np.ascontiguousarray(values))
    roi = OpenImageIO.ROI(0, width // 2, 0, height // 2)
    return lambda: OpenImageIO.ImageBufAlgo.resize(buffer, name, 0.0, roi, 1)


def oiio_levels(values: Values, name: str, count: int) -> list[Values]:
    """Return levels 1 to ``count`` by repeated halving with an OpenImageIO filter."""
    result: list[Values] = []
    for _ in range(count):
        pixels = oiio_halving(values, name)().get_pixels(OpenImageIO.FLOAT)
        values = pixels.reshape(*pixels.shape[:2], -1)
        result.append(values)
    return result


def gdal_overview(values: NDArray[np.float32], valid: NDArray[np.bool_], method: str) -> tuple[Values, NDArray[np.bool_]]:
    """Return GDAL's first overview of ``values`` (h, w) of which only ``valid`` samples hold, and which of its samples hold."""
    height, width = values.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "float32", "nodata": _NODATA}
    with MemoryFile() as memory:
        with memory.open(**profile, transform=_CELLS) as file:
            file.write(np.where(valid, values, np.float32(_NODATA)), 1)
        with rasterio.open(memory.name, "r+") as file:
            file.build_overviews([2], GDAL_METHODS[method])
        with memory.open(overview_level=0) as file:
            coarse: Values = file.read(1)
    return coarse, coarse != _NODATA
