"""Reading a scene from a file."""

from pathlib import Path
from typing import Final

from schemas.errors import InputError, NotFoundError, StorageError
from schemas.scene import Scene, parse_scene

_MAX_BYTES: Final = 1 << 20


def read_scene(name: str) -> Scene:
    """Return the scene that a file says; raises NotFoundError, StorageError or InputError."""
    path = Path(name)
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise NotFoundError(f"{name}: no such file; clipmap plan --example prints a scene to start from") from None
    except (OSError, ValueError) as error:
        raise StorageError(f"{name!r}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(content) > _MAX_BYTES:
        raise InputError(f"{name}: is larger than {_MAX_BYTES >> 20} MiB, so it is no scene")
    try:
        return parse_scene(content.decode("utf-8"), name)
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: is not UTF-8 text, so it is no scene") from error
