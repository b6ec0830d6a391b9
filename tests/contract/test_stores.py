"""The store in a directory: the contract, and what is a directory's own."""

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from schemas.errors import StorageError
from tests.contract.stores import StoreContract
from tiler.stores.claims import ClaimNote, utc_now
from tiler.stores.directory import DirectoryStore


class TestDirectoryStore(StoreContract):
    def store(self, place: Path) -> DirectoryStore:
        return DirectoryStore(place)

    def set(self, place: Path, key: str, data: bytes) -> None:
        path = place / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    def get(self, place: Path, key: str) -> bytes:
        return (place / key).read_bytes()

    def left(self, place: Path) -> list[str]:
        return sorted(path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file())

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
            assert claim.predecessor is not None
            assert claim.predecessor != ClaimNote.mine().left_by()
            claim.announce()
        assert self.left(tmp_path) == []

    def test_folders_that_were_made_go_only_if_nothing_is_in_them(self, tmp_path: Path) -> None:
        with self.store(tmp_path / "a/b/c").exclusive():
            assert (tmp_path / "a/b/c").is_dir()
        assert list(tmp_path.iterdir()) == []
        with self.store(tmp_path / "a/b/c").exclusive() as claim:
            claim.announce("height")
        assert self.left(tmp_path / "a/b/c") == [".clipmap-lock"]
        (tmp_path / "d").mkdir()
        with self.store(tmp_path / "d/e").exclusive():
            pass
        assert list((tmp_path / "d").iterdir()) == []

    def test_the_first_form_of_the_note_is_still_understood(self, tmp_path: Path) -> None:
        (tmp_path / ".clipmap-lock").write_text("clipmap build\n999999\nimagery\nlight.2\n../height\n")
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ("imagery", "light.2")
            assert claim.predecessor == "process 999999"

    def test_a_build_on_another_machine_is_named_with_it(self, tmp_path: Path) -> None:
        """On a network file system the kernels agree on the lock; the note says on which machine to look."""
        with self.store(tmp_path).exclusive():
            note = replace(ClaimNote.mine(), machine="b2", begun=utc_now() - timedelta(hours=3, minutes=12, seconds=20))
            (tmp_path / ".clipmap-lock").write_bytes(note.dump())
            said = r"on b2, for 3 h 12 min, since .* UTC\); wait until it has ended, or end it on b2: the lock goes with the process"
            with pytest.raises(StorageError, match=said), self.store(tmp_path).exclusive(break_stale=True):
                pass
            note = replace(ClaimNote.mine(), begun=utc_now() + timedelta(hours=1))
            (tmp_path / ".clipmap-lock").write_bytes(note.dump())
            with pytest.raises(StorageError, match="which is still to come by the clock of this machine"), self.store(tmp_path).exclusive():
                pass
            with pytest.raises(StorageError, match="the lock of a folder ends with its process"), self.store(tmp_path).exclusive(True):
                pass

    def test_a_lock_of_another_user_is_named(self, tmp_path: Path) -> None:
        (tmp_path / ".clipmap-lock").write_text("")
        (tmp_path / ".clipmap-lock").chmod(0o444)
        with (
            unprivileged(tmp_path) as place,
            pytest.raises(StorageError, match=r"\.clipmap-lock: cannot be written: Permission denied$"),
            self.store(place).exclusive(),
        ):
            pass

    def test_a_note_that_cannot_be_written_is_a_sentence(self, tmp_path: Path) -> None:
        with self.store(tmp_path).exclusive() as claim:
            claim.announce("height")
            with file_size_limit(0), pytest.raises(StorageError, match=r"clipmap-lock: cannot be written: File too large"):
                claim.announce("imagery")
        with self.store(tmp_path).exclusive() as claim:
            assert claim.abandoned == ("height",)


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
