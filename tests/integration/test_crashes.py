"""``kill -9`` at any moment, a full disk, a source that goes away: nothing that was finished is lost, nothing half-done is seen."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.errors import InputError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.verify import verify
from tiler.stores.dataset import open_dataset

OPTIONS = {"codec": "png", "block": 32, "task": 128, "pad": 1}


def crash(
    source: Path,
    output: Path,
    kills: int,
    seed: int,
    *,
    finish: bool,
    most_writes: int,
    at_least: int = 1,
    processes: bool = False,
    **options: Any,
) -> int:
    """Build in processes that are killed, tasks in ``processes`` of theirs; returns how many builds were killed."""
    job = {
        "source": str(source),
        "output": str(output),
        "settings": {**OPTIONS, **options},
        "kills": kills,
        "seed": seed,
        "finish": finish,
        "writes": (at_least, most_writes),
        "processes": processes,
    }
    program = [sys.executable, "-m", "tests.integration.crashes"]
    # NumPy's linear algebra would start threads, and a process with threads is not copied.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(program, input=json.dumps(job), capture_output=True, text=True, timeout=300, check=False, env=environment)
    assert ended.returncode == 0, ended.stderr
    return int(ended.stdout)


@pytest.mark.parametrize(("processes", "kills"), [(False, 19), (True, 7)])
def test_many_kills(processes: bool, kills: int, tmp_path: Path) -> None:
    """At random writes, before or after them: the build that is left to end does the rest, and makes what an undisturbed one makes."""
    source = write_tiff(tmp_path / "photo.tif", photo(900, 700))
    whole = build_layer(source, tmp_path / "whole", settings(**OPTIONS))
    out = tmp_path / "out"
    assert crash(source, out, kills, seed=1, finish=False, most_writes=60, processes=processes) == kills
    with pytest.raises(NotFoundError, match="its build has not finished"):
        open_dataset(out)
    assert crash(source, out, 1, seed=2, finish=False, most_writes=60, processes=processes) == 1
    report = build_layer(source, out, settings(**OPTIONS))
    assert report.outcome == "continued"
    assert report.tasks_kept > 0
    assert report.blocks_written < whole.blocks_written
    assert tree_digest(out) == tree_digest(tmp_path / "whole")
    assert sorted(path.name for path in out.iterdir()) == ["imagery", MANIFEST_NAME]


@pytest.mark.parametrize("what", ["imagery/0/*.png", "imagery/2/*.png", "imagery/tasks/0/*/*.f32", "imagery/tasks/*/*/*.json"])
def test_files_that_a_power_cut_emptied_are_made_again(what: str, tmp_path: Path) -> None:
    """A file system may keep a file's name and lose its content: a finished task counts only if its blocks have their digests."""
    source, out = write_tiff(tmp_path / "photo.tif", photo(900, 700)), tmp_path / "out"
    assert crash(source, out, 1, seed=7, finish=False, most_writes=931, at_least=930) == 1
    victims = sorted(out.glob(what))[::3]
    assert victims
    for path in victims:
        path.write_bytes(bytes(path.stat().st_size if path.suffix == ".f32" else 0))
    assert build_layer(source, out, settings(**OPTIONS)).outcome == "continued"
    build_layer(source, tmp_path / "whole", settings(**OPTIONS))
    assert tree_digest(out) == tree_digest(tmp_path / "whole")
    assert verify(open_dataset(out)).findings == []


@pytest.mark.parametrize("seed", range(4))
def test_kills_at_the_end(seed: int, tmp_path: Path) -> None:
    """Around the manifest and the deletions after it, of a rebuild in place of another version."""
    source = write_tiff(tmp_path / "photo.tif", photo(200, 180))
    build_layer(source, tmp_path / "fresh", settings(**OPTIONS, radius=2))
    out = tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    assert crash(source, out, 6, seed, finish=True, most_writes=110, overwrite=True, radius=2) > 0
    assert verify(open_dataset(out)).findings == []
    assert len(list(out.iterdir())) == 2
    layer = open_dataset(out).manifest.layer("imagery")
    assert tree_digest(out / layer.path) == tree_digest(tmp_path / "fresh/imagery")


@pytest.mark.parametrize("seed", range(4))
def test_kills_of_an_update(seed: int, tmp_path: Path) -> None:
    """Readers have the old version until they have the new one; what was superseded is deleted in the end."""
    pixels = photo(500, 400)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    for turn in range(2):
        pixels[100 + 90 * turn : 260 + 90 * turn, 100:260] ^= 0x33
        write_tiff(source, pixels)
        os.utime(source, (turn, turn))
        assert crash(source, out, 4, 10 * seed + turn, finish=False, most_writes=60, update=True) > 0
        findings = verify(open_dataset(out)).findings
        assert {found.kind for found in findings} <= {"stray"}, "the old version or the new one, and what was not yet deleted"
        crash(source, out, 0, seed, finish=True, most_writes=2, update=True)
        assert verify(open_dataset(out)).findings == []
    build_layer(source, tmp_path / "full", settings(**OPTIONS))
    dataset, full = open_dataset(out), open_dataset(tmp_path / "full")
    for level in range(5):
        assert dataset.index("imagery", level).data == full.index("imagery", level).data
    assert not (out / ".clipmap-lock").exists()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(place)], capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("mounting a file system needs root and the right to mount")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_full_disk_keeps_what_is_finished(small_disk: Path, tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(900, 700))
    out = small_disk / "out"
    for _ in range(2):
        with pytest.raises(StorageError, match=r"out/.*: cannot be written: No space left on device") as failure:
            build_layer(source, out, settings(**OPTIONS))
        assert "tasks are finished and kept" in failure.value.__notes__[0]
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    report = build_layer(source, out, settings(**OPTIONS))
    assert report.outcome == "continued"
    assert report.tasks_kept > 0
    build_layer(source, tmp_path / "whole", settings(**OPTIONS))
    assert tree_digest(out) == tree_digest(tmp_path / "whole")


def test_a_source_that_vanishes_is_named(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(900, 700))
    data = source.read_bytes()

    def vanish(done: int, total: int) -> None:
        if done == total // 2:
            source.unlink()

    with pytest.raises(InputError, match=r"photo\.tif: (is gone|no such file|cannot be)") as failure:
        build_layer(source, tmp_path / "out", settings(**OPTIONS, workers=1), vanish)
    assert "tasks are finished and kept" in failure.value.__notes__[0]
    source.write_bytes(data)
    report = build_layer(source, tmp_path / "out", settings(**OPTIONS))
    assert (report.outcome, report.tasks_kept > 0) == ("continued", True)
    assert verify(open_dataset(tmp_path / "out")).findings == []
