"""Samples of a file on a lattice of another projection, spacing or rotation, through rasterio's WarpedVRT.

GDAL chooses some things by the window it is given: how far its kernel reaches when samples become coarser, and which datum shift
holds. Both are fixed here for the whole file, and samples are computed in chunks that are always cut the same way, so a sample
does not depend on the window it is read with.
"""

from collections.abc import Callable, Iterator
from math import hypot, inf
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform as reproject

from schemas.errors import InputError
from schemas.region import Rect
from tiler.sources import FileInfo
from tiler.sources.grid import Floats, Grid, grid_of, same_system

Kernel = Literal["bilinear", "cubic"]
Values = NDArray[Any]
"""Colours (rows, columns, channels) and one more channel, opacity from 0 to 255, in float32 or float64."""

CHUNK_COLUMNS: Final = 512
CHUNK_ROWS: Final = 256
_SOURCE_LIMIT_PX: Final = 1 << 21
"""Pixels of the file that are read for one chunk; a chunk that needs more, because the file is much finer, is cut into four."""
_TOLERANCE_PX: Final = 1e-4
"""How far transformed positions may be interpolated. rasterio 1.4 fails with 0; 1e-6 takes 1.7 times as long."""
_WIDENED_PX: Final = 1.5
"""Pixels of the file for one sample from which on kernels widen against aliasing. GDAL's widened bilinear kernel moves a plane by up
to 0.07 pixels, so it is left alone for what is nearly as fine as the lattice."""
_PROBES: Final = 17
_MARGIN_PX: Final = 3
"""Beyond the centres that are interpolated, times how far kernels widen: 2 for the cubic kernel, 1 for rounding."""
_WORLD: Final = "-180,-90,180,90"
_ANY_PLANE: Final = "EPSG:3857"
"""Stands for an unknown system when both sides have the same: then coordinates are not transformed at all."""


class Warp:
    """How one file comes onto a lattice.

    ``rect`` is what it covers there; ``read`` returns float32 or float64 values of a window of the file.
    """

    def __init__(self, info: FileInfo, target: Grid, rect: Rect, kernel: Kernel, read: Callable[[Rect], Values]) -> None:
        self._info, self._own, self._target, self._rect, self._read = info, grid_of(info), target, rect, read
        self._kernel = Resampling[kernel]
        self._same = same_system(self._own.crs, target.crs)
        self._scales: tuple[float, float] | None = None

    def read(self, window: Rect) -> Values:
        """Return values of ``window`` of the lattice, which lies in the file's rectangle; raises InputError if they cannot be had."""
        found: Values | None = None
        for chunk in _chunks(window):
            whole = chunk & self._rect
            values = self._warped(whole)
            if found is None:
                found = np.zeros((window.height, window.width, values.shape[2]), values.dtype)
            part = whole & window
            found[part.y0 - window.y0 : part.y1 - window.y0, part.x0 - window.x0 : part.x1 - window.x0] = values[
                part.y0 - whole.y0 : part.y1 - whole.y0, part.x0 - whole.x0 : part.x1 - whole.x0
            ]
        assert found is not None, "windows are not empty"
        return found

    def _warped(self, chunk: Rect) -> Values:
        needed = self._needed(chunk)
        if not needed:
            return self._read(Rect(0, 0, 1, 1))[:1, :1].repeat(chunk.height, axis=0).repeat(chunk.width, axis=1) * 0
        if needed.area > _SOURCE_LIMIT_PX:
            return self._in_quarters(chunk)
        try:
            return self._resampled(self._read(needed), needed, chunk)
        except (RasterioError, CPLE_BaseError, MemoryError) as error:
            reason = " ".join(str(error.__cause__ or error).split()) or "no reason given"
            raise InputError(f"{self._info.path}: cannot be brought into {self._target.crs}: {reason}") from error

    def _in_quarters(self, chunk: Rect) -> Values:
        if chunk.area == 1:
            raise InputError(f"{self._info.path}: is too fine for this mosaic; make it coarser first, e.g. with gdalwarp -tr")
        x, y = (chunk.x0 + chunk.x1 + 1) // 2, (chunk.y0 + chunk.y1 + 1) // 2
        rows = []
        for y0, y1 in ((chunk.y0, y), (y, chunk.y1)):
            parts = [Rect(x0, y0, x1, y1) for x0, x1 in ((chunk.x0, x), (x, chunk.x1))]
            if warped := [self._warped(part) for part in parts if part]:
                rows.append(np.concatenate(warped, axis=1))
        return np.concatenate(rows, axis=0)

    def _resampled(self, values: Values, needed: Rect, chunk: Rect) -> Values:
        bands = values.shape[2]
        scales = self._scales = self._scales or self._coarsening()
        profile = {"driver": "GTiff", "width": needed.width, "height": needed.height, "count": bands, "dtype": values.dtype.name}
        with MemoryFile() as memory:
            with memory.open(**profile, crs=self._own.crs or _ANY_PLANE, transform=_affine(self._own, needed)) as file:
                file.colorinterp = [ColorInterp.gray] + [ColorInterp.undefined] * (bands - 2) + [ColorInterp.alpha]
                file.write(np.moveaxis(values, -1, 0))
            with (
                memory.open() as file,
                WarpedVRT(
                    file,
                    crs=self._target.crs or _ANY_PLANE,
                    transform=_affine(self._target, chunk),
                    width=chunk.width,
                    height=chunk.height,
                    resampling=self._kernel,
                    tolerance=_TOLERANCE_PX,
                    XSCALE=scales[0],
                    YSCALE=scales[1],
                    AREA_OF_INTEREST=_WORLD,
                ) as warped,
            ):
                return np.moveaxis(warped.read(), 0, -1)

    def _needed(self, chunk: Rect) -> Rect:
        """Return the window of the file that ``chunk`` is interpolated from; empty if it lies beside the file."""
        columns, rows = self._probes(chunk)
        finite = np.isfinite(columns) & np.isfinite(rows)
        if not finite.any():
            return Rect(0, 0, 0, 0)
        reaches = 1 / np.array(self._scales or self._coarsening())
        (x0, x1), (y0, y1) = (
            (float(np.min(at[finite])) - margin, float(np.max(at[finite])) + margin)
            for at, margin in ((at, _MARGIN_PX * reach + _bulge(at, finite)) for at, reach in zip((columns, rows), reaches, strict=True))
        )
        return _whole(x0, y0, x1, y1) & self._info.rect

    def _probes(self, chunk: Rect) -> tuple[Floats, Floats]:
        """Return positions in the file of points all over ``chunk`` (17, 17); infinite where there is no place for them."""
        across, down = np.meshgrid(np.linspace(chunk.x0, chunk.x1, _PROBES), np.linspace(chunk.y0, chunk.y1, _PROBES))
        xs, ys = self._target.coordinates(across, down)
        if not self._same:
            found = _coordinates(str(self._target.crs), str(self._own.crs), xs.ravel(), ys.ravel())
            xs, ys = (values.reshape(xs.shape) for values in found)
        with np.errstate(invalid="ignore"):
            return self._own.positions(xs, ys)

    def _coarsening(self) -> tuple[float, float]:
        """Return lattice samples per pixel of the file along its columns and rows, at its centre, 1 at most: how far kernels widen."""
        x, y = (self._rect.x0 + self._rect.x1) // 2, (self._rect.y0 + self._rect.y1) // 2
        columns, rows = self._probes(Rect(x, y, x + 1, y + 1))
        last = _PROBES - 1
        steps = (hypot(float(at[0, last] - at[0, 0]), float(at[last, 0] - at[0, 0])) for at in (columns, rows))
        across, down = (1 / step if _WIDENED_PX < step < inf else 1.0 for step in steps)
        return across, down


