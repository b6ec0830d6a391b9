"""What one run of a program costs: time, processor time, memory and output, the processes it starts included."""

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from select import select
from time import perf_counter
from typing import Final

PERIOD_S: Final = 0.03
"""Between two looks at the memory of a run."""
SHARED_EVERY: Final = 6
"""So many looks apart, what several processes hold: the kernel goes through all their pages for it, which takes a millisecond each."""


class CommandError(Exception):
    """A program ended with another exit status than 0; the message has the command and the end of its error output."""


@dataclass(frozen=True, slots=True)
class Cost:
    """One run: ``wall_s`` of the whole command, ``cpu_s`` of all its processes, ``flush_s`` until the disk had its output.

    ``peak_rss_bytes`` is the peak of a process that stays alone, else the largest sum seen of what processes hold at the same time,
    each page shared by n of them counted as 1/n for each. ``other_cpu_s`` is what everything else on the machine used meanwhile;
    ``record_bytes`` is the part of ``output_bytes`` that clipmap keeps for updates and repairs.
    """

    wall_s: float
    cpu_s: float
    flush_s: float
    other_cpu_s: float
    peak_rss_bytes: int
    output_bytes: int
    record_bytes: int
    files: int


def _family(process: int) -> list[int]:
    """Return a process and all below it; those that have just ended are left out."""
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [process, *(member for child in children for member in _family(int(child)))]


def _noted_bytes(process: int, file: str, name: str) -> int:
    try:
        status = Path(f"/proc/{process}/{file}").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return next((1024 * int(line.split()[1]) for line in status.splitlines() if line.startswith(name)), 0)


def _held_bytes(processes: list[int], look: int) -> int:
    """Return what processes hold: of one its peak, of several their shares, at every few looks; 0 if not known."""
    if len(processes) == 1:
        return _noted_bytes(processes[0], "status", "VmHWM:")
    return 0 if look % SHARED_EVERY else sum(_noted_bytes(each, "smaps_rollup", "Pss:") for each in processes)


def machine_busy_s() -> float:
    """Return the processor seconds that the whole machine has used since it started, from ``/proc/stat``."""
    user, nice, system, _, _, interrupts, soft, *_ = map(int, Path("/proc/stat").read_text().splitlines()[0].split()[1:])
    return (user + nice + system + interrupts + soft) / os.sysconf("SC_CLK_TCK")


def _sizes(folder: Path) -> tuple[int, int, int]:
    """Return bytes and number of the files in ``folder``, and the bytes of clipmap's records among them; links count for nothing."""
    found = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    records = sum(path.stat().st_size for path in found if "tasks" in path.relative_to(folder).parts)
    return sum(path.stat().st_size for path in found), len(found), records


def run_command(command: list[str], output: Path) -> tuple[Cost, str]:
    """Run ``command``, which writes into the folder ``output``; return what it cost and what it printed on its standard output.

    Raises CommandError if it fails.
    """
    printed, complaints = output.parent / "printed", output.parent / "complaints"
    peak, look, busy_s, started = 0, 0, machine_busy_s(), perf_counter()
    with open(printed, "wb") as out, open(complaints, "wb") as err, subprocess.Popen(command, stdout=out, stderr=err) as process:
        with open(os.pidfd_open(process.pid), "rb", buffering=0) as end:
            while not select([end], [], [], PERIOD_S)[0]:
                peak, look = max(peak, _held_bytes(_family(process.pid), look)), look + 1
        wall_s = perf_counter() - started
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    cpu_s = usage.ru_utime + usage.ru_stime
    other_s = max(0.0, machine_busy_s() - busy_s - cpu_s)
    if process.returncode:
        raise CommandError(f"{' '.join(command)}: exit status {process.returncode}: {complaints.read_text(errors='replace')[-500:]}")
    flushed = perf_counter()
    subprocess.run(["sync", "-f", str(output)], check=True)
    flush_s = perf_counter() - flushed
    size, files, records = _sizes(output)
    return Cost(wall_s, cpu_s, flush_s, other_s, peak, size, records, files), printed.read_text()
