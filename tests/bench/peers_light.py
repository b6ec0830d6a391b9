"""Shadows, horizons and shading of the same crop by clipmap, GRASS, SAGA and GDAL: what each costs, and how far it is from the truth.

    python tests/bench/peers_light.py [HEIGHTS --scale 0.1 --spacing 160] [--runs 3]
    python tests/bench/peers_light.py --bake shadow IN.tif OUT.tif       # one program of the comparison: ours

The crops are the middle 256 x 256 samples, and 1024 x 1024 for all but r.sunmask, which reads its map anew for every step of every ray;
besides, for times that the start of a program does not hide, the latter mirrored to 4096 x 4096.
HEIGHTS is any file that rasterio reads; without it, Puget Sound where CLIPMAP_TEST_DATA names the folder of real inputs, or else a
terrain made here. Truth is a walk along every ray in float64, see
``tiler/accuracy/lightwalk.py``; samples within 16 of the border are not compared. Times are user and system time of the program that does
the work, files included; ``ns_per_sample`` is without what it takes for 32 x 32 samples, its start. For clipmap, also the kernel alone.
Programs that are not installed are named and left out.
Debian: ``apt-get install grass-core saga gdal-bin``. Results go to ``tests/bench/results/peers-light.json`` and ``.csv``.
"""

import argparse
import csv
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from tests.bench.light import best_s
from tests.bench.peers_measure import machine
from tiler.accuracy.lightground import Ground, inner
from tiler.accuracy.lightwalk import walked_horizons, walked_lit
from tiler.accuracy.sample import built_in
from tiler.light.certified import certified_shadow
from tiler.light.frame import SunPosition, sine_cosine_deg
from tiler.light.horizons import horizon_tangents
from tiler.light.shadow import cast_shadow

RESULTS: Final = Path(__file__).parent / "results" / "peers-light.json"
SUN: Final = SunPosition(290.0, 10.0)
MARGINS: Final = (16, 16)
START_SIDE: Final = 32
CROPS: Final = (256, 1024)
MIRRORED_SIDE: Final = 4096
TELLING: Final = 0.2
"""Share of its start by which a program must take longer before its time per sample is given."""
GRASS: Final = "grass --tmp-location {source} --exec bash {script}"
IN_GRASS: Final = """set -e
r.in.gdal -o --quiet input={source} output=z
g.region raster=z
TIMEFORMAT='cpu %U %S'
time {command}
r.out.gdal -f --quiet --overwrite input={result} output={output} type=Float64 createopt=COMPRESS=NONE
"""

Grid = NDArray[np.float64]
Row = dict[str, Any]

KERNELS: Final[dict[str, Callable[[Ground], NDArray[Any]]]] = {
    "shadow": lambda ground: cast_shadow(ground.heights_m, ground.cell_m, SUN),
    "shadow4": lambda ground: cast_shadow(ground.heights_m, ground.cell_m, SUN, lines=4),
    "certified": lambda ground: certified_shadow(ground.heights_m, ground.cell_m, SUN),
    "horizon": lambda ground: horizon_tangents(ground.heights_m, ground.cell_m, SUN.azimuth_deg),
}


@dataclass(frozen=True, slots=True)
class Peer:
    """A program: what it finds, its command with ``{source}`` and ``{output}``, and how its output is to be read.

    ``grass`` commands run within a session of GRASS, ``result`` is the name of their map there; ``kernel`` is ours.
    """

    name: str
    finds: str
    command: str
    read: Callable[[Grid], Grid]
    result: str = ""
    kernel: str = ""
    largest: int = 1 << 30
    suffix: str = ".tif"


def ours(name: str, kernel: str, finds: str, read: Callable[[Grid], Grid]) -> Peer:
    """Return one of our kernels as a program."""
    return Peer(name, finds, f"{sys.executable} {__file__} --bake {kernel} {{source}} {{output}}", read, kernel=kernel)


def saga(name: str, shadow: int) -> Peer:
    """Return SAGA's shadows, ``shadow`` 0 for slim and 1 for fat; shaded samples are those with a quarter turn or more."""
    command = "saga_cmd -f=s ta_lighting 0 -ELEVATION {source} -SHADE {output} -METHOD 3 -POSITION 0 "
    command += f"-AZIMUTH {SUN.azimuth_deg:g} -DECLINATION {SUN.elevation_deg:g} -SHADOW {shadow}"
    return Peer(name, "shadow", command, lambda found: (found < np.pi / 2 - 1e-4).astype(float), suffix=".sgrd")


