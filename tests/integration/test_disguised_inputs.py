"""Whole builds of inputs that are not what they seem: 16 bits to be seen as 8, 12 bits in 16, pictures stored sideways."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.errors import InputError, UsageError
from schemas.manifest import Manifest
from tests.contract.picture_files import write_with_openimageio
from tests.contract.plain_tiff import MIN_IS_BLACK, RGB, tiff_bytes
from tests.integration.files import Picture, assemble, settings, tree_digest, write_tiff
from tests.reference.terrain import photo, terrain
from tiler.building.build import build_layer
from tiler.stores.dataset import open_dataset


def scene(height: int, width: int) -> Picture:
    """A photograph as a satellite's 16-bit numbers: dark, each channel with a range of its own."""
    gain, offset = np.array([30, 40, 50], np.uint16), np.array([6000, 7000, 8000], np.uint16)
    return photo(height, width, seed=3).astype(np.uint16) * gain + offset


def built(path: Path, output: Path, **options: Any) -> tuple[Manifest, Picture]:
    """The manifest, and level 0 of the only layer, cut to its size."""
    build_layer(path, output, settings(**options))
    dataset = open_dataset(output)
    ((name, layer),) = dataset.manifest.layers.items()
    return dataset.manifest, assemble(dataset, name, 0)[0][: layer.height, : layer.width]


def test_a_stretched_layer(tmp_path: Path) -> None:
    pixels = scene(100, 130)
    path = write_tiff(tmp_path / "scene.tif", pixels)
    manifest, found = built(path, tmp_path / "out", stretch="2%")
    layer = manifest.layers["imagery"]
    planes = [np.sort(plane.ravel()) for plane in np.moveaxis(pixels, -1, 0)]
    ranges = [(float(plane[260]), float(plane[-261])) for plane in planes]
    assert layer.source.stretch == ranges
    assert (layer.dtype, layer.channels, layer.alpha, layer.source.dtype, layer.source.scale) == ("uint8", 3, False, "uint16", 1)
    assert found.dtype == np.uint8
    for channel, (low, high) in enumerate(ranges):
        exact = np.clip((pixels[..., channel] - low) * 255 / (high - low), 0, 255)
        assert np.abs(found[..., channel] - exact).max() <= 0.5 + 1e-4
    assert built(path, tmp_path / "plain")[0].layers["imagery"].source.stretch is None


@pytest.mark.parametrize(("nodata", "codec"), [(None, "jpeg:85"), (6000.0, "png")])
def test_the_codec_follows_what_is_stored(nodata: float | None, codec: str, tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "scene.tif", scene(60, 60))
    manifest, _ = built(path, tmp_path / "out", stretch="6000,20000", nodata=nodata, codec=None)
    assert manifest.layers["imagery"].codec == codec
    assert manifest.layers["imagery"].source.stretch == [(6000.0, 20000.0)] * 3


@pytest.mark.parametrize("options", [{}, {"linear_light": True, "enhance": "wavelet:1.5"}], ids=["plain", "light and details"])
def test_bytes_do_not_depend_on_workers_or_tasks(options: dict[str, Any], tmp_path: Path) -> None:
    pixels = scene(150, 210)
    pixels[40:70, 90:120] = 0
    path = write_tiff(tmp_path / "scene.tif", pixels, nodata=0)
    digests = set()
    for number, (workers, task) in enumerate(itertools.product((1, 3), (64, 4096))):
        build_layer(path, tmp_path / f"out{number}", settings(stretch="1.5%", workers=workers, task=task, **options))
        digests.add(tree_digest(tmp_path / f"out{number}"))
    assert len(digests) == 1


def test_stretch_composes_with_linear_light_and_enhancement(tmp_path: Path) -> None:
    """The same as if the file had held the stretched numbers; light is that of 8-bit codes."""
    low, high = 6000, 6000 + 255 * 40
    codes = photo(90, 120, seed=3)
    as_16_bits = write_tiff(tmp_path / "16.tif", codes.astype(np.uint16) * np.uint16(40) + np.uint16(low))
    as_8_bits = write_tiff(tmp_path / "8.tif", codes)
    light, details = {"linear_light": True}, {"enhance": "wavelet:2"}
    combinations: list[dict[str, Any]] = [{}, light, details, {**light, **details}]
    for number, options in enumerate(combinations):
        stretched, plain = tmp_path / f"16-{number}", tmp_path / f"8-{number}"
        build_layer(as_16_bits, stretched, settings(stretch=f"{low},{high}", **options))
        build_layer(as_8_bits, plain, settings(**options))
        one, other = open_dataset(stretched), open_dataset(plain)
        for level in range(len(one.manifest.layers["imagery"].levels)):
            found, expected = assemble(one, "imagery", level)[0], assemble(other, "imagery", level)[0]
            assert np.abs(found.astype(int) - expected).max() <= 1, "as rounding may differ"
            assert (found != expected).mean() < 0.001


