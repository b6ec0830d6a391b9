"""Deterministic inputs for tests: natural spectra with a known power law, and inputs made to break things.

Arrays are [row, column, channel]: heights (h, w, 1) float64 in metres, images (h, w, 3) uint8, masks (h, w) bool (True is
valid). Same arguments, same samples, up to rounding in the FFT.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def power_law_field(height: int, width: int, seed: int, exponent: float) -> Array:
    """Return a periodic field (h, w) of mean 0 and variance 1 whose 2-D power spectrum is exactly k**-exponent.

    k is the radial frequency in cycles per sample. Spectral synthesis with random phases and *fixed* amplitudes (Saupe in
    Peitgen and Saupe, "The Science of Fractal Images", 1988, section 2.5): the periodogram is the law itself, without scatter.
    """
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    frequency[0, 0] = 1.0
    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((height, width)))
    spectrum = noise / np.abs(noise) * frequency ** (-exponent / 2)
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, s=(height, width))
    return np.asarray(field / field.std(), np.float64)


def terrain(height: int, width: int, seed: int = 1, *, exponent: float = 3.0, rms_m: float = 400.0, mean_m: float = 1000.0) -> Array:
    """Return mountains (h, w, 1) [m] of the given mean and rms; natural terrain has a power spectrum near k**-3."""
    return (mean_m + rms_m * power_law_field(height, width, seed, exponent))[:, :, None]


def coast(height: int, width: int, seed: int = 1, sea_m: float = 0.0) -> Array:
    """Return ``terrain`` around sea level with everything below ``sea_m`` flat: plateaus and a sharp shore line."""
    return np.maximum(terrain(height, width, seed, mean_m=sea_m), sea_m)


def photo(height: int, width: int, seed: int = 1) -> Image:
    """Return a colour image (h, w, 3) uint8 with the 1/f amplitude of natural images: strong luminance, weak correlated chroma.

    Field, "Relations between the statistics of natural images and the response properties of cortical cells", 1987.
    """
    luminance, red, blue = (power_law_field(height, width, 3 * seed + i, 2.0) for i in range(3))
    colour = np.stack((luminance + 0.3 * red, luminance - 0.15 * red - 0.15 * blue, luminance + 0.3 * blue), axis=-1)
    return np.clip(np.rint(120 + 48 * colour), 0, 255).astype(np.uint8)


def constant(height: int, width: int, value: float) -> Array:
    """Return (h, w, 1) of one value."""
    return np.full((height, width, 1), value)


def ramp(height: int, width: int, right: float, down: float, start: float = 0.0) -> Array:
    """Return the plane (h, w, 1) that grows by ``right`` per column and ``down`` per row."""
    return (start + down * np.arange(height)[:, None] + right * np.arange(width)[None, :])[:, :, None]


def checkerboard(height: int, width: int, low: float = 0.0, high: float = 1.0, cell: int = 1) -> Array:
    """Return a checkerboard (h, w, 1) of squares of ``cell`` samples; ``low`` is at the top left. Cell 1 is at fine Nyquist."""
    odd = (np.arange(height)[:, None] // cell + np.arange(width)[None, :] // cell) % 2 == 1
    return np.where(odd, float(high), float(low))[:, :, None]


def impulse(height: int, width: int, row: int, column: int, value: float = 1.0) -> Array:
    """Return zeros (h, w, 1) with one sample of ``value``."""
    result = np.zeros((height, width, 1))
    result[row, column] = value
    return result


def cliffs(height: int, width: int, step_m: float = 3000.0) -> Array:
    """Return vertical steps (h, w, 1) [m] of both signs along rows, columns and a diagonal, at odd and even samples."""
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    up = (column >= width // 3).astype(np.float64) + (row >= height // 2 + 1)
    return (step_m * (up - (row + column >= height + width // 4)))[:, :, None]


def offset_noise(height: int, width: int, seed: int = 1, offset: float = 1e7, amplitude: float = 1.0) -> Array:
    """Return uniform noise (h, w, 1) of ``offset`` +- ``amplitude``: at 1e7 a float32 resolves no finer than 1."""
    return offset + np.random.default_rng(seed).uniform(-amplitude, amplitude, (height, width, 1))


def int16_extremes(height: int, width: int, seed: int = 1) -> Array:
    """Return (h, w, 1) of nothing but -32768 and 32767 at random: every overshoot leaves the range of int16."""
    return np.random.default_rng(seed).choice(np.array([-32768.0, 32767.0]), (height, width, 1))


def adversarial_heights(height: int, width: int, seed: int = 1) -> dict[str, Array]:
    """Return one of each unkind height field (h, w, 1), by name."""
    return {
        "checkerboard": checkerboard(height, width, -4000.0, 4000.0),
        "impulse": impulse(height, width, height // 2, width // 2, 8848.0),
        "corner impulse": impulse(height, width, height - 1, width - 1, 8848.0),
        "cliffs": cliffs(height, width),
        "coast": coast(height, width, seed),
        "offset noise": offset_noise(height, width, seed),
        "int16 extremes": int16_extremes(height, width, seed),
        "constant": constant(height, width, 1234.567),
        "steep ramp": ramp(height, width, 1000.0, -777.0, -1e5),
    }


def random_mask(height: int, width: int, valid: float, seed: int = 1) -> Mask:
    """Return a mask (h, w) in which each sample is valid with probability ``valid``, on its own."""
    return np.random.default_rng(seed).random((height, width)) < valid


def adversarial_masks(height: int, width: int, seed: int = 1) -> dict[str, Mask]:
    """Return one of each unkind mask (h, w), by name, from almost complete to empty."""
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    centre_distance = np.hypot(row - height / 2, column - width / 2)
    masks: dict[str, NDArray[np.bool_]] = {
        "one void": ~((row == height // 2) & (column == width // 2)),
        "random 95 %": random_mask(height, width, 0.95, seed),
        "random 50 %": random_mask(height, width, 0.5, seed + 1),
        "random 5 %": random_mask(height, width, 0.05, seed + 2),
        "checkerboard": (row + column) % 2 == 0,
        "even columns": (column + 0 * row) % 2 == 0,
        "odd rows": (row + 0 * column) % 2 == 1,
        "no edges": (row > 0) & (column > 0) & (row < height - 1) & (column < width - 1),
        "slanted swath": np.abs(row - column * height / width) < height / 4,
        "disc": centre_distance < min(height, width) / 3,
        "hole": centre_distance >= min(height, width) / 3,
        "one sample": (row == height // 2) & (column == width // 2),
        "corner sample": (row == height - 1) & (column == width - 1),
        "empty": np.zeros((height, width), np.bool_),
    }
    return masks
