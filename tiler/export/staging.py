"""Exports appear under their name only when they are whole: written beside it under a hidden name, then renamed."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from schemas.errors import StorageError, UsageError

PREFIX: Final = ".tmp-"


def require_free(target: Path, overwrite: bool) -> None:
    """Raise UsageError if there is something at ``target`` that must not be replaced, StorageError if its folder does not exist."""
    if not target.parent.is_dir():
        raise StorageError(f"{target}: there is no folder {target.parent}; make it first, or choose another")
    if target.is_dir():
        raise UsageError(f"{target}: is a folder; give the name of a file to write with -o")
    if not overwrite and os.path.lexists(target):
        raise UsageError(f"{target}: exists already; add --overwrite to replace it, or choose another name")


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Give the path of an empty file to write, which replaces ``target`` when the block ends well and is removed when it does not.

    What a killed export left is written over by the next one. Raises StorageError if another export is writing there, or if the
    disk is full or the folder cannot be written; an OSError inside the block becomes one.
    """
    temporary = target.with_name(f"{PREFIX}{target.name}")
    with storage_errors(target):
        descriptor = _locked(temporary, target)
        try:
            os.ftruncate(descriptor, 0)
            yield temporary
            os.fsync(descriptor)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)


def _locked(temporary: Path, target: Path) -> int:
    """Return the descriptor of the file at ``temporary``, made if need be, which this process alone may write."""
    while True:
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise StorageError(f"{target}: another export is writing it; wait until it has ended") from None
        if temporary.exists() and os.path.samestat(os.fstat(descriptor), temporary.stat()):
            return descriptor
        os.close(descriptor)  # its owner renamed it between our opening and locking it


@contextmanager
def storage_errors(target: Path) -> Iterator[None]:
    """Turn an OSError of writing ``target`` into a StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
