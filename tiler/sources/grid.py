"""Where georeferenced files lie on one lattice of pixels, and which of them share its grid.

Positions are (column, row) of pixel corners on the grid of the first file, so they may be negative and need not be whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import hypot, isfinite, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import CRSError

from schemas.errors import InputError
from schemas.manifest import Transform
from schemas.region import Rect
from tiler.geodesy import transformed
from tiler.sources import FileInfo, Georeference

Floats = NDArray[np.float64]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom [pixels]."""

_SPACING_TOLERANCE: Final = 1e-6
"""Largest relative difference of equal spacings; 0.000277778 degrees written for 1/3600 is off by 8e-7."""
_OFFSET_TOLERANCE_PX: Final = 1e-3
_EDGE_POINTS: Final = 64
"""Points of an edge that are transformed: its bulge between them is 1 / 4096 of that of the whole edge."""
_FARTHEST_PX: Final = 2.0**40
_WEB_MERCATOR: Final = "EPSG:3857"
_EARTH_RADIUS_M: Final = 6378137.0
"""Of the sphere that web Mercator unrolls."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A lattice of pixels: its coordinate system and the transform from pixel corners to coordinates."""

    crs: str | None
    transform: Transform

    def shifted(self, columns: float, rows: float) -> "Grid":
        """Return the same pixels, counted from ``columns`` and ``rows`` on."""
        a, b, c, d, e, f = self.transform
        return Grid(self.crs, (a, b, c + a * columns + b * rows, d, e, f + d * columns + e * rows))

    def coordinates(self, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
        """Return coordinates of positions."""
        a, b, c, d, e, f = self.transform
        return a * columns + b * rows + c, d * columns + e * rows + f

    def positions(self, xs: Floats, ys: Floats) -> tuple[Floats, Floats]:
        """Return positions of coordinates."""
        a, b, c, d, e, f = self.transform
        determinant = a * e - b * d
        return (e * (xs - c) - b * (ys - f)) / determinant, (a * (ys - f) - d * (xs - c)) / determinant


@dataclass(frozen=True, slots=True)
class Placement:
    """A file on the lattice: its number, the pixels it covers, whether its samples are the lattice's, and turns round the Earth.

    With ``turns``, the file shows where its coordinates lie after so many times 360 degrees were added to them.
    """

    number: int
    rect: Rect
    exact: bool
    turns: int


@dataclass(frozen=True, slots=True)
class Arrangement:
    """Files on one lattice: ``grid`` counts from the top-left pixel of all; ``turn_px`` is once round the Earth, 0 if not known."""

    grid: Grid
    width: int
    height: int
    turn_px: float
    placements: tuple[Placement, ...]


@cache
def same_system(one: str | None, other: str | None) -> bool:
    """Whether two coordinate systems are the same, however they are written."""
    if one == other or one is None or other is None:
        return one == other
    try:
        return bool(CRS.from_user_input(one) == CRS.from_user_input(other))
    except CRSError:
        return False


def grid_of(info: FileInfo) -> Grid:
    """Return the grid of a file's pixels; raises InputError if it does not say where it lies."""
    georeference: Georeference | None = info.georeference
    if georeference is None:
        raise InputError(f"{info.path}: has no georeference, so it has no place in a mosaic; add one with gdal_edit.py -a_srs -a_ullr")
    return Grid(georeference.crs, georeference.transform)


def arrange(infos: Sequence[FileInfo]) -> Arrangement:
    """Place files on the grid of the first one; raises InputError if one of them cannot be placed there."""
    grid = grid_of(infos[0])
    turn_px = _turn_px(grid)
    boxes = [_box(info, grid, infos[0], turn_px) for info in infos]
    turns = [0] * len(boxes)
    left, right = min(box[0] for box in boxes), max(box[2] for box in boxes)
    if turn_px:
        turns = _gathered(boxes, turn_px)
        left = min(box[0] + turn * turn_px for box, turn in zip(boxes, turns, strict=True))
        right = max(box[2] + turn * turn_px for box, turn in zip(boxes, turns, strict=True))
        if right - left > turn_px + 0.5:
            left = _seam(boxes, grid, turn_px)
            right = left + turn_px
    union = _rounded((left, min(box[1] for box in boxes), right, max(box[3] for box in boxes)))
    placements = tuple(
        _placed(number, info, box, turn, grid, turn_px, union)
        for number, (info, box, first) in enumerate(zip(infos, boxes, turns, strict=True))
        for turn in ((first - 1, first, first + 1) if turn_px else (first,))
        if _rounded((box[0] + turn * turn_px, box[1], box[2] + turn * turn_px, box[3])) & union or turn == first
    )
    return Arrangement(grid.shifted(union.x0, union.y0), union.width, union.height, turn_px, placements)


def _placed(number: int, info: FileInfo, box: Box, turn: int, grid: Grid, turn_px: float, union: Rect) -> Placement:
    left = box[0] + turn * turn_px
    rect = _rounded((left, box[1], box[2] + turn * turn_px, box[3])).shifted(-union.x0, -union.y0)
    aligned = all(abs(value - round(value)) <= _OFFSET_TOLERANCE_PX for value in (left, box[1]))
    return Placement(number, rect, aligned and _same_steps(grid_of(info), grid), turn)


def _same_steps(one: Grid, other: Grid) -> bool:
    """Whether rows and columns run the same way in steps of the same length."""
    if not same_system(one.crs, other.crs):
        return False
    (a, b, _, d, e, _), (p, q, _, s, t, _) = one.transform, other.transform
    close = _SPACING_TOLERANCE * hypot(p, s), _SPACING_TOLERANCE * hypot(q, t)
    return hypot(a - p, d - s) <= close[0] and hypot(b - q, e - t) <= close[1]


def _rounded(box: Box) -> Rect:
    """Return the pixels whose centres lie in a box: a pixel that a file covers by less than half is not worth a seam of voids."""
    left, top, right, bottom = (round(value) for value in box)
    return Rect(left, top, max(left, right), max(top, bottom))


def _turn_px(grid: Grid) -> float:
    """Return how many columns lead once round the Earth, 0 where columns do not follow the longitude."""
    a, b, _, d, e, _ = grid.transform
    if grid.crs is None or (b, d) != (0, 0) or e == 0:
        return 0.0
    crs = CRS.from_user_input(grid.crs)
    if crs.is_geographic:
        return 2 * pi / float(crs.units_factor[1]) / abs(a)
    return 2 * pi * _EARTH_RADIUS_M / abs(a) if same_system(grid.crs, _WEB_MERCATOR) else 0.0


def _box(info: FileInfo, grid: Grid, first: FileInfo, turn_px: float) -> Box:
    """Return the box of a file's outline on ``grid``; raises InputError if it has none."""
    own = grid_of(info)
    if same_system(own.crs, grid.crs) and _same_steps(own, grid):
        column, row = (float(value) for value in grid.positions(*own.coordinates(np.float64(0), np.float64(0))))  # type: ignore[arg-type]
        return _checked((column, row, column + info.width, row + info.height), info)
    columns, rows = _outline(info, own, grid, first)
    if turn_px and not same_system(own.crs, grid.crs):
        # Where the outline crosses the antimeridian, its longitudes jump by 360 degrees: taken back, they run on.
        jumps = np.rint(np.diff(columns) / turn_px)
        if jumps.sum() != 0:
            raise InputError(
                f"{info.path}: holds a pole, which {grid.crs}, the system of {first.path.name}, cannot show in one piece; "
                "give a file in a polar projection first"
            )
        columns = columns - turn_px * np.concatenate([[0], np.cumsum(jumps)])
        if same_system(grid.crs, _WEB_MERCATOR):
            # By custom it ends at 85.06 degrees, as a square; the poles would lie at 12 times that, or nowhere.
            top, bottom = sorted(
                float(grid.positions(np.zeros(1), np.full(1, y))[1][0]) for y in (-pi * _EARTH_RADIUS_M, pi * _EARTH_RADIUS_M)
            )
            rows = np.clip(rows, top, bottom)
    elif _is_torn(columns, rows):
        raise InputError(
            f"{info.path}: is torn apart in {grid.crs}, the system of {first.path.name}; cut it at the seam, or give first a file "
            "in a system that shows it in one piece"
        )
    return _checked((float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max())), info)


