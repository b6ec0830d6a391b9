"""Readers of many files, opened when they are needed; those not used for the longest time are closed again."""

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from schemas.errors import InputError
from tiler.sources import FileInfo, Reader
from tiler.sources.files import open_file

MAX_OPEN: Final = 64
"""Files held open at once: far below the 1024 descriptors that a process usually has, with several threads on each file."""
_MEMORY_BYTES: Final = 512 << 20
"""What decoded files that can only be read as a whole may take together."""
_IN_MEMORY_BYTES: Final = 64 << 20
"""A decoded file of more bytes than this lies in a scratch file (``tiler.rowfile``)."""


class _Held:
    """An open reader, and how many threads are reading from it."""

    def __init__(self, reader: Reader) -> None:
        self.reader = reader
        self.users = 0
        info = reader.info
        decoded = info.width * info.height * info.channels * info.dtype.itemsize
        self.memory_bytes = decoded if info.layout == "sequential" and decoded <= _IN_MEMORY_BYTES else 0


class ReaderPool:
    """Readers of the files that ``infos`` describe by their numbers, from any thread.

    At most 64 stay open, and more only while more than that are in use. Files are opened with ``tiler.sources.files.open_file``,
    whose errors name the file.
    """

    def __init__(self, infos: Sequence[FileInfo], scratch: Path | None, max_samples: int) -> None:
        self._infos, self._scratch, self._max_samples = infos, scratch, max_samples
        self._held: OrderedDict[int, _Held] = OrderedDict()
        self._lock = threading.Lock()
        self._opening = [threading.Lock() for _ in range(MAX_OPEN)]

    @contextlib.contextmanager
    def use(self, number: int) -> Iterator[Reader]:
        """Hold the reader of a file open; raises InputError if it cannot be opened, or is not what it was."""
        held = self._taken(number)
        if held is None:
            with self._opening[number % MAX_OPEN]:  # or each thread would decode the file for itself
                held = self._taken(number) or self._opened(number)
        try:
            yield held.reader
        finally:
            with self._lock:
                held.users -= 1
            self._close_superfluous()

    def _taken(self, number: int) -> _Held | None:
        with self._lock:
            held = self._held.get(number)
            if held is not None:
                held.users += 1
                self._held.move_to_end(number)
            return held

    def _opened(self, number: int) -> _Held:
        info = self._infos[number]
        held = _Held(open_file(info.path, self._scratch, self._max_samples))
        if _essence(held.reader.info) != _essence(info):
            held.reader.close()
            raise InputError(f"{info.path}: was changed while the mosaic was read; start again")
        held.users = 1
        with self._lock:
            self._held[number] = held
        return held

    def _close_superfluous(self) -> None:
        closing = []
        with self._lock:
            memory_bytes = sum(held.memory_bytes for held in self._held.values())
            for number, held in list(self._held.items()):
                if len(self._held) <= MAX_OPEN and memory_bytes <= _MEMORY_BYTES:
                    break
                if held.users == 0:
                    memory_bytes -= held.memory_bytes
                    closing.append(self._held.pop(number))
        for held in closing:
            held.reader.close()

    def close(self) -> None:
        """Close all files; nobody may be reading."""
        with self._lock:
            closing = list(self._held.values())
            self._held.clear()
        for held in closing:
            held.reader.close()


def _essence(info: FileInfo) -> tuple[object, ...]:
    """Return what decides how a file's pixels are used."""
    nodata = None if info.nodata is None else str(info.nodata)  # NaN is not equal to itself
    return info.width, info.height, info.channels, info.dtype, info.file_bytes, info.alpha, info.has_mask, nodata, info.georeference
