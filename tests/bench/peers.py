"""Builds the same pyramids with clipmap and with other programs, in turn, and says what each costs.

    python tests/bench/peers.py [--size 8192] [--runs 5] [--only 'jpeg.*(clipmap|vips)'] [--merge]
    python tests/bench/peers.py --report

Sources are made here: the picture of ``stages.py``, and heights of a known spectrum. A round runs every program of a case once,
A B C A B C; the first round warms caches (kernels, pages) and is not counted. Programs that are not installed are named and left out.
Results go to ``tests/bench/results/peers-SIZE.csv`` and ``.json``; then, or with ``--report`` alone, the tables and the picture of
``docs/PERFORMANCE.md`` are written from all results. Debian: ``apt-get install libvips-tools gdal-bin python3-gdal openimageio-tools``.
"""

import argparse
import csv
import json
import os
import re
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from tests.bench.peers_cost import run_command
from tests.bench.peers_limits import limits
from tests.bench.peers_programs import Program, Source, programs, versions
from tests.bench.peers_report import write_report
from tests.bench.stages import PERIOD, RESULTS, machine, natural_picture, write_source

STAGES: Final = ("read", "filter", "encode", "write")


def terrain(side: int, seed: int = 2) -> NDArray[np.float32]:
    """Return heights (side, side) in metres, float32, without a seam; amplitudes fall as 1/f^2, deviation 400 m."""
    random = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = np.inf
    heights = np.fft.irfft2(np.fft.rfft2(random.standard_normal((side, side))) / frequency**2, s=(side, side))
    return np.asarray(1000 + heights * (400 / heights.std()), np.float32)


def write_heights(path: Path, side: int) -> None:
    """Write a georeferenced float32 TIFF of ``side`` by ``side`` heights in 512 x 512 tiles."""
    period = min(PERIOD, side)
    heights = terrain(period)
    profile = {"driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "float32"}
    tiles = {"tiled": True, "blockxsize": 512, "blockysize": 512}
    with rasterio.open(path, "w", crs="EPSG:32633", transform=Affine(1, 0, 500000, 0, -1, 5000000), **profile, **tiles) as file:
        for row in range(0, side, period):
            for column in range(0, side, period):
                part = heights[: min(period, side - row), : min(period, side - column)]
                file.write(part, 1, window=rasterio.windows.Window(column, row, part.shape[1], part.shape[0]))


def run_once(program: Program, source: Path, folder: Path) -> dict[str, Any]:
    """Run a program into a fresh folder, which is removed, and return its cost, with the stages where it is clipmap."""
    output = folder / "output"
    output.mkdir()
    (output / "link.tif").symlink_to(source)
    try:
        cost, printed = run_command(program.line(source, output), output)
    finally:
        shutil.rmtree(output)
    row: dict[str, Any] = asdict(cost)
    if printed.startswith("{"):
        report = json.loads(printed)
        row["build_s"] = report["wall_s"]
        row |= {f"{stage}_s_per_megasample": report["thread_seconds_per_megasample"][stage] for stage in STAGES}
    return row


def measure(size: int, runs: int, only: str) -> dict[str, Any]:
    """Make the sources, run every program in turn and return all figures."""
    result: dict[str, Any] = {"size": size, "machine": machine(), "versions": versions(), "load": [os.getloadavg()[0]], "rows": []}
    with tempfile.TemporaryDirectory(prefix="clipmap-peers-") as name:
        folder = Path(name)
        paths: dict[Source, Path] = {"rgb": folder / "rgb.tif", "height": folder / "height.tif"}
        write_source(paths["rgb"], size)
        write_heights(paths["height"], size)
        for kind, several in programs(size).items():
            chosen = [program for program in several if re.search(only, f"{program.case}: {program.name}", re.IGNORECASE)]
            for missing in sorted({program.command[0] for program in chosen if not program.installed}):
                sys.stderr.write(f"{missing} is not installed: left out\n")
            run_case([program for program in chosen if program.installed], paths[kind], folder, runs, result)
        result["limits"] = limits(folder, natural_picture(1024), terrain(1024)[..., np.newaxis], paths["rgb"])
    return result


def run_case(chosen: list[Program], source: Path, folder: Path, runs: int, result: dict[str, Any]) -> None:
    """Add the runs of all programs that take the same source to ``result``, case by case, so that a round is short."""
    for case in dict.fromkeys(program.case for program in chosen):
        of_case = [program for program in chosen if program.case == case]
        for number in range(-1, runs):
            for program in of_case:
                if number >= (program.runs or runs):
                    continue
                cost = run_once(program, source, folder)
                if number < 0:
                    continue
                same = {"case": case, "program": program.name, "filter": program.filter, "remark": program.remark, "run": number}
                result["rows"].append(same | cost)
                sys.stderr.write(f"{case}: {program.name}: {cost['wall_s']:.2f} s\n")
            result["load"].append(os.getloadavg()[0])


def save(result: dict[str, Any], merge: bool) -> None:
    """Write all figures as JSON and a line per run as CSV; ``merge`` keeps the cases in the old files that were not measured now."""
    RESULTS.mkdir(exist_ok=True)
    stem = RESULTS / f"peers-{result['size']}"
    if merge and stem.with_suffix(".json").exists():
        measured = {row["case"] for row in result["rows"]}
        old = json.loads(stem.with_suffix(".json").read_text())
        result["rows"] = [row for row in old["rows"] if row["case"] not in measured] + result["rows"]
        result["load"] = old["load"] + result["load"]
    order = [program.case for several in programs(result["size"]).values() for program in several]
    result["rows"].sort(key=lambda row: order.index(row["case"]))
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    names = list(dict.fromkeys(name for row in result["rows"] for name in row))
    with open(stem.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(result["rows"])


def main() -> None:
    """Read the options, measure, save, and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=8192, help="side of the sources [samples]")
    parser.add_argument("--runs", type=int, default=5, help="counted rounds; slow programs take part in fewer")
    parser.add_argument("--only", default="", help="measure only what this regular expression finds in 'case: program'")
    parser.add_argument("--merge", action="store_true", help="keep the cases of an earlier measurement that are not measured now")
    parser.add_argument("--report", action="store_true", help="measure nothing, write docs/PERFORMANCE.md from the results")
    options = parser.parse_args()
    if not options.report:
        save(measure(options.size, options.runs, options.only), options.merge)
    write_report(RESULTS)


if __name__ == "__main__":
    main()
