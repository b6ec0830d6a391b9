"""Times `clipmap light` from the command to the last block, stage by stage, with the memory it takes, and prints a table.

    python tests/bench/light_stages.py [--size 16384] [--folder FOLDER] [--runs 1] [--only hard,soft]

The heights are those of `make bench`, floats that are 1 m apart, 1700 m over 16 km, built as raw blocks in a dataset below ``--folder``,
which has to be on a disk: a folder in memory counts as memory. Each way of lighting them is a process of its own, with the threads that
the machine has, and its layer stays until all are done. Times are the shortest of ``--runs``; processor time beside them tells how
much of a time was waiting for other programs. Raw results go to ``tests/bench/results/light-stages.csv``.
"""

import argparse
import csv
import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any, Final

RESULTS: Final = Path(__file__).parent / "results"
CELL_M: Final = 1.0
WAYS: Final[dict[str, list[str]]] = {
    "hard": [],
    "certified": ["--certified"],
    "soft": ["--soft"],
    "hard, sky 16": ["--sky", "16"],
    "hard, sky 16, bounce": ["--sky", "16", "--bounce"],
}
STAGES: Final = ("heights", "sun", "sky", "bounce", "blocks")
STAGE: Final = re.compile(r"(heights|sun|sky|bounce|blocks) ([\d.]+) s")
MEMORY: Final = re.compile(r"peak memory ([\d.]+) (MiB|GiB)")

Row = dict[str, Any]


def run(command: list[str]) -> tuple[str, float, float]:
    """Run a command; return what it printed, its time and its processor time [s]."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter()
    done = subprocess.run([str(Path(sys.executable).with_name("clipmap")), *command], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    seconds, after = perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return done.stdout, seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def make_dataset(folder: Path, size: int) -> Path:
    """Build the dataset of heights, unless a run before this one left it there."""
    dataset = folder / f"heights-{size}"
    if not (dataset / "manifest.json").exists():
        import OpenImageIO

        from tests.bench.inputs import terrain

        source = folder / f"heights-{size}.tif"
        output = OpenImageIO.ImageOutput.create(str(source))
        assert output is not None
        output.open(str(source), OpenImageIO.ImageSpec(size, size, 1, "float"))
        output.write_image(terrain(size))
        output.close()
        run(["build", str(source), "-o", str(dataset), "--layer", "height", "--codec", "raw", "--spacing", str(CELL_M)])
        source.unlink()
    return dataset


def light(dataset: Path, name: str, options: list[str], number: int) -> Row:
    """Light the heights one way and return the figures."""
    layer = f"{re.sub('[^a-z0-9]+', '_', name)}_{number}"
    printed, seconds, processor = run(["light", str(dataset), "--sun", "290,10", "--layer", layer, "--overwrite", *options])
    stages = {stage: float(value) for stage, value in STAGE.findall(printed)}
    memory = MEMORY.search(printed)
    peak = float(memory.group(1)) * (1024 if memory.group(2) == "GiB" else 1) if memory else float("nan")
    whole = {"all_s": seconds, "processor_s": processor, "peak_mib": peak}
    return {"way": name, **{stage: stages.get(stage, 0.0) for stage in STAGES}, **whole}


def table(rows: list[Row], size: int) -> str:
    """Return the figures as the table of docs/LIGHT.md."""
    lines = ["| | heights | sun | sky | bounce | blocks | in all | processor | peak memory |", "|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        stages = " | ".join(f"{row[stage]:.1f} s" if row[stage] else "" for stage in STAGES)
        whole = f"{row['all_s']:.0f} s | {row['processor_s']:.0f} s | {row['peak_mib'] / 1024:.2f} GiB"
        lines.append(f"| {size} x {size}, {row['way']} | {stages} | {whole} |")
    return "\n".join(lines)


def main() -> None:
    """Read the options, measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=16384, help="side of the map [samples]")
    parser.add_argument("--folder", type=Path, help="where the dataset is made, or was (default: a temporary folder, deleted at the end)")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--only", default=",".join(way.replace(", ", "+") for way in WAYS), help="ways, a comma between, + for a comma")
    options = parser.parse_args()
    wanted = [way.replace("+", ", ") for way in options.only.split(",")]
    with tempfile.TemporaryDirectory(prefix="light-stages-") as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        dataset = make_dataset(folder, options.size)
        rows = []
        for way in wanted:
            found = [light(dataset, way, WAYS[way], number) for number in range(options.runs)]
            rows.append(min(found, key=lambda row: float(row["all_s"])))
            sys.stdout.write(f"{table(rows[-1:], options.size).splitlines()[-1]}\n")
            sys.stdout.flush()
    RESULTS.mkdir(exist_ok=True)
    with open(RESULTS / "light-stages.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["size", "processors", "load", *rows[0]], lineterminator="\n")
        writer.writeheader()
        load = f"{os.getloadavg()[1]:.1f}"
        writer.writerows({"size": options.size, "processors": len(os.sched_getaffinity(0)), "load": load, **row} for row in rows)
    sys.stdout.write(f"\n{table(rows, options.size)}\n")


if __name__ == "__main__":
    main()
