"""Draws ``docs/images/light-*.png``: Puget Sound under a sun 10 degrees high in the west, with and without each effect.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python -m docs.light

1025 x 1025 heights at 160 m, lit by the kernels of ``tiler/light`` directly: the cosine of the sun's angle to the ground where the sun
is seen, and the share of the sky, encoded for screens (IEC 61966-2-1). Takes some seconds. Look at the result before you commit it.
"""

import os
import sys
from pathlib import Path
from typing import Final

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from schemas.settings import BuildSettings
from tiler.accuracy.lightground import Ground, ground_of
from tiler.accuracy.lightparts import sky_share
from tiler.accuracy.sample import load_sample
from tiler.light.certified import certified_shadow
from tiler.light.disc import disc_coverage
from tiler.light.frame import Earth, SunPosition, sine_cosine_deg
from tiler.light.horizons import horizon_tangents
from tiler.light.shadow import local_elevation_deg, rays_of
from tiler.light.sweeping import LIT

IMAGES: Final = Path(__file__).parent / "images"
CELL_M: Final = (160.0, 160.0)
SUN: Final = SunPosition(270.0, 10.0)
SKY: Final = 0.15
"""Light of the whole sky, as a share of that of a sun in the zenith."""
RAINIER: Final = Rect(740, 440, 996, 612)
"""Mount Rainier, its shadow to the east, and the valleys around it: 41 by 28 km."""
ZOOM: Final = 3
DARKEST_SKY: Final = 0.6
"""Drawn black in the picture of the sky."""
ALBEDO: Final = 0.3
AMPLIFIED: Final = 24
"""So many times as bright as it is is what the ground reflects drawn."""

Picture = NDArray[np.float64]


def lambert(ground: Ground, elevation_deg: float) -> Picture:
    """Return the cosine (h, w) of the sun's angle to the ground's normal, 0 where it turns away."""
    east, north = ground.slopes()
    (sine, cosine), (up, level) = sine_cosine_deg(SUN.azimuth_deg), sine_cosine_deg(elevation_deg)
    found: Picture = np.maximum((up - level * (east * sine + north * cosine)) / np.sqrt(1 + east**2 + north**2), 0)
    return found


def hard(ground: Ground, earth: Earth | None = None) -> Picture:
    """Return 1 where the middle of the sun is seen, else 0."""
    lit: Picture = (certified_shadow(ground.heights_m, ground.cell_m, SUN, earth) == LIT).astype(np.float64)
    return lit


def soft(ground: Ground, earth: Earth | None = None) -> Picture:
    """Return the share of the sun's disc that is seen."""
    tangents = horizon_tangents(ground.heights_m, ground.cell_m, SUN.azimuth_deg, earth, near_steps=32)
    height, width = ground.heights_m.shape
    rays = rays_of((height, width), ground.cell_m, SUN, earth)
    elevation = SUN.elevation_deg if earth is None else local_elevation_deg(rays, Rect(0, 0, width, height))
    return disc_coverage(tangents, elevation).astype(np.float64)


def sky(ground: Ground) -> Picture:
    """Return the share of the sky's light that falls on the ground."""
    return sky_share(lambda azimuth: horizon_tangents(ground.heights_m, ground.cell_m, azimuth, near_steps=16), ground.slopes(), 32)


def for_screens(light: Picture) -> Picture:
    """Return linear light, 0 to 1, encoded for screens."""
    light = np.clip(light, 0, 1)
    encoded: Picture = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return encoded


def part(light: Picture, window: Rect, zoom: int) -> NDArray[np.uint8]:
    """Return a window as 8-bit codes, every sample ``zoom`` pixels wide."""
    codes: NDArray[np.uint8] = np.rint(255 * np.clip(light[window.y0 : window.y1, window.x0 : window.x1], 0, 1)).astype(np.uint8)
    return codes.repeat(zoom, axis=0).repeat(zoom, axis=1)


