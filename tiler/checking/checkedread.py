"""Reading a dataset to pass its bytes on: what differs from its digest is an error and goes no further."""

from schemas.address import BlockAddress
from schemas.blockindex import BlockRecord
from schemas.errors import ClipmapError, InputError, StorageError
from schemas.findings import Finding
from schemas.manifest import digest
from tiler.checking.contents import read_checked
from tiler.stores.dataset import Dataset, read_manifest


def read_index(dataset: Dataset, name: str, level: int) -> bytes:
    """Return the bytes of the block index of ``level``; raises NotFoundError or StorageError, InputError if it is damaged."""
    layer = dataset.manifest.layer(name)
    key = layer.index_key(level)
    data = dataset.store.read(key)
    if digest(data) != layer.levels[level].index:
        raise InputError(f"{dataset.store.location}/{key}: differs from what the manifest says; the index is damaged, rebuild the layer")
    return data


def read_block(dataset: Dataset, name: str, address: BlockAddress, record: BlockRecord) -> bytes:
    """Return the bytes of a block that is stored, as ``record`` in the index says.

    Raises InputError if it is missing or its bytes are not those that the index means, StorageError if it cannot be read or the
    dataset was rebuilt meanwhile; both name the block.
    """
    found = read_checked(dataset, name, address, record)
    if not isinstance(found, Finding):
        return found
    if read_manifest(dataset.store) != dataset.manifest:
        raise StorageError(f"{dataset.store.location}: was rebuilt while it was read; run the command again")
    kind: type[ClipmapError] = StorageError if found.kind == "unreadable" else InputError
    raise kind(f"{dataset.store.location}/{found.file}: {found.what}, so nothing was published; {found.remedy}")
