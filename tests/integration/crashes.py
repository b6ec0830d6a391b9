"""Runs builds that are killed with SIGKILL, each in a process of its own; run as a module, one job as JSON on standard input.

The processes are forked from this one, which has imported everything: a crash then costs milliseconds, not the start of an interpreter.
"""

import json
import os
import random
import signal
import sys
from pathlib import Path
from typing import Any

from schemas.settings import BuildSettings
from tiler.building.build import build_layer
from tiler.stores.directory import DirectoryStore
from tiler.tasks.processes import ProcessEngine, can_fork


def in_a_child(job: dict[str, Any], writes: int | None) -> bool:
    """Build in a forked process that dies at its ``writes``-th write or delete, before or after it; whether it was killed."""
    child = os.fork()
    if child == 0:
        if writes is not None:
            die_at(writes)
        engine = ProcessEngine(2) if job["processes"] else None
        build_layer(Path(job["source"]), job["output"], BuildSettings(**job["settings"]), engine=engine)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    if status not in (0, signal.SIGKILL):
        raise SystemExit(f"the build ended with {status}")
    return status == signal.SIGKILL


def die_at(writes: int) -> None:
    """Kill the build at the n-th write or delete of one of its processes."""
    count, build = 0, os.getpid()

    def dying(name: str) -> Any:
        method = getattr(DirectoryStore, name)

        def act(*arguments: Any) -> Any:
            nonlocal count
            count += 1
            if count == writes and writes % 2:
                os.kill(build, signal.SIGKILL)
            result = method(*arguments)
            if count >= writes:
                os.kill(build, signal.SIGKILL)
            return result

        return act

    for name in ("write", "write_unnamed", "delete", "delete_prefix", "sync"):
        setattr(DirectoryStore, name, dying(name))


def main() -> None:
    """Kill the build again and again, then let it end; prints how often it was killed."""
    job = json.load(sys.stdin)
    if job["processes"] and not can_fork():
        raise SystemExit("this process has threads")
    chance = random.Random(job["seed"])
    killed = sum(in_a_child(job, chance.randrange(*job["writes"])) for _ in range(job["kills"]))
    if job["finish"]:
        in_a_child(job, None)
    sys.stdout.write(str(killed))


if __name__ == "__main__":
    main()
