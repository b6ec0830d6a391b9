"""Filter design: the taps of one-dimensional low-pass kernels for halving a level, and their frequency response.

A kernel is designed as a windowed sinc of cut-off half the coarse sampling rate, in float64, and then quantised to
multiples of 2**-23, the grid on which float32 adds numbers below 2 exactly. So the weights used by the float32 loops sum
to exactly 1 in any order, and a ``point`` kernel is exactly half-band: centre 1/2, odd taps summing to 1/2, even taps 0, hence a
response of exactly 0 at the Nyquist frequency. The quantisation changes no weight by more than 6e-8, except the
innermost, which takes the rest of the sum: at most 2.7e-7 up to radius 16.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.lattice import Registration

_GRID: Final = 2.0**23
MAX_RADIUS: Final = 16


@dataclass(frozen=True, slots=True)
class Kernel:
    """A symmetric kernel that makes coarse sample i from fine samples ``2i + offset``, as pairs around its centre.

    ``low`` and ``high`` are the offsets of each pair, nearest first; ``weights`` belong to either member of a pair. For
    ``area`` the centre lies between offsets 0 and 1, for ``point`` on offset 0, whose weight is what the pairs leave of 1.
    """

    name: str
    radius: int
    registration: Registration
    low: tuple[int, ...]
    high: tuple[int, ...]
    weights: tuple[float, ...]

    @property
    def reach(self) -> tuple[int, int]:
        """How many fine samples before and after sample 2i the kernel sees."""
        return -self.low[-1], self.high[-1]

    def taps(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return all offsets, ascending, and their weights, which sum to exactly 1."""
        weight = {**dict(zip(self.low, self.weights, strict=True)), **dict(zip(self.high, self.weights, strict=True))}
        if self.registration == "point":
            weight[0] = 1 - 2 * sum(self.weights)
        offsets = sorted(weight)
        return np.array(offsets, np.int64), np.array([weight[offset] for offset in offsets])


def blackman_sinc(radius: int, registration: Registration) -> Kernel:
    """Return the sinc with a Blackman window of ``radius`` coarse samples.

    Window 0.42 + 0.5 cos(pi t) + 0.08 cos(2 pi t) over |t| < 1, as Holkner's "Hardware Based Clipmapping", section 3,
    uses for terrain levels. Raises UsageError if the radius is not between 1 and 16.
    """
    if not 1 <= radius <= MAX_RADIUS:
        raise UsageError(f"filter radius {radius}: must be between 1 and {MAX_RADIUS} coarse samples")
    odd = np.arange(1, 2 * radius, 2)
    distance = np.arange(2 * radius) + 0.5 if registration == "area" else odd.astype(np.float64)
    t = distance / (2 * radius)
    window = 0.42 + 0.5 * np.cos(np.pi * t) + 0.08 * np.cos(2 * np.pi * t)
    ideal = np.sinc(distance / 2) * window
    total = 0.5 if registration == "area" else 0.25
    weights = _quantised(ideal * (total / ideal.sum()), total)
    low = -np.arange(2 * radius) if registration == "area" else -odd
    high = np.arange(2 * radius) + 1 if registration == "area" else odd
    return Kernel("blackman-sinc", radius, registration, _ints(low), _ints(high), weights)


def covering(registration: Registration) -> Kernel:
    """Return the smallest positive kernel: the mean of two cells (``area``), or (1, 2, 1) / 4 (``point``).

    It carries coverage from level to level, and is the fallback where voids leave a windowed sinc too little weight.
    """
    if registration == "area":
        return Kernel("covering", 1, "area", (0,), (1,), (0.5,))
    return Kernel("covering", 1, "point", (-1,), (1,), (0.25,))


DESIGNS: Final = {"blackman-sinc": blackman_sinc}


def frequency_response(kernel: Kernel, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gain of ``kernel`` at ``frequency`` in cycles per coarse sample; 0.5 is the coarse Nyquist frequency.

    The phase is zero about the coarse sample's own place, so the gain is real.
    """
    offsets, weights = kernel.taps()
    centre = 0.5 if kernel.registration == "area" else 0.0
    gain: NDArray[np.float64] = np.cos(np.pi * np.multiply.outer(frequency, offsets - centre)) @ weights
    return gain


def _quantised(weights: NDArray[np.float64], total: float) -> tuple[float, ...]:
    steps = np.rint(weights * _GRID)
    steps[0] += total * _GRID - steps.sum()
    return tuple(float(weight) for weight in steps / _GRID)


def _ints(values: NDArray[np.int64]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)
