"""Files that one process at a time may write: the lock is the kernel's (``flock``), so it ends with the process however that ends."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from schemas.errors import StorageError


def open_locked(path: Path, refusal: Callable[[int], StorageError]) -> int:
    """Return a descriptor of the file at ``path``, made if need be, which is locked as long as it is open.

    If another process has the lock, raises what ``refusal`` makes of a descriptor of the file. Raises OSError.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            error = refusal(descriptor)
            os.close(descriptor)
            raise error from None
        if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
        os.close(descriptor)  # its owner renamed or removed it between our opening and locking it
