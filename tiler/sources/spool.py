"""Random access to files that can only be decoded from top to bottom: decoded once, into memory or a scratch file."""

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.rowfile import RowFile
from tiler.sources import FileInfo, Pixels, Reader

_PORTION_BYTES = 8 << 20


class _Silence:
    """Keeps libpng's and libjpeg's own words off stderr: the error we raise says the same in one sentence.

    Descriptors belong to the process: the first thread in turns stderr away, the last one out turns it back.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = 0
        self._saved = -1

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._threads == 0:
                sys.stderr.flush()
                self._saved = os.dup(2)
                with open(os.devnull, "wb") as sink:
                    os.dup2(sink.fileno(), 2)
            self._threads += 1
        try:
            yield
        finally:
            with self._lock:
                self._threads -= 1
                if self._threads == 0:
                    os.dup2(self._saved, 2)
                    os.close(self._saved)


_c_libraries_silenced = _Silence()


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
