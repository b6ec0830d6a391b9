"""Choosing a view when none is given, and circling what a view shows. All of it is deterministic."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from viewer.camera import Camera, Vector, looking_at
from viewer.options import ViewOptions
from viewer.scene import Scene

AZIMUTHS: Final = 24
FLAT: Final = 0.004
"""Relief, as a part of the dataset's diagonal, below which there are no mountains."""
PROMINENT: Final = 0.4
"""Height of the summit above the middle height around it, as a part of the relief, from which it counts as a mountain."""
NEARER: Final = np.array([1.0, 0.75, 0.55, 0.4])
"""Parts of the best distance that are tried until a view has ground below it."""
FARTHEST: Final = 1e6
"""Distance of a view from the dataset, as a multiple of the dataset's size, beyond which not a pixel of it is seen."""
OVERVIEW: Final = math.radians(50)
"""Elevation from which a dataset is seen as a whole."""


@dataclass(frozen=True)
class _Ground:
    """The whole dataset at its coarsest: local positions (count, 3) of its valid samples, exaggerated."""

    points: NDArray[np.float64]
    diagonal_m: float
    relief_m: float

    @property
    def has_mountain(self) -> bool:
        """Whether the highest point stands out from what lies around it, as far as a view of it reaches."""
        summit = self.points[int(self.points[:, 2].argmax())]
        around = np.hypot(*(self.points - summit)[:, :2].T) < self.view_distance_m
        drop = float(summit[2] - np.median(self.points[around, 2]))
        return self.relief_m > FLAT * self.diagonal_m and drop > PROMINENT * self.relief_m

    @property
    def view_distance_m(self) -> float:
        """Distance from which a mountain as high as the relief fills a picture well."""
        return min(max(3.8 * self.relief_m, 0.02 * self.diagonal_m), 0.5 * self.diagonal_m)


def _ground(scene: Scene, exaggeration: float) -> _Ground:
    level, (z, valid) = scene.overview()
    if not valid.any():
        valid = np.ones_like(valid)
    rows, columns = np.nonzero(valid)
    samples = np.stack([columns, rows], axis=-1) * 2.0**level
    local = samples @ scene.frame.to_local.linear.T + scene.frame.to_local.offset
    points = np.column_stack([local, z[valid].astype(np.float64) * exaggeration])
    size = points[:, :2].max(axis=0) - points[:, :2].min(axis=0)
    relief = float(points[:, 2].max() - np.percentile(points[:, 2], 10))
    return _Ground(points, max(float(np.hypot(*size)), scene.frame.spacing_m), relief)


def default_camera(scene: Scene, options: ViewOptions, target: tuple[float, float] | None = None) -> Camera:
    """Return a view of the highest mountain, or of ``target`` (local metres), with as much of the dataset behind it as can be.

    Among views that show about as much, one from the sunny side is taken. Where nothing stands out, on plains and on
    plateaus cut by canyons, the whole dataset is shown, obliquely from the south.
    """
    ground = _ground(scene, options.exaggeration)
    if target is not None:
        summit = np.array([*target, (scene.ground_m(*target) or 0.0) * options.exaggeration])
    elif ground.has_mountain:
        summit = ground.points[int(ground.points[:, 2].argmax())]
    else:
        return _overview_camera(ground, options)
    for distance in ground.view_distance_m * NEARER:
        turns = np.arange(AZIMUTHS) * (2 * math.pi / AZIMUTHS)
        eyes = [_eye(scene, ground, summit, float(distance), float(turn), options.exaggeration) for turn in turns]
        over = [eye for eye in eyes if _is_over(scene, eye)]
        if over:
            best = max(over, key=lambda eye: _score(ground, eye, summit, options) * _filled(scene, eye, summit, options) ** 2)
            aim = summit - (0.0, 0.0, 0.45 * min(ground.relief_m, float(distance)))
            return looking_at(best, aim, options.fov_deg)
    return _overview_camera(ground, options)


def _eye(scene: Scene, ground: _Ground, summit: Vector, distance: float, azimuth: float, exaggeration: float) -> Vector:
    x, y = summit[0] + distance * math.sin(azimuth), summit[1] + distance * math.cos(azimuth)
    low = float(np.percentile(ground.points[:, 2], 10))
    height = low + 1.1 * min(ground.relief_m, distance)
    # High enough above the ridges on the way that none of them stands in front of the summit.
    for part in np.linspace(0.3, 1.0, 8):
        on_way = scene.ground_m(summit[0] + part * (x - summit[0]), summit[1] + part * (y - summit[1]))
        if on_way is not None:
            height = max(height, on_way * exaggeration + 0.08 * distance * part)
    return np.array([x, y, height])


def _score(ground: _Ground, eye: Vector, summit: Vector, options: ViewOptions) -> float:
    """Part of the dataset inside the horizontal field of view, worth up to half as much again from the sunny side."""
    ahead = (summit - eye)[:2] / np.hypot(*(summit - eye)[:2])
    offsets = ground.points[:, :2] - eye[:2]
    along = offsets @ ahead
    across = np.abs(offsets @ np.array([ahead[1], -ahead[0]]))
    half_width = _half_width(options)
    seen = float(((along > 0) & (across < along * half_width)).mean())
    sunny = 0.0
    if options.sun_deg is not None:
        sun = math.radians(options.sun_deg[0])
        sunny = -float(ahead @ (math.sin(sun), math.cos(sun)))
    return seen * (1.0 + 0.5 * sunny)


