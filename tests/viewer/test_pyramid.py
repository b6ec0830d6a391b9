from pathlib import Path

import numpy as np
import pytest

from schemas.region import Rect
from tests.viewer.scenes import written
from tests.viewer.writer import LayerSpec, coarser
from viewer.options import ViewOptions
from viewer.pyramid import FlatHeights
from viewer.scene import Scene, load_all

TRANSFORM = (2.0, 0.0, 0.0, 0.0, -3.0, 0.0)
OPTIONS = ViewOptions(grid=15, texture_window=256)
rng = np.random.default_rng(11)
Z = rng.normal(size=(45, 70)).astype(np.float32) * 10
VALID = rng.random((45, 70)) < 0.9
VALID[:16, 16:32] = False
COLOURS = rng.integers(0, 256, (50, 33, 3), np.uint8)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    specs = [
        LayerSpec("height", "height", Z, TRANSFORM, valid=VALID, ground_spacing_m=(2.0, 3.0)),
        LayerSpec("imagery", "imagery", COLOURS, TRANSFORM, pad=1),
    ]
    return written(tmp_path, specs, OPTIONS)


def load(scene: Scene, level: int, rect: Rect) -> None:
    wanted = scene.heights.needs(level, rect)
    load_all(scene.loader, lambda: [key for key in wanted if not scene.is_loaded(key)])


RECTS = [Rect(0, 0, 8, 8), Rect(-20, -20, 5, 7), Rect(13, 9, 40, 30), Rect(60, 40, 90, 60), Rect(100, 3, 110, 4), Rect(-9, -9, -2, -3)]


@pytest.mark.parametrize("rect", RECTS)
@pytest.mark.parametrize("level", range(5))
def test_heights_are_those_of_the_level_and_void_outside(scene: Scene, level: int, rect: Rect) -> None:
    z, valid = np.where(VALID, Z, 0), VALID
    for _ in range(level):
        z, valid = coarser(z, "point"), coarser(valid, "point")
    assert scene.heights.extent(level) == Rect(0, 0, z.shape[1], z.shape[0])
    load(scene, level, rect)
    heights = scene.heights.heights(level, rect)
    assert heights is not None
    for j, y in enumerate(range(rect.y0, rect.y1)):
        for i, x in enumerate(range(rect.x0, rect.x1)):
            row, column = min(max(y, 0), z.shape[0] - 1), min(max(x, 0), z.shape[1] - 1)
            assert heights[0][j, i] == z[row, column]
            assert heights[1][j, i] == (valid[row, column] and (x, y) == (column, row))
    scene.close()


def test_slopes_are_central_differences_in_metres(scene: Scene) -> None:
    rect = Rect(33, 20, 60, 40)
    load(scene, 0, rect)
    planes = scene.heights.planes(0, rect)
    assert planes is not None
    surface, slopes = planes
    assert (surface.dtype.name, slopes.dtype.name) == ("float32", "float16")
    np.testing.assert_array_equal(surface[..., 1], VALID[20:40, 33:60])
    for j in range(20):
        for i in range(27):
            y, x = 20 + j, 33 + i
            if VALID[y - 1 : y + 2, x].all() and VALID[y, x - 1 : x + 2].all():
                expected = (Z[y, x + 1] - Z[y, x - 1]) / 4.0, -(Z[y + 1, x] - Z[y - 1, x]) / 6.0
                np.testing.assert_allclose(slopes[j, i], expected, rtol=2e-3, atol=1e-3)
    scene.close()


def test_slopes_beside_edges_and_voids_are_one_sided() -> None:
    z = np.arange(25, dtype=np.float32).reshape(5, 5) ** 1.5
    valid = np.ones((5, 5), np.bool_)
    valid[2, 3] = False
    from viewer.pyramid import height_planes

    _, slopes = height_planes(z, valid, valid, np.eye(2))
    assert slopes[1, 1, 0] == pytest.approx(z[2, 2] - z[2, 1], rel=1e-3)
    valid[2, 1] = False
    _, slopes = height_planes(z, valid, valid, np.eye(2))
    assert slopes[1, 1, 0] == 0
    assert slopes[1, 1, 1] == pytest.approx((z[3, 2] - z[1, 2]) / 2, rel=1e-3)


