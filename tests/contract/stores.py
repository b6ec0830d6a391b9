"""The contract of a store. A new store subclasses ``StoreContract`` in a few lines and gets every test."""

import os
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.errors import NotFoundError, StorageError
from tiler.stores import Store
from tiler.stores.locate import open_store

NOT_KEYS = [
    "",
    "/",
    "/a",
    "a/",
    "a//b",
    ".",
    "..",
    "../a",
    "a/..",
    "a/../b",
    "./a",
    "a/./b",
    ".tmp-1-2-a",
    "a/.tmp-x",
    ".hidden",
    "a\0b",
    "\0",
]
part = st.text("abcxyz0189_-.", min_size=1, max_size=8).filter(lambda text: not text.startswith("."))


class StoreContract:
    """Tests of any store; ``set`` and ``get`` reach the stored bytes past the store, so that it cannot vouch for itself."""

    def store(self, place: Path) -> Store:
        raise NotImplementedError

    def set(self, place: Path, key: str, data: bytes) -> None:
        raise NotImplementedError

    def get(self, place: Path, key: str) -> bytes:
        raise NotImplementedError

    def left(self, place: Path) -> list[str]:
        """Return everything that is there, hidden or not, sorted."""
        raise NotImplementedError

    def test_read(self, tmp_path: Path) -> None:
        self.set(tmp_path, "layer/0/a.png", b"old")
        store = self.store(tmp_path)
        assert store.read("layer/0/a.png") == b"old"
        self.set(tmp_path, "layer/0/a.png", b"new bytes")
        assert store.read("layer/0/a.png") == b"new bytes"

    @pytest.mark.parametrize("data", [b"", b"\0", bytes(range(256)) * 5000])
    def test_write(self, tmp_path: Path, data: bytes) -> None:
        store = self.store(tmp_path)
        store.write("layer/0/a.png", data)
        assert self.get(tmp_path, "layer/0/a.png") == store.read("layer/0/a.png") == data

    def test_write_replaces(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a", b"a longer value than the next one")
        store = self.store(tmp_path)
        store.write("a", b"short")
        assert self.get(tmp_path, "a") == b"short"
        assert store.keys("") == ["a"]

    @pytest.mark.parametrize("buffer", [bytearray, memoryview])
    def test_write_takes_any_buffer(self, tmp_path: Path, buffer: Callable[[bytes], bytes]) -> None:
        self.store(tmp_path).write("a", buffer(b"bytes"))
        assert self.get(tmp_path, "a") == b"bytes"

    def test_what_is_not_there(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a/b", b"x")
        store = self.store(tmp_path)
        for key in ("b", "a", "a/c", "a/b/c", "c/d/e"):
            with pytest.raises(NotFoundError, match=key):
                store.read(key)
        with pytest.raises(NotFoundError):
            self.store(tmp_path / "nowhere").read("a")

    @pytest.mark.parametrize("key", NOT_KEYS)
    def test_keys_are_plain_relative_paths(self, tmp_path: Path, key: str) -> None:
        place = tmp_path / "in" / "side"
        self.set(place, "a/b", b"x")
        store = self.store(place)
        with pytest.raises(NotFoundError, match="is not a key"):
            store.read(key)
        with pytest.raises(NotFoundError, match="is not a key"):
            store.write(key, b"y")
        with pytest.raises(NotFoundError, match="is not a key"):
            store.delete_prefix(key)
        if key:
            with pytest.raises(NotFoundError, match="is not a key"):
                store.keys(key)
        assert self.get(place, "a/b") == b"x"
        assert store.keys("") == ["a/b"]

    def test_keys(self, tmp_path: Path) -> None:
        keys = ["a.1/0/x", "a/0/x", "a/0/y", "a/1/x", "ab/0/x", "manifest.json"]
        for key in reversed(keys):
            self.set(tmp_path, key, b"")
        store = self.store(tmp_path)
        assert store.keys("") == sorted(keys)
        assert store.keys("a") == ["a/0/x", "a/0/y", "a/1/x"]
        assert store.keys("a/0") == ["a/0/x", "a/0/y"]
        assert store.keys("nothing") == store.keys("manifest.json") == []
        assert self.store(tmp_path / "nowhere").keys("") == []

    def test_delete_prefix(self, tmp_path: Path) -> None:
        for key in ("a/0/x", "a/1/x", "ab/0/x", "manifest.json"):
            self.set(tmp_path, key, b"kept")
        store = self.store(tmp_path)
        store.delete_prefix("a")
        store.delete_prefix("a")
        store.delete_prefix("manifest.json")
        assert store.keys("") == ["ab/0/x", "manifest.json"]
        assert self.get(tmp_path, "manifest.json") == b"kept"
        with pytest.raises(NotFoundError):
            store.read("a/0/x")
        store.write("a/0/x", b"again")
        assert self.get(tmp_path, "a/0/x") == b"again"

    def test_delete(self, tmp_path: Path) -> None:
        for key in ("a/0/x", "a/0/y", "a/1/x", "b", "b.1"):
            self.set(tmp_path, key, b"x")
        store = self.store(tmp_path)
        store.delete(iter(["a/0/x", "b", "a/0/nothing", "nothing/at/all"]))
        store.delete([])
        store.delete(["a/0/x"])
        assert store.keys("") == ["a/0/y", "a/1/x", "b.1"]
        for key in ("../b.1", "", ".b.1"):
            with pytest.raises(NotFoundError, match="is not a key"):
                store.delete(["a/1/x", key] if key else [key])

    def test_location_tells_stores_apart_and_opens_them_again(self, tmp_path: Path) -> None:
        self.set(tmp_path / "one", "a", b"x")
        location = self.store(tmp_path / "one").location
        assert str(tmp_path / "one") in location
        assert location != self.store(tmp_path / "two").location
        again = open_store(location)
        assert (again.read("a"), again.location) == (b"x", location)

    def test_scratch_is_a_folder_of_this_machine(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a", b"x")
        scratch = self.store(tmp_path).scratch
        assert scratch.is_dir()
        assert os.access(scratch, os.W_OK)

    def test_what_is_synchronised_is_still_there(self, tmp_path: Path) -> None:
        store = self.store(tmp_path)
        store.write("a", b"x")
        store.sync()
        assert self.get(tmp_path, "a") == b"x"

    # The executors that differ are the stores, and what holds for one need not be replayed on another.
    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.differing_executors], max_examples=30)
    @given(entries=st.dictionaries(st.lists(part, min_size=1, max_size=3).map("/".join), st.binary(max_size=64), max_size=8))
    def test_a_store_is_a_dictionary(self, tmp_path_factory: pytest.TempPathFactory, entries: dict[str, bytes]) -> None:
        # A path cannot be both a key and the beginning of another one.
        entries = {key: data for key, data in entries.items() if not any(other.startswith(f"{key}/") for other in entries)}
        store = self.store(tmp_path_factory.mktemp("store"))
        for key, data in entries.items():
            store.write(key, data)
        assert store.keys("") == sorted(entries)
        assert {key: store.read(key) for key in entries} == entries

    def test_a_reader_never_sees_a_part(self, tmp_path: Path) -> None:
        values = [bytes([value]) * (300_000 + 100_000 * value) for value in range(3)]
        store = self.store(tmp_path)
        store.write("a/block", values[0])
        done = threading.Event()

        def write() -> None:
            for turn in range(150):
                store.write("a/block", values[turn % 3])
            done.set()

        def read() -> set[bytes]:
            seen = set()
            while not done.is_set():
                seen.add(store.read("a/block"))
            return seen

        with ThreadPoolExecutor(3) as pool:
            readers = [pool.submit(read), pool.submit(read)]
            pool.submit(write).result()
            seen = set.union(*(reader.result() for reader in readers))
        assert seen <= set(values)
        assert len(seen) > 1, "the readers never ran beside the writer"

    def test_concurrent_writers_of_one_key(self, tmp_path: Path) -> None:
        values = [bytes([value]) * 50_000 for value in range(8)]
        store, other = self.store(tmp_path), self.store(tmp_path)
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda turn: (store, other)[turn % 2].write("a/b/block", values[turn % 8]), range(200)))
        assert self.get(tmp_path, "a/b/block") in values
        assert store.keys("") == ["a/b/block"]

    def test_concurrent_writers_of_many_keys(self, tmp_path: Path) -> None:
        keys = [f"a/{number % 7}/{number}" for number in range(300)]
        store = self.store(tmp_path)
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda key: store.write(key, key.encode()), keys))
        assert store.keys("") == sorted(keys)
        assert all(self.get(tmp_path, key) == key.encode() for key in keys)

    def test_one_build_at_a_time(self, tmp_path: Path) -> None:
        place = tmp_path / "new"
        with self.store(place).exclusive() as claim:
            assert (claim.abandoned, claim.predecessor) == ((), None)
            claim.announce("height", "height.2")
            claim.confirm()
            who = rf"process {os.getpid()} of \w+ on {os.uname().nodename}, for \d s, since 20[-\d]+ [\d:]+ UTC"
            with pytest.raises(StorageError, match=rf"another build is writing here \({who}\)"), self.store(place).exclusive():
                pass
            assert self.store(place).keys("") == []
            claim.announce()
        assert self.left(place) == []
        with self.store(place).exclusive() as claim:
            assert (claim.abandoned, claim.predecessor) == ((), None)
            self.store(place).write("a", b"x")
        assert self.left(place) == ["a"]

    def test_what_a_failed_build_announced_is_known_to_those_after_it(self, tmp_path: Path) -> None:
        """It stays known until one of them says that all is done: none of these failures may forget what the first one left."""
        with suppress(ZeroDivisionError), self.store(tmp_path).exclusive() as claim:
            claim.announce("height.2/tasks", "height")
            raise ZeroDivisionError
        assert self.left(tmp_path) == [".clipmap-lock"]
        assert self.store(tmp_path).keys("") == []
        left_by = rf"process {os.getpid()} on {os.uname().nodename}, begun 20\d\d-\d\d-\d\d \d\d:\d\d UTC"
        for error in (KeyboardInterrupt, StorageError):
            with suppress(error), self.store(tmp_path).exclusive() as claim:
                assert claim.abandoned == ("height.2/tasks", "height")
                assert claim.predecessor is not None
                assert re.fullmatch(left_by, claim.predecessor)
                raise error
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ("height.2/tasks", "height")
            claim.announce("height", "imagery")
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ("height", "imagery")
            claim.announce()
        assert self.left(tmp_path) == []

    @pytest.mark.parametrize(
        "content", ["", "1234", "clipmap build", "clipmap build\n12\n../../etc\n/\n", "\x00\xff" * 40, "{}", "[" * 60000]
    )
    def test_a_lock_of_someone_else_announces_nothing(self, content: str, tmp_path: Path) -> None:
        """2026-11-22: any file called .lock made a build take a foreign folder for its own leftovers, and delete them."""
        self.set(tmp_path, ".clipmap-lock", content.encode())
        with self.store(tmp_path).exclusive() as claim:
            assert (claim.abandoned, claim.predecessor) == ((), None)
        assert self.left(tmp_path) == []

    def test_only_one_of_many_builds_that_begin_at_once_gets_the_store(self, tmp_path: Path) -> None:
        stores = [self.store(tmp_path) for _ in range(8)]
        begin, end = threading.Barrier(8), threading.Barrier(8)

        def build(store: Store) -> bool:
            begin.wait()
            try:
                with store.exclusive() as claim:
                    end.wait(20)
                    claim.confirm()
            except StorageError as error:
                end.wait(20)
                return "is writing here" not in str(error)
            return True

        with ThreadPoolExecutor(8) as pool:
            for _ in range(3):
                assert sum(pool.map(build, stores)) == 1
                assert self.left(tmp_path) == []
