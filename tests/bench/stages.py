"""Times a build of imagery by stage, and the whole command against ``vips dzsave`` where that is installed.

    python tests/bench/stages.py [--size 8192] [--runs 3] [--codec jpeg:85] [--workers N]

A quick look at one kind of build; ``peers.py`` measures everything. The source is the picture of ``inputs.py``.
Each build runs in a process of its own: once to compile the kernels (not counted), then ``--runs`` times. Stages are seconds of
each worker's clock, so with two workers they may add up to twice the wall time. libvips does less: it averages 2 x 2 pixels, where
clipmap filters with 12 x 12 taps, and does not wait for the disk. Raw results go to ``tests/bench/results``.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from statistics import median
from time import perf_counter, sleep
from typing import Any, Final

from schemas.settings import BuildSettings
from tests.bench.inputs import Source, write_source
from tests.bench.peers_measure import machine
from tiler.building.build import build_layer

RESULTS: Final = Path(__file__).parent / "results"
STAGES: Final = ("read_s", "filter_s", "encode_s", "write_s")


def peak_rss_bytes(process: int) -> int:
    """Return the largest resident size of a process so far, 0 once it has ended.

    ``ru_maxrss`` would not do: a child inherits the peak of the process that started it, here that of the source's making.
    """
    status = Path(f"/proc/{process}/status").read_text()
    return next((1024 * int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")), 0)


def build_once(source: Path, output: Path, codec: str, workers: int | None) -> dict[str, float]:
    """Build in this process and return what it cost."""
    report = build_layer(source, output, BuildSettings(layer="imagery", codec=codec, workers=workers))
    return {
        "build_s": report.wall_s,
        **asdict(report.times),
        "megasamples": report.megasamples,
        "stored_bytes": sum(level.stored_bytes for level in report.manifest.layers[report.layer].levels),
    }


def timed(command: list[str]) -> tuple[dict[str, float], str]:
    """Run ``command``, which prints little; returns its wall and processor seconds and peak resident size, and what it printed."""
    started, peak = perf_counter(), 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"VIPS_WARNING": "0"}) as process:
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            peak = max(peak, peak_rss_bytes(process.pid))
            sleep(0.005)
        wall_s = perf_counter() - started
        _, status, usage = ended
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.stdout is not None
        printed = process.stdout.read()
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit status {process.returncode}")
    return {"command_s": wall_s, "cpu_s": usage.ru_utime + usage.ru_stime, "peak_rss_bytes": peak}, printed


def run_clipmap(source: Path, folder: Path, codec: str, workers: int | None) -> dict[str, float]:
    """Build in a new process and return what it cost, start of Python included in ``command_s``."""
    output = Path(tempfile.mkdtemp(dir=folder)) / "dataset"
    options = ["--workers", str(workers)] if workers else []
    cost, printed = timed([sys.executable, __file__, "--build", str(source), str(output), "--codec", codec, *options])
    report: dict[str, float] = json.loads(printed)
    return cost | report


def run_vips(source: Path, folder: Path, quality: str) -> dict[str, float]:
    """Cut the same levels with libvips and return what it cost."""
    output = Path(tempfile.mkdtemp(dir=folder)) / "vips"
    layout = ["--tile-size", "256", "--overlap", "0", "--depth", "onetile"]
    cost, _ = timed(["vips", "dzsave", str(source), str(output), "--suffix", f".jpg[Q={quality}]", *layout])
    return cost


def measure(size: int, runs: int, codec: str, workers: int | None) -> dict[str, Any]:
    """Make the source, run every program ``runs`` times, in turn, and return all figures."""
    has_vips = shutil.which("vips") is not None and codec.startswith("jpeg")
    result: dict[str, Any] = {"size": size, "codec": codec, "workers": workers, "machine": machine(), "clipmap": [], "vips": []}
    with tempfile.TemporaryDirectory(prefix="clipmap-bench-") as name:
        folder = Path(name)
        source = folder / "source.tif"
        write_source(source, Source("rgb", size))
        run_clipmap(source, folder, codec, workers)
        for _ in range(runs):
            result["clipmap"].append(run_clipmap(source, folder, codec, workers))
            if has_vips:
                result["vips"].append(run_vips(source, folder, codec.partition(":")[2] or "85"))
    return result


def summary(result: dict[str, Any]) -> str:
    """Return the medians for people."""
    runs = result["clipmap"]
    million = runs[0]["megasamples"]
    processors = result["machine"]["processors"]
    lines = [f"{result['size']} x {result['size']} RGB to {result['codec']}, median of {len(runs)} runs, {processors} processors"]
    lines += [
        f"  {stage.removesuffix('_s'):<8} {1000 * median(run[stage] for run in runs) / million:8.2f} ms per megasample, workers added up"
        for stage in STAGES
    ]
    command_s = median(run["command_s"] for run in runs)
    lines.append(f"  {'build':<8} {median(run['build_s'] for run in runs):8.2f} s wall, {command_s:.2f} s with the start of Python")
    lines.append(f"  {'memory':<8} {max(run['peak_rss_bytes'] for run in runs) / 2**20:8.0f} MiB at most")
    if result["vips"]:
        vips_s = median(run["command_s"] for run in result["vips"])
        peak = max(run["peak_rss_bytes"] for run in result["vips"]) / 2**20
        lines.append(f"  {'vips':<8} {vips_s:8.2f} s wall, {peak:.0f} MiB: clipmap takes {command_s / vips_s:.2f} times as long")
    return "\n".join(lines)


def save(result: dict[str, Any]) -> Path:
    """Write all figures as JSON, and one line per run as CSV; return the JSON file."""
    RESULTS.mkdir(exist_ok=True)
    stem = RESULTS / f"stages-{result['size']}-{result['codec'].replace(':', '')}"
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    rows = [{"program": program, "run": number, **run} for program in ("clipmap", "vips") for number, run in enumerate(result[program])]
    with open(stem.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return stem.with_suffix(".json")


def main() -> None:
    """Read the options, measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=8192, help="side of the source [pixels]")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--codec", default="jpeg:85")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--build", nargs=2, type=Path, metavar=("SOURCE", "OUTPUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.build:
        sys.stdout.write(json.dumps(build_once(options.build[0], options.build[1], options.codec, options.workers)))
        return
    result = measure(options.size, options.runs, options.codec, options.workers)
    sys.stdout.write(f"{summary(result)}\nraw results: {save(result)}\n")


if __name__ == "__main__":
    main()
