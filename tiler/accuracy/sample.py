"""The input of the experiments: a void-free square cut from the middle of a source, or a built-in terrain whose spectrum is known."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.lattice import Registration
from schemas.manifest import LayerKind
from schemas.region import Rect
from schemas.settings import BuildSettings
from tiler.accuracy.ideal import MARGIN, power_law_terrain
from tiler.filters.edges import EdgeRule
from tiler.sources.convert import Source, choose_conversion
from tiler.sources.files import open_file

LEVELS: Final = 3
"""Coarser levels that are measured where the sample is large enough."""
_SMALLEST: Final = 6 * MARGIN
"""Least cells along an edge: level 1 then keeps a third of its samples."""

REGISTRATION: Final[dict[LayerKind, Registration]] = {"height": "point", "imagery": "area"}
EDGE: Final[dict[LayerKind, EdgeRule]] = {"height": "antisymmetric", "imagery": "mirror"}
DEFAULT_RADIUS: Final[dict[LayerKind, int]] = {"height": 6, "imagery": 3}
"""How `clipmap build` filters a kind of layer unless told otherwise."""

EXPONENT: Final = 3.0
RMS_M: Final = 400.0
"""The built-in terrain: power spectrum k**-3, standard deviation of heights."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Samples (h, w, c) float32 of one kind of layer; heights have one more sample than cells, so that levels end where it ends."""

    name: str
    kind: LayerKind
    values: NDArray[np.float32]
    remarks: tuple[str, ...] = ()
    known_spectrum: bool = False

    @property
    def registration(self) -> Registration:
        """Where its samples sit."""
        return REGISTRATION[self.kind]

    @property
    def edge(self) -> EdgeRule:
        """What its filters assume beyond the border."""
        return EDGE[self.kind]

    @property
    def unit(self) -> str:
        """Unit of its samples."""
        return "m" if self.kind == "height" else "codes"

    @property
    def megasamples(self) -> float:
        """Millions of samples, channels not counted."""
        height, width = self.values.shape[:2]
        return float(height * width / 1e6)

    @property
    def level_count(self) -> int:
        """How many coarser levels keep a third of their samples clear of the border."""
        cells: int = min(self.values.shape[:2])
        return max(1, sum(cells >> level >= 3 * MARGIN for level in range(1, LEVELS + 1)))


def built_in(crop: int) -> Sample:
    """Return a terrain of ``crop`` cells along an edge (rounded down to a multiple of 8) and power spectrum k**-3."""
    side = _checked_side(crop, crop, "the built-in terrain")
    values = power_law_terrain(side, EXPONENT, RMS_M).astype(np.float32)
    return Sample("built-in terrain, power spectrum k⁻³", "height", values, known_spectrum=True)


def load_sample(path: Path, settings: BuildSettings, crop: int) -> Sample:
    """Return the middle of ``path``, at most ``crop`` cells along an edge, or its largest square without a void.

    Raises InputError if the file cannot be read or holds no square of 96 cells without voids, UsageError as a build would.
    """
    with tempfile.TemporaryDirectory(prefix="clipmap-accuracy-") as scratch:
        reader = open_file(path, Path(scratch))
        source = Source(reader, choose_conversion(reader.info, settings))
        try:
            kind = source.conversion.kind
            vertex = 1 if REGISTRATION[kind] == "point" else 0
            window = _middle(reader.info.rect, crop + vertex)
            values, coverage = source.read(window)
        finally:
            reader.close()
    remarks: list[str] = []
    if coverage is not None and (coverage < 1).any():
        square = largest_covered_square(coverage == 1)
        remarks.append(f"voids in {100 * float((coverage < 1).mean()):.3g} % of the crop: the largest square without one is used")
        values = values[square]
    sides = [_checked_side(crop, length - vertex, str(path)) for length in values.shape[:2]]
    top, left = ((length - side - vertex) // 2 for length, side in zip(values.shape[:2], sides, strict=True))
    values = np.ascontiguousarray(values[top : top + sides[0] + vertex, left : left + sides[1] + vertex])
    if not np.ptp(values):
        raise InputError(f"{path}: the crop is constant, every filter is exact on it; choose another source, or a larger --crop")
    return Sample(path.name, kind, values, tuple(remarks))


def _checked_side(crop: int, cells: int, where: str) -> int:
    """Return the largest multiple of 8 that fits, so that three levels end where the sample ends."""
    side = min(crop, cells) // 8 * 8
    if side < _SMALLEST:
        raise InputError(
            f"{where}: {max(0, cells)} cells along an edge without voids, at least {_SMALLEST} are needed to tell filters apart; "
            "try a larger --crop"
        )
    return side


def _middle(whole: Rect, side: int) -> Rect:
    x0, y0 = max(0, (whole.width - side) // 2), max(0, (whole.height - side) // 2)
    return Rect(x0, y0, min(whole.x1, x0 + side), min(whole.y1, y0 + side))


def largest_covered_square(covered: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the first of the largest squares without a gap, found by halving over summed areas."""
    areas = np.pad(covered, ((1, 0), (1, 0))).astype(np.int64).cumsum(axis=0).cumsum(axis=1)

    def places(side: int) -> NDArray[np.intp]:
        sums = areas[side:, side:] - areas[:-side, side:] - areas[side:, :-side] + areas[:-side, :-side]
        return np.argwhere(sums == side * side)

    low, high = 0, min(covered.shape)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if len(places(middle)) else (low, middle - 1)
    y, x = places(low)[0] if low else (0, 0)
    return slice(y, y + low), slice(x, x + low)
