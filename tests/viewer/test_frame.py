import math

import numpy as np
import pytest

from schemas.errors import InputError
from schemas.manifest import Transform, World
from tests.viewer.writer import LayerSpec, build_layer
from viewer.frame import Affine, level_texel, local_frame, texel_map

METRE = World(crs=None, unit="metre")
DEGREE = World(crs="EPSG:4326", unit="degree")


def heights(transform: Transform, spacing: tuple[float, float] | None) -> LayerSpec:
    return LayerSpec("height", "height", np.zeros((33, 33), np.float32), transform, ground_spacing_m=spacing)


def test_a_metric_frame_points_east_and_north() -> None:
    layer, _ = build_layer(heights((10.0, 0.0, 500.0, 0.0, -10.0, 900.0), None))
    frame = local_frame(layer, METRE)
    assert frame.to_local(3, 4) == (30.0, -40.0)
    assert frame.sample_at(30.0, -40.0) == pytest.approx((3, 4))
    assert frame.world_of_local(30.0, -40.0) == pytest.approx((530.0, 860.0))
    assert frame.local_of_world(530.0, 860.0) == pytest.approx((30.0, -40.0))
    assert frame.spacing_m == pytest.approx(10.0)


def test_ground_spacing_overrides_stretched_or_angular_units() -> None:
    mercator, _ = build_layer(heights((100.0, 0.0, 0.0, 0.0, -100.0, 0.0), (61.5, 61.4)))
    assert local_frame(mercator, METRE).to_local(2, 3) == pytest.approx((123.0, -184.2))
    degrees, _ = build_layer(heights((0.001, 0.0, 10.0, 0.0, -0.001, 60.0), (55.8, 111.4)))
    assert local_frame(degrees, DEGREE).to_local(1, 1) == pytest.approx((55.8, -111.4))


def test_south_up_and_rotated_layers_keep_north_up_and_their_spacing() -> None:
    south_up, _ = build_layer(heights((10.0, 0.0, 0.0, 0.0, 10.0, 0.0), (10.0, 10.0)))
    assert local_frame(south_up, METRE).to_local(0, 5) == pytest.approx((0.0, 50.0))
    c, s = 10 * math.cos(0.5), 10 * math.sin(0.5)
    for spacing in ((10.0, 10.0), None):
        rotated, _ = build_layer(heights((c, s, 0.0, s, -c, 0.0), spacing))
        assert local_frame(rotated, METRE).to_local(1, 0) == pytest.approx((c, s))
        assert local_frame(rotated, METRE).to_local(0, 1) == pytest.approx((s, -c))
    diagonal = 10 * math.sqrt(0.5)
    turned, _ = build_layer(heights((diagonal, diagonal, 0.0, diagonal, -diagonal, 0.0), (20.0, 20.0)))
    assert np.hypot(*local_frame(turned, METRE).to_local(1, 0)) == pytest.approx(20.0)


def test_without_spacing_degrees_shrink_with_latitude() -> None:
    layer, _ = build_layer(heights((0.001, 0.0, 10.0, 0.0, -0.001, 60.0165), None))
    assert local_frame(layer, DEGREE).to_local(1, 1) == pytest.approx((55.66, -111.32), rel=1e-6)
    feet, _ = build_layer(heights((10.0, 0.0, 0.0, 0.0, -10.0, 0.0), None))
    assert local_frame(feet, World(crs=None, unit="foot")).to_local(1, 0) == pytest.approx((3.048, 0.0))


def test_height_samples_reach_the_texels_that_lie_there() -> None:
    height, _ = build_layer(heights((10.0, 0.0, 500.0, 0.0, -10.0, 900.0), None))
    image = LayerSpec("imagery", "imagery", np.zeros((40, 40, 3), np.uint8), (2.5, 0.0, 520.0, 0.0, 2.5, 800.0))
    area, _ = build_layer(image)
    # Height sample (4, 8) is world (540, 820): 8 texel sides east and 8 south-up ones from the imagery's corner.
    assert texel_map(local_frame(height, METRE), area)(4, 8) == pytest.approx((8.0, 8.0))
    point, _ = build_layer(LayerSpec("imagery", "imagery", image.samples, image.transform, registration="point"))
    assert texel_map(local_frame(height, METRE), point)(4, 8) == pytest.approx((8.5, 8.5))


