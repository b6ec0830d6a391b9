"""Datasets in archives: a folder with one PMTiles file per layer, or one such file alone."""

import os
import stat
import threading
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from schemas.address import BlockAddress, parse_block_name
from schemas.errors import NotFoundError, StorageError, UsageError
from schemas.manifest import INDEX_NAME, MANIFEST_NAME
from tiler.stores import Claim
from tiler.stores.directory import DirectoryStore
from tiler.stores.keys import check_key
from tiler.stores.tilefile import SUFFIX, TileFile

_Stamp = tuple[int, int, int]


def holds_archives(folder: Path) -> bool:
    """Whether ``folder`` is there and holds the archive of a layer."""
    return any(folder.glob(f"[a-z]*{SUFFIX}"))


class ArchiveStore:
    """A folder in which a layer may be one file: keys below ``<path>`` lie in ``<path>.pmtiles`` if there is such a file.

    All other keys are files, as in DirectoryStore. An archive is written once: what lies in it can be deleted as a whole
    (``delete_prefix``), but neither written nor deleted block by block, which raises StorageError. Safe to use from several threads.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._loose = DirectoryStore(root)
        self._open: dict[str, tuple[_Stamp, TileFile]] = {}
        self._lock = threading.Lock()

    @property
    def location(self) -> str:
        """The folder's path."""
        return str(self._root)

    @property
    def scratch(self) -> Path:
        """The folder itself."""
        return self._root

    def archive_path(self, path: str) -> Path:
        """Return the file that holds the layer at ``path``, or would."""
        return self._root / f"{path}{SUFFIX}"

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError or StorageError, or InputError if its archive is damaged."""
        archive = self._archive_of(key)
        return self._loose.read(key) if archive is None else _read_tile(archive, key, f"{self._root}/{key}")

    def write(self, key: str, data: bytes) -> None:
        """Put ``data`` under ``key`` in one step; raises StorageError, always if ``key`` lies in an archive."""
        self._refuse_archived(key)
        self._loose.write(key, data)

    def delete(self, keys: Iterable[str]) -> None:
        """Delete what lies under ``keys``; raises StorageError, always if one of them lies in an archive."""
        listed = list(keys)
        for key in listed:
            self._refuse_archived(key)
        self._loose.delete(listed)

    def delete_prefix(self, prefix: str) -> None:
        """Delete every key below ``prefix``, and the layer's archive, finished or not; raises StorageError."""
        if "/" in prefix:
            self._refuse_archived(prefix)
        self._loose.delete_prefix(prefix)
        with self._lock:
            self._open.pop(prefix, None)
        path = self.archive_path(prefix)
        for file in (path, unfinished(path)):
            try:
                file.unlink(missing_ok=True)
            except OSError as error:
                raise StorageError(f"{file}: cannot be deleted: {error.strerror}") from error

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below ``prefix``, sorted; '' means all. Raises InputError if an archive is damaged."""
        loose = self._loose.keys(prefix)
        if prefix:
            archive = self._archive_of(f"{prefix}/")
            if archive is None:
                return loose
            return sorted(key for key in _keys_of(archive, prefix.partition("/")[0]) if key.startswith(f"{prefix}/"))
        archived = {path for key in loose if (path := key.removesuffix(SUFFIX)) != key and self._is_archived(f"{path}/")}
        found = [key for key in loose if key.partition("/")[0].removesuffix(SUFFIX) not in archived]
        for path in archived:
            found += self.keys(path)
        return sorted(found)

    def sync(self) -> None:
        """Flush what was written to the disk."""
        self._loose.sync()

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        """Keep other builds out of the folder as long as the context lasts, as DirectoryStore does."""
        return self._loose.exclusive(break_stale)

    def _is_archived(self, key: str) -> bool:
        path, inside, _ = key.partition("/")
        return bool(inside) and self._stamp(path) is not None

    def _refuse_archived(self, key: str) -> None:
        if "/" not in key and key.endswith(SUFFIX):
            raise NotFoundError(f"{self._root}: {key!r} is not a key of a store")
        if self._is_archived(key):
            archive = f"{key.partition('/')[0]}{SUFFIX}"
            raise StorageError(
                f"{self._root}/{key}: lies in the archive {archive}, which is written once; "
                "change the dataset it was copied from and run clipmap copy again"
            )

    def _stamp(self, path: str) -> _Stamp | None:
        try:
            status = os.stat(f"{self._root}/{path}{SUFFIX}")
        except (OSError, ValueError):  # a key with a NUL is no path
            return None
        return (status.st_ino, status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None

    def _archive_of(self, key: str) -> TileFile | None:
        """Return the archive in which ``key`` lies, None if it is a file's; opens an archive that was replaced anew."""
        path, inside, _ = key.partition("/")
        if not inside:
            if key.endswith(SUFFIX):
                raise NotFoundError(f"{self._root}: {key!r} is not a key of a store")
            return None
        stamp = self._stamp(path)
        if stamp is None or path.startswith("."):
            return None
        known = self._open.get(path)
        if known is None or known[0] != stamp:
            known = stamp, TileFile(self.archive_path(path))
            with self._lock:
                self._open[path] = known
        return known[1]


