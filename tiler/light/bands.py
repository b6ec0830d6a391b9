"""The order in which a grid is read for a sweep: bands across it, from the sun's side on, each a few rows of blocks or columns of blocks.

For a sun nearer to north or south the bands are rows of the grid, for one nearer to east or west they are columns. One band and what
the sweep carries is all that is ever held.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.region import Rect
from tiler.light.frame import Frame
from tiler.light.sweeping import Float32
from tiler.light.turning import turned

Swept_co = TypeVar("Swept_co", np.float32, np.uint8, covariant=True)


class Sweep(Protocol[Swept_co]):
    """What takes the rows of a frame in order: ``ShadowSweep``, ``CertifiedSweep``, ``HorizonSweep``."""

    @property
    def frame(self) -> Frame:
        """How the grid is turned."""

    def push(self, rows_m: Float32, /) -> NDArray[Swept_co]:
        """Return the result for the next rows of the frame."""


@dataclass(frozen=True, slots=True)
class Band:
    """Rows ``first`` up to before ``stop`` of a frame, and the window of the grid that they are."""

    first: int
    stop: int
    window: Rect


def plan_bands(frame: Frame, size: int) -> tuple[Band, ...]:
    """Return the bands of a frame in the order in which they must be swept.

    They end at multiples of ``size`` rows (or columns) of the grid: if that is a multiple of the side of blocks, each block is in one band.
    Raises UsageError for a size that is not positive.
    """
    if size < 1:
        raise UsageError(f"bands of {size} rows: give at least 1")
    from_the_end = frame.turns in (1, 2)
    offset = frame.rows % size if from_the_end else 0
    ends = [*range(offset or size, frame.rows, size), frame.rows]
    starts = [0, *ends[:-1]]
    return tuple(Band(start, stop, frame.grid_window((start, stop))) for start, stop in zip(starts, ends, strict=True))


def sweep_bands(sweep: Sweep[Swept_co], read: Callable[[Rect], Float32], size: int) -> Iterator[tuple[Rect, NDArray[Swept_co]]]:
    """Read a grid band by band in the order of ``plan_bands`` and yield each band's window of the grid with its result, as the grid lies.

    ``read`` returns the heights (h, w) float32 [m] of a window of the grid, NaN where they are void.
    """
    turns = sweep.frame.turns
    for band in plan_bands(sweep.frame, size):
        yield band.window, turned(sweep.push(turned(read(band.window), turns)), -turns)
