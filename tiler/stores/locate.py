"""Which store a location means: a folder, or the URL of a bucket."""

import re
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from schemas.errors import UsageError
from tiler.stores import Store
from tiler.stores.archive import ArchiveFileStore, ArchiveStore, holds_archives
from tiler.stores.directory import DirectoryStore
from tiler.stores.objects import ObjectStore
from tiler.stores.tilefile import SUFFIX

_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


def is_url(location: str | Path) -> bool:
    """Whether ``location`` is a URL rather than a path; a ``Path`` never is, it would have lost a slash."""
    return isinstance(location, str) and _URL.match(location) is not None


def is_remote(location: str | Path) -> bool:
    """Whether ``location`` is the URL of an object store rather than a folder on this machine."""
    return is_url(location) and not str(location).lower().startswith("file:")


def folder_of(location: str | Path) -> Path:
    """Return the folder that ``location`` names, a path or a URL that begins with ``file://``.

    Raises UsageError for a file URL of another machine.
    """
    if isinstance(location, Path) or not is_url(location):
        return Path(location)
    parts = urlsplit(location)
    if parts.netloc not in ("", "localhost") or parts.query or parts.fragment:
        raise UsageError(f"{location}: a file URL names a folder of this machine, like file:///data/alps; for others mount the folder")
    return Path(unquote(parts.path))


def open_store(location: str | Path) -> Store:
    """Return the store at ``location``: a folder, which need not exist yet, or a URL; nothing is read or made.

    ``s3://``, ``gs://`` and ``az://`` are object stores, ``file://`` is a folder. Raises UsageError for any other URL, and
    MissingExtraError if the extra that a store needs is not installed.
    """
    if is_remote(location):
        return ObjectStore(str(location))
    return _open_folder(folder_of(location))


def _open_folder(folder: Path) -> Store:
    """Return the store in ``folder``, which need not exist; it may be the archive of one layer as well."""
    if folder.suffix == SUFFIX and folder.is_file():
        return ArchiveFileStore(folder)
    return ArchiveStore(folder) if holds_archives(folder) else DirectoryStore(folder)
