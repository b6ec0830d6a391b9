"""A store in a directory: one file per key, written to a temporary name and renamed."""

import fcntl
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from schemas.errors import NotFoundError, StorageError

_TEMPORARY = ".tmp-"
_LOCK = ".lock"


class DirectoryStore:
    """Keys are file paths below ``root``; the directory is created by the first write. Hidden names (``.x``) are no keys.

    ``write`` renames a finished temporary file over the key, so a killed process leaves at most files whose
    names begin with ``.tmp-``, which no reader sees.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._known_folders: set[Path] = set()

    @property
    def location(self) -> str:
        """The directory's path."""
        return str(self._root)

    def _path(self, key: str) -> Path:
        parts = key.split("/")
        if "\0" in key or any(not part or part.startswith(".") for part in parts):
            raise NotFoundError(f"{self._root}: {key!r} is not a key of a store")
        return self._root.joinpath(*parts)

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError or StorageError."""
        path = self._path(key)
        try:
            with open(path, "rb", buffering=0) as file:
                return file.read()
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            raise NotFoundError(f"{path}: no such block or file") from None
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error

    def write(self, key: str, data: bytes) -> None:
        """Put ``data`` under ``key`` in one step; raises StorageError."""
        path = self._path(key)
        temporary = path.with_name(f"{_TEMPORARY}{os.getpid()}-{threading.get_ident()}-{path.name}")
        try:
            self._make_folder(path.parent)
            try:
                descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
                with open(descriptor, "wb", buffering=0) as file:
                    view = memoryview(data)
                    while view:
                        view = view[file.write(view) :]
                os.replace(temporary, path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error.strerror}") from error

    def _make_folder(self, folder: Path) -> None:
        if folder not in self._known_folders:
            folder.mkdir(parents=True, exist_ok=True)
            self._known_folders.add(folder)

    def delete_prefix(self, prefix: str) -> None:
        """Delete every key below ``prefix``; raises StorageError."""
        path = self._path(prefix)
        self._known_folders.clear()
        try:
            shutil.rmtree(path)
        except (FileNotFoundError, NotADirectoryError):
            return
        except OSError as error:
            raise StorageError(f"{path}: cannot be deleted: {error.strerror}") from error

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below ``prefix``, sorted; '' means all."""
        folder = self._path(prefix) if prefix else self._root
        found = []
        for parent, folders, names in os.walk(folder):
            folders[:] = [name for name in folders if not name.startswith(".")]
            found += [(Path(parent) / name).relative_to(self._root).as_posix() for name in names if not name.startswith(".")]
        return sorted(found)

    def sync(self) -> None:
        """Flush what was written to the disk, so that a manifest never survives a power cut that its blocks did not."""
        os.sync()

    @contextmanager
    def exclusive(self) -> Iterator[bool]:
        """Keep other builds out of the store; gives True if the last one was killed and left its lock file behind.

        The lock is the kernel's (``flock``), so it ends with the process however that ends. Makes the directory if there is
        none, and removes it again if nothing was put in. Raises StorageError if another build is at work or the directory cannot
        be made.
        """
        path = self._root / _LOCK
        try:
            made = [folder for folder in (self._root, *self._root.parents) if not folder.exists()]
            self._root.mkdir(parents=True, exist_ok=True)
            abandoned = path.exists()
            descriptor = self._locked(path)
        except OSError as error:
            raise StorageError(f"{self._root}: cannot be written: {error.strerror}") from error
        try:
            yield abandoned
        finally:
            path.unlink(missing_ok=True)
            os.close(descriptor)
            with suppress(OSError):
                for folder in made:
                    folder.rmdir()

    def _locked(self, path: Path) -> int:
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                owner = os.pread(descriptor, 20, 0).decode("ascii", "replace") or "unknown"
                os.close(descriptor)
                raise StorageError(f"{self._root}: another build is writing here (process {owner}); wait until it has ended") from None
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, str(os.getpid()).encode(), 0)
                return descriptor
            os.close(descriptor)  # its owner removed the file between our opening and locking it
