"""Statistics of a block in one pass: numba, outside the GIL (NumPy's reductions over interleaved channels are 50 times slower)."""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(nogil=True, cache=True)
def _measure(samples: NDArray[Any], valid: NDArray[np.bool_], masked: bool, found: NDArray[np.float64]) -> int:
    """Put minimum, maximum and sum per channel into ``found`` (3, channels); return the number of valid samples."""
    rows, columns = samples.shape[:2]
    channels = found.shape[1]
    count = 0
    for channel in range(channels):
        low, high, total = np.inf, -np.inf, 0.0
        count = 0
        for y in range(rows):
            for x in range(columns):
                if masked and not valid[y, x]:
                    continue
                value = np.float64(samples[y, x, channel])
                low = min(low, value)
                high = max(high, value)
                total += value
                count += 1
        found[0, channel], found[1, channel], found[2, channel] = low, high, total
    return count


_NO_MASK = np.empty((0, 0), np.bool_)


def measure(samples: NDArray[Any], valid: NDArray[np.bool_] | None, channels: int) -> tuple[int, NDArray[np.float64]]:
    """Return the number of valid samples, and minimum, maximum and sum of the first ``channels`` channels, (3, channels).

    ``samples`` is (rows, columns, channels or more) of any number type, ``valid`` (rows, columns) or None if all are.
    """
    found = np.empty((3, channels))
    return _measure(samples, _NO_MASK if valid is None else valid, valid is not None, found), found
