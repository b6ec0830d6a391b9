"""Measures what one task of a build costs, for several sides of blocks: the raw results behind ``docs/SCALE.md``.

    python tests/bench/scale.py [--size 16384] [--codec jpeg:85]

One worker, so that a task has a processor of its own; the source is that of ``inputs.py``. Per task: seconds, the part of them spent
reading and writing, samples, blocks, requests to the store, bytes. Besides, what the coordinating process spends per task and
per block. The first build compiles the kernels and is not counted. Results go to ``tests/bench/results/scale-tasks.csv``
and ``scale.json``.
"""

import argparse
import csv
import json
import platform
import tempfile
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Final

from schemas.address import BlockAddress
from schemas.blockindex import BlockRecord
from schemas.lattice import Lattice
from schemas.settings import BuildSettings
from tests.bench.inputs import Source, write_source
from tiler.building.build import build_layer
from tiler.tasks.cut import CutBlock
from tiler.tasks.ledger import Ledger
from tiler.tasks.partition import Task, plan_tasks, plan_tiers
from tiler.tasks.records import TaskRecord
from tiler.tasks.worker import Done, TaskWorker, Work

RESULTS: Final = Path(__file__).parent / "results"
SIDES: Final = ((256, 4096), (1024, 8192), (1024, 16384), (4096, 16384))
"""Sides of blocks and of the tasks that go with them in a very large build."""
ENGINE_S_PER_TASK: Final = 0.0025
"""What handing a task to a Dask cluster and taking its result back costs the coordinating process; measured by hand, distributed 2026.8."""


@dataclass
class TimedEngine:
    """Runs one task after the other and notes what each took."""

    rows: list[dict[str, float]] = field(default_factory=list)

    def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done, None, None]:
        """Yield what became of every task."""
        for work in works:
            started = perf_counter()
            done = worker(work)
            self.rows.append(
                {
                    "level": work.task.tier.first,
                    "samples": work.task.core.area,
                    "seconds": perf_counter() - started,
                    "read_s": done.times.read_s,
                    "write_s": done.times.write_s,
                    "blocks": len(done.record.index()),
                    "requests": done.written + 2 + len(work.pieces),
                    "stored_bytes": sum(record.length_bytes for record in done.record.index()),
                    "piece_bytes": 0 if done.record.piece is None else work.task.piece.area * 12,
                }
            )
            yield done


def coordinator_seconds(records: Iterator[tuple[Task, TaskRecord]], ledger: Ledger) -> tuple[float, int]:
    """Return the seconds that entering ``records`` takes, and how many blocks that were."""
    entered = list(records)
    started = perf_counter()
    for task, record in entered:
        ledger.enter(task, record)
    return perf_counter() - started, sum(len(record.index()) for _, record in entered)


def measure(source: Path, folder: Path, codec: str, block: int, task: int) -> list[dict[str, float]]:
    """Return one row per task of a build."""
    engine = TimedEngine()
    build_layer(source, folder / f"out-{block}-{task}", BuildSettings(codec=codec, block=block, task=task, workers=1), engine=engine)
    return [{"block": block, "task": task, **row} for row in engine.rows]


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=16384)
    parser.add_argument("--codec", default="jpeg:85")
    options = parser.parse_args()
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_source(folder / "small.tif", Source("rgb", 512))
        measure(folder / "small.tif", folder, options.codec, 64, 128)
        write_source(folder / "source.tif", Source("rgb", options.size))
        for block, task in SIDES:
            rows += measure(folder / "source.tif", folder, options.codec, block, task)
    with (RESULTS / "scale-tasks.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    about = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": platform.machine(),
        "processor": next(
            (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line), ""
        ),
        "size": options.size,
        "codec": options.codec,
        "ledger_s_per_block": ledger_seconds_per_block(),
        "engine_s_per_task": ENGINE_S_PER_TASK,
    }
    (RESULTS / "scale.json").write_text(json.dumps(about, indent=1) + "\n")


def ledger_seconds_per_block() -> float:
    """Return what entering one block costs the coordinating process, from 100 tasks of 340 blocks."""
    lattice = Lattice(40960, 40960)
    tier = plan_tiers(lattice, 4096)[0]
    record = BlockRecord("ab" * 16, 30_000, 65536, 0.0, 255.0)

    def records() -> Iterator[tuple[Task, TaskRecord]]:
        for task in plan_tasks(lattice, tier, "tiled"):
            addresses = (BlockAddress(level, x, y) for level, r in task.blocks(256) for y in range(r.y0, r.y1) for x in range(r.x0, r.x1))
            blocks = [CutBlock(address, record, (0.0,), (255.0,), (1.0,)) for address in addresses]
            yield task, TaskRecord.of(task, blocks, plan="0" * 32, stamp="", content="0" * 32)

    seconds, blocks = coordinator_seconds(records(), Ledger(lattice, 1))
    return seconds / blocks


if __name__ == "__main__":
    main()
