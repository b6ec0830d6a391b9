"""What builds that did not end have left under the paths of a layer, and may be deleted: exactly that, and nothing else."""

from collections.abc import Iterator, Sequence

from schemas.address import BlockAddress, parse_block_name
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.lattice import Lattice
from schemas.manifest import block_key, index_key
from tiler.stores import Claim, Store
from tiler.stores.dataset import Dataset
from tiler.tasks.records import TASKS, RecordBook


def sweep(dataset: Dataset, claim: Claim) -> None:
    """Delete what a build that was killed after it had published a layer did not come to delete; raises StorageError.

    Only layers are looked at under whose paths a build was at work that did not end.
    """
    for name, layer in dataset.manifest.layers.items():
        if set(layer.paths) & set(claim.abandoned):
            dataset.store.delete(_superseded(dataset, name))
            for patch in layer.patches:
                RecordBook(dataset.store, patch.path).delete()


def _superseded(dataset: Dataset, name: str) -> list[str]:
    """Return the keys of blocks and indexes of older versions, and of blocks that are blank now, under a layer's paths."""
    layer = dataset.manifest.layer(name)
    indexes = {layer.index_key(level) for level in range(len(layer.levels))}
    found = []
    for path in layer.paths:
        old_indexes = {index_key(path, level) for level in range(len(layer.levels))} - indexes
        found += [key for key in dataset.store.keys(path) if key in old_indexes]
        for key, address in _block_keys(dataset.store, path, name, layer.lattice, layer.suffix):
            if layer.block_path(address) != path or _is_blank(dataset, name, address):
                found.append(key)
    return found


def _is_blank(dataset: Dataset, name: str, address: BlockAddress) -> bool:
    try:
        return dataset.record(name, address).blank
    except (InputError, NotFoundError):  # the index is damaged: for verify --repair
        return False


def _block_keys(store: Store, path: str, name: str, lattice: Lattice, suffix: str) -> Iterator[tuple[str, BlockAddress]]:
    """Yield the keys under ``path`` that are those of the layer's blocks, to the letter; other files are somebody else's."""
    for key in store.keys(path):
        if key.startswith(f"{path}/{TASKS}/"):
            continue
        try:
            address = parse_block_name(key.rpartition("/")[2]).address
        except UsageError:
            continue
        if lattice.contains(address) and block_key(path, name, address, lattice.levels, suffix) == key:
            yield key, address


def delete_unnamed(store: Store, path: str, name: str, lattice: Lattice, suffix: str, stored: Sequence[bytes]) -> None:
    """Delete the blocks under ``path`` that are not in the bitmaps ``stored``, one per level; raises StorageError.

    A build that went on with what another one had left, of a source that changed between them, may not want all of it.
    """
    unnamed = []
    for key, address in _block_keys(store, path, name, lattice, suffix):
        number = lattice.block_number(address)
        if not stored[address.level][number // 8] >> number % 8 & 1:
            unnamed.append(key)
    store.delete(unnamed)
