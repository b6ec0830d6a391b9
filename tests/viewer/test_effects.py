"""What the viewer draws and leaves out: by bounds that points before a camera keep to, in pictures that show it."""

import math
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.scene import EARTH_RADIUS_M
from tests.viewer.scenes import magenta, on_magenta, projected, written
from tests.viewer.writer import LayerSpec
from viewer.camera import Camera
from viewer.effects import FLAT_M, View, decide_effects
from viewer.gl.headless import HeadlessView
from viewer.options import ViewOptions

CELL_M = 100.0
PLACE = (CELL_M, 0.0, 0.0, 0.0, -CELL_M, 0.0)
SIZE = (200, 150)


def view(**parts: Any) -> View:
    given: dict[str, Any] = {
        "size": SIZE,
        "focal_px": 180.0,
        "farthest_m": 10_000.0,
        "depth_m": 10_000.0,
        "relief_m": 1000.0,
        "spacing_m": 30.0,
        "levels": 3,
        "on_earth": True,
    }
    return View(**{**given, **parts})


@given(
    distance=st.integers(1, 6000).map(lambda n: 100.0 * n),
    height=st.integers(0, 80).map(lambda n: 100.0 * n),
    eye=st.integers(1, 300).map(lambda n: 100.0 * n),
    aside=st.integers(-100, 100).map(lambda n: n / 100),
    pitch=st.integers(-60, 20).map(float),
)
def test_no_ground_moves_more(distance: float, height: float, eye: float, aside: float, pitch: float) -> None:
    """A point that sinks as the shader lets it, anywhere in the picture."""
    found = decide_effects(view(farthest_m=distance, relief_m=height), ViewOptions(size=SIZE, curvature="on"))
    camera = Camera(0.0, 0.0, eye, 0.0, pitch, fov_deg=math.degrees(2 * math.atan(SIZE[1] / 2 / 180.0)))
    point = np.array([aside * distance, math.sqrt(1 - aside**2) * distance, height])
    sunk = point - (0, 0, found.sag_per_m * distance**2)
    assert found.sag_per_m == 0.5 / EARTH_RADIUS_M
    if (camera.forward @ (point - (0, 0, eye)) <= 0) or (camera.forward @ (sunk - (0, 0, eye)) <= 0):
        return
    before, after = (np.array(projected(camera, SIZE, one)) for one in (point, sunk))
    inside = all(((one >= 0) & (one <= SIZE)).all() for one in (before, after))
    assert not inside or np.linalg.norm(after - before) <= found.curvature.bound * (1 + 1e-9)


@pytest.mark.parametrize(
    ("parts", "options", "runs", "says"),
    [
        ({}, {}, False, "moves ground by up to 0.2"),
        ({"farthest_m": 100_000.0}, {}, True, "0.5 is noticed"),
        ({"farthest_m": 100_000.0, "on_earth": False}, {}, False, "does not say that it lies on the Earth"),
        ({"farthest_m": 2 * FLAT_M}, {}, False, "1200 km away"),
        ({"farthest_m": 2 * FLAT_M, "on_earth": False}, {"curvature": "on"}, True, "--curvature on"),
        ({"farthest_m": 100_000.0}, {"curvature": "off"}, False, "--curvature off"),
    ],
)
def test_curvature_is_drawn_where_it_is_seen(parts: dict[str, Any], options: dict[str, Any], runs: bool, says: str) -> None:
    found = decide_effects(view(**parts), ViewOptions(size=SIZE, **options))
    assert found.curvature.runs is runs
    assert says in found.curvature.text
    assert (found.sag_per_m > 0) is runs


def test_haze_is_drawn_where_it_is_seen() -> None:
    decided = [decide_effects(view(), ViewOptions(size=SIZE, haze_m=haze)) for haze in (None, 1e4, 1e7, 1e9)]
    assert [one.haze.runs for one in decided] == [False, True, True, False]
    assert [one.extinction_per_m for one in decided] == [0.0, 1e-4, 1e-7, 0.0]
    assert "not asked for" in decided[0].haze.text
    assert 0 < decided[3].haze.bound <= 1
    # Mixed as light, a thousandth shows as three codes next to black.
    assert decided[2].haze.bound == pytest.approx(255 * 12.92 * 1e-3, rel=0.01)


def test_levels_always_meet() -> None:
    flat, single = (decide_effects(view(**parts), ViewOptions(size=SIZE)).geomorph for parts in ({"relief_m": 0.0}, {"levels": 1}))
    assert (flat.runs, flat.bound) == (True, 0.0)
    assert not single.runs
    assert "any length" in decide_effects(view(relief_m=1e9), ViewOptions(size=SIZE)).geomorph.text


def wall(root: Path, options: ViewOptions, context: moderngl.Context) -> HeadlessView:
    """A plain of 40 km with a wall at its far end, on no Earth."""
    z = np.zeros((401, 65))
    z[:3] = 1000.0
    root.mkdir(exist_ok=True)
    return HeadlessView(
        written(root, [LayerSpec("height", "height", z, PLACE, ground_spacing_m=(CELL_M, CELL_M))], options), options, context
    )


def test_a_far_wall_sinks_by_as_much(tmp_path: Path, context: moderngl.Context) -> None:
    """Its upper edge moves down by what the parabola says, within a pixel; ground at the feet stays."""
    size, camera = (320, 240), Camera(3200.0, -39_000.0, 300.0, 0.0, 0.0, 10.0)
    tops = []
    for curvature in ("off", "on"):
        options = ViewOptions(size=size, fov_deg=10.0, grid=63, samples=0, curvature=curvature)
        drawn = wall(tmp_path / curvature, options, context)
        ground = ~magenta(on_magenta(drawn, camera))
        tops.append(int(np.argmax(ground[:, size[0] // 2])))
    top = np.array([3200.0, -200.0, 1000.0])
    sag = 38_800.0**2 / (2 * EARTH_RADIUS_M)
    expected = [projected(camera, size, top - (0, 0, drop))[1] for drop in (0.0, sag)]
    assert expected[1] - expected[0] > 3
    np.testing.assert_allclose(tops, expected, atol=1.5)


def test_what_nobody_could_see_is_not_drawn(tmp_path: Path, context: moderngl.Context) -> None:
    """Thin haze is left out, and a picture with it would not differ by more than its bound."""
    camera = Camera(3200.0, -39_000.0, 300.0, 0.0, 0.0, 10.0)
    pictures, bounds = [], []
    for haze in (None, 1e9, 1e8):
        options = ViewOptions(size=(320, 240), fov_deg=10.0, grid=63, samples=0, haze_m=haze)
        drawn = wall(tmp_path / str(haze), options, context)
        bounds.append(drawn.settle(camera).effects.haze.bound)
        pictures.append(on_magenta(drawn, camera).astype(int))
    assert (pictures[1] == pictures[0]).all()
    assert bounds[1] < 1 < bounds[2]
    assert np.abs(pictures[2] - pictures[0]).max() <= math.ceil(bounds[2])
