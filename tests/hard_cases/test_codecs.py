"""Hard cases of codecs: ranges, constants, damage, shared borders."""

from pathlib import Path

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import InputError
from tests.integration.files import decode, settings, write_tiff
from tests.reference.terrain import terrain
from tiler.building.build import build_layer
from tiler.codecs import BlockFormat, open_codec
from tiler.stores.dataset import open_dataset

HEIGHTS = BlockFormat("height", 64, 1, "float32")
HEIGHT_CODECS = ["raw", "lerc:0", "lerc:0.1", "png16:0.1,-1000", "exr:float", "exr:half"]


def test_c19_everest_does_not_fit_into_a_tenth_of_a_metre(tmp_path: Path) -> None:
    """16 bits of 0.1 m end at 6553.5 m: refused with the range, not wrapped to 2295 m."""
    source = write_tiff(tmp_path / "everest.tif", np.full((40, 40, 1), 8848.86, np.float32))
    with pytest.raises(InputError, match=r"0 to 6553\.5 only, but the source has 8848"):
        build_layer(source, tmp_path / "out", settings(codec="png16:0.1,0"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("value", "fits"), [(65504.0, True), (65519.9, False), (65536.0, False), (-65504.0, True)])
def test_c20_half_float_ends_at_65504(value: float, fits: bool) -> None:
    """What half cannot hold is refused, never infinity."""
    codec, samples = open_codec("exr:half", HEIGHTS), np.full((64, 64, 1), value, np.float32)
    if fits:
        assert (codec.decode(codec.encode(samples, None))[0] == value).all()
    else:
        with pytest.raises(InputError, match="65504"):
            codec.encode(samples, None)


def test_c20_half_float_is_coarse_on_mountains() -> None:
    """At 8848 m half keeps steps of 8 m, so it promises no error bound; the exact codecs do."""
    codec = open_codec("exr:half", HEIGHTS)
    decoded, _ = codec.decode(codec.encode(np.full((64, 64, 1), 8851, np.float32), None))
    assert abs(float(decoded[0, 0, 0]) - 8851) > 1
    assert codec.max_error is None
    assert open_codec("exr:float", HEIGHTS).max_error == 0


@pytest.mark.parametrize("spec", HEIGHT_CODECS)
def test_c22_negative_zero_is_zero(spec: str) -> None:
    """-0.0 decodes to something equal to 0 (within the codec's step)."""
    codec = open_codec(spec, HEIGHTS)
    decoded, mask = codec.decode(codec.encode(np.full((64, 64, 1), -0.0, np.float32), None))
    assert mask is None
    assert np.abs(decoded).max() <= (codec.max_error or 0)


@pytest.mark.parametrize("spec", HEIGHT_CODECS)
def test_c68_constant_and_nearly_void_blocks(spec: str) -> None:
    """A constant block and one with a single valid sample survive every codec, mask included."""
    codec = open_codec(spec, HEIGHTS)
    constant = np.full((64, 64, 1), 812, np.float32)
    assert np.abs(codec.decode(codec.encode(constant, None))[0] - 812).max() <= (codec.max_error or 0)
    mask = np.zeros((64, 64), np.bool_)
    mask[63, 0] = True
    decoded, found = codec.decode(codec.encode(np.where(mask[..., np.newaxis], constant, np.float32(0)), mask))
    assert found is not None
    assert (found == mask).all()
    assert (decoded[~mask] == 0).all()


@pytest.mark.parametrize("spec", ["lerc:0.01", "png16:0.1,-1000", "exr:float"])
def test_c69_one_damaged_block_leaves_the_others_readable(spec: str, tmp_path: Path) -> None:
    """A truncated block is an error that says so; its neighbours decode as before."""
    source = write_tiff(tmp_path / "terrain.tif", terrain(96, 96).astype(np.float32))
    build_layer(source, tmp_path / "out", settings(codec=spec))
    dataset = open_dataset(tmp_path / "out")
    layer = dataset.manifest.layer("height")
    victim = tmp_path / "out" / layer.block_key("height", BlockAddress(0, 1, 1))
    victim.write_bytes(victim.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"has \d+ bytes instead of \d+; the block is damaged"):
        decode(dataset, "height", BlockAddress(0, 1, 1))
    assert decode(dataset, "height", BlockAddress(0, 0, 1))[1].all()


@pytest.mark.parametrize("codec", ["lerc:0.01", "exr:float", "png16:0.1,-1000"])
def test_c70_same_bytes_from_any_number_of_threads(codec: str, tmp_path: Path) -> None:
    """One thread, two, five, tasks in another order: the same digests."""
    source = write_tiff(tmp_path / "terrain.tif", terrain(200, 200).astype(np.float32))
    versions = {
        build_layer(source, tmp_path / f"out{number}", settings(codec=codec, workers=workers, task=task)).manifest.version
        for number, (workers, task) in enumerate(((1, 64), (2, 64), (5, 64), (2, 4096)))
    }
    assert len(versions) == 1


def test_c71_lossy_borders_agree_within_the_bound(tmp_path: Path) -> None:
    """Two blocks that store the same border sample decode to heights at most two error bounds apart: no cracks beyond that."""
    bound = 0.5
    source = write_tiff(tmp_path / "terrain.tif", (30 * np.random.default_rng(71).normal(size=(128, 128, 1))).astype(np.float32))
    build_layer(source, tmp_path / "out", settings(codec=f"lerc:{bound}", pad=4))
    dataset = open_dataset(tmp_path / "out")
    left, _ = decode(dataset, "height", BlockAddress(0, 0, 0))
    right, _ = decode(dataset, "height", BlockAddress(0, 1, 0))
    difference = np.abs(left[4:36, 32:40] - right[4:36, :8])
    assert 0 < difference.max() <= 2 * bound
