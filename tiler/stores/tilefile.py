"""One PMTiles file that holds one layer: header, directories, tiles, and the block indexes behind the tiles.

Format: PMTiles version 3, https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md; what clipmap adds is in
``docs/FORMAT.md``, section Archives. The reference reader of the ``pmtiles`` package parses header and directories anew for every
tile, byte by byte, and inflates whatever it is given; here directories are kept, and every declared size is checked before anything
is allocated.
"""

import json
import os
import threading
import weakref
import zlib
from array import array
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

from pmtiles.tile import Compression, MagicNumberNotFound, SpecVersionUnsupported, deserialize_header, tileid_to_zxy, zxy_to_tileid

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES
from schemas.errors import InputError, NotFoundError, StorageError
from schemas.manifest import Layer, Manifest, parse_manifest

SUFFIX: Final = ".pmtiles"
HEADER_BYTES: Final = 127
ROOT_END_BYTES: Final = 16384
"""Header and root directory lie within so many bytes (specification, section 2)."""
METADATA_BYTES: Final = 16 << 20
"""Most metadata that is inflated; JSON of so many bytes becomes at most some 350 MB of Python objects."""
_DIRECTORY_BYTES: Final = 16 << 20
"""Most of a directory that is inflated: 4 million entries; 4096 are usual and need some 30 kB."""
_CACHED_ENTRIES: Final = 1 << 20
"""Directory entries that are kept in memory, at 32 bytes each."""
_DEEPEST: Final = 4
"""A leaf directory may point to another; the reference reader follows so many."""


