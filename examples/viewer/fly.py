"""Flying by keyboard and mouse: what is held down, turned into the next camera. No window, no clock."""

from dataclasses import dataclass, field
from typing import Final, Literal

from viewer.camera import Camera
from viewer.scene import Scene

Motion = Literal["forward", "back", "left", "right", "up", "down"]

HEIGHTS_PER_S: Final = 0.8
"""Speed, in heights above ground per second: the ground passes by equally fast from anywhere."""
FAST: Final = 6.0
CLEARANCE: Final = 0.02
"""Least height above ground, as a part of the spacing of heights."""


@dataclass
class Flight:
    """A camera that moves as long as keys are held."""

    scene: Scene
    camera: Camera
    exaggeration: float
    held: set[Motion] = field(default_factory=set)
    fast: bool = False

    def look(self, right_px: float, down_px: float, height_px: int) -> None:
        """Turn by a drag of the mouse: what was under it stays under it, near the middle of the picture."""
        scale = self.camera.fov_deg / height_px
        self.camera = self.camera.turned(-right_px * scale, down_px * scale)

    def step(self, elapsed_s: float) -> Camera:
        """Move on by ``elapsed_s``, never into the ground, and return the camera."""
        camera, least_m = self.camera, CLEARANCE * self.scene.frame.spacing_m
        below = self._ground_m(camera)
        lowest = self.scene.z_range_m[0] * self.exaggeration
        above_m = max(camera.z_m - (lowest if below is None else below), least_m)
        distance = HEIGHTS_PER_S * above_m * elapsed_s * (FAST if self.fast else 1.0)
        ahead, right, up = (self._axis(*pair) for pair in (("forward", "back"), ("right", "left"), ("up", "down")))
        step = (ahead * camera.forward + right * camera.right) * distance
        moved = camera.moved(float(step[0]), float(step[1]), float(step[2]) + up * distance)
        ground = self._ground_m(moved)
        sunk_m = 0.0 if ground is None else ground + least_m - moved.z_m
        self.camera = moved.moved(0.0, 0.0, sunk_m) if sunk_m > 0 else moved
        return self.camera

    def _axis(self, positive: Motion, negative: Motion) -> int:
        return (positive in self.held) - (negative in self.held)

    def _ground_m(self, camera: Camera) -> float | None:
        ground = self.scene.ground_m(camera.x_m, camera.y_m)
        return None if ground is None else ground * self.exaggeration
