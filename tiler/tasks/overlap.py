"""Requests to a store that are under way at the same time, where waiting for answers would cost more than the work.

A block takes a millisecond to make and an object store 20 ms to accept it: one after the other, a build into a bucket would wait most
of its time. In a directory requests are made where they are needed: there the system's cache answers at once.
"""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from typing import Final, TypeVar

from tiler.stores import Store
from tiler.stores.directory import DirectoryStore
from tiler.stores.locate import is_remote

Item = TypeVar("Item")
Answer = TypeVar("Answer")

_WRITES: Final = 32
"""Requests of all tasks of this process that are under way at most; S3 answers thousands a second."""
_READS: Final = 16
_WAITING: Final = 16
"""Blocks of one task that wait to be written: their bytes are held in memory."""


@cache
def _lanes(kind: str, count: int) -> ThreadPoolExecutor:
    """Return the threads that wait for answers; apart for reads and writes, so that neither can wait for the other for ever."""
    return ThreadPoolExecutor(count, thread_name_prefix=f"clipmap-{kind}")


class TaskWrites:
    """The writes of one task; ``finish`` returns when all have been made, and nothing may rely on one before.

    ``unnamed``: nothing names the keys before, so that a killed process may leave a part of one.
    """

    def __init__(self, store: Store, unnamed: bool = False) -> None:
        self._write = store.write_unnamed if unnamed and isinstance(store, DirectoryStore) else store.write
        self._overlapping = is_remote(store.location)
        self._pending: deque[Future[None]] = deque()

    def write(self, key: str, data: bytes) -> None:
        """Write, or begin to; raises StorageError, also that of an earlier write."""
        if not self._overlapping:
            self._write(key, data)
            return
        while len(self._pending) >= _WAITING:
            self._pending.popleft().result()
        self._pending.append(_lanes("write", _WRITES).submit(self._write, key, data))

    def finish(self) -> None:
        """Wait for all writes; raises the StorageError of the first that failed."""
        wait(self._pending)
        while self._pending:
            self._pending.popleft().result()


def read_all(store: Store, read: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Return what ``read`` gives for every item, in their order; ``read`` waits for ``store``."""
    if not is_remote(store.location):
        return [read(item) for item in items]
    return list(_lanes("read", _READS).map(read, items))
