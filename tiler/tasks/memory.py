"""How much memory a process has held, as Linux counts it (``proc_pid_status(5)``, ``proc_pid_smaps(5)``)."""

import resource
from contextlib import suppress
from pathlib import Path


def peak_bytes() -> int:
    """Return the largest resident set this process has had; ``getrusage`` would count a parent's, inherited by fork."""
    return _sum("/proc/self/status", "VmHWM:") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def own_peak_bytes() -> int:
    """Return the same without what it shares with other processes now: of a fork, what it has added or changed, at most."""
    return max(0, peak_bytes() - _sum("/proc/self/smaps_rollup", "Shared_Clean:", "Shared_Dirty:"))


def _sum(path: str, *names: str) -> int:
    """Return the sum of lines like ``VmHWM:  123 kB`` of a file [bytes]; 0 if it cannot be read."""
    with suppress(OSError):
        fields = [line.split() for line in Path(path).read_text().splitlines()]
        return sum(1024 * int(field[1]) for field in fields if field[0] in names)
    return 0
