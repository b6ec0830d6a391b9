"""Builds whose tasks run in processes: the same bytes, the same sentences, and none that outlives the build, however that ends."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import StorageError
from schemas.manifest import MANIFEST_NAME
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.verify import verify
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore
from tiler.tasks.engine import LocalEngine
from tiler.tasks.processes import ProcessEngine, can_fork

PROGRAM = """
from cli.startup import start_lean
start_lean()
import tiler.building.build
tiler.building.build._LEAST_SAMPLES = 0  # these sources are too small to be worth it
from cli.main import main
main()
"""
OPTIONS = ["--block", "32", "--task", "64", "--codec", "png", "--workers", "2"]


def command(source: Path, output: Path, *more: str) -> list[str]:
    return [sys.executable, "-W", "error", "-c", PROGRAM, "build", str(source), "-o", str(output), *OPTIONS, *more]


def start(source: Path, output: Path, *more: str) -> subprocess.Popen[str]:
    """Begin a build in a session of its own."""
    line = command(source, output, *more)
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def children(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children")
    return [int(each) for each in found.read_text().split()] if found.exists() else []


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def at_work(build: subprocess.Popen[str], output: Path) -> list[int]:
    """Wait until some tasks are finished; return the processes at work."""
    wait_until(lambda: len(list(output.glob("imagery/tasks/0/*/*.json"))) > 5 or build.poll() is not None)
    return children(build.pid)


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A picture of 256 tasks."""
    return write_tiff(tmp_path_factory.mktemp("source") / "photo.tif", photo(1024, 1024, seed=8))


