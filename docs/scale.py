"""Simulates a build of one petapixel on a cluster, from measured tasks, and writes the tables of ``docs/SCALE.md``.

    .venv/bin/python docs/scale.py

Reads ``tests/bench/results/scale-tasks.csv`` and ``scale.json``, which ``tests/bench/scale.py`` writes. A discrete simulation, one
event per task: cores take tasks in order; a task lasts as long as a measured one, or as its writes take if that is longer; the store
answers so many requests a second and no more; the coordinating process enters one result after the other, and no more than two tasks
per core are handed out before it has; a tier begins when the one below has ended. Deterministic; takes a minute.
"""

import csv
import heapq
import json
import random
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from docs.markers import with_content

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "tests/bench/results"
TARGET = DOCS / "SCALE.md"
BEGIN: Final = "<!-- simulation: written by docs/scale.py -->"
END: Final = "<!-- end of the simulation -->"

SIDE: Final = 1 << 25
"""Samples a side: 1.126 petapixels."""
LATENCY_S: Final = 0.02
"""Of one request to an object store."""
IN_FLIGHT: Final = 16
"""Writes of one task that are under way at the same time, see ``tiler/tasks/overlap.py``; the task goes on meanwhile."""
REQUESTS_PER_S: Final = 3500
"""Writes that one prefix of S3 takes at least; every level has its own."""
CORES: Final = (100, 1_000, 10_000)
MAX_BLOCKS: Final = 1 << 27
ENOUGH_TASKS: Final = 1_000_000
"""Of a tier with more tasks so many are simulated, and the time is multiplied."""


@dataclass(frozen=True)
class Config:
    """One way to cut the petapixel: what a task of its first tier costs."""

    block: int
    task: int
    seconds: tuple[float, ...]
    requests: int
    stored_bytes_per_px: float
    ledger_s: float
    engine_s: float

    @property
    def blocks(self) -> int:
        """Blocks of level 0."""
        return (SIDE // self.block) ** 2

    @property
    def datasets(self) -> int:
        """How many datasets the petapixel takes: each has prefixes of its own in the store, and a build of its own, at the same time."""
        return max(1, self.blocks // MAX_BLOCKS)

    @property
    def levels_per_tier(self) -> int:
        """Levels that a task makes."""
        return (self.task // self.block).bit_length() - 1

    @property
    def tiers(self) -> list[int]:
        """Number of tasks of every tier."""
        found, side = [], SIDE
        while side >= self.block:
            found.append(max(1, side // self.task) ** 2)
            side >>= self.levels_per_tier
        return found

    @property
    def coordinator_s(self) -> float:
        """What one result costs the coordinating processes, of which there is one per dataset."""
        blocks = sum((self.task // self.block >> step) ** 2 for step in range(self.levels_per_tier))
        return (self.engine_s + blocks * self.ledger_s) / self.datasets


@dataclass(frozen=True)
class Outcome:
    """What a simulated build took, and how busy its parts were."""

    wall_s: float
    cores_busy: float
    store_busy: float
    coordinator_busy: float
    last_tiers_s: float


def load() -> list[Config]:
    """Return what was measured, one configuration per side of a block."""
    about = json.loads((RESULTS / "scale.json").read_text())
    with (RESULTS / "scale-tasks.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    configs = []
    for block, task in sorted({(int(row["block"]), int(row["task"])) for row in rows}):
        own = [row for row in rows if row["block"] == block and row["task"] == task]
        whole = [row for row in own if row["level"] == 0 and row["samples"] == task * task]
        pixels = sum(row["samples"] for row in whole)
        configs.append(
            Config(
                block,
                task,
                tuple(row["seconds"] for row in whole),
                round(sum(row["requests"] for row in whole) / len(whole)),
                sum(row["stored_bytes"] for row in whole) / pixels,
                about["ledger_s_per_block"],
                about["engine_s_per_task"],
            )
        )
    return configs


def simulate(config: Config, cores: int) -> Outcome:
    """Run the build on ``cores`` cores."""
    chance = random.Random(1)
    clock = work_s = store_s = coordinator_s = 0.0
    ends: list[float] = []
    wait_s = config.requests * LATENCY_S / IN_FLIGHT
    rate = REQUESTS_PER_S * config.datasets
    for count in config.tiers:
        simulated = min(count, ENOUGH_TASKS)
        free = [clock] * min(cores, simulated)
        store = coordinator = clock
        handed_out: deque[float] = deque()
        for _ in range(simulated):
            start = heapq.heappop(free)
            if len(handed_out) == 2 * cores:
                start = max(start, handed_out.popleft())
            seconds = max(chance.choice(config.seconds), wait_s)
            store = max(store, start) + config.requests / rate
            end = max(start + seconds, store)
            heapq.heappush(free, end)
            coordinator = max(coordinator, end) + config.coordinator_s
            handed_out.append(coordinator)
            work_s += seconds * count / simulated
        store_s += count * config.requests / rate
        coordinator_s += count * config.coordinator_s
        clock += (max(coordinator, *free) - clock) * count / simulated
        ends.append(clock)
    return Outcome(clock, work_s / (clock * cores), store_s / clock, coordinator_s / clock, clock - ends[1])


def amounts(configs: list[Config]) -> str:
    """Return the table of what has to be made and kept."""
    lines = ["| block, task | tasks | blocks | stored | index | scratch (pieces) | datasets |", "|---" * 7 + "|"]
    for config in configs:
        blocks = config.blocks * 4 / 3
        stored = config.stored_bytes_per_px * SIDE * SIDE
        pieces = SIDE * SIDE / 4**config.levels_per_tier * 12 * 16 / 15
        lines.append(
            f"| {config.block}, {config.task} | {sum(config.tiers):,} | {blocks:.2g} | {stored / 1e12:,.0f} TB "
            f"| {blocks * 32 / 1e9:,.1f} GB | {pieces / 1e12:,.0f} TB | {config.datasets} |"
        )
    return "\n".join(lines)


def walls(configs: list[Config]) -> str:
    """Return the table of simulated builds."""
    head = "| block, task | s per task | cores | wall | cores busy | writes/s | store busy | coordinator busy | tiers above the first two |"
    lines = [head, "|---" * 9 + "|"]
    for config in configs:
        for cores in CORES:
            found = simulate(config, cores)
            writes = config.requests * sum(config.tiers) / found.wall_s
            mean = sum(config.seconds) / len(config.seconds)
            lines.append(
                f"| {config.block}, {config.task} | {mean:.1f} | {cores:,} | {found.wall_s / 3600:,.1f} h | {found.cores_busy:.0%} "
                f"| {writes:,.0f} | {found.store_busy:.0%} | {found.coordinator_busy:.0%} | {found.last_tiers_s / 60:,.1f} min |"
            )
    return "\n".join(lines)


def main() -> None:
    """Write the tables between the markers."""
    configs = load()
    TARGET.write_text(with_content(TARGET, BEGIN, END, f"{amounts(configs)}\n\n{walls(configs)}"), encoding="utf-8")


if __name__ == "__main__":
    main()
