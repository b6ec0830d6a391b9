"""The layout of a layer in one PMTiles file, worked out before a block is read.

The block indexes say length and digest of every block: so which blocks are the same, where each one goes, and what header, directories
and metadata say is known from them. Format: PMTiles version 3, https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md; header
and directories are written by its reference implementation, the ``pmtiles`` package.
"""

import gzip
import json
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pmtiles.tile import Compression, Entry, TileType, serialize_directory, serialize_header, tileid_to_zxy

from schemas.blockindex import RECORD_BYTES
from schemas.errors import InputError, UsageError
from schemas.manifest import Layer, Manifest
from tiler.archives.tileids import tile_ids
from tiler.checking.checkedread import read_index
from tiler.inspecting.footprint import measure_footprint
from tiler.stores.dataset import Dataset
from tiler.stores.tilefile import HEADER_BYTES, METADATA_BYTES, ROOT_END_BYTES

_TILE_TYPES: Final = {"image/png": TileType.PNG, "image/jpeg": TileType.JPEG, "image/webp": TileType.WEBP}
_RECORD: Final = np.dtype([("high", "<u8"), ("low", "<u8"), ("length", "<u4"), ("valid", "<u4"), ("min", "<f4"), ("max", "<f4")])
_ROOT_BYTES: Final = ROOT_END_BYTES - HEADER_BYTES
_LARGEST_ROOT: Final = 16384
"""Entries for which a root without leaves is tried; more never fit."""
_LEAF_ENTRIES: Final = 4096
_ROOT_ENTRIES: Final = 2048
"""Leaf directories that a root usually holds: a pointer takes some 5 bytes of 16 KiB."""
_MOST_LEVELS: Final = 32
"""Tile ids of zooms 0 to 31 fit in 64 bits."""
_MERCATOR_HALF_M: Final = 20037508.342789244
"""Half the side of the web mercator square: half the circumference of a sphere with the equatorial radius of WGS 84, pi * 6378137 m."""
_WEB_MERCATOR: Final = "Tiles are those of web mercator (EPSG:3857)."
_OWN_TILING: Final = (
    "Tiles are blocks of the layer's own quadtree, not of web mercator: z counts levels from the coarsest, which is one tile, x and y "
    "count blocks from the top left of the layer. See clipmap.manifest for size, transform and coordinate system."
)

Numbers = NDArray[Any]


@dataclass(frozen=True, slots=True)
class ArchivePlan:
    """The whole file but for the tiles; arrays have one element per tile, in the order of tile ids.

    ``head`` is header, root directory, metadata and leaf directories. ``numbers`` are the blocks' positions in their level, ``offsets``
    their places in the file, ``first`` says which tile is the first with its content. ``starts`` is the first tile of every zoom, and
    the number of tiles at the end. ``indexes`` are the block indexes, the finest level first; they end the file.
    """

    head: bytes
    numbers: NDArray[np.uint32]
    offsets: NDArray[np.int64]
    first: NDArray[np.bool_]
    starts: list[int]
    indexes: list[bytes]
    indexes_offset: int
    entries: int
    leaves: int

    @property
    def data_bytes(self) -> int:
        """Size of the different blocks."""
        return self.indexes_offset - len(self.head)

    @property
    def file_bytes(self) -> int:
        """Size of the whole file."""
        return self.indexes_offset + sum(map(len, self.indexes))