class TileFile:
    """An archive of one layer, open for reading from several threads; closed when nothing refers to it any more.

    Raises NotFoundError if there is no such file, StorageError if it cannot be read, InputError if it is not an archive of a layer
    or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except (FileNotFoundError, NotADirectoryError):
            raise NotFoundError(f"{path}: no such file") from None
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
        weakref.finalize(self, os.close, self._descriptor)
        self._size = os.fstat(self._descriptor).st_size
        self._header = self._checked_header()
        self._directories: OrderedDict[int, _Directory] = OrderedDict()
        self._lock = threading.Lock()
        self.manifest, self._indexes = self._described()
        self.name, self.layer = next(iter(self.manifest.layers.items()))

    def tile(self, address: BlockAddress) -> bytes | None:
        """Return the stored bytes of the block at ``address``, which lies in the lattice; None if the file has no such tile."""
        tile_id = zxy_to_tileid(len(self.layer.levels) - 1 - address.level, address.x, address.y)
        offset, length = self._header["root_offset"], self._header["root_length"]
        for _ in range(_DEEPEST):
            directory = self._directory(offset, length)
            number = directory.find(tile_id)
            if number is None:
                return None
            offset, length = directory.offsets[number], directory.lengths[number]
            if directory.runs[number]:
                return self._section("tile_data", offset, length)
            offset += self._header["leaf_directory_offset"]
        raise self._damaged(f"its directories are nested more than {_DEEPEST} deep")

    def index(self, level: int) -> bytes:
        """Return the block index of ``level``."""
        return self._section("tile_data", *self._indexes[level])

    def addresses(self) -> Iterator[BlockAddress]:
        """Yield the address of every tile, from the coarsest level on; raises InputError if one lies outside the lattice."""
        lattice, last = self.layer.lattice, len(self.layer.levels) - 1
        for first, run in self._entries(self._header["root_offset"], self._header["root_length"], _DEEPEST):
            for tile_id in range(first, first + run):
                zoom, x, y = tileid_to_zxy(tile_id) if tile_id < 1 << 63 else (last + 1, 0, 0)
                if zoom > last or not lattice.contains(address := BlockAddress(last - zoom, x, y)):
                    raise self._damaged(f"tile {zoom}/{x}/{y} lies outside the layer")
                yield address

    def _entries(self, offset: int, length: int, depth: int) -> Iterator[tuple[int, int]]:
        directory = self._directory(offset, length)
        for number, (tile_id, run) in enumerate(zip(directory.ids, directory.runs, strict=True)):
            if run:
                yield tile_id, run
            elif depth > 1:
                leaf = self._header["leaf_directory_offset"] + directory.offsets[number]
                yield from self._entries(leaf, directory.lengths[number], depth - 1)

    def _damaged(self, what: str) -> InputError:
        return InputError(f"{self._path}: {what}; the archive is damaged, copy the dataset again")

    def _read(self, offset: int, length: int) -> bytes:
        if offset + length > self._size:
            raise self._damaged(f"it ends at byte {self._size}, and something is said to lie at {offset} to {offset + length}")
        try:
            data = os.pread(self._descriptor, length, offset)
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be read: {error.strerror}") from error
        while len(data) < length:  # Linux reads at most 2 GiB at once
            more = os.pread(self._descriptor, length - len(data), offset + len(data))
            if not more:
                raise self._damaged("it was cut off while it was open")
            data += more
        return data

    def _section(self, section: str, offset: int, length: int) -> bytes:
        if offset + length > self._header[f"{section}_length"]:
            raise self._damaged(f"bytes {offset} to {offset + length} lie beyond its section of {section.replace('_', ' ')}")
        return self._read(self._header[f"{section}_offset"] + offset, length)

    def _checked_header(self) -> dict[str, Any]:
        if self._size < HEADER_BYTES:
            raise InputError(f"{self._path}: has {self._size} bytes, too few for a PMTiles archive")
        try:
            header = dict(deserialize_header(self._read(0, HEADER_BYTES)))
        except MagicNumberNotFound:
            raise InputError(f"{self._path}: is not a PMTiles archive") from None
        except SpecVersionUnsupported:
            raise InputError(f"{self._path}: is a PMTiles archive of another version than 3") from None
        except ValueError as error:
            raise InputError(f"{self._path}: is not a PMTiles archive of version 3: {error}") from error
        if header["internal_compression"] not in (Compression.GZIP, Compression.NONE):
            raise InputError(f"{self._path}: its directories are not packed with gzip")
        if header["root_offset"] + header["root_length"] > ROOT_END_BYTES:
            raise self._damaged(f"its root directory ends beyond byte {ROOT_END_BYTES}")
        return header

    def _inflated(self, offset: int, length: int, limit: int, what: str) -> bytes:
        if length > limit:
            raise self._damaged(f"its {what} is said to have {length} bytes, more than {limit}")
        data = self._read(offset, length)
        if self._header["internal_compression"] == Compression.NONE:
            return data
        stream = zlib.decompressobj(31)
        try:
            inflated = stream.decompress(data, limit + 1)
        except zlib.error as error:
            raise self._damaged(f"its {what} cannot be unpacked ({error})") from error
        if len(inflated) > limit:
            raise self._damaged(f"its {what} unpacks to more than {limit} bytes")
        if not stream.eof:
            raise self._damaged(f"its {what} is cut off")
        return inflated

    def _directory(self, offset: int, length: int) -> "_Directory":
        with self._lock:
            known = self._directories.get(offset)
            if known is not None:
                self._directories.move_to_end(offset)
                return known
        try:
            directory = _parse_directory(self._inflated(offset, length, _DIRECTORY_BYTES, "directory"))
        except (ValueError, OverflowError) as error:
            raise self._damaged(f"the directory at byte {offset} makes no sense ({error})") from error
        with self._lock:
            self._directories[offset] = directory
            while len(self._directories) > 1 and sum(len(kept.ids) for kept in self._directories.values()) > _CACHED_ENTRIES:
                self._directories.popitem(last=False)
        return directory

    def _described(self) -> tuple[Manifest, list[tuple[int, int]]]:
        """Return the manifest of the one layer and where its block indexes lie, relative to the tile data."""
        data = self._inflated(self._header["metadata_offset"], self._header["metadata_length"], METADATA_BYTES, "metadata")
        try:
            metadata = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise self._damaged(f"its metadata is not JSON ({error})") from error
        ours = metadata.get("clipmap") if isinstance(metadata, dict) else None
        if not isinstance(ours, dict):
            raise InputError(f"{self._path}: is a PMTiles archive, but not of a clipmap layer (its metadata has no object 'clipmap')")
        manifest = parse_manifest(json.dumps(ours.get("manifest")).encode(), str(self._path))
        if len(manifest.layers) != 1:
            raise self._damaged(f"its metadata describes {len(manifest.layers)} layers instead of one")
        layer = next(iter(manifest.layers.values()))
        if layer.patches:
            raise self._damaged("its metadata says that blocks lie elsewhere")
        return manifest, self._checked_indexes(layer, ours.get("indexes"))

    def _checked_indexes(self, layer: Layer, said: object) -> list[tuple[int, int]]:
        offsets = said if isinstance(said, list) else []
        if len(offsets) != len(layer.levels) or not all(type(offset) is int and offset >= 0 for offset in offsets):
            raise self._damaged("its metadata does not say where the block index of every level lies")
        found = [(offset, level.columns * level.rows * RECORD_BYTES) for offset, level in zip(offsets, layer.levels, strict=True)]
        for level, (offset, length) in enumerate(found):
            if self._header["tile_data_offset"] + offset + length > self._size:
                raise self._damaged(f"the block index of level {level} would need {length} bytes, more than there are")
        return found


@dataclass(frozen=True, slots=True)
class _Directory:
    """Entries in ascending order of tile id; a run of 0 points to a leaf directory."""

    ids: "array[int]"
    runs: "array[int]"
    lengths: "array[int]"
    offsets: "array[int]"

    def find(self, tile_id: int) -> int | None:
        """Return the number of the entry that holds ``tile_id`` or points to the leaf that may hold it; None if there is none."""
        number = bisect_right(self.ids, tile_id) - 1
        if number < 0 or (self.runs[number] and tile_id - self.ids[number] >= self.runs[number]):
            return None
        return number


def _parse_directory(data: bytes) -> _Directory:
    """Return the entries of an inflated directory; raises ValueError or OverflowError if it is none."""
    numbers = _parse_varints(data)
    count = numbers[0] if numbers else 0
    if count == 0 or len(numbers) != 4 * count + 1:
        raise ValueError(f"{count} entries in {len(numbers)} numbers")
    steps, runs, lengths, places = (numbers[1 + n * count : 1 + (n + 1) * count] for n in range(4))
    if 0 in steps[1:]:
        raise ValueError("a tile is listed twice")
    if 0 in lengths:
        raise ValueError("an entry has no bytes")
    offsets = array("Q")
    end = 0
    for place, length in zip(places, lengths, strict=True):
        offset = place - 1 if place else end
        offsets.append(offset)
        end = offset + length
    if places[0] == 0:
        raise ValueError("the first entry has no offset")
    return _Directory(array("Q", accumulate(steps)), runs, lengths, offsets)


def _parse_varints(data: bytes) -> "array[int]":
    """Return the numbers in ``data``, each in groups of 7 bits, the lowest first, the top bit saying that more follow."""
    numbers = array("Q")
    append = numbers.append
    value = shift = 0
    for byte in data:
        if byte < 128:
            append(value | byte << shift)
            value = shift = 0
        else:
            value |= (byte & 127) << shift
            shift += 7
            if shift > 63:  # without this a megabyte of set bits would take hours
                raise ValueError("a number has more than 64 bits")
    if shift:
        raise ValueError("it ends within a number")
    return numbers
