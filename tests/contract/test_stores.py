"""The contract of a store. A new store subclasses ``StoreContract`` in a few lines and gets every test."""

import errno
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.errors import NotFoundError, StorageError
from tiler.stores import Store
from tiler.stores.directory import DirectoryStore

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

    def test_location_tells_stores_apart(self, tmp_path: Path) -> None:
        assert str(tmp_path / "one") in self.store(tmp_path / "one").location

    def test_what_is_synchronised_is_still_there(self, tmp_path: Path) -> None:
        store = self.store(tmp_path)
        store.write("a", b"x")
        store.sync()
        assert self.get(tmp_path, "a") == b"x"

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
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


class TestDirectoryStore(StoreContract):
    def store(self, place: Path) -> DirectoryStore:
        return DirectoryStore(place)

    def set(self, place: Path, key: str, data: bytes) -> None:
        path = place / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    def get(self, place: Path, key: str) -> bytes:
        return (place / key).read_bytes()

    def test_nothing_is_made_before_the_first_write(self, tmp_path: Path) -> None:
        store = self.store(tmp_path / "new")
        assert store.keys("") == []
        store.delete_prefix("a")
        assert not (tmp_path / "new").exists()

    def test_hidden_files_and_folders_are_no_keys(self, tmp_path: Path) -> None:
        for name in ("a", ".tmp-12-34-b", ".lock", "c/.tmp-1-2-d", ".trash/e"):
            self.set(tmp_path, name, b"x")
        assert self.store(tmp_path).keys("") == ["a"]
        assert self.store(tmp_path).keys("c") == []

    def test_new_files_are_for_everyone_that_the_umask_allows(self, tmp_path: Path) -> None:
        before = os.umask(0o027)
        try:
            self.store(tmp_path).write("a", b"x")
        finally:
            os.umask(before)
        assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640

    def test_a_killed_writer_leaves_whole_blocks_only(self, tmp_path: Path) -> None:
        """The first writer dies at the last moment before its block is published, the others at any moment."""
        store = self.store(tmp_path)
        store.write("a/block", bytes(4_000_000))
        self.kill_writer(tmp_path, "os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)", 60)
        assert len(list((tmp_path / "a").iterdir())) == 2
        assert store.read("a/block") == bytes(4_000_000)
        for turn in range(5):
            self.kill_writer(tmp_path, "", 0.003 * turn)
            data = store.read("a/block")
            assert (len(data), len(set(data))) == (4_000_000, 1)
            assert store.keys("") == ["a/block"]
        store.write("a/block", b"x")
        assert store.read("a/block") == b"x"

    def kill_writer(self, place: Path, prelude: str, after_s: float) -> None:
        program = f"""
import os, signal
from pathlib import Path
from tiler.stores.directory import DirectoryStore
store = DirectoryStore(Path({str(place)!r}))
{prelude}
print("ready", flush=True)
for turn in range(10**9):
    store.write("a/block", bytes([turn % 5]) * 4_000_000)
"""
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "ready\n"
            with suppress(subprocess.TimeoutExpired):
                writer.wait(after_s)
            writer.kill()
            assert writer.wait() == -signal.SIGKILL

    def test_a_full_disk_is_a_sentence_and_keeps_the_old_bytes(self, tmp_path: Path) -> None:
        """The limit on file sizes stands in for the end of the disk: part of the bytes is written, then the system refuses."""
        store = self.store(tmp_path)
        store.write("a/block", b"old")
        with file_size_limit(65536), pytest.raises(StorageError, match=r"a/block: cannot be written: File too large"):
            store.write("a/block", bytes(200_000))
        assert [path.name for path in (tmp_path / "a").iterdir()] == ["block"]
        assert self.get(tmp_path, "a/block") == b"old"
        store.write("a/block", bytes(200_000))

    @pytest.mark.parametrize("call", ["open", "replace"])
    def test_any_refusal_of_the_system_is_a_sentence(self, tmp_path: Path, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        store = self.store(tmp_path)
        store.write("a", b"old")
        with monkeypatch.context() as patch:
            patch.setattr(os, call, refuse)
            with pytest.raises(StorageError, match=r"a: cannot be written: No space left on device$"):
                store.write("a", b"new")
        assert [path.name for path in tmp_path.iterdir()] == ["a"]
        assert store.read("a") == b"old"

    def test_an_unwritable_directory_is_a_sentence(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a/block", b"old")
        with unprivileged(tmp_path) as place:
            store = self.store(place)
            with pytest.raises(StorageError, match=r"a/block: cannot be written: Permission denied$"):
                store.write("a/block", b"new")
            with pytest.raises(StorageError, match=r"b/c/block: cannot be written: Permission denied$"):
                store.write("b/c/block", b"new")
            with pytest.raises(StorageError, match=r"a: cannot be deleted: Permission denied$"):
                store.delete_prefix("a")
            assert store.read("a/block") == b"old"

    def test_an_unreadable_file_is_a_sentence(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a", b"secret")
        (tmp_path / "a").chmod(0)
        with unprivileged(tmp_path) as place, pytest.raises(StorageError, match=r"a: cannot be read: Permission denied$"):
            self.store(place).read("a")

    def test_a_file_in_the_way_of_a_folder_is_a_sentence(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a", b"old")
        with pytest.raises(StorageError, match=r"a/b: cannot be written: "):
            self.store(tmp_path).write("a/b", b"new")
        (tmp_path / "c").mkdir()
        with pytest.raises(StorageError, match=r"c: cannot be written: Is a directory$"):
            self.store(tmp_path).write("c", b"new")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]

    def test_one_build_at_a_time(self, tmp_path: Path) -> None:
        place = tmp_path / "new"
        with self.store(place).exclusive() as claim:
            assert claim.abandoned == ()
            claim.announce("height")
            with (
                pytest.raises(StorageError, match=rf"another build is writing here \(process {os.getpid()}\)"),
                self.store(place).exclusive(),
            ):
                pass
            assert self.store(place).keys("") == []
        assert not place.exists()
        with self.store(place).exclusive() as claim:
            assert claim.abandoned == ()
            self.store(place).write("a", b"x")
        assert [path.name for path in place.iterdir()] == ["a"]

    def test_what_a_killed_build_announced_is_known_to_the_next(self, tmp_path: Path) -> None:
        program = f"""
import os, signal
from pathlib import Path
from tiler.stores.directory import DirectoryStore
with DirectoryStore(Path({str(tmp_path)!r})).exclusive() as claim:
    claim.announce("height.2", "height")
    os.kill(os.getpid(), signal.SIGKILL)
"""
        assert subprocess.run([sys.executable, "-c", program], check=False, timeout=60).returncode == -signal.SIGKILL
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ("height.2", "height")
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ()

    @pytest.mark.parametrize("content", ["", "1234", "clipmap build", "clipmap build\n12\n../../etc\n/\n", "\x00\xff" * 40])
    def test_a_lock_file_of_someone_else_announces_nothing(self, content: str, tmp_path: Path) -> None:
        """2026-11-22: any file called .lock made a build take a foreign folder for its own leftovers, and delete them."""
        (tmp_path / ".clipmap-lock").write_text(content)
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ()


@contextmanager
def file_size_limit(limit_bytes: int) -> Iterator[None]:
    """Make writes behind ``limit_bytes`` fail; Python ignores the signal that comes with it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def unprivileged(place: Path) -> Iterator[Path]:
    """Give a path to ``place`` that is readable but not writable, as a user whom permissions bind (root is not bound by any)."""
    folders = [place, *(path for path in place.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    user = os.geteuid()
    before = os.getcwd()
    try:
        # Relative, because the folders above belong to the user who runs the tests and may be closed to others.
        os.chdir(place)
        if user == 0:
            os.seteuid(65534)
        yield Path(".")
    finally:
        if user == 0:
            os.seteuid(0)
        os.chdir(before)
        for folder in folders:
            folder.chmod(0o755)
