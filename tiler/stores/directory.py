"""A store in a directory: one file per key, written to a temporary name and renamed, but for what nothing names yet."""

import ctypes
import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from schemas.errors import NotFoundError, StorageError
from tiler.stores.claims import CLAIM_NAME, MAX_CLAIM_BYTES, ClaimNote
from tiler.stores.filelock import open_locked
from tiler.stores.keys import check_key

_TEMPORARY = ".tmp-"
_LIBC = ctypes.CDLL(None, use_errno=True)


def _write_file(path: str, data: bytes, flag: int) -> None:
    """Write a file, opened with ``flag``; leaves none if it cannot be written to the end. Raises OSError."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | flag, 0o666)
    try:
        try:
            written = os.write(descriptor, data)
            while written < len(data):  # a file system that is nearly full, or more than 2 GiB
                written += os.write(descriptor, memoryview(data)[written:])
        finally:
            os.close(descriptor)
    except BaseException:
        Path(path).unlink(missing_ok=True)
        raise


class DirectoryStore:
    """Keys are file paths below ``root``; the directory is created by the first write. Hidden names (``.x``) are no keys.

    ``write`` renames a finished temporary file over the key, so a killed process leaves at most files whose
    names begin with ``.tmp-``, which no reader sees. ``write_unnamed`` is for what no reader looks for yet.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folder = str(root)
        self._known_folders: set[str] = set()

    @property
    def location(self) -> str:
        """The directory's path."""
        return self._folder

    @property
    def scratch(self) -> Path:
        """The directory itself."""
        return self._root

    def _path(self, key: str) -> Path:
        return self._root.joinpath(*check_key(self.location, key))

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
        # Strings instead of Path objects: a build writes thousands of files a second, and every thread waits for this one meanwhile.
        *folders, name = check_key(self.location, key)
        self._replace("/".join((self._folder, *folders)), name, data)

    def write_unnamed(self, key: str, data: bytes) -> None:
        """Put ``data`` under a ``key`` that nothing names yet; a process that is killed may leave a part of it. Raises StorageError.

        Without the temporary name a file of 25 kB takes 50 us instead of 70. What lies under the key is replaced as ever: it may be
        a link, or be linked to from elsewhere.
        """
        *folders, name = check_key(self.location, key)
        folder = "/".join((self._folder, *folders))
        try:
            self._make_folder(folder)
            _write_file(f"{folder}/{name}", data, os.O_EXCL)
        except FileExistsError:
            self._replace(folder, name, data)
        except OSError as error:
            raise StorageError(f"{folder}/{name}: cannot be written: {error.strerror}") from error

    def _replace(self, folder: str, name: str, data: bytes) -> None:
        temporary = f"{folder}/{_TEMPORARY}{os.getpid()}-{threading.get_ident()}-{name}"
        try:
            self._make_folder(folder)
            try:
                _write_file(temporary, data, os.O_TRUNC)
                os.replace(temporary, f"{folder}/{name}")
            except BaseException:
                Path(temporary).unlink(missing_ok=True)
                raise
        except OSError as error:
            raise StorageError(f"{folder}/{name}: cannot be written: {error.strerror}") from error

    def _make_folder(self, folder: str) -> None:
        if folder not in self._known_folders:
            os.makedirs(folder, exist_ok=True)
            self._known_folders.add(folder)

    def delete(self, keys: Iterable[str]) -> None:
        """Delete the files under ``keys``; raises StorageError."""
        for key in keys:
            path = self._path(key)
            try:
                path.unlink()
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise StorageError(f"{path}: cannot be deleted: {error.strerror}") from error

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
    def exclusive(self, break_stale: bool = False) -> Iterator["BuildClaim"]:
        """Keep other builds out of the store as long as the block lasts.

        The lock is the kernel's (``flock``), so it ends with the process however that ends, and there is never one to break. Its
        file stays, unlocked, while prefixes are announced. Makes the directory if there is none, and removes it again if
        nothing was put in. Raises StorageError if another build is at work or the directory cannot be made.
        """
        path = self._root / CLAIM_NAME
        try:
            made = [folder for folder in (self._root, *self._root.parents) if not folder.exists()]
            self._root.mkdir(parents=True, exist_ok=True)
            descriptor = open_locked(path, lambda taken: _refusal(self.location, _read_note(taken), break_stale))
        except (FileExistsError, NotADirectoryError):
            raise StorageError(f"{self._root}: a file is in the way, or a link that leads nowhere; choose another folder") from None
        except OSError as error:
            # A lock that another user's build left may be theirs alone, in a folder that is everybody's.
            where = path if os.path.lexists(path) else self._root
            raise StorageError(f"{where}: cannot be written: {error.strerror}") from error
        claim = BuildClaim(descriptor, path)
        try:
            claim.announce(*claim.abandoned)
            for prefix in claim.abandoned:
                self.delete_temporaries(prefix)
            yield claim
        finally:
            if not claim.announced:
                path.unlink(missing_ok=True)
            os.close(descriptor)
            with suppress(OSError):
                for folder in made:
                    folder.rmdir()

    def delete_temporaries(self, prefix: str) -> None:
        """Delete the half-written files that killed processes left below ``prefix``; nobody may be writing there."""
        for parent, _, names in os.walk(self._path(prefix)):
            for name in names:
                if name.startswith(_TEMPORARY):
                    Path(parent, name).unlink(missing_ok=True)


