"""Loading blocks: worker threads, a bounded cache, and a queue that always holds what the viewer wants now.

The queue is replaced as a whole every frame: what is no longer wanted is forgotten before it is fetched, and the order is
the viewer's, coarse levels first. At most one block per worker is under way. Decoding happens in the workers; the codecs
release the GIL.
"""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, StorageError
from viewer.decode import Block, Decoder

CAPACITY_BYTES: Final = 512 << 20
RETRY_S: Final = 2.0


@dataclass(frozen=True, order=True, slots=True)
class BlockKey:
    """A block of a named layer."""

    layer: str
    address: BlockAddress


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a block is not there, and when it may be tried again (``time.monotonic``; None: never)."""

    error: Exception
    retry_at: float | None


@dataclass(slots=True)
class LoadCounts:
    """What has been loaded since the start."""

    blocks: int = 0
    blank: int = 0
    fetched_bytes: int = 0
    evicted: int = 0


Read = Callable[[str, BlockAddress], bytes | None]


class BlockLoader:
    """Loads and keeps decoded blocks; ``get``, ``request``, ``wait`` and ``close`` belong to one thread, the renderer's.

    ``capacity_bytes`` bounds the decoded blocks kept; those wanted right now are kept even beyond it. A block whose read
    failed (StorageError) is tried again after ``RETRY_S``; one that is damaged or missing is not.
    """

    def __init__(self, read: Read, decoders: Mapping[str, Decoder], workers: int = 4, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self._read = read
        self._decoders = decoders
        self._capacity = capacity_bytes
        self._changed = threading.Condition()
        self._cache: OrderedDict[BlockKey, Block] = OrderedDict()
        self._held_bytes = 0
        self._queue: deque[BlockKey] = deque()
        self._wanted: frozenset[BlockKey] = frozenset()
        self._under_way: set[BlockKey] = set()
        self._failures: dict[BlockKey, Failure] = {}
        self._arrivals = 0
        self._closed = False
        self.counts = LoadCounts()
        self._threads = [threading.Thread(target=self._work, name=f"blocks-{number}", daemon=True) for number in range(workers)]
        for thread in self._threads:
            thread.start()

    def get(self, key: BlockKey) -> Block | None:
        """Return the block if it is loaded."""
        with self._changed:
            block = self._cache.get(key)
            if block is not None:
                self._cache.move_to_end(key)
            return block

    def request(self, wanted: Iterable[BlockKey]) -> int:
        """Replace the queue by ``wanted``, most urgent first, and return how many of them are still to come.

        What fails for another reason than a ClipmapError is a defect, and is raised here.
        """
        with self._changed:
            self._raise_defect()
            ordered = list(dict.fromkeys(wanted))
            self._wanted = frozenset(ordered)
            now = time.monotonic()
            self._queue = deque(key for key in ordered if key not in self._cache and key not in self._under_way and self._may_try(key, now))
            missing = sum(key not in self._cache for key in ordered)
            self._changed.notify_all()
            return missing

    def wait(self, timeout_s: float) -> bool:
        """Wait until a block has arrived or failed since the last call, or nothing is under way; False if the time ran out."""
        with self._changed:
            done = self._changed.wait_for(lambda: self._arrivals or not (self._queue or self._under_way), timeout_s)
            self._arrivals = 0
            self._raise_defect()
            return bool(done)

    @property
    def failures(self) -> dict[BlockKey, ClipmapError]:
        """The wanted blocks that could not be loaded, and why."""
        with self._changed:
            return {
                key: failure.error
                for key, failure in self._failures.items()
                if key in self._wanted and isinstance(failure.error, ClipmapError)
            }

    @property
    def pending(self) -> int:
        """Blocks queued or under way."""
        with self._changed:
            return len(self._queue) + len(self._under_way)

    @property
    def held_bytes(self) -> int:
        """Memory of the blocks kept [bytes]."""
        with self._changed:
            return self._held_bytes

    def close(self) -> None:
        """Stop the workers; blocks under way are waited for."""
        with self._changed:
            self._closed = True
            self._queue.clear()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _may_try(self, key: BlockKey, now: float) -> bool:
        failure = self._failures.get(key)
        return failure is None or (failure.retry_at is not None and now >= failure.retry_at)

    def _raise_defect(self) -> None:
        for failure in self._failures.values():
            if not isinstance(failure.error, ClipmapError):
                raise failure.error

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                key = self._queue.popleft()
                self._under_way.add(key)
            try:
                data = self._read(key.layer, key.address)
                result: Block | Exception = self._decoders[key.layer](data)
                size = 0 if data is None else len(data)
            except Exception as error:
                result, size = error, 0
            self._finish(key, result, size)

    def _finish(self, key: BlockKey, result: Block | Exception, size: int) -> None:
        with self._changed:
            self._under_way.discard(key)
            self._arrivals += 1
            if isinstance(result, Exception):
                self._failures[key] = Failure(result, time.monotonic() + RETRY_S if isinstance(result, StorageError) else None)
            else:
                self._failures.pop(key, None)
                self._cache[key] = result
                self._held_bytes += result.nbytes
                self.counts.blocks += 1
                self.counts.blank += size == 0
                self.counts.fetched_bytes += size
                self._evict()
            self._changed.notify_all()

    def _evict(self) -> None:
        if self._held_bytes <= self._capacity:
            return
        for key in [key for key in self._cache if key not in self._wanted]:
            self._held_bytes -= self._cache.pop(key).nbytes
            self.counts.evicted += 1
            if self._held_bytes <= self._capacity:
                return
