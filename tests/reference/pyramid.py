"""The pyramid in float64: separable reduction by two, voids by guarded normalised convolution, edges by reflection.

Coarser levels come from the full-precision finer level and never from rounded samples. Normalised convolution: Knutsson and
Westin, "Normalized and differential convolution", CVPR 1993; the guard and its bound are derived in ``void_gain_bound``.
"""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tests.reference.edges import Edge, extend
from tests.reference.kernels import Array, Registration, Taps, positive_taps, taps

Level = tuple[Array, Array | None]
"""Values (h, w, c) and coverage (h, w); the coverage is None where every sample is valid."""

GUARD_LOW = 0.5
"""Covered share up to which the positive kernel decides alone."""
GUARD_HIGH = 0.9
"""Covered share from which the sharp kernel decides alone."""


def coarsen(values: Array, coverage: Array | None, *, kernel: str, radius: int, registration: Registration, edge: Edge) -> Level:
    """Return the next coarser level, ``ceil(h / 2)`` by ``ceil(w / 2)`` samples.

    ``values`` is (h, w, c) float64, colours not premultiplied; ``coverage`` is (h, w) float64 from 0 (void) to 1, or None for
    all 1. With weights w of the sharp and p of the positive kernel, W = sum w c, N = sum w c z, Wp = sum p c, P = sum p c z:
    the new coverage is Wp; the new value is 0 where Wp = 0, P / Wp where the share S = W / max c (largest c under the sharp taps)
    is at most 1/2, otherwise (1 - t) P / Wp + t N / W with ``t = guard_blend(S)``. Where every sample of non-zero weight has
    coverage 1, W is exactly 1, as the sums of ``taps`` are exact, and the value is the plain sum. What lies under coverage 0 is
    ignored, even NaN. Raises ValueError for wrong shapes, for coverage outside [0, 1] and for covered values that are not finite.
    """
    sharp, positive = taps(kernel, radius, registration), positive_taps(registration)
    z, c = _checked(values, coverage)
    z, c = extend(z, c, _margin(sharp), edge)
    size = (values.shape[0] + 1) // 2, (values.shape[1] + 1) // 2
    before = _margin(sharp)[0]
    sharp_sum = _weighted_sum(c * z, sharp, before, size)
    if coverage is None:
        return sharp_sum, None

    sharp_weight = _weighted_sum(c, sharp, before, size)
    positive_sum = _weighted_sum(c * z, positive, before, size)
    positive_weight = _weighted_sum(c, positive, before, size)

    safe = positive_sum / np.where(positive_weight > 0, positive_weight, 1.0)
    peak = _largest(c, sharp, before, size)
    share = sharp_weight / np.where(peak > 0, peak, 1.0)
    normalised = sharp_sum / np.where(share > GUARD_LOW, sharp_weight, 1.0)
    t = guard_blend(share)
    value = np.where(share > GUARD_LOW, (1 - t) * safe + t * normalised, safe)
    return np.where(positive_weight > 0, value, 0.0), positive_weight[:, :, 0]


def pyramid(
    values: Array, coverage: Array | None, levels: int, *, kernel: str, radius: int, registration: Registration, edge: Edge
) -> list[Level]:
    """Return ``levels`` levels, the finest (the input itself, with voids set to 0) first; arguments as in ``coarsen``."""
    z, _ = _checked(values, coverage)
    result: list[Level] = [(z, coverage)]
    for _ in range(levels - 1):
        result.append(coarsen(*result[-1], kernel=kernel, radius=radius, registration=registration, edge=edge))
    return result


def guard_blend(share: Array) -> Array:
    """Return the part t of the sharp kernel for a covered share S: a smooth step from 0 at 0.5 to 1 at 0.9."""
    u = np.clip((share - GUARD_LOW) / (GUARD_HIGH - GUARD_LOW), 0.0, 1.0)
    return np.asarray(u * u * (3 - 2 * u), np.float64)