def test_levels_halve_about_corners_or_about_samples() -> None:
    assert level_texel(8.0, 2, "area") == 2.0
    assert level_texel(8.5, 2, "point") == 2.5
    assert level_texel(2.0**50 + 0.25, 1, "area") == 2.0**49 + 0.125


def test_a_degenerate_transform_is_refused() -> None:
    with pytest.raises(InputError, match="onto a line"):
        Affine.of((1.0, 2.0, 0.0, 2.0, 4.0, 0.0)).inverse()


@pytest.mark.parametrize("spacing", [None, (10.0, 10.0)])
@pytest.mark.parametrize(
    ("transform", "words"),
    [
        ((1e308, 0.0, 0.0, 0.0, -1e308, 0.0), "height layer's samples lie 1e+308 world units apart"),
        ((1e-320, 0.0, 0.0, 0.0, -1e-320, 0.0), "height layer's samples lie 9.99989e-321 world units apart"),
        ((1e308, 1e308, 0.0, 1e308, -1e308, 0.0), "height layer's samples lie 1.41421e+308 world units apart"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "height layer's samples lie 0 world units apart"),
        ((10.0, 0.0, 0.0, 0.0, -1e200, 0.0), "height layer's samples lie 1e+200 world units apart"),
        ((1.0, 2.0, 0.0, 2.0, 4.0, 0.0), "onto a line"),
        ((1.0, 1.0, 0.0, 1.0, 1.0 + 1e-15, 0.0), "onto a line"),
        ((10.0, 0.0, 1e308, 0.0, -10.0, 0.0), "too far from the world's origin"),
    ],
)
def test_absurd_transforms_are_refused(transform: Transform, words: str, spacing: tuple[float, float] | None) -> None:
    """2026-11-22: these raised LinAlgError, ZeroDivisionError or RuntimeWarning."""
    layer, _ = build_layer(heights(transform, spacing))
    with pytest.raises(InputError) as caught:
        local_frame(layer, METRE)
    assert words in str(caught.value)


@pytest.mark.parametrize("spacing", [(1e308, 1.0), (1.0, 1e-320), (0.0, 1.0), (1.0, -1.0)])
def test_absurd_ground_spacings_are_refused(spacing: tuple[float, float]) -> None:
    """2026-11-22: like absurd transforms."""
    layer, _ = build_layer(heights((10.0, 0.0, 0.0, 0.0, -10.0, 0.0), spacing))
    with pytest.raises(InputError, match="metres apart, which cannot be drawn"):
        local_frame(layer, METRE)


@pytest.mark.parametrize("step", [1e-12, 1e12])
def test_the_least_and_the_greatest_spacing_have_a_frame(step: float) -> None:
    for spacing in (None, (step, step)):
        layer, _ = build_layer(heights((step, 0.0, 0.0, 0.0, -step, 0.0), spacing))
        frame = local_frame(layer, METRE)
        assert frame.spacing_m == pytest.approx(step)
        assert frame.sample_at(*frame.to_local(7, 9)) == pytest.approx((7, 9))


@pytest.mark.parametrize("place", [(1e12, 0.0, 0.0), (1e-12, 0.0, 0.0), (2.5, 0.0, 1e17)])
def test_imagery_that_has_nothing_to_do_with_the_heights_is_refused(place: tuple[float, float, float]) -> None:
    """2026-11-22: texel coordinates beyond 64 bits raised OverflowError."""
    height, _ = build_layer(heights((10.0, 0.0, 500.0, 0.0, -10.0, 900.0), None))
    step, turn, x = place
    image, _ = build_layer(LayerSpec("imagery", "imagery", np.zeros((40, 40, 3), np.uint8), (step, turn, x, turn, -step, 0.0)))
    with pytest.raises(InputError, match=r"too much in place or spacing|too far from the world's origin"):
        texel_map(local_frame(height, METRE), image)
