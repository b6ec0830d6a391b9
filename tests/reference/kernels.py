"""Filter kernels for a reduction by two, in float64, straight from their formulas.

Distances are in fine samples, radii in coarse samples, frequencies in cycles per coarse sample. Windows: Harris, "On the use
of windows for harmonic analysis with the discrete Fourier transform", Proc. IEEE 66 (1978); the classic Blackman window is
0.42 + 0.5 cos(pi t) + 0.08 cos(2 pi t).
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Offsets = NDArray[np.int64]
Taps = tuple[Offsets, Array]
"""Offsets from fine sample 2i, ascending and without gaps, and the weights there."""
Registration = Literal["area", "point"]

_GRID = 2.0**-52  # sums of a few multiples of this, below 2 in magnitude, are exact in any order


def kernel_shape(kernel: str, radius: int, distance: ArrayLike) -> Array:
    """Return the unscaled weight at ``distance`` [fine samples] from the coarse sample's centre.

    ``kernel`` is ``blackman-sinc``, ``lanczos``, ``kaiser:<beta>``, or, of radius 1 only, ``box`` and ``triangle``. Raises
    ValueError for any other.
    """
    x = np.asarray(distance, np.float64)
    t = x / (2 * radius)
    inside = np.abs(t) < 1
    name, _, parameter = kernel.partition(":")
    if name in ("box", "triangle"):
        if radius != 1:
            raise ValueError(f"kernel {kernel!r} has radius 1, got {radius}")
        return np.where(np.abs(x) <= 1, 1.0, 0.0) if name == "box" else np.maximum(0.0, 1 - np.abs(t))
    if name == "blackman-sinc":
        window = 0.42 + 0.5 * np.cos(np.pi * t) + 0.08 * np.cos(2 * np.pi * t)
    elif name == "lanczos":
        window = np.sinc(t)
    elif name == "kaiser":
        beta = float(parameter)
        window = np.i0(beta * np.sqrt(np.maximum(0.0, 1 - t * t))) / np.i0(beta)
    else:
        raise ValueError(f"unknown kernel {kernel!r}")
    return np.where(inside, np.sinc(x / 2) * window, 0.0)


def taps(kernel: str, radius: int, registration: Registration) -> Taps:
    """Return the offsets from fine sample 2i (int64) and the weights (float64) that make coarse sample i.

    ``area``: coarse cell i spans fine cells 2i and 2i + 1, so its centre lies half a sample right of fine sample 2i; 4r taps
    at offsets -(2r - 1) .. 2r that sum to 1. ``point``: coarse sample i sits on fine sample 2i; 4r - 1 taps at offsets
    -(2r - 1) .. 2r - 1, an exact half-band: the centre is 1/2, other even taps are 0, odd taps sum to 1/2.
    All three sums are exact in float64, in whatever order they are taken.
    """
    if radius < 1:
        raise ValueError(f"radius {radius}: must be at least 1")
    if registration == "area":
        right = _scaled(kernel_shape(kernel, radius, np.arange(2 * radius) + 0.5), 0.5)
        return np.arange(-(2 * radius - 1), 2 * radius + 1), np.concatenate((right[::-1], right))
    offsets = np.arange(-(2 * radius - 1), 2 * radius)
    right = _scaled(kernel_shape(kernel, radius, np.arange(1, 2 * radius, 2)), 0.25)
    weights = np.where(offsets == 0, 0.5, 0.0)
    weights[0::2] = np.concatenate((right[::-1], right))  # the first offset is odd
    return offsets, weights


def _scaled(shape: Array, total: float) -> Array:
    """Scale one side of a symmetric kernel, innermost weight first, to sum to exactly ``total``.

    Weights are rounded to multiples of 2**-52 and the innermost, largest one takes up the remainder, about 1e-16.
    """
    weights = np.rint(shape * (total / math.fsum(shape)) / _GRID) * _GRID
    weights[0] = total - weights[1:].sum()
    return weights


def positive_taps(registration: Registration) -> Taps:
    """Return the taps of the smallest symmetric positive kernel: 1/2 1/2 for ``area``, 1/4 1/2 1/4 for ``point``."""
    if registration == "area":
        return np.array([0, 1]), np.array([0.5, 0.5])
    return np.array([-1, 0, 1]), np.array([0.25, 0.5, 0.25])


def frequency_response(kernel: str, radius: int, registration: Registration, frequency: ArrayLike) -> Array:
    """Return the response of ``taps`` at ``frequency`` [cycles per coarse sample]; it is real, for kernels are symmetric.

    Coarse Nyquist is 0.5, fine Nyquist is 1. Phase is measured from the coarse sample's centre.
    """
    offsets, weights = taps(kernel, radius, registration)
    distance = offsets - (0.5 if registration == "area" else 0.0)
    phase = np.multiply.outer(np.asarray(frequency, np.float64), np.pi * distance)  # 2 pi (u / 2) x
    return np.asarray((np.cos(phase) * weights).sum(axis=-1), np.float64)


def l1_norm(kernel: str, radius: int, registration: Registration) -> float:
    """Return the sum of the absolute weights of one axis; in two dimensions it is the square."""
    return float(np.abs(taps(kernel, radius, registration)[1]).sum())
