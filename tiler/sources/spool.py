"""Random access to files that can only be decoded from top to bottom: decoded once, into memory or a scratch file."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.rowfile import RowFile
from tiler.sources import FileInfo, Pixels, Reader

_PORTION_BYTES = 8 << 20


@contextlib.contextmanager
def _c_libraries_silenced() -> Iterator[None]:
    """Keep libpng's and libjpeg's own words off stderr: the error we raise says the same in one sentence."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 2)
            yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


class SpooledReader:
    """The pixels of a sequential reader, decoded once when this is made; windows then come from memory or a scratch file.

    The scratch file lies in ``scratch`` and has no name. Raises InputError if the file is truncated or damaged, StorageError if
    the scratch file cannot be written.
    """

    def __init__(self, reader: Reader, scratch: Path) -> None:
        self.info: FileInfo = reader.info
        info = reader.info
        self._rows = RowFile(info.width, info.height, info.channels, info.dtype, scratch)
        portion = max(1, _PORTION_BYTES // (info.width * info.channels * info.dtype.itemsize))
        try:
            with _c_libraries_silenced():
                for y in range(0, info.height, portion):
                    pixels, _ = reader.read(Rect(0, y, info.width, min(info.height, y + portion)))
                    self._rows.write(0, y, pixels)
        except BaseException:
            self._rows.close()
            raise
        finally:
            reader.close()

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels) and None; raises StorageError if the scratch file cannot be read."""
        return self._rows.read(window), None

    def close(self) -> None:
        """Free the memory or the scratch file."""
        self._rows.close()
