"""Which datasets there are, and which version of each is current.

Datasets come, go and are rebuilt while the service runs. Every request costs one ``stat`` of the manifest, the commit
point of a build; the manifest is read again only if it changed. A manifest that becomes unreadable or damaged does not
take the dataset away from running viewers: its blocks are still there, so the last good version stays in service, and
the log and the catalogue say what is wrong. A manifest that was never good is answered with 503.
"""

import logging
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME, digest
from server.problems import UnavailableError
from tiler.stores.dataset import Dataset, open_dataset

_log: Final = logging.getLogger(__name__)

_Stamp = tuple[int, int, int]
"""Modification time [ns], size [bytes] and inode of a manifest; a renamed-over file has another inode."""
_NO_MANIFEST: Final[_Stamp] = (0, 0, 0)
_LOOK_AGAIN: Final[_Stamp] = (0, 0, -1)
"""Equals no file's stamp: the next request reads the manifest again."""


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
class _State:
    stamp: _Stamp
    published: PublishedDataset | None
    problem: str | None


class _Slot:
    """The place of one dataset in the catalogue; safe to use from several threads."""

    def __init__(self, name: str, path: Path) -> None:
        self.path = path
        self._name = name
        self._manifest = os.fspath(path / MANIFEST_NAME)
        self._lock = threading.Lock()
        self._state = _State(_NO_MANIFEST, None, None)

    @property
    def state(self) -> _State:
        """What was last seen."""
        return self._state

    def refreshed(self) -> _State:
        """Return what is there now; reads the manifest only if it changed."""
        if self._stamp() == self._state.stamp:
            return self._state
        with self._lock:
            # The stamp is taken before the manifest is read: one that is replaced in between is read again next time.
            stamp = self._stamp()
            if stamp != self._state.stamp:
                self._state = self._reopened(stamp)
            return self._state

    def _stamp(self) -> _Stamp:
        try:
            status = os.stat(self._manifest)
        except (FileNotFoundError, NotADirectoryError):
            return _NO_MANIFEST
        except OSError:
            return _LOOK_AGAIN
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _reopened(self, stamp: _Stamp) -> _State:
        if stamp == _NO_MANIFEST:
            return _State(stamp, None, None)
        try:
            dataset = open_dataset(self.path)
        except NotFoundError:
            return _State(_NO_MANIFEST, None, None)
        except ClipmapError as error:
            return self._failed(stamp, error)
        manifest_json = dataset.manifest.to_json()
        return _State(stamp, PublishedDataset(self._name, dataset, manifest_json, f'"{digest(manifest_json)}"'), None)

    def _failed(self, stamp: _Stamp, error: ClipmapError) -> _State:
        last = self._state.published
        if str(error) != self._state.problem:
            _log.error("%s%s", error, f"; version {last.version} stays in service" if last else "")
        # A damaged file stays damaged until it is replaced; an unreadable one may recover without a trace in its stamp.
        return _State(_LOOK_AGAIN if isinstance(error, StorageError) else stamp, last, str(error))


class Catalog:
    """The datasets below ``roots``, by name; a root is a dataset or a folder of datasets.

    A dataset is called as its folder. Folders with a leading dot are skipped. Raises NotFoundError, InputError or
    StorageError for a root that cannot be used, UsageError if two datasets have one name. A name that turns up twice
    while the service runs stays with the dataset that had it first.
    """

    def __init__(self, roots: Sequence[Path]) -> None:
        self._roots = tuple(Path(os.path.abspath(root)) for root in roots)
        self._lock = threading.Lock()
        self._slots: dict[str, _Slot] = {}
        for root in self._roots:
            _check_root(root)
        for path in self._dataset_folders():
            known = self._slots.setdefault(path.name, _Slot(path.name, path))
            if known.path != path and not known.path.samefile(path):
                raise UsageError(f"{known.path} and {path} are both called {path.name!r}; rename one of the folders")
            known.refreshed()

    def names(self) -> list[str]:
        """Return the datasets in service when they were last looked at; costs no look at the disk."""
        return sorted(name for name, slot in self._slots.copy().items() if slot.state.published is not None)

    def dataset(self, name: str) -> PublishedDataset:
        """Return the current version of a dataset.

        ``name`` is compared with the folders there are and never becomes part of a path. Raises NotFoundError, or
        UnavailableError if the manifest has never been good.
        """
        slot = self._slots.get(name)
        state = slot.refreshed() if slot else None
        if state is None or state.stamp == _NO_MANIFEST:
            path = next((path for path in self._candidates() if path.name == name and _has_manifest(path)), None)
            if path is None:
                raise NotFoundError(f"no dataset {name!r}; /datasets lists those there are")
            state = self._slot(path).refreshed()
        if state.published is None:
            raise UnavailableError(f"dataset {name!r} cannot be read at present; the service's log says why")
        return state.published

    def listing(self) -> tuple[list[PublishedDataset], list[tuple[str, str]]]:
        """Return the datasets in service, by name, and (name, what is wrong) of those whose manifest cannot be read."""
        for path in self._dataset_folders():
            self._slot(path)
        states = [(name, slot.refreshed()) for name, slot in sorted(self._slots.copy().items())]
        published = [state.published for _, state in states if state.published is not None]
        problems = [(name, _problem_text(state)) for name, state in states if state.problem is not None]
        return published, problems

    def _slot(self, path: Path) -> _Slot:
        with self._lock:
            known = self._slots.get(path.name)
            if known is None or (known.path != path and known.refreshed().stamp == _NO_MANIFEST):
                known = self._slots[path.name] = _Slot(path.name, path)
            return known

    def _candidates(self) -> Iterator[Path]:
        """Yield the folders that may be datasets, in the order of the roots."""
        for root in self._roots:
            if _has_manifest(root):
                yield root
                continue
            try:
                names = sorted(os.listdir(root))
            except OSError as error:
                _log.warning("%s: cannot be listed: %s", root, error.strerror)
                continue
            yield from (root / name for name in names if _servable(name))

    def _dataset_folders(self) -> Iterator[Path]:
        return filter(_has_manifest, self._candidates())


def _check_root(root: Path) -> None:
    if not root.exists():
        raise NotFoundError(f"{root}: no such folder; give a dataset or a folder of datasets")
    if not root.is_dir():
        raise InputError(f"{root}: is not a folder; give a dataset or a folder of datasets")
    try:
        os.listdir(root)
    except OSError as error:
        raise StorageError(f"{root}: cannot be listed: {error.strerror}") from error
    if _has_manifest(root):
        # Asked for by name, so worth an error at once; in a folder of datasets one that is damaged must not stop the others.
        if not root.name:
            raise UsageError(f"{root}: a dataset is called as its folder, and this one has no name")
        open_dataset(root)


def _has_manifest(folder: Path) -> bool:
    return os.path.isfile(folder / MANIFEST_NAME)


def _servable(name: str) -> bool:
    """Whether a folder's name can be a dataset's: not hidden, and text that fits in a URL and in JSON."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return not name.startswith(".")


def _problem_text(state: _State) -> str:
    kept = f"version {state.published.version} stays in service" if state.published else "it is not served"
    return f"the manifest cannot be read; {kept}; the service's log says why"
