"""A built-in terrain, so that clipmap can be tried and measured without any download: a mountainous island and its picture.

Heights are a sum of ridged octaves of gradient noise (Perlin 1985; Musgrave 1989 for the ridges), each weighed by the one
before so that valleys stay smooth, over a falloff to the sea. Everything follows from the seed.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float64]

_OCTAVES: Final = 9
_PERSISTENCE: Final = 0.47
_PEAK_M: Final = 2400.0


@dataclass(frozen=True, slots=True)
class Island:
    """A square island: heights (side + 1, side + 1) float32 [m] at grid vertices, colour (2 side, 2 side, 3) uint8 in cells."""

    heights_m: NDArray[np.float32]
    colour: NDArray[np.uint8]
    spacing_m: float


def make_island(side: int = 1024, spacing_m: float = 20.0, seed: int = 7) -> Island:
    """Return the island of ``side`` cells along an edge; its picture has twice the resolution of its heights."""
    heights = _heights_m(np.linspace(0, 1, side + 1), seed)
    fine = _at_half_cells(_at_half_cells(heights).T).T
    return Island(heights.astype(np.float32), _colour(fine, spacing_m / 2, seed), spacing_m)


def _at_half_cells(rows: Field) -> Field:
    """Return ``rows`` (n + 1, m) interpolated at the centres of half cells, (2 n, m)."""
    upper, lower = rows[:-1], rows[1:]
    return np.stack([0.75 * upper + 0.25 * lower, 0.25 * upper + 0.75 * lower], axis=1).reshape(-1, rows.shape[1])


def _heights_m(places: Field, seed: int) -> Field:
    """Return heights [m] at the square grid of ``places``, 0 to 1 along each axis."""
    u, v = np.meshgrid(places, places)
    bend_x, bend_y = (_noise(3 * u, 3 * v, seed + 100 + axis) for axis in (0, 1))
    u, v = u + 0.06 * bend_x, v + 0.06 * bend_y
    total, weight, amplitude, norm = np.zeros_like(u), np.ones_like(u), 1.0, 0.0
    for octave in range(_OCTAVES):
        frequency = 2.5 * 2**octave
        ridge = (1 - np.abs(_noise(frequency * u, frequency * v, seed + octave))) ** 2
        total += amplitude * weight * ridge
        norm += amplitude
        weight = np.clip(1.6 * weight * ridge, 0, 1)
        amplitude *= _PERSISTENCE
    radius = np.hypot(u - 0.5, v - 0.5)
    island = np.clip(1.15 - 2.05 * radius, 0, 1)
    dome = np.exp(-((radius / 0.16) ** 2))
    shape = (total / norm) * island**1.3 * (0.55 + 0.75 * dome)
    return np.maximum(0.0, (shape - 0.07) * _PEAK_M / 0.75)


def _noise(x: Field, y: Field, seed: int) -> Field:
    """Gradient noise in about -1 to 1 with a period of 256 cells."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(256)
    angle = rng.uniform(0, 2 * np.pi, 256)
    cosine, sine = np.cos(angle), np.sin(angle)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - left, y - top

    def corner(i: int, j: int) -> Field:
        index = order[(order[(left + i) & 255] + top + j) & 255]
        result: Field = cosine[index] * (fx - i) + sine[index] * (fy - j)
        return result

    sx, sy = (t * t * t * (t * (6 * t - 15) + 10) for t in (fx, fy))
    upper = corner(0, 0) + sx * (corner(1, 0) - corner(0, 0))
    lower = corner(0, 1) + sx * (corner(1, 1) - corner(0, 1))
    noise: Field = 1.5 * (upper + sy * (lower - upper))
    return noise


def _colour(heights_m: Field, spacing_m: float, seed: int) -> NDArray[np.uint8]:
    """Return sRGB colours by height and slope: sea, beach, meadow, forest, rock, snow."""
    slope = np.hypot(*np.gradient(heights_m, spacing_m))
    side = np.linspace(0, 1, heights_m.shape[0])
    grain = _noise(*np.meshgrid(90 * side, 90 * side), seed + 50)
    height = heights_m + 60 * grain
    stops = [-200.0, 8, 60, 500, 1100, 1500, 3000]
    palette = np.array(
        [(194, 178, 128), (194, 178, 128), (104, 132, 66), (58, 92, 48), (92, 104, 66), (124, 116, 104), (136, 130, 124)], np.float64
    )
    colour = np.stack([np.interp(height, stops, palette[:, channel]) for channel in range(3)], axis=-1)
    rock = np.clip((slope - 0.75) / 0.5, 0, 1)[..., np.newaxis]
    colour = colour * (1 - rock) + np.array((112, 104, 96)) * rock
    snow = (np.clip((height - 1350) / 250, 0, 1) * np.clip((1.5 - slope) / 0.6, 0, 1))[..., np.newaxis]
    colour = colour * (1 - snow) + np.array((240, 244, 248)) * snow
    colour *= 1 + 0.06 * grain[..., np.newaxis]
    sea = (heights_m <= 0)[..., np.newaxis]
    return np.clip(np.rint(np.where(sea, np.array((38, 78, 120)), colour)), 0, 255).astype(np.uint8)
