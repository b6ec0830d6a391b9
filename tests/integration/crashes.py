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


def in_a_child(job: dict[str, Any], writes: int | None) -> bool:
    """Build in a forked process that dies at its ``writes``-th write or delete, before or after it; whether it was killed."""
    child = os.fork()
    if child == 0:
        if writes is not None:
            die_at(writes)
        build_layer(Path(job["source"]), job["output"], BuildSettings(**job["settings"]))
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    if status not in (0, signal.SIGKILL):
        raise SystemExit(f"the build ended with {status}")
    return status == signal.SIGKILL


def die_at(writes: int) -> None:
    count = 0

    def dying(name: str) -> Any:
        method = getattr(DirectoryStore, name)

        def act(*arguments: Any) -> Any:
            nonlocal count
            count += 1
            if count == writes and writes % 2:
                os.kill(os.getpid(), signal.SIGKILL)
            result = method(*arguments)
            if count >= writes:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return act

    for name in ("write", "delete", "delete_prefix", "sync"):
        setattr(DirectoryStore, name, dying(name))


def main() -> None:
    """Kill the build again and again, then let it end; prints how often it was killed."""
    job = json.load(sys.stdin)
    chance = random.Random(job["seed"])
    killed = sum(in_a_child(job, chance.randrange(*job["writes"])) for _ in range(job["kills"]))
    if job["finish"]:
        in_a_child(job, None)
    sys.stdout.write(str(killed))


if __name__ == "__main__":
    main()
