"""A camera that looks at a map, for proofs of what the viewer's effects change on the screen."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.scene import Viewer
from schemas.viewbounds import focal_px

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with the picture of ``viewer``; its eye is the origin of the points that it sees.

    ``yaw_deg`` turns clockwise from north, ``pitch_deg`` is positive upward.
    """

    viewer: Viewer
    yaw_deg: float
    pitch_deg: float

    def project(self, points_m: Float64) -> Float64:
        """Return where ``points_m`` (..., 3), east, north and up of the eye [m], are in the picture, (..., 2) [pixels]; NaN off it."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
        forward = np.array([math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch), math.sin(pitch)])
        across, up, depth = (points_m @ axis for axis in (right, np.cross(right, forward), forward))
        focal = focal_px(self.viewer.width_px, self.viewer.fov_deg)
        depth = np.where(depth > 0, depth, np.nan)
        picture = np.stack([focal * across / depth, focal * up / depth], axis=-1)
        inside = np.all(np.abs(picture) <= (self.viewer.width_px / 2, self.viewer.height_px / 2), axis=-1, keepdims=True)
        return np.asarray(np.where(inside, picture, np.nan), np.float64)

    def largest_shift_px(self, before_m: Float64, after_m: Float64) -> float:
        """Return how far points (..., 3) move in the picture at most [pixels]; 0 if none is in it before and after."""
        moved = np.linalg.norm(self.project(after_m) - self.project(before_m), axis=-1)
        return float(np.nanmax(moved)) if np.isfinite(moved).any() else 0.0


def cameras_around(viewer: Viewer) -> list[Camera]:
    """Return cameras that look all around, level and downward: together they see everything that is not overhead."""
    turns = max(4, math.ceil(360 / viewer.fov_deg))
    return [Camera(viewer, 360 * n / turns, pitch) for pitch in (0.0, -35.0, -80.0) for n in range(turns)]
