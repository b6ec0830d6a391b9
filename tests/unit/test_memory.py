"""The memory of a build, by the model and in fact; and how much there is to be had, under the limits of control groups."""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.settings import BuildSettings
from tests.integration.files import write_tiff
from tests.reference.terrain import photo
from tiler.building.plan import Plan
from tiler.estimate.build import plan_from_headers
from tiler.estimate.machine import available_bytes
from tiler.estimate.memory import build_memory_bytes

BUILD = "import sys; from cli.main import run; sys.exit(run(sys.argv[1:]))"
MIB = 1 << 20


@pytest.mark.parametrize(("tiled", "workers"), [(True, 2), (False, 1)])
def test_the_model_is_near_the_truth(tiled: bool, workers: int, tmp_path: Path) -> None:
    """Builds of 100 million samples were 10 % above to 28 % below the model (2026-11-22); the smaller these are, the nearer."""
    profile: dict[str, Any] = {} if tiled else {"tiled": False, "blockxsize": None, "blockysize": 16}
    source = write_tiff(tmp_path / "wide.tif", np.tile(photo(512, 512), (2, 16, 1)), **profile)
    expected = build_memory_bytes(plan_from_headers([source], tmp_path / "out", BuildSettings(workers=workers)), workers)
    arguments = ["build", str(source), "-o", str(tmp_path / "out"), "--workers", str(workers), "--json"]
    ran = subprocess.run([sys.executable, "-c", BUILD, *arguments], check=True, capture_output=True, text=True)
    peak = json.loads(ran.stdout)["peak_rss_bytes"]
    assert 0.8 * peak < expected < 1.4 * peak


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    folder = tmp_path_factory.mktemp("plan")
    source = write_tiff(folder / "large.tif", np.zeros((3000, 9000, 1), np.uint8), compress="deflate")
    return plan_from_headers([source], folder / "out", BuildSettings(layer="imagery", task=1024))


def test_more_threads_take_more_up_to_the_number_of_tasks(plan: Plan) -> None:
    sizes = [build_memory_bytes(plan, workers) for workers in range(1, 40)]
    assert all(more > less for less, more in pairwise(sizes[:27]))
    assert len(set(sizes[26:])) == 1  # 9 x 3 tasks


def groups(folder: Path, lines: dict[str, dict[str, object]]) -> None:
    """Write files of control groups."""
    for path, files in lines.items():
        (folder / path).mkdir(parents=True, exist_ok=True)
        for name, value in files.items():
            (folder / path / name).write_text(f"{value}\n")


def machine(folder: Path, free: int | None, group: str) -> tuple[Path, Path]:
    """Make what stands for ``/proc`` and ``/sys/fs/cgroup``."""
    proc = folder / "proc"
    (proc / "self").mkdir(parents=True)
    if free is not None:
        (proc / "meminfo").write_text(f"MemTotal: {2 * free >> 10} kB\nMemAvailable:   {free >> 10} kB\nHugePages_Total: 0\n")
    (proc / "self/cgroup").write_text(group)
    return proc, folder / "groups"


def test_without_limits_it_is_what_the_machine_has(tmp_path: Path) -> None:
    assert available_bytes(*machine(tmp_path, 900 * MIB, "0::/\n")) == 900 * MIB


def test_nothing_is_known_of_another_system(tmp_path: Path) -> None:
    assert available_bytes(tmp_path / "none", tmp_path / "none") is None


@given(st.integers(0, 3), st.integers(0, 700), st.integers(0, 200))
def test_the_tightest_limit_above_counts(level: int, used: int, cached: int) -> None:
    """Version 2: of four nested groups one has the limit; cached files are given back."""
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        proc, folder = machine(Path(name), 2000 * MIB, "0::/a/b/c\n")
        cached = min(cached, used)
        for number, path in enumerate(("", "a", "a/b", "a/b/c")):
            limit: object = 800 * MIB if number == level else "max"
            files = {"memory.max": limit, "memory.current": used * MIB, "memory.stat": f"anon 5\ninactive_file {cached * MIB}"}
            groups(folder, {path: files})
        assert available_bytes(proc, folder) == (800 - used + cached) * MIB


def test_version_1_and_a_path_that_only_the_host_knows(tmp_path: Path) -> None:
    proc, folder = machine(tmp_path, 2000 * MIB, "9:name=systemd:/x\n4:cpu,memory:/docker/0123\n0::/\n")
    files = {"memory.limit_in_bytes": 500 * MIB, "memory.usage_in_bytes": 450 * MIB, "memory.stat": f"total_inactive_file {100 * MIB}"}
    groups(folder, {"memory": files})
    assert available_bytes(proc, folder) == 150 * MIB


def test_a_group_beyond_its_limit_has_nothing_left(tmp_path: Path) -> None:
    proc, folder = machine(tmp_path, 2000 * MIB, "0::/a\n")
    groups(folder, {"a": {"memory.max": 10, "memory.current": 20}})
    assert available_bytes(proc, folder) == 0


def test_this_machine_has_some() -> None:
    found = available_bytes()
    assert found is not None
    assert found > 10 * MIB
