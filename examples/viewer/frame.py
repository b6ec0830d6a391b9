"""From samples to the world to local metres: affine maps in float64.

Three coordinate systems meet in the viewer. *Samples* are level-0 column and row of the height layer; all clipmap
arithmetic is done in them. *World* coordinates are the dataset's own. *Local* metres point east and north from the height
layer's sample (0, 0); the camera lives there. Imagery has samples of its own, reached through the world.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.manifest import Layer, Transform, World

Matrix = NDArray[np.float64]

_METRES: Final = {"metre": 1.0, "foot": 0.3048, "us-foot": 1200 / 3937, "unknown": 1.0}
_METRES_PER_DEGREE: Final = 111_320.0
"""Length of a degree of the equator [m], used only where the manifest does not give the ground spacing."""

_STEPS: Final = (1e-12, 1e12)
"""Least and greatest distance between samples, in world units and in metres: beyond any survey, far within float64's range."""
_FLAT: Final = 1e-9
"""Area of a cell as a part of what its sides would span at right angles, below which the plane is squeezed onto a line."""
_FAR: Final = 2.0**52
"""Distance from the origin [samples] beyond which float64 cannot tell two neighbouring samples apart."""
_RATIO: Final = 2.0**24
"""Greatest ratio between the spacings of heights and imagery."""


@dataclass(frozen=True)
class Affine:
    """The map p -> linear @ p + offset of the plane."""

    linear: Matrix
    offset: Matrix

    @classmethod
    def of(cls, transform: Transform) -> "Affine":
        """Return the map of a manifest's (a, b, c, d, e, f)."""
        a, b, c, d, e, f = transform
        return cls(np.array([[a, b], [d, e]], np.float64), np.array([c, f], np.float64))

    def __call__(self, x: float, y: float) -> tuple[float, float]:
        """Return the image of the point (x, y)."""
        result = self.linear @ (x, y) + self.offset
        return float(result[0]), float(result[1])

    def inverse(self) -> "Affine":
        """Return the inverse map; raises InputError if there is none."""
        if abs(float(np.linalg.det(self.linear))) <= _FLAT * math.prod(self.steps):
            raise InputError("the layer's transform squeezes the plane onto a line; rebuild the layer")
        linear = np.asarray(np.linalg.inv(self.linear), np.float64)
        return Affine(linear, -linear @ self.offset)

    @property
    def steps(self) -> tuple[float, float]:
        """Lengths of a step along x and of one along y."""
        return math.hypot(*self.linear[:, 0]), math.hypot(*self.linear[:, 1])

    def after(self, first: "Affine") -> "Affine":
        """Return the map that applies ``first``, then this one."""
        return Affine(self.linear @ first.linear, self.linear @ first.offset + self.offset)


@dataclass(frozen=True)
class LocalFrame:
    """Level-0 height samples, world and local metres of one dataset."""

    to_world: Affine
    to_local: Affine

    @property
    def spacing_m(self) -> float:
        """Side of a square of the same area as the cell between four samples [m]."""
        return math.sqrt(abs(float(np.linalg.det(self.to_local.linear))))

    def sample_at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the sample coordinates (column, row) under a local position."""
        return self.to_local.inverse()(x_m, y_m)

    def local_of_world(self, x: float, y: float) -> tuple[float, float]:
        """Return local metres of a world position."""
        return self.to_local.after(self.to_world.inverse())(x, y)

    def world_of_local(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the world position of local metres."""
        return self.to_world.after(self.to_local.inverse())(x_m, y_m)


def local_frame(layer: Layer, world: World) -> LocalFrame:
    """Return the frame in which ``layer``'s samples lie ``ground_spacing_m`` apart; world units are used if that is not known.

    Raises InputError if no survey can have such samples: too near, too far apart, on a line, or too far from the origin.
    """
    to_world = _placed(layer)
    scale = _metres_per_unit(layer, world, to_world)
    linear = np.diag(scale) @ to_world.linear
    return LocalFrame(to_world, Affine(linear, np.zeros(2)))


def _placed(layer: Layer) -> Affine:
    """Return the map from the layer's samples to the world; raises InputError if nothing can be drawn with it."""
    to_world = Affine.of(layer.transform)
    low, high = _STEPS
    for steps, unit in ((to_world.steps, "world units"), (layer.ground_spacing_m or (), "metres")):
        for step in steps:
            if not low <= step <= high:
                raise InputError(f"the {layer.kind} layer's samples lie {step:g} {unit} apart, which cannot be drawn; rebuild the layer")
    if max(np.abs(to_world.inverse().offset)) > _FAR:
        raise InputError(f"the {layer.kind} layer's transform puts it too far from the world's origin to tell samples apart; rebuild it")
    return to_world


def _metres_per_unit(layer: Layer, world: World, to_world: Affine) -> Matrix:
    """Return metres per world unit along x and along y at the layer's centre."""
    if layer.ground_spacing_m is None:
        if world.unit != "degree":
            return np.full(2, _METRES[world.unit])
        latitude = to_world(layer.width / 2, layer.height / 2)[1]
        return np.array([_METRES_PER_DEGREE * max(1e-3, math.cos(math.radians(latitude))), _METRES_PER_DEGREE])
    spacing = np.array(layer.ground_spacing_m, np.float64)
    # A step along a row is (a, d) world units long: (a kx)^2 + (d ky)^2 = spacing^2, and likewise for a column.
    squares = to_world.linear.T**2
    if abs(np.linalg.det(squares)) > 1e-9 * np.abs(squares).max() ** 2:
        solved = np.linalg.solve(squares, spacing**2)
        if (solved > 0).all():
            return np.asarray(np.sqrt(solved), np.float64)
    # Turned by 45 degrees, or spacings that contradict the transform: both axes get the mean scale.
    return np.full(2, math.sqrt(float(np.prod(spacing)) / abs(float(np.linalg.det(to_world.linear)))))


def texel_map(heights: LocalFrame, imagery: Layer) -> Affine:
    """Return the map from height samples to level-0 texel coordinates of ``imagery``.

    Texel coordinates are those of a texture: texel i reaches from i to i + 1. A point-registered layer's sample i is the
    middle of its texel on level 0; coarser levels of such a layer go through ``level_texel``. Raises InputError if the
    imagery lies elsewhere, or so much finer or coarser than the heights that the two do not belong together.
    """
    to_texel = _placed(imagery).inverse()
    if imagery.registration == "point":
        to_texel = Affine(to_texel.linear, to_texel.offset + 0.5)
    both = to_texel.after(heights.to_world)
    if max(np.abs(both.offset)) > _FAR or not all(1 / _RATIO <= step <= _RATIO for step in both.steps):
        raise InputError("imagery and heights differ too much in place or spacing to be drawn together; rebuild one of them")
    return both


def level_texel(texel: float, level: int, registration: str) -> float:
    """Return where level-0 texel coordinate ``texel`` lies on ``level``, in float64.

    Halving keeps cell corners on cell corners (``area``); for ``point`` it is the samples, half a texel in, that must stay put.
    """
    if registration == "point":
        return math.ldexp(texel - 0.5, -level) + 0.5
    return math.ldexp(texel, -level)
