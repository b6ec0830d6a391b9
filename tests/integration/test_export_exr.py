"""EXR: one mip-mapped file whose levels are ours, for OpenEXR, for OpenImageIO, and for a texture system that looks them up."""

from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from numpy.typing import NDArray

from schemas.errors import UsageError
from tests.integration.export_datasets import HEIGHTS, IMAGERY, KINDS, build, exported, level_samples, the_layer
from tests.levels import run_cascade
from tiler.stores.dataset import Dataset, open_dataset

Pixels = NDArray[np.float64]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("exports")


def light(codes: NDArray[Any], top: int) -> Pixels:
    """Decode sRGB as IEC 61966-2-1 has it, sample by sample in float64."""
    value = codes / top
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def expected_level(dataset: Dataset, level: int) -> Pixels:
    """What a level's pixels should be, from its decoded blocks, before they are rounded to the file's type."""
    layer = dataset.manifest.layer(the_layer(dataset))
    samples, valid = level_samples(dataset, level)
    if layer.kind == "height":
        metres = np.where(valid[..., np.newaxis], samples, 0).astype(np.float64)
        voids = layer.statistics.valid < layer.width * layer.height
        return np.concatenate([metres, valid[..., np.newaxis]], axis=-1) if voids else metres
    top = np.iinfo(samples.dtype).max
    colours = samples[..., : layer.channels - layer.alpha]
    pixels = light(colours, top) if top == 255 or layer.filter.linear_light else colours / top
    if not layer.alpha:
        return pixels
    alpha = samples[..., -1:] / top
    return np.concatenate([pixels * alpha, alpha], axis=-1)


def read_level(path: Path, level: int, pixel_type: str = "float") -> NDArray[np.float32]:
    file = OpenImageIO.ImageInput.open(str(path))
    assert file is not None, OpenImageIO.geterror()
    spec = file.spec(0, level)
    pixels = file.read_image(0, level, 0, spec.nchannels, pixel_type)
    assert pixels is not None, file.geterror()
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


@pytest.mark.parametrize("kind", KINDS)
def test_every_level_is_a_mip_level(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}.exr"
    report = exported(folder / kind / "out", "exr", target)
    half = layer.dtype == "uint8"
    for level in range(len(layer.levels)):
        expected = expected_level(dataset, level)
        found = read_level(target, level)
        # Two float32 roundings (light, alpha) and the product's; then half's 11 bits, and its smallest step of 2^-24.
        relative, smallest = (2**-11 + 2**-21, 2**-24) if half else (2**-21, 0.0)
        np.testing.assert_allclose(found, expected, rtol=relative if layer.kind == "imagery" else 0, atol=smallest)
    assert report.done.stored_bytes == target.stat().st_size
    sizes = [read_level(target, level).shape[1::-1] for level in range(report.done.levels)]
    assert sizes == [(ceil(layer.width / 2**level), ceil(layer.height / 2**level)) for level in range(len(sizes))]
    assert sizes[-1] == (1, 1)
    assert len(sizes) == 1 or max(sizes[-2]) == 2


@pytest.mark.parametrize("kind", ["lerc", "full_heights", "png_rgba", "jpeg"])
def test_openexr_itself_reads_it(kind: str, folder: Path) -> None:
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}-openexr.exr"
    exported(folder / kind / "out", "exr", target)
    with OpenEXR.File(str(target), separate_channels=True) as file:
        header = dict(file.header())
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    names = {"lerc": "AY", "full_heights": "Y", "png_rgba": "ABGR", "jpeg": "BGR"}[kind]
    assert sorted(channels) == list(names)
    tiles = header["tiles"]
    assert (tiles.xSize, tiles.ySize) == (32, 32)
    assert tiles.mode == OpenEXR.LevelMode.MIPMAP_LEVELS
    assert tiles.roundingMode == OpenEXR.LevelRoundingMode.ROUND_UP
    order = "YA" if "Y" in names else "RGBA"
    stacked = np.stack([channels[name] for name in order if name in channels], axis=-1)
    assert stacked.dtype == (np.float32 if layer.kind == "height" else np.float16)
    assert (stacked.astype(np.float32) == read_level(target, 0)).all()
    assert header["clipmap:filter"].startswith("blackman-sinc, radius")
    assert header["clipmap:registration"] == layer.registration
    assert tuple(map(float, header["clipmap:transform"].split())) == layer.transform
    assert header.get("clipmap:crs", "") == (dataset.manifest.world.crs or "")


@pytest.mark.parametrize("kind", ["png_rgba", "webp_rgba", "light", "png_rgba16"])
def test_no_code_is_lost(kind: str, folder: Path) -> None:
    """Where alpha is not 0, dividing by it and encoding as sRGB again gives every stored code back: half floats are enough."""
    dataset = open_dataset(build(kind, folder))
    exported(folder / kind / "out", "exr", folder / f"{kind}-codes.exr", overwrite=True)
    samples, _ = level_samples(dataset, 0)
    top = np.iinfo(samples.dtype).max
    found = read_level(folder / f"{kind}-codes.exr", 0).astype(np.float64)
    colour = found[..., :3]
    if samples.shape[-1] == 4:
        assert (np.rint(found[..., 3] * top) == samples[..., 3]).all()
        colour = colour / np.where(found[..., 3:] > 0, found[..., 3:], 1)
    if top == 255:
        colour = np.where(colour <= 0.0031308, colour * 12.92, 1.055 * np.maximum(colour, 1e-9) ** (1 / 2.4) - 0.055)
    seen = samples[..., -1] > 0 if samples.shape[-1] == 4 else np.s_[:]
    assert (np.rint(colour * top) == samples[..., :3])[seen].all()


