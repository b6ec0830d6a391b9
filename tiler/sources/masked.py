"""Pixels from one reader and the file's mask, which only GDAL knows, from another."""

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.sources import FileInfo, Pixels, Reader
from tiler.sources.geo import RasterioReader


class MaskedReader:
    """Windows of ``pixels`` with the mask that lies in the same file or beside it (``.msk``)."""

    def __init__(self, pixels: Reader, masks: RasterioReader) -> None:
        self.info: FileInfo = pixels.info
        self._pixels = pixels
        self._masks = masks

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels) and mask (rows, columns); raises InputError if either cannot be read."""
        pixels, _ = self._pixels.read(window)
        return pixels, self._masks.read_mask(window)

    def close(self) -> None:
        """Close both."""
        self._pixels.close()
        self._masks.close()
