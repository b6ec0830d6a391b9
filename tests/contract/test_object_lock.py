"""The lock of a bucket: what happens to it when builds begin at once, die, fall silent, or come back (server: ``tests/s3.py``)."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import StorageError
from tests.s3 import S3Server
from tiler.stores import claims, objectlock
from tiler.stores.claims import ClaimNote, utc_now
from tiler.stores.objectlock import LockTimes
from tiler.stores.objects import ObjectStore

LOCK = ".clipmap-lock"
QUICK = LockTimes(refresh_s=0.1, stale_s=2.0, watch_s=0.5)
"""As the real ones, some hundred times faster; the store tells times in whole seconds."""


def note_in(s3: S3Server, place: Path) -> ClaimNote:
    data = s3.get(place, LOCK)
    assert data is not None
    note = ClaimNote.parse(data)
    assert note is not None
    return note


def refusal(store: ObjectStore, break_stale: bool = False) -> str:
    with pytest.raises(StorageError) as caught, store.exclusive(break_stale):
        pass
    return str(caught.value)


@contextmanager
def build_elsewhere(s3: S3Server, place: Path, rest: str = "time.sleep(60)") -> "Iterator[subprocess.Popen[str]]":
    """A process that holds the lock, with the quick times, and has announced two prefixes."""
    program = f"""
import sys, time
from tiler.stores.objectlock import LockTimes
from tiler.stores.objects import ObjectStore
with ObjectStore({s3.url(place)!r}, LockTimes({QUICK.refresh_s}, {QUICK.stale_s}, {QUICK.watch_s})).exclusive() as claim:
    claim.announce("height.2", "height")
    print("ready", flush=True)
    {rest}
"""
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def wait_until(true: Callable[[], bool], limit_s: float = 20) -> None:
    deadline = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_killed_build_leaves_a_lock_that_is_broken_only_when_told_and_only_when_it_is_old(s3: S3Server, tmp_path: Path) -> None:
    store = ObjectStore(s3.url(tmp_path), QUICK)
    with build_elsewhere(s3, tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        who = rf"another build is writing here \(process {process.pid} of .*, for \d s, since .* UTC\); "
        assert re.search(rf"{who}its last sign of life came \d s ago: wait until it has ended$", refusal(store))
        assert refusal(store, True).endswith("wait until it has ended; --break-lock is for one that has shown none for 2 s")
        time.sleep(QUICK.stale_s + 1)
        said = (
            rf"{who}it has shown no sign of life for \d s and has probably died: make sure that it has, then build again with --break-lock$"
        )
        assert re.search(said, refusal(store))
        with store.exclusive(break_stale=True) as claim:
            assert claim.abandoned == ("height.2", "height")
            assert claim.predecessor is not None
            assert claim.predecessor.startswith(f"process {process.pid} on ")
            assert note_in(s3, tmp_path).prefixes == ("height.2", "height")
            claim.announce()
    assert s3.names(tmp_path) == []


def test_signs_of_life_keep_a_lock_young(s3: S3Server, tmp_path: Path) -> None:
    store = ObjectStore(s3.url(tmp_path), QUICK)
    with build_elsewhere(s3, tmp_path):
        time.sleep(QUICK.stale_s + 1.5)
        assert re.search(r"its last sign of life came [01] s ago: wait", refusal(store, True))
        assert (note_in(s3, tmp_path).sign_of_life or utc_now()) > (note_in(s3, tmp_path).begun or utc_now()) + timedelta(seconds=2)


def test_a_clock_that_runs_ahead_cannot_break_a_living_lock(s3: S3Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the clock of the second machine the first one is silent for an hour; while it is watched it is not."""
    store = ObjectStore(s3.url(tmp_path), QUICK)
    with build_elsewhere(s3, tmp_path):
        monkeypatch.setattr(objectlock, "utc_now", lambda: utc_now() + timedelta(hours=1))
        assert "no sign of life for 1 h 0 min" in refusal(store)
        assert re.search(r"it was silent for .*, but has just shown a sign of life: wait until it has ended$", refusal(store, True))


def test_a_clock_that_is_behind_is_explained(s3: S3Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = ObjectStore(s3.url(tmp_path), QUICK)
    with build_elsewhere(s3, tmp_path):
        behind: Callable[[], datetime] = lambda: utc_now() - timedelta(hours=5)  # noqa: E731
        monkeypatch.setattr(objectlock, "utc_now", behind)
        monkeypatch.setattr(claims, "utc_now", behind)
        for break_stale in (False, True):
            said = refusal(store, break_stale)
            assert "which is still to come by the clock of this machine); its last sign of life lies 4 h 59 min ahead" in said
            assert "set the clock right" in said


def test_a_suspended_build_that_lost_its_lock_stops(s3: S3Server, tmp_path: Path) -> None:
    """It neither takes the lock back nor removes the one of its successor."""
    store = ObjectStore(s3.url(tmp_path), QUICK)
    with build_elsewhere(s3, tmp_path, "sys.stdin.read(); claim.confirm()") as process:
        process.send_signal(signal.SIGSTOP)
        time.sleep(QUICK.stale_s + 1.1)
        with store.exclusive(break_stale=True) as claim:
            mine = note_in(s3, tmp_path).token
            process.send_signal(signal.SIGCONT)
            _, errors = process.communicate(timeout=20)
            assert process.returncode == 1
            assert re.search(
                r"StorageError: s3://.*: the lock was taken over by another build meanwhile \(process .*\); this build stops", errors
            )
            assert note_in(s3, tmp_path).token == mine
            claim.confirm()


def test_a_lock_that_somebody_deleted_is_lost(s3: S3Server, tmp_path: Path) -> None:
    """Not made anew: a build that began meanwhile may have had it, and be done."""
    with ObjectStore(s3.url(tmp_path), replace(QUICK, refresh_s=60)).exclusive() as claim:
        s3.delete(tmp_path, LOCK)
        for call in (claim.confirm, claim.announce):
            with pytest.raises(StorageError, match="the lock of this build was deleted meanwhile; this build stops"):
                call()
    assert s3.names(tmp_path) == []


def test_an_answer_that_gets_lost_is_not_a_loss_of_the_lock(s3: S3Server, tmp_path: Path) -> None:
    """The put is done, the connection breaks, the put is repeated, and fails: by our own doing."""
    store = ObjectStore(s3.url(tmp_path), replace(QUICK, refresh_s=60))
    store._objects = Forgetful(store._objects)
    with store.exclusive() as claim:
        claim.announce("height")
        claim.confirm()
        assert note_in(s3, tmp_path).prefixes == ("height",)
        claim.announce()
    assert s3.names(tmp_path) == []


class Forgetful:
    """obstore's store, but every conditional put is done twice, as by a retry whose first try had succeeded."""

    def __init__(self, objects: Any) -> None:
        self._objects = objects

    def __getattr__(self, name: str) -> Any:
        return getattr(self._objects, name)

    def put(self, name: str, data: bytes, **options: Any) -> Any:
        if self._turn():
            self._objects.put(name, data, **options)
        return self._objects.put(name, data, **options)

    _count = 0

    def _turn(self) -> bool:
        # Every second one: what comes after the look at the object succeeds at once.
        self._count += 1
        return self._count % 2 == 1


def test_why_a_build_failed_counts_more_than_that_its_lock_stays(s3: S3Server, tmp_path: Path) -> None:
    def build() -> None:
        with ObjectStore(s3.url(tmp_path), replace(QUICK, refresh_s=60)).exclusive():
            s3.delete(tmp_path, LOCK)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        build()
