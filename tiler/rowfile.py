"""A picture that may not fit into memory: rows of pixels in memory if small, else in an unnamed scratch file."""

import os
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import StorageError
from schemas.region import Rect

_MEMORY_LIMIT_BYTES: Final = 64 << 20


class RowFile:
    """``height`` rows of ``width`` pixels of ``channels`` channels; windows are written and read from any thread.

    Up to 64 MiB stay in memory. Beyond that the rows lie in a file in ``folder`` that has no name, so it vanishes with the
    process however that ends; it is read and written by position, not mapped, so that it does not count as the process's
    memory. Raises StorageError if the file cannot be made or written.
    """

    def __init__(self, width: int, height: int, channels: int, dtype: np.dtype[Any], folder: Path) -> None:
        self._shape = (height, width, channels)
        self._dtype = dtype
        self._folder = folder
        self._pixel_bytes = channels * dtype.itemsize
        self._memory: NDArray[Any] | None = None
        self._file = -1
        if width * height * self._pixel_bytes <= _MEMORY_LIMIT_BYTES:
            self._memory = np.empty(self._shape, dtype)
            return
        try:
            self._file, name = tempfile.mkstemp(prefix=".tmp-", dir=folder)
            os.unlink(name)
        except OSError as error:
            raise StorageError(f"{folder}: no scratch file can be made there: {error.strerror}") from error

    def _offset(self, x: int, y: int) -> int:
        return (y * self._shape[1] + x) * self._pixel_bytes

    def write(self, x: int, y: int, pixels: NDArray[Any]) -> None:
        """Put ``pixels`` (rows, columns, channels) with their top-left one at (x, y)."""
        rows, columns = pixels.shape[:2]
        if self._memory is not None:
            self._memory[y : y + rows, x : x + columns] = pixels
            return
        packed = np.ascontiguousarray(pixels, self._dtype)
        if columns == self._shape[1]:
            self._write_bytes(packed.view(np.uint8).reshape(-1).data, self._offset(0, y))
            return
        for row in range(rows):
            self._write_bytes(packed[row].view(np.uint8).reshape(-1).data, self._offset(x, y + row))

    def _write_bytes(self, view: memoryview, offset: int) -> None:
        try:
            while view:
                written = os.pwrite(self._file, view, offset)
                view, offset = view[written:], offset + written
        except OSError as error:
            raise StorageError(f"scratch file in {self._folder}: cannot be written: {error.strerror}") from error

    def read(self, window: Rect) -> NDArray[Any]:
        """Return the pixels (rows, columns, channels) of ``window``; a view if they are in memory."""
        if self._memory is not None:
            return self._memory[window.y0 : window.y1, window.x0 : window.x1]
        pixels = np.empty((window.height, window.width, self._shape[2]), self._dtype)
        for row in range(window.height):
            self._read_bytes(pixels[row].view(np.uint8).reshape(-1).data, self._offset(window.x0, window.y0 + row))
        return pixels

    def _read_bytes(self, line: memoryview, offset: int) -> None:
        try:
            found = os.preadv(self._file, [line], offset)
        except OSError as error:
            raise StorageError(f"scratch file in {self._folder}: cannot be read: {error.strerror}") from error
        if found != line.nbytes:
            raise StorageError(f"scratch file in {self._folder}: shorter than what was written")

    def close(self) -> None:
        """Free the memory or the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        self._memory = None
