"""Copies between stores: the same dataset, whatever happens on the way."""

import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError, UsageError
from schemas.findings import Finding
from schemas.manifest import MANIFEST_NAME, Patch, digest, pack_bitmap
from tests.integration.files import tree_digest
from tests.server.datasets import block_bytes, publish, write_dataset, write_layer
from tiler.archives.copying import copy_dataset
from tiler.checking.diff import diff
from tiler.checking.verify import Checks, verify
from tiler.stores import Store
from tiler.stores.archive import ArchiveStore
from tiler.stores.dataset import open_dataset, read_manifest
from tiler.stores.directory import DirectoryStore
from tiler.stores.locate import open_store

BLANK = BlockAddress(0, 1, 2)
PATCHED = (BlockAddress(0, 0, 0), BlockAddress(1, 2, 1))
BLOCKS = 2 * 29 - 1
FORMS = [False, True]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A dataset of two layers of 29 blocks, one of them blank, and a file of a build beside the blocks."""
    write_dataset(tmp_path / "source", blank=[BLANK])
    (tmp_path / "source/height.1/tasks").mkdir()
    (tmp_path / "source/height.1/tasks/record").write_bytes(b"of a build")
    return tmp_path / "source"


def store_at(place: Path, archive: bool) -> Store:
    return ArchiveStore(place) if archive else DirectoryStore(place)


def damages(place: Path) -> list[Finding]:
    """What is wrong with a dataset, besides the statistics, which the writer of these tests makes up."""
    found = verify(open_dataset(place), checks=Checks(decode=False)).findings
    return [finding for finding in found if finding.kind != "statistics"]


def check_same(a: Path, b: Path) -> None:
    """Assert that two places hold the same dataset and nothing else."""
    assert diff(open_dataset(a), open_dataset(b)).same
    assert damages(b) == []
    assert [path.name for path in b.iterdir() if path.name.startswith(".")] == []


def test_there_and_back(source: Path, tmp_path: Path) -> None:
    """Folder, archives, archives, folder, and single layers out of one file."""
    places = [("archive", True), ("archive2", True), ("folder", False), ("folder2", False)]
    before = source
    for name, archive in places:
        report = copy_dataset(open_dataset(before), store_at(tmp_path / name, archive), archive=archive)
        assert (report.blocks, report.kept) == (BLOCKS, 0)
        check_same(source, tmp_path / name)
        assert (tmp_path / name / MANIFEST_NAME).read_bytes() == (source / MANIFEST_NAME).read_bytes()
        before = tmp_path / name
    assert tree_digest(tmp_path / "archive") == tree_digest(tmp_path / "archive2")
    assert sorted(path.name for path in (tmp_path / "archive").iterdir()) == ["height.1.pmtiles", "imagery.1001.pmtiles", MANIFEST_NAME]
    shutil.rmtree(source / "height.1/tasks")
    assert tree_digest(tmp_path / "folder") == tree_digest(tmp_path / "folder2") == tree_digest(source)
    copy_dataset(open_dataset(tmp_path / "archive/height.1.pmtiles"), DirectoryStore(tmp_path / "alone"))
    assert tree_digest(tmp_path / "alone/height") == tree_digest(source / "height.1")


@pytest.mark.parametrize("archive", FORMS)
def test_any_number_of_workers_makes_the_same_bytes(archive: bool, source: Path, tmp_path: Path) -> None:
    done = []
    for workers in (1, 4):
        place = tmp_path / str(workers)
        copy_dataset(
            open_dataset(source), store_at(place, archive), archive=archive, workers=workers, on_progress=lambda *at: done.append(at)
        )
    assert tree_digest(tmp_path / "1") == tree_digest(tmp_path / "4")
    assert (BLOCKS, BLOCKS) in done
    assert all(0 <= number <= total == BLOCKS for number, total in done)


def test_some_layers(source: Path, tmp_path: Path) -> None:
    copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "copy"), ["imagery"])
    assert list(open_dataset(tmp_path / "copy").manifest.layers) == ["imagery"]
    assert sorted(path.name for path in (tmp_path / "copy").iterdir()) == ["imagery.1001", MANIFEST_NAME]
    with pytest.raises(NotFoundError, match="no layer 'light'"):
        copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "none"), ["light"])
    assert not (tmp_path / "none").exists()


def patched(source: Path) -> None:
    """Give the height layer a patch of two blocks, as an update does: new bytes under a path of their own, with new indexes."""
    manifest = open_dataset(source).manifest
    newer = write_layer(source.parent / "newer", "height", "height", (19, 13), seed=2, blank=[BLANK])
    levels, bitmaps = [], []
    for level in manifest.layer("height").levels:
        (source / f"height.2/{level.level}").mkdir(parents=True)
        folder = f"{level.level}/index.bin"
        index, other = bytearray((source / "height.1" / folder).read_bytes()), (source.parent / "newer/height.2" / folder).read_bytes()
        bitmap = 0
        for address in (address for address in PATCHED if address.level == level.level):
            number = newer.lattice.block_number(address)
            index[32 * number : 32 * number + 32] = other[32 * number : 32 * number + 32]
            bitmap |= 1 << number
            shutil.copy(source.parent / "newer" / newer.block_key("height", address), source / newer.block_key("height", address))
        (source / "height.2" / folder).write_bytes(index)
        size = sum(int.from_bytes(index[place + 16 : place + 20], "little") for place in range(0, len(index), 32))
        levels.append(level.model_copy(update={"index": digest(index), "stored_bytes": size}))
        count = level.columns * level.rows
        bitmaps.append(pack_bitmap(bitmap.to_bytes(-(-count // 8), "little"), count))
    layer = manifest.layer("height").model_copy(update={"levels": levels, "patches": [Patch(path="height.2", levels=bitmaps)]})
    publish(source, {**manifest.layers, "height": layer})


@pytest.mark.parametrize("archive", FORMS)
def test_of_a_layer_with_patches_the_newest_blocks_are_copied(archive: bool, source: Path, tmp_path: Path) -> None:
    patched(source)
    copy_dataset(open_dataset(source), store_at(tmp_path / "copy", archive), archive=archive)
    check_same(source, tmp_path / "copy")
    copied = open_dataset(tmp_path / "copy")
    assert copied.manifest.layer("height").patches == []
    for address in (*PATCHED, BlockAddress(0, 1, 0), BlockAddress(3, 0, 0)):
        assert copied.block("height", address) == block_bytes(2 if address in PATCHED else 1, address)


@pytest.mark.parametrize("archive", FORMS)
def test_damaged_source_blocks_stop_the_copy(archive: bool, source: Path, tmp_path: Path) -> None:
    path = source / open_dataset(source).manifest.layer("imagery").block_key("imagery", BlockAddress(0, 4, 3))
    data = path.read_bytes()
    changes: list[tuple[Callable[[], object], str]] = [
        (lambda: path.write_bytes(bytes([data[0] ^ 1]) + data[1:]), "differs from the digest in the index"),
        (lambda: path.write_bytes(data[:-1]), "bytes, the index says \\d+"),
        (path.unlink, "the file is missing"),
    ]
    for change, what in changes:
        change()
        with pytest.raises(InputError, match=rf"{path}: .*{what}, so nothing was published; ") as caught:
            copy_dataset(open_dataset(source), store_at(tmp_path / "copy", archive), archive=archive, workers=1)
        assert caught.value.__notes__ == [f"what was copied is kept in {tmp_path / 'copy'}; repeat the command to go on with it"]
        assert read_manifest(store_at(tmp_path / "copy", archive)) is None
    path.write_bytes(data)
    report = copy_dataset(open_dataset(source), store_at(tmp_path / "copy", archive), archive=archive)
    assert report.kept >= 28
    check_same(source, tmp_path / "copy")


def test_a_source_that_is_rebuilt_meanwhile_is_said_to_be(source: Path, tmp_path: Path) -> None:
    opened = open_dataset(source)
    shutil.rmtree(source)
    write_dataset(source, seed=9)
    with pytest.raises((StorageError, NotFoundError)):
        copy_dataset(opened, DirectoryStore(tmp_path / "copy"))
    assert not (tmp_path / "copy").exists()


def test_a_repeated_copy_restores_what_is_damaged(source: Path, tmp_path: Path) -> None:
    copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "copy"))
    whole = tree_digest(tmp_path / "copy")
    blocks = sorted((tmp_path / "copy").rglob("*-*"))
    for path in random.Random(1).sample(blocks, 5):
        path.write_bytes(path.read_bytes()[:-1])
    blocks[0].unlink(missing_ok=True)
    report = copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "copy"))
    assert BLOCKS - 6 <= report.kept <= BLOCKS - 5
    assert tree_digest(tmp_path / "copy") == whole
    assert copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "copy")).kept == BLOCKS


def test_a_repeated_copy_restores_an_archive(source: Path, tmp_path: Path) -> None:
    copy_dataset(open_dataset(source), ArchiveStore(tmp_path / "copy"), archive=True)
    whole = tree_digest(tmp_path / "copy")
    assert copy_dataset(open_dataset(source), ArchiveStore(tmp_path / "copy"), archive=True).archives == {}
    path = tmp_path / "copy/height.1.pmtiles"
    for place in (3, 200, 5000, path.stat().st_size - 5):
        data = bytearray(path.read_bytes())
        data[place] ^= 1
        path.write_bytes(data)
        report = copy_dataset(open_dataset(source), ArchiveStore(tmp_path / "copy"), archive=True)
        assert list(report.archives) == ["height"]
        assert tree_digest(tmp_path / "copy") == whole


@pytest.mark.parametrize("archive", FORMS)
@pytest.mark.parametrize("before", FORMS)
def test_another_dataset_is_replaced_only_when_told(before: bool, archive: bool, source: Path, tmp_path: Path) -> None:
    """And is served until the new one is complete; also when only the form is another one."""
    place = tmp_path / "copy"
    write_dataset(tmp_path / "old", seed=1000)
    copy_dataset(open_dataset(tmp_path / "old"), store_at(place, before), archive=before)
    old, tree = open_dataset(place), tree_digest(place)
    with pytest.raises(UsageError, match="another dataset is there, or the same in another form; --overwrite replaces it"):
        copy_dataset(open_dataset(source), ArchiveStore(place), archive=archive)
    assert tree_digest(place) == tree
    seen = []

    def look(done: int, total: int) -> None:
        seen.append(old.block("imagery", BlockAddress(0, 2, 2)) == block_bytes(2000, BlockAddress(0, 2, 2)))

    copy_dataset(open_dataset(source), ArchiveStore(place), archive=archive, overwrite=True, on_progress=look)
    assert seen
    assert all(seen)
    check_same(source, place)
    other = not archive
    with pytest.raises(UsageError, match="the same in another form"):
        copy_dataset(open_dataset(source), ArchiveStore(place), archive=other)
    copy_dataset(open_dataset(source), ArchiveStore(place), archive=other, overwrite=True)
    check_same(source, place)
    assert any(place.glob("*.pmtiles")) == other
    assert len(list(place.iterdir())) == 3


def test_paths_in_use_are_not_written_over(tmp_path: Path) -> None:
    """Two versions of a dataset whose layers have the same paths: what the old manifest names stays until the new one is there."""
    manifest = write_dataset(tmp_path / "a", seed=1)
    write_dataset(tmp_path / "b", seed=2)
    for name, path in (("height", "height.2"), ("imagery", "imagery.1002")):
        (tmp_path / "b" / path).rename(tmp_path / "b" / manifest.layers[name].path)
    layers = {
        name: layer.model_copy(update={"path": manifest.layers[name].path})
        for name, layer in open_dataset(tmp_path / "b").manifest.layers.items()
    }
    publish(tmp_path / "b", layers)
    copy_dataset(open_dataset(tmp_path / "a"), DirectoryStore(tmp_path / "copy"))
    copy_dataset(open_dataset(tmp_path / "b"), DirectoryStore(tmp_path / "copy"), overwrite=True)
    check_same(tmp_path / "b", tmp_path / "copy")
    assert [layer.path for layer in open_dataset(tmp_path / "copy").manifest.layers.values()] == ["height.2", "imagery.2"]
    assert sorted(path.name for path in (tmp_path / "copy").iterdir()) == ["height.2", "imagery.2", MANIFEST_NAME]


@pytest.mark.parametrize("archive", FORMS)
def test_other_things_are_left_alone(archive: bool, source: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "precious").write_text("x")
    with pytest.raises(UsageError, match=r"mine: not a dataset, and not empty \(it holds precious\)"):
        copy_dataset(open_dataset(source), store_at(mine, archive), archive=archive, overwrite=True)
    assert [path.name for path in mine.iterdir()] == ["precious"]
    for inside in (source, source / "copy", source / "../source/height.1"):
        with pytest.raises(UsageError, match="is the dataset to be copied, or lies inside it"):
            copy_dataset(open_dataset(source), store_at(inside, archive), archive=archive)
    with pytest.raises(UsageError, match="archives are written into a folder"):
        copy_dataset(open_dataset(source), DirectoryStore(tmp_path / "copy"), archive=True)


@pytest.mark.parametrize("archive", FORMS)
def test_what_a_build_left_unfinished_is_not_thrown_away(archive: bool, source: Path, tmp_path: Path) -> None:
    place = tmp_path / "copy"
    (place / "height.3/tasks").mkdir(parents=True)
    (place / "height.3/tasks/record").write_bytes(b"hours of work")
    with DirectoryStore(place).exclusive() as claim:
        claim.announce("height.3")
    with pytest.raises(UsageError, match=r"left something unfinished there \(height\.3\); finish that, or discard it with --overwrite"):
        copy_dataset(open_dataset(source), store_at(place, archive), archive=archive)
    assert (place / "height.3/tasks/record").exists()
    copy_dataset(open_dataset(source), store_at(place, archive), archive=archive, overwrite=True)
    check_same(source, place)
    assert not (place / "height.3").exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from tiler.archives.copying import copy_dataset
from tiler.stores.archive import ArchiveStore
from tiler.stores.dataset import open_dataset
source, target, archive, moment = sys.argv[1:]

def die(done, total):
    if done >= float(moment) * total:
        os.kill(os.getpid(), signal.SIGKILL)

copy_dataset(open_dataset(source), ArchiveStore(Path(target)), archive=archive == "True", on_progress=die)
"""


