"""The state of source files: what counts as a change, and which windows it concerns."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import InputError
from schemas.region import Rect
from tiler.sources import FileInfo, Part
from tiler.tasks.stamps import SourceStamps, stamp_file


@pytest.fixture
def info(tmp_path: Path) -> FileInfo:
    for name in ("west.tif", "east.tif"):
        (tmp_path / name).write_bytes(b"pixels")
    whole = FileInfo(tmp_path / "west.tif", "mosaic", 20_000, 1000, 1, np.dtype(np.uint8), 12, "tiled", 1)
    return replace(
        whole, parts=(Part(tmp_path / "west.tif", Rect(0, 0, 10_000, 1000)), Part(tmp_path / "east.tif", Rect(10_000, 0, 20_000, 1000)))
    )


def test_size_and_time_of_change_count(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"pixels")
    os.utime(path, ns=(1, 1_000_000_000))
    first = stamp_file(path)
    os.utime(path, ns=(5, 1_000_000_000))
    assert stamp_file(path) == first, "reading is no change"
    os.utime(path, ns=(1, 1_000_000_001))
    assert stamp_file(path) != first
    path.write_bytes(b"other pixels")
    os.utime(path, ns=(1, 1_000_000_000))
    assert stamp_file(path) != first


def test_another_file_of_the_same_size_and_time_is_another(tmp_path: Path) -> None:
    """2026-11-22: a build of one tile was taken for that of another: all tiles of an elevation model have one size."""
    stamps = []
    for name in ("n46e010.hgt", "n46e011.hgt"):
        (tmp_path / name).write_bytes(b"heights")
        os.utime(tmp_path / name, (9, 9))
        stamps.append(stamp_file(tmp_path / name))
    assert stamps[0] != stamps[1]


@pytest.mark.parametrize("suffix", [".msk", ".aux.xml"])
def test_files_beside_the_source_count(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"pixels")
    first = stamp_file(path)
    (tmp_path / f"a.tif{suffix}").write_bytes(b"mask")
    assert stamp_file(path) != first


def test_a_window_has_the_state_of_the_files_under_it(info: FileInfo) -> None:
    before = SourceStamps(info)
    os.utime(info.parts[1].path, (1, 1))
    after = SourceStamps(info)
    assert before.of(Rect(0, 0, 9000, 1000)) == after.of(Rect(0, 0, 9000, 1000))
    assert before.of(Rect(0, 0, 9900, 1000)) != after.of(Rect(0, 0, 9900, 1000)), "what fills voids looks that far"
    assert before.of(Rect(12_000, 0, 20_000, 1000)) != after.of(Rect(12_000, 0, 20_000, 1000))


def test_a_change_meanwhile_names_the_file(info: FileInfo) -> None:
    stamps = SourceStamps(info)
    stamps.require_unchanged()
    os.utime(info.parts[1].path, (1, 1))
    with pytest.raises(InputError, match=r"east\.tif: was changed while it was read; run the same command again"):
        stamps.require_unchanged()
    info.parts[0].path.unlink()
    with pytest.raises(InputError, match=r"west\.tif: is gone, or cannot be reached any more"):
        stamps.require_unchanged()
