"""Heights hidden in colour are told from pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.region import Rect
from schemas.settings import BuildSettings
from tests.reference.terrain import photo, power_law_field, terrain
from tests.unit.memory_reader import MemoryReader
from tiler.sources.convert import Conversion, choose_conversion
from tiler.sources.disguise import hidden_heights, refuse_disguised_heights


def terrain_rgb(heights: NDArray[np.float64]) -> NDArray[np.uint8]:
    steps = np.rint((heights[..., 0] + 10000) * 10).astype(np.int64)
    return np.stack([steps >> 16, steps >> 8 & 255, steps & 255], axis=-1).astype(np.uint8)


def terrarium(heights: NDArray[np.float64], fractions: bool = True) -> NDArray[np.uint8]:
    steps = np.rint((heights[..., 0] + 32768) * 256).astype(np.int64)
    return np.stack([steps >> 16, steps >> 8 & 255, steps & 255 if fractions else 0 * steps], axis=-1).astype(np.uint8)


def smooth(rms_m: float, mean_m: float = 1500, exponent: float = 4.0) -> NDArray[np.float64]:
    return terrain(256, 256, 3, exponent=exponent, rms_m=rms_m, mean_m=mean_m)


DISGUISED = {
    **{f"terrain-rgb-{rms}": (terrain_rgb(smooth(rms)), "terrain-rgb") for rms in (20, 100, 400)},
    "terrain-rgb-rough": (terrain_rgb(smooth(100, exponent=3.0)), "terrain-rgb"),
    "terrain-rgb-sea": (terrain_rgb(np.maximum(smooth(200, 0), 0)), "terrain-rgb"),
    "terrain-rgb-deep": (terrain_rgb(smooth(300, -6000)), "terrain-rgb"),
    "terrain-rgb-carry-of-red": (terrain_rgb(smooth(300, 3107.2)), "terrain-rgb"),
    "terrain-rgb-plain-slope": (terrain_rgb(np.add.outer(np.arange(256.0), np.arange(256.0))[..., np.newaxis]), "terrain-rgb"),
    **{f"terrarium-{rms}": (terrarium(smooth(rms)), "terrarium") for rms in (300, 1000)},
    "terrarium-whole-metres": (terrarium(smooth(400), fractions=False), "terrarium"),
    "terrarium-gentle": (terrarium(smooth(3)), "terrarium"),
    "terrarium-sea-floor": (terrarium(smooth(800, -3000)), "terrarium"),
}


def _mosaic(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Tiles of 8 x 8 pixels, dark and bright in turn: every step between neighbours is a jump by more than half the range."""
    dark = rng.integers(0, 60, (32, 32, 3))
    bright = np.add.outer(np.arange(32), np.arange(32))[..., np.newaxis] % 2 * 195
    tiles: NDArray[np.uint8] = (dark + bright).astype(np.uint8)
    return tiles.repeat(8, axis=0).repeat(8, axis=1)


