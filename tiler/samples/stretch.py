"""Stretching 16-bit imagery to 8 bits: a range of each colour channel becomes 0 to 255, what lies outside is clipped.

The range is given, or found in a first pass over the file that counts how often each of the 65536 values occurs. With n valid
samples, a cut of p per cent leaves out k = floor(n p / 100) samples at both ends: the range leads from the sample of rank k to
that of rank n - 1 - k. Counts are whole numbers, so the range is exact and does not depend on how the file is read.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from schemas.region import Rect
from tiler.sources import FileInfo
from tiler.sources.convert import DerivedSource, SampleSource
from tiler.tasks.engine import run_tasks

Ranges = tuple[tuple[float, float], ...]
"""(min, max) of every colour channel [units of the file]."""

_FARTHEST: Final = 1e6
"""Limits beyond this are no use for 16 bits."""
_VALUES: Final = 1 << 16
_PORTION_PX: Final = 1 << 20
_PORTION_COLUMNS: Final = 2048
_MAX_PORTION_ROWS: Final = 1024


@dataclass(frozen=True, slots=True)
class Stretch:
    """What becomes 0 to 255: all but the share ``cut`` of the valid samples at both ends, or ``limits`` for every channel."""

    cut: Fraction | None
    limits: tuple[float, float] | None = None


def parse_stretch(spec: str) -> Stretch:
    """Return the stretch that ``CUT%`` or ``MIN,MAX`` asks for; raises UsageError for anything else."""
    percent = spec.endswith("%")
    try:
        numbers = [float(part) for part in spec.removesuffix("%").split(",")]
    except ValueError:
        numbers = []
    if percent and len(numbers) == 1 and 0 <= numbers[0] < 50:
        return Stretch(Fraction(str(numbers[0])) / 100)
    if percent or len(numbers) != 2 or not all(abs(number) <= _FARTHEST for number in numbers):
        raise UsageError(f"--stretch {spec!r}: expected CUT% from 0% to below 50%, or MIN,MAX in units of the file, e.g. 2% or 300,12000")
    low, high = numbers
    if np.float32(low) >= np.float32(high):
        raise UsageError(f"--stretch {spec!r}: MIN must be less than MAX")
    return Stretch(None, (low, high))


def find_ranges(source: SampleSource, stretch: Stretch, workers: int) -> Ranges:
    """Return the range of every colour channel of ``source`` (16-bit imagery); reads all of it if ``stretch`` is a cut.

    Raises InputError if there is no valid sample, or a channel has the same value from one end to the other.
    """
    if stretch.cut is None:
        return (stretch.limits or (0.0, float(_VALUES - 1)),) * source.conversion.channels
    ranges = []
    for channel, counts in zip(source.conversion.colours, _counts(source, workers), strict=True):
        below = np.cumsum(counts)
        valid = int(below[-1])
        if valid == 0:
            raise InputError(f"{source.info.path}: has no valid sample, so there is no range to stretch; leave out --stretch")
        cut = math.floor(valid * stretch.cut)
        low, high = (int(np.searchsorted(below, rank, side="right")) for rank in (cut, valid - 1 - cut))
        if low == high:
            raise InputError(
                f"{source.info.path}: channel {channel + 1} has no range to stretch, its samples are {low}"
                f"{' but for those cut off' if cut else ''}; give --stretch MIN,MAX"
            )
        ranges.append((float(low), float(high)))
    return tuple(ranges)


def _counts(source: SampleSource, workers: int) -> NDArray[np.int64]:
    """Return how many valid samples have each value, (channels, 65536)."""
    total = np.zeros((source.conversion.channels, _VALUES), np.int64)

    def count(window: Rect) -> NDArray[np.int64]:
        values, coverage = source.read(window)
        valid = np.s_[:, :] if coverage is None else coverage > 0
        # Only colour that was divided by its alpha is not whole already.
        codes = np.clip(np.rint(values[valid]), 0, _VALUES - 1).astype(np.uint16)
        return np.stack([np.bincount(codes[..., channel].reshape(-1), minlength=_VALUES) for channel in range(len(total))])

    for counts in run_tasks(count, _portions(source.info), workers):
        total += counts
    return total


def _portions(info: FileInfo) -> Iterator[Rect]:
    """Yield windows that cover the file, about a million pixels each, along its tiles or strips."""
    columns = info.width if info.layout == "striped" else min(info.width, _PORTION_COLUMNS)
    rows = min(max(1, _PORTION_PX // columns // info.chunk_rows) * info.chunk_rows, _MAX_PORTION_ROWS)
    for y in range(0, info.height, rows):
        for x in range(0, info.width, columns):
            yield Rect(x, y, min(x + columns, info.width), min(y + rows, info.height))


class StretchedSource(DerivedSource):
    """A source of 16-bit imagery as samples from 0 to 255, not yet rounded; the coverage is that of the file."""

    def __init__(self, source: SampleSource, ranges: Ranges) -> None:
        super().__init__(source)
        self._low, high = (np.array(limits, np.float32) for limits in zip(*ranges, strict=True))
        self._width = high - self._low
        self.conversion = replace(source.conversion, dtype="uint8", stretch=ranges)

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return stretched samples (rows, columns, channels) and coverage of ``window``; raises InputError if it cannot be read."""
        values, coverage = self._source.read(window)
        # Divided, not multiplied by an inverse: so both ends become 0 and 255 exactly.
        stretched: NDArray[Any] = np.clip((values - self._low) / self._width, 0, 1)
        stretched *= np.float32(255)
        if coverage is not None:
            stretched[coverage == 0] = 0
        return stretched, coverage