def _checked(box: Box, info: FileInfo) -> Box:
    if not all(isfinite(value) and abs(value) < _FARTHEST_PX for value in box):
        raise InputError(f"{info.path}: lies more than {_FARTHEST_PX:.0e} pixels away from the first file of the mosaic; leave it out")
    return box


def _outline(info: FileInfo, own: Grid, grid: Grid, first: FileInfo) -> tuple[Floats, Floats]:
    """Return positions on ``grid`` all round a file, closed; raises InputError if the grid's system does not reach there."""
    along = np.linspace(0, 1, _EDGE_POINTS, endpoint=False)
    zero = np.zeros(_EDGE_POINTS)
    across = np.concatenate([along, zero + 1, 1 - along, zero, [0]]) * info.width
    down = np.concatenate([zero, along, zero + 1, 1 - along, [0]]) * info.height
    xs, ys = own.coordinates(across, down)
    if not same_system(own.crs, grid.crs):
        if own.crs is None or grid.crs is None:
            one, other = (info, first) if own.crs is None else (first, info)
            raise InputError(
                f"{one.path}: has a place but no coordinate reference system, and {other.path} has one; add it with gdal_edit.py -a_srs"
            )
        found = transformed(own.crs, grid.crs, xs.tolist(), ys.tolist())
        if found is None:
            raise InputError(
                f"{info.path}: reaches beyond what {grid.crs}, the system of {first.path}, can show; cut it with gdalwarp -te, "
                "or give first a file in a system that shows all"
            )
        xs, ys = np.array(found[0]), np.array(found[1])
    return grid.positions(xs, ys)