def peers() -> list[Peer]:
    """Return all programs, those that find the same beside each other."""
    grass_azimuth = (90 - SUN.azimuth_deg) % 360
    sun = f"altitude={SUN.elevation_deg:g} azimuth={SUN.azimuth_deg:g}"
    return [
        ours("clipmap, 1 line", "shadow", "shadow", lambda found: (found == 1).astype(float)),
        ours("clipmap, 4 lines", "shadow4", "shadow", lambda found: (found == 1).astype(float)),
        ours("clipmap, certified", "certified", "shadow", lambda found: (found == 1).astype(float)),
        saga("SAGA ta_lighting, slim", 0),
        saga("SAGA ta_lighting, fat", 1),
        Peer(
            "GRASS r.sunmask",
            "shadow",
            f"r.sunmask -z --quiet elevation=z output=m {sun}",
            lambda found: (found != 1).astype(float),
            result="m",
            largest=256,
        ),
        ours("clipmap, 16 exact steps", "horizon", "horizon", lambda found: np.degrees(np.arctan(found))),
        Peer(
            "GRASS r.horizon",
            "horizon",
            f"r.horizon -d --quiet elevation=z direction={grass_azimuth:g} output=h",
            lambda found: found,
            result=f"h_{grass_azimuth:03.0f}",
        ),
        Peer(
            "gdaldem hillshade",
            "shade",
            f"gdaldem hillshade -q -az {SUN.azimuth_deg:g} -alt {SUN.elevation_deg:g} {{source}} {{output}}",
            lambda found: found,
        ),
    ]


def write_heights(path: Path, ground: Ground) -> None:
    """Write heights as a GeoTIFF somewhere in UTM zone 10."""
    height, width = ground.heights_m.shape
    place = rasterio.Affine(ground.cell_m[0], 0, 500_000, 0, -ground.cell_m[1], 5_300_000)
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "float32", "crs": "EPSG:32610"}
    with rasterio.open(path, "w", transform=place, **profile) as file:
        file.write(ground.heights_m, 1)


def read_heights(path: Path) -> Ground:
    """Return what ``write_heights`` wrote."""
    with rasterio.open(path) as file:
        return Ground(file.read(1), (file.transform.a, -file.transform.e))


