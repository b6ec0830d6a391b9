"""Reading a stored dataset: manifest, block index, block bytes. Nothing is decoded here."""

import threading
from dataclasses import dataclass, field
from pathlib import Path

from schemas.address import BlockAddress
from schemas.blockindex import BlockIndex, BlockRecord
from schemas.errors import InputError, NotFoundError
from schemas.manifest import MANIFEST_NAME, Manifest, digest, parse_manifest
from tiler.stores import Store
from tiler.stores.locate import folder_of, is_remote, open_store


@dataclass(frozen=True)
class Dataset:
    """One published version of a dataset; safe to use from several threads."""

    store: Store
    manifest: Manifest
    _indexes: dict[tuple[str, int], BlockIndex] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def index(self, name: str, level: int) -> BlockIndex:
        """Return the block index of a level, read once; raises NotFoundError, or InputError if it is damaged."""
        layer = self.manifest.layer(name)
        lattice = layer.lattice
        columns, rows = lattice.block_counts(level)
        with self._lock:
            known = self._indexes.get((name, level))
        if known is not None:
            return known
        key = layer.index_key(level)
        data = self.store.read(key)
        where = f"{self.store.location}/{key}"
        if digest(data) != layer.levels[level].index:
            raise InputError(f"{where}: differs from what the manifest says; the index is damaged, rebuild the layer")
        index = BlockIndex(data, columns * rows, where)
        with self._lock:
            return self._indexes.setdefault((name, level), index)

    def record(self, name: str, address: BlockAddress) -> BlockRecord:
        """Return what the index says of a block; raises NotFoundError outside the lattice."""
        lattice = self.manifest.layer(name).lattice
        return self.index(name, lattice.check(address).level)[lattice.block_number(address)]

    def block(self, name: str, address: BlockAddress) -> bytes | None:
        """Return the stored bytes of a block, None for a blank; raises NotFoundError outside the lattice.

        Raises InputError if the stored bytes have another length than the index says: a truncated block is never passed on.
        """
        record = self.record(name, address)
        if record.blank:
            return None
        key = self.manifest.layer(name).block_key(name, address)
        data = self.store.read(key)
        if len(data) != record.length_bytes:
            raise InputError(f"{self.store.location}/{key}: has {len(data)} bytes instead of {record.length_bytes}; the block is damaged")
        return data


def read_manifest(store: Store) -> Manifest | None:
    """Return the manifest of the dataset in ``store``, None if there is none; raises InputError if it cannot be understood."""
    try:
        data = store.read(MANIFEST_NAME)
    except NotFoundError:
        return None
    return parse_manifest(data, f"{store.location}/{MANIFEST_NAME}")


def open_dataset(location: str | Path) -> Dataset:
    """Open the dataset at ``location``, a folder or a URL.

    Raises NotFoundError if there is no manifest, InputError if it cannot be understood, and whatever ``open_store`` raises.
    """
    store = open_store(location)
    manifest = read_manifest(store)
    if manifest is not None:
        return Dataset(store, manifest)
    # Not asked of an object store: there it would be a long list.
    folder = None if is_remote(location) else folder_of(location)
    if folder is not None and folder.is_dir() and any(folder.iterdir()):
        raise NotFoundError(f"{folder}: no {MANIFEST_NAME}: not a dataset, or its build has not finished")
    raise NotFoundError(f"{store.location}: no dataset there (no {MANIFEST_NAME})")
