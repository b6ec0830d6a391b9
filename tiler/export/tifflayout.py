"""The byte layout of a Cloud Optimized GeoTIFF: directories first, then the tiles of the coarsest level, those of level 0 last.

TIFF 6.0 (Adobe, 1992) and BigTIFF (Aware Systems); the order of data and the structural metadata in front are those of GDAL's
COG driver, so that GDAL needs one request per tile. All numbers are little-endian.
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

SUBFILE_TYPE, WIDTH, HEIGHT, SUBSAMPLING = 254, 256, 257, 530
TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS, TILE_BYTES, JPEG_TABLES = 322, 323, 324, 325, 347

_SHORT, _LONG, _LONG8 = 3, 4, 16
_TYPE_BYTES: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_CLASSIC_LIMIT_BYTES: Final = (1 << 32) - 1
_STRUCTURE: Final = (
    b"LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n"
    b"BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n "
)
_GHOST: Final = b"GDAL_STRUCTURAL_METADATA_SIZE=%06d bytes\n" % len(_STRUCTURE) + _STRUCTURE
LEADER_AND_TRAILER_BYTES: Final = 8


@dataclass(frozen=True, slots=True)
class Tag:
    """A field of a directory: its TIFF type, number of values, and their bytes."""

    kind: int
    count: int
    data: bytes


Tags = Mapping[int, Tag]


def shorts(*values: int) -> Tag:
    """Return a field of 16-bit numbers."""
    return Tag(_SHORT, len(values), struct.pack(f"<{len(values)}H", *values))


def longs(*values: int) -> Tag:
    """Return a field of 32-bit numbers."""
    return Tag(_LONG, len(values), struct.pack(f"<{len(values)}I", *values))


def read_tags(data: bytes) -> dict[int, Tag]:
    """Return the fields of the first directory of a little-endian classic TIFF that a library has just written; nothing is checked."""
    (directory,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, directory)
    tags = {}
    for entry in range(directory + 2, directory + 2 + 12 * count, 12):
        code, kind, values = struct.unpack_from("<HHI", data, entry)
        size = _TYPE_BYTES[kind] * values
        start = entry + 8 if size <= 4 else struct.unpack_from("<I", data, entry + 8)[0]
        tags[code] = Tag(kind, values, data[start : start + size])
    return tags


@dataclass(frozen=True, slots=True)
class LevelTiles:
    """One directory to write: its fields, all but sizes and places of tiles, and how many tiles there are."""

    width: int
    height: int
    tags: Tags
    tiles: int


class CogFile:
    """Writes the tiles of all levels one after the other, the coarsest level first, and at last the directories in front of them.

    ``levels`` has the finest one first; ``at_most_bytes`` bounds what all tiles can take, so that files that may pass 4 GiB become
    BigTIFF. 12 or 8 bytes per tile are kept in memory until the end.
    """

    def __init__(self, file: BinaryIO, levels: list[LevelTiles], side: int, at_most_bytes: int) -> None:
        self._file, self._levels, self._side = file, levels, side
        tiles = sum(level.tiles for level in levels)
        directories = sum(len(tag.data) + 20 for level in levels for tag in level.tags.values()) + 1000 * len(levels)
        self.big = at_most_bytes + tiles * (LEADER_AND_TRAILER_BYTES + 12) + directories > _CLASSIC_LIMIT_BYTES
        self._offsets = [np.zeros(level.tiles, np.uint64 if self.big else np.uint32) for level in levels]
        self._sizes = [np.zeros(level.tiles, np.uint32) for level in levels]
        file.write(bytes(len(self._front())))
        self._position = file.tell()

    def write_level(self, level: int, tiles: Iterable[bytes]) -> None:
        """Write all tiles of a level, in row order."""
        for number, data in enumerate(tiles):
            self._file.write(struct.pack("<I", len(data)) + data + data[-4:])
            self._offsets[level][number] = self._position + 4
            self._sizes[level][number] = len(data)
            self._position += len(data) + LEADER_AND_TRAILER_BYTES

    def finish(self) -> None:
        """Write header and directories into the room left for them."""
        self._file.seek(0)
        self._file.write(self._front())

    def _front(self) -> bytes:
        """Return everything before the first tile."""
        header = 16 if self.big else 8
        first = _even(header + len(_GHOST))
        sizes = [len(self._directory(level, 0, last=False)) for level in range(len(self._levels))]
        starts = list(accumulate(sizes, initial=first))
        directories = [self._directory(level, start, last=level == len(sizes) - 1) for level, start in enumerate(starts[:-1])]
        head = struct.pack("<2sHHHQ", b"II", 43, 8, 0, first) if self.big else struct.pack("<2sHI", b"II", 42, first)
        return (head + _GHOST).ljust(first, b"\0") + b"".join(directories)

    def _directory(self, number: int, start: int, *, last: bool) -> bytes:
        """Return the bytes of a directory that lies at ``start``, its longer values after it; the next one follows unless ``last``."""
        level = self._levels[number]
        tags = {
            **level.tags,
            WIDTH: longs(level.width),
            HEIGHT: longs(level.height),
            TILE_WIDTH: shorts(self._side),
            TILE_HEIGHT: shorts(self._side),
            TILE_OFFSETS: _numbers(self._offsets[number]),
            TILE_BYTES: _numbers(self._sizes[number]),
        }
        inline, entry = (8, "<HHQ") if self.big else (4, "<HHI")
        count, pointer = ("<Q", "<Q") if self.big else ("<H", "<I")
        body = start + struct.calcsize(count) + len(tags) * (struct.calcsize(entry) + inline) + struct.calcsize(pointer)
        entries, values, next_start = b"", b"", _even(body)
        padding = bytes(next_start - body)
        for code, tag in sorted(tags.items()):
            entries += struct.pack(entry, code, tag.kind, tag.count)
            if len(tag.data) <= inline:
                entries += tag.data.ljust(inline, b"\0")
                continue
            entries += struct.pack(pointer, next_start + len(values))
            values += tag.data.ljust(_even(len(tag.data)), b"\0")
        following = 0 if last else next_start + len(values)
        return struct.pack(count, len(tags)) + entries + struct.pack(pointer, following) + padding + values


def _numbers(values: NDArray[Any]) -> Tag:
    kind = _LONG8 if values.dtype == np.uint64 else _LONG
    return Tag(kind, len(values), values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes())


def _even(position: int) -> int:
    """Values of a TIFF begin at even positions; those of a BigTIFF had better at multiples of 8."""
    return -(-position // 8) * 8
