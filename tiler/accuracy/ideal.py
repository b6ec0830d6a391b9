"""The coarser level that a filter aims at: everything below its Nyquist frequency kept as it is, everything above removed.

This brick-wall decimation is what a sinc of infinite length would give. It is computed per axis by the FFT, so samples beyond the
border have to be assumed: the same ones that clipmap's filters assume. Heights are reflected antisymmetrically, which, after the line
from the first to the last sample has been taken off, is a periodic and smooth sequence (a sine series), so ramps are exact; imagery is
mirrored, which is periodic and continuous as it stands (a cosine series). Neither knows what really lies there: statistics leave
a border out (``MARGIN``).
"""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import Registration
from tiler.filters.edges import EdgeRule

Array = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)

MARGIN: Final = 16
"""Samples of a coarser level that statistics leave out at each border: as many as radius 8 reaches through any number of levels."""


def interior(level: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the part of a coarser level (h, w, ...) that does not depend on what a filter assumes beyond the border."""
    return level[MARGIN:-MARGIN, MARGIN:-MARGIN]


def band_limited(values: Array, level: int, edge: EdgeRule, shift: float = 0.0) -> Array:
    """Return ``values`` (h, w, c) without frequencies above the Nyquist frequency of ``level``, sampled ``shift`` samples on.

    Half of what lies exactly at that frequency is kept. The band is a square, as a level's lattice is.
    """
    channels = [
        _band_limited_rows(_band_limited_rows(values[..., channel], level, edge, shift).T, level, edge, shift).T
        for channel in range(values.shape[2])
    ]
    return np.stack(channels, axis=-1)


def ideal_level(values: Array, level: int, registration: Registration, edge: EdgeRule) -> Array:
    """Return level ``level`` of ``values`` (h, w, c) by brick-wall decimation, (ceil(h / 2**level), ceil(w / 2**level), c)."""
    step = 2**level
    shift = (step - 1) / 2 if registration == "area" else 0.0
    return band_limited(values, level, edge, shift)[::step, ::step]


def _band_limited_rows(values: Array, level: int, edge: EdgeRule, shift: float) -> Array:
    """Filter along the first axis of ``values`` (n, m)."""
    size = len(values)
    if edge == "mirror":
        return _filtered(np.concatenate([values, values[::-1]]), level, shift)[:size]
    place = np.arange(size, dtype=np.float64)[:, np.newaxis]
    slope = (values[-1] - values[0]) / (size - 1)
    rest = values - (values[0] + slope * place)
    line: Array = values[0] + slope * (place + shift)
    return _filtered(np.concatenate([rest, -rest[-2:0:-1]]), level, shift)[:size] + line


def _filtered(periodic: Array, level: int, shift: float) -> Array:
    frequency = np.fft.rfftfreq(len(periodic))
    limit = 0.5 / 2**level
    gain = np.where(frequency < limit, 1.0, np.where(frequency == limit, 0.5, 0.0))
    spectrum = np.fft.rfft(periodic, axis=0) * (gain * np.exp(2j * np.pi * frequency * shift))[:, np.newaxis]
    result: Array = np.fft.irfft(spectrum, n=len(periodic), axis=0)
    return result


def power_law_terrain(side: int, exponent: float = 3.0, rms: float = 400.0, seed: int = 1) -> Array:
    """Return heights (side + 1, side + 1, 1) [m] that repeat every ``side`` samples and have a power spectrum of exactly k**-exponent.

    Random phases and fixed amplitudes (Saupe in Peitgen & Saupe, "The Science of Fractal Images", 1988, 2.5), so the spectrum is known
    and not only expected. Natural terrain is near k**-3.
    """
    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((side, side)))
    field = np.fft.irfft2(noise / np.abs(noise) * _law(side, exponent), s=(side, side))
    field *= rms / field.std()
    return np.pad(field, (0, 1), mode="wrap")[..., np.newaxis]


def _law(side: int, exponent: float) -> Array:
    """Return the amplitudes of ``rfft2`` of the power-law field, unscaled."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, np.newaxis], np.fft.rfftfreq(side)[np.newaxis, :])
    frequency[0, 0] = np.inf
    amplitude: Array = frequency ** (-exponent / 2)
    return amplitude


def predicted_errors(side: int, exponent: float, rms: float, gain: Array) -> tuple[float, float]:
    """Return the rms of droop and alias of level 1 that a kernel must have on ``power_law_terrain``, by Parseval's theorem.

    ``gain`` is the kernel's response at frequencies k / side, k = 0 .. side / 2. No sample is filtered for it: agreement with
    what is measured checks kernel, loops and ideal at once.
    """
    power = _law(side, exponent) ** 2
    power[:, 1 : (side + 1) // 2] *= 2  # rfft2 leaves out the conjugate half
    power *= rms**2 / power.sum()
    rows = gain[np.abs(np.rint(np.fft.fftfreq(side) * side)).astype(np.intp)]
    response = np.outer(rows, gain)
    below = (np.arange(side // 2 + 1) < side / 4) + 0.5 * (np.arange(side // 2 + 1) == side / 4)
    kept = np.outer(below[np.abs(np.rint(np.fft.fftfreq(side) * side)).astype(np.intp)], below)
    droop = float((power * (kept * (1 - response)) ** 2).sum())
    alias = float((power * ((1 - kept) * response) ** 2).sum())
    return float(np.sqrt(droop)), float(np.sqrt(alias))
