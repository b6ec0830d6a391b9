"""A picture that may not fit into memory: rows of pixels in memory if small, else in an unnamed scratch file."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import StorageError
from schemas.region import Rect

_MEMORY_LIMIT_BYTES: Final = 64 << 20
_WASTE_BYTES: Final = 1 << 13
"""What is read of a row for nothing at most: a call of its own for every row costs about as much."""
_PIECE_BYTES: Final = 1 << 18
"""Read at once where a strip is not asked for as it lies: what fits the cache is not fetched from memory again."""


class RowFile:
    """``height`` rows of ``width`` pixels of ``channels`` channels; windows are written and read from any thread.

    Up to 64 MiB stay in memory. Beyond that the rows lie in a file in ``folder`` that has no name, so it vanishes with the
    process however that ends; it is read and written by position, not mapped, so that it does not count as the process's
    memory. Raises StorageError if the file cannot be made or written.

    With ``strip`` the file has strips of so many columns, one after the other, so that whole strips are read and written in one piece,
    as whole rows are without: a picture that is swept along its rows and along its columns is best cut so.
    """

    def __init__(self, width: int, height: int, channels: int, dtype: np.dtype[Any], folder: Path, strip: int | None = None) -> None:
        self._shape = (height, width, channels)
        self._strip = strip or width
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

    def _strips(self, x0: int, x1: int) -> Iterator[Rect]:
        """Yield the columns ``x0`` up to before ``x1`` by the strips that they are in, as windows of all their rows."""
        for x in range(x0 - x0 % self._strip, x1, self._strip):
            yield Rect(max(x, x0), 0, min(x + self._strip, x1), self._shape[0])

    def _strip_of(self, x: int) -> tuple[int, int]:
        """Return the first column of the strip that column ``x`` is in, and how many it has."""
        first = x - x % self._strip
        return first, min(self._strip, self._shape[1] - first)

    def _offset(self, x: int, y: int) -> int:
        first, columns = self._strip_of(x)
        return (first * self._shape[0] + y * columns + x - first) * self._pixel_bytes

    def write(self, x: int, y: int, pixels: NDArray[Any]) -> None:
        """Put ``pixels`` (rows, columns, channels) with their top-left one at (x, y)."""
        rows, columns = pixels.shape[:2]
        if self._memory is not None:
            self._memory[y : y + rows, x : x + columns] = pixels
            return
        for part in self._strips(x, x + columns):
            packed = np.ascontiguousarray(pixels[:, part.x0 - x : part.x1 - x], self._dtype)
            if part.width == self._strip_of(part.x0)[1]:
                self._write_bytes(packed.view(np.uint8).reshape(-1).data, self._offset(part.x0, y))
                continue
            for row in range(rows):
                self._write_bytes(packed[row].view(np.uint8).reshape(-1).data, self._offset(part.x0, y + row))

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
        for part in self._strips(window.x0, window.x1):
            self._read_strip(part, window, pixels[:, part.x0 - window.x0 : part.x1 - window.x0])
        return pixels

    def _read_strip(self, part: Rect, window: Rect, out: NDArray[Any]) -> None:
        """Read the rows of a ``window`` from the columns ``part`` of a strip, in few pieces, or row by row if that is less work."""
        first, columns = self._strip_of(part.x0)
        if (columns - part.width) * self._pixel_bytes > _WASTE_BYTES:
            for y in range(window.height):
                self._read_bytes(out[y].view(np.uint8).reshape(-1).data, self._offset(part.x0, window.y0 + y))
            return
        if out.flags.c_contiguous and part.width == columns:
            self._read_bytes(out.view(np.uint8).reshape(-1).data, self._offset(first, window.y0))
            return
        rows = max(1, _PIECE_BYTES // (columns * self._pixel_bytes))
        whole = np.empty((min(rows, window.height), columns, self._shape[2]), self._dtype)
        for y in range(0, window.height, rows):
            found = whole[: window.height - y]
            self._read_bytes(found.view(np.uint8).reshape(-1).data, self._offset(first, window.y0 + y))
            out[y : y + len(found)] = found[:, part.x0 - first : part.x1 - first]

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