def test_codes_may_be_kept(folder: Path) -> None:
    dataset = open_dataset(build("jpeg", folder))
    exported(folder / "jpeg" / "out", "exr", folder / "codes.exr", codes=True, half=False)
    np.testing.assert_allclose(read_level(folder / "codes.exr", 0), level_samples(dataset, 0)[0] / 255, rtol=2**-23)
    with OpenEXR.File(str(folder / "codes.exr")) as file:
        assert file.header()["clipmap:values"] == "codes / 255"


def test_levels_beyond_ours_are_made_by_our_filter(folder: Path) -> None:
    """Below the last stored level there is what the layer's own filter makes of it: heights, holes and all."""
    dataset = open_dataset(build("lerc", folder))
    exported(folder / "lerc" / "out", "exr", folder / "tail.exr", overwrite=True)
    last = len(dataset.manifest.layer("height").levels) - 1
    samples, valid = level_samples(dataset, last)
    samples = np.where(valid[..., np.newaxis], samples, np.float32(0))
    rows = run_cascade(samples, valid.astype(np.float32), levels=4, kind="height", radius=6)
    for beyond in (1, 2, 3):
        _, values, coverage = rows[beyond]
        assert coverage is not None
        found = read_level(folder / "tail.exr", last + beyond)
        assert (found[..., 1] == (coverage > 0)).all()
        assert (found[..., 0] == np.where(coverage > 0, values[..., 0], 0)).all()


def test_levels_beyond_ours_are_made_in_light_if_ours_were(folder: Path) -> None:
    dataset = open_dataset(build("light", folder))
    exported(folder / "light" / "out", "exr", folder / "light.exr", overwrite=True, codes=True, half=False)
    last = len(dataset.manifest.layer("imagery").levels) - 1
    samples, _ = level_samples(dataset, last)
    rows = run_cascade(light(samples, 255).astype(np.float32), None, levels=2, kind="imagery", radius=3)
    mean = np.clip(rows[1][1].astype(np.float64), 0, 1)
    codes = 255 * np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * np.maximum(mean, 1e-9) ** (1 / 2.4) - 0.055)
    # Half a code of rounding, and what float32 light is off by.
    assert np.abs(read_level(folder / "light.exr", last + 1) * 255 - codes).max() <= 0.501


@pytest.mark.parametrize("kind", ["full_heights", "jpeg"])
def test_texture_lookups_see_our_levels(kind: str, folder: Path) -> None:
    """A lookup as wide as a level's texel returns that level's sample; nothing is filtered down from level 0 on the way."""
    dataset = open_dataset(build(kind, folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    target = folder / f"{kind}-texture.exr"
    exported(folder / kind / "out", "exr", target)
    cache = OpenImageIO.ImageCache(False)
    textures = OpenImageIO.TextureSystem(False)
    options = OpenImageIO.TextureOpt()
    options.swrap = options.twrap = OpenImageIO.Wrap.Clamp
    options.interpmode = OpenImageIO.InterpMode.Closest
    options.mipmode = OpenImageIO.MipMode.OneLevel
    for level in range(1, len(layer.levels)):
        found = read_level(target, level)
        height, width, channels = found.shape
        cached = cache.get_pixels(str(target), 0, level, 0, width, 0, height)
        assert (np.asarray(cached).reshape(found.shape) == found).all()
        for row, column in ((0, 0), (height // 2, width // 3), (height - 1, width - 1)):
            s, t = (column + 0.5) / width, (row + 0.5) / height
            looked_up = textures.texture(str(target), options, s, t, 1 / width, 0.0, 0.0, 1 / height, channels)
            np.testing.assert_allclose(looked_up, found[row, column], rtol=1e-6)


def test_the_bytes_do_not_depend_on_workers_or_time(folder: Path) -> None:
    build("png_rgba", folder)
    contents = set()
    for workers in (1, 2, 5):
        exported(folder / "png_rgba" / "out", "exr", folder / "workers.exr", workers=workers, overwrite=True)
        contents.add((folder / "workers.exr").read_bytes())
    assert len(contents) == 1


def test_half_floats_are_refused_where_they_end(tmp_path: Path) -> None:
    from tests.integration.files import settings, write_tiff
    from tiler.building.build import build_layer

    source = write_tiff(tmp_path / "high.tif", np.full((20, 20, 1), 70_000, np.float32))
    build_layer([source], tmp_path / "out", settings())
    with pytest.raises(UsageError, match=r"70000.*65504.*--half"):
        exported(tmp_path / "out", "exr", tmp_path / "high.exr", half=True)
    assert not list(tmp_path.glob("*.exr"))
    exported(tmp_path / "out", "exr", tmp_path / "high.exr")
    assert (read_level(tmp_path / "high.exr", 2) == 70_000).all()


def test_all_kinds_are_covered() -> None:
    assert set(KINDS) == set(HEIGHTS) | set(IMAGERY)
