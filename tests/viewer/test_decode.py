import numpy as np
import pytest

from schemas.errors import InputError, UsageError
from tests.viewer.writer import LayerSpec, build_layer
from viewer.decode import HeightBlock, ImageBlock, layer_decoder

TRANSFORM = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
rng = np.random.default_rng(7)


def image(samples: np.ndarray, alpha: bool = False, pad: int = 0) -> np.ndarray:
    """The first block of an image of one block."""
    layer, files = build_layer(LayerSpec("imagery", "imagery", samples, TRANSFORM, alpha=alpha, pad=pad))
    block = layer_decoder(layer)(next(data for key, data in files.items() if key.endswith(".raw")))
    assert isinstance(block, ImageBlock)
    assert block.texels.shape == (16, 16, 4)
    return block.texels


def test_heights_keep_their_values_and_voids() -> None:
    z = rng.normal(size=(16, 16)).astype(np.float32)
    z[3, 4] = np.nan
    valid = rng.random((16, 16)) < 0.8
    valid[3, 4] = True
    layer, files = build_layer(LayerSpec("height", "height", z, TRANSFORM, valid=valid))
    block = layer_decoder(layer)(files["height/0/height-0.raw"])
    assert isinstance(block, HeightBlock)
    expected = valid & np.isfinite(z)
    np.testing.assert_array_equal(block.valid, expected)
    np.testing.assert_array_equal(block.z, np.where(expected, z, 0))
    blank = layer_decoder(layer)(None)
    assert isinstance(blank, HeightBlock)
    assert not blank.valid.any()


@pytest.mark.parametrize("pad", [0, 2])
def test_colour_is_padded_with_full_opacity_and_the_border_is_cut(pad: int) -> None:
    samples = rng.integers(0, 256, (16, 16, 3), np.uint8)
    texels = image(samples, pad=pad)
    np.testing.assert_array_equal(texels[..., :3], samples)
    assert (texels[..., 3] == 255).all()


def test_grey_becomes_colour_and_alpha_premultiplies() -> None:
    grey = rng.integers(0, 256, (16, 16, 1), np.uint8)
    np.testing.assert_array_equal(image(grey)[..., :3], np.repeat(grey, 3, axis=-1))
    for channels in (2, 4):
        samples = rng.integers(0, 256, (16, 16, channels), np.uint8)
        texels = image(samples, alpha=True)
        np.testing.assert_array_equal(texels[..., 3], samples[..., -1])
        exact = samples[..., :-1].astype(float) * samples[..., -1:] / 255
        assert np.abs(texels[..., :3] - exact).max() <= 0.5
    np.testing.assert_array_equal(image(rng.integers(0, 256, (16, 16, 2), np.uint8))[..., 3], 255)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_light_is_as_bright_however_it_is_stored(dtype: str) -> None:
    """2026-11-23: 16 bits and floats were stretched to what occurs, and floats shown as if they were codes of sRGB."""
    light = np.linspace(0.01, 0.6, 256).reshape(16, 16, 1)
    codes = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    top = {"uint8": 255, "uint16": 65535}.get(dtype)
    stored = light.astype(np.float32) if top is None else np.rint(top * codes).astype(dtype)
    layer, files = build_layer(LayerSpec("light", "light", stored, TRANSFORM))
    block = layer_decoder(layer)(files["light/0/light-0.raw"])
    assert isinstance(block, ImageBlock)
    assert np.abs(block.texels[..., :3] - 255 * codes).max() <= 0.51


def test_sixteen_bits_are_stretched_to_what_occurs() -> None:
    samples = rng.integers(1000, 3000, (16, 16, 3)).astype(np.uint16)
    samples[0, 0], samples[0, 1] = 1000, 3000
    texels = image(samples)
    assert texels[0, 0].tolist() == [0, 0, 0, 255]
    assert texels[0, 1].tolist() == [255, 255, 255, 255]
    assert np.abs(texels[..., :3] - (samples - 1000.0) / 2000 * 255).max() <= 0.5 + 1e-3
    flat = image(np.full((16, 16, 1), 500, np.uint16))
    assert (flat[..., 3] == 255).all()


def test_a_damaged_block_is_an_input_error() -> None:
    layer, _ = build_layer(LayerSpec("height", "height", np.zeros((16, 16), np.float32), TRANSFORM))
    with pytest.raises(InputError):
        layer_decoder(layer)(b"short")


def test_heights_of_several_channels_are_refused() -> None:
    layer, _ = build_layer(LayerSpec("height", "height", np.zeros((16, 16), np.float32), TRANSFORM))
    with pytest.raises(UsageError, match="must have 1"):
        layer_decoder(layer.model_copy(update={"channels": 2}))
