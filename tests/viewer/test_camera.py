from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import UsageError
from tests.viewer.scenes import projected, written
from tests.viewer.writer import LayerSpec
from viewer.camera import Camera, looking_at
from viewer.fly import CLEARANCE, Flight
from viewer.framing import camera_at, default_camera, focus, orbit, view_text
from viewer.options import ViewOptions
from viewer.pyramid import FlatHeights
from viewer.scene import Scene, load_all

OPTIONS = ViewOptions(grid=15, texture_window=256)
TRANSFORM = (100.0, 0.0, 500000.0, 0.0, -100.0, 5200000.0)


def mountain(height_m: float) -> np.ndarray:
    """A cone at sample (90, 40) of 129 x 129."""
    y, x = np.mgrid[0:129, 0:129]
    cone: np.ndarray = np.maximum(0, height_m * (1 - np.hypot(x - 90, y - 40) / 25)).astype(np.float32)
    return cone


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return written(tmp_path, [LayerSpec("height", "height", mountain(1500), TRANSFORM, ground_spacing_m=(100.0, 100.0))], OPTIONS)


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (90.0, 0.0), (215.0, -40.0), (359.0, 80.0)])
def test_the_matrix_projects_as_angles_do(yaw: float, pitch: float) -> None:
    camera = Camera(1e6, -2e6, 300.0, yaw, pitch, 50.0)
    rng = np.random.default_rng(3)
    for _ in range(20):
        relative = camera.forward * rng.uniform(10, 1000) + rng.normal(size=3)
        x, y, z, w = camera.view_projection(16 / 9, 0.5, 5000.0) @ (*relative, 1.0)
        point = relative + np.array([camera.x_m, camera.y_m, camera.z_m])
        got = (x / w + 1) / 2 * 1600, (1 - y / w) / 2 * 900
        assert got == pytest.approx(projected(camera, (1600, 900), point), abs=1e-4)
        assert -1 < z / w < 1


def test_yaw_turns_clockwise_from_north_and_pitch_upwards() -> None:
    assert Camera(0, 0, 0, 0, 0).forward == pytest.approx((0, 1, 0))
    assert Camera(0, 0, 0, 90, 0).forward == pytest.approx((1, 0, 0))
    assert Camera(0, 0, 0, 0, 90).forward == pytest.approx((0, 0, 1))
    assert Camera(0, 0, 0, 350, 80).turned(20, 30) == Camera(0, 0, 0, 10, 90)
    aimed = looking_at(np.array([10.0, 20.0, 30.0]), np.array([0.0, 20.0, 20.0]), 45.0)
    assert (aimed.yaw_deg, aimed.pitch_deg) == pytest.approx((270, -45))


def test_a_printed_view_makes_the_same_camera(scene: Scene) -> None:
    camera = Camera(1234.567, -9876.543, 1500.5, 123.45, -12.34)
    again = camera_at(scene, tuple(map(float, view_text(scene, camera).split(","))), 45.0)  # type: ignore[arg-type]
    assert (again.x_m, again.y_m) == pytest.approx((camera.x_m, camera.y_m), abs=0.1)
    assert (again.z_m, again.yaw_deg, again.pitch_deg) == pytest.approx((1500.5, 123.45, -12.34))
    with pytest.raises(UsageError, match="pitch"):
        camera_at(scene, (0.0, 0.0, 0.0, 0.0, 91.0), 45.0)
    scene.close()


def test_the_default_view_shows_the_summit_in_front_of_the_dataset(scene: Scene) -> None:
    camera = default_camera(scene, OPTIONS)
    summit = np.array([9000.0, -4000.0, 1500.0])
    x, y = projected(camera, (1280, 720), summit)
    # The summit is looked for on the coarsest level, whose samples are 800 m apart.
    assert x == pytest.approx(640, abs=120)
    assert 100 < y < 360
    assert 0 <= camera.x_m <= 12800
    assert -12800 <= camera.y_m <= 0
    middle = np.array([6400.0, -6400.0, 0.0]) - (camera.x_m, camera.y_m, camera.z_m)
    assert middle @ camera.forward > 0
    below = scene.ground_m(camera.x_m, camera.y_m)
    assert below is not None
    assert camera.z_m > below + 50
    assert camera == default_camera(scene, OPTIONS)
    scene.close()


