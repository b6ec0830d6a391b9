"""Which datasets there are, and which version of each is current.

Datasets come, go and are rebuilt while the service runs. Every request costs one ``stat`` of the manifest, the commit
point of a build, or a look at an object store that is a second old at most; the manifest is read again only if it
changed. A manifest that becomes unreadable or damaged does not take the dataset away from running viewers: its blocks are
still there, so the last good version stays in service, and the log and the catalogue say what is wrong. A manifest that was
never good is answered with 503.
"""

import logging
import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME
from server.problems import UnavailableError
from server.remote import RemoteSlot, dataset_name, reads_each
from server.slots import FolderSlot, PublishedDataset, Slot, State
from tiler.stores.dataset import open_dataset
from tiler.stores.locate import folder_of, is_remote

_log: Final = logging.getLogger(__name__)


class Catalog:
    """The datasets of ``roots``, by name; a root is a dataset, a folder of datasets, or the URL of a dataset.

    A dataset is called as its folder, or as the last part of its URL. Folders with a leading dot are skipped. Raises
    NotFoundError, InputError or StorageError for a root that cannot be used, UsageError if two datasets have one name. A name that turns
    up twice while the service runs stays with the dataset that had it first.
    """

    def __init__(self, roots: Sequence[str | Path]) -> None:
        urls = list(dict.fromkeys(str(root).rstrip("/") for root in roots if is_remote(root)))
        self._roots = tuple(Path(os.path.abspath(folder_of(root))) for root in roots if not is_remote(root))
        self._lock = threading.Lock()
        self._slots: dict[str, Slot] = {}
        for root in self._roots:
            _check_root(root)
        for path in self._dataset_folders():
            known = self._slots.setdefault(path.name, FolderSlot(path.name, path))
            if known.where != str(path) and not Path(known.where).samefile(path):
                raise _same_name(known.where, str(path), path.name)
            known.refreshed()
        for url in urls:
            slot = RemoteSlot(url, reads_each(len(urls)))
            if (known := self._slots.setdefault(name := dataset_name(slot.where), slot)) is not slot:
                raise _same_name(known.where, slot.where, name)

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
        if state is None or state.absent:
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
        slots = sorted(self._slots.copy().items())
        for _, slot in slots:
            slot.look()  # all at once, so that several slow stores cost no more time than one
        states = [(name, slot.refreshed()) for name, slot in slots]
        published = [state.published for _, state in states if state.published is not None]
        problems = [(name, _problem_text(state)) for name, state in states if state.problem is not None]
        return published, problems

    def _slot(self, path: Path) -> Slot:
        with self._lock:
            known = self._slots.get(path.name)
            if known is None or (isinstance(known, FolderSlot) and known.where != str(path) and known.refreshed().absent):
                known = self._slots[path.name] = FolderSlot(path.name, path)
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


def _same_name(one: str, other: str, name: str) -> UsageError:
    return UsageError(f"{one} and {other} are both called {name!r}; rename one of them")


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


def _problem_text(state: State) -> str:
    kept = f"version {state.published.version} stays in service" if state.published else "it is not served"
    return f"the manifest cannot be read; {kept}; the service's log says why"
