"""Writes the table of estimates of ``docs/EFFECTS.md``: what is estimated on a coarse level beside what is true of every sample.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python docs/effects_estimates.py

Takes a minute. The built-in island needs nothing, the real terrains the folder of real inputs; without it nothing is written. What is true
is the sky as light is baked: 16 azimuths, horizons with 16 exact steps.
"""

import math
import os
from pathlib import Path
from typing import Final

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from docs.markers import with_content
from schemas.scene import Scene, Sun
from tiler.effects.bounds import FULL_SCALE, code_scale
from tiler.effects.estimate import estimate_effects
from tiler.effects.plan import plan_effects
from tiler.effects.statistics import measure_heights
from tiler.light.frame import sine_cosine_deg
from tiler.light.horizons import horizon_tangents
from tiler.light.shading import add_sky
from tiler.terrain import make_island

Float32 = NDArray[np.float32]

TARGET: Final = Path(__file__).parent / "EFFECTS.md"
BEGIN: Final = "<!-- estimates: written by docs/effects_estimates.py -->"
END: Final = "<!-- end of the estimates -->"
SCENE: Final = Scene(sun=Sun(azimuth_deg=270, elevation_deg=40))
AZIMUTHS: Final = 16
UNIT: Final = 1 << 20


def hidden(heights: Float32, cell_m: float) -> tuple[float, float]:
    """Return the largest parts of the sky that are hidden and of what is seen that is ground, over all samples."""
    around = np.pad(heights, 1, constant_values=np.float32(np.nan))
    cells = np.full((2, heights.shape[0]), cell_m)
    seen, open_sky = (np.zeros(heights.shape, np.uint32) for _ in range(2))
    for number in range(AZIMUTHS):
        azimuth = (number + 0.5) * 360 / AZIMUTHS
        horizon = np.fmax(horizon_tangents(heights, (cell_m, cell_m), azimuth), np.float32(0))
        add_sky(around, cells, horizon, *sine_cosine_deg(azimuth), seen)
        add_sky(around, cells, np.zeros_like(horizon), *sine_cosine_deg(azimuth), open_sky)
    whole = AZIMUTHS * UNIT
    return float((open_sky.astype(np.int64) - seen).max()) / whole, 1 - float(seen.min()) / whole


def terrains() -> dict[str, tuple[Float32, float]]:
    """Return heights [m] of terrains without voids, and the distance of their samples [m]."""
    folder = Path(os.environ["CLIPMAP_TEST_DATA"])

    def decoded(name: str) -> Float32:
        red, green, blue = (np.asarray(imagecodecs.imread(folder / "dem" / name))[..., n].astype(np.float64) for n in range(3))
        if "terrarium" in name:
            return np.asarray(256 * red + green + blue / 256 - 32768, np.float32)
        return np.asarray(0.1 * (65536 * red + 256 * green + blue) - 10000, np.float32)

    puget = np.asarray(imagecodecs.imread(folder / "puget" / "ps_height_1k.png")).astype(np.float32) * np.float32(0.1)
    canyon = np.asarray(imagecodecs.imread(folder / "grandcanyon" / "gcanyon_elev_crop.bw.png"))
    return {
        "Puget Sound, 160 m": (puget, 160.0),
        "Fuji, 30 m": (decoded("fuji_terrain_rgb.png"), 30.0),
        "St. Helens, 30 m": (decoded("st_helens_terrain_rgb.png"), 30.0),
        "Grand Canyon, 30 m": (decoded("grandcanyon_terrarium.png"), 30.0),
        "Grand Canyon of 8 bits, 60 m": (10 * canyon.reshape(*canyon.shape[:2], -1)[..., 0].astype(np.float32), 60.0),
        "built-in island, 20 m": (make_island(1024).heights_m.astype(np.float32), 20.0),
    }


def line(name: str, heights: Float32, cell_m: float, scale: float) -> str:
    """Return one line of the table."""
    z = np.ascontiguousarray(heights * np.float32(scale))
    found = measure_heights([z], (z.shape[0], z.shape[1]), (cell_m, cell_m), SCENE.sun.direction_deg)
    estimates, plan, true = estimate_effects(SCENE, found), plan_effects(SCENE, found), hidden(z, cell_m)
    if estimates is None:
        raise ValueError(f"{name}: nothing was estimated")
    shares = code_scale(SCENE.sky.share) * SCENE.sky.share * true[0], FULL_SCALE * SCENE.ground.albedo * true[1]
    cells = []
    for effect, estimate, share in zip(("sky", "bounce"), (estimates.sky, estimates.bounce), shares, strict=True):
        if estimate < share:
            raise ValueError(f"{name}: {effect} is {share}, more than the estimate, {estimate}")
        cells.append(f"{plan.effect(effect).bound:.3g} / {estimate:.3g} / {share:.3g} | {estimate / share:.1f}")  # type: ignore[arg-type]
    levels = f"{math.log2(estimates.step):.1f}"
    return (
        f"| {name}{f', {scale:g} of its heights' if scale != 1 else ''} | {levels} | {estimates.exaggeration:.2f} | {' | '.join(cells)} |"
    )


def main() -> None:
    """Write the table where real inputs are."""
    if "CLIPMAP_TEST_DATA" not in os.environ:
        return
    lines = [
        "| | levels | exaggerated | sky: bound / estimate / true | | bounce: bound / estimate / true | |",
        "|---|---|---|---|---|---|---|",
        *(line(name, *terrain, scale) for name, terrain in terrains().items() for scale in (1.0, 0.1)),
    ]
    TARGET.write_text(with_content(TARGET, BEGIN, END, "\n".join(lines)), encoding="utf-8")


if __name__ == "__main__":
    main()