@pytest.fixture(scope="module")
def whole(large: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What becomes of it on threads."""
    out = tmp_path_factory.mktemp("whole") / "out"
    build_layer(large, out, settings(block=32, task=64, codec="png", workers=2), engine=LocalEngine(2))
    return out


def same(out: Path, whole: Path) -> bool:
    return (
        tree_digest(out / "imagery") == tree_digest(whole / "imagery")
        and (out / MANIFEST_NAME).read_bytes() == (whole / MANIFEST_NAME).read_bytes()
    )


def records(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in sorted(out.glob("imagery/tasks/[0-9]*/*/*"))}


def test_bytes_and_records_are_those_of_threads(large: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    build = start(large, out, "--json")
    seen: set[int] = set()
    while build.poll() is None:
        seen.update(children(build.pid))
        time.sleep(0.001)
    printed, errors = build.communicate(timeout=60)
    assert (build.returncode, errors) == (0, "")
    assert len(seen) == 8, "two for each of the four tiers that have more than one task"
    assert same(out, whole)
    assert records(out) == records(whole)
    report = json.loads(printed)
    assert report["tasks_kept"] == 0
    assert report["blocks_written"] == report["blocks_stored"] == 1024 + 256 + 64 + 16 + 4 + 1
    assert report["peak_rss_bytes"] > 0
    assert all(seconds > 0 for seconds in report["thread_seconds_per_megasample"].values())


@pytest.mark.parametrize("kind", ["voids", "strips", "sequential"])
def test_every_reader_works_in_a_copy(kind: str, tmp_path: Path) -> None:
    """Handles are opened anew: a position in a file that two processes share would move under the other's hands."""
    pixels = photo(300, 260)
    source = tmp_path / "photo.tif"
    if kind == "voids":
        write_tiff(source, np.where(photo(300, 260, seed=3) > 200, np.uint8(0), pixels), nodata=0)
    elif kind == "strips":
        write_tiff(source, pixels, tiled=False, blockysize=3, compress="zstd")
    else:
        source = write_tiff(tmp_path / "photo.png", pixels[..., :3])
    for engine, out in (("processes", tmp_path / "a"), ("threads", tmp_path / "b")):
        more = ["--decode", "none", *(["--codec", "png"] if engine == "processes" else ["--workers", "1"])]
        subprocess.run(command(source, out, *more), check=True, capture_output=True)
    assert tree_digest(tmp_path / "a") == tree_digest(tmp_path / "b")


def test_one_worker_is_no_other_process(large: Path, tmp_path: Path) -> None:
    build = start(large, tmp_path / "out", "--workers", "1")
    seen = set()
    while build.poll() is None:
        seen.update(children(build.pid))
        time.sleep(0.001)
    build.communicate(timeout=60)
    assert build.returncode == 0
    assert not seen


def test_a_process_with_threads_is_not_copied(large: Path, whole: Path, tmp_path: Path) -> None:
    """A lock that another thread holds would never be free in the copy."""
    stop = threading.Event()
    other = threading.Thread(target=stop.wait)
    other.start()
    try:
        assert not can_fork()
        engine = ProcessEngine(2)
        build_layer(large, tmp_path / "out", settings(block=32, task=64, codec="png", workers=2), engine=engine)
        assert engine.peak_bytes == 0
    finally:
        stop.set()
        other.join()
    assert same(tmp_path / "out", whole)


@pytest.mark.parametrize(
    ("number", "group"), [(signal.SIGINT, True), (signal.SIGINT, False), (signal.SIGTERM, True), (signal.SIGHUP, False)]
)
def test_termination_keeps_what_is_finished(number: signal.Signals, group: bool, large: Path, whole: Path, tmp_path: Path) -> None:
    """Whether all processes are told, as a terminal does, or one: a sentence, no process left, and the same command goes on."""
    out = tmp_path / "out"
    build = start(large, out)
    hands = at_work(build, out)
    (os.killpg if group else os.kill)(build.pid, number)
    _, errors = build.communicate(timeout=60)
    assert build.returncode == 128 + number
    first, second = errors.strip().splitlines()
    assert first == f"clipmap: {'interrupted' if number == signal.SIGINT else 'terminated'}"
    assert re.fullmatch(r"note: \d+ of 342 tasks are finished and kept: the same command goes on from there", second)
    assert len(hands) == 2
    assert not any(map(is_alive, hands))
    assert not list(out.rglob(".tmp-*"))
    rerun = subprocess.run(command(large, out), check=True, capture_output=True, text=True)
    assert "continued" in rerun.stdout
    assert same(out, whole)


def test_a_process_that_is_killed_is_a_sentence(large: Path, whole: Path, tmp_path: Path) -> None:
    """As by the system when memory runs out; what the others are at is finished and kept."""
    out = tmp_path / "out"
    build = start(large, out)
    hands = at_work(build, out)
    os.kill(hands[0], signal.SIGKILL)
    _, errors = build.communicate(timeout=60)
    assert build.returncode == 4
    first, second = errors.strip().splitlines()
    assert first == (
        f"clipmap: {out}: one of the build's processes was killed, most often because the machine had no memory left; try fewer --workers"
    )
    assert second.endswith("the same command goes on from there")
    assert not any(map(is_alive, hands))
    subprocess.run(command(large, out), check=True, capture_output=True)
    assert same(out, whole)


def test_nothing_outlives_a_build_that_is_killed(large: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for _ in range(3):
        build = start(large, out)
        hands = at_work(build, out)
        build.kill()
        build.communicate(timeout=60)
        time.sleep(1)
        assert not any(map(is_alive, hands))
    rerun = subprocess.run(command(large, out), check=True, capture_output=True, text=True)
    assert "continued" in rerun.stdout
    assert same(out, whole)
    assert verify(open_dataset(out)).findings == []


HOLDER = """
import os, sys, time
from pathlib import Path
from tiler.stores.directory import DirectoryStore
with DirectoryStore(Path(sys.argv[1])).exclusive() as claim:
    claim.announce("imagery")
    if os.fork() == 0:
        time.sleep(1)
        os._exit(0)
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_next_build_waits_for_what_a_killed_one_has_left_running(tmp_path: Path) -> None:
    """Its processes have its lock for as long as they take to end; that is no other build."""
    store = DirectoryStore(tmp_path / "out")
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path / "out")], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(StorageError, match=rf"another build is writing here \(process {holder.pid} "), store.exclusive():
            pass
        holder.kill()
    with store.exclusive() as claim:
        assert claim.abandoned == ("imagery",)


def test_an_error_is_the_same_as_on_threads(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 3 // 4])
    ended = [
        subprocess.run(command(source, tmp_path / "out", *more), capture_output=True, text=True, check=False)
        for more in ([], ["--overwrite", "--workers", "1"])
    ]
    assert [each.returncode for each in ended] == [3, 3]
    first, second = (each.stderr.splitlines()[0] for each in ended)
    assert re.sub(r"rows.*", "", first) == re.sub(r"rows.*", "", second)
    assert "cut.tif: cannot be read at rows" in first
    assert re.fullmatch(r"note: \d+ of 86 tasks are finished and kept: .*", ended[0].stderr.splitlines()[1])
