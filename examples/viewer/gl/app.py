"""The window: fly with the keyboard, look with the mouse, toggles on function keys, numbers in the title."""

import time
from collections.abc import Callable
from typing import Final, Protocol

import moderngl

from schemas.errors import UsageError
from viewer.camera import Camera
from viewer.fly import Flight, Motion
from viewer.frames import Budget, Frame, FrameMaker
from viewer.framing import view_text
from viewer.gl.context import GL_VERSION, check_errors, import_window_library, renderer_name
from viewer.gl.terrain import TerrainRenderer
from viewer.options import ViewOptions
from viewer.scene import Scene

LONGEST_STEP_S: Final = 0.1
"""A frame that took longer moves the camera no farther, so that a stall does not become a leap."""
TITLE_S: Final = 0.5

Key = int | str


class Keys(Protocol):
    """The keys of a backend that are used here."""

    ACTION_PRESS: Key
    W: Key
    A: Key
    S: Key
    D: Key
    Q: Key
    E: Key
    P: Key
    ESCAPE: Key
    F1: Key
    F2: Key
    F3: Key


class Modifiers(Protocol):
    """Modifier keys held down."""

    @property
    def shift(self) -> bool:
        """Whether shift is."""
        ...


class Window(Protocol):
    """What is used of a window of moderngl-window, of any backend."""

    keys: Keys
    key_event_func: Callable[[Key, Key, Modifiers], None]
    mouse_drag_event_func: Callable[[int, int, int, int], None]
    title: str
    exit_key: Key | None

    @property
    def ctx(self) -> moderngl.Context:
        """The window's context."""
        ...

    @property
    def fbo(self) -> moderngl.Framebuffer:
        """The window's framebuffer."""
        ...

    @property
    def height(self) -> int:
        """Height in units of the mouse."""
        ...

    @property
    def buffer_size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        ...

    @property
    def is_closing(self) -> bool:
        """Whether the user wants it closed."""
        ...

    def swap_buffers(self) -> None:
        """Show what was drawn and take events."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


class App:
    """One scene in one window; ``say`` takes lines for the user."""

    def __init__(self, window: Window, scene: Scene, options: ViewOptions, camera: Camera, title: str, say: Callable[[str], None]) -> None:
        self.window = window
        self.flight = Flight(scene, camera, options.exaggeration)
        self.wireframe = options.wireframe
        self.tint = options.color_by_level
        self.frozen: Camera | None = None
        self._scene = scene
        self._title = title
        self._say = say
        self._context: moderngl.Context = window.ctx
        self._context.gc_mode = "context_gc"
        self._renderer = TerrainRenderer(self._context, scene, options)
        self._maker = FrameMaker(scene, options, self._renderer.heights, self._renderer.imagery)
        self._budget = Budget(options.grid**2, options.texture_window**2 // 2)
        self._titled_at, self._frames = time.perf_counter(), 0
        self._motions = self._key_map(window.keys)
        self._closing = False
        self._drawn: dict[str, bool] = {}
        # The library's own exit key closes the window in the midst of its events, which pyglet does not always survive.
        window.exit_key = None
        window.key_event_func = self.on_key
        window.mouse_drag_event_func = self.on_drag
        check_errors(self._context, "making textures")

    @staticmethod
    def _key_map(keys: Keys) -> dict[Key, Motion]:
        return {keys.W: "forward", keys.S: "back", keys.A: "left", keys.D: "right", keys.E: "up", keys.Q: "down"}

    def run(self) -> Camera:
        """Draw until the window is closed and return the last camera."""
        last = time.perf_counter()
        while not (self._closing or self.window.is_closing):
            now = time.perf_counter()
            self.draw(min(now - last, LONGEST_STEP_S))
            last = now
            self.window.swap_buffers()
        return self.flight.camera

    def draw(self, elapsed_s: float) -> Frame:
        """Move on by ``elapsed_s``, draw one frame into the window and return it."""
        camera = self.flight.step(elapsed_s)
        width, height = self.window.buffer_size
        size = max(width, 1), max(height, 1)
        frame = self._maker.prepare(camera, size, self._budget, self.frozen)
        target = self.window.fbo
        target.use()
        target.viewport = (0, 0, *size)
        target.clear(depth=1.0)
        self._renderer.draw(frame, wireframe=self.wireframe, tint=self.tint)
        self._context.gc()
        self._tell_effects(frame)
        self._show_numbers(frame)
        return frame

    def on_key(self, key: Key, action: Key, modifiers: Modifiers) -> None:
        """Take a key that went down or up."""
        keys = self.window.keys
        pressed = action == keys.ACTION_PRESS
        self.flight.fast = bool(modifiers.shift)
        motion = self._motions.get(key)
        if motion is not None:
            (self.flight.held.add if pressed else self.flight.held.discard)(motion)
        elif key == keys.ESCAPE:
            self._closing = True
        elif pressed and key == keys.F1:
            self.wireframe = not self.wireframe
        elif pressed and key == keys.F2:
            self.tint = not self.tint
        elif pressed and key == keys.F3:
            self.frozen = None if self.frozen else self.flight.camera
        elif pressed and key == keys.P:
            self._say(f"--view={view_text(self._scene, self.flight.camera)}")

    def on_drag(self, x: int, y: int, right_px: int, down_px: int) -> None:
        """Take a drag of the mouse."""
        self.flight.look(right_px, down_px, self.window.height)

    def _tell_effects(self, frame: Frame) -> None:
        """Say which effects are drawn and why, first and whenever one begins or ends."""
        for effect in frame.effects.all:
            if self._drawn.get(effect.name) != effect.runs:
                self._say(f"{effect.name} {effect.text}")
                self._drawn[effect.name] = effect.runs

    def _show_numbers(self, frame: Frame) -> None:
        self._frames += 1
        now = time.perf_counter()
        if now - self._titled_at < TITLE_S:
            return
        loader = self._scene.loader
        parts = [
            self._title,
            f"{self._frames / (now - self._titled_at):.0f} fps",
            f"{loader.counts.blocks} blocks, {loader.pending} to come",
            f"level {frame.active}",
            *(f"{effect.name} up to {effect.bound:.3g} {effect.unit}" for effect in frame.effects.all if effect.runs),
        ]
        if self.frozen is not None:
            parts.append("frozen")
        failures = loader.failures
        if failures:
            parts.append(f"{len(failures)} failed: {next(iter(failures.values()))}")
        self.window.title = " - ".join(parts)
        self._titled_at, self._frames = now, 0


def make_window(options: ViewOptions, title: str) -> Window:
    """Return a window of the size of ``options``, without antialiasing if the display has none; raises UsageError."""
    library = import_window_library()
    reason: Exception | None = None
    for samples in dict.fromkeys((options.samples, 0)):
        try:
            window: Window = library.get_local_window_cls("pyglet")(
                title=title,
                size=options.size,
                gl_version=divmod(GL_VERSION // 10, 10),
                samples=samples,
                vsync=True,
                resizable=True,
                cursor=True,
            )
        except Exception as error:  # pyglet's own errors share no base; no display and no such pixel format are two of them
            reason = error
            continue
        library.activate_context(window=window)
        return window
    raise UsageError(f"no window can be opened here ({type(reason).__name__}); use --headless to draw into a file") from reason


def run_window(scene: Scene, options: ViewOptions, camera: Camera, title: str, say: Callable[[str], None]) -> Camera:
    """Open a window on ``scene``, run it until it is closed, and return the last camera."""
    window = make_window(options, title)
    app = App(window, scene, options, camera, title, say)
    say(f"{title} on {renderer_name(window.ctx)}")
    last = app.run()
    window.close()
    return last
