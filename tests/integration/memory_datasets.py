"""Datasets in memory with any bytes as blocks, as many as a test likes."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from schemas.address import BlockAddress
from schemas.blockindex import BLANK, BlockRecord, pack_record
from schemas.errors import NotFoundError
from schemas.lattice import Lattice
from schemas.manifest import LayerKind, Level, Manifest, World, digest, pack_bitmap
from tests.schemas.sample_manifest import make_layer
from tiler.stores import Claim
from tiler.stores.dataset import Dataset

Content = Callable[[BlockAddress], bytes | None]
"""The bytes of a block, None for a blank."""


class MemoryStore:
    """A store that is a dictionary; ``reads`` counts them."""

    def __init__(self, entries: dict[str, bytes]) -> None:
        self.entries = entries
        self.reads = 0

    @property
    def location(self) -> str:
        return "memory"

    @property
    def scratch(self) -> Path:
        raise NotImplementedError

    def read(self, key: str) -> bytes:
        self.reads += 1
        try:
            return self.entries[key]
        except KeyError:
            raise NotFoundError(f"memory/{key}: no such block or file") from None

    def keys(self, prefix: str) -> list[str]:
        return sorted(key for key in self.entries if not prefix or key.startswith(f"{prefix}/"))

    def write(self, key: str, data: bytes) -> None:
        self.entries[key] = data

    def delete(self, keys: Iterable[str]) -> None:
        raise NotImplementedError

    def delete_prefix(self, prefix: str) -> None:
        raise NotImplementedError

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        raise NotImplementedError

    def sync(self) -> None:
        raise NotImplementedError


def memory_dataset(
    size: tuple[int, int], content: Content, *, kind: LayerKind = "imagery", block: int = 4, crs: str | None = "EPSG:32610", **changes: Any
) -> Dataset:
    """A dataset of one layer called as its kind; ``changes`` replace fields of the layer."""
    layer = make_layer(kind, *size, block, **changes)
    entries: dict[str, bytes] = {}
    levels = []
    for number in range(layer.lattice.levels):
        records = []
        for address in layer.lattice.addresses(number):
            data = content(address)
            if data is not None:
                entries[layer.block_key(kind, address)] = data
            records.append(BLANK if data is None else BlockRecord(digest(data), len(data), block * block, 0.0, 1.0))
        index = b"".join(map(pack_record, records))
        entries[layer.index_key(number)] = index
        levels.append(_level(layer.lattice, number, records, index))
    layer = layer.model_copy(update={"levels": levels})
    manifest = Manifest.create(generator="tests", world=World(crs=crs, unit="unknown"), layers={kind: layer})
    entries["manifest.json"] = manifest.to_json()
    return Dataset(MemoryStore(entries), manifest)


def _level(lattice: Lattice, number: int, records: list[BlockRecord], index: bytes) -> Level:
    (width, height), (columns, rows) = lattice.level_size(number), lattice.block_counts(number)
    stored = [not record.blank for record in records]
    bitmap = sum(flag << place for place, flag in enumerate(stored))
    return Level(
        level=number,
        width=width,
        height=height,
        columns=columns,
        rows=rows,
        stored=sum(stored),
        blank=len(stored) - sum(stored),
        stored_bytes=sum(record.length_bytes for record in records),
        availability=pack_bitmap(bitmap.to_bytes(-(-len(stored) // 8), "little"), len(stored)),
        index=digest(index),
    )
