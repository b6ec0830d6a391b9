"""The memory of the machine, and how much of it this process may still take."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

PROCESS_BYTES: Final = 235 << 20
"""A process that has loaded readers, codecs and compiled kernels and built something tiny: 230 to 248 MiB."""


def available_bytes(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the memory that this process could still get: the machine's, or less in a control group with a limit; None if unknown.

    Control groups are those of Linux, version 2 or 1 (the kernel's ``admin-guide/cgroup-v2`` and ``cgroup-v1/memory``): a limit holds
    for all groups below it; what the group uses counts without the cached files that the kernel gives back.
    """
    found = [*_group_rests(proc, groups)]
    free = _meminfo(proc).get("MemAvailable")
    return min([*found, *([] if free is None else [free])], default=None)


def total_bytes() -> int:
    """Return the memory of the machine, 0 if unknown."""
    return _meminfo(Path("/proc")).get("MemTotal", 0)


def _meminfo(proc: Path) -> dict[str, int]:
    lines = [line.split() for line in _text(proc / "meminfo").splitlines()]
    return {words[0].rstrip(":"): int(words[1]) * 1024 for words in lines if len(words) > 1 and words[1].isdecimal()}


def _group_rests(proc: Path, groups: Path) -> Iterator[int]:
    """Yield what is left of every limit that this process is under."""
    for line in _text(proc / "self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers and "memory" not in controllers.split(","):
            continue
        base, names = (groups / "memory", _VERSION_1) if controllers else (groups, _VERSION_2)
        inside = Path(path.lstrip("/"))
        # In a container the path may be the host's: then its own group is at the root of what it sees.
        for folder in (base / inside, *(base / parent for parent in inside.parents)):
            limit, used = (_text(folder / name).strip() for name in names[:2])
            if limit.isdecimal() and used.isdecimal():
                yield max(0, int(limit) - int(used) + _cached(folder, names[2]))


_VERSION_1: Final = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2: Final = ("memory.max", "memory.current", "inactive_file")


def _cached(folder: Path, name: str) -> int:
    words = [line.split() for line in _text(folder / "memory.stat").splitlines()]
    return next((int(line[1]) for line in words if line[0] == name), 0)


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