def plan_archive(dataset: Dataset, name: str) -> ArchivePlan:
    """Return the layout of the layer ``name``.

    Raises InputError if it has no block with bytes or an index is damaged, UsageError if the format cannot hold it, and NotFoundError or
    StorageError if an index cannot be read.
    """
    layer = dataset.manifest.layer(name)
    if len(layer.levels) > _MOST_LEVELS:
        raise UsageError(f"layer {name!r} has {len(layer.levels)} levels, and a PMTiles archive holds {_MOST_LEVELS} at most")
    if not any(level.stored for level in layer.levels):
        raise InputError(f"{dataset.store.location}: every block of layer {name!r} is blank, and an archive cannot be empty")
    indexes = [read_index(dataset, name, level) for level in range(len(layer.levels))]
    parts = [_tiles_of(layer, zoom, indexes[-1 - zoom]) for zoom in range(len(indexes))]
    ids, numbers, records = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    lengths = records["length"].astype(np.int64)
    first_of = _first_with_same_content(records)
    first = first_of == np.arange(len(ids))
    ends = np.cumsum(np.where(first, lengths, 0))
    offsets = (ends - lengths)[first_of]
    begins = np.flatnonzero((np.diff(ids, prepend=ids[:1]) != 1) | (np.diff(first_of, prepend=first_of[:1]) != 0))
    root, leaves, leaf_count = _directories(ids[begins], np.diff(begins, append=len(ids)), lengths[begins], offsets[begins])
    metadata = _metadata(dataset.manifest, name, int(ends[-1]))
    # The indexes count as tile data: the file then ends where the header says, which `pmtiles verify` demands.
    data_bytes = int(ends[-1]) + sum(map(len, indexes))
    counts = len(ids), len(begins), int(np.count_nonzero(first))
    zooms = tileid_to_zxy(int(ids[0]))[0], tileid_to_zxy(int(ids[-1]))[0]
    fields = _header((len(root), len(metadata), len(leaves), data_bytes), counts, zooms) | _bounds(layer, dataset.manifest.world.crs)
    header = serialize_header(fields | {"tile_type": _TILE_TYPES.get(layer.media_type, TileType.UNKNOWN)})
    head = header + root + metadata + leaves
    return ArchivePlan(
        head=head,
        numbers=numbers,
        offsets=offsets + len(head),
        first=first,
        starts=[0, *np.cumsum([len(part[0]) for part in parts]).tolist()],
        indexes=indexes,
        indexes_offset=len(head) + int(ends[-1]),
        entries=len(begins),
        leaves=leaf_count,
    )


def _header(lengths: tuple[int, int, int, int], counts: tuple[int, int, int], zooms: tuple[int, int]) -> dict[str, Any]:
    """Return the fields of the header but for place and kind of the layer.

    ``lengths`` are those of root directory, metadata, leaf directories and tile data, which follow in this order, ``counts`` the
    numbers of tiles, entries and contents, ``zooms`` the first and the last.
    """
    fields: dict[str, Any] = {}
    end = HEADER_BYTES
    for section, length in zip(("root", "metadata", "leaf_directory", "tile_data"), lengths, strict=True):
        fields |= {f"{section}_offset": end, f"{section}_length": length}
        end += length
    names = ("addressed_tiles_count", "tile_entries_count", "tile_contents_count")
    fields |= dict(zip(names, counts, strict=True)) | dict(zip(("min_zoom", "max_zoom"), zooms, strict=True))
    return fields | {
        "center_zoom": zooms[0],
        "clustered": True,
        "internal_compression": Compression.GZIP,
        "tile_compression": Compression.NONE,
    }


def _tiles_of(layer: Layer, zoom: int, index: bytes) -> tuple[NDArray[np.uint64], NDArray[np.uint32], NDArray[np.void]]:
    """Return tile ids, block numbers and index records of the stored blocks of one level, in the order of tile ids."""
    records = np.frombuffer(index, _RECORD)
    numbers = np.flatnonzero(records["length"])
    y, x = np.divmod(numbers, layer.levels[-1 - zoom].columns)
    ids = tile_ids(zoom, x.astype(np.uint64), y.astype(np.uint64))
    order = np.argsort(ids)
    return ids[order], numbers[order].astype(np.uint32), records[numbers[order]]


