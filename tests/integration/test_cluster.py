"""Builds on a real Dask cluster on loopback: a scheduler and worker processes of their own, and workers and builds that are killed."""

import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import tiler.cluster.engine
from schemas.errors import InputError, MissingExtraError, StorageError, UsageError
from tests.integration.dask_cluster import Cluster, two_workers, wait_until
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.cluster.engine import DaskEngine
from tiler.stores.dataset import open_dataset
from tiler.tasks.worker import Done, TaskWorker, Work

if TYPE_CHECKING:
    from tests.s3 import S3Server

pytest.importorskip("distributed", reason="the extra 'dask' is not installed: pip install 'clipmap[dev]'")

BUILD = [sys.executable, "-c", "from cli.main import main; main()", "build"]
OPTIONS = {"codec": "png", "task": 64, "pad": 1}
FLAGS = ["--codec", "png", "--task", "64", "--pad", "1", "--block", "32"]
TASKS = 256 + 64 + 16 + 4 + 1 + 1
"""Of 1024 x 1024 samples in blocks of 32 and tasks of 64: a level a task."""


def records(out: Path) -> int:
    return len(list(out.glob("imagery/tasks/*/*/*.json")))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Cluster]:
    with two_workers(tmp_path_factory.mktemp("cluster"), request) as running:
        yield running


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiff(tmp_path_factory.mktemp("source") / "photo.tif", photo(1024, 1024, seed=8))


