"""Telling heights hidden in colour from pictures: filtered as colours, such a file would become noise at every 25 metres.

Terrain-RGB and terrarium write a height as a number of several digits to the base 256, one per channel. Where the terrain
rises past a multiple of 256, the lower digit wraps from 255 to 0 and the next higher one grows by exactly 1. In a picture, colours
of neighbours rise and fall together: a jump by half the range in one channel hardly ever goes with a step of 1 the other way
in another.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.region import Rect
from schemas.settings import HeightEncoding
from tiler.sources import Reader
from tiler.sources.convert import Conversion

_WINDOW_PX: Final = 256
_MIN_WRAPS: Final = 24
"""Fewer neighbours than this are chance: a contour line across a tenth of the window."""
_MIN_WRAP_SHARE: Final = 0.5
"""Least share of the jumps by half the range that are wraps; 0.75 on Mount Fuji, whose slopes jump by themselves."""
_MIN_CARRY_SHARE: Final = 0.25
"""Least share of the changes of the higher digit that are carries; 0.5 on Mount Fuji, 0.98 where slopes are gentle."""
_MIN_VALUES: Final = 64
"""A digit that wraps has run through most of its values; a map of few colours or a dithered one has not."""


def refuse_disguised_heights(reader: Reader, conversion: Conversion) -> None:
    """Raise UsageError if what is about to become imagery looks like encoded heights in a window at the centre of the file."""
    info = reader.info
    if conversion.kind != "imagery" or len(conversion.colours) != 3 or info.dtype != np.uint8:
        return
    left, top = (max(0, (size - _WINDOW_PX) // 2) for size in (info.width, info.height))
    window = Rect(left, top, min(info.width, left + _WINDOW_PX), min(info.height, top + _WINDOW_PX))
    encoding = hidden_heights(reader.read(window)[0][..., list(conversion.colours)])
    if encoding is not None:
        raise UsageError(
            f"{info.path}: looks like heights hidden in colour; build it with --layer height --decode {encoding}, "
            "or with --decode none if it is a picture all the same"
        )


def hidden_heights(colours: NDArray[np.uint8]) -> HeightEncoding | None:
    """Return how ``colours`` (rows, columns, 3) most likely encode heights, None if they look like a picture.

    Needs relief: a lower digit that never wraps within the window (less than 25.6 m in terrain-RGB, 256 m in terrarium with whole
    metres) cannot be told from a picture.
    """
    if not any(_carries(colours[..., digit], colours[..., digit + 1]) for digit in (0, 1)):
        return None
    # The highest digit of terrain-RGB is 0 to 2 (-10000 to 9660 m), that of terrarium near 128 (sea level).
    return "terrain-rgb" if np.median(colours[..., 0]) <= 2 else "terrarium"


def _carries(high: NDArray[np.uint8], low: NDArray[np.uint8]) -> bool:
    """Whether the wraps of ``low`` go with carries into ``high``, over all pairs of neighbours in rows and columns."""
    if np.unique(low).size < _MIN_VALUES:
        return False
    jumps = changes = wraps = 0
    for axis in (0, 1):
        high_step, low_step = (np.diff(digit.astype(np.int16), axis=axis) for digit in (high, low))
        jump = np.abs(low_step) > 128
        jumps += int(np.count_nonzero(jump))
        changes += int(np.count_nonzero(high_step))
        wraps += int(np.count_nonzero(jump & (high_step == -np.sign(low_step))))
    return wraps >= max(_MIN_WRAPS, _MIN_WRAP_SHARE * jumps, _MIN_CARRY_SHARE * changes)