@pytest.mark.parametrize("rect", RECTS)
def test_imagery_repeats_its_edge(scene: Scene, rect: Rect) -> None:
    assert scene.imagery is not None
    pyramid = scene.imagery.pyramid
    wanted = pyramid.needs(0, rect)
    load_all(scene.loader, lambda: [key for key in wanted if not scene.is_loaded(key)])
    planes = pyramid.planes(0, rect)
    assert planes is not None
    rows = np.clip(np.arange(rect.y0, rect.y1), 0, 49)
    columns = np.clip(np.arange(rect.x0, rect.x1), 0, 32)
    np.testing.assert_array_equal(planes[0][..., :3], COLOURS[np.ix_(rows, columns)])
    scene.close()


def test_blank_blocks_are_never_asked_for(scene: Scene) -> None:
    needed = scene.heights.needs(0, scene.heights.extent(0))
    assert (1, 0) not in {(key.address.x, key.address.y) for key in needed}
    assert len(needed) == 5 * 3 - 1
    scene.close()


def test_nothing_is_put_together_while_a_block_is_missing(scene: Scene) -> None:
    assert scene.heights.planes(0, Rect(0, 0, 8, 8)) is None
    load(scene, 0, Rect(0, 0, 8, 8))
    assert scene.heights.planes(0, Rect(0, 0, 8, 8)) is not None
    scene.close()


def test_flat_ground_ends_with_its_lattice() -> None:
    flat = FlatHeights(9, 5, 3)
    assert [flat.extent(level) for level in range(flat.levels)] == [Rect(0, 0, 9, 5), Rect(0, 0, 5, 3), Rect(0, 0, 3, 2)]
    surface, slopes = flat.planes(0, Rect(-1, 3, 3, 6))
    np.testing.assert_array_equal(surface[..., 1], [[0, 1, 1, 1], [0, 1, 1, 1], [0, 0, 0, 0]])
    assert flat.planes(1, Rect(0, 0, 6, 5))[0][..., 1].tolist() == [[1, 1, 1, 1, 1, 0]] * 3 + [[0] * 6] * 2
    assert not surface[..., 0].any()
    assert not slopes.any()


def test_levels_beyond_the_stored_ones_halve_alike_with_and_without_heights(scene: Scene) -> None:
    """2026-11-22: the two kinds of heights each had their own copy of this rule."""
    flat = FlatHeights(70, 45, OPTIONS.grid // 4)
    assert scene.manifest.layer("height").lattice.levels == 4
    assert [scene.heights.extent(level) for level in range(scene.heights.levels)] == [flat.extent(level) for level in range(flat.levels)]
    assert [flat.extent(level).width for level in range(flat.levels)] == [70, 35, 18, 9, 5, 3]
    assert [flat.extent(level).height for level in range(flat.levels)] == [45, 23, 12, 6, 3, 2]
    scene.close()


def test_a_coarse_level_that_ends_early_is_drawn_to_the_edge(scene: Scene) -> None:
    # 70 x 45 samples: level 1 has 35 columns, the last at 68, so a 36th at 70 covers column 69; row 44 is row 22 of level 1.
    rect = Rect(33, 20, 38, 25)
    load(scene, 1, rect)
    planes = scene.heights.planes(1, rect)
    heights = scene.heights.heights(1, rect)
    assert planes is not None
    assert heights is not None
    edge = VALID[40::2, 68][:3].astype(float)
    np.testing.assert_array_equal(planes[0][:3, 2, 1], edge)
    np.testing.assert_array_equal(planes[0][:3, 2, 0], planes[0][:3, 1, 0])
    assert not heights[1][:, 2].any()
    assert not planes[0][:, 3:, 1].any()
    assert not planes[0][3:, :, 1].any()
    scene.close()
