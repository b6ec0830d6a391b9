"""Jobs: what another process needs to know of a build, and when it must refuse to take part."""

import json
import os
import pickle
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import ClipmapError, InputError, StorageError, UsageError
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.cluster.job import JobRef, open_job
from tiler.cluster.worker import Failed, TaskCall, leave_job, retire_jobs, run_task
from tiler.stores.directory import DirectoryStore
from tiler.tasks.engine import LocalEngine
from tiler.tasks.ledger import Ledger
from tiler.tasks.records import RecordBook
from tiler.tasks.worker import Done, TaskWorker, Work

OPTIONS = {"codec": "png", "task": 64}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_tiff(tmp_path / "photo.tif", photo(200, 300))


class Visitor:
    """Runs tasks as a cluster's worker would, in this process, after ``visit`` has looked at the job in its store."""

    def __init__(self, visit: Callable[[DirectoryStore, JobRef], None] = lambda store, ref: None) -> None:
        self._visit = visit
        self.refs: list[JobRef] = []

    def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
        assert worker.job is not None
        assert isinstance(worker.store, DirectoryStore)
        ref = worker.job.post(worker.store)
        self.refs.append(ref)
        self._visit(worker.store, ref)
        for work in works:
            outcome = pickle.loads(pickle.dumps(TaskCall(ref, work)))
            if isinstance(outcome, Failed):
                raise outcome.error
            worker.count(outcome)
            yield outcome