def test_mistakes_leave_nothing_and_cost_no_pass_over_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_tiff(tmp_path / "scene.tif", scene(60, 60))
    built(path, tmp_path / "out", stretch="2%")
    before = tree_digest(tmp_path / "out")
    monkeypatch.setattr("tiler.samples.opening.find_ranges", None)
    mistakes: list[tuple[dict[str, Any], str]] = [
        ({"stretch": "3%"}, r"other settings \(stretch was 2%, now 3%\); add --overwrite"),
        ({"stretch": "2", "overwrite": True}, "expected CUT%"),
        ({"stretch": "2%", "layer": "height", "bands": (1,), "overwrite": True}, "--stretch is for imagery"),
    ]
    for options, sentence in mistakes:
        with pytest.raises(UsageError, match=sentence):
            build_layer(path, tmp_path / "out", settings(**options))
    assert build_layer(path, tmp_path / "out", settings(stretch="2%")).outcome == "up to date"
    assert tree_digest(tmp_path / "out") == before


def test_12_bits_of_colour_become_16(tmp_path: Path) -> None:
    pixels = scene(70, 90) >> 4
    path = tmp_path / "colour.tif"
    path.write_bytes(tiff_bytes(pixels, 12, RGB))
    manifest, found = built(path, tmp_path / "out")
    layer = manifest.layers["imagery"]
    assert (layer.dtype, layer.source.scale) == ("uint16", 65535 / 4095)
    assert np.abs(found - pixels * (65535 / 4095)).max() <= 0.51
    manifest, found = built(path, tmp_path / "stretched", stretch="0,4095")
    assert np.abs(found - pixels * (255 / 4095)).max() <= 0.51
    assert (manifest.layers["imagery"].dtype, manifest.layers["imagery"].source.scale) == ("uint8", 1)


def test_12_bits_of_height_stay_what_they_are(tmp_path: Path) -> None:
    pixels = np.clip(terrain(70, 90, seed=3) + 1000, 0, 4095).astype(np.uint16).reshape(70, 90, 1)
    path = tmp_path / "height.tif"
    path.write_bytes(tiff_bytes(pixels, 12, MIN_IS_BLACK))
    manifest, found = built(path, tmp_path / "out", layer="height", height_scale=0.5)
    assert np.array_equal(found, pixels * np.float32(0.5))
    assert manifest.layers["height"].source.scale == 0.5


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_picture_stored_sideways_is_built_upright(orientation: int, tmp_path: Path) -> None:
    pixels = photo(100, 70, seed=3)
    stored = pixels[::-1, ::-1] if orientation == 3 else np.rot90(pixels, 1)
    path = tmp_path / "sideways.tif"
    write_with_openimageio(path, np.ascontiguousarray(stored), 32, Orientation=orientation)
    manifest, found = built(path, tmp_path / "out")
    assert (manifest.layers["imagery"].width, manifest.layers["imagery"].height) == (70, 100)
    np.testing.assert_array_equal(found, pixels)


def test_a_file_of_more_samples_than_allowed(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "scene.tif", scene(60, 60))
    with pytest.raises(InputError, match=r"declares 60 x 60 x 3 = 10800 samples, more than 10799; .* --max-samples 10800"):
        build_layer(path, tmp_path / "out", settings(max_samples=10799))
    build_layer(path, tmp_path / "out", settings(max_samples=10800))


@pytest.mark.parametrize("void", [3.4028234663852886e38, -1e32])
def test_c23_an_undeclared_void_ends_a_build_of_heights(void: float, tmp_path: Path) -> None:
    pixels = terrain(100, 130, seed=3).astype(np.float32).reshape(100, 130, 1)
    pixels[77:80, 100:110] = void
    path = write_tiff(tmp_path / "dem.tif", pixels)
    with pytest.raises(InputError, match="is no height; if it marks voids, give --nodata") as caught:
        build_layer(path, tmp_path / "out", settings())
    given = float(str(caught.value).rsplit(" ", 1)[1])
    build_layer(path, tmp_path / "out", settings(nodata=given))
    assert open_dataset(tmp_path / "out").manifest.layers["height"].statistics.valid == 100 * 130 - 30


def test_c22_negative_zero_does_not_show_in_the_bytes(tmp_path: Path) -> None:
    digests = set()
    for zero in (0.0, -0.0):
        pixels = terrain(70, 70, seed=3).astype(np.float32).reshape(70, 70, 1)
        pixels[10:50, 10:50] = zero
        folder = tmp_path / str(zero)
        folder.mkdir()
        build_layer(write_tiff(folder / "dem.tif", pixels), folder / "out", settings())
        digests.add(tree_digest(folder / "out"))
    assert len(digests) == 1
