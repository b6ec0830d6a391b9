"""Scenes and cameras for the tests that draw."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tests.viewer.writer import LayerSpec, write_dataset
from viewer.blocks import BlockKey
from viewer.camera import Camera
from viewer.gl.headless import HeadlessView
from viewer.options import ViewOptions
from viewer.pyramid import Heights, Planes, height_planes
from viewer.scene import Scene, open_scene
from viewer.source import BlockSource, open_source

MAGENTA = (1.0, 0.0, 1.0)


def opened(source: BlockSource, options: ViewOptions) -> Scene:
    """A scene with its coarsest blocks loaded."""
    scene = open_scene(source, options)
    scene.load_coarsest()
    return scene


def written(root: Path, specs: list[LayerSpec], options: ViewOptions) -> Scene:
    """A scene of a dataset written to ``root``."""
    write_dataset(root, specs)
    return opened(open_source(str(root)), options)


def on_magenta(view: HeadlessView, camera: Camera) -> NDArray[np.uint8]:
    """The picture without a sky, on a colour that no terrain has."""
    frame = view.settle(camera)
    view.target.clear(MAGENTA)
    view.renderer.draw(frame, sky=False)
    return view.target.pixels()


def magenta(pixels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where the background shows, wholly or, at an antialiased edge, in part."""
    red, green, blue = (pixels[..., channel].astype(int) for channel in range(3))
    return (red > green + 40) & (blue > green + 40)


def projected(camera: Camera, size: tuple[int, int], point: NDArray[np.float64]) -> tuple[float, float]:
    """Where a local point (east, north, up) appears, pixels from the top left; worked out from angles, not from matrices."""
    yaw, pitch = np.radians(camera.yaw_deg), np.radians(camera.pitch_deg)
    east, north, up = point - (camera.x_m, camera.y_m, camera.z_m)
    ahead, right = east * np.sin(yaw) + north * np.cos(yaw), east * np.cos(yaw) - north * np.sin(yaw)
    depth, above = ahead * np.cos(pitch) + up * np.sin(pitch), up * np.cos(pitch) - ahead * np.sin(pitch)
    scale = size[1] / 2 / np.tan(np.radians(camera.fov_deg) / 2)
    return float(size[0] / 2 + right / depth * scale), float(size[1] / 2 - above / depth * scale)


def rough(x: NDArray[np.int64], y: NDArray[np.int64], level: int) -> NDArray[np.float64]:
    """Noise of a few metres, another on each level, on hills of tens of metres; repeated every 2**20 samples."""
    hashed = (x * 73856093 ^ y * 19349663 ^ level * 83492791) & 0xFFFFF
    hashed = (hashed * 2654435761 >> 7) & 0xFFFF
    turn = 2 * np.pi / 2**20
    z: NDArray[np.float64] = hashed / 0xFFFF * 4.0 + 30 * np.sin(x * turn * 9000) * np.cos(y * turn * 7000)
    return z


class EndlessHeights:
    """A height pyramid without blocks and without edges: ``rough`` everywhere, on ``levels`` levels."""

    def __init__(self, levels: int) -> None:
        self.levels = levels

    def extent(self, level: int) -> Rect:
        side = 2**40 >> level
        return Rect(-side, -side, side, side)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        return []

    def heights(self, level: int, rect: Rect) -> Heights:
        y, x = np.mgrid[rect.y0 : rect.y1, rect.x0 : rect.x1].astype(np.int64) << level
        return rough(x % 2**20, y % 2**20, level).astype(np.float32), np.ones(x.shape, np.bool_)

    def planes(self, level: int, rect: Rect) -> Planes:
        z, valid = self.heights(level, rect.grown(1))
        return height_planes(z, valid, valid, np.eye(2) * 0.5**level)


class EndlessImagery:
    """An imagery pyramid without blocks and without edges, of a pattern that repeats every 2**16 texels of its level."""

    def __init__(self, levels: int) -> None:
        self.levels = levels

    def extent(self, level: int) -> Rect:
        side = 2**40 >> level
        return Rect(0, 0, side, side)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        return []

    def planes(self, level: int, rect: Rect) -> Planes:
        y, x = np.mgrid[rect.y0 : rect.y1, rect.x0 : rect.x1].astype(np.int64) % 2**16
        red, green = (x * 37 ^ y * 11) & 255, (x * 5 + y * 91) & 255
        return (np.stack([red, green, (red + green) // 2, np.full(x.shape, 255)], axis=-1).astype(np.uint8),)
