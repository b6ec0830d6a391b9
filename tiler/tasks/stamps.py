"""Whether source files have changed, as far as the file system knows: which file, its size, and its time of change to the nanosecond."""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from schemas.errors import InputError
from schemas.manifest import digest
from schemas.region import Rect
from tiler.sources import FileInfo, Part

_SIDECARS: Final = (".msk", ".aux.xml")
"""Files that GDAL reads beside the one that is named, if they are there: a mask, and nodata or georeference."""
_MARGIN: Final = 512
"""What fills voids or enhances details looks beyond the window it is asked for [px]; more than any of them."""


def stamp_file(path: Path, others: Iterable[Path] = ()) -> str:
    """Return the state of a source file, its sidecars and the ``others`` that it needs; raises InputError if the file is gone.

    Its path is part of it: other files of the same size are common (all tiles of an elevation model are), and so are equal times.
    """
    found = []
    sidecars = {path.with_name(path.name + suffix) for suffix in _SIDECARS}
    for each in (path, *sorted(sidecars | set(others))):
        try:
            state = each.stat()
        except OSError as error:
            if each == path:
                raise InputError(f"{path}: is gone, or cannot be reached any more: {error.strerror}") from error
            continue
        found.append(f"{each.absolute()} {state.st_size} {state.st_mtime_ns}")
    return "\n".join(found)


class SourceStamps:
    """The state of all files of a source, taken once, and of those that a window of it touches."""

    def __init__(self, info: FileInfo) -> None:
        self._parts = info.parts or (Part(info.path, info.rect, info.files),)
        self._rects = np.array([[part.window.x0, part.window.y0, part.window.x1, part.window.y1] for part in self._parts], np.int64)
        self.stamps = self._taken()

    def _taken(self) -> list[str]:
        known = {part.path: stamp_file(part.path, part.files) for part in self._parts}
        return [f"{known[part.path]}{part.how}" for part in self._parts]

    @property
    def paths(self) -> list[str]:
        """The absolute paths of all files; one that lies on the lattice twice is named twice."""
        return [str(part.path.absolute()) for part in self._parts]

    def of(self, window: Rect) -> str:
        """Return the digest of the state of the files under a window of the source, and of their places in it."""
        seen = window.grown(_MARGIN)
        left, top, right, bottom = self._rects.T
        met = np.flatnonzero((left < seen.x1) & (right > seen.x0) & (top < seen.y1) & (bottom > seen.y0))
        return digest("\n".join(f"{self._parts[number].window} {self.stamps[number]}" for number in met).encode())

    def require_unchanged(self) -> None:
        """Raise InputError if a file has changed since its state was taken: what was read of it may be neither old nor new."""
        for part, before, now in zip(self._parts, self.stamps, self._taken(), strict=True):
            if before != now:
                raise InputError(f"{part.path}: was changed while it was read; run the same command again when it is complete")
