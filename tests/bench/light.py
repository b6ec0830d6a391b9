"""Times cast shadows and horizons, and counts what is wrong, each against the exact march.

    python tests/bench/light.py [--size 4096] [--runs 5] [--crop 512]
    python tests/bench/light.py --heights DEM.tif --spacing 30

The terrain is made here: ridges, plains and a quarter of flat sea, 2500 m over 41 km. Times are those of one thread's processor clock,
the best of ``--runs``, without the turn of the grid: another program on the machine disturbs them only as it takes memory's time. What
is wrong with a sweep is counted over all samples against the certified one. That is compared with rays walked by NumPy, and hulls with
walked horizons, on a crop. Raw results go to ``tests/bench/results``. With ``--heights`` only what is wrong on the square middle of that
file is counted, up to 4096 samples wide, and printed; with ``--rough`` on a fractal.
"""

import argparse
import csv
import json
import math
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from time import thread_time
from typing import Any, Final

import numpy as np
import rasterio
from numpy.typing import NDArray

from tests.reference.shadows import horizon_tangents, shadow_margins
from tests.reference.terrain import power_law_field
from tiler.light.certified import CertifiedSweep, certified_shadow
from tiler.light.disc import disc_coverage
from tiler.light.frame import Earth, SunPosition
from tiler.light.horizons import HorizonSweep, angles_deg
from tiler.light.shadow import ShadowSweep, cast_shadow
from tiler.light.sweeping import LIT, Float32
from tiler.light.turning import turned

RESULTS: Final = Path(__file__).parent / "results"
CELL_M: Final = (10.0, 10.0)
SUNS: Final = ((300.0, 30.0), (290.0, 10.0), (247.0, 3.0))

Row = dict[str, Any]


def make_terrain(side: int) -> Float32:
    """Return heights (side, side) [m]: smooth ranges, their ridges sharp and rough, with the lowest quarter under a flat sea."""
    ranges = 1 / (1 + np.exp(-2 * power_law_field(side, side, 1, 5.0)))
    ridges = 1 / (1 + np.abs(power_law_field(side, side, 2, 4.2)))
    heights = ranges**2 * ridges
    heights -= np.quantile(heights, 0.25)
    return np.asarray(2500 * np.maximum(heights, 0) / heights.max(), np.float32)


def best_s(runs: int, work: Callable[[], object]) -> float:
    """Return the shortest processor time of ``runs`` calls, after one that is not counted."""
    work()
    times = []
    for _ in range(runs):
        started = thread_time()
        work()
        times.append(thread_time() - started)
    return min(times)


def row(method: str, sun: tuple[float, float], seconds: float, samples: int, **more: float) -> Row:
    """Return one line of the results."""
    return {"method": method, "azimuth": sun[0], "elevation": sun[1], "s": seconds, "msamples_per_s": samples / seconds / 1e6, **more}


def time_turns(heights: Float32, runs: int) -> list[Row]:
    """Time the quarter turn of heights and of codes, and NumPy's."""
    codes = (heights > 500).view(np.uint8)
    works: dict[str, Callable[[], NDArray[Any]]] = {
        "turn heights": lambda: turned(heights, 1),
        "turn codes": lambda: turned(codes, 1),
        "turn heights, NumPy": lambda: np.ascontiguousarray(np.rot90(heights)),
    }
    return [row(name, (90, 0), best_s(runs, work), heights.size) for name, work in works.items()]


def time_shadows(heights: Float32, sun: tuple[float, float], runs: int) -> list[Row]:
    """Time the sweeps with 1, 2, 4 and 8 lines, and the certified one, and count what the former have wrong."""
    shape = (heights.shape[0], heights.shape[1])
    position = SunPosition(*sun)
    certified = CertifiedSweep(shape, CELL_M, position)
    rows = turned(heights, certified.frame.turns)
    exact = certified.push(rows)
    results = []
    for lines in (1, 2, 4, 8):
        found = ShadowSweep(shape, CELL_M, position, lines=lines).push(rows)
        seconds = best_s(runs, lambda lines=lines: ShadowSweep(shape, CELL_M, position, lines=lines).push(rows))  # type: ignore[misc]
        results.append(row(f"sweep, {lines} lines", sun, seconds, rows.size, wrong_percent=100 * float((found != exact).mean())))
    seconds = best_s(runs, lambda: ShadowSweep(shape, CELL_M, position, Earth()).push(rows))
    results.append(row("sweep, 1 line, round Earth", sun, seconds, rows.size))
    seconds = best_s(runs, lambda: CertifiedSweep(shape, CELL_M, position).push(rows))
    marched = 100 * certified.marched / rows.size
    results.append(row("certified", sun, seconds, rows.size, marched_percent=marched, lit_percent=100 * float((exact == LIT).mean())))
    return results


def check_certified(heights: Float32, sun: tuple[float, float]) -> Row:
    """Count the samples of a crop on which the certified sweep and walked rays disagree, and by how much at most."""
    sweep = CertifiedSweep((heights.shape[0], heights.shape[1]), CELL_M, SunPosition(*sun))
    rows = turned(heights, sweep.frame.turns)
    started = thread_time()
    margins = shadow_margins(rows.astype(np.float64), (-1.0, sweep.frame.shift, sweep.frame.step_m), math.tan(math.radians(sun[1])))
    seconds = thread_time() - started
    wrong = (sweep.push(rows) == LIT) != (margins >= 0)
    return row("walked rays, NumPy, crop", sun, seconds, rows.size, wrong_samples=int(wrong.sum()))


