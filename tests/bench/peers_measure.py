"""Runs the programs of a case in turn and notes what every run costs."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from tests.bench.peers_cost import CommandError, run_command
from tests.bench.peers_programs import Case, Program
from tests.bench.peers_room import Room, read_through

Row = dict[str, Any]

STAGES: Final = ("read", "filter", "encode", "write")
WARM_SIDE: Final = 2048
"""Side of the sources of the round that is not counted [samples]: enough that a build has tasks of more than one tier."""
GROWTH: Final = 1.3
"""Output is taken to need at most so much more per sample on a large source than on a small one."""
BUSY: Final = 0.1
"""Share of all processors that others may use during a run; with more it is repeated."""
AGAIN: Final = 2
"""How often at most."""


def machine() -> dict[str, Any]:
    """Return what the figures are measured on."""
    model = [line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": model[0] if model else platform.machine(),
        "processors": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
    }


def file_system(folder: Path) -> str:
    """Return the type of the file system that ``folder`` lies on."""
    answer = subprocess.run(["findmnt", "-no", "FSTYPE", "-T", str(folder)], capture_output=True, text=True, check=False)
    return answer.stdout.strip() or "an unknown file system"


def run_once(program: Program, source: Path, room: Room) -> Row:
    """Run a program into a fresh folder, which stays, and return its cost, with the stages where it is clipmap."""
    output = room.output()
    (output / "link.tif").symlink_to(source)
    processors = len(os.sched_getaffinity(0))
    cost, printed = run_command(program.line(source, output, processors), output)
    row: Row = asdict(cost) | {"others": cost.other_cpu_s / (cost.wall_s * processors)}
    if printed.startswith("{"):
        report = json.loads(printed)
        row["build_s"] = report["wall_s"]
        row |= {f"{stage}_s_per_megasample": report["thread_seconds_per_megasample"][stage] for stage in STAGES}
    return row


def run_undisturbed(program: Program, source: Path, room: Room) -> Row:
    """Run a program, again if others used more than ``BUSY`` of the machine; return the least disturbed run, and of how many."""
    tries = [run_once(program, source, room)]
    while tries[-1]["others"] > BUSY and len(tries) <= AGAIN and room.free_bytes() > 2 * tries[-1]["output_bytes"]:
        tries.append(run_once(program, source, room))
    return min(tries, key=lambda row: float(row["others"])) | {"tries": len(tries)}


def warm_up(programs: Sequence[Program], room: Room) -> dict[str, float]:
    """Run every program once on a small source, then read the large ones; return the output of each [bytes per sample].

    That compiles kernels and brings programs and sources into memory. A program that fails is named and left out.
    """
    found = {}
    for program in programs:
        side = min(WARM_SIDE, program.source.side)
        try:
            cost = run_once(program, room.source(replace(program.source, side=side)), room)
        except CommandError as failure:
            sys.stderr.write(f"{program.name}: left out: {failure}\n")
            continue
        found[program.name] = cost["output_bytes"] / side**2
    for source in dict.fromkeys(program.source for program in programs if program.name in found):
        read_through(room.source(source))
    return found


def affordable_runs(programs: Sequence[Program], runs: int, sample_bytes: dict[str, float], room: Room) -> int:
    """Return how many rounds of output the disk can keep, at most ``runs``; raises SystemExit if not even one."""

    def needed(rounds: int) -> int:
        counts = {program.name: min(rounds, program.runs or rounds) for program in programs}
        return int(sum(GROWTH * sample_bytes[p.name] * p.source.side**2 * counts[p.name] for p in programs))

    what = "the output of all rounds"
    if needed(runs) > room.free_bytes():
        room.clear(what)
    while runs > 1 and needed(runs) > room.free_bytes():
        runs -= 1
    room.demand(needed(runs), what)
    return runs


def run_case(case: Case, programs: Sequence[Program], runs: int, room: Room) -> dict[str, Any]:
    """Return all runs of ``programs``, round by round, A B C A B C, and the conditions."""
    sample_bytes = warm_up(programs, room)
    programs = [program for program in programs if program.name in sample_bytes]
    wanted = min(runs, case.runs or runs)
    runs = affordable_runs(programs, wanted, sample_bytes, room)
    if runs < wanted:
        sys.stderr.write(f"{case.key}: {runs} instead of {wanted} rounds, for the disk cannot keep more output\n")
    started, load, rows = datetime.now(UTC).isoformat(timespec="seconds"), os.getloadavg()[0], []
    for number in range(runs):
        for program in programs:
            if number >= (program.runs or runs):
                continue
            row = run_undisturbed(program, room.source(program.source), room)
            about: Row = {"case": case.key, "program": program.name, "filter": program.filter, "remark": program.remark}
            about |= {"against": program.against or programs[0].name, "side": program.source.side, "source": asdict(program.source)}
            rows.append(about | {"run": number} | row)
            sys.stderr.write(f"{case.key}: {program.name}: {row['wall_s']:.2f} s\n")
    return {
        "title": case.title,
        "time": started,
        "load": load,
        "file_system": file_system(room.folder),
        "machine": machine(),
        "rows": rows,
    }