class ArchiveFileStore:
    """One archive alone, as a dataset of one layer: its manifest is in the file's metadata. Nothing can be written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._archive: TileFile | None = None

    @property
    def location(self) -> str:
        """The file's path."""
        return str(self._path)

    @property
    def scratch(self) -> Path:
        """The folder the file lies in."""
        return self._path.parent

    def _opened(self) -> TileFile:
        if self._archive is None:
            self._archive = TileFile(self._path)
        return self._archive

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError or StorageError, or InputError if the archive is damaged."""
        archive = self._opened()
        if key == MANIFEST_NAME:
            return archive.manifest.to_json()
        if key.partition("/")[0] != archive.layer.path:
            raise NotFoundError(f"{self._path}: has no {key!r}")
        return _read_tile(archive, key, f"{self._path}/{key}")

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below ``prefix``, sorted; '' means all."""
        archive = self._opened()
        found = [*_keys_of(archive, archive.layer.path), MANIFEST_NAME]
        return sorted(key for key in found if not prefix or key.startswith(f"{prefix}/"))

    def write(self, key: str, data: bytes) -> None:
        """Raise StorageError: an archive is written once."""
        raise self._sealed()

    def delete(self, keys: Iterable[str]) -> None:
        """Raise StorageError: an archive is written once."""
        raise self._sealed()

    def delete_prefix(self, prefix: str) -> None:
        """Raise StorageError: an archive is written once."""
        raise self._sealed()

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        """Raise StorageError: an archive is written once."""
        raise self._sealed()

    def sync(self) -> None:
        """Return at once: nothing was written."""

    def _sealed(self) -> StorageError:
        return StorageError(f"{self._path}: is an archive, which is written once; build into a folder, and export that again")


def unfinished(path: Path) -> Path:
    """Return the name under which the archive ``path`` is written until it is whole; hidden, so no key and no archive."""
    return path.with_name(f".tmp-{path.name}")


def _read_tile(archive: TileFile, key: str, where: str) -> bytes:
    parts = check_key(where, key)
    if len(parts) == 3:
        level = int(parts[1]) if parts[1].isdecimal() and len(parts[1]) < 5 else -1
        if parts[2] == INDEX_NAME and 0 <= level < len(archive.layer.levels) and parts[1] == str(level):
            return archive.index(level)
        address = _address(archive, parts[1], parts[2])
        data = None if address is None else archive.tile(address)
        if data is not None:
            return data
    raise NotFoundError(f"{where}: no such block or file in the archive")


def _address(archive: TileFile, level: str, name: str) -> BlockAddress | None:
    """Return the address of the block called ``name`` in the folder ``level``; None if that is no block of the archive's layer."""
    try:
        parsed = parse_block_name(name)
    except UsageError:
        return None
    ours = (archive.name, archive.layer.suffix, len(archive.layer.levels), level)
    return parsed.address if (parsed.layer, parsed.suffix, parsed.levels, str(parsed.address.level)) == ours else None


def _keys_of(archive: TileFile, path: str) -> Iterator[str]:
    layer = archive.layer.model_copy(update={"path": path})  # a layer in an archive has no patches
    yield from (layer.index_key(level) for level in range(len(layer.levels)))
    yield from (layer.block_key(archive.name, address) for address in archive.addresses())
