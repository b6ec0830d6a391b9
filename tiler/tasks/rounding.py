"""From filtered samples to stored ones: rounded once, to nearest, within the range of the stored type."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiler.codecs import BlockFormat, Mask, Samples
from tiler.compiled import compiled
from tiler.filters.cascade import Coverage, Values
from tiler.samples.transfer import encode_srgb


@compiled
def _round(values: NDArray[np.float32], top: np.float32, rounded: NDArray[Any]) -> None:
    """Set ``rounded`` (rows, columns, channels) to ``values``, to nearest with ties to even, from 0 to ``top``; one pass, no copies."""
    rows, columns, channels = values.shape
    width = columns * channels
    for y in range(rows):
        row, out = values[y].reshape(width), rounded[y].reshape(width)
        for x in range(width):
            out[x] = min(max(np.rint(row[x]), np.float32(0)), top)


def round_samples(values: Values, coverage: Coverage | None, block: BlockFormat, linear_light: bool = False) -> tuple[Samples, Mask | None]:
    """Round ``values`` (rows, columns, channels), contiguous, to the stored type, once, to nearest (ties to even), within its range.

    Coverage becomes the alpha channel of imagery, or the mask of heights (True where any of the sample is covered). Colour
    under an alpha of 0 is set to 0. Values in ``linear_light`` are encoded as sRGB first. Samples that have the stored type already
    are returned as they are.
    """
    if block.dtype == "float32":
        return values, None if coverage is None else coverage > 0
    dtype = np.dtype(block.dtype)
    rounded: Samples = values
    if values.dtype != dtype:
        top = np.iinfo(dtype).max
        codes = encode_srgb(values, top) if linear_light else values
        rounded = np.empty(values.shape, dtype)
        _round(np.ascontiguousarray(codes), np.float32(top), rounded)
    if not block.alpha:
        return rounded, None
    alpha = np.full(values.shape[:2], np.iinfo(dtype).max, dtype)
    if coverage is not None:
        alpha = np.rint(coverage * np.float32(np.iinfo(dtype).max)).astype(dtype)
        rounded = np.where(alpha[..., np.newaxis] == 0, dtype.type(0), rounded)
    return np.concatenate([rounded, alpha[..., np.newaxis]], axis=-1), None
