"""Rows of pixels in memory or in an unnamed file."""

import os
from pathlib import Path

import numpy as np
import pytest

from schemas.errors import StorageError
from schemas.region import Rect
from tests.contract.picture_files import content, windows
from tiler import rowfile
from tiler.rowfile import RowFile


@pytest.mark.parametrize("strip", [None, 1, 8, 33, 64, 200])
@pytest.mark.parametrize("limit", [0, 1 << 30])
def test_rowfile_windows_are_written_and_read_back(limit: int, strip: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rowfile, "_MEMORY_LIMIT_BYTES", limit)
    whole = content(3, "float32", 101, 67)
    monkeypatch.setattr(rowfile, "_PIECE_BYTES", 4000)
    monkeypatch.setattr(rowfile, "_WASTE_BYTES", 300)
    rows = RowFile(101, 67, 3, np.dtype(np.float32), tmp_path, strip)
    for y in range(0, 67, 20):
        for x in range(0, 101, 33):
            rows.write(x, y, whole[y : y + 20, x : x + 33])
    rows.write(0, 30, whole[30:40][:, ::-1][:, ::-1])
    for window in windows(101, 67):
        np.testing.assert_array_equal(rows.read(window), whole[window.y0 : window.y1, window.x0 : window.x1])
    rows.close()
    rows.close()


def test_rowfile_says_in_one_sentence_that_there_is_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rowfile, "_MEMORY_LIMIT_BYTES", 0)
    with pytest.raises(StorageError, match="no scratch file can be made there: No such file or directory"):
        RowFile(8, 8, 1, np.dtype(np.uint8), tmp_path / "missing")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    rows = RowFile(8, 8, 1, np.dtype(np.uint8), tmp_path)
    with pytest.raises(StorageError, match="shorter than what was written"):
        rows.read(Rect(0, 0, 8, 8))
    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(StorageError, match="cannot be written: No space left on device"):
        rows.write(0, 0, np.zeros((8, 8, 1), np.uint8))
    monkeypatch.setattr(os, "preadv", full)
    with pytest.raises(StorageError, match="cannot be read: No space left on device"):
        rows.read(Rect(0, 0, 8, 8))
    rows.close()