def _is_torn(columns: Floats, rows: Floats) -> bool:
    """Whether an outline has a step as no edge has that is only bent."""
    steps = np.hypot(np.diff(columns), np.diff(rows))
    return bool(steps.max() > 20 * np.median(steps) and steps.max() > hypot(float(np.ptp(columns)), float(np.ptp(rows))) / 4)


def _gathered(boxes: Sequence[Box], turn_px: float) -> list[int]:
    """Return turns that bring files from both sides of the antimeridian together, if that halves the width at least.

    The Earth is cut open in the widest gap between the files; the first file stays where it is.
    """
    starts = np.array([box[0] for box in boxes])
    widths = np.array([box[2] - box[0] for box in boxes])
    order = np.argsort(np.mod(starts, turn_px), kind="stable")
    begins = np.mod(starts, turn_px)[order]
    reach = np.maximum.accumulate(np.concatenate([[(begins + widths[order]).max() - turn_px], (begins + widths[order])[:-1]]))
    gaps = begins - reach
    cut = begins[int(gaps.argmax())]
    # A quarter of a pixel keeps rounding from sending the file at the cut once round.
    moved = np.mod(starts - cut + 0.25, turn_px) - 0.25
    if gaps.max() <= 0 or 2 * (moved + widths).max() > (starts + widths).max() - starts.min():
        return [0] * len(boxes)
    turns = np.rint((moved + cut - starts) / turn_px).astype(int)
    return [int(turn) for turn in turns - turns[0]]


def _seam(boxes: Sequence[Box], grid: Grid, turn_px: float) -> float:
    """Return where a lattice that leads all round the Earth begins: as a file that does so, or at the antimeridian."""
    widest = max(boxes, key=lambda box: box[2] - box[0])
    if widest[2] - widest[0] > turn_px - 1:
        return widest[0]
    a, _, c, _, _, _ = grid.transform
    return -c / a - turn_px / 2
