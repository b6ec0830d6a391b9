"""Measures what effects of light cost: the table of tiler/effects/costs.py.

    python tests/bench/effects.py [--size 4096] [--runs 3]

Times are processor times of one thread per sample of the terrain of ``tests/bench/light.py``, the best of ``--runs`` for each of three suns
or azimuths, of which the middle one counts. What an effect costs is what the light with it takes longer than without. Prints the
lines of the table; what is written there by hand is rounded to two digits. Raw results go to ``tests/bench/results``.
"""

import argparse
import csv
import platform
from collections.abc import Callable
from statistics import median
from typing import Any, Final

import numpy as np

from schemas.region import Rect
from tests.bench.light import CELL_M, RESULTS, SUNS, best_s, make_terrain
from tiler.effects.costs import COSTS
from tiler.light.frame import Earth, SunPosition, curvature_per_m, sine_cosine_deg
from tiler.light.horizons import HorizonSweep
from tiler.light.penumbra import PenumbraSweep
from tiler.light.shading import add_sky, shade_window, share_of_disc
from tiler.light.shadow import ShadowSweep
from tiler.light.sweeping import Float32
from tiler.light.turning import turned
from tiler.light.visibility import sun_slopes
from tiler.samples.transfer import encode_srgb, light_of_codes

NEAR_STEPS: Final = 16
BAND: Final = 512
"""Rows that are swept at once."""


class Works:
    """The kernels of light over one terrain, as ``tiler.light.visibility`` and ``tiler.light.lightsource`` call them."""

    def __init__(self, heights: Float32) -> None:
        self.heights = heights
        self.shape = (heights.shape[0], heights.shape[1])
        self._around = np.pad(heights, 1, constant_values=np.float32(np.nan))
        self._cells = np.ascontiguousarray(np.repeat(np.array(CELL_M)[:, np.newaxis], self.shape[0], axis=1))
        self._shares = np.full(self.shape, 40000, np.uint16)
        self._light = np.empty(self.shape, np.float32)

    def shadow(self, sun: tuple[float, float], earth: Earth | None) -> None:
        """Sweep the shadows of a point, the grid's turn included."""
        sweep = ShadowSweep(self.shape, CELL_M, SunPosition(*sun), earth)
        rows = turned(self.heights, sweep.frame.turns)
        for start in range(0, len(rows), BAND):
            turned(sweep.push(rows[start : start + BAND]), -sweep.frame.turns)

    def horizon(self, azimuth: float, earth: Earth | None) -> Float32:
        """Find horizons, the grid's turn included."""
        return self._swept(HorizonSweep(self.shape, CELL_M, azimuth, earth, near_steps=NEAR_STEPS))

    def _swept(self, sweep: HorizonSweep | PenumbraSweep) -> Float32:
        rows = turned(self.heights, sweep.frame.turns)
        tangents = np.concatenate([sweep.push(rows[start : start + BAND]) for start in range(0, len(rows), BAND)])
        return turned(tangents, -sweep.frame.turns)

    def disc(self, sun: tuple[float, float], earth: Earth | None) -> None:
        """Find how much of the sun's disc is seen."""
        bounds = float(self.heights.min()), float(self.heights.max())
        tangents = self._swept(PenumbraSweep(self.shape, CELL_M, SunPosition(*sun), 0.2666, earth, range_m=bounds))
        slopes = sun_slopes(self.shape, CELL_M, SunPosition(*sun), earth, Rect(0, 0, self.shape[1], self.shape[0]))
        share_of_disc(tangents, self.heights, slopes, curvature_per_m(earth), 0.2666, self._shares)

    def sky(self, azimuth: float, earth: Earth | None) -> None:
        """Find what is seen of the sky in one azimuth."""
        tangents = np.fmax(self.horizon(azimuth, earth), np.float32(0))
        add_sky(self._around, self._cells, tangents, *sine_cosine_deg(azimuth), np.zeros(self.shape, np.uint32))

    def shading(self, sun: tuple[float, float], has_sky: bool, bounced: float) -> None:
        """Make light of shares."""
        slopes = sun_slopes(self.shape, CELL_M, SunPosition(*sun), None, Rect(0, 0, self.shape[1], self.shape[0]))
        sky = self._shares if has_sky else self._shares[:, :0]
        east, north = sine_cosine_deg(sun[0])
        shade_window(self._around, self._cells, east, north, slopes, self._shares, sky, 0.15, bounced, self._light)

    def transfer(self) -> None:
        """Decode codes of one channel, and encode a quarter as many again, which is what a level of imagery takes."""
        codes = self._shares.astype(np.uint8)
        light = light_of_codes(255)[codes]
        encode_srgb(light[::2, ::2], 255)


def middle_ns(works: list[Callable[[], object]], samples: int, runs: int) -> float:
    """Return the median of the best times of ``works`` [ns per sample]."""
    return median(best_s(runs, work) for work in works) / samples * 1e9


def measure(side: int, runs: int) -> list[dict[str, Any]]:
    """Return time per sample of every kernel with and without every effect [ns]."""
    works, samples, earth = Works(make_terrain(side)), side * side, Earth()

    def timed(work: Callable[..., object], *arguments: Any) -> float:
        return middle_ns([lambda sun=sun: work(sun, *arguments) for sun in SUNS], samples, runs)  # type: ignore[misc]

    def timed_azimuths(work: Callable[..., object], *arguments: Any) -> float:
        return middle_ns([lambda a=sun[0]: work(a, *arguments) for sun in SUNS], samples, runs)  # type: ignore[misc]

    hard, bent_hard = (timed(works.shadow, globe) for globe in (None, earth))
    soft, sky, bent_sky = timed(works.disc, None), timed_azimuths(works.sky, None), timed_azimuths(works.sky, earth)
    bare, lit = timed(works.shading, False, 0.0), timed(works.shading, True, 0.0)
    transfer = middle_ns([works.transfer], samples, runs)
    found = [
        ("shadow", hard, 0.0, "line sweep, one line per sample, with the grid's turns"),
        ("penumbra", soft - hard, 0.0, "horizons that cut the disc, and what is above them, less shadow"),
        ("sky", lit - bare, sky, "horizon and its share of the sky; its light"),
        ("curvature_shadow", bent_hard - hard, 0.0, "sweep over curved ground, less that over flat ground"),
        ("curvature_sky", 0.0, bent_sky - sky, "horizons over curved ground, less those over flat ground"),
        ("bounce", bare, 0.0, "light once more, for its mean"),
        ("linear_filter", transfer, 0.0, "decoding one sample, encoding a quarter"),
    ]
    return [{"effect": effect, "ns": max(0.0, ns), "ns_per_azimuth": max(0.0, more), "of": what} for effect, ns, more, what in found]


def main() -> None:
    """Measure, print the lines of the table, and keep the raw results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=4096)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    rows = measure(given.size, given.runs)
    for row in rows:
        known = COSTS[row["effect"]]
        table = f"table: {known.ns:g} + {known.ns_per_azimuth:g}"
        print(f"{row['effect']:18} {row['ns']:7.2f} ns + {row['ns_per_azimuth']:6.2f} per azimuth; {table}; {row['of']}")  # noqa: T201
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "effects.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0], "side", "machine"])
        writer.writeheader()
        writer.writerows({**row, "side": given.size, "machine": platform.processor() or platform.machine()} for row in rows)


if __name__ == "__main__":
    main()
