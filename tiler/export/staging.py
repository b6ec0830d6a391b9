"""Exports appear under their name only when they are whole: written beside it under a hidden name, then renamed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from schemas.errors import StorageError, UsageError
from tiler.stores.filelock import open_locked

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
        descriptor = open_locked(temporary, lambda taken: StorageError(f"{target}: another export is writing it; wait until it has ended"))
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


@contextmanager
def storage_errors(target: Path) -> Iterator[None]:
    """Turn an OSError of writing ``target`` into a StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
