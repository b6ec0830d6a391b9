"""Pictures that are stored rotated or mirrored, read upright (EXIF 2.32 and TIFF 6.0, tag 274 "Orientation").

The tag says where the stored first row and first column lie in the picture: 1 top and left, 2 top and right, 3 bottom and right,
4 bottom and left; 5 left and top, 6 right and top, 7 right and bottom, 8 left and bottom. From 5 on, stored rows are columns.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.sources import FileInfo, Pixels, Reader

TRANSPOSING: Final = frozenset({5, 6, 7, 8})
_FROM_BOTTOM: Final = frozenset({3, 4, 7, 8})
"""Where the picture's top is the end of the stored axis that runs down in it."""
_FROM_RIGHT: Final = frozenset({2, 3, 6, 7})


class OrientedReader:
    """Windows of the upright picture that ``reader`` holds with ``orientation``, 1 to 8.

    A window is read from where it is stored and turned: it takes no more memory than itself, twice.
    """

    def __init__(self, reader: Reader, orientation: int) -> None:
        stored = reader.info
        transposed = orientation in TRANSPOSING
        width, height = (stored.height, stored.width) if transposed else (stored.width, stored.height)
        self.info: FileInfo = replace(stored, width=width, height=height, orientation=1)
        self._reader = reader
        self._transposed = transposed
        self._from_bottom, self._from_right = orientation in _FROM_BOTTOM, orientation in _FROM_RIGHT

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return upright pixels (rows, columns, channels) and mask or None; raises InputError if the file cannot be read."""
        pixels, mask = self._reader.read(self._stored(window))
        return self._upright(pixels), None if mask is None else self._upright(mask)

    def _stored(self, window: Rect) -> Rect:
        """Return where ``window`` of the upright picture lies in the file."""
        x0, x1, y0, y1 = window.x0, window.x1, window.y0, window.y1
        if self._from_right:
            x0, x1 = self.info.width - x1, self.info.width - x0
        if self._from_bottom:
            y0, y1 = self.info.height - y1, self.info.height - y0
        return Rect(y0, x0, y1, x1) if self._transposed else Rect(x0, y0, x1, y1)

    def _upright(self, stored: NDArray[Any]) -> NDArray[Any]:
        turned = stored.swapaxes(0, 1) if self._transposed else stored
        return turned[:: -1 if self._from_bottom else 1, :: -1 if self._from_right else 1]

    def close(self) -> None:
        """Close the reader."""
        self._reader.close()
