"""From a camera to a frame: update the windows, ask for blocks, and say what to draw. No OpenGL."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from viewer.camera import Camera, Matrix
from viewer.clipmap import GeometryClipmap, TextureClipmap, Update, finest_level
from viewer.drawplan import GeometryPlan, plan_geometry, texture_records
from viewer.effects import View, ViewEffects, decide_effects
from viewer.frustum import Culling, planes_of
from viewer.options import ViewOptions
from viewer.scene import Scene
from viewer.stack import ClipStack, Origin, Sink

NEAR_PART = 0.08
"""Near plane as a part of the height above ground: terrain up to 80 degrees steep is farther away, in the corners too."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Everything the shaders need for one picture."""

    camera: Camera
    size: tuple[int, int]
    """Width and height of the picture [pixels]."""
    geometry: GeometryPlan
    textures: NDArray[np.void] | None
    """``drawplan.TEXTURE_LEVEL`` records; None without imagery."""
    view_projection: Matrix
    origin_m: tuple[float, float, float]
    """Where the clipmap's centre is at height 0, relative to the camera."""
    ground_edge: tuple[float, float, float, float]
    """The edge of the heights relative to the clipmap's centre [level-0 samples]."""
    image_edge: tuple[float, float, float, float]
    """The imagery's edge relative to the clipmap's centre [level-0 texels]."""
    active: int
    """Finest geometry level drawn."""
    settled: bool
    """Whether every window was where the camera wants it."""
    effects: ViewEffects
    """What is drawn of haze and curvature, and why."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Most samples written per frame."""

    heights: int
    texels: int


