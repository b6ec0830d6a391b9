"""The place of a dataset in the catalogue: which version is current, and what was wrong with the last look."""

import logging
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from schemas.errors import ClipmapError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME, digest
from tiler.stores.dataset import Dataset, open_dataset

_log: Final = logging.getLogger(__name__)

Stamp = tuple[int, int, int] | str
"""What tells a manifest from the one before: of a file, modification time [ns], size [bytes] and inode, as a renamed-over file has another
inode; of an object, its entity tag."""
NO_MANIFEST: Final[Stamp] = (0, 0, 0)
LOOK_AGAIN: Final[Stamp] = (0, 0, -1)
"""Equals no manifest's stamp: the next request reads it again."""


@dataclass(frozen=True, slots=True)
class PublishedDataset:
    """One version of a dataset, as it is served; a rebuilt dataset is another object."""

    name: str
    dataset: Dataset
    manifest_json: bytes
    manifest_etag: str

    @property
    def version(self) -> str:
        """The manifest's version."""
        return self.dataset.manifest.version


@dataclass(frozen=True, slots=True)
class State:
    """What was seen at the last look: a version to serve, what is wrong, or neither if there is no manifest."""

    stamp: Stamp
    published: PublishedDataset | None = None
    problem: str | None = None

    @property
    def absent(self) -> bool:
        """Whether there is no manifest."""
        return self.stamp == NO_MANIFEST

    @classmethod
    def of(cls, name: str, dataset: Dataset, stamp: Stamp) -> "State":
        """Return the state after a good manifest was read."""
        manifest_json = dataset.manifest.to_json()
        return cls(stamp, PublishedDataset(name, dataset, manifest_json, f'"{digest(manifest_json)}"'))

    def failed(self, stamp: Stamp, error: ClipmapError) -> "State":
        """Return the state after a manifest could not be read: the last good version stays; what is new goes to the log."""
        if str(error) != self.problem:
            _log.error("%s%s", error, f"; version {self.published.version} stays in service" if self.published else "")
        # A damaged file stays damaged until it is replaced; an unreadable one may recover without a trace in its stamp.
        return State(LOOK_AGAIN if isinstance(error, StorageError) else stamp, self.published, str(error))


class Slot(Protocol):
    """The place of one dataset in the catalogue; safe to use from several threads."""

    @property
    def where(self) -> str:
        """Folder or URL of the dataset."""
        ...

    @property
    def state(self) -> State:
        """What was last seen; costs no look."""
        ...

    def look(self) -> None:
        """Begin to look what is there now, if that takes long; ``refreshed`` then waits for less."""
        ...

    def refreshed(self) -> State:
        """Return what is there now; reads the manifest only if it changed."""
        ...


class FolderSlot:
    """A dataset in a folder: every look is one ``stat`` of its manifest."""

    def __init__(self, name: str, path: Path) -> None:
        self._name, self._path = name, path
        self._manifest = os.fspath(path / MANIFEST_NAME)
        self._lock = threading.Lock()
        self._state = State(NO_MANIFEST)

    @property
    def where(self) -> str:
        """The folder's path."""
        return str(self._path)

    @property
    def state(self) -> State:
        """What was last seen."""
        return self._state

    def look(self) -> None:
        """Do nothing: a look does not take long."""

    def refreshed(self) -> State:
        """Return what is there now; reads the manifest only if it changed."""
        if self._stamp() == self._state.stamp:
            return self._state
        with self._lock:
            # The stamp is taken before the manifest is read: one that is replaced in between is read again next time.
            stamp = self._stamp()
            if stamp != self._state.stamp:
                self._state = self._reopened(stamp)
            return self._state

    def _stamp(self) -> Stamp:
        try:
            status = os.stat(self._manifest)
        except (FileNotFoundError, NotADirectoryError):
            return NO_MANIFEST
        except OSError:
            return LOOK_AGAIN
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _reopened(self, stamp: Stamp) -> State:
        if stamp == NO_MANIFEST:
            return State(stamp)
        try:
            dataset = open_dataset(self._path)
        except NotFoundError:
            return State(NO_MANIFEST)
        except ClipmapError as error:
            return self._state.failed(stamp, error)
        return State.of(self._name, dataset, stamp)
