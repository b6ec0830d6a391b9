"""The window's logic, on a window that is none: a framebuffer and a set of keys."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import moderngl
import numpy as np
import pytest

from tests.viewer.scenes import opened, rough
from tests.viewer.writer import ProceduralSource
from viewer.camera import Camera
from viewer.gl.app import App, Window
from viewer.gl.headless import HeadlessView
from viewer.options import ViewOptions

NAMES = ("W", "A", "S", "D", "Q", "E", "P", "F1", "F2", "F3", "ESCAPE")
KEYS = SimpleNamespace(ACTION_PRESS="press", ACTION_RELEASE="release", **{name: name for name in NAMES})
OPTIONS = ViewOptions(size=(160, 100), grid=31, texture_window=256, samples=0)
START = Camera(128.0, -220.0, 90.0, 0.0, -40.0)


class FakeWindow:
    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.ctx, self.keys, self.title, self.exit_key = context, KEYS, "", "ESCAPE"
        self.fbo = context.simple_framebuffer(size)
        self.buffer_size, self.height = size, size[1]
        self.key_event_func: Callable[[str, str, SimpleNamespace], None]
        self.mouse_drag_event_func: Callable[[int, int, int, int], None]
        self.swaps = 0
        self.is_closing = False

    def swap_buffers(self) -> None:
        self.swaps += 1
        if self.swaps == 5:
            self.press("ESCAPE")

    def close(self) -> None:
        pass

    def press(self, key: str, shift: bool = False) -> None:
        self.key_event_func(key, "press", SimpleNamespace(shift=shift))

    def release(self, key: str) -> None:
        self.key_event_func(key, "release", SimpleNamespace(shift=False))

    def pixels(self) -> np.ndarray:
        width, height = self.buffer_size
        return np.frombuffer(self.fbo.read(components=3, alignment=1), np.uint8).reshape(height, width, 3)[::-1]


@pytest.fixture
def parts(context: moderngl.Context) -> tuple[App, FakeWindow, list[str]]:
    lines: list[str] = []
    scene = opened(ProceduralSource(257, 32, rough), OPTIONS)
    window = FakeWindow(context, OPTIONS.size)
    app = App(cast("Window", window), scene, OPTIONS, START, "hills", lines.append)
    return app, window, lines


def settle(app: App) -> None:
    for _ in range(200):
        if app.draw(0.0).settled:
            return
        app._scene.loader.wait(0.2)
    pytest.fail("the window never had all its blocks")


def test_the_window_comes_to_show_what_headless_shows(parts: tuple[App, FakeWindow, list[str]], context: moderngl.Context) -> None:
    app, window, _ = parts
    assert not app.draw(0.0).settled
    assert len(np.unique(window.pixels().reshape(-1, 3), axis=0)) > 20
    settle(app)
    view = HeadlessView(app._scene, OPTIONS, context)
    view.draw(view.settle(START))
    np.testing.assert_array_equal(window.pixels(), view.target.pixels())
    app._scene.close()


def test_keys_fly_toggle_freeze_and_print(parts: tuple[App, FakeWindow, list[str]]) -> None:
    app, window, lines = parts
    settle(app)
    plain = window.pixels().copy()
    for key, name in (("F1", "wireframe"), ("F2", "tint")):
        window.press(key)
        assert getattr(app, name)
        app.draw(0.0)
        assert (window.pixels() != plain).any()
        window.press(key)
        app.draw(0.0)
        np.testing.assert_array_equal(window.pixels(), plain)
    window.press("W")
    app.draw(0.1)
    assert app.flight.camera.y_m > START.y_m
    window.release("W")
    moved = app.flight.camera
    app.draw(0.1)
    assert app.flight.camera == moved
    window.mouse_drag_event_func(0, 0, 10, 0)
    assert app.flight.camera.yaw_deg == pytest.approx(360 - 10 * 45 / 100)
    window.press("P")
    assert lines[-1].startswith("--view=")
    app._scene.close()


def test_effects_are_told_first_and_when_they_change(parts: tuple[App, FakeWindow, list[str]]) -> None:
    app, _, lines = parts
    settle(app)
    told = list(lines)
    assert told[0] == "haze left out: not asked for"
    assert told[1].startswith("curvature left out: ")
    assert told[2].startswith("geomorph drawn: it joins levels")
    app.draw(0.0)
    assert lines == told, "nothing has changed"
    app._drawn["haze"] = True
    app.draw(0.0)
    assert lines == [*told, told[0]]
    app._scene.close()


def test_frozen_levels_stay_where_they_were(parts: tuple[App, FakeWindow, list[str]]) -> None:
    app, window, _ = parts
    settle(app)
    held = app.draw(0.0)
    window.press("F3")
    window.press("E", shift=True)
    for _ in range(5):
        app.draw(0.1)
    window.release("E")
    frame = app.draw(0.0)
    assert frame.camera.z_m > START.z_m + 50
    np.testing.assert_array_equal(frame.geometry.levels, held.geometry.levels)
    assert frame.origin_m[2] == -frame.camera.z_m
    window.press("F3")
    assert app.frozen is None
    app._scene.close()


def test_a_resized_window_is_filled(parts: tuple[App, FakeWindow, list[str]], context: moderngl.Context) -> None:
    app, window, _ = parts
    settle(app)
    window.fbo, window.buffer_size = context.simple_framebuffer((90, 120)), (90, 120)
    app.draw(0.0)
    assert app.draw(0.0).size == (90, 120)
    assert (window.pixels()[0] != 0).any()
    assert (window.pixels()[-1] != 0).any()
    app._scene.close()


def test_escape_ends_the_run_and_numbers_stand_in_the_title(
    parts: tuple[App, FakeWindow, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    app, window, _ = parts
    monkeypatch.setattr("viewer.gl.app.TITLE_S", 0.0)
    assert app.run() == app.flight.camera
    assert window.swaps == 5
    assert window.title.startswith("hills - ")
    assert "fps" in window.title
    assert "blocks" in window.title
    app._scene.close()
