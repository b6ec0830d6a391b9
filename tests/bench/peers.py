"""Builds the same pyramids with clipmap and with other programs, in turn, and says what each costs.

    python tests/bench/peers.py                                  # everything: about half an hour on two processors
    python tests/bench/peers.py --only '^png: ' --merge          # one case anew, the others as they were
    python tests/bench/peers.py --only '^(limits|errors)' --merge
    python tests/bench/peers.py --size 2048 --runs 2 --scratch   # a trial: no results, no report
    python tests/bench/peers.py --report                         # only write docs/PERFORMANCE.md

Cases are jpeg, jpeg-small, heights, png, workers, layouts and growth; besides, errors (of the coarse levels), limits (of the machine) and
light (shadows and horizons: ``peers_light.py``).
Sources are made here. A round runs every program of a case once, A B C A B C, after one round on small sources that is not counted.
Every output is kept until the end, see ``peers_room.py``: with the default size that takes some 40 GB. Programs that are not installed are
named and left out. Results go to ``tests/bench/results/peers.json``, ``peers.csv`` and ``peers-errors.csv``; then the generated parts
and the pictures of ``docs/PERFORMANCE.md`` are written. Debian: ``apt-get install libvips-tools gdal-bin python3-gdal openimageio-tools``.
"""

import argparse
import csv
import json
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from tests.bench.peers_cost import CommandError
from tests.bench.peers_errors import check_box, measure_errors
from tests.bench.peers_light import compare
from tests.bench.peers_limits import limits
from tests.bench.peers_measure import run_case
from tests.bench.peers_programs import cases, versions
from tests.bench.peers_report import RAW, write_report
from tests.bench.peers_room import Room
from tests.bench.peers_tables import Result
from tests.bench.peers_targets import targets

MOST_ERROR_SIDE: Final = 4096
"""Side of the sources whose coarse levels are compared: the references are float64 and slow."""


def measure(size: int, runs: int, only: str, place: Path, keep: Callable[[Result], None]) -> Result:
    """Make the sources, measure what ``only`` finds, and return all figures; ``keep`` is given what there is after every part."""
    result: Result = {"size": size, "versions": versions(), "cases": {}}
    with Room(place) as room:
        for case in cases(size):
            chosen = [program for program in case.programs if re.search(only, f"{case.key}: {program.name}")]
            for missing in sorted({program.command[0] for program in chosen if not program.installed}):
                sys.stderr.write(f"{case.key}: {missing} is not installed: left out\n")
            present = [program for program in chosen if program.installed]
            if present:
                result["cases"][case.key] = run_case(case, present, runs, room)
                keep(result)
        if re.search(only, "errors: "):
            side = min(MOST_ERROR_SIDE, size)
            result["errors"] = [row for kind in ("rgb", "height") for row in measure_errors(kind, side, room)]
            result["box"] = check_box(side, room)
            keep(result)
        if re.search(only, "limits: "):
            result["limits"] = limits(room, size)  # at the end: for half an hour nothing was deleted here
            keep(result)
    return result


def merged(old: Result, new: Result) -> Result:
    """Return ``old`` with everything that was measured anew in its place, cases as a whole; raises SystemExit if sizes differ."""
    if old["size"] != new["size"]:
        raise SystemExit(f"{RAW}: has results of --size {old['size']}, which --merge cannot mix with those of {new['size']}")
    both = old["cases"] | new["cases"]
    ordered = {case.key: both[case.key] for case in cases(new["size"]) if case.key in both}
    return old | new | {"cases": ordered}


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write one line per row as CSV."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def save(result: Result) -> None:
    """Write all figures as JSON, a line per run as CSV, and a line per error."""
    RAW.parent.mkdir(exist_ok=True)
    partial = RAW.with_suffix(".part")
    partial.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    partial.replace(RAW)
    rows = [row | {"source": row["source"]["layout"]} for case in result["cases"].values() for row in case["rows"]]
    write_rows(RAW.with_suffix(".csv"), rows)
    write_rows(RAW.with_name("peers-errors.csv"), result.get("errors", []))


def options_of_user() -> argparse.Namespace:
    """Return the options of the command line; ends with a message if they make no sense."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=16384, help="side of the large sources [samples], a power of two from 1024 on")
    parser.add_argument("--runs", type=int, default=5, help="counted rounds; some cases and slow programs have fewer")
    parser.add_argument("--only", default="", metavar="REGEX", help="measure only what this finds in 'case: program'")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="where sources and outputs go; /dev/shm: no disk")
    parser.add_argument("--merge", action="store_true", help="keep the cases of an earlier measurement that are not measured now")
    parser.add_argument("--scratch", action="store_true", help="print all figures as JSON, write no results and no report")
    parser.add_argument("--report", action="store_true", help="measure nothing, write docs/PERFORMANCE.md from the results")
    options = parser.parse_args()
    if options.size < 1024 or options.size & (options.size - 1) or options.runs < 1 or not options.folder.is_dir():
        parser.error("--size is a power of two from 1024 on, --runs at least 1, --folder a folder that exists")
    return options


def main() -> None:
    """Measure, save after every part, and write the report."""
    options = options_of_user()
    old = json.loads(RAW.read_text(encoding="utf-8")) if options.merge and RAW.exists() else None
    if old and not options.report:
        merged(old, {"size": options.size, "cases": {}})  # refuses before half an hour is spent

    def keep(result: Result) -> None:
        if not options.scratch:
            save(merged(old, result) if old else result)

    if not options.report:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the default would leave all outputs on the disk
        try:
            result = measure(options.size, options.runs, options.only, options.folder, keep)
        except CommandError as failure:
            raise SystemExit(str(failure)) from failure
        if re.search(options.only, "light: ") and not options.scratch:
            compare(None, 1.0, 90.0, min(options.runs, 3))
        if options.scratch:
            sys.stdout.write(json.dumps(result, indent=1) + "\n")
            return
    sys.stderr.write(f"{targets(write_report())}\n")


if __name__ == "__main__":
    main()
