"""Files that one process at a time may write: the lock is the kernel's (``flock``), so it ends with the process however that ends."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from typing import Final

from schemas.errors import StorageError

_PATIENCE_S: Final = 10.0
_LOOK_S: Final = 0.02


def open_locked(path: Path, refusal: Callable[[int], StorageError | None]) -> int:
    """Return a descriptor of the file at ``path``, made if need be, which is locked as long as it is open.

    If another process has the lock, raises what ``refusal`` makes of a descriptor of the file; if that is None, the lock is about to
    be free, and is waited for for 10 s at most. Raises OSError.
    """
    deadline_s = monotonic() + _PATIENCE_S
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            error = refusal(descriptor)
            os.close(descriptor)
            if error is not None:
                raise error from None
            if monotonic() > deadline_s:
                raise StorageError(f"{path}: is locked by what a killed process has left running; end that, or wait") from None
            sleep(_LOOK_S)
            continue
        if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
        os.close(descriptor)  # its owner renamed or removed it between our opening and locking it
