"""``verify --repair``: what is damaged is named, all of it and nothing else, and made again byte for byte."""

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import StorageError
from schemas.findings import VerifyReport
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks, verify
from tiler.stores.dataset import open_dataset

OPTIONS = {"codec": "png", "task": 128, "pad": 2}


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


DAMAGES: list[Callable[[Path], None]] = [flip, truncate, Path.unlink, zero]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``photo.tif`` and the dataset ``out`` made of it."""
    folder = tmp_path_factory.mktemp("repair")
    build_layer(write_tiff(folder / "photo.tif", photo(500, 620)), folder / "out", settings(**OPTIONS))
    return folder


@pytest.fixture
def copied(built: Path, tmp_path: Path) -> Path:
    """A copy of the dataset; its source stays where it was."""
    shutil.copytree(built / "out", tmp_path / "out")
    return tmp_path / "out"


def repaired(out: Path) -> VerifyReport:
    return verify_and_repair(open_dataset(out), None, Checks(seams=True, workers=2))


@pytest.mark.parametrize("seed", range(3))
def test_twenty_damaged_blocks_are_named_and_restored(seed: int, built: Path, copied: Path) -> None:
    chance = random.Random(seed)
    victims = chance.sample(sorted(copied.glob("imagery/*/*.png")), 20)
    for number, path in enumerate(victims):
        DAMAGES[number % 4](path)
    found = verify(open_dataset(copied), checks=Checks(seams=True)).findings
    assert sorted(each.file for each in found) == sorted(path.relative_to(copied).as_posix() for path in victims)
    report = repaired(copied)
    assert (report.findings, report.notes) == ([], [])
    assert sorted(each.file for each in report.repaired) == sorted(each.file for each in found)
    assert tree_digest(copied) == tree_digest(built / "out")


def test_every_block_can_be_restored(built: Path, copied: Path) -> None:
    """Also when the task records and the samples between tiers are lost: all follows from the source."""
    for path in [*copied.glob("imagery/*/*.png"), *copied.glob("imagery/tasks/*/*/*")]:
        path.unlink()
    report = repaired(copied)
    assert (report.findings, report.notes) == ([], [])
    assert tree_digest(copied) == tree_digest(built / "out")


@pytest.mark.parametrize("damage", DAMAGES)
def test_indexes_are_restored_with_what_lies_under_them(damage: Callable[[Path], None], built: Path, copied: Path) -> None:
    for path in copied.glob("imagery/*/index.bin"):
        damage(path)
    flip(next(copied.glob("imagery/1/*.png")))
    report = repaired(copied)
    assert (report.findings, report.notes) == ([], [])
    assert {each.file for each in report.repaired} >= {f"imagery/{level}/index.bin" for level in range(5)}
    assert tree_digest(copied) == tree_digest(built / "out")


def test_blocks_of_updates_are_restored_where_they_lie(tmp_path: Path) -> None:
    pixels = photo(400, 400)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    for turn in range(2):
        pixels[turn * 200 : turn * 200 + 60, 100:160] ^= 0x55
        write_tiff(source, pixels)
        build_layer(source, out, settings(update=True, **OPTIONS))
    whole = tree_digest(out)
    for path in list(out.glob("imagery*/*/*.png"))[::2] + list(out.glob("imagery*/2/index.bin")):
        zero(path)
    report = repaired(out)
    assert (report.findings, report.notes) == ([], [])
    assert tree_digest(out) == whole


def test_a_file_of_a_blank_block_is_deleted_and_other_strays_are_left(tmp_path: Path) -> None:
    pixels = np.concatenate([photo(300, 300), np.full((300, 300, 1), 255, np.uint8)], axis=-1)
    pixels[:, 100:, 3] = 0
    out = tmp_path / "out"
    build_layer(write_tiff(tmp_path / "photo.tif", pixels), out, settings(**OPTIONS))
    layer = open_dataset(out).manifest.layer("imagery")
    blank = out / layer.block_key("imagery", BlockAddress(0, layer.levels[0].columns - 1, 0))
    stray = out / "imagery/0/notes.txt"
    for path in (blank, stray):
        assert not path.exists()
        path.write_text("mine")
    report = repaired(out)
    assert [each.file for each in report.findings] == ["imagery/0/notes.txt"]
    assert stray.read_text() == "mine"
    assert not blank.exists()


def test_a_source_that_is_gone_is_named(built: Path, tmp_path: Path) -> None:
    source = tmp_path / "photo.tif"
    shutil.copy2(built / "photo.tif", source)
    build_layer(source, tmp_path / "out", settings(**OPTIONS))
    flip(next((tmp_path / "out").glob("imagery/0/*.png")))
    source.unlink()
    report = repaired(tmp_path / "out")
    assert [each.kind for each in report.findings] == ["digest"]
    assert report.notes == [f"imagery: nothing could be restored: {source}: no such file"]


def test_a_source_that_changed_restores_what_it_did_not_change(built: Path, tmp_path: Path) -> None:
    """A block that the source gives no more is not replaced by another one: it would not go with its neighbours."""
    pixels = photo(500, 620)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    blocks = sorted(out.glob("imagery/0/*.png"))
    for path in blocks:
        flip(path)
    pixels[250:260, 300:310] ^= 0xFF
    write_tiff(source, pixels)
    report = repaired(out)
    assert 0 < len(report.findings) < 5
    assert len(report.repaired) == len(blocks) - len(report.findings)
    assert all("cannot be restored, the source gives another block now" in note for note in report.notes)
    assert build_layer(source, out, settings(update=True, **OPTIONS)).outcome == "updated"
    assert verify(open_dataset(out)).findings == []


def test_without_records_nothing_can_be_restored(built: Path, copied: Path) -> None:
    shutil.rmtree(copied / "imagery/tasks")
    flip(next(copied.glob("imagery/0/*.png")))
    report = repaired(copied)
    assert len(report.findings) == 1
    assert "no records of how the layer was built; rebuild it" in report.notes[0]


def test_an_intact_dataset_is_not_touched(copied: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copied.rglob("*") if path.is_file()}
    assert repaired(copied).repaired == []
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*") if path.is_file()} == before


def test_a_build_at_work_keeps_repair_out(copied: Path) -> None:
    dataset = open_dataset(copied)
    with dataset.store.exclusive(), pytest.raises(StorageError, match=rf"another build is writing here \(process {os.getpid()}"):
        repaired(copied)
