"""A dataset in an object store: its manifest is watched from aside, and its reads are counted, so that a slow store holds up nobody else.

Every look is a request over the network. So there is one at most per second, in a thread of its own, and a request that finds it under
way waits for it a second at most: a store that does not answer leaves the last good version in service. Blocks are read by the
service's threads like any others, but only so many at once that threads are left for other datasets.
"""

import threading
import time
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import unquote

from schemas.errors import ClipmapError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME, parse_manifest
from server.problems import UnavailableError
from server.slots import NO_MANIFEST, State
from tiler.stores.dataset import Dataset
from tiler.stores.objects import ObjectStore

READS_AT_ONCE: Final = 32
"""Of the 40 threads of the service, how many may wait for object stores at a time."""
_FEWEST_READS: Final = 2
_INTERVAL_S: Final = 1.0
"""A new version is seen this long after it was published, or sooner."""
_PATIENCE_S: Final = 1.0
"""How long a request waits for a look, or for its turn to read, before it goes on without."""


def dataset_name(url: str) -> str:
    """Return what a dataset at ``url`` is called: the last part of its path, or its bucket."""
    return unquote(url.rstrip("/").rpartition("/")[2])


def reads_each(datasets: int) -> int:
    """Return how many reads at once each of so many remote datasets may have."""
    return max(_FEWEST_READS, READS_AT_ONCE // max(1, datasets))


class ServedStore(ObjectStore):
    """An object store as blocks are served from it: ``reads`` at a time, and its failures are answers that say 'not now'."""

    def __init__(self, url: str, reads: int) -> None:
        super().__init__(url)
        self._turns = threading.BoundedSemaphore(reads)
        self.missed = threading.Event()
        """Set when something was not there: the dataset may have been rebuilt."""

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError, or UnavailableError if the store fails or is too slow."""
        name = dataset_name(self.location)
        if not self._turns.acquire(timeout=_PATIENCE_S):
            raise UnavailableError(f"the store of dataset {name!r} is slower than the requests come; ask again")
        try:
            return super().read(key)
        except NotFoundError:
            self.missed.set()
            raise
        except StorageError as error:
            raise UnavailableError(f"the store of dataset {name!r} cannot be read at present; the service's log says why") from error
        finally:
            self._turns.release()


@dataclass(frozen=True, slots=True)
class _Look:
    begun_s: float
    done: threading.Event = field(default_factory=threading.Event)


class RemoteSlot:
    """A dataset in an object store. Raises NotFoundError, InputError or StorageError if it cannot be read to begin with."""

    def __init__(self, url: str, reads: int) -> None:
        self._store = ServedStore(url, reads)
        self._lock = threading.Lock()
        self._last: _Look | None = None
        self._state = State(NO_MANIFEST)
        try:
            self._state = self._seen()
        except NotFoundError as error:
            raise NotFoundError(f"{self.where}: no dataset there (no {MANIFEST_NAME}); give the URL of a dataset") from error

    @property
    def where(self) -> str:
        """The dataset's URL."""
        return self._store.location

    @property
    def state(self) -> State:
        """What was last seen."""
        return self._state

    def look(self) -> None:
        """Begin a look unless one is under way or was just done."""
        self._due_look()

    def refreshed(self) -> State:
        """Return what was seen a second ago or later; after a second of waiting, what was seen last."""
        look = self._due_look()
        if look is not None:
            look.done.wait(max(0.0, look.begun_s + _PATIENCE_S - time.monotonic()))
        return self._state

    def _due_look(self) -> _Look | None:
        """Return the look that is under way, begun by this call if need be; None if the last one is recent enough."""
        with self._lock:
            last, now_s = self._last, time.monotonic()
            if last is not None and not last.done.is_set():
                return last
            if last is not None and now_s < last.begun_s + _INTERVAL_S and not self._store.missed.is_set():
                return None
            self._store.missed.clear()
            self._last = _Look(now_s)
            # A daemon, since a store that does not answer shall not hold up the end of the service either.
            threading.Thread(target=self._look, args=(self._last,), name="clipmap-look", daemon=True).start()
            return self._last

    def _look(self, look: _Look) -> None:
        try:
            self._state = self._seen()
        except NotFoundError:
            self._state = State(NO_MANIFEST)
        except ClipmapError as error:
            self._state = self._state.failed(self._state.stamp, error)
        finally:
            look.done.set()

    def _seen(self) -> State:
        """Return the state of the store; raises what the store or the manifest does."""
        tag = self._state.stamp if isinstance(self._state.stamp, str) and self._state.stamp else None
        found = self._store.read_if_changed(MANIFEST_NAME, tag)
        if found is None:
            return State(self._state.stamp, self._state.published)
        data, new_tag = found
        manifest = parse_manifest(data, f"{self.where}/{MANIFEST_NAME}")
        return State.of(dataset_name(self.where), Dataset(self._store, manifest), new_tag or "")
