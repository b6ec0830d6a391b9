"""Where the programs write: a fresh folder for every run, and nothing deleted while anything is measured.

ext4 does not give a deleted inode away again for a minute, and looks at every such inode before it finds one that is free
(``recently_deleted`` in the kernel's ``fs/ext4/ialloc.c``). After the deletion of some thousand files it takes 0.35 ms to make a
file instead of 0.04 to 0.08, whoever makes it: a benchmark that tidies up between runs measures its own tidying.
"""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from time import sleep
from types import TracebackType
from typing import Final, Self

from tests.bench.inputs import Source, write_source

SPARE_BYTES: Final = 1 << 30
"""Left free on the disk: a full one is slow, and other people's programs fail on it."""
SETTLE_S: Final = 90
"""Waited after outputs had to be deleted to make room: longer than ext4 keeps deleted inodes back."""


@dataclass
class Room:
    """A folder for sources and outputs, made in ``place`` and deleted at the very end."""

    place: Path
    folder: Path = field(init=False)
    count: int = 0

    def __enter__(self) -> Self:
        self.folder = Path(tempfile.mkdtemp(prefix="clipmap-bench-", dir=self.place))
        (self.folder / "outputs").mkdir()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def output(self) -> Path:
        """Return a new empty folder."""
        self.count += 1
        folder = self.folder / "outputs" / f"{self.count:04}"
        folder.mkdir()
        return folder

    def source(self, source: Source) -> Path:
        """Return the file of ``source``, which is made the first time, and on the disk before anything is measured."""
        path = self.folder / source.file_name
        if not path.exists():
            self.demand(source.side**2 * source.sample_bytes, f"a source of {source.side} x {source.side}")
            write_source(path, source)
            subprocess.run(["sync", "-f", str(path)], check=True)
        return path

    def free_bytes(self) -> int:
        """Return what may still be written."""
        return shutil.disk_usage(self.folder).free - SPARE_BYTES

    def clear(self, reason: str) -> None:
        """Delete the outputs of earlier cases, if there are any, and wait until the file system has forgotten them."""
        outputs = self.folder / "outputs"
        if not any(outputs.iterdir()):
            return
        sys.stderr.write(f"{reason}: deleting earlier outputs, then waiting {SETTLE_S} s for the file system\n")
        shutil.rmtree(outputs)
        outputs.mkdir()
        subprocess.run(["sync", "-f", str(self.folder)], check=True)
        sleep(SETTLE_S)

    def demand(self, needed_bytes: int, what: str) -> None:
        """Make room for ``needed_bytes``; raises SystemExit if there is not so much."""
        if self.free_bytes() < needed_bytes:
            self.clear(what)
        if self.free_bytes() < needed_bytes:
            raise SystemExit(
                f"{self.place}: {what} needs {needed_bytes / 1e9:.1f} GB and {max(0, self.free_bytes()) / 1e9:.1f} GB can be written; "
                "choose another place with --folder, or a smaller --size"
            )


def read_through(path: Path) -> None:
    """Read a file once, so that its pages are in memory for everybody, as far as there is memory."""
    buffer = bytearray(1 << 22)
    with open(path, "rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
