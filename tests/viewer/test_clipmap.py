from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.region import Rect
from tests.viewer.scenes import EndlessHeights, EndlessImagery, opened, written
from tests.viewer.writer import LayerSpec, ProceduralSource
from viewer.blocks import BlockKey
from viewer.camera import Camera
from viewer.clipmap import GeometryClipmap, TextureClipmap, finest_level
from viewer.frames import Budget, FrameMaker
from viewer.options import ViewOptions
from viewer.pyramid import Planes, Pyramid
from viewer.stack import ClipStack
from viewer.torus import TorusRect


class Arrays:
    """A stack of textures made of arrays; a slot not yet written holds -1."""

    def __init__(self, levels: int, side: int, channels: int) -> None:
        self.slots: NDArray[np.float64] = np.full((levels, side, side, channels), -1.0)
        self.writes = 0

    def write(self, level: int, rect: TorusRect, planes: Planes) -> None:
        x, y, width, height = rect.slots
        self.slots[level, y : y + height, x : x + width] = rect.arrange(planes[0])
        self.writes += 1

    def window(self, level: int, origin: tuple[int, int]) -> NDArray[np.float64]:
        """The window's samples in the order of the level."""
        side = self.slots.shape[1]
        rows, columns = (np.arange(start, start + side) % side for start in (origin[1], origin[0]))
        window: NDArray[np.float64] = self.slots[level][np.ix_(rows, columns)]
        return window


def sampled(pyramid: Pyramid, level: int, origin: tuple[int, int], side: int) -> NDArray[np.generic]:
    planes = pyramid.planes(level, Rect(*origin, origin[0] + side, origin[1] + side))
    assert planes is not None
    return planes[0]


def everything(_: BlockKey) -> bool:
    return True


@pytest.mark.parametrize("centre", [0.0, 1e9])
def test_windows_hold_what_sampling_gives_after_any_walk(centre: float) -> None:
    rng = np.random.default_rng(5)
    pyramid, sink = EndlessHeights(5), Arrays(5, 32, 2)
    clipmap = GeometryClipmap(ClipStack(pyramid, 32, sink), everything)
    viewer = np.array([centre, -centre])
    for step in range(60):
        viewer = viewer + rng.normal(size=2) * 10 ** rng.uniform(-1, 3)
        finest = int(rng.integers(0, 3))
        update = clipmap.update((viewer[0], viewer[1]), finest, None)
        assert update.active == finest
        assert update.settled
        for level in range(finest, 5):
            origin = clipmap.wanted_origin((viewer[0], viewer[1]), level)
            if step % 5 == 0:
                np.testing.assert_array_equal(sink.window(level, origin), sampled(pyramid, level, origin, 32))


def test_texture_windows_too() -> None:
    rng = np.random.default_rng(6)
    pyramid, sink = EndlessImagery(4), Arrays(4, 64, 4)
    clipmap = TextureClipmap(ClipStack(pyramid, 64, sink), pyramid, "area", everything)
    viewer = np.array([1e6, 2e6])
    for _ in range(30):
        viewer = viewer + rng.normal(size=2) * 10 ** rng.uniform(0, 3)
        assert clipmap.update((viewer[0], viewer[1]), 0, None).settled
        for level in range(4):
            origin = clipmap.origins[level]
            assert origin is not None
            np.testing.assert_array_equal(sink.window(level, origin), sampled(pyramid, level, origin, 64))


def test_standing_still_writes_nothing_and_a_step_writes_one_strip() -> None:
    pyramid, sink = EndlessHeights(3), Arrays(3, 16, 2)
    stack = ClipStack(pyramid, 16, sink)
    clipmap = GeometryClipmap(stack, everything)
    clipmap.update((100.0, 100.0), 0, None)
    assert stack.written_samples == 3 * 16 * 16
    clipmap.update((100.4, 100.0), 0, None)
    assert stack.written_samples == 3 * 16 * 16
    clipmap.update((102.0, 100.0), 0, None)
    assert stack.written_samples == 3 * 16 * 16 + 2 * 16


def test_a_level_without_its_blocks_is_inactive_with_all_finer_ones() -> None:
    class Blocky(EndlessHeights):
        def needs(self, level: int, rect: Rect) -> list[BlockKey]:
            from schemas.address import BlockAddress

            return [BlockKey("height", BlockAddress(level, 0, 0))]

    loaded = {0, 1, 3, 4}
    sink = Arrays(5, 16, 2)
    clipmap = GeometryClipmap(ClipStack(Blocky(5), 16, sink), lambda key: key.address.level in loaded)
    update = clipmap.update((50.0, 50.0), 0, None)
    assert update.active == 3
    assert not update.settled
    assert [(urgency.depth, key.address.level) for urgency, key in update.wanted if not urgency.ahead] == [(2, 2)]
    assert (sink.slots[:3] == -1).all()
    loaded.add(2)
    update = clipmap.update((50.0, 50.0), 0, None)
    assert update.active == 0
    assert update.settled


def test_a_small_budget_catches_up_coarse_to_fine() -> None:
    clipmap = GeometryClipmap(ClipStack(EndlessHeights(5), 16, Arrays(5, 16, 2)), everything)
    active = [clipmap.update((50.0, 50.0), 0, 16 * 16).active for _ in range(6)]
    assert active == [4, 3, 2, 1, 0, 0]


def test_levels_too_fine_for_the_height_are_not_drawn() -> None:
    clipmap = GeometryClipmap(ClipStack(EndlessHeights(8), 256, Arrays(1, 256, 2)), everything)
    # A pixel a sample straight below: 500 pixels per radian reach 500 samples of 10 m.
    assert [clipmap.height_cut_off(height, 10.0, 500.0) for height in (0.0, 4999.0, 5001.0, 10001.0, 1e9)] == [0, 0, 1, 2, 7]
    # Losasso & Hoppe: 0.4 n samples where pixels are few.
    assert clipmap.height_cut_off(0.4 * 255 + 1, 1.0, 1.0) == 1
    assert finest_level(0.0, 1) == 0


def test_the_cache_losing_a_block_only_delays(tmp_path: Path) -> None:
    z = np.random.default_rng(1).normal(size=(65, 65)).astype(np.float32)
    options = ViewOptions(grid=15, texture_window=256)
    scene = written(tmp_path, [LayerSpec("height", "height", z, (1.0, 0, 0, 0, -1.0, 0))], options)
    stack = ClipStack(scene.heights, 16, Arrays(scene.heights.levels, 16, 2))
    assert stack.move(0, (0, 0)) is False
    assert stack.origins[0] is None
    scene.close()


def test_frames_ask_for_coarse_blocks_first_and_settle() -> None:
    options = ViewOptions(grid=15, texture_window=256)
    scene = opened(ProceduralSource(257, 16, lambda x, y, _: (x + y) % 7), options)
    maker = FrameMaker(scene, options, Arrays(scene.heights.levels, 16, 2), None)
    camera = Camera(128.0, -128.0, 20.0, 0.0, -30.0)
    frame = maker.prepare(camera, (64, 64), Budget(10**9, 10**9))
    assert not frame.settled
    for _ in range(100):
        scene.loader.wait(1.0)
        frame = maker.prepare(camera, (64, 64), Budget(10**9, 10**9))
        if frame.settled:
            break
    assert frame.settled
    assert frame.active == 0
    scene.close()
