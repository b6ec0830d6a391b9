"""Terrains that try to break bounds, with the sun they are meant for."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

Array = NDArray[np.float64]
CELLS = ((1.0, 1.0), (10.0, 30.0), (100.0, 1.0), (0.02, 0.05))


@dataclass(frozen=True, eq=False)
class Case:
    """Heights (h, w), NaN where void, the distances of their samples, and a sun."""

    z: Array
    cell: tuple[float, float]
    azimuth: float
    elevation: float

    @property
    def sun(self) -> tuple[float, float]:
        return self.azimuth, self.elevation

    def __repr__(self) -> str:
        return f"Case({self.z.tolist()}, {self.cell}, {self.azimuth}, {self.elevation})"


Rng = np.random.Generator


def _spike(rng: Rng, i: Array, j: Array) -> Array:
    return np.asarray((i == rng.integers(i.shape[0])) & (j == rng.integers(j.shape[1])), np.float64)


def _plane(rng: Rng, i: Array, j: Array) -> Array:
    return np.asarray((i * rng.normal() + j * rng.normal()) / max(i.shape), np.float64)


def _cone(rng: Rng, i: Array, j: Array) -> Array:
    distance = np.hypot(i - rng.uniform(0, i.shape[0]), j - rng.uniform(0, i.shape[1]))
    return np.asarray(1 - distance / max(i.shape), np.float64)


SHAPES: dict[str, Callable[[Rng, Array, Array], Array]] = {
    "noise": lambda rng, i, j: rng.uniform(-1, 1, i.shape),
    "spike": _spike,
    "wall": lambda rng, i, j: (np.abs(i - j * rng.uniform(-1, 1) - rng.uniform(0, i.shape[0])) < 1).astype(np.float64),
    "cliff": lambda rng, i, j: np.where(_plane(rng, i, j) > 0.3 * rng.normal(), 1.0, -1.0),
    "ramp": lambda rng, i, j: _plane(rng, i, j) + 1e-3 * rng.uniform(-1, 1, i.shape),
    "terraces": lambda rng, i, j: np.round(3 * _plane(rng, i, j)) / 3,
    "chequers": lambda rng, i, j: (i + j) % 2 * 2 - 1,
    "cone": _cone,
    "saddle": lambda rng, i, j: (i - i.shape[0] / 2) * (j - i.shape[1] / 2) / i.size,
    "walk": lambda rng, i, j: np.cumsum(rng.uniform(-1, 1, i.shape), axis=int(rng.integers(2))) / max(i.shape),
}
"""Heights (h, w) between about -1 and 1 for rows ``i`` and columns ``j``."""


@st.composite
def cases(draw: st.DrawFn, voids: bool = True, largest: int = 11) -> Case:
    """A terrain about as steep as its sun is high, so that bounds are nearly reached; sometimes with voids or a large offset."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    height, width = draw(st.integers(1, largest)), draw(st.integers(1, largest))
    cell = draw(st.sampled_from(CELLS))
    azimuth = draw(
        st.sampled_from([0.0, 90.0, 180.0, 270.0, 45.0, 44.9999999, 300.0, 17.3, 225.0]) | st.integers(0, 35999).map(lambda n: n / 100)
    )
    elevation = draw(st.sampled_from([0.5, 3.0, 10.0, 45.0, 80.0]) | st.integers(-50, 900).map(lambda n: n / 10))
    i, j = np.mgrid[0:height, 0:width].astype(np.float64)
    z = SHAPES[draw(st.sampled_from(sorted(SHAPES)))](rng, i, j)
    steep = max(float(np.abs(np.diff(z, axis=axis)).max(initial=0)) / cell[1 - axis] for axis in (0, 1))
    slope = math.tan(math.radians(min(max(elevation, 0.2), 85))) * draw(st.sampled_from([0.01, 0.5, 0.9, 0.999, 1.0, 1.001, 1.2, 3.0]))
    z = z * (slope / steep if steep > 0 else 1.0) + draw(st.sampled_from([0.0, 0.0, -430.0, 8848.0]))
    if voids and draw(st.booleans()):
        z[rng.random(z.shape) < draw(st.sampled_from([0.05, 0.3, 0.8]))] = np.nan
        z[rng.integers(height), rng.integers(width)] = 0.0
    return Case(z, cell, azimuth, elevation)
