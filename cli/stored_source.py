"""Blocks for the viewer from archives and object stores. The viewer itself knows folders and servers only: it does not import tiler."""

from typing import TYPE_CHECKING, Final

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError
from schemas.manifest import Manifest, digest
from tiler.stores.dataset import Dataset, open_dataset, read_manifest
from tiler.stores.directory import DirectoryStore
from tiler.stores.locate import open_store

if TYPE_CHECKING:
    from viewer.source import BlockSource

_SERVERS: Final = ("http://", "https://")


class StoredSource:
    """A dataset in any store, as the viewer wants it: every block is held against its digest, and two versions are never mixed."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    @property
    def location(self) -> str:
        """Path or URL of the dataset."""
        return self._dataset.store.location

    @property
    def manifest(self) -> Manifest:
        """The dataset's manifest."""
        return self._dataset.manifest

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        """Return the stored bytes of a block, None for a blank.

        Raises NotFoundError, StorageError, or InputError if the bytes are not the block's or the dataset was rebuilt.
        """
        try:
            return self._block(layer, address)
        except (NotFoundError, InputError):
            if self._is_rebuilt():
                raise InputError(f"{self.location}: the dataset was rebuilt meanwhile; start again") from None
            raise

    def _block(self, layer: str, address: BlockAddress) -> bytes | None:
        data = self._dataset.block(layer, address)
        if data is not None and digest(data) != self._dataset.record(layer, address).digest:
            raise InputError(f"{self.location}: block {address} of {layer!r} differs from its digest; it is damaged, rebuild the layer")
        return data

    def close(self) -> None:
        """Nothing is held open that does not close itself."""

    def _is_rebuilt(self) -> bool:
        try:
            found = read_manifest(self._dataset.store)
        except ClipmapError:
            return False
        return found is not None and found.version != self.manifest.version


def open_block_source(where: str, connections: int) -> "BlockSource":
    """Open the dataset at ``where``: a folder, archives, an object store or a server; raises NotFoundError, InputError or StorageError."""
    from viewer.source import open_source

    if where.startswith(_SERVERS) or isinstance(open_store(where), DirectoryStore):
        return open_source(where, connections)
    return StoredSource(open_dataset(where))