def _filled(scene: Scene, eye: Vector, summit: Vector, options: ViewOptions) -> float:
    """Part of the picture's width in which there is ground, halfway to the summit and at its distance."""
    ahead = (summit - eye)[:2]
    sideways = np.array([ahead[1], -ahead[0]]) * _half_width(options)
    points = [eye[:2] + part * (ahead + across * sideways) for part in (0.5, 1.0) for across in np.linspace(-0.9, 0.9, 9)]
    return sum(_is_over(scene, point) for point in points) / len(points)


def _half_width(options: ViewOptions) -> float:
    """Half the width of the picture at unit distance."""
    return math.tan(math.radians(options.fov_deg) / 2) * options.size[0] / options.size[1]


def _is_over(scene: Scene, eye: Vector) -> bool:
    """Whether there is ground below the eye; beside the dataset, its cut edge would fill the foreground."""
    column, row = scene.frame.sample_at(float(eye[0]), float(eye[1]))
    extent = scene.heights.extent(0)
    return 0 <= column <= extent.width - 1 and 0 <= row <= extent.height - 1


def _overview_camera(ground: _Ground, options: ViewOptions) -> Camera:
    low, high = ground.points.min(axis=0), ground.points.max(axis=0)
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    middle = (low + high) / 2
    back = np.array([0.0, -math.cos(OVERVIEW), math.sin(OVERVIEW)])
    camera = looking_at(middle + ground.diagonal_m * back, middle, options.fov_deg)
    for distance in np.geomspace(0.2 * ground.diagonal_m, 100 * ground.diagonal_m, 200):
        camera = looking_at(middle + distance * back, middle, options.fov_deg)
        matrix = camera.view_projection(options.size[0] / options.size[1], 1e-3 * distance, 10 * distance)
        relative = corners - (camera.x_m, camera.y_m, camera.z_m)
        x, y, _, w = matrix @ np.column_stack([relative, np.ones(len(corners))]).T
        if (w > 0).all() and (np.maximum(np.abs(x), np.abs(y)) < 0.94 * w).all():
            break
    return camera


def focus(scene: Scene, camera: Camera, exaggeration: float) -> Vector:
    """Return the point of the ground in the middle of the picture, or one as far ahead as the camera is high if there is none."""
    eye, forward = np.array([camera.x_m, camera.y_m, camera.z_m]), camera.forward
    below = scene.ground_m(camera.x_m, camera.y_m)
    height = max(camera.z_m - (below or 0.0) * exaggeration, scene.frame.spacing_m)
    for distance in np.geomspace(height, 1e4 * height, 800):
        point = eye + distance * forward
        ground = scene.ground_m(point[0], point[1])
        if ground is not None and point[2] <= ground * exaggeration:
            return np.asarray(point)
    return np.asarray(eye + height * forward)


def orbit(camera: Camera, centre: Vector, turn_deg: float) -> Camera:
    """Return the camera carried clockwise around the vertical axis through ``centre``, still looking the same way at it."""
    angle = math.radians(turn_deg)
    x, y = camera.x_m - centre[0], camera.y_m - centre[1]
    moved = replace(
        camera,
        x_m=float(centre[0] + x * math.cos(angle) + y * math.sin(angle)),
        y_m=float(centre[1] - x * math.sin(angle) + y * math.cos(angle)),
    )
    return moved.turned(turn_deg, 0.0)


def place_at(scene: Scene, x: float, y: float) -> tuple[float, float]:
    """Return local metres of a world position; raises UsageError if nothing of the dataset could be seen from there."""
    with np.errstate(over="ignore", invalid="ignore"):
        place = scene.frame.local_of_world(x, y)
    _check_near(scene, place, f"{x:g},{y:g}")
    return place


def _check_near(scene: Scene, lengths_m: Iterable[float], where: str) -> None:
    extent = scene.heights.extent(0)
    side_m = max(extent.width, extent.height) * max(scene.frame.to_local.steps)
    farthest_m = FARTHEST * (side_m + max(map(abs, scene.z_range_m)))
    if not all(abs(length) <= farthest_m for length in lengths_m):
        raise UsageError(f"{where}: more than a million times as far away as the dataset is large; positions are world coordinates")


def camera_at(scene: Scene, view: tuple[float, float, float, float, float], fov_deg: float) -> Camera:
    """Return the camera of a view (world x, world y, metres z, yaw, pitch in degrees); raises UsageError if it is out of range."""
    x, y, z_m, yaw_deg, pitch_deg = view
    if not -90.0 <= pitch_deg <= 90.0:
        raise UsageError(f"view pitch {pitch_deg:g}: must be from -90 (down) to 90 (up) degrees")
    x_m, y_m = place_at(scene, x, y)
    _check_near(scene, [z_m], f"view height {z_m:g} m")
    return Camera(x_m, y_m, z_m, yaw_deg % 360.0, pitch_deg, fov_deg)


def view_text(scene: Scene, camera: Camera) -> str:
    """Return what ``camera_at`` takes to make this camera again, within a thousandth of the spacing of heights."""
    x, y = scene.frame.world_of_local(camera.x_m, camera.y_m)
    step = math.sqrt(abs(float(np.linalg.det(scene.frame.to_world.linear))))
    places = max(0, 3 - math.floor(math.log10(step)))
    return f"{x:.{places}f},{y:.{places}f},{camera.z_m:.2f},{camera.yaw_deg:.2f},{camera.pitch_deg:.2f}"
