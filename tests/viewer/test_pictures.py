"""What is drawn: no holes, no cracks, everything in its place, and the same wherever it is."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest

from schemas.manifest import Transform
from tests.viewer.scenes import EndlessHeights, EndlessImagery, magenta, on_magenta, opened, projected, rough, written
from tests.viewer.writer import LayerSpec, ProceduralSource, build_layer
from viewer import drawplan
from viewer.blocks import BlockLoader
from viewer.camera import Camera, looking_at
from viewer.frame import Affine, LocalFrame
from viewer.framing import camera_at
from viewer.gl.headless import HeadlessView, frame_paths, render_frames
from viewer.morph import STILL
from viewer.options import ViewOptions
from viewer.pyramid import BlockHeights
from viewer.scene import Imagery, Scene, open_scene

SIZE = (320, 200)


@pytest.fixture(scope="module")
def rough_scene() -> Iterator[Scene]:
    scene = opened(ProceduralSource(4097, 64, rough), ViewOptions(grid=15, texture_window=256))
    yield scene
    scene.close()


def random_cameras(count: int) -> list[Camera]:
    """Cameras over the middle of 4096 m that see nothing but ground: none looks less than 12 degrees below the horizon."""
    rng = np.random.default_rng(20)
    cameras = []
    for _ in range(count):
        x, y = 2048 + rng.uniform(-300, 300, 2)
        cameras.append(Camera(x, -y, float(40 + 10 ** rng.uniform(0.8, 2.2)), rng.uniform(0, 360), rng.uniform(-90, -36), 45.0))
    return cameras


@pytest.mark.parametrize("n", [15, 31])
@pytest.mark.parametrize("samples", [0, 4])
def test_terrain_that_fills_the_view_has_no_holes(context: moderngl.Context, n: int, samples: int) -> None:
    options = ViewOptions(size=SIZE, grid=n, texture_window=256, samples=samples)
    scene = opened(ProceduralSource(4097, 64, rough), options)
    view = HeadlessView(scene, options, context)
    for camera in random_cameras(25):
        holes = magenta(on_magenta(view, camera))
        assert not holes.any(), (camera, int(holes.sum()))
    scene.close()


def test_the_search_for_holes_finds_cracks(context: moderngl.Context, rough_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawplan, "ramp", lambda _: STILL)
    options = ViewOptions(size=SIZE, grid=15, texture_window=256, samples=0)
    view = HeadlessView(rough_scene, options, context)
    assert sum(int(magenta(on_magenta(view, camera)).sum()) for camera in random_cameras(25)) > 100


def test_culling_leaves_the_picture_as_it_is(context: moderngl.Context, rough_scene: Scene) -> None:
    options = ViewOptions(size=SIZE, grid=15, texture_window=256, samples=0)
    culled, whole = (HeadlessView(rough_scene, replace(options, cull=cull), context) for cull in (True, False))
    fewer = 0
    for camera in (*random_cameras(8), Camera(2048.0, -2048.0, 60.0, 77.0, 0.0, 45.0), Camera(100.0, -100.0, 400.0, 135.0, -10.0, 90.0)):
        some, all_of_it = culled.settle(camera), whole.settle(camera)
        few, many = culled.draw(some), whole.draw(all_of_it)
        np.testing.assert_array_equal(culled.target.pixels(), whole.target.pixels())
        fewer += few < many
    assert fewer >= 8


def endless_scene(levels: int, texture_levels: int) -> Scene:
    """A scene without edges: 1 m samples, two texels to a sample."""
    base = opened(ProceduralSource(33, 16, rough), ViewOptions(grid=15, texture_window=256))
    spec = LayerSpec("imagery", "imagery", np.zeros((16, 16, 3), np.uint8), (0.5, 0.0, 0.0, 0.0, -0.5, 0.0))
    layer, _ = build_layer(spec)
    frame = LocalFrame(Affine.of((1.0, 0.0, 0.0, 0.0, -1.0, 0.0)), Affine.of((1.0, 0.0, 0.0, 0.0, -1.0, 0.0)))
    imagery = Imagery(layer, EndlessImagery(texture_levels), Affine(np.eye(2) * 2.0, np.array([2.0**31, 2.0**31])))
    return replace(base, heights=EndlessHeights(levels), frame=frame, imagery=imagery, z_range_m=(-40.0, 40.0))


def test_a_picture_is_the_same_to_the_bit_a_billion_samples_away(context: moderngl.Context) -> None:
    scene = endless_scene(6, 4)
    options = ViewOptions(size=SIZE, grid=31, texture_window=256, samples=0, cull=False)
    view = HeadlessView(scene, options, context)
    rng = np.random.default_rng(8)
    for _ in range(4):
        x, y = np.rint(rng.uniform(-500, 500, 2) * 2**16) / 2**16
        camera = Camera(float(x), float(y), 60.0, float(rng.uniform(0, 360)), -20.0, 45.0)
        pictures = []
        for shift in (0.0, 2.0**20, -(2.0**29), 2.0**30):
            moved = replace(camera, x_m=camera.x_m + shift, y_m=camera.y_m - shift)
            # The depth range follows the edge of the dataset, which cannot be shifted with it.
            frame = replace(view.settle(moved), view_projection=camera.view_projection(SIZE[0] / SIZE[1], 0.5, 3000.0))
            view.draw(frame)
            pictures.append(view.target.pixels())
        assert len(np.unique(pictures[0].reshape(-1, 3), axis=0)) > 1000
        for other in pictures[1:]:
            np.testing.assert_array_equal(pictures[0], other)
    scene.close()


def test_voids_and_the_dataset_s_edge_are_not_drawn(context: moderngl.Context, tmp_path: Path) -> None:
    side = 65
    valid = np.ones((side, side), np.bool_)
    valid[30:40, 20:30] = False
    z = np.full((side, side), 50.0, np.float32)
    options = ViewOptions(size=(300, 300), grid=63, texture_window=256, samples=0)
    transform = (10.0, 0.0, 1000.0, 0.0, -10.0, 2000.0)
    scene = written(tmp_path, [LayerSpec("height", "height", z, transform, valid=valid, ground_spacing_m=(10.0, 10.0))], options)
    view = HeadlessView(scene, options, context)
    camera = Camera(320.0, -320.0, 950.0, 0.0, -90.0, 45.0)
    holes = magenta(on_magenta(view, camera))
    pixel_m = 2 * 900 * np.tan(np.radians(22.5)) / 300
    rows, columns = np.mgrid[0:300, 0:300]
    x, y = (320 + (columns + 0.5 - 150) * pixel_m) / 10, (320 + (rows + 0.5 - 150) * pixel_m) / 10
    # A quad with a void corner is not drawn, so the hole reaches from one valid sample to the next.
    expected = ((x > 19) & (x < 30) & (y > 29) & (y < 40)) | (x < 0) | (x > 64) | (y < 0) | (y > 64)
    border = np.minimum.reduce([np.abs(x - edge) for edge in (19, 30, 0, 64)] + [np.abs(y - edge) for edge in (29, 40, 0, 64)]) * 10
    # In the hole's quads at two corners, the triangle beyond the diagonal has no void vertex.
    diagonal = ((np.floor(x) == 29) & (np.floor(y) == 29)) | ((np.floor(x) == 19) & (np.floor(y) == 39))
    sure = (border > 1.5 * pixel_m) & ~diagonal
    np.testing.assert_array_equal(holes[sure], expected[sure])
    assert holes[sure].sum() > 100
    scene.close()


def test_the_edge_is_the_same_on_every_level(context: moderngl.Context, tmp_path: Path) -> None:
    options = ViewOptions(size=(300, 300), grid=15, texture_window=256, samples=0)
    z = np.zeros((52, 60), np.float32)
    scene = written(tmp_path, [LayerSpec("height", "height", z, (10.0, 0.0, 0.0, 0.0, -10.0, 0.0))], options)
    view = HeadlessView(scene, options, context)
    for x_m, z_m in ((295.0, 700.0), (20.0, 800.0), (295.0, 20000.0)):
        camera = Camera(x_m, -255.0, z_m, 0.0, -90.0, 60.0 if z_m < 1000 else 2.0)
        shown = ~magenta(on_magenta(view, camera))
        pixel_m = 2 * z_m * np.tan(np.radians(camera.fov_deg / 2)) / 300
        rows, columns = np.mgrid[0:300, 0:300]
        x, y = camera.x_m + (columns + 0.5 - 150) * pixel_m, 255 + (rows + 0.5 - 150) * pixel_m
        inside = (x > 0) & (x < 590) & (y > 0) & (y < 510)
        border = np.minimum.reduce([np.abs(x), np.abs(x - 590), np.abs(y), np.abs(y - 510)])
        sure = border > pixel_m
        np.testing.assert_array_equal(shown[sure], inside[sure])
        assert 1000 < inside.sum() < inside.size
    scene.close()


C, S = 40 * np.cos(0.3), 40 * np.sin(0.3)
PLACES: list[tuple[Transform, Transform, str]] = [
    ((40.0, 0.0, 1000.0, 0.0, -40.0, 9000.0), (10.0, 0.0, 1300.0, 0.0, -10.0, 8800.0), "area"),
    ((40.0, 0.0, 1000.0, 0.0, -40.0, 9000.0), (10.0, 0.0, 1300.0, 0.0, -10.0, 8800.0), "point"),
    ((40.0, 0.0, 1000.0, 0.0, 40.0, 7000.0), (10.0, 0.0, 1300.0, 0.0, -10.0, 8800.0), "area"),
    ((40.0, 0.0, 1000.0, 0.0, -40.0, 9000.0), (10.0, 0.0, 1300.0, 0.0, 10.0, 7200.0), "area"),
    ((C, S, 500.0, S, -C, 9000.0), (7.0, 3.0, 1200.0, 2.0, -9.0, 8500.0), "area"),
    ((40.0, 0.0, 1e7, 0.0, -40.0, 9e6), (10.0, 0.0, 1e7 + 300.0, 0.0, -10.0, 9e6 - 200.0), "area"),
]


@pytest.mark.parametrize(("height_place", "image_place", "registration"), PLACES)
def test_imagery_lies_where_its_transform_says(
    context: moderngl.Context, tmp_path: Path, height_place: Transform, image_place: Transform, registration: str
) -> None:
    to_world = Affine.of(height_place)
    rows, columns = np.mgrid[0:65, 0:65]
    world = np.stack([columns, rows], axis=-1) @ to_world.linear.T + to_world.offset
    start = to_world(0, 0)
    z = 0.2 * (world[..., 0] - start[0]) + 0.1 * (world[..., 1] - start[1])
    colours = np.zeros((150, 160, 3), np.uint8)
    marks = [(60, 50), (100, 90), (30, 110)]
    for column, row in marks:
        colours[row - 2 : row + 3, column - 2 : column + 3] = 255
    specs = [
        LayerSpec("height", "height", z, height_place, ground_spacing_m=(40.0, 40.0)),
        LayerSpec("imagery", "imagery", colours, image_place, registration="point" if registration == "point" else "area"),
    ]
    options = ViewOptions(size=(640, 480), grid=31, texture_window=256, samples=4, sun_deg=None)
    scene = written(tmp_path, specs, options)
    view = HeadlessView(scene, options, context)
    middle = 0.5 if registration == "area" else 0.0
    for column, row in marks:
        at = Affine.of(image_place)(column + middle, row + middle)
        height = 0.2 * (at[0] - start[0]) + 0.1 * (at[1] - start[1])
        point = np.array([at[0], at[1], height])
        for eye in ((-150.0, -260.0, 330.0), (300.0, 50.0, 250.0)):
            aim = point + np.array([20.0, 10.0, 0.0])
            world_camera = looking_at(point + eye, aim, 45.0)
            pose = (world_camera.x_m, world_camera.y_m, world_camera.z_m, world_camera.yaw_deg, world_camera.pitch_deg)
            view.draw(view.settle(camera_at(scene, pose, 45.0)))
            expected = projected(world_camera, options.size, point)
            pixels = view.target.pixels().astype(float).min(axis=-1)
            y, x = np.mgrid[0:480, 0:640] + 0.5
            near = np.hypot(x - expected[0], y - expected[1]) < 60
            light = np.where(near, pixels, 0.0)
            found = (light * x).sum() / light.sum(), (light * y).sum() / light.sum()
            assert light.max() > 200
            # A texel is at least 8 pixels here; the mark's nearer half looks larger, which moves its middle by one.
            assert found == pytest.approx(expected, abs=2.0)
    scene.close()


def test_imagery_without_heights_lies_on_flat_ground(context: moderngl.Context, tmp_path: Path) -> None:
    colours = np.zeros((100, 120, 4), np.uint8)
    colours[..., 0], colours[..., 3] = 200, 255
    colours[:50, :60, 3] = 0
    options = ViewOptions(size=(200, 200), grid=63, texture_window=256, samples=0)
    spec = LayerSpec("imagery", "imagery", colours, (1.0, 0.0, 0.0, 0.0, -1.0, 0.0), alpha=True)
    scene = written(tmp_path, [spec], options)
    view = HeadlessView(scene, options, context)
    camera = Camera(60.0, -50.0, 100.0, 0.0, -90.0, 60.0)
    view.draw(view.settle(camera))
    pixels = view.target.pixels()
    for point, red in (((90.0, -25.0, 0.0), True), ((30.0, -75.0, 0.0), True), ((30.0, -25.0, 0.0), False)):
        x, y = projected(camera, options.size, np.array(point))
        colour = pixels[int(y), int(x)].astype(int)
        # Without heights nothing lies below transparent imagery: the sky shows.
        assert (colour[0] > 190 and colour[1] < 10) == red, colour
        assert (colour[2] > 180) != red
    scene.close()


def test_light_falls_from_the_sun(context: moderngl.Context, tmp_path: Path) -> None:
    x = np.arange(65)
    ridge = np.repeat((400 - 20 * np.abs(x - 32.0))[None, :], 65, axis=0).astype(np.float32)
    grey = np.full((64, 64, 3), 100, np.uint8)
    place: Transform = (20.0, 0.0, 0.0, 0.0, -20.0, 0.0)
    means = {}
    for sun in ((90.0, 30.0), (270.0, 30.0), None):
        options = ViewOptions(size=(200, 200), grid=63, texture_window=256, samples=0, sun_deg=sun)
        scene = written(
            tmp_path / str(sun), [LayerSpec("height", "height", ridge, place), LayerSpec("imagery", "imagery", grey, place)], options
        )
        view = HeadlessView(scene, options, context)
        view.draw(view.settle(Camera(640.0, -640.0, 1500.0, 0.0, -90.0, 40.0)))
        pixels = view.target.pixels().astype(float)
        means[sun] = pixels[:, :80].mean(), pixels[:, 120:].mean()
        scene.close()
    assert means[90.0, 30.0][1] > means[90.0, 30.0][0] + 30
    assert means[270.0, 30.0][0] > means[270.0, 30.0][1] + 30
    assert means[None] == pytest.approx((100.0, 100.0), abs=1.0)


def test_frames_of_an_orbit_are_reproducible(context: moderngl.Context, tmp_path: Path) -> None:
    options = ViewOptions(size=(160, 100), grid=31, texture_window=256)
    data = []
    for run in ("a", "b"):
        scene = opened(ProceduralSource(257, 32, rough), options)
        view = HeadlessView(scene, options, context)
        (tmp_path / run).mkdir()
        paths = frame_paths(tmp_path / run / "frame_%02d.png", 3)
        pictures = list(render_frames(view, scene, Camera(128.0, -220.0, 90.0, 0.0, -40.0), paths, 1.0))
        assert [picture.path.name for picture in pictures] == ["frame_00.png", "frame_01.png", "frame_02.png"]
        assert all(picture.triangles > 1000 for picture in pictures)
        data.append([path.read_bytes() for path in paths])
        scene.close()
    assert data[0] == data[1]
    assert len(set(data[0])) == 3


def test_a_view_from_anywhere_can_be_drawn(context: moderngl.Context, rough_scene: Scene) -> None:
    options = ViewOptions(size=(64, 48), grid=15, texture_window=256, samples=0)
    view = HeadlessView(rough_scene, options, context)
    for camera in (
        Camera(-50000.0, 90000.0, 100.0, 0.0, 0.0),
        Camera(2048.0, -2048.0, 1e7, 0.0, -90.0),
        Camera(2048.0, -2048.0, -500.0, 0.0, 90.0),
        Camera(0.0, 0.0, 10.0, 315.0, 5.0, 1.0),
        Camera(4096.0, -4096.0, 1.0, 0.0, 0.0, 150.0),
    ):
        view.draw(view.settle(camera))
        assert view.target.pixels().shape == (48, 64, 3)


def test_ground_beside_a_void_below_the_viewer_is_not_cut_away(context: moderngl.Context, tmp_path: Path) -> None:
    valid = np.ones((65, 65), np.bool_)
    valid[30:35, 30:35] = False
    z = np.full((65, 65), 6000.0, np.float32)
    options = ViewOptions(size=(200, 200), grid=63, texture_window=256, samples=0)
    scene = written(tmp_path, [LayerSpec("height", "height", z, (10.0, 0.0, 0.0, 0.0, -10.0, 0.0), valid=valid)], options)
    view = HeadlessView(scene, options, context)
    holes = magenta(on_magenta(view, Camera(320.0, -320.0, 6040.0, 0.0, -90.0, 120.0)))
    assert holes[100, 100]
    assert not holes[5:40].any()
    assert not holes[:, 160:195].any()
    scene.close()


def test_a_cache_too_small_for_a_frame_still_gives_the_frame(context: moderngl.Context) -> None:
    options = ViewOptions(size=(64, 48), grid=63, texture_window=256, samples=0)
    camera = Camera(128.0, -220.0, 90.0, 0.0, -40.0, 45.0)
    pictures = []
    for capacity in (10**9, 1):
        scene = open_scene(ProceduralSource(257, 16, rough), options)
        scene.loader.close()
        loader = BlockLoader(ProceduralSource(257, 16, rough).read, scene.loader._decoders, 3, capacity)
        heights = BlockHeights("height", scene.manifest.layer("height"), loader.get, np.diag([1.0, -1.0]), 15)
        scene = replace(scene, loader=loader, heights=heights)
        scene.load_coarsest()
        view = HeadlessView(scene, options, context)
        view.draw(view.settle(camera))
        pictures.append(view.target.pixels())
        scene.close()
    np.testing.assert_array_equal(pictures[0], pictures[1])