@pytest.mark.parametrize("archive", FORMS)
def test_killed_at_any_moment(archive: bool, tmp_path: Path) -> None:
    """Until it is complete there is nothing that opens; the next attempt goes on, and the result is that of an undisturbed copy."""
    write_dataset(tmp_path / "source", size=(100, 80))
    copy_dataset(open_dataset(tmp_path / "source"), store_at(tmp_path / "whole", archive), archive=archive)
    place = tmp_path / "copy"
    for moment in (0.2, 0.7, 1.0):
        arguments = [sys.executable, "-c", KILLED, str(tmp_path / "source"), str(place), str(archive), str(moment)]
        assert subprocess.run(arguments, check=False, timeout=120).returncode == -signal.SIGKILL
        with pytest.raises(NotFoundError, match="its build has not finished"):
            open_dataset(place)
        for path in place.glob("[a-z]*.pmtiles"):
            assert damages(path) == []
    report = copy_dataset(open_dataset(tmp_path / "source"), store_at(place, archive), archive=archive)
    assert report.kept > 0.7 * report.blocks
    assert tree_digest(place) == tree_digest(tmp_path / "whole")
    check_same(tmp_path / "source", place)


def test_an_unfinished_archive_is_none(tmp_path: Path) -> None:
    """Its first bytes are written last: whatever name it is given, no reader takes it for an archive."""
    write_dataset(tmp_path / "source", size=(120, 100))

    def stop(done: int, total: int) -> None:
        if done > total // 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        copy_dataset(open_dataset(tmp_path / "source"), ArchiveStore(tmp_path / "copy"), archive=True, on_progress=stop)
    left = tmp_path / "copy/.tmp-height.1.pmtiles"
    assert ArchiveStore(tmp_path / "copy").keys("") == []
    os.link(left, tmp_path / "renamed.pmtiles")
    with pytest.raises(InputError, match="is not a PMTiles archive"):
        open_dataset(tmp_path / "renamed.pmtiles")
    with suppress(ClipmapError):
        ArchiveStore(tmp_path / "copy").delete_prefix("height.1")
    assert not left.exists()


def test_two_copies_at_once_exclude_each_other(source: Path, tmp_path: Path) -> None:
    with DirectoryStore(tmp_path / "copy").exclusive(), pytest.raises(StorageError, match="writing here"):
        copy_dataset(open_dataset(source), open_store(tmp_path / "copy"))
