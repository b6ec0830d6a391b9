"""Filter design: the taps of one-dimensional low-pass kernels for halving a level, and their frequency response.

A windowed sinc is designed for a cut-off of half the coarse sampling rate, in float64, and then quantised to
multiples of 2**-23, the grid on which float32 adds numbers below 2 exactly. So the weights used by the float32 loops sum
to exactly 1 in any order, and a ``point`` kernel is exactly half-band: centre 1/2, odd taps summing to 1/2, even taps 0, hence a
response of exactly 0 at the Nyquist frequency. The quantisation changes no weight by more than 6e-8, except the
innermost, which takes the rest of the sum: at most 2.7e-7 up to radius 16.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.lattice import Registration
from schemas.manifest import KernelName

_GRID: Final = 2.0**23
MAX_RADIUS: Final = 16


@dataclass(frozen=True, slots=True)
class Kernel:
    """A symmetric kernel that makes coarse sample i from fine samples ``2i + offset``, as pairs around its centre.

    ``low`` and ``high`` are the offsets of each pair, nearest first; ``weights`` belong to either member of a pair. For
    ``area`` the centre lies between offsets 0 and 1, for ``point`` on offset 0, whose weight is what the pairs leave of 1.
    """

    name: KernelName
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


Window = Callable[[NDArray[np.float64], int], NDArray[np.float64]]
"""Gives the window at ``t`` = distance / radius, |t| < 1, for a radius in coarse samples."""


def _blackman(t: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    return 0.42 + 0.5 * np.cos(np.pi * t) + 0.08 * np.cos(2 * np.pi * t)


def _lanczos(t: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    return np.sinc(t)


def _kaiser(t: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    beta = 4 * radius / 3
    return np.i0(beta * np.sqrt(1 - t * t)) / np.i0(beta)


def _windowed_sinc(name: KernelName, window: Window, radius: int, registration: Registration) -> Kernel:
    if not 1 <= radius <= MAX_RADIUS:
        raise UsageError(f"filter radius {radius}: must be between 1 and {MAX_RADIUS} coarse samples")
    odd = np.arange(1, 2 * radius, 2)
    distance = np.arange(2 * radius) + 0.5 if registration == "area" else odd.astype(np.float64)
    ideal = np.sinc(distance / 2) * window(distance / (2 * radius), radius)
    total = 0.5 if registration == "area" else 0.25
    weights = _quantised(ideal * (total / ideal.sum()), total)
    low = -np.arange(2 * radius) if registration == "area" else -odd
    high = np.arange(2 * radius) + 1 if registration == "area" else odd
    return Kernel(name, radius, registration, _ints(low), _ints(high), weights)


def blackman_sinc(radius: int, registration: Registration) -> Kernel:
    """Return the sinc with a Blackman window of ``radius`` coarse samples, the default.

    Window 0.42 + 0.5 cos(pi t) + 0.08 cos(2 pi t) over |t| < 1, as Holkner's "Hardware Based Clipmapping", section 3,
    uses for terrain levels. Raises UsageError if the radius is not between 1 and 16.
    """
    return _windowed_sinc("blackman-sinc", _blackman, radius, registration)


def lanczos(radius: int, registration: Registration) -> Kernel:
    """Return the sinc with the main lobe of a wider sinc as its window (Lanczos; Duchon 1979), ``radius`` coarse samples."""
    return _windowed_sinc("lanczos", _lanczos, radius, registration)


def kaiser(radius: int, registration: Registration) -> Kernel:
    """Return the sinc with a Kaiser window of beta = 4/3 radius, i.e. 4 at radius 3 and 8 at radius 6 (Kaiser 1974).

    At equal taps it droops and aliases less than Blackman's, and overshoots more (at radius 3: 5.2 % of a step against 3.4 %).
    """
    return _windowed_sinc("kaiser", _kaiser, radius, registration)


def box(radius: int, registration: Registration) -> Kernel:
    """Return the mean over one coarse cell: 2 cells (``area``), or (1, 2, 1) / 4 (``point``). ``radius`` must be 1."""
    _check_radius_one("box", radius)
    return covering(registration)


def triangle(radius: int, registration: Registration) -> Kernel:
    """Return linear interpolation's adjoint: (1, 3, 3, 1) / 8 (``area``), or (1, 2, 1) / 4 (``point``). ``radius`` must be 1."""
    _check_radius_one("triangle", radius)
    if registration == "area":
        return Kernel("triangle", 1, "area", (0, -1), (1, 2), (0.375, 0.125))
    return replace(covering("point"), name="triangle")


def _check_radius_one(name: str, radius: int) -> None:
    if radius != 1:
        raise UsageError(f"filter {name} has a fixed support of one coarse sample; leave out --radius, or give 1")


def covering(registration: Registration) -> Kernel:
    """Return the smallest positive kernel: the mean of two cells (``area``), or (1, 2, 1) / 4 (``point``).

    It carries coverage from level to level, and is the fallback where voids leave a windowed sinc too little weight.
    """
    if registration == "area":
        return Kernel("box", 1, "area", (0,), (1,), (0.5,))
    return Kernel("box", 1, "point", (-1,), (1,), (0.25,))


DESIGNS: Final[dict[KernelName, Callable[[int, Registration], Kernel]]] = {
    "blackman-sinc": blackman_sinc,
    "kaiser": kaiser,
    "lanczos": lanczos,
    "triangle": triangle,
    "box": box,
}
FIXED_RADIUS: Final[frozenset[KernelName]] = frozenset({"triangle", "box"})
"""Kernels whose radius is 1 and cannot be chosen."""


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
