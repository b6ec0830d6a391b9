"""A kernel's figures, all computed from its taps: none is quoted from a table."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiler.filters.kernels import Kernel, frequency_response

_FLOOR = 1e-10
"""Gains below this are shown as -200 dB: the taps are multiples of 2**-23, so a deeper stopband is chance."""


@dataclass(frozen=True, slots=True)
class Figures:
    """What the taps say: gains in decibels at frequencies u in cycles per coarse sample, of which 0.5 is Nyquist's."""

    taps: int
    dc_gain: float
    """Sum of the taps; exactly 1."""
    nyquist_gain: float
    """Gain at the finer level's Nyquist frequency, u = 1: a checkerboard's."""
    droop_quarter_db: float
    """Gain at u = 0.25."""
    droop_passband_db: float
    """Gain at u = 0.40."""
    stopband_db: float
    """Largest gain at u from 0.6 to 1."""
    far_stopband_db: float
    """Largest gain at u from 0.75 to 1."""
    step_overshoot_percent: float
    """How far the response to a step goes beyond it, at the worst place of the step."""
    l1_norm: float
    """Sum of absolute taps in two dimensions: no result exceeds the largest sample by a larger factor."""


def figures(kernel: Kernel) -> Figures:
    """Return the figures of ``kernel``; the stopband is searched on a grid of 1/2000 cycle."""
    offsets, weights = kernel.taps()
    return Figures(
        taps=len(offsets),
        dc_gain=float(weights.sum()),
        nyquist_gain=float(frequency_response(kernel, np.array([1.0]))[0]),
        droop_quarter_db=_decibel(kernel, np.array([0.25])),
        droop_passband_db=_decibel(kernel, np.array([0.4])),
        stopband_db=_decibel(kernel, np.linspace(0.6, 1, 801)),
        far_stopband_db=_decibel(kernel, np.linspace(0.75, 1, 501)),
        step_overshoot_percent=100 * max(0.0, float(np.cumsum(weights).max()) - 1),
        l1_norm=float(np.abs(weights).sum()) ** 2,
    )


def _decibel(kernel: Kernel, frequency: NDArray[np.float64]) -> float:
    """Return the largest gain [dB] at the given frequencies."""
    gain = np.abs(frequency_response(kernel, frequency)).max()
    return float(20 * np.log10(max(gain, _FLOOR)))
