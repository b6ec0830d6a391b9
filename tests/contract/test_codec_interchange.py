"""Blocks are ordinary files: another library reads the same samples from them."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest

from schemas.manifest import SampleType
from tests.contract.blocks import heights, imagery
from tiler.codecs import BlockFormat, open_codec

HEIGHT = BlockFormat("height", 64, 1, "float32")


def read_with_openimageio(data: bytes, suffix: str, folder: Path) -> Any:
    path = folder / f"block.{suffix}"
    path.write_bytes(data)
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    handle = OpenImageIO.ImageInput.open(str(path), config)
    assert handle is not None, OpenImageIO.geterror()
    pixels = handle.read_image(handle.spec().format)
    handle.close()
    return pixels


@pytest.mark.parametrize(
    ("spec", "channels", "dtype", "tolerance"),
    [
        ("png", 1, "uint8", 0),
        ("png", 2, "uint16", 0),
        ("png", 3, "uint16", 0),
        ("png", 4, "uint8", 0),
        ("jpeg:90", 3, "uint8", 2),
        ("jpeg:90", 1, "uint8", 2),
        ("webp:90", 3, "uint8", 0),
        ("webp:90", 4, "uint8", 0),
    ],
)
def test_other_programs_read_the_same_pictures(spec: str, channels: int, dtype: SampleType, tolerance: int, tmp_path: Path) -> None:
    """JPEG decoders may differ by the rounding of their inverse cosine transform and colour conversion."""
    codec = open_codec(spec, BlockFormat("imagery", 64, channels, dtype, alpha=channels in (2, 4)))
    samples = imagery(64, channels, dtype)
    if codec.media_type == "image/webp" and channels == 4:
        samples[..., 3] = np.maximum(samples[..., 3], 1)
    data = codec.encode(samples, None)
    found = read_with_openimageio(data, codec.suffix, tmp_path)
    assert np.abs(found.astype(int) - codec.decode(data)[0]).max() <= tolerance


@pytest.mark.parametrize(("spec", "channels"), [("exr:float", 2), ("exr:half", 2), ("exr:float", 1), ("png16:0.1,-500", 2)])
def test_other_programs_read_the_same_heights(spec: str, channels: int, tmp_path: Path) -> None:
    codec = open_codec(spec, HEIGHT)
    samples = heights(64)
    mask = np.random.default_rng(1).random((64, 64)) < 0.8 if channels == 2 else None
    data = codec.encode(samples, mask)
    found = read_with_openimageio(data, codec.suffix, tmp_path).astype(np.float64)
    assert found.shape == (64, 64, channels)
    decoded = codec.decode(data)[0][..., 0]
    seen = found[..., 0] * 0.1 - 500 if codec.suffix == "png" else found[..., 0]
    valid = np.ones((64, 64), np.bool_) if mask is None else mask
    assert np.abs(seen - decoded)[valid].max() <= (1e-3 if codec.suffix == "png" else 0)
    if mask is not None:
        assert np.array_equal(found[..., 1] > 0, mask)
