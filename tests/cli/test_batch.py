"""``clipmap batch``: many datasets at once, jobs that fail alone, reruns that do what is missing, and no process left over."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from affine import Affine

from schemas.batch import BatchReport
from tests.cli.conftest import Clipmap, Golden
from tests.cli.reports import parsed
from tests.integration.files import PLACE, settings, tree_digest, write_png, write_tiff
from tests.reference.terrain import photo
from tiler.batch import run as batch
from tiler.batch.jobs import Job, explain_death
from tiler.batch.run import Bounds, run_batch
from tiler.building.build import build_layer
from tiler.estimate.machine import PROCESS_BYTES
from tiler.stores.dataset import open_dataset

RUN = "import sys; from cli.main import main; sys.argv[0] = 'clipmap'; main()"
DEADLINE_S = 60.0


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two pictures, heights, and two files that nothing can be made of."""
    folder = tmp_path_factory.mktemp("scenes")
    write_tiff(folder / "first.tif", photo(130, 200, seed=1))
    write_tiff(folder / "second.tif", photo(90, 64, seed=2))
    write_tiff(folder / "terrain.tif", (photo(100, 100, seed=3)[..., :1].astype(np.int16) * 7))
    (folder / "text.tif").write_text("no picture")
    cut = write_tiff(folder / "cut.tif", photo(256, 256, seed=4), compress="deflate")
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 3 // 4])
    return folder


@pytest.fixture
def large(tmp_path: Path) -> Path:
    """Two pictures that take seconds in many tasks."""
    for number in (1, 2):
        write_tiff(tmp_path / f"large{number}.tif", photo(1024, 1024, seed=number))
    return tmp_path


LARGE_OPTIONS = ("--block", "32", "--task", "64", "--codec", "png", "--workers", "1")


def test_help(clipmap: Clipmap, golden: Golden) -> None:
    ran = clipmap("batch", "--help")
    assert (ran.code, ran.err) == (0, "")
    golden("help-batch.txt", ran.out)
    assert all(len(line) <= 110 for line in ran.out.splitlines())