def halved(light: Picture) -> Picture:
    """Return the means of 2 x 2 samples: light adds up."""
    means: Picture = light[:1024, :1024].reshape(512, 2, 512, 2).mean(axis=(1, 3))
    return means


def write(name: str, pixels: NDArray[np.uint8]) -> None:
    """Write a picture (h, w) or (h, w, 3)."""
    (IMAGES / f"light-{name}.png").write_bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels), level=9))


def changed(before: Picture, after: Picture, window: Rect, zoom: int) -> NDArray[np.uint8]:
    """Return ``before`` in grey, with what ``after`` has lighter in orange and what it has darker in blue."""
    grey = part(0.25 + 0.5 * before, window, zoom)
    more, less = (part(np.clip(sign * (after - before), 0, 1), window, zoom).astype(np.float64) / 255 for sign in (1, -1))
    share, colour = (more + less)[..., np.newaxis], np.array([255.0, 120, 20]) * more[..., np.newaxis]
    colour = (colour + np.array([30.0, 110, 255]) * less[..., np.newaxis]) / np.maximum(share, 1e-9)
    return np.rint(grey[..., np.newaxis] * (1 - share) + colour * share).astype(np.uint8)


def main() -> None:
    """Draw all pictures, and say in figures what they show."""
    if "CLIPMAP_TEST_DATA" not in os.environ:
        sys.exit("CLIPMAP_TEST_DATA names no folder of real inputs: there is nothing to draw")
    path = Path(os.environ["CLIPMAP_TEST_DATA"]) / "puget" / "ps_height_1k.png"
    ground = ground_of(load_sample(path, BuildSettings(layer="height", height_scale=0.1), 1024), CELL_M)
    cosine, flat_hard, flat_soft, open_sky = lambert(ground, SUN.elevation_deg), hard(ground), soft(ground), sky(ground)
    round_hard, bent_hard = hard(ground, Earth(refraction=0.0)), hard(ground, Earth())
    write("plain", part(for_screens(cosine), RAINIER, ZOOM))
    write("hard", part(for_screens(cosine * flat_hard), RAINIER, ZOOM))
    write("soft", part(for_screens(cosine * flat_soft), RAINIER, ZOOM))
    write("penumbra", part(0.5 + 0.5 * (flat_soft - flat_hard), RAINIER, ZOOM))
    write("sky", part((open_sky - DARKEST_SKY) / (1 - DARKEST_SKY), RAINIER, ZOOM))
    write("all", part(for_screens(halved((cosine * flat_soft + SKY * open_sky) / (1 + SKY))), Rect(0, 0, 512, 512), 1))
    write("curvature", changed(flat_hard, round_hard, RAINIER, ZOOM))
    write("refraction", changed(round_hard, bent_hard, RAINIER, ZOOM))
    reflected = ALBEDO * (1 - open_sky) * float((cosine * flat_soft + SKY * open_sky).mean())
    write("bounce", part(AMPLIFIED * reflected / (1 + SKY), RAINIER, ZOOM))
    partly = (flat_soft > 0) & (flat_soft < 1)
    sys.stdout.write(
        f"shaded: flat {100 * (1 - flat_hard.mean()):.2f} %, round {100 * (1 - round_hard.mean()):.2f} %, with refraction "
        f"{100 * (1 - bent_hard.mean()):.2f} %; changed by curvature {100 * (flat_hard != round_hard).mean():.2f} %, by refraction of "
        f"that {100 * (bent_hard != round_hard).mean():.2f} %; partly lit {100 * partly.mean():.2f} %; sky {open_sky.min():.2f} to 1, "
        f"mean {open_sky.mean():.3f}; reflected "
        f"{255 * reflected.max() / (1 + SKY):.1f} codes at most, {255 * reflected.mean() / (1 + SKY):.2f} on average\n"
    )


if __name__ == "__main__":
    main()