def _first_with_same_content(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Return for every tile the number of the first one with its digest and length."""
    keys = [records[field] for field in ("length", "low", "high")]
    order = np.lexsort(keys)  # stable: of equal tiles the first comes first
    changes = np.zeros(len(order), np.bool_)
    changes[:1] = True
    for key in keys:
        changes[1:] |= np.diff(key[order]) != 0
    first_of = np.empty(len(order), np.int64)
    first_of[order] = order[np.flatnonzero(changes)][np.cumsum(changes) - 1]
    return first_of


def _directories(ids: Numbers, runs: Numbers, lengths: Numbers, offsets: Numbers) -> tuple[bytes, bytes, int]:
    """Return root directory, leaf directories and the number of these; none if the root holds all entries."""

    def packed(part: slice) -> bytes:
        columns = zip(ids[part].tolist(), offsets[part].tolist(), lengths[part].tolist(), runs[part].tolist(), strict=True)
        packed: bytes = serialize_directory([Entry(*column) for column in columns])
        return packed

    if len(ids) <= _LARGEST_ROOT and len(root := packed(slice(None))) < _ROOT_BYTES:
        return root, b"", 0
    side = max(_LEAF_ENTRIES, -(-len(ids) // _ROOT_ENTRIES))
    while True:
        leaves = [packed(slice(begin, begin + side)) for begin in range(0, len(ids), side)]
        ends = list(accumulate(map(len, leaves)))
        pointers = [
            Entry(tile_id, end - len(leaf), len(leaf), 0) for tile_id, end, leaf in zip(ids[::side].tolist(), ends, leaves, strict=True)
        ]
        root = serialize_directory(pointers)
        if len(root) < _ROOT_BYTES:
            return root, b"".join(leaves), len(leaves)
        side *= 2


def _metadata(manifest: Manifest, name: str, indexes_offset: int) -> bytes:
    """Return the packed metadata; ``clipmap`` in it is all that a reader needs who has this file alone."""
    layer = manifest.layer(name).model_copy(update={"path": name, "patches": []})
    alone = Manifest.create(generator=manifest.generator, world=manifest.world, layers={name: layer})
    sizes = [level.columns * level.rows * RECORD_BYTES for level in layer.levels]
    web_mercator = _is_web_mercator(layer, manifest.world.crs)
    content = {
        "name": name,
        "description": _WEB_MERCATOR if web_mercator else _OWN_TILING,
        "version": alone.version,
        "clipmap": {
            "manifest": alone.model_dump(mode="json"),
            "indexes": [indexes_offset + begin for begin in accumulate(sizes[:-1], initial=0)],
            "web_mercator": web_mercator,
        },
    }
    data = json.dumps(content, separators=(",", ":")).encode()
    if len(data) > METADATA_BYTES:
        raise UsageError(f"layer {name!r} needs {len(data)} bytes of metadata, and an archive holds {METADATA_BYTES} at most")
    return gzip.compress(data, mtime=0)


def _is_web_mercator(layer: Layer, crs: str | None) -> bool:
    """Whether the blocks are the tiles of web mercator with the same zoom, x and y (to a thousandth of a sample)."""
    if crs != "EPSG:3857" or layer.pad or layer.registration != "area":
        return False
    side_m = 2 * _MERCATOR_HALF_M / (layer.block << len(layer.levels) - 1)
    wanted = (side_m, 0.0, -_MERCATOR_HALF_M, 0.0, -side_m, _MERCATOR_HALF_M)
    reach = (max(layer.width, layer.height), 1)  # an error of scale grows with the distance, one of the origin does not
    return all(
        abs(said - true) * reach[n in (2, 5)] <= side_m / 1000 for n, (said, true) in enumerate(zip(layer.transform, wanted, strict=True))
    )


def _bounds(layer: Layer, crs: str | None) -> dict[str, int]:
    """Return bounds and centre for the header, in units of 1e-7 degrees; the whole world if the layer's place is not known."""
    found = measure_footprint(layer, crs)
    if found is None:
        west, south, east, north = -180.0, -90.0, 180.0, 90.0
    elif found.crosses_antimeridian:  # the format has no way to say so
        west, south, east, north = -180.0, found.south_deg, 180.0, found.north_deg
    else:
        west, south, east, north = found.west_deg, found.south_deg, found.east_deg, found.north_deg
    corners = [round(degrees * 1e7) for degrees in (west, south, east, north)]
    for low, high in ((0, 2), (1, 3)):
        if corners[low] == corners[high]:  # a single row or column of points: readers refuse bounds without an area
            corners[low], corners[high] = corners[low] - 1, corners[high] + 1
    middle = (corners[0] + corners[2]) // 2
    if found is not None and found.crosses_antimeridian:
        middle = round((found.west_deg + found.east_deg + (360 if found.west_deg + found.east_deg < 0 else -360)) / 2 * 1e7)
    names = ("min_lon_e7", "min_lat_e7", "max_lon_e7", "max_lat_e7", "center_lon_e7", "center_lat_e7")
    return dict(zip(names, [*corners, middle, (corners[1] + corners[3]) // 2], strict=True))