def pictures() -> dict[str, NDArray[np.uint8]]:
    rng = np.random.default_rng(7)
    ramp = np.arange(256, dtype=np.uint8)
    across, down = np.broadcast_to(ramp, (256, 256)), np.broadcast_to(ramp[:, np.newaxis], (256, 256))
    field = [power_law_field(256, 256, seed, 2.5) for seed in range(3)]
    hard = [np.where(part > 0, 250, 5).astype(np.uint8) for part in field]
    return {
        "photo": photo(256, 256),
        "noise": rng.integers(0, 256, (256, 256, 3), dtype=np.uint8),
        "noise in one channel": np.stack([across // 64, down, rng.integers(0, 256, (256, 256), dtype=np.uint8)], axis=-1),
        "flat": np.full((256, 256, 3), 128, np.uint8),
        "black": np.zeros((256, 256, 3), np.uint8),
        "grey ramp": np.stack([across] * 3, axis=-1),
        "colour ramps": np.stack([across, down, 255 - across], axis=-1),
        "ramps against each other": np.stack([across, 255 - across, across], axis=-1),
        "sawtooth in one channel": np.stack([down, (across.astype(int) * 5).astype(np.uint8), down], axis=-1),
        "independent sawteeth": np.stack(
            [(across.astype(int) * 7) % 256, (down.astype(int) * 11) % 256, (across.astype(int) * 13) % 256], axis=-1
        ).astype(np.uint8),
        "hard edges": np.stack(hard, axis=-1),
        "edges against each other": np.stack([hard[0], 255 - hard[0], hard[1]], axis=-1),
        "dither of two colours": np.where(rng.random((256, 256, 1)) < 0.5, np.array([10, 250, 90]), np.array([11, 5, 90])).astype(np.uint8),
        "false colour": np.stack([np.clip(128 + 60 * part, 0, 255).astype(np.uint8) for part in field], axis=-1),
        "mosaic": _mosaic(rng),
        "photo of few levels": photo(256, 256) // 64 * 64,
        "checkers": np.where((across // 2 + down // 2) % 2, 255, 0).astype(np.uint8)[..., np.newaxis].repeat(3, axis=-1),
        "one pixel": np.zeros((1, 1, 3), np.uint8),
        "one row": photo(8, 256)[:1],
    }


@pytest.mark.parametrize("name", pictures())
def test_pictures_are_not_taken_for_heights(name: str) -> None:
    assert hidden_heights(pictures()[name]) is None


def test_hidden_heights_are_refused_before_they_become_imagery() -> None:
    """By guess and with --layer imagery; only a window at the centre is read."""
    heights = np.pad(terrain_rgb(smooth(100)), ((500, 500), (1000, 1000), (0, 0)))
    for settings in (BuildSettings(), BuildSettings(layer="imagery")):
        reader = MemoryReader(heights)
        with pytest.raises(
            UsageError, match=r"dem\.tif: looks like heights hidden in colour; build it with --layer height --decode terrain-rgb"
        ):
            refuse_disguised_heights(reader, choose_conversion(reader.info, settings))
        assert reader.windows == [Rect(1000, 500, 1256, 756)]


def test_what_cannot_be_hidden_heights_is_not_read() -> None:
    reader = MemoryReader(np.zeros((300, 300, 3), np.uint16))
    refuse_disguised_heights(reader, choose_conversion(reader.info, BuildSettings()))
    conversion = Conversion("height", (0, 1, 2), None, False, None, "terrarium", 1.0, 0.0, "float32")
    for kept in (conversion, replace(conversion, kind="imagery", colours=(0,), decode=None)):
        refuse_disguised_heights(reader, kept)
    assert not reader.windows


REAL = {
    "bluemarble/world_topo_bathy_200411_3x5400x2700.jpg": None,
    "puget/ps_texture_1k.png": None,
    "grandcanyon/gcanyon_color.1024.png": None,
    "imagery/naip_rgba_3857.tif": None,
    "imagery/rgb_mask.tif": None,
    "imagery/rgba_alpha.tif": None,
    "dem/fuji_terrain_rgb.png": "terrain-rgb",
    "dem/st_helens_terrain_rgb.png": "terrain-rgb",
    "dem/grandcanyon_terrarium.png": "terrarium",
}


@pytest.mark.parametrize("name", DISGUISED)
def test_heights_hidden_in_colour_are_seen(name: str) -> None:
    colours, encoding = DISGUISED[name]
    assert hidden_heights(colours) == encoding
    assert hidden_heights(colours[:, ::-1]) == encoding
    assert hidden_heights(colours.swapaxes(0, 1)) == encoding


@pytest.mark.parametrize("name", REAL)
def test_real_pictures_and_real_heights(name: str, data_dir: Path) -> None:
    """At the centre, and for pictures anywhere: a picture refused by mistake would be the worse error."""
    pixels = OpenImageIO.ImageBuf(str(data_dir / name)).get_pixels(OpenImageIO.UINT8)
    assert pixels is not None
    colours = pixels[..., :3]
    height, width = colours.shape[:2]
    top, left = max(0, (height - 256) // 2), max(0, (width - 256) // 2)
    assert hidden_heights(colours[top : top + 256, left : left + 256]) == REAL[name]
    if REAL[name] is None:
        for y in range(0, height, 256):
            for x in range(0, width, 256):
                assert hidden_heights(colours[y : y + 256, x : x + 256]) is None
