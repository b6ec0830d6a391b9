"""What is left when a build does not end, and what readers see while one is at work."""

import itertools
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest

from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME
from tests.integration.files import assemble, opened, settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.verify import verify
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore


def test_an_existing_layer_is_replaced_only_when_told(height_tiff: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = build_layer(height_tiff, out, settings())
    with pytest.raises(UsageError, match=r"other settings \(codec was raw, now lerc:0\.01\); add --overwrite"):
        build_layer(height_tiff, out, settings(codec="lerc"))
    second = build_layer(height_tiff, out, settings(codec="lerc", overwrite=True))
    third = build_layer(height_tiff, out, settings(overwrite=True))
    assert first.manifest.version != second.manifest.version
    assert [report.manifest.layer("height").path for report in (first, second, third)] == ["height", "height.2", "height.3"]
    assert sorted(path.name for path in out.iterdir()) == ["height.3", MANIFEST_NAME]
    build_layer(height_tiff, tmp_path / "fresh", settings())
    assert tree_digest(out / "height.3") == tree_digest(tmp_path / "fresh/height")


def test_a_reader_of_the_old_version_sees_it_until_the_new_one_is_done(height_tiff: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    build_layer(height_tiff, out, settings())
    before = assemble(open_dataset(out), "height", 0)[0]
    seen = []

    def look(done: int, total: int) -> None:
        if done == total // 2:
            seen.append(assemble(open_dataset(out), "height", 0)[0])

    build_layer(height_tiff, out, settings(overwrite=True, height_offset=100.0, workers=1), look)
    assert (seen[0] == before).all()
    assert not np.array_equal(assemble(open_dataset(out), "height", 0)[0], before)


def test_a_folder_with_other_things_is_left_alone(height_tiff: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/height").write_text("precious")
    with pytest.raises(UsageError, match="not a dataset, and not empty"):
        build_layer(height_tiff, tmp_path / "mine", settings())
    assert (tmp_path / "mine/height").read_text() == "precious"
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["height"]


def test_what_lies_beside_the_layers_is_left_alone(height_tiff: Path, tmp_path: Path) -> None:
    """2026-11-22: a folder called like a layer, and the source in it, were deleted by a build into an existing dataset."""
    out = tmp_path / "out"
    build_layer(write_tiff(tmp_path / "photo.tif", photo(64, 64)), out, settings(codec="png"))
    (out / "height").mkdir()
    (out / "height/mine.txt").write_text("precious")
    report = build_layer(height_tiff, out, settings())
    assert report.manifest.layer("height").path == "height.2"
    assert (out / "height/mine.txt").read_text() == "precious"
    inside = write_tiff(out / "height/inside.tif", photo(64, 64))
    with pytest.raises(UsageError, match="lies inside"):
        build_layer(inside, out, settings(overwrite=True, codec="png"))
    assert inside.exists()


def test_the_next_build_clears_what_a_killed_one_left(height_tiff: Path, tmp_path: Path) -> None:
    """Also if it builds another layer; and what the killed one had replaced and not got to delete."""
    out = tmp_path / "out"
    build_layer(height_tiff, out, settings())
    for folder in ("imagery", "light.2"):
        (out / folder / "0").mkdir(parents=True)
        (out / folder / "0/left.raw").write_bytes(b"x")
    (out / ".clipmap-lock").write_text("clipmap build\n999999\nimagery\nlight.2\nheight\n")
    build_layer(height_tiff, out, settings(overwrite=True))
    assert sorted(path.name for path in out.iterdir()) == ["height.2", MANIFEST_NAME]


def test_blocks_are_on_the_disk_before_the_manifest(height_tiff: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut must not leave a manifest whose blocks were still in memory, nor lose a manifest that was announced."""
    events: list[str] = []
    write, sync = DirectoryStore.write, DirectoryStore.sync

    def recorded_write(self: DirectoryStore, key: str, data: bytes) -> None:
        events.append(key.partition("/")[0])
        write(self, key, data)

    def recorded_sync(self: DirectoryStore) -> None:
        events.append("sync")
        sync(self)

    monkeypatch.setattr(DirectoryStore, "write", recorded_write)
    monkeypatch.setattr(DirectoryStore, "sync", recorded_sync)
    build_layer(height_tiff, tmp_path / "out", settings())
    assert events[-3:] == ["sync", MANIFEST_NAME, "sync"]
    assert MANIFEST_NAME not in events[:-3]


def test_an_interrupt_after_the_manifest_keeps_what_it_names(height_tiff: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2026-11-22: Ctrl-C between the manifest and the end of the build deleted the blocks that had just been published."""
    out = tmp_path / "out"
    build_layer(height_tiff, out, settings())
    sync = DirectoryStore.sync

    def interrupted(self: DirectoryStore) -> None:
        sync(self)
        if b"height.2" in (out / MANIFEST_NAME).read_bytes():
            raise KeyboardInterrupt

    monkeypatch.setattr(DirectoryStore, "sync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build_layer(height_tiff, out, settings(overwrite=True))
    monkeypatch.undo()
    assert verify(open_dataset(out)).findings == []
    assert build_layer(height_tiff, out, settings()).outcome == "up to date"
    assert sorted(path.name for path in out.iterdir()) == ["height.2", MANIFEST_NAME]


@pytest.mark.parametrize(("number", "code", "said"), [(2, 130, "interrupted"), (15, 143, "terminated"), (1, 129, "terminated")])
def test_termination_keeps_what_is_finished(number: int, code: int, said: str, tmp_path: Path) -> None:
    """Ctrl-C, a scheduler or a closed terminal: one sentence, what is kept, and the same command goes on from there."""
    source = write_tiff(tmp_path / "photo.tif", photo(1024, 1024, seed=8))
    arguments = [sys.executable, "-c", "from cli.main import main; main()", "build", str(source)]
    arguments += ["--block", "32", "--task", "64", "--codec", "png", "-o", str(tmp_path / "o")]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "o").glob("imagery/tasks/0/*/*.json"))) < 9 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    first, second = errors.strip().splitlines()
    assert first == f"clipmap: {said}"
    assert re.fullmatch(r"note: \d+ of 342 tasks are finished and kept: the same command goes on from there", second)
    assert not list((tmp_path / "o").rglob(".tmp-*"))
    rerun = subprocess.run(arguments, check=True, capture_output=True, text=True)
    assert re.search(r"layer +imagery in .*, continued: \d+ of 342 tasks were finished", rerun.stdout)
    assert "note: went on with what process " in rerun.stderr
    assert [path.name for path in (tmp_path / "o").glob(".*")] == []


def test_an_unreadable_part_of_the_source_keeps_what_is_finished(tmp_path: Path) -> None:
    """The tiles at the end of the file are cut off: noticed only when they are read, long after blocks were stored."""
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    whole = source.read_bytes()
    source.write_bytes(whole[: len(whole) * 3 // 4])
    with pytest.raises(InputError, match=r"cut\.tif") as failure:
        build_layer(source, tmp_path / "out", settings(workers=1, task=64))
    assert re.fullmatch(r"\d+ of 86 tasks are finished and kept: .*", failure.value.__notes__[0])
    with pytest.raises(NotFoundError):
        open_dataset(tmp_path / "out")
    source.write_bytes(whole)
    report = build_layer(source, tmp_path / "out", settings(workers=1, task=64))
    assert report.outcome == "continued"
    assert report.tasks_kept >= 32
    build_layer(source, tmp_path / "fresh", settings(workers=1, task=64))
    assert tree_digest(tmp_path / "out") == tree_digest(tmp_path / "fresh")


def test_a_build_that_finished_nothing_leaves_nothing(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 3 // 4])
    with pytest.raises(InputError, match=r"cut\.tif"):
        build_layer(source, tmp_path / "out", settings())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("call", ["write", "replace"])
def test_a_full_disk_is_a_sentence(call: str, height_tiff: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noticed when the bytes of a block are written, or when a record gets its name."""
    calls = itertools.count()
    original = getattr(os, call)

    def failing(*arguments: Any) -> Any:
        if next(calls) == (40 if call == "write" else 1):
            raise OSError(28, os.strerror(28))
        return original(*arguments)

    monkeypatch.setattr(os, call, failing)
    with pytest.raises(StorageError, match="No space left on device"):
        build_layer(height_tiff, tmp_path / "out", settings())
    monkeypatch.undo()
    assert not (tmp_path / "out").exists()


def test_two_builds_exclude_each_other(height_tiff: Path, tmp_path: Path) -> None:
    refused = []

    def intrude(done: int, total: int) -> None:
        if done == 1:
            with pytest.raises(StorageError, match=rf"another build is writing here \(process {os.getpid()} ") as error:
                build_layer(height_tiff, tmp_path / "out", settings())
            refused.append(error)

    build_layer(height_tiff, tmp_path / "out", settings(workers=1), intrude)
    assert len(refused) == 1
    open_dataset(tmp_path / "out")


BUILD = "import sys; from cli.main import run; sys.exit(run(sys.argv[1:]))"


def test_kill_leaves_no_dataset_that_opens_as_complete(tmp_path: Path) -> None:
    """``kill -9`` at random moments; then the same command makes the same dataset as an undisturbed build."""
    source = write_tiff(tmp_path / "photo.tif", photo(1024, 1024, seed=8))
    arguments = [sys.executable, "-c", BUILD, "build", str(source), "--block", "32", "--task", "64", "--codec", "png"]
    subprocess.run([*arguments, "-o", str(tmp_path / "whole")], check=True, capture_output=True)
    chance, killed, out = random.Random(20261122), 0, tmp_path / "killed"
    for _ in range(6):
        process = subprocess.Popen([*arguments, "-o", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        blocks = chance.randrange(1, 600)
        while process.poll() is None and len(list(out.glob("imagery/*/*.png"))) < blocks:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if (out / MANIFEST_NAME).exists():
            break
        killed += 1
        with pytest.raises(NotFoundError, match=r"not a dataset|no dataset"):
            open_dataset(out)
    assert killed, "no build was caught in the act"
    if not (out / MANIFEST_NAME).exists():
        subprocess.run([*arguments, "-o", str(out)], check=True, capture_output=True)
    assert tree_digest(out / "imagery") == tree_digest(tmp_path / "whole/imagery")
    assert (out / MANIFEST_NAME).read_bytes() == (tmp_path / "whole" / MANIFEST_NAME).read_bytes()


@pytest.mark.parametrize("layout", ["tiled", "striped"])
def test_memory_is_bounded_by_the_rows_in_flight(layout: str, tmp_path: Path) -> None:
    """8192 x 8192 RGB is 201 MB raw and 805 MB as float32; the build's peak must stay under 400 MB (striped took 450, 2026-11-22)."""
    side = 8192
    source = tmp_path / "large.tif"
    spec = OpenImageIO.ImageSpec(side, side, 3, "uint8")
    spec.attribute("compression", "none")
    tile = photo(512, 512, seed=5)
    if layout == "tiled":
        spec.tile_width = spec.tile_height = 512
    output = opened(source, spec)
    if layout == "tiled":
        for y, x in itertools.product(range(0, side, 512), range(0, side, 512)):
            assert output.write_tile(x, y, 0, tile)
    else:
        row = np.tile(tile, (1, side // 512, 1))
        for y in range(0, side, 512):
            assert output.write_scanlines(y, y + 512, 0, row)
    output.close()
    result = subprocess.run(
        [sys.executable, "-c", BUILD, "build", str(source), "-o", str(tmp_path / "out"), "--workers", "2", "--json"],
        check=True,
        capture_output=True,
        text=True,
    )
    report = json.loads(result.stdout)
    assert report["peak_rss_bytes"] < 400e6
    assert report["blocks_stored"] == 1024 + 256 + 64 + 16 + 4 + 1
