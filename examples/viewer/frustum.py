"""Which patches cannot be seen: their boxes against the planes of the view (Losasso & Hoppe, section 6.4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viewer.footprint import Patch, shape_sizes
from viewer.stack import Origin

Matrix = NDArray[np.float64]


def planes_of(view_projection: Matrix) -> Matrix:
    """Return the left, right, bottom, top and near plane (5, 4) of a view: a point p is inside where plane @ (p, 1) >= 0.

    The far plane is left out: it is put behind all there is.
    """
    x, y, z, w = view_projection
    return np.stack([w + x, w - x, w + y, w - y, w + z])


@dataclass(frozen=True)
class Culling:
    """Drops the patches of a frame whose boxes lie outside one plane.

    ``to_metres`` is the 2 x 2 matrix from level-0 samples to local metres; ``z_range_m`` holds the heights that occur, relative
    to the camera.
    """

    planes: Matrix
    to_metres: Matrix
    z_range_m: tuple[float, float]
    viewer: tuple[float, float]
    origins: Sequence[Origin]
    n: int

    def __call__(self, level: int, patches: Sequence[Patch]) -> list[Patch]:
        """Return the patches of ``level`` that may be seen."""
        sizes = shape_sizes(self.n)
        boxes = np.array([(patch.x, patch.y, *sizes[patch.shape]) for patch in patches], np.float64)
        lows = boxes[:, :2] + self.origins[level]
        corners = np.stack([lows + boxes[:, 2:] * (i, j) for j in (0, 1) for i in (0, 1)], axis=1)
        ground = (corners * 2.0**level - self.viewer) @ self.to_metres.T
        seen = np.ones(len(patches), np.bool_)
        for plane in self.planes:
            height = max(plane[2] * self.z_range_m[0], plane[2] * self.z_range_m[1])
            seen &= (ground @ plane[:2]).max(axis=1) + height + plane[3] >= 0
        return [patch for patch, keep in zip(patches, seen.tolist(), strict=True) if keep]
