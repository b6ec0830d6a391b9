"""Writes that overlap: all are made before a task counts as finished, an error is not lost, and in a directory none overlaps."""

import threading
import time
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import StorageError
from tiler.stores.directory import DirectoryStore
from tiler.tasks.overlap import TaskWrites, read_all


class SlowStore(DirectoryStore):
    """Every write takes a while; counts how many are under way, and fails for keys that begin with 'bad'."""

    def __init__(self, root: Path, location: str, slow_s: float = 0.02) -> None:
        super().__init__(root)
        self._location, self._slow_s = location, slow_s
        self.most = self.under_way = 0
        self.lock = threading.Lock()

    @property
    def location(self) -> str:
        return self._location

    def write(self, key: str, data: Any) -> None:
        with self.lock:
            self.under_way += 1
            self.most = max(self.most, self.under_way)
        time.sleep(self._slow_s)
        with self.lock:
            self.under_way -= 1
        if key.startswith("bad"):
            raise StorageError(f"{key}: refused")
        super().write(key, data)


def test_writes_to_an_object_store_overlap_and_are_all_made(tmp_path: Path) -> None:
    store = SlowStore(tmp_path, "s3://bucket/x")
    writes = TaskWrites(store)
    for number in range(40):
        writes.write(f"a/{number}", b"%d" % number)
    writes.finish()
    assert sorted(store.keys("a")) == sorted(f"a/{number}" for number in range(40))
    assert 1 < store.most <= 16
    assert store.under_way == 0


def test_writes_to_a_directory_do_not(tmp_path: Path) -> None:
    store = SlowStore(tmp_path, str(tmp_path), 0.001)
    writes = TaskWrites(store)
    for number in range(20):
        writes.write(f"a/{number}", b"x")
        assert len(store.keys("a")) == number + 1
    writes.finish()
    assert store.most == 1


@pytest.mark.parametrize("location", ["s3://bucket/x", "/folder"])
def test_an_error_is_raised_and_nothing_is_left_under_way(location: str, tmp_path: Path) -> None:
    store = SlowStore(tmp_path, location)
    writes = TaskWrites(store)

    def work() -> None:
        try:
            for key in ("a", "bad", "b", "c"):
                writes.write(key, b"x")
        finally:
            writes.finish()

    with pytest.raises(StorageError, match="bad: refused"):
        work()
    assert store.under_way == 0


@pytest.mark.parametrize("location", ["s3://bucket/x", "/folder"])
def test_reads_come_in_order(location: str, tmp_path: Path) -> None:
    store = SlowStore(tmp_path, location)
    assert read_all(store, lambda number: number * number, range(100)) == [number * number for number in range(100)]