@pytest.fixture(scope="module")
def local(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a build on this machine's threads makes of the source."""
    out = tmp_path_factory.mktemp("local") / "out"
    build_layer(source, out, settings(**OPTIONS))
    return out


class WatchedEngine(DaskEngine):
    """Notes how far what is submitted runs ahead of what is finished."""

    ahead = 0

    def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
        taken = finished = 0

        def counted() -> Iterator[Work]:
            nonlocal taken
            for work in works:
                taken += 1
                self.ahead = max(self.ahead, taken - finished)
                yield work

        for done in super().run(worker, counted()):
            finished += 1
            yield done


def test_the_cluster_makes_the_same_bytes(cluster: Cluster, source: Path, local: Path, tmp_path: Path) -> None:
    """With back-pressure, progress, nothing left over, and a scheduler that has not loaded clipmap."""
    import distributed

    out, progress = tmp_path / "out", list[tuple[int, int]]()
    with WatchedEngine(cluster.address) as engine:
        report = build_layer(source, out, settings(**OPTIONS), lambda done, total: progress.append((done, total)), engine)
    assert (report.outcome, report.tasks, report.tasks_kept) == ("built", TASKS, 0)
    assert tree_digest(out) == tree_digest(local)
    assert [done for done, _ in progress] == sorted({done for done, _ in progress})
    assert progress[-1] == (1365, 1365)
    assert 2 <= engine.ahead <= 4
    assert not list(out.glob("**/tasks/job"))
    with distributed.Client(cluster.address, set_as_default=False) as client:
        assert client.run_on_scheduler(lambda: __import__("sys").modules.get("tiler") is None)


def test_the_command_says_only_our_words(
    cluster: Cluster, source: Path, local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with relative paths, which mean nothing to a worker that was started elsewhere."""
    monkeypatch.chdir(tmp_path)
    given = os.path.relpath(source)
    done = subprocess.run(
        [*BUILD, given, "-o", "out", *FLAGS, "--engine", "dask", "--scheduler", cluster.address],
        check=False,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "PYTHONWARNINGS": "default"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert re.match(r"layer +imagery in out, built\n", done.stdout)
    assert tree_digest(tmp_path / "out") == tree_digest(local)


def test_update_on_the_cluster(cluster: Cluster, tmp_path: Path) -> None:
    pixels = photo(500, 600)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    pixels[410:430, 130:160] += 77
    write_tiff(source, pixels)
    with DaskEngine(cluster.address) as engine:
        report = build_layer(source, out, settings(update=True, **OPTIONS), engine=engine)
        again = build_layer(source, out, settings(update=True, **OPTIONS), engine=engine)
        assert build_layer(source, tmp_path / "full", settings(stretch=None, **OPTIONS), engine=engine).outcome == "built"
    assert report.outcome == "updated"
    assert report.tasks / 2 < report.tasks_kept < report.tasks
    assert again.outcome == "up to date"
    updated, full = open_dataset(out), open_dataset(tmp_path / "full")
    lattice = full.manifest.layer("imagery").lattice
    for level in range(lattice.levels):
        for address in lattice.addresses(level):
            assert updated.block("imagery", address) == full.block("imagery", address)
    assert sorted(path.name for path in out.iterdir()) == ["imagery", "imagery.2", "manifest.json"]
    assert not list(out.glob("imagery.2/tasks*"))


def test_what_was_found_out_is_not_found_out_again_by_workers(cluster: Cluster, tmp_path: Path) -> None:
    """A stretch, of which a worker sees only a part of the samples, and a nodata value that JSON does not have."""
    source = write_tiff(tmp_path / "photo.tif", photo(300, 300).astype("uint16") * 7, nodata=0)
    options = {**OPTIONS, "stretch": "2%", "nodata": float("nan")}
    build_layer(source, tmp_path / "here", settings(**options))
    with DaskEngine(cluster.address) as engine:
        build_layer(source, tmp_path / "there", settings(**options), engine=engine)
    assert tree_digest(tmp_path / "here") == tree_digest(tmp_path / "there")


def test_a_killed_worker_is_replaced(cluster: Cluster, source: Path, local: Path, tmp_path: Path) -> None:
    """Two are killed in mid-build and another one joins: nothing is lost, nothing half-written is left, and it is said."""
    out, notices = tmp_path / "out", list[str]()
    first, second = cluster.workers[-2:]

    def kill() -> None:
        wait_until(lambda: records(out) > 20)
        first.kill()
        cluster.add_worker()
        wait_until(lambda: records(out) > 100)
        cluster.add_worker()
        second.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    with DaskEngine(cluster.address, notices.append) as engine:
        report = build_layer(source, out, settings(**OPTIONS), engine=engine)
    killer.join()
    assert (report.outcome, report.tasks) == ("built", TASKS)
    assert tree_digest(out) == tree_digest(local)
    assert not list(out.rglob(".tmp-*"))
    assert any(re.search(r"[12] workers have left tcp://.* meanwhile", notice) for notice in notices)


def killed(arguments: list[str], number: int, out: Path, after: int) -> tuple[int, str]:
    """Run a build, send it a signal when it has more than ``after`` task records; returns its exit code and what it said."""
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: records(out) > after)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors.strip()


def test_a_killed_build_goes_on(cluster: Cluster, source: Path, local: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = [*BUILD, str(source), "-o", str(out), *FLAGS, "--engine", "dask", "--scheduler", cluster.address]
    assert killed(arguments, signal.SIGKILL, out, after=30) == (-9, "")
    rerun = subprocess.run(arguments, check=True, capture_output=True, text=True)
    kept = re.search(rf"continued: (\d+) of {TASKS} tasks were finished", rerun.stdout)
    assert kept is not None
    assert 30 <= int(kept[1]) < TASKS
    assert tree_digest(out) == tree_digest(local)
    assert not list(out.glob("**/tasks/job"))


def test_an_interrupted_build_leaves_nothing_under_way(cluster: Cluster, source: Path, local: Path, tmp_path: Path) -> None:
    """Tasks are larger here, so that one that goes on behind the back of the build would be seen."""
    out = tmp_path / "out"
    arguments = [*BUILD, str(source), "-o", str(out), *FLAGS, "--engine", "dask", "--scheduler", cluster.address]
    arguments[arguments.index("--task") + 1] = "256"
    code, errors = killed(arguments, signal.SIGINT, out, after=3)
    before = records(out)
    assert code == 130
    assert re.fullmatch(rf"clipmap: interrupted\nnote: {before} of 17 tasks are finished and kept: .*", errors)
    time.sleep(0.3)
    assert records(out) == before
    assert not list(out.rglob(".tmp-*"))
    assert not list(out.glob("**/tasks/job"))
    with DaskEngine(cluster.address) as engine:
        report = build_layer(source, out, settings(**OPTIONS), engine=engine)
    assert (report.outcome, report.tasks, report.tasks_kept) == ("continued", 17, before)
    assert tree_digest(out) == tree_digest(local)


def test_an_error_on_a_worker_reaches_the_user(cluster: Cluster, tmp_path: Path) -> None:
    """As the sentence that a local build says (of the tile that was read first), and where it was said."""
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 3 // 4])
    with pytest.raises(InputError) as here:
        build_layer(source, tmp_path / "here", settings(workers=1, task=64))
    with pytest.raises(InputError) as there, DaskEngine(cluster.address) as engine:
        build_layer(source, tmp_path / "there", settings(task=64), engine=engine)
    assert re.sub(r"\d+", "0", str(there.value)) == re.sub(r"\d+", "0", str(here.value))
    place, kept = there.value.__notes__
    assert re.fullmatch(rf"the error came from worker tcp://127\.0\.0\.1:\d+ on {re.escape(os.uname().nodename)}", place)
    assert re.match(r"\d+ of 86 tasks are finished and kept", kept)


def test_a_source_that_changes_is_noticed_by_workers(cluster: Cluster, tmp_path: Path) -> None:
    """A worker that joins opens the file as it is then."""
    source = write_tiff(tmp_path / "photo.tif", photo(512, 512))

    class Meddler(DaskEngine):
        def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
            os.utime(source, (1, 1))
            return super().run(worker, works)

    with pytest.raises(InputError, match=r"photo\.tif: a worker sees another state of the file than the build does"):  # noqa: SIM117
        with Meddler(cluster.address) as engine:
            build_layer(source, tmp_path / "out", settings(), engine=engine)
    assert not (tmp_path / "out").exists()


def test_a_store_by_url(cluster: Cluster, s3: "S3Server", tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(200, 300))
    build_layer(source, tmp_path / "here", settings(**OPTIONS))
    with DaskEngine(cluster.address) as engine:
        report = build_layer(source, s3.url(tmp_path), settings(**OPTIONS), engine=engine)
    here, there = open_dataset(tmp_path / "here"), open_dataset(s3.url(tmp_path))
    assert there.manifest == here.manifest == report.manifest
    lattice = here.manifest.layer("imagery").lattice
    for address in (address for level in range(lattice.levels) for address in lattice.addresses(level)):
        assert there.block("imagery", address) == here.block("imagery", address)


def test_without_workers_the_user_is_told_and_a_lost_scheduler_is_noticed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiler.cluster.engine, "_NOTICE_S", 0.2)
    monkeypatch.setattr(tiler.cluster.engine, "_LOOK_S", 0.1)
    monkeypatch.setattr(tiler.cluster.engine, "_CONNECT_S", 3)
    lonely, notices = Cluster(tmp_path, {}), list[str]()
    try:
        with (
            pytest.raises(StorageError, match=r"tcp://.*: has had no worker for 1 s; start some with dask worker tcp"),
            DaskEngine(lonely.address, notices.append, patience_s=1) as engine,
        ):
            build_layer(source, tmp_path / "out", settings(), engine=engine)
        assert notices == [f"{lonely.address} has no worker; waiting for one to start"]
        with (
            pytest.raises(StorageError, match="the connection to the scheduler was lost"),
            DaskEngine(lonely.address, lambda sentence: lonely.scheduler.kill()) as engine,
        ):
            build_layer(source, tmp_path / "out", settings(), engine=engine)
    finally:
        lonely.stop()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["", "head", "tcp://head", "http://head:8786", "tcp://head:0", "tcp://head:65536", "tcp://a b:1"])
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(UsageError, match="is no address of a Dask scheduler; it is like tcp://head:8786"), DaskEngine(address):
        pass


@pytest.mark.parametrize("answer", [None, b"HTTP/1.0 400 Bad Request\r\n\r\n", b""])
def test_nobody_or_somebody_else_answers(answer: bytes | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """2026-11-22: of an HTTP server, such as its own dashboard, Dask's client waited for ever."""
    monkeypatch.setattr(tiler.cluster.engine, "_CONNECT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(answer or b"")

        server = threading.Thread(target=serve, daemon=True)
        if answer is None:
            listener.close()
        else:
            server.start()
        with (
            pytest.raises(StorageError, match=rf"tcp://127\.0\.0\.1:{port}: no Dask scheduler answers"),
            DaskEngine(f"tcp://127.0.0.1:{port}"),
        ):
            pass


def test_the_log_of_the_library_is_not_for_the_user(cluster: Cluster) -> None:
    """It would be written to stderr by handlers that distributed makes when it is imported."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "tornado.application")]
    for logger in loggers:
        logger.addHandler(logging.StreamHandler())
    with DaskEngine(cluster.address):
        assert not any(isinstance(handler, logging.StreamHandler) for logger in loggers for handler in logger.handlers)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'clipmap\[dask\]'"), DaskEngine("tcp://head:8786"):
        pass


@pytest.mark.parametrize("arguments", [["--engine", "dask"], ["--scheduler", "tcp://head:8786"]])
def test_options_that_need_each_other(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from cli.main import run

    assert run(["build", "photo.tif", "-o", "out", *arguments]) == 2
    assert re.fullmatch(r"clipmap: --(engine dask needs|scheduler is for) .*\n", capsys.readouterr().err)