def _coordinates(source: str, target: str, xs: Floats, ys: Floats) -> Floats:
    """Return coordinates (2, n) of ``source`` in ``target``, infinite where they have no place there."""
    try:
        found = reproject(source, target, xs, ys)
    except (RasterioError, CPLE_BaseError):
        # One place that has none spoils all of a call.
        if xs.size == 1:
            return np.full((2, 1), np.inf)
        half = xs.size // 2
        return np.concatenate([_coordinates(source, target, xs[part], ys[part]) for part in (slice(half), slice(half, None))], axis=1)
    return np.array(found)


def _bulge(positions: Floats, finite: NDArray[np.bool_]) -> float:
    """Return how far positions between probes may lie outside of the probes' box: an eighth of the curve, or a step at an edge."""
    known = np.where(finite, positions, np.nan)
    if not finite.all():
        steps = np.concatenate([np.abs(np.diff(known, axis=axis)).ravel() for axis in (0, 1)])
        return float(np.nanmax(steps)) if np.isfinite(steps).any() else 0.0
    curves = [np.abs(np.diff(known, n=2, axis=axis)).max() for axis in (0, 1)]
    return float(max(curves)) / 8


def _whole(x0: float, y0: float, x1: float, y1: float) -> Rect:
    limit = 2.0**40
    low_x, low_y, high_x, high_y = np.clip([x0, y0, x1, y1], -limit, limit)
    return Rect(int(np.floor(low_x)), int(np.floor(low_y)), int(np.ceil(high_x)), int(np.ceil(high_y)))


def _affine(grid: Grid, window: Rect) -> Affine:
    return Affine(*grid.shifted(window.x0, window.y0).transform)


def _chunks(window: Rect) -> Iterator[Rect]:
    """Yield the chunks that meet ``window``; they are counted from the lattice's first pixel."""
    for y in range(window.y0 // CHUNK_ROWS, -(-window.y1 // CHUNK_ROWS)):
        for x in range(window.x0 // CHUNK_COLUMNS, -(-window.x1 // CHUNK_COLUMNS)):
            yield Rect(x * CHUNK_COLUMNS, y * CHUNK_ROWS, (x + 1) * CHUNK_COLUMNS, (y + 1) * CHUNK_ROWS)
