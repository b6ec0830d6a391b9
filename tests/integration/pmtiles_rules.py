"""What the PMTiles specification, version 3, and the ``verify`` command of the format's own tools demand of an archive.

Sources: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md and pmtiles/verify.go of https://github.com/protomaps/go-pmtiles.
Reading is done with the reference reader, not with ours.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmtiles.reader import Reader
from pmtiles.tile import Compression, Entry, deserialize_directory, tileid_to_zxy, zxy_to_tileid


@dataclass(frozen=True)
class Facts:
    """An archive that breaks no rule: its header, metadata and tiles (by z, x, y), and the number of leaf directories."""

    header: dict[str, Any]
    metadata: dict[str, Any]
    tiles: dict[tuple[int, int, int], bytes]
    leaves: int


def check_rules(path: Path) -> Facts:
    """Assert that the archive follows the rules, and return what is in it."""
    data = path.read_bytes()
    reader = Reader(lambda offset, length: data[offset : offset + length])
    header = dict(reader.header())
    # All sections in the usual order, back to back, and nothing behind them.
    end = 127
    for section in ("root", "metadata", "leaf_directory", "tile_data"):
        assert header[f"{section}_offset"] == end, section
        end += header[f"{section}_length"]
    assert end == len(data)
    assert header["root_offset"] + header["root_length"] <= 16384
    assert header["internal_compression"] == Compression.GZIP
    assert header["tile_compression"] == Compression.NONE
    root = deserialize_directory(data[127 : 127 + header["root_length"]])
    entries, leaves = _entries(data, header, root)
    _check_entries(entries, header)
    first, last = entries[0], entries[-1]
    assert header["min_zoom"] == tileid_to_zxy(first.tile_id)[0]
    assert header["max_zoom"] == tileid_to_zxy(last.tile_id + last.run_length - 1)[0]
    assert header["min_zoom"] <= header["center_zoom"] <= header["max_zoom"]
    assert -1_800_000_000 <= header["min_lon_e7"] < header["max_lon_e7"] <= 1_800_000_000
    assert -900_000_000 <= header["min_lat_e7"] < header["max_lat_e7"] <= 900_000_000
    assert -1_800_000_000 <= header["center_lon_e7"] <= 1_800_000_000
    metadata = reader.metadata()
    assert isinstance(metadata, dict)
    start = header["tile_data_offset"]
    tiles = {}
    for entry in entries:
        for tile_id in range(entry.tile_id, entry.tile_id + entry.run_length):
            tiles[tileid_to_zxy(tile_id)] = data[start + entry.offset : start + entry.offset + entry.length]
    return Facts(header, metadata, tiles, leaves)


def reader_gets(path: Path, z: int, x: int, y: int) -> bytes | None:
    """Look one tile up the way the reference reader does."""
    with path.open("rb") as file:

        def get_bytes(offset: int, length: int) -> bytes:
            file.seek(offset)
            return file.read(length)

        found: bytes | None = Reader(get_bytes).get(z, x, y)
    return found


def _entries(data: bytes, header: dict[str, Any], directory: list[Entry]) -> tuple[list[Entry], int]:
    entries, leaves = [], 0
    for entry in directory:
        if entry.run_length:
            entries.append(entry)
            continue
        leaves += 1
        assert entry.offset + entry.length <= header["leaf_directory_length"]
        begin = header["leaf_directory_offset"] + entry.offset
        leaf = deserialize_directory(data[begin : begin + entry.length])
        assert leaf[0].tile_id == entry.tile_id
        assert all(inner.run_length for inner in leaf), "leaf directories point to leaf directories"
        entries += leaf
    return entries, leaves


def _check_entries(entries: list[Entry], header: dict[str, Any]) -> None:
    assert entries
    assert all(entry.length for entry in entries)
    after = 0
    offsets: set[int] = set()
    written = 0
    for entry in entries:
        assert entry.tile_id >= after
        after = entry.tile_id + entry.run_length
        assert entry.offset + entry.length <= header["tile_data_length"]
        if entry.offset not in offsets:
            assert entry.offset == written, "not clustered"
            written += entry.length
        offsets.add(entry.offset)
    assert header["clustered"]
    assert header["addressed_tiles_count"] == sum(entry.run_length for entry in entries)
    assert header["tile_entries_count"] == len(entries)
    assert header["tile_contents_count"] == len(offsets)
    assert entries[-1].tile_id <= zxy_to_tileid(31, (1 << 31) - 1, 0)
