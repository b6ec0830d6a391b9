"""Where a task's blocks go: to a new path, to a patch if they differ from what is published, or back to where they are damaged."""

import threading
from collections.abc import Collection
from typing import Protocol

from schemas.address import BlockAddress
from schemas.blockindex import BlockRecord
from schemas.errors import InputError, NotFoundError
from schemas.manifest import block_key, digest
from tiler.stores import Store
from tiler.stores.dataset import Dataset


class Destination(Protocol):
    """Decides what is written; used from several threads."""

    def key(self, address: BlockAddress, record: BlockRecord) -> str | None:
        """Return the store key for a block's bytes, None if they are not to be written."""
        ...

    def holds(self, address: BlockAddress, record: BlockRecord) -> bool:
        """Whether the bytes that ``record`` describes need not be made again."""
        ...


class NewBlocks:
    """Every block goes under one path; what lies there already, from a build that was interrupted, is trusted if its digest is right."""

    def __init__(self, store: Store, path: str, name: str, levels: int, suffix: str) -> None:
        self._store = store
        self._path, self._name, self._levels, self._suffix = path, name, levels, suffix

    def _own_key(self, address: BlockAddress) -> str:
        return block_key(self._path, self._name, address, self._levels, self._suffix)

    def key(self, address: BlockAddress, record: BlockRecord) -> str | None:
        """Return the block's key under the path; never None."""
        return self._own_key(address)

    def holds(self, address: BlockAddress, record: BlockRecord) -> bool:
        """Whether the stored bytes are those that ``record`` describes; they are read, for a power cut may leave files without content."""
        if record.blank:
            return True
        try:
            return digest(self._store.read(self._own_key(address))) == record.digest
        except NotFoundError:
            return False


class ChangedBlocks(NewBlocks):
    """Only blocks that differ from those of the published layer go under the path."""

    def __init__(self, store: Store, path: str, published: Dataset, name: str) -> None:
        layer = published.manifest.layer(name)
        super().__init__(store, path, name, len(layer.levels), layer.suffix)
        self._published = published

    def _is_published(self, address: BlockAddress, record: BlockRecord) -> bool:
        try:
            return self._published.record(self._name, address).digest == record.digest
        except (InputError, NotFoundError):  # its index is damaged: then nothing is known of the published blocks
            return False

    def key(self, address: BlockAddress, record: BlockRecord) -> str | None:
        """Return the block's key under the path; None if the published layer has the same bytes."""
        return None if self._is_published(address, record) else self._own_key(address)

    def holds(self, address: BlockAddress, record: BlockRecord) -> bool:
        """Whether the bytes are published (then ``verify`` answers for them), or stored under the path."""
        return self._is_published(address, record) or super().holds(address, record)


class DamagedBlocks:
    """Only the blocks ``wanted`` are written, to where they are published; ``restored`` says which were, ``differing`` which cannot be."""

    def __init__(self, published: Dataset, name: str, wanted: Collection[BlockAddress]) -> None:
        self._published, self._name, self._wanted = published, name, wanted
        self.restored: set[BlockAddress] = set()
        self.differing: set[BlockAddress] = set()
        self._lock = threading.Lock()

    def key(self, address: BlockAddress, record: BlockRecord) -> str | None:
        """Return the published block's key if it is wanted and ``record`` has the digest that the index says."""
        if address not in self._wanted:
            return None
        try:
            same = self._published.record(self._name, address).digest == record.digest
        except (InputError, NotFoundError):  # its index is damaged as well
            same = False
        with self._lock:
            (self.restored if same else self.differing).add(address)
        return self._published.manifest.layer(self._name).block_key(self._name, address) if same else None

    def holds(self, address: BlockAddress, record: BlockRecord) -> bool:
        """Whether the block is not wanted."""
        return address not in self._wanted