class FrameMaker:
    """Keeps the windows of a scene around a camera.

    ``prepare`` never waits: what is not loaded is asked for, and the frame shows what there is.
    """

    def __init__(self, scene: Scene, options: ViewOptions, height_sink: Sink, image_sink: Sink | None) -> None:
        self._scene = scene
        self._options = options
        self._height_stack = ClipStack(scene.heights, options.grid + 1, height_sink)
        self._geometry = GeometryClipmap(self._height_stack, scene.is_loaded)
        self._textures: TextureClipmap | None = None
        if scene.imagery is not None and image_sink is not None:
            stack = ClipStack(scene.imagery.pyramid, options.texture_window, image_sink)
            self._textures = TextureClipmap(stack, scene.imagery.pyramid, scene.imagery.layer.registration, scene.is_loaded)
        low, high = scene.z_range_m
        # Filters overshoot on coarse levels, codecs err: a tenth of the range is room enough for both.
        room = 0.1 * (high - low) + 1.0
        self._z_range = (low - room) * options.exaggeration, (high + room) * options.exaggeration
        self.missing = 0

    def prepare(self, camera: Camera, size: tuple[int, int], budget: Budget | None = None, centre: Camera | None = None) -> Frame:
        """Return the frame for ``camera`` in a picture of ``size`` pixels; without a budget, as much is written as is loaded.

        The windows stay around ``centre`` if that is given, so that they can be looked at from outside.
        """
        scene, held = self._scene, centre or camera
        viewer = scene.frame.sample_at(held.x_m, held.y_m)
        above_m = self._above_ground(held)
        pixels = held.pixels_per_radian(size[1])
        geometry = self._geometry
        finest = geometry.height_cut_off(above_m, scene.frame.spacing_m, pixels)
        update = geometry.update(viewer, finest, None if budget is None else budget.heights)
        image_update, records, image_edge = self._update_textures(viewer, above_m, pixels, budget)
        self._request(update, image_update)
        origins: list[Origin] = [geometry.wanted_origin(viewer, level) for level in range(geometry.levels)]
        view = self._view(camera, size)
        effects = decide_effects(view, self._options)
        z_range = self._z_range[0] - effects.sag_per_m * view.farthest_m**2 - camera.z_m, self._z_range[1] - camera.z_m
        matrix = self._view_projection(camera, size[0] / size[1], z_range)
        culling = Culling(
            planes_of(matrix) @ _translation(held.x_m - camera.x_m, held.y_m - camera.y_m),
            scene.frame.to_local.linear,
            z_range,
            viewer,
            origins,
            geometry.n,
        )
        plan = plan_geometry(viewer, origins, update.active, geometry.n, culling if self._options.cull else None)
        origin = held.x_m - camera.x_m, held.y_m - camera.y_m, -camera.z_m
        last = scene.heights.extent(0)
        edge = last.x0 - viewer[0], last.y0 - viewer[1], last.x1 - 1 - viewer[0], last.y1 - 1 - viewer[1]
        settled = update.settled and (image_update is None or image_update.settled)
        return Frame(camera, size, plan, records, matrix, origin, edge, image_edge, update.active, settled, effects)

    @property
    def written_samples(self) -> int:
        """Height samples written to the GPU since the start."""
        return self._height_stack.written_samples

    def _above_ground(self, camera: Camera) -> float:
        """Return the height above ground, above the highest ground there is where none is below [m]."""
        ground = self._scene.ground_m(camera.x_m, camera.y_m)
        below = self._z_range[1] if ground is None else ground * self._options.exaggeration
        return max(0.0, camera.z_m - below)

    def _update_textures(
        self, viewer: tuple[float, float], above_m: float, pixels: float, budget: Budget | None
    ) -> tuple[Update | None, NDArray[np.void] | None, tuple[float, float, float, float]]:
        imagery, textures = self._scene.imagery, self._textures
        if imagery is None or textures is None:
            return None, None, (0.0, 0.0, 0.0, 0.0)
        x, y = imagery.to_texels(*viewer)
        texel_m = self._scene.frame.spacing_m / math.sqrt(abs(float(np.linalg.det(imagery.to_texels.linear))))
        # Finer than half a pixel straight below is finer than any pixel on level ground.
        finest = finest_level(above_m / (2 * pixels * texel_m), textures.levels)
        update = textures.update((x, y), finest, None if budget is None else budget.texels)
        sizes = [(extent.width, extent.height) for extent in map(imagery.pyramid.extent, range(textures.levels))]
        records = texture_records((x, y), textures.origins, sizes, textures.side, imagery.layer.registration)
        return update, records, (-x, -y, sizes[0][0] - x, sizes[0][1] - y)

    def _request(self, *updates: Update | None) -> None:
        wanted = [pair for update in updates if update is not None for pair in update.wanted]
        wanted.sort(key=lambda pair: (pair[0].ahead, pair[0].depth, pair[0].layer))
        self.missing = self._scene.loader.request(key for _, key in wanted)

    def _view(self, camera: Camera, size: tuple[int, int]) -> View:
        """Return what bounds of effects need to know of a picture."""
        beside = self._corners - (camera.x_m, camera.y_m)
        farthest = float(np.hypot(*beside.T).max())
        high = max(abs(z - camera.z_m) for z in self._z_range)
        scene = self._scene
        return View(
            size,
            camera.pixels_per_radian(size[1]),
            farthest,
            math.hypot(farthest, high),
            self._z_range[1] - self._z_range[0],
            scene.frame.spacing_m,
            scene.heights.levels,
            scene.manifest.world.crs is not None,
        )

    @cached_property
    def _corners(self) -> Matrix:
        """The corners of the dataset (4, 2) [local metres]."""
        extent, place = self._scene.heights.extent(0), self._scene.frame.to_local
        return np.array([place(x, y) for x in (0, extent.width - 1) for y in (0, extent.height - 1)])

    def _view_projection(self, camera: Camera, aspect: float, z_range_m: tuple[float, float]) -> Matrix:
        """Return the matrix; the depth range spans from the nearest ground there can be to the farthest corner of the dataset.

        ``z_range_m`` are the heights that occur, relative to the camera.
        """
        beside = self._corners - (camera.x_m, camera.y_m)
        low, high = z_range_m
        far = math.sqrt(float((beside**2).sum(axis=1).max()) + max(low**2, high**2)) * 1.01
        outside = np.maximum(np.maximum(beside.min(axis=0), -beside.max(axis=0)), 0.0)
        nearest = max(self._above_ground(camera), float(np.hypot(*outside)), -high, low)
        near = max(NEAR_PART * nearest, 2e-7 * far, 1e-3 * self._scene.frame.spacing_m)
        return camera.view_projection(aspect, near, max(far, 2 * near))


def _translation(x: float, y: float) -> Matrix:
    matrix = np.eye(4)
    matrix[:2, 3] = x, y
    return matrix