def test_a_view_can_be_asked_of_a_place(scene: Scene) -> None:
    camera = default_camera(scene, OPTIONS, (3000.0, -9000.0))
    x, y = projected(camera, (1280, 720), np.array([3000.0, -9000.0, 0.0]))
    assert x == pytest.approx(640, abs=1)
    assert 0 < y < 720
    scene.close()


def test_flat_datasets_are_seen_whole(tmp_path: Path) -> None:
    scene = written(tmp_path, [LayerSpec("height", "height", mountain(20), TRANSFORM)], OPTIONS)
    camera = default_camera(scene, OPTIONS)
    for corner in ((0, 0), (12800, 0), (0, -12800), (12800, -12800)):
        x, y = projected(camera, (1280, 720), np.array([*corner, 0.0]))
        assert 0 <= x <= 1280
        assert 0 <= y <= 720
    scene.close()


def test_an_orbit_keeps_its_distance_and_its_aim(scene: Scene) -> None:
    camera = default_camera(scene, OPTIONS)
    centre = focus(scene, camera, 1.0)
    ground = scene.ground_m(centre[0], centre[1])
    assert ground is not None
    assert centre[2] == pytest.approx(ground, abs=30)
    before = projected(camera, (1280, 720), centre)
    assert before == pytest.approx((640, 360), abs=1e-6)
    for turn in (30.0, 90.0, 240.0):
        assert projected(orbit(camera, centre, turn), (1280, 720), centre) == pytest.approx(before, abs=1e-6)
    scene.close()


def test_flight_is_as_fast_as_it_is_high_and_stays_above_ground(scene: Scene) -> None:
    flight = Flight(scene, Camera(1000.0, -1000.0, 1000.0, 90.0, 0.0), 1.0)
    flight.held = {"forward"}
    assert flight.step(0.5).x_m == pytest.approx(1000 + 0.8 * 1000 * 0.5)
    flight.fast = True
    assert flight.step(0.5).x_m == pytest.approx(1400 + 6 * 0.8 * 1000 * 0.5)
    flight.held, flight.fast = {"left", "up"}, False
    moved = flight.step(0.1)
    assert moved.y_m == pytest.approx(-1000 + 80)
    assert moved.z_m == pytest.approx(1080)
    wanted = scene.heights.needs(0, scene.heights.extent(0))
    load_all(scene.loader, lambda: [key for key in wanted if not scene.is_loaded(key)])
    flight.camera = Camera(9000.0, -4000.0, 1600.0, 0.0, -90.0)
    flight.held = {"forward"}
    for _ in range(300):
        flight.step(0.1)
    assert flight.camera.z_m == pytest.approx(1500 + CLEARANCE * 100, abs=0.1)
    scene.close()


def test_dragging_moves_the_picture_with_the_mouse(scene: Scene) -> None:
    flight = Flight(scene, Camera(0.0, 0.0, 1000.0, 90.0, 0.0), 1.0)
    point = np.array([5000.0, 0.0, 1000.0])
    flight.look(20.0, 10.0, 720)
    assert projected(flight.camera, (1280, 720), point) == pytest.approx((660, 370), abs=5)
    scene.close()


def test_the_ground_is_known_where_there_is_some(tmp_path: Path) -> None:
    z = np.tile(np.arange(20, dtype=np.float32), (20, 1)) * 100
    valid = np.ones((20, 20), np.bool_)
    valid[5:10, 5:10] = False
    scene = written(tmp_path, [LayerSpec("height", "height", z, (10.0, 0.0, 0.0, 0.0, -10.0, 0.0), valid=valid)], OPTIONS)
    wanted = scene.heights.needs(0, scene.heights.extent(0))
    load_all(scene.loader, lambda: [key for key in wanted if not scene.is_loaded(key)])
    assert scene.ground_m(25.0, -25.0) == pytest.approx(250.0)
    assert scene.ground_m(45.0, -70.0) == pytest.approx(400.0)
    for nowhere in ((70.0, -70.0), (-20.0, -20.0), (20.0, 20.0), (300.0, -20.0)):
        assert scene.ground_m(*nowhere) is None
    scene.close()


def test_the_overview_of_an_enormous_image_is_small(tmp_path: Path) -> None:
    scene = written(tmp_path, [LayerSpec("imagery", "imagery", np.zeros((20, 20, 3), np.uint8), TRANSFORM)], OPTIONS)
    huge = replace(scene, heights=FlatHeights(2**30, 2**29, 7))
    level, (z, _) = huge.overview()
    assert max(z.shape) <= 512
    assert level == 21
    scene.close()