class BuildClaim:
    """A build's hold on a directory. Its file says who holds it and which prefixes are being written or deleted.

    So the build after one that was killed or failed knows exactly what was left behind: what it may go on with, or delete.
    """

    def __init__(self, descriptor: int, path: Path) -> None:
        self._descriptor, self._path = descriptor, path
        left = _read_note(descriptor)
        self.abandoned = () if left is None else left.prefixes
        self.predecessor = left.left_by() if left is not None and left.prefixes else None
        self._note = replace(ClaimNote.mine(), prefixes=self.abandoned)

    @property
    def announced(self) -> tuple[str, ...]:
        """The prefixes announced last."""
        return self._note.prefixes

    def announce(self, *prefixes: str) -> None:
        """Write down the prefixes that are no dataset's until the build has ended; raises StorageError."""
        note = replace(self._note, prefixes=prefixes)
        text = note.dump()
        try:
            # Over the old note, then cut off: a build that is killed in between leaves the new one whole, which is its first line.
            written = os.pwrite(self._descriptor, text, 0)
            os.ftruncate(self._descriptor, written)
            # Or a power cut could leave blocks that nobody remembers.
            os.fsync(self._descriptor)
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written: {error.strerror}") from error
        if written < len(text):
            raise StorageError(f"{self._path}: cannot be written: only {written} of {len(text)} bytes could be")
        self._note = note

    def confirm(self) -> None:
        """Do nothing: nobody but the kernel can end the hold, and only with the process."""


def _refusal(location: str, note: ClaimNote | None, break_stale: bool) -> StorageError | None:
    """Return the error for a build that comes second; None if the first was killed, and the processes it had started are ending."""
    return None if note is not None and note.is_gone else StorageError(_at_work(location, note, break_stale))


def _at_work(location: str, note: ClaimNote | None, break_stale: bool) -> str:
    """Return the sentence for a build that comes second."""
    if note is None:
        return f"{location}: another build is writing here; wait until it has ended"
    sentence = f"{location}: another build is writing here ({note.at_work()}); "
    if note.elsewhere:
        return (
            f"{sentence}wait until it has ended, or end it on {note.machine}: the lock goes with the process, or when the file server "
            f"gives {note.machine} up"
        )
    if break_stale:
        return f"{sentence}the lock of a folder ends with its process, so it is at work: wait until it has ended, or end it"
    return f"{sentence}wait until it has ended"


def _read_note(descriptor: int) -> ClaimNote | None:
    """Return the note in a claim's file, None if it is not one."""
    return ClaimNote.parse(os.pread(descriptor, MAX_CLAIM_BYTES, 0))
