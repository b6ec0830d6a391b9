"""Pictures without a window: every wanted block is loaded before a frame is drawn, so pictures are reproducible."""

import os
import re
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import imagecodecs
import moderngl
import numpy as np
from numpy.typing import NDArray

from schemas.errors import StorageError, UsageError
from viewer.camera import Camera
from viewer.effects import ViewEffects
from viewer.frames import Frame, FrameMaker
from viewer.framing import focus, orbit
from viewer.gl.context import check_errors, headless_context, renderer_name
from viewer.gl.terrain import TerrainRenderer
from viewer.options import ViewOptions
from viewer.scene import WAIT_S, Scene

Pixels = NDArray[np.uint8]
"""A picture, (height, width, 3), top row first."""

_NUMBER: Final = re.compile(r"%(0[1-9]\d?)?d")
"""The place of a frame's number in a file name."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What one frame came to."""

    path: Path
    camera: Camera
    triangles: int
    draw_s: float
    load_s: float
    effects: ViewEffects
    """What was drawn of haze and curvature, and why."""


class Offscreen:
    """A framebuffer of the size and coverage samples of ``options``; raises UsageError if the machine has no such one."""

    def __init__(self, context: moderngl.Context, options: ViewOptions) -> None:
        most = context.max_samples
        if options.samples > most:
            raise UsageError(f"samples {options.samples}: this machine has at most {most}")
        self._context = context
        self.size = options.size
        self.framebuffer = context.framebuffer(
            [context.renderbuffer(self.size, 4, samples=options.samples)], context.depth_renderbuffer(self.size, samples=options.samples)
        )
        self._resolved = context.simple_framebuffer(self.size, 4) if options.samples else self.framebuffer

    def clear(self, colour: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Make this the framebuffer in use, filled with ``colour``."""
        self.framebuffer.use()
        self.framebuffer.clear(*colour, 1.0, depth=1.0)

    def pixels(self) -> Pixels:
        """Return what was drawn."""
        if self._resolved is not self.framebuffer:
            self._context.copy_framebuffer(self._resolved, self.framebuffer)
        width, height = self.size
        data = self._resolved.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)[::-1].copy()


class HeadlessView:
    """A scene with a renderer and a framebuffer of its own."""

    def __init__(self, scene: Scene, options: ViewOptions, context: moderngl.Context | None = None) -> None:
        self.context = context or headless_context()
        self._scene = scene
        self._options = options
        self.target = Offscreen(self.context, options)
        self.renderer = TerrainRenderer(self.context, scene, options)
        self.maker = FrameMaker(scene, options, self.renderer.heights, self.renderer.imagery)
        check_errors(self.context, "making textures")

    @property
    def renderer_name(self) -> str:
        """What OpenGL calls the machine that draws."""
        return renderer_name(self.context)

    @property
    def uploaded_bytes(self) -> int:
        """Bytes of samples written to the GPU since the start."""
        imagery = self.renderer.imagery
        return self.renderer.heights.written_bytes + (0 if imagery is None else imagery.written_bytes)

    def settle(self, camera: Camera, centre: Camera | None = None) -> Frame:
        """Return the frame once every block it wants is there; raises the first error that loading meets."""
        loader = self._scene.loader
        while True:
            frame = self.maker.prepare(camera, self._options.size, centre=centre)
            if frame.settled:
                return frame
            loader.wait(WAIT_S)
            for error in loader.failures.values():
                raise error

    def draw(self, frame: Frame) -> int:
        """Draw a frame with the sky behind it and return the number of triangles."""
        self.target.clear()
        triangles = self.renderer.draw(frame, wireframe=self._options.wireframe, tint=self._options.color_by_level)
        self.context.finish()
        check_errors(self.context, "drawing")
        return triangles


def frame_paths(out: Path, frames: int) -> list[Path]:
    """Return the files of ``frames`` pictures: their number stands where ``out`` has %d or %0Nd, else, if there are several, at the end.

    Raises UsageError if ``out`` is no PNG or has another % in its name.
    """
    if frames < 1:
        raise UsageError(f"frames {frames}: must be at least 1")
    if out.suffix.lower() != ".png":
        raise UsageError(f"{out}: pictures are written as PNG; give a name that ends in .png")
    pattern = out.name if frames == 1 or "%" in out.name else f"{out.stem}_%04d{out.suffix}"
    if "%" not in pattern:
        return [out]
    if pattern.count("%") > 1 or not _NUMBER.search(pattern):
        raise UsageError(f"{out}: a % in the name marks the place of the frame's number; give it once, as %d or %04d")
    return [out.with_name(pattern % number) for number in range(frames)]


def render_frames(view: HeadlessView, scene: Scene, camera: Camera, paths: list[Path], exaggeration: float) -> Iterator[Picture]:
    """Draw one picture per path, circling once around what ``camera`` looks at, and yield what each came to."""
    centre = focus(scene, camera, exaggeration) if len(paths) > 1 else np.zeros(3)
    for number, path in enumerate(paths):
        placed = orbit(camera, centre, 360.0 * number / len(paths)) if number else camera
        begun = time.perf_counter()
        frame = view.settle(placed)
        loaded = time.perf_counter()
        triangles = view.draw(frame)
        drawn = time.perf_counter()
        write_png(path, view.target.pixels())
        yield Picture(path, placed, triangles, draw_s=drawn - loaded, load_s=loaded - begun, effects=frame.effects)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write a picture in one step, so that nobody sees a part of one; raises StorageError."""
    data = imagecodecs.png_encode(pixels, level=6)
    temporary = path.with_name(f".tmp-{os.getpid()}-{secrets.token_hex(4)}.png")
    try:
        try:
            temporary.write_bytes(data)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror}") from error
