"""Several georeferenced files as one: later ones on top, and what is void in one shows what lies below."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from schemas.region import Rect
from tiler.sources import FileInfo, Part, Pixels, Reader
from tiler.sources.files import open_file
from tiler.sources.grid import Arrangement, Placement, arrange
from tiler.sources.overlay import Form, Layerer, Opacity, common_form, from_warp, lay, to_warp
from tiler.sources.pool import ReaderPool
from tiler.sources.warped import CHUNK_ROWS, Kernel, Values, Warp

_MAX_CHUNK_ROWS: Final = 512


def open_mosaic(
    paths: Sequence[Path],
    scratch: Path | None,
    max_samples: int,
    nodata: float | None = None,
    kernel: Kernel | None = None,
    encoded: bool = False,
) -> Reader:
    """Open georeferenced files as one reader over all that they cover, on the grid of the first file.

    Files that share its grid are copied sample for sample; others are resampled with ``kernel``: by default ``bilinear`` for one
    channel with a sign or a fraction, which is a height, and ``cubic`` for the rest. ``nodata`` replaces what the files declare.
    ``encoded`` says that colours encode heights: then files off the grid are refused. What no file covers is void. Only headers are
    read; without ``scratch``, nothing else of files that are decoded as a whole can be had.

    Raises UsageError without files, InputError if one cannot be opened or placed, if they do not go together, or if all of it is
    more samples than ``max_samples``.
    """
    if not paths:
        raise UsageError("a mosaic needs one file at least; name the files after clipmap build")
    infos = [_header(path, max_samples) for path in paths]
    form = common_form(infos)
    arrangement = arrange(infos)
    _check_size(infos, form, arrangement, max_samples)
    if encoded:
        _refuse_resampling(infos, arrangement)
    return MosaicReader(ReaderPool(infos, scratch, max_samples), infos, form, arrangement, nodata, kernel or _kernel(form))


def _header(path: Path, max_samples: int) -> FileInfo:
    """Return what a file declares; nothing is decoded or held open."""
    reader = open_file(path, None, max_samples)
    reader.close()
    return reader.info


def _kernel(form: Form) -> Kernel:
    """Heights must not overshoot at cliffs and coasts; pictures would be blurred by half of their finest details."""
    return "bilinear" if form.colours == 1 and form.dtype.kind in "if" else "cubic"


def _check_size(infos: Sequence[FileInfo], form: Form, arrangement: Arrangement, max_samples: int) -> None:
    channels = form.colours + form.alpha
    samples = arrangement.width * arrangement.height * channels
    if samples == 0:
        raise InputError(f"{infos[0].path}: the files of the mosaic are all smaller than a pixel of it; give the finest one first")
    if samples > max_samples:
        home = arrangement.placements[0].rect
        far = max(arrangement.placements, key=lambda place: abs(place.rect.x0 - home.x0) + abs(place.rect.y0 - home.y0))
        raise InputError(
            f"{infos[0].path} and {len(infos) - 1} more span {arrangement.width} x {arrangement.height} x {channels} = {samples} samples, "
            f"more than {max_samples}; leave out what is far away, such as {infos[far.number].path}, or give --max-samples {samples}"
        )


def _refuse_resampling(infos: Sequence[FileInfo], arrangement: Arrangement) -> None:
    for place in arrangement.placements:
        if not place.exact:
            raise InputError(
                f"{infos[place.number].path}: is not on the grid of {infos[0].path}, and heights hidden in colour cannot be resampled; "
                "decode it first, or build it on its own"
            )


def _part(info: FileInfo, place: Placement, arrangement: Arrangement, kernel: Kernel) -> Part:
    how = "" if place.exact else f"{kernel} of {info.georeference} onto {arrangement.grid} after {place.turns} turns"
    return Part(info.path, place.rect & Rect(0, 0, arrangement.width, arrangement.height), info.files, how)


class MosaicReader:
    """Windows of all files of a mosaic, from any thread; only files that a window meets are opened."""

    def __init__(
        self, pool: ReaderPool, infos: Sequence[FileInfo], form: Form, arrangement: Arrangement, nodata: float | None, kernel: Kernel
    ) -> None:
        self._pool, self._form, self._kernel = pool, form, kernel
        self._placements = arrangement.placements
        self._rects = np.array([[p.rect.x0, p.rect.y0, p.rect.x1, p.rect.y1] for p in self._placements], np.int64)
        self._layerers = [Layerer(info, form, nodata) for info in infos]
        self._opaque = [place.exact and self._layerers[place.number].opaque for place in self._placements]
        self._warps = {
            number: Warp(
                infos[place.number],
                arrangement.grid.shifted(-place.turns * arrangement.turn_px, 0),
                place.rect,
                kernel,
                self._values_of(place.number),
            )
            for number, place in enumerate(self._placements)
            if not place.exact
        }
        self.info = self._described(infos, arrangement)

    def _described(self, infos: Sequence[FileInfo], arrangement: Arrangement) -> FileInfo:
        form, first = self._form, infos[0]
        whole = Rect(0, 0, arrangement.width, arrangement.height)
        complete = all(self._opaque) and _is_covered(whole, self._rects)
        chunks = {info.chunk_rows for info in infos} | ({CHUNK_ROWS} if self._warps else set())
        assert first.georeference is not None, "files without one are not arranged"
        return FileInfo(
            path=first.path,
            format="mosaic",
            width=whole.width,
            height=whole.height,
            channels=form.colours + form.alpha,
            dtype=form.dtype,
            file_bytes=sum(info.file_bytes for info in infos),
            layout="tiled",
            chunk_rows=min(max(chunks), _MAX_CHUNK_ROWS),
            alpha=form.colours if form.alpha else None,
            premultiplied=form.premultiplied,
            has_mask=not form.alpha and not complete,
            georeference=type(first.georeference)(first.georeference.crs, first.georeference.unit, arrangement.grid.transform),
            bits=form.bits,
            parts=tuple(_part(infos[place.number], place, arrangement, self._kernel) for place in self._placements),
        )

    def read(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        """Return pixels (rows, columns, channels), 0 where void, and mask, None if nothing of the mosaic is void.

        Raises InputError naming the file that cannot be read.
        """
        form = self._form
        colours, opacity = self._composed(window)
        if form.alpha:
            return np.concatenate([colours, opacity[..., np.newaxis]], axis=-1), None
        return colours, opacity if self.info.has_mask else None

    def _composed(self, window: Rect) -> tuple[Pixels, Opacity]:
        form, met = self._form, self._met(window)
        if len(met) == 1 and self._placements[met[0]].rect.contains(window):
            return self._layer(met[0], window)
        colours = np.zeros((window.height, window.width, form.colours), form.dtype)
        opacity = np.zeros((window.height, window.width), form.opacity_dtype)
        for number in met:
            area = window & self._placements[number].rect
            here = np.s_[area.y0 - window.y0 : area.y1 - window.y0, area.x0 - window.x0 : area.x1 - window.x0]
            upper, upper_opacity = self._layer(number, area)
            if self._opaque[number]:
                colours[here], opacity[here] = upper, form.full
            else:
                lay(colours[here], opacity[here], upper, upper_opacity, form)
        return colours, opacity

    def _met(self, window: Rect) -> list[int]:
        """Return the placements that show in ``window``, lowest first; files that others hide there are not read."""
        x0, y0, x1, y1 = self._rects.T
        numbers = np.flatnonzero((x0 < window.x1) & (x1 > window.x0) & (y0 < window.y1) & (y1 > window.y0)).tolist()
        hiding = [at for at, number in enumerate(numbers) if self._opaque[number] and self._placements[number].rect.contains(window)]
        return numbers[hiding[-1] :] if hiding else numbers

    def _layer(self, number: int, area: Rect) -> tuple[Pixels, Opacity]:
        place: Placement = self._placements[number]
        if not place.exact:
            return from_warp(self._warps[number].read(area), self._form)
        return self._read_file(place.number, area.shifted(-place.rect.x0, -place.rect.y0))

    def _read_file(self, number: int, window: Rect) -> tuple[Pixels, Opacity]:
        with self._pool.use(number) as reader:
            return self._layerers[number](*reader.read(window))

    def _values_of(self, number: int) -> Callable[[Rect], Values]:
        def read(window: Rect) -> Values:
            return to_warp(*self._read_file(number, window), self._form)

        return read

    def close(self) -> None:
        """Close all files."""
        self._pool.close()


def _is_covered(whole: Rect, rects: NDArray[np.int64]) -> bool:
    """Whether rectangles (n, 4) leave no pixel of ``whole`` uncovered: looked at in the strips between their upper and lower edges."""
    x0, y0, x1, y1 = rects.T
    edges = np.unique(np.clip(np.concatenate([y0, y1, [whole.y0, whole.y1]]), whole.y0, whole.y1))
    order = np.argsort(x0, kind="stable")
    for top in edges[:-1]:
        there = order[(y0[order] <= top) & (y1[order] > top)]
        ends = np.maximum.accumulate(np.concatenate([[whole.x0], x1[there]]))
        if ends[-1] < whole.x1 or (x0[there] > ends[:-1]).any():
            return False
    return True