def bake(kernel: str, source: Path, target: Path) -> None:
    """Read heights, run one of our kernels and write what it gives, as a program of the comparison does."""
    found = KERNELS[kernel](read_heights(source))
    profile = {"driver": "GTiff", "width": found.shape[1], "height": found.shape[0], "count": 1, "dtype": found.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(target, "w", **profile) as file:
            file.write(found, 1)


def run_peer(peer: Peer, source: Path, folder: Path) -> tuple[Row, Grid]:
    """Run a program once; return its processor and wall time [s], and what it found."""
    output = folder / f"out{peer.suffix}"
    command, script = peer.command.format(source=source, output=output), folder / "script.sh"
    if peer.result:
        script.write_text(IN_GRASS.format(source=source, command=command, result=peer.result, output=output))
        command = GRASS.format(source=source, script=script)
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    done = subprocess.run(command.split(), capture_output=True, text=True, check=False)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter() - started
    if done.returncode:
        raise SystemExit(f"{peer.name}: exit status {done.returncode}: {done.stderr[-500:]}")
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    if peer.result:
        cpu = sum(float(part) for part in done.stderr.rsplit("cpu ", 1)[1].split()[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(output.with_suffix(".sdat") if peer.suffix == ".sgrd" else output) as file:
            found = peer.read(file.read(1).astype(np.float64))
    return {"cpu_s": cpu, "wall_s": wall}, found


def truths(ground: Ground) -> dict[str, Grid]:
    """Return what is right for each thing that is found; shading by GDAL's formula and normals (Horn), but with cast shadows."""
    lit = walked_lit(ground, SUN).astype(float)
    horizons = np.degrees(np.arctan(walked_horizons(ground, SUN.azimuth_deg)))
    z = np.pad(ground.heights_m.astype(float), 1, mode="edge")
    east = (z[:-2, 2:] + 2 * z[1:-1, 2:] + z[2:, 2:] - z[:-2, :-2] - 2 * z[1:-1, :-2] - z[2:, :-2]) / (8 * ground.cell_m[0])
    north = (z[:-2, :-2] + 2 * z[:-2, 1:-1] + z[:-2, 2:] - z[2:, :-2] - 2 * z[2:, 1:-1] - z[2:, 2:]) / (8 * ground.cell_m[1])
    (sine, cosine), (up, level) = sine_cosine_deg(SUN.azimuth_deg), sine_cosine_deg(SUN.elevation_deg)
    lambert = (up - level * (east * sine + north * cosine)) / np.sqrt(1 + east**2 + north**2)
    return {"shadow": lit, "horizon": horizons, "shade": 1 + 254 * np.maximum(lambert, 0) * lit}


def errors(peer: Peer, found: Grid, expected: Grid) -> Row:
    """Return wrong samples [%] of shadows, otherwise the root of the mean square, the 99th percentile and the largest error."""
    error = np.abs(inner(found, MARGINS) - inner(expected, MARGINS)).astype(np.float64)
    if peer.finds == "shadow":
        return {"wrong_percent": 100 * float(error.mean())}
    figures = np.sqrt(np.mean(error**2)), np.percentile(error, 99), error.max()
    unit = "deg" if peer.finds == "horizon" else "codes"
    return {f"{name}_{unit}": float(figure) for name, figure in zip(("rms", "p99", "largest"), figures, strict=True)}


def measure_side(ground: Ground, runs: int) -> list[Row]:
    """Return a row per program for one crop, the least of its times."""
    side, expected, rows = ground.heights_m.shape[0], truths(ground), list[Row]()
    with tempfile.TemporaryDirectory(prefix="clipmap-light-") as place:
        source, small = Path(place) / "heights.tif", Path(place) / "small.tif"
        write_heights(source, ground)
        write_heights(small, middle(ground, START_SIDE))
        for peer in peers():
            program = "grass" if peer.result else peer.command.split()[0]
            if shutil.which(program) is None:
                sys.stderr.write(f"{peer.name}: {program} is not installed: left out\n")
            elif side <= peer.largest:
                starts, _ = zip(*(run_peer(peer, small, Path(place)) for _ in range(runs)), strict=True)
                costs, found = zip(*(run_peer(peer, source, Path(place)) for _ in range(runs)), strict=True)
                least, start_s = min(costs, key=lambda cost: float(cost["cpu_s"])), min(float(cost["cpu_s"]) for cost in starts)
                row: Row = {"finds": peer.finds, "program": peer.name, "side": side, "runs": runs, "start_s": start_s} | least
                if least["cpu_s"] > (1 + TELLING) * start_s:
                    row["ns_per_sample"] = 1e9 * (least["cpu_s"] - start_s) / (side**2 - START_SIDE**2)
                if peer.kernel:
                    kernel_s = best_s(max(5, runs), lambda kernel=peer.kernel: KERNELS[kernel](ground))  # type: ignore[misc]
                    row["kernel_ns_per_sample"] = 1e9 * kernel_s / side**2
                rows.append(row | errors(peer, found[-1], expected[peer.finds]))
                sys.stderr.write(f"{rows[-1]}\n")
    return rows


def middle(ground: Ground, side: int) -> Ground:
    """Return the middle ``side`` x ``side`` samples."""
    top, left = ((length - side) // 2 for length in ground.heights_m.shape)
    return Ground(np.ascontiguousarray(ground.heights_m[top : top + side, left : left + side]), ground.cell_m)


def load(path: Path | None, scale: float, spacing: float) -> tuple[str, Ground]:
    """Return the name of the heights and the heights; without a path those of Puget Sound if they are here."""
    if path is None and "CLIPMAP_TEST_DATA" in os.environ:
        path, scale, spacing = Path(os.environ["CLIPMAP_TEST_DATA"]) / "puget" / "ps_height_1k.png", 0.1, 160.0
    if path is None:
        return "built-in terrain", Ground(np.ascontiguousarray(built_in(1024).values[..., 0]), (90.0, 90.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            return path.name, Ground(file.read(1).astype(np.float32) * np.float32(scale), (spacing, spacing))


def versions() -> dict[str, str]:
    """Return what the programs call themselves, those that are installed."""
    asked = {"GRASS": "grass --version", "SAGA": "saga_cmd --version", "GDAL": "gdaldem --version"}
    present = {name: command.split() for name, command in asked.items() if shutil.which(command.split()[0])}
    answers = {name: subprocess.run(line, capture_output=True, text=True, check=False) for name, line in present.items()}
    return {name: (answer.stdout or answer.stderr).strip().splitlines()[0] for name, answer in answers.items()}


def save(result: Row) -> None:
    """Write all figures as JSON and a line per program as CSV."""
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    rows: Sequence[Row] = result["rows"]
    names = list(dict.fromkeys(name for row in rows for name in row))
    with RESULTS.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def compare(path: Path | None, scale: float, spacing: float, runs: int) -> None:
    """Measure all programs on all crops and keep the results."""
    name, ground = load(path, scale, spacing)
    crops = [middle(ground, side) for side in CROPS]
    beyond = MIRRORED_SIDE - CROPS[-1]
    crops.append(Ground(np.pad(crops[-1].heights_m, ((0, beyond), (0, beyond)), mode="reflect"), ground.cell_m))
    rows = [row for crop in crops for row in measure_side(crop, runs if crop is not crops[-1] else 1)]
    about = {"heights": name, "cell_m": ground.cell_m, "azimuth": SUN.azimuth_deg, "elevation": SUN.elevation_deg}
    save(about | {"machine": machine(), "versions": versions(), "rows": rows})


def main() -> None:
    """Measure all programs, or be one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("heights", type=Path, nargs="?", help="any file that rasterio reads; default: Puget Sound, or a terrain made here")
    parser.add_argument("--scale", type=float, default=1.0, help="metres per unit of HEIGHTS")
    parser.add_argument("--spacing", type=float, default=90.0, help="distance between its samples [m]")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--bake", nargs=3, metavar=("KERNEL", "IN", "OUT"), help="be one of the programs")
    options = parser.parse_args()
    if options.bake:
        bake(options.bake[0], Path(options.bake[1]), Path(options.bake[2]))
        return
    compare(options.heights, options.scale, options.spacing, options.runs)


if __name__ == "__main__":
    main()
