"""Whether source files have changed, as far as the file system knows: size and time of change, to the nanosecond."""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from schemas.errors import InputError
from schemas.manifest import digest
from schemas.region import Rect
from tiler.sources import FileInfo

_SIDECARS: Final = (".msk", ".aux.xml")
"""Files that GDAL reads beside one of a mosaic: a mask, and nodata or georeference."""
_MARGIN: Final = 512
"""What fills voids or enhances details looks beyond the window it is asked for [px]; more than any of them."""


def stamp_file(path: Path, others: Iterable[Path] = ()) -> str:
    """Return the state of a source file, its sidecars and the ``others`` that it needs; raises InputError if the file is gone."""
    found = []
    sidecars = {path.with_name(path.name + suffix) for suffix in _SIDECARS}
    for each in (path, *sorted(sidecars | set(others))):
        try:
            state = each.stat()
        except OSError as error:
            if each == path:
                raise InputError(f"{path}: is gone, or cannot be reached any more: {error.strerror}") from error
            continue
        found.append(f"{state.st_size}:{state.st_mtime_ns}")
    return " ".join(found)


class SourceStamps:
    """The state of all files of a source, taken once, and of those that a window of it touches."""

    def __init__(self, info: FileInfo) -> None:
        self._parts = [(part.path, part.window) for part in info.parts] or [(info.path, info.rect)]
        self._others = info.files
        self.stamps = self._taken()

    def _taken(self) -> list[str]:
        known = {path: stamp_file(path, self._others) for path in {path for path, _ in self._parts}}
        return [known[path] for path, _ in self._parts]

    @property
    def paths(self) -> list[str]:
        """The absolute paths of all files."""
        return [str(path.absolute()) for path, _ in self._parts]

    def of(self, window: Rect) -> str:
        """Return the digest of the state of the files under a window of the source, and of their places in it."""
        seen = window.grown(_MARGIN)
        touching = [f"{where} {stamp}" for (_, where), stamp in zip(self._parts, self.stamps, strict=True) if seen & where]
        return digest("\n".join(touching).encode())

    def require_unchanged(self) -> None:
        """Raise InputError if a file has changed since its state was taken: what was read of it may be neither old nor new."""
        for (path, _), before, now in zip(self._parts, self.stamps, self._taken(), strict=True):
            if before != now:
                raise InputError(f"{path}: was changed while it was read; run the same command again when it is complete")
