"""The camera: a float64 position in local metres, a heading, and matrices that never hold the position."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """Where the viewer is and looks.

    ``x_m`` and ``y_m`` are local metres east and north, ``z_m`` metres above height 0. ``yaw_deg`` turns clockwise from
    north, ``pitch_deg`` is positive upwards, ``fov_deg`` is the vertical field of view.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    fov_deg: float = 45.0

    @property
    def forward(self) -> Vector:
        """Unit vector (east, north, up) of the line of sight."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        return np.array([math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch), math.sin(pitch)])

    @property
    def right(self) -> Vector:
        """Unit vector to the right, level."""
        yaw = math.radians(self.yaw_deg)
        return np.array([math.cos(yaw), -math.sin(yaw), 0.0])

    @property
    def rotation(self) -> Matrix:
        """3 x 3 matrix from local directions to eye directions (x right, y up, z backwards)."""
        up = np.cross(self.right, self.forward)
        return np.stack([self.right, up, -self.forward])

    def moved(self, east_m: float, north_m: float, up_m: float) -> "Camera":
        """Return the camera moved by local metres."""
        return replace(self, x_m=self.x_m + east_m, y_m=self.y_m + north_m, z_m=self.z_m + up_m)

    def turned(self, yaw_deg: float, pitch_deg: float) -> "Camera":
        """Return the camera turned by degrees; it never looks past straight up or down."""
        return replace(self, yaw_deg=(self.yaw_deg + yaw_deg) % 360.0, pitch_deg=max(-90.0, min(90.0, self.pitch_deg + pitch_deg)))

    def view_projection(self, aspect: float, near_m: float, far_m: float) -> Matrix:
        """Return the 4 x 4 matrix from metres relative to the camera to clip space; the position is not in it."""
        view = np.eye(4)
        view[:3, :3] = self.rotation
        return perspective(self.fov_deg, aspect, near_m, far_m) @ view

    def pixels_per_radian(self, height_px: int) -> float:
        """Pixels that one unit of length covers at one unit of distance in the middle of a picture of ``height_px`` rows."""
        return height_px / (2 * math.tan(math.radians(self.fov_deg) / 2))


def perspective(fov_deg: float, aspect: float, near_m: float, far_m: float) -> Matrix:
    """Return OpenGL's projection matrix for a vertical field of view."""
    focal = 1 / math.tan(math.radians(fov_deg) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal / aspect, focal
    matrix[2, 2] = (far_m + near_m) / (near_m - far_m)
    matrix[2, 3] = 2 * far_m * near_m / (near_m - far_m)
    matrix[3, 2] = -1.0
    return matrix


def looking_at(eye: Vector, target: Vector, fov_deg: float) -> Camera:
    """Return a camera at ``eye`` that looks at ``target``, both (east, north, up) in local metres."""
    x_m, y_m, z_m = (float(part) for part in eye)
    east, north, up = (float(part) for part in target - eye)
    level = math.hypot(east, north)
    yaw = math.degrees(math.atan2(east, north)) % 360.0
    return Camera(x_m, y_m, z_m, yaw, math.degrees(math.atan2(up, level)), fov_deg)
