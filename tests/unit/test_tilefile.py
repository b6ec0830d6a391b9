"""PMTiles files from anywhere: what is damaged or hostile ends in a sentence, and takes neither memory nor time."""

import gzip
import io
import json
import os
import random
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pmtiles.tile import (
    Compression,
    Entry,
    TileType,
    deserialize_header,
    serialize_directory,
    serialize_header,
    tileid_to_zxy,
    write_varint,
    zxy_to_tileid,
)

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError
from tests.integration.memory_datasets import memory_dataset
from tests.server.datasets import block_bytes
from tiler.archives.tileids import tile_ids
from tiler.archives.writing import write_archive
from tiler.stores.archive import ArchiveFileStore
from tiler.stores.dataset import open_dataset
from tiler.stores.tilefile import TileFile

U64 = (1 << 64) - 1
Change = Callable[[dict[str, Any]], None]


@given(zoom=st.integers(0, 31), data=st.data())
@settings(max_examples=60)
@example(zoom=31, data=None)
@example(zoom=0, data=None)
def test_tile_ids_are_those_of_the_reference(zoom: int, data: Any) -> None:
    corners = [0, (1 << zoom) - 1]
    places = data.draw(st.lists(st.tuples(*[st.integers(0, (1 << zoom) - 1)] * 2), max_size=20)) if data else []
    places += [(x, y) for x in corners for y in corners]
    x, y = (np.array(column, np.uint64) for column in zip(*places, strict=True))
    ids = tile_ids(zoom, x, y).tolist()
    assert ids == [zxy_to_tileid(zoom, *place) for place in places]
    assert [tileid_to_zxy(tile_id) for tile_id in ids] == [(zoom, *place) for place in places]


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of 29 tiles; not to be changed."""
    path = tmp_path_factory.mktemp("archive") / "good.pmtiles"
    write_archive(memory_dataset((19, 13), lambda address: block_bytes(1, address)), "imagery", path)
    return path


def read_all(path: Path) -> dict[str, bytes]:
    """Open an archive and read all that is in it."""
    store = ArchiveFileStore(path)
    return {key: store.read(key) for key in store.keys("")}


def rebuilt(
    archive: Path, target: Path, *, root: bytes | None = None, metadata: bytes | None = None, header: dict[str, Any] | None = None
) -> Path:
    """Write the archive with another root directory, metadata (both inflated) or header fields; the rest is moved."""
    data = archive.read_bytes()
    fields: dict[str, Any] = dict(deserialize_header(data[:127]))
    parts = {
        name: data[fields[f"{name}_offset"] :][: fields[f"{name}_length"]] for name in ("root", "metadata", "leaf_directory", "tile_data")
    }
    parts["root"] = parts["root"] if root is None else gzip.compress(root)
    parts["metadata"] = parts["metadata"] if metadata is None else gzip.compress(metadata)
    end = 127
    for name, part in parts.items():
        fields[f"{name}_offset"], fields[f"{name}_length"] = end, len(part)
        end += len(part)
    target.write_bytes(serialize_header(fields | (header or {})) + b"".join(parts.values()))
    return target


def packed(*numbers: int) -> bytes:
    """The numbers as a directory has them, uncompressed."""
    stream = io.BytesIO()
    for number in numbers:
        write_varint(stream, number)
    return stream.getvalue()


def metadata_of(archive: Path) -> dict[str, Any]:
    data = archive.read_bytes()
    header = deserialize_header(data[:127])
    found: dict[str, Any] = json.loads(gzip.decompress(data[header["metadata_offset"] :][: header["metadata_length"]]))
    return found


def test_the_good_one_is_read(archive: Path, tmp_path: Path) -> None:
    assert len(read_all(archive)) == 29 + 4 + 1
    assert read_all(rebuilt(archive, tmp_path / "same.pmtiles")) == read_all(archive)


@pytest.mark.parametrize(
    ("header", "what"),
    [
        ({"root_offset": U64}, "root directory ends beyond"),
        ({"root_length": 16384}, "root directory ends beyond"),
        ({"root_length": 0}, "directory is cut off"),
        ({"metadata_offset": U64, "metadata_length": 1}, "it ends at byte"),
        ({"metadata_length": U64}, "metadata is said to have 18446744073709551615 bytes"),
        ({"metadata_length": 1 << 24}, "it ends at byte"),
        ({"metadata_length": 20}, "metadata is cut off"),
        ({"tile_data_offset": U64}, "block index of level 0 would need"),
        ({"tile_data_length": 0}, "beyond its section of tile data"),
        ({"internal_compression": Compression.BROTLI}, "not packed with gzip"),
        ({"internal_compression": Compression.NONE}, "its metadata is not JSON"),
    ],
)
def test_headers_that_lie(header: dict[str, Any], what: str, archive: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"bad\.pmtiles: .*{what}"):
        read_all(rebuilt(archive, tmp_path / "bad.pmtiles", header=header))


@pytest.mark.parametrize(
    ("root", "what"),
    [
        (b"", "0 entries"),
        (packed(0), "0 entries"),
        (packed(1 << 60), "1152921504606846976 entries in 1 numbers"),
        (packed(1, 0, 1, 9), "1 entries in 4 numbers"),
        (packed(2, 0, 0, 1, 1, 9, 9, 1, 1), "a tile is listed twice"),
        (packed(1, 0, 1, 0, 1), "an entry has no bytes"),
        (packed(1, 0, 1, 9, 0), "the first entry has no offset"),
        (packed(1, 0, 1, U64, U64), "beyond its section of tile data"),
        (packed(2, 0, 1, 1, 1, U64, 9, U64, 0), "makes no sense"),
        (packed(1, 1 << 70, 1, 9, 1), "more than 64 bits"),
        (packed(2, U64, 1, 1, 1, 9, 9, 1, 1), "makes no sense"),
        (b"\xff" * 8_000_000, "more than 64 bits"),
        (packed(1, 0, 1, 9, 1)[:-1] + b"\x80", "ends within a number"),
        (packed(1, 0, U64, 9, 1), "lies outside the layer"),
        (packed(1, 1 << 63, 1, 9, 1), "lies outside the layer"),
        (packed(1, zxy_to_tileid(3, 5, 0), 1, 9, 1), "lies outside the layer"),
    ],
)
def test_directories_that_lie(root: bytes, what: str, archive: Path, tmp_path: Path) -> None:
    path = rebuilt(archive, tmp_path / "bad.pmtiles", root=root)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=rf"bad\.pmtiles: .*{what}"):
            read_all(path)
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()


def test_directories_that_point_to_themselves(archive: Path, tmp_path: Path) -> None:
    """A leaf pointer whose leaf is the root directory itself."""
    path = rebuilt(archive, tmp_path / "bad.pmtiles", root=packed(1, 0, 0, 40, 1))
    header = deserialize_header(path.read_bytes()[:127])
    root = gzip.compress(packed(1, 0, 0, header["root_length"], 1))
    assert len(root) == header["root_length"]
    path = rebuilt(archive, path, root=packed(1, 0, 0, header["root_length"], 1), header={"leaf_directory_offset": 127})
    with pytest.raises(InputError, match="nested more than 4 deep"):
        TileFile(path).tile(BlockAddress(0, 0, 0))
    assert len(ArchiveFileStore(path).keys("")) == 5


@pytest.mark.parametrize(
    ("path", "value", "what"),
    [
        (["clipmap"], None, "not of a clipmap layer"),
        (["clipmap", "manifest"], None, "not a clipmap manifest"),
        (["clipmap", "manifest", "format_version"], 99, "format version 99 is newer"),
        (["clipmap", "manifest", "layers", "imagery", "width"], 20, "levels do not fit a lattice"),
        (["clipmap", "manifest", "layers"], {}, r"bad\.pmtiles: layers"),
        (["clipmap", "indexes"], 5, "does not say where the block index"),
        (["clipmap", "indexes"], [1, 2, 3], "does not say where the block index"),
        (["clipmap", "indexes", 1], -1, "does not say where the block index"),
        (["clipmap", "indexes", 1], True, "does not say where the block index"),
        (["clipmap", "indexes", 0], 1 << 70, "block index of level 0 would need"),
    ],
)
def test_metadata_that_lies(path: list[Any], value: object, what: str, archive: Path, tmp_path: Path) -> None:
    content: Any = metadata_of(archive)
    part = content
    for step in path[:-1]:
        part = part[step]
    part[path[-1]] = value
    with pytest.raises(InputError, match=what):
        open_dataset(rebuilt(archive, tmp_path / "bad.pmtiles", metadata=json.dumps(content).encode()))


@pytest.mark.parametrize(("data", "what"), [(b"{", "is not JSON"), (b"[" * 1_000_000, "is not JSON"), (b"[]", "not of a clipmap layer")])
def test_metadata_of_another_kind(data: bytes, what: str, archive: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=what):
        open_dataset(rebuilt(archive, tmp_path / "bad.pmtiles", metadata=data))


def test_leaf_directories_that_would_fill_the_memory(archive: Path, tmp_path: Path) -> None:
    bomb = gzip.compress(bytes(300_000_000))
    path = rebuilt(archive, tmp_path / "bad.pmtiles", root=packed(1, 0, 0, len(bomb), 1))
    header = {"leaf_directory_offset": path.stat().st_size}
    path = rebuilt(archive, path, root=packed(1, 0, 0, len(bomb), 1), header=header)
    path.write_bytes(path.read_bytes() + bomb)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="directory unpacks to more than 16777216 bytes"):
            read_all(path)
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()


def test_metadata_that_would_fill_the_memory(archive: Path, tmp_path: Path) -> None:
    path = rebuilt(archive, tmp_path / "bad.pmtiles", metadata=bytes(300_000_000))
    with pytest.raises(InputError, match="metadata unpacks to more than 16777216 bytes"):
        TileFile(path)


@pytest.mark.parametrize("data", [b"", b"PMTiles\x03", b"PMTiles\x02" + bytes(200), b"PM\x02" + bytes(200), bytes(200), b"\xff" * 200])
def test_what_is_no_archive(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.pmtiles").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.pmtiles: (has \d+ bytes, too few|is not a PMTiles|is a PMTiles archive of another version)"):
        TileFile(tmp_path / "a.pmtiles")


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no such file"):
        TileFile(tmp_path / "a.pmtiles")
    (tmp_path / "a.pmtiles").mkdir()
    with pytest.raises(StorageError, match="cannot be read: Is a directory"):
        TileFile(tmp_path / "a.pmtiles")


def test_truncated_anywhere(archive: Path, tmp_path: Path) -> None:
    """What is opened at all gives right bytes or a sentence; nothing is made up."""
    whole, wanted = archive.read_bytes(), read_all(archive)
    for length in [*range(0, 3000, 97), *range(3000, len(whole), 397), len(whole) - 1]:
        (tmp_path / "a.pmtiles").write_bytes(whole[:length])
        with pytest.raises(ClipmapError):
            read_all(tmp_path / "a.pmtiles")
    assert read_all(archive) == wanted


def test_flipped_bits_anywhere(archive: Path, tmp_path: Path) -> None:
    """1000 archives with one to three flipped bits in header, directories or metadata end in the same keys or in a sentence."""
    whole = archive.read_bytes()
    head = deserialize_header(whole[:127])["tile_data_offset"]
    draw = random.Random(11)
    refused = 0
    for _ in range(1000):
        data = bytearray(whole)
        for _ in range(draw.randrange(1, 4)):
            data[draw.randrange(head)] ^= 1 << draw.randrange(8)
        (tmp_path / "a.pmtiles").write_bytes(data)
        try:
            read_all(tmp_path / "a.pmtiles")
        except ClipmapError:
            refused += 1
    assert refused > 500


def test_files_are_closed(archive: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    threads = [threading.Thread(target=read_all, args=(archive,)) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(os.listdir("/proc/self/fd")) == before


def test_nested_leaf_directories_and_plain_ones_are_read(archive: Path, tmp_path: Path) -> None:
    """Other programs may write what ours does not: leaves of leaves."""
    data = archive.read_bytes()
    header: dict[str, Any] = dict(deserialize_header(data[:127]))
    inner = data[header["root_offset"] :][: header["root_length"]]
    outer = serialize_directory([Entry(0, 0, len(inner), 0)])
    root = serialize_directory([Entry(0, len(inner), len(outer), 0)])
    path = rebuilt(archive, tmp_path / "a.pmtiles", root=gzip.decompress(root))
    whole = path.read_bytes()
    path.write_bytes(whole + inner + outer)
    header = dict(deserialize_header(whole[:127]))
    header |= {"leaf_directory_offset": len(whole), "leaf_directory_length": len(inner) + len(outer), "tile_type": TileType.UNKNOWN}
    path.write_bytes(serialize_header(header) + whole[127:] + inner + outer)
    assert read_all(path) == read_all(archive)