def time_horizons(heights: Float32, crop: Float32, azimuth: float, runs: int) -> list[Row]:
    """Time horizons with 0, 4 and 16 exact steps, and give their errors on a crop."""
    sun = (azimuth, 10.0)
    shape, small = (heights.shape[0], heights.shape[1]), (crop.shape[0], crop.shape[1])
    frame = HorizonSweep(small, CELL_M, azimuth).frame
    rows, crop_rows = turned(heights, frame.turns), turned(crop, frame.turns)
    expected = np.degrees(np.arctan(horizon_tangents(crop_rows.astype(np.float64), (-1.0, frame.shift, frame.step_m))))
    results = []
    for steps in (0, 4, 16):

        def sweep(steps: int = steps) -> None:
            horizon = HorizonSweep(shape, CELL_M, azimuth, near_steps=steps)
            for start in range(0, rows.shape[0], 512):
                horizon.push(rows[start : start + 512])

        error = np.abs(angles_deg(HorizonSweep(small, CELL_M, azimuth, near_steps=steps).push(crop_rows)) - expected)[1:, 8:-8]
        rms, high = float(np.sqrt((error**2).mean())), float(np.quantile(error, 0.99))
        results.append(row(f"horizon, {steps} exact steps", sun, best_s(runs, sweep), rows.size, rms_deg=rms, p99_deg=high))
    tangents = HorizonSweep(small, CELL_M, azimuth).push(crop_rows)
    results.append(row("share of the disc, crop", sun, best_s(runs, lambda: disc_coverage(tangents, 10.0)), crop.size))
    return results


def measure(size: int, runs: int, crop: int) -> dict[str, Any]:
    """Make the terrain and return all figures."""
    heights = make_terrain(size)
    slopes = np.hypot(*np.gradient(heights[:2048, :2048], CELL_M[0]))
    part = np.ascontiguousarray(heights[size // 3 : size // 3 + crop, size // 3 : size // 3 + crop])
    rows = time_turns(heights, runs)
    for sun in SUNS:
        rows += [*time_shadows(heights, sun, runs), check_certified(part, sun)]
    for azimuth in (290.0, 17.0):
        rows += time_horizons(heights, part, azimuth, max(1, runs // 2))
    terrain = {"relief_m": float(heights.max()), "slope_p50": float(np.median(slopes)), "slope_p99": float(np.quantile(slopes, 0.99))}
    return {"size": size, "runs": runs, "crop": crop, "machine": platform.processor(), "terrain": terrain, "rows": rows}


def heights_of_file(path: Path) -> Float32:
    """Return the square middle of a file of heights, up to 4096 samples wide, with NaN for voids."""
    with rasterio.open(path) as file:
        side = min(file.width, file.height, 4096)
        window = rasterio.windows.Window((file.width - side) // 2, (file.height - side) // 2, side, side)
        heights = np.asarray(file.read(1, window=window), np.float32)
        if file.nodata is not None:
            heights[heights == np.float32(file.nodata)] = np.nan
    return heights


def count_wrong(heights: Float32, spacing_m: float) -> str:
    """Return what sweeps have wrong on heights whose samples are so far apart [m]."""
    slopes = np.hypot(*np.gradient(heights, spacing_m))
    steep = f"slopes p50 {np.nanmedian(slopes):.2f} p99 {np.nanquantile(slopes, 0.99):.2f}"
    lines = [f"{heights.shape[0]} x {heights.shape[1]} samples of {spacing_m:g} m, {steep}"]
    for azimuth, elevation in SUNS:
        sun, cell = SunPosition(azimuth, elevation), (spacing_m, spacing_m)
        exact = certified_shadow(heights, cell, sun)
        found = [100 * float((cast_shadow(heights, cell, sun, lines=count) != exact).mean()) for count in (1, 2, 4, 8)]
        shaded = 100 * float((exact != LIT).mean())
        wrong = ", ".join(f"{percent:.3g}" for percent in found)
        lines.append(f"  az {azimuth:g} el {elevation:g}: {shaded:.1f} % shaded; wrong with 1, 2, 4, 8 lines: {wrong} %")
    return "\n".join(lines)


def save(result: dict[str, Any]) -> Path:
    """Write all figures as JSON, and one line per method as CSV; return the JSON file."""
    RESULTS.mkdir(exist_ok=True)
    stem = RESULTS / f"light-{result['size']}"
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    fields = list(dict.fromkeys(field for line in result["rows"] for field in line))
    with open(stem.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows(result["rows"])
    return stem.with_suffix(".json")


def summary(result: dict[str, Any]) -> str:
    """Return the figures for people."""
    lines = [f"{result['size']} x {result['size']} samples of {CELL_M[0]:g} m, {result['terrain']}"]
    for line in result["rows"]:
        rest = ", ".join(f"{name} {value:.4g}" for name, value in line.items() if name not in ("method", "azimuth", "elevation", "s"))
        lines.append(f"  {line['method']:<28} az {line['azimuth']:5g} el {line['elevation']:4g} {1000 * line['s']:9.1f} ms  {rest}")
    return "\n".join(lines)


def main() -> None:
    """Read the options, measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=4096, help="side of the terrain [samples]")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--crop", type=int, default=512, help="side of what is compared with walked rays [samples]")
    parser.add_argument("--heights", type=Path, help="count on this file instead")
    parser.add_argument("--rough", action="store_true", help="count on a fractal that is rough at every scale instead")
    parser.add_argument("--spacing", type=float, default=CELL_M[0], help="distance between its samples [m]")
    options = parser.parse_args()
    if options.heights or options.rough:
        heights = heights_of_file(options.heights) if options.heights else np.asarray(60 * power_law_field(1024, 1024, 1, 2.6), np.float32)
        sys.stdout.write(f"{count_wrong(heights, options.spacing)}\n")
        return
    result = measure(options.size, options.runs, options.crop)
    sys.stdout.write(f"{summary(result)}\nraw results: {save(result)}\n")


if __name__ == "__main__":
    main()
