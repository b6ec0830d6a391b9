"""The beginning and the end of a process that runs one command: what Python and libraries do then that a command needs not wait for.

Only ``main`` uses this: who imports clipmap into a program of his own finds nothing changed. What each line saves was measured on
``clipmap build`` of 512 x 512 RGB, which took 1.17 s without them (docs/PERFORMANCE.md).
"""

import atexit
import gc
import os
import sys
from typing import Final

_GC_THRESHOLDS: Final = (20_000, 20, 50)
"""Python looks for garbage after every 700 objects, which imports make by the hundred thousand, and none of them is garbage: 60 ms."""


def start_lean() -> None:
    """Keep Python and libraries from work at the start of a process that no command needs."""
    gc.set_threshold(*_GC_THRESHOLDS)
    # rasterio imports boto3 where it is installed, to sign requests of GDAL, which is given no URLs here: 100 ms.
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]  # None makes the import fail, which rasterio expects
    # NumPy's linear algebra, of which nothing here makes use, would start a thread per processor that first spins: 1 % of a build.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Else pydantic reads the entry points of everything that is installed: 15 ms.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


class QuickEnd:
    """Ends the process without taking apart what its memory holds, which takes Python 0.25 s after a build and changes nothing.

    It is the last of the functions that run at exit, as it is registered first: by then threads have ended, and whatever
    libraries do at exit in Python is done. Files that a command writes are closed, synchronised and renamed long before.
    """

    def __init__(self) -> None:
        self._code: int | None = None
        atexit.register(self._end)

    def with_code(self, code: int) -> int:
        """Note that the command has ended, with an exit code, and return it; without this Python ends as ever, e.g. by a traceback."""
        self._code = code
        return code

    def _end(self) -> None:
        if self._code is None or sys.gettrace() or sys.getprofile():
            return
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):  # Python knows what to say, and which code to exit with
            return
        os._exit(self._code)