def test_a_folder_of_good_and_bad(scenes: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    arguments = ["batch", scenes / "*.tif", "-o", tmp_path / "out", "--block", "64", "--codec", "png", "--layer", "imagery"]
    ran = clipmap(*arguments, "--json")
    assert ran.code == 1
    report = parsed(ran.out, "BatchReport")
    outcomes = {Path(job["sources"][0]).stem: job["outcome"] for job in report["jobs"]}
    assert outcomes == {"cut": "failed", "first": "built", "second": "built", "terrain": "failed", "text": "failed"}
    assert list(outcomes) == sorted(outcomes)
    assert report["failed"] == 3
    first = report["jobs"][1]
    build_layer(scenes / "first.tif", tmp_path / "alone", settings(block=64, codec="png", layer="imagery"))
    assert tree_digest(tmp_path / "out/first") == tree_digest(tmp_path / "alone")
    levels = open_dataset(tmp_path / "alone").manifest.layers["imagery"].levels
    assert first["blocks"] == first["blocks_written"] == sum(level.stored for level in levels)
    assert first["stored_bytes"] == sum(level.stored_bytes for level in levels)
    assert first["peak_rss_bytes"] > 50 << 20
    assert first["memory_bytes"] >= PROCESS_BYTES
    assert "cut.tif: cannot be read at rows" in report["jobs"][0]["reason"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["first", "second"]

    ran = clipmap(*arguments)
    assert ran.code == 1
    table = [line.split() for line in ran.out.splitlines()]
    assert table[0] == ["source", "dataset", "layer", "outcome", "blocks", "bytes", "time"]
    assert table[2][:5] == ["first.tif", "first", "imagery", "up", "to"]
    assert re.fullmatch(r"5 jobs in \d+\.?\d* s: 3 failed, 2 up to date", ran.out.splitlines()[-1])
    sentences = [line for line in ran.out.splitlines() if line.startswith("failed: ")]
    assert len(sentences) == 3
    assert all(str(scenes) in line for line in sentences)


def test_a_rerun_does_what_is_missing(scenes: Path, tmp_path: Path) -> None:
    def run(**options: Any) -> BatchReport:
        jobs = [Job((scenes / f"{name}.tif",), str(tmp_path / name), settings(**options)) for name in ("first", "second")]
        return run_batch(jobs, Bounds(2, 1, None))

    assert [job.outcome for job in run().jobs] == ["built", "built"]
    (tmp_path / "second/manifest.json").unlink()
    (tmp_path / "second/.clipmap-lock").write_text("clipmap build\n999999\nimagery\n")
    again = run()
    assert [job.outcome for job in again.jobs] == ["up to date", "continued"]
    assert [(job.blocks_written, job.tasks - job.tasks_kept) for job in again.jobs] == [(0, 0), (0, 0)]
    assert [job.reason is None for job in run(codec="png").jobs] == [False, False]
    assert [job.outcome for job in run(codec="png", overwrite=True).jobs] == ["built", "built"]


def test_layers_of_one_dataset_follow_each_other(scenes: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    """The second has no georeference: it lies where the first one does, so it has to wait for it."""
    bare = tmp_path / "bare.png"
    write_png(bare, photo(64, 64))
    (tmp_path / "jobs.toml").write_text(f"""
        [defaults]
        block = 32
        [[job]]
        sources = "{scenes / "terrain.tif"}"
        output = "alps"
        [[job]]
        sources = "{bare}"
        output = "alps"
    """)
    ran = clipmap("batch", tmp_path / "jobs.toml", "-o", tmp_path, "--jobs", "2")
    assert (ran.code, ran.err) == (0, f"note: {bare}: bare.png has no georeference: spread over the dataset's extent\n")
    assert set(open_dataset(tmp_path / "alps").manifest.layers) == {"height", "imagery"}


def test_after_a_failure_nothing_is_added_to_its_dataset(scenes: Path, tmp_path: Path) -> None:
    jobs = [Job((scenes / f"{name}.tif",), str(tmp_path / "out"), settings()) for name in ("cut", "terrain")]
    jobs.append(Job((scenes / "second.tif",), str(tmp_path / "other"), settings()))
    report = run_batch(jobs, Bounds(2, 1, None))
    assert [job.outcome for job in report.jobs] == ["failed", "not begun", "built"]
    assert str(scenes / "cut.tif") in (report.jobs[1].reason or "")
    assert report.failed == 2
    assert not (tmp_path / "out").exists()


def test_two_jobs_for_one_layer(scenes: Path, tmp_path: Path) -> None:
    jobs = [Job((scenes / f"{name}.tif",), f"{tmp_path}{slash}out", settings()) for name, slash in (("first", "/"), ("second", "//"))]
    report = run_batch(jobs, Bounds(1, 1, None))
    assert [job.outcome for job in report.jobs] == ["built", "failed"]
    assert "both become the layer 'imagery'" in (report.jobs[1].reason or "")


def test_a_mosaic_is_one_job(tmp_path: Path, clipmap: Clipmap) -> None:
    write_tiff(tmp_path / "west.tif", photo(64, 64, seed=1))
    write_tiff(tmp_path / "east.tif", photo(64, 64, seed=2), transform=PLACE @ Affine.translation(64, 0))
    (tmp_path / "jobs.toml").write_text('[[job]]\nsources = "*.tif"\noutput = "both"\nmosaic = true\ncodec = "png"\nblock = 32')
    ran = clipmap("batch", tmp_path / "jobs.toml", "-o", tmp_path / "out")
    assert ran.code == 0
    assert "east.tif and 1 more" in ran.out
    assert open_dataset(tmp_path / "out/both").manifest.layers["imagery"].width == 128


def test_jobs_stay_within_the_memory(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With room for one and a half, jobs run alone, though two processes are allowed."""
    most: list[int] = []
    begin = batch._Batch._begin

    def watch(self: batch._Batch, number: int) -> bool:
        begun = begin(self, number)
        most.append(len(self._running))
        return begun

    monkeypatch.setattr(batch._Batch, "_begin", watch)
    jobs = [Job((scenes / "first.tif",), str(tmp_path / str(number)), settings()) for number in range(3)]
    for limit, together in ((None, 2), (PROCESS_BYTES * 3 // 2, 1)):
        most.clear()
        report = run_batch(jobs, Bounds(2, 1, limit))
        assert [job.reason for job in report.jobs] == [None] * 3
        assert max(most) == together
    report = run_batch(jobs, Bounds(2, None, 10 << 20))
    assert all("more than the 10 MiB that the batch may use" in (job.reason or "") for job in report.jobs)


def test_the_largest_job_begins_first(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    begin = batch._Batch._begin

    def watch(self: batch._Batch, number: int) -> bool:
        done = begin(self, number)
        begun.extend([number] * done)
        return done

    monkeypatch.setattr(batch._Batch, "_begin", watch)
    jobs = [Job((scenes / f"{name}.tif",), str(tmp_path / name), settings()) for name in ("second", "first", "terrain")]
    assert [job.outcome for job in run_batch(jobs, Bounds(1, 1, None)).jobs] == ["built"] * 3
    assert begun == [1, 2, 0]


def test_mistakes_are_told_before_anything_runs(scenes: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    for arguments, code, match in (
        ([scenes / "*.jp2"], 3, "no file has such a name"),
        ([scenes], 2, "is a folder; name its files"),
        ([scenes / "first.tif", "--block", "0"], 1, "block side 0"),
        ([scenes / "first.tif", "--pad", "-1"], 2, "--pad: "),
        ([scenes / "first.tif", "--memory", "lots"], 2, "a size like 4G"),
    ):
        ran = clipmap("batch", *arguments, "-o", tmp_path / "out")
        assert ran.code == code
        assert match in ran.err + ran.out
        assert "Traceback" not in ran.err
        assert not (tmp_path / "out").exists()


class Started:
    """A batch in a process and a session of its own."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", RUN, "batch", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def workers(self) -> list[int]:
        """Processes of jobs that live, by their session, whoever is their parent by now."""
        found = []
        for folder in Path("/proc").iterdir():
            try:
                words = (folder / "stat").read_text().rpartition(")")[2].split() if folder.name.isdecimal() else []
            except OSError:
                continue
            if words and int(words[3]) == self.process.pid != int(folder.name) and words[0] != "Z":
                found.append(int(folder.name))
        return sorted(found)

    def wait_until(self, there: Callable[[], bool]) -> None:
        end = time.monotonic() + DEADLINE_S
        while not there():
            assert time.monotonic() < end, "it took too long"
            time.sleep(0.01)


@pytest.fixture
def start() -> Iterator[Callable[..., Started]]:
    """Start batches; what a test leaves over is killed."""
    started: list[Started] = []

    def begin(*arguments: object) -> Started:
        started.append(Started(*arguments))
        return started[-1]

    yield begin
    for each in started:
        left = each.workers()
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        if each.process.poll() is None:
            each.process.kill()
        each.process.communicate()
        assert not left, "a process of a job was left over"


def records(folder: Path) -> int:
    return len(list(folder.glob("*/imagery/tasks/0/*/*.json")))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_keeps_what_is_finished(number: int, code: int, large: Path, start: Callable[..., Started]) -> None:
    arguments = (large / "large*.tif", "-o", large / "out", *LARGE_OPTIONS)
    batch = start(*arguments)
    batch.wait_until(lambda: records(large / "out") >= 6)
    # From a terminal the interrupt reaches all processes, a termination only the one that is named.
    (os.killpg if number == signal.SIGINT else os.kill)(batch.process.pid, number)
    out, err = batch.process.communicate()
    assert (batch.process.returncode, out) == (code, "")
    assert "Traceback" not in err
    assert re.search(r"large[12]\.tif: \d+ of 342 tasks are finished and kept", err)
    assert "0 of 2 jobs are done; the same command does the rest" in err
    batch.wait_until(lambda: not batch.workers())
    assert not list(large.rglob(".tmp-*"))
    kept = records(large / "out")
    again = start(*arguments, "--json")
    report = json.loads(again.process.communicate()[0])
    assert "continued" in {job["outcome"] for job in report["jobs"]} <= {"continued", "built"}
    assert sum(job["tasks_kept"] for job in report["jobs"]) >= kept


def test_jobs_end_with_a_batch_that_is_killed(large: Path, start: Callable[..., Started]) -> None:
    batch = start(large / "large*.tif", "-o", large / "out", *LARGE_OPTIONS)
    batch.wait_until(lambda: records(large / "out") >= 4)
    assert batch.workers()
    batch.process.kill()
    batch.process.communicate()
    batch.wait_until(lambda: not batch.workers())
    assert not list(large.rglob("manifest.json"))


def test_a_job_whose_process_dies_fails_alone(large: Path, start: Callable[..., Started]) -> None:
    write_tiff(large / "third.tif", photo(64, 64))
    arguments = (large / "*.tif", "-o", large / "out", *LARGE_OPTIONS)
    batch = start(*arguments, "--jobs", "2", "--json")
    batch.wait_until(lambda: records(large / "out") >= 8)
    os.kill(batch.workers()[0], signal.SIGKILL)
    report = json.loads(batch.process.communicate()[0])
    assert batch.process.returncode == 1
    assert sorted(job["outcome"] for job in report["jobs"]) == ["built", "built", "failed"]
    dead = next(job for job in report["jobs"] if job["outcome"] == "failed")
    assert "its process was killed" in dead["reason"]
    again = json.loads(start(*arguments, "--json").process.communicate()[0])
    assert sorted(job["outcome"] for job in again["jobs"]) == ["continued", "up to date", "up to date"]


def test_a_process_that_dies_without_work_is_replaced(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build = batch._Batch.build

    def strike(self: batch._Batch) -> None:
        for process in self._idle:
            os.kill(process.pid, signal.SIGKILL)
            assert wait([process.connection], DEADLINE_S)
        build(self)

    monkeypatch.setattr(batch._Batch, "build", strike)
    report = run_batch([Job((scenes / "first.tif",), str(tmp_path / "out"), settings())], Bounds(1, 1, None))
    assert [(job.outcome, job.reason) for job in report.jobs] == [("built", None)]


def test_deaths_are_explained() -> None:
    assert "no memory left" in explain_death(-9)
    assert "SIGSEGV" in explain_death(-11)
    assert "exit status 3" in explain_death(3)


def test_real_files(data_dir: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    """Whatever is wrong with a file is told in a sentence, and the others are built."""
    ran = clipmap("batch", data_dir / "nasty/*", data_dir / "imagery/*.tif", "-o", tmp_path / "out")
    assert ran.code == 1
    assert "Traceback" not in ran.out + ran.err
    assert "12 jobs in" in ran.out.splitlines()[-1]
    assert ": 6 failed, 6 built" in ran.out.splitlines()[-1]
    assert sum(line.startswith("failed: ") for line in ran.out.splitlines()) == 6
