"""Ground shaded by a stored layer of normals: the same light as from its own heights, in the same directions, and finer."""

from pathlib import Path

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.settings import NormalSettings
from tests.integration.lighting import CELL_M, store_heights
from tests.viewer.scenes import opened
from tiler.building.normals import build_normals
from viewer.camera import Camera
from viewer.decode import NORMAL_ZERO, ImageBlock, layer_decoder
from viewer.frame import Affine, LocalFrame
from viewer.gl.headless import HeadlessView
from viewer.options import ViewOptions
from viewer.scene import Imagery, open_scene
from viewer.source import open_source

SIZE = (320, 240)
SIDE = 129


def waves(step: float, side: int) -> NDArray[np.float64]:
    """Hills 16 samples from one to the next, another way along rows than along columns."""
    y, x = np.mgrid[0:side, 0:side] * step
    return np.asarray(40 * np.sin(2 * np.pi * x / 16) + 25 * np.cos(2 * np.pi * (x + 2 * y) / 32), np.float64)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    found = store_heights(tmp_path, waves(1.0, SIDE))
    build_normals(found, NormalSettings(bits=16))
    build_normals(found, NormalSettings(codec="exr:half", density=2, layer="fine"))
    return found


def picture(context: moderngl.Context, dataset: Path, imagery: str | None, pitch: float = -60.0) -> NDArray[np.int64]:
    """The middle of the map from near enough for its finest samples."""
    options = ViewOptions(size=SIZE, grid=127, texture_window=256, samples=0, sun_deg=(110.0, 25.0), imagery_layer=imagery)
    scene = opened(open_source(str(dataset)), options)
    view = HeadlessView(scene, options, context)
    view.draw(view.settle(Camera(64 * CELL_M, -64 * CELL_M, 900.0, 30.0, pitch, 45.0)))
    pixels = view.target.pixels().astype(np.int64)
    scene.close()
    return pixels


def test_the_same_light_as_from_the_heights(context: moderngl.Context, dataset: Path) -> None:
    """From straight above samples are 21 pixels apart: what differs is how it is interpolated, unit vectors or slopes."""
    own = picture(context, dataset, None, -90.0)
    stored = picture(context, dataset, "normal", -90.0)
    assert np.ptp(own[..., 0]) > 60, "else there is no light to compare"
    assert np.abs(stored - own).mean() < 1
    assert np.abs(stored - own).max() < 8
    fine = picture(context, dataset, "fine", -90.0)
    assert 0 < np.abs(fine - own).mean() < 4


def test_directions_are_those_of_the_grid(dataset: Path) -> None:
    """A grid whose columns run north and rows east: x of a normal is north there, y is west."""
    layer = open_source(str(dataset)).manifest.layer("normal")
    turned = Affine(np.array([[0.0, 30.0], [30.0, 0.0]]), np.zeros(2))
    twice = Imagery(layer, None, Affine(np.eye(2) * 2, np.zeros(2)))  # type: ignore[arg-type]
    np.testing.assert_allclose(twice.facing(LocalFrame(turned, turned)), [[0, -1], [1, 0]], atol=1e-15)
    upright = Affine(np.diag([30.0, -30.0]), np.zeros(2))
    np.testing.assert_allclose(twice.facing(LocalFrame(upright, upright)), np.eye(2), atol=1e-15)


@pytest.mark.parametrize(("codec", "bits"), [("png", 8), ("png", 16), ("raw", 8), ("exr:float", 8)])
def test_texels_are_eight_bit_normals(codec: str, bits: int, tmp_path: Path) -> None:
    heights = waves(1.0, 40)
    heights[3:6, 3:6] = np.nan
    dataset = store_heights(tmp_path, heights)
    build_normals(dataset, NormalSettings(codec=codec, bits=bits))
    source = open_source(str(dataset))
    layer = source.manifest.layer("normal")
    address = next(layer.lattice.addresses(0))
    block = layer_decoder(layer)(source.read("normal", address))
    assert isinstance(block, ImageBlock)
    slope = (heights[10, 11] - heights[10, 9]) / 2 / CELL_M, (heights[9, 10] - heights[11, 10]) / 2 / CELL_M
    expected = -np.array(slope) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2) * NORMAL_ZERO + NORMAL_ZERO
    np.testing.assert_allclose(block.texels[10, 10, :2], expected, atol=0.51)
    np.testing.assert_array_equal(block.texels[..., 3] == 0, np.isnan(heights)[:32, :32])
    assert not block.texels[4, 4].any()
    blank = layer_decoder(layer)(None)
    assert isinstance(blank, ImageBlock)
    assert not blank.texels.any()


def test_normals_are_drawn_when_asked_for_only(dataset: Path) -> None:
    scene = open_scene(open_source(str(dataset)), ViewOptions(grid=127, texture_window=256))
    assert scene.imagery is None
    scene.close()
    with pytest.raises(UsageError, match="layer 'normal' is of kind normal, not height"):
        open_scene(open_source(str(dataset)), ViewOptions(height_layer="normal"))