def void_gain_bound(l1: float) -> float:
    """Return the largest possible ``|value| / max |z|`` of ``coarsen`` for a kernel of 1-D L1 norm ``l1``, any coverage.

    Only the ratios of coverages matter, so let the largest one be 1; then S = W.

    Simple bound. N / W is used only where W > 1/2, and |N| <= sum |w| c max|z| <= L max|z| with the 2-D norm L = l1**2, so
    |N / W| <= 2 L max|z|. P / Wp is an average, a blend of both lies between them, hence the gain is at most 2 L.

    Sharp bound, returned here. Split the covered weight into its positive part A and negative part -B: W = A - B and
    |N| <= (A + B) max|z| = (W + 2 B) max|z|. The weights sum to 1, so 2 B <= L - 1, and the gain of the blend is at most
    (1 - t) + t (W + L - 1) / W = 1 + (L - 1) t(W) / W. The largest t(W) / W is about 1.131, at W about 0.867. It is
    attained: z = sign w, full coverage of all negative weights, and W brought to 0.867 by uncovering positive ones.
    For W > 1 the same formula with t = 1 gives less.

    Both are relative to the largest *extended* sample: one antisymmetric reflection may triple it on each axis.
    """
    weight = np.linspace(GUARD_LOW, 1.0, 1_000_001)
    return float(1 + (l1 * l1 - 1) * (guard_blend(weight) / weight).max())


def quantise(values: Array, dtype: DTypeLike) -> NDArray[Any]:
    """Return ``values`` rounded half to even and clipped to the range of an integer ``dtype``: the only rounding there is."""
    info = np.iinfo(np.dtype(dtype))
    return np.clip(np.rint(values), info.min, info.max).astype(dtype)


def stored_alpha(coverage: Array, dtype: DTypeLike) -> NDArray[Any]:
    """Return ``coverage`` as the alpha channel of an unsigned integer ``dtype``: coverage 1 becomes its greatest value."""
    return quantise(coverage * np.iinfo(np.dtype(dtype)).max, dtype)


def _checked(values: Array, coverage: Array | None) -> tuple[Array, Array]:
    """Return values with 0 under voids, and the coverage as (h, w, 1)."""
    if values.ndim != 3 or values.dtype != np.float64:
        raise ValueError(f"values must be (h, w, c) float64, got {values.shape} {values.dtype}")
    c = np.ones(values.shape[:2]) if coverage is None else coverage
    if c.shape != values.shape[:2] or not (c >= 0).all() or not (c <= 1).all():
        raise ValueError(f"coverage must be {values.shape[:2]} in [0, 1], got {c.shape}")
    z = np.where(c[:, :, None] > 0, values, 0.0)
    if not np.isfinite(z).all():
        raise ValueError("covered values must be finite")
    return z, c[:, :, None]


def _margin(kernel: Taps) -> tuple[int, int]:
    offsets, _ = kernel
    return -int(offsets[0]), int(offsets[-1])


def _weighted_sum(extended: Array, kernel: Taps, before: int, size: tuple[int, int]) -> Array:
    """Sum over the separable 2-D kernel at every second sample; sample (0, 0) of the level is ``extended[before, before]``."""
    rows = _weighted_rows(extended, kernel, before, size[0])
    return _weighted_rows(rows.swapaxes(0, 1), kernel, before, size[1]).swapaxes(0, 1)


def _largest(extended: Array, kernel: Taps, before: int, size: tuple[int, int]) -> Array:
    """Return the largest value under the taps that are not 0 at every second sample."""
    offsets = kernel[0][kernel[1] != 0]
    shifted = [
        extended[before + int(j) :, before + int(i) :][: 2 * size[0] - 1 : 2, : 2 * size[1] - 1 : 2] for j in offsets for i in offsets
    ]
    return np.asarray(np.max(shifted, axis=0), np.float64)


def _weighted_rows(extended: Array, kernel: Taps, before: int, size: int) -> Array:
    total = np.zeros((size, *extended.shape[1:]))
    for offset, weight in zip(*kernel, strict=True):
        first = before + int(offset)
        total += weight * extended[first : first + 2 * size - 1 : 2]
    return total
