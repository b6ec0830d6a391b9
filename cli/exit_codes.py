"""Exit codes, and which error ends in which."""

from typing import Final

from schemas.errors import ClipmapError, InputError, MissingExtraError, NotFoundError, StorageError, UsageError

DONE: Final = 0
FOUND: Final = 1
"""A check found something wrong."""
USAGE: Final = 2
BAD_INPUT: Final = 3
STORAGE: Final = 4
INTERRUPTED: Final = 130

_CODES: Final[tuple[tuple[type[ClipmapError], int], ...]] = (
    (UsageError, USAGE),
    (MissingExtraError, USAGE),
    (InputError, BAD_INPUT),
    (NotFoundError, BAD_INPUT),
    (StorageError, STORAGE),
)


def exit_code(error: ClipmapError) -> int:
    """Return the process's exit code for ``error``."""
    return next((code for kind, code in _CODES if isinstance(error, kind)), BAD_INPUT)
