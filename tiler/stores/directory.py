"""A store in a directory: one file per key, written to a temporary name and renamed."""

import os
import shutil
import threading
from pathlib import Path

from schemas.errors import NotFoundError, StorageError

_TEMPORARY = ".tmp-"


class DirectoryStore:
    """Keys are file paths below ``root``; the directory is created by the first write.

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
        if not key or any(part in ("", ".", "..") or part.startswith(_TEMPORARY) for part in parts):
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
        except FileNotFoundError:
            return
        except OSError as error:
            raise StorageError(f"{path}: cannot be deleted: {error.strerror}") from error

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below ``prefix``, sorted; '' means all."""
        folder = self._path(prefix) if prefix else self._root
        return sorted(
            (Path(parent) / name).relative_to(self._root).as_posix()
            for parent, _, names in os.walk(folder)
            for name in names
            if not name.startswith(_TEMPORARY)
        )

    def sync(self) -> None:
        """Flush what was written to the disk, so that a manifest never survives a power cut that its blocks did not."""
        os.sync()
