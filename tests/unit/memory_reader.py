"""A reader of pixels that never were in a file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.sources import FileInfo, Pixels


class MemoryReader:
    """Pixels in memory as if they came from a file that declares ``declared``; keeps the windows it was asked for."""

    def __init__(self, pixels: Pixels, mask: NDArray[np.uint8] | None = None, **declared: Any) -> None:
        self._pixels, self._mask = pixels, mask
        self.windows: list[Rect] = []
        height, width, channels = pixels.shape
        self.info = FileInfo(
            path=Path("dem.tif"),
            format="tiff",
            width=width,
            height=height,
            channels=channels,
            dtype=pixels.dtype,
            file_bytes=pixels.nbytes,
            layout="tiled",
            chunk_rows=1,
            has_mask=mask is not None,
            **declared,
        )

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        self.windows.append(window)
        rows, columns = slice(window.y0, window.y1), slice(window.x0, window.x1)
        return self._pixels[rows, columns], None if self._mask is None else self._mask[rows, columns]

    def close(self) -> None:
        self.windows.clear()