def test_tasks_of_a_job_are_those_of_the_build(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if both are named by relative paths, and the working folder is another one."""
    build_layer(source, tmp_path / "local", settings(**OPTIONS))
    monkeypatch.chdir(tmp_path)
    visitor = Visitor(lambda store, ref: os.chdir("/"))
    before = Path.cwd()

    class Elsewhere(Visitor):
        def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
            for done in visitor.run(worker, works):
                os.chdir(before)
                yield done
                os.chdir("/")
            os.chdir(before)

    build_layer(Path("photo.tif"), Path("out"), settings(**OPTIONS), engine=Elsewhere())
    assert tree_digest(tmp_path / "out") == tree_digest(tmp_path / "local")
    assert visitor.refs[0].location == str(tmp_path / "out")
    assert len({ref.token for ref in visitor.refs}) == 1 < len(visitor.refs)


def changed(**fields: Any) -> Callable[[dict[str, Any]], None]:
    return lambda job: job.update(fields)


def changed_record(**fields: Any) -> Callable[[dict[str, Any]], None]:
    return lambda job: job["record"].update(fields)


def changed_signature(job: dict[str, Any]) -> None:
    job["record"]["signature"]["imagecodecs"] = "2099.1"


@pytest.mark.parametrize(
    ("change", "kind", "sentence"),
    [
        (changed(token="of another build"), StorageError, "a worker sees another folder or store there than the build does"),
        (changed(version="0" * 32), StorageError, "a worker sees another version of the dataset than the build does"),
        (changed(novelty=1), UsageError, "does not understand the build; install the same version of clipmap"),
        (changed_record(stamps=["1:1"]), InputError, r"photo\.tif: a worker sees another state of the file than the build does"),
        (changed_record(stamps=["/elsewhere/photo.tif 1 1"]), InputError, "a worker sees another state of the file"),
        (changed_signature, UsageError, r"a worker would make other blocks \(imagecodecs was 2099\.1, now .* there\)"),
        (changed(sources=["/nowhere/photo.tif"]), InputError, "/nowhere/photo.tif: no such file"),
    ],
)
def test_who_would_make_other_blocks_is_refused(
    change: Callable[[dict[str, Any]], None], kind: type[ClipmapError], sentence: str, source: Path, tmp_path: Path
) -> None:
    def meddle(store: DirectoryStore, ref: JobRef) -> None:
        job = json.loads(store.read(ref.key))
        change(job)
        store.write(ref.key, json.dumps(job).encode())

    with pytest.raises(kind, match=sentence):
        build_layer(source, tmp_path / "out", settings(**OPTIONS), engine=Visitor(meddle))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b"\xff"])
def test_a_damaged_job_is_a_sentence(damage: bytes, source: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a worker does not understand the build"):
        build_layer(source, tmp_path / "out", settings(**OPTIONS), engine=Visitor(lambda store, ref: store.write(ref.key, damage)))


def test_a_store_that_is_not_shared_is_noticed(tmp_path: Path) -> None:
    """A worker whose folder of that name is another one: without this it would fill it, and nobody would ever look there."""
    with pytest.raises(StorageError, match="let all share one, under the same name"):
        open_job(JobRef(str(tmp_path / "out"), "imagery/tasks/job", "0"))
    assert not (tmp_path / "out").exists()


def test_another_version_is_noticed_before_anything_is_read() -> None:
    outcome = run_task(JobRef("/nowhere", "imagery/tasks/job", "1"), "0.0.1", b"not even a pickle")
    assert isinstance(outcome, Failed)
    assert isinstance(outcome.error, UsageError)
    assert str(outcome.error).startswith("the build runs with clipmap 0.0.1, a worker with ")
    assert outcome.worker == f"process {os.getpid()} on {os.uname().nodename}"


def test_a_job_that_has_ended_is_left(source: Path, tmp_path: Path) -> None:
    """Whether a worker knew it or not; its files are closed, and those of a later build of the same store stay open."""
    opened = len(os.listdir("/proc/self/fd"))
    outcomes = []

    class Leaver(Visitor):
        def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
            listed = list(works)
            yield from super().run(worker, listed)
            ref = self.refs[-1]
            assert retire_jobs(ref.location, ref.token) == leave_job("0") == 0
            outcomes.append(pickle.loads(pickle.dumps(TaskCall(ref, listed[0]))))
            if not listed[0].task.tier.carry:
                assert leave_job(ref.token) == 0
                outcomes.append(pickle.loads(pickle.dumps(TaskCall(ref, listed[0]))))

    build_layer(source, tmp_path / "out", settings(**OPTIONS), engine=Leaver())
    assert [outcome is None for outcome in outcomes] == [False] * (len(outcomes) - 1) + [True]
    assert len(outcomes) > 2
    assert len(os.listdir("/proc/self/fd")) == opened


def test_tasks_have_ended_before_what_is_kept_is_counted(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the build ends while a result is being noted, as by Ctrl-C: what cleans up must not have tasks running behind its back."""
    events = []

    class Watched(LocalEngine):
        def run(self, worker: TaskWorker, works: Iterable[Work]) -> Generator[Done]:
            try:
                yield from super().run(worker, works)
            finally:
                events.append("closed")

    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    def finished(self: RecordBook) -> int:
        events.append("counted")
        return 1

    monkeypatch.setattr(Ledger, "enter", interrupt)
    monkeypatch.setattr(RecordBook, "finished", finished)
    with pytest.raises(KeyboardInterrupt):
        build_layer(source, tmp_path / "out", settings(**OPTIONS), engine=Watched(2))
    assert events == ["closed", "counted"]


@pytest.mark.parametrize(("given", "expected"), [(None, []), ("65536", [(-3, 32 << 20), (-1, 64 << 20)])])
def test_freed_memory_is_kept_where_the_nanny_has_it_given_back(
    given: str | None, expected: list[tuple[int, int]], source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2026-11-22: tasks took 2.1 times as long on workers with a nanny, for every array was mapped anew."""
    calls = []

    class Library:
        def __init__(self, name: None) -> None:
            self.mallopt = lambda number, value: calls.append((number, value))

    if given is None:
        monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    else:
        monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", given)
    monkeypatch.setattr("tiler.cluster.worker.ctypes.CDLL", Library)
    build_layer(source, tmp_path / "out", settings(**OPTIONS), engine=Visitor())
    assert calls == expected
