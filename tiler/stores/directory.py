"""A store in a directory: one file per key, written to a temporary name and renamed."""

import ctypes
import fcntl
import os
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from schemas.errors import NotFoundError, StorageError

_TEMPORARY = ".tmp-"
_LOCK = ".clipmap-lock"
_CLAIM = "clipmap build"
_PREFIX = re.compile(r"[a-z][a-z0-9_.]*")
_LIBC = ctypes.CDLL(None, use_errno=True)


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
        if not self._root.exists():
            return
        descriptor = os.open(self._root, os.O_RDONLY)
        try:
            # Only the file system of the store: os.sync() would wait for every disk of the machine.
            if _LIBC.syncfs(descriptor) != 0:
                os.sync()
        finally:
            os.close(descriptor)

    @contextmanager
    def exclusive(self) -> Iterator["BuildClaim"]:
        """Keep other builds out of the store as long as the block lasts.

        The lock is the kernel's (``flock``), so it ends with the process however that ends. Makes the directory if there is
        none, and removes it again if nothing was put in. Raises StorageError if another build is at work or the directory cannot
        be made.
        """
        path = self._root / _LOCK
        try:
            made = [folder for folder in (self._root, *self._root.parents) if not folder.exists()]
            self._root.mkdir(parents=True, exist_ok=True)
            descriptor = self._locked(path)
        except (FileExistsError, NotADirectoryError):
            raise StorageError(f"{self._root}: a file is in the way, or a link that leads nowhere; choose another folder") from None
        except OSError as error:
            raise StorageError(f"{self._root}: cannot be written: {error.strerror}") from error
        try:
            yield BuildClaim(descriptor)
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
                _, owner = _read_claim(descriptor)
                os.close(descriptor)
                raise StorageError(f"{self._root}: another build is writing here (process {owner}); wait until it has ended") from None
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
            os.close(descriptor)  # its owner removed the file between our opening and locking it


class BuildClaim:
    """A build's hold on a store. Its file says who holds it and which prefixes are being written or deleted.

    So the build after a killed one knows exactly what was left behind, and deletes that and nothing else.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.abandoned, _ = _read_claim(descriptor)
        self.announce(*self.abandoned)

    def announce(self, *prefixes: str) -> None:
        """Write down the prefixes that are no dataset's until the build has ended."""
        text = "\n".join([_CLAIM, str(os.getpid()), *prefixes]) + "\n"
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, text.encode(), 0)


def _read_claim(descriptor: int) -> tuple[tuple[str, ...], str]:
    """Return the prefixes and the process of a claim; none and 'unknown' if the file is not one."""
    lines = os.pread(descriptor, 65536, 0).decode("utf-8", "replace").splitlines()
    if len(lines) < 2 or lines[0] != _CLAIM:
        return (), "unknown"
    return tuple(line for line in lines[2:] if _PREFIX.fullmatch(line)), lines[1]
