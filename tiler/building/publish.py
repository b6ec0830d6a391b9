"""From finished tasks to a published layer: indexes, patches, manifest; and what may be deleted once it is published."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Final

import numpy as np

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES
from schemas.errors import InputError, NotFoundError
from schemas.lattice import Lattice
from schemas.manifest import MANIFEST_NAME, Filter, Layer, Manifest, Patch, Source, block_key, index_key, pack_bitmap, unpack_bitmap
from tiler.building.leftovers import delete_unnamed
from tiler.building.plan import Plan
from tiler.stores import Store
from tiler.stores.dataset import Dataset
from tiler.tasks.ledger import Ledger

_DIGEST_BYTES: Final = 16
_MANY_PATCHES: Final = 16
"""With so many the next update puts them together: looking a block up takes 0.4 us longer with each."""


@dataclass(frozen=True, slots=True)
class Published:
    """What publishing did: the new manifest, and what no manifest names any more, as keys and as prefixes."""

    manifest: Manifest
    changed: bool
    superseded_keys: list[str]
    superseded_paths: list[str]


def publish_layer(plan: Plan, store: Store, path: str, ledger: Ledger, dataset: Manifest | None, continued: bool) -> Published:
    """Publish a layer whose blocks all lie under ``path``, in place of the one that ``dataset`` may have.

    ``continued`` says that another build was at work under ``path`` before: of a source that may have changed since.
    """
    if continued:
        _clear(plan, store, path, [ledger.stored(level) for level in range(plan.lattice.levels)])
    _write_indexes(store, path, ledger, plan.lattice)
    replaced = None if dataset is None else dataset.layers.get(plan.name)
    manifest = _write_manifest(plan, store, dataset, _layer_entry(plan, path, [], ledger))
    return Published(manifest, True, [], [] if replaced is None else replaced.paths)


def publish_update(plan: Plan, store: Store, path: str, ledger: Ledger, published: Dataset, continued: bool) -> Published:
    """Publish a layer of which ``path`` has the blocks that differ from those of ``published``; nothing happens if nothing differs."""
    old = published.manifest.layers[plan.name]
    levels = range(plan.lattice.levels)
    before = [_read_index(published, plan.name, level) for level in levels]
    # The records in an index hold the range of the samples before they are encoded: it may differ where no block does.
    if all(ledger.index(level) == index for level, index in zip(levels, before, strict=True)):
        entry = _layer_entry(plan, old.path, old.patches, ledger)
        if entry == old:
            return Published(published.manifest, False, [], [])
        return Published(_write_manifest(plan, store, published.manifest, entry), True, [], [])
    changed = [_changed(ledger.index(level), index) for level, index in zip(levels, before, strict=True)]
    differing, stored = [pair[0] for pair in changed], [pair[1] for pair in changed]
    if continued:
        _clear(plan, store, path, stored)
    _write_indexes(store, path, ledger, plan.lattice)
    counts = [level.columns * level.rows for level in old.levels]
    if len(old.patches) >= _MANY_PATCHES:
        differing, stored = _merged(plan, store, path, old, differing, stored, counts)
    patches, dropped = _trimmed(old, differing, counts)
    patch = Patch(path=path, levels=[pack_bitmap(bitmap, count) for bitmap, count in zip(stored, counts, strict=True)])
    manifest = _write_manifest(plan, store, published.manifest, _layer_entry(plan, old.path, [*patches, patch], ledger))
    keys = [old.index_key(level) for level in levels]
    keys += [old.block_key(plan.name, address) for address in _addresses(plan.lattice, differing)]
    return Published(manifest, True, [key for key in keys if key.partition("/")[0] not in dropped], dropped)


def _read_index(published: Dataset, name: str, level: int) -> bytes | None:
    """Return the bytes of a published index, None if it is damaged: then every block of the level counts as changed."""
    try:
        return published.index(name, level).data
    except (InputError, NotFoundError):
        return None


def _clear(plan: Plan, store: Store, path: str, stored: list[bytes]) -> None:
    delete_unnamed(store, path, plan.name, plan.lattice, plan.codec.suffix, stored)


def _merged(
    plan: Plan, store: Store, path: str, old: Layer, differing: list[bytes], stored: list[bytes], counts: list[int]
) -> tuple[list[bytes], list[bytes]]:
    """Copy the blocks of all older patches under ``path``: every patch costs readers time, on every block."""
    moved = [bytes(len(bitmap)) for bitmap in differing]
    for patch in old.patches:
        moved = [_or(a, b) for a, b in zip(moved, _left_of(patch, differing, counts), strict=True)]
    for address in _addresses(plan.lattice, moved):
        key = block_key(path, plan.name, address, plan.lattice.levels, plan.codec.suffix)
        store.write(key, store.read(old.block_key(plan.name, address)))
    return [_or(a, b) for a, b in zip(differing, moved, strict=True)], [_or(a, b) for a, b in zip(stored, moved, strict=True)]


def _left_of(patch: Patch, changed: list[bytes], counts: list[int]) -> list[bytes]:
    """Return the bitmaps of the blocks of a patch that are not ``changed``."""
    own = [unpack_bitmap(text, count, f"patch {patch.path!r}") for text, count in zip(patch.levels, counts, strict=True)]
    return [_without(bitmap, gone) for bitmap, gone in zip(own, changed, strict=True)]


def _or(a: bytes, b: bytes) -> bytes:
    return (int.from_bytes(a, "little") | int.from_bytes(b, "little")).to_bytes(len(a), "little")


def _without(a: bytes, b: bytes) -> bytes:
    return (int.from_bytes(a, "little") & ~int.from_bytes(b, "little")).to_bytes(len(a), "little")


def _changed(new: bytes, old: bytes | None) -> tuple[bytes, bytes]:
    """Return the bitmaps of the blocks whose bytes differ between two indexes, and of those among them that are stored now."""
    digests = np.frombuffer(new, np.uint8).reshape(-1, RECORD_BYTES)[:, :_DIGEST_BYTES]
    before = None if old is None else np.frombuffer(old, np.uint8).reshape(-1, RECORD_BYTES)[:, :_DIGEST_BYTES]
    differing = np.ones(len(digests), np.bool_) if before is None else (digests != before).any(axis=1)
    stored = differing & digests.any(axis=1)
    return np.packbits(differing, bitorder="little").tobytes(), np.packbits(stored, bitorder="little").tobytes()


def _trimmed(old: Layer, changed: list[bytes], counts: list[int]) -> tuple[list[Patch], list[str]]:
    """Return the layer's patches without the blocks that are ``changed``, and the paths of those that have none left."""
    patches, dropped = [], []
    for patch in old.patches:
        left = _left_of(patch, changed, counts)
        if any(map(any, left)):
            levels = [pack_bitmap(bitmap, count) for bitmap, count in zip(left, counts, strict=True)]
            patches.append(Patch(path=patch.path, levels=levels))
        else:
            dropped.append(patch.path)
    return patches, dropped


def _addresses(lattice: Lattice, bitmaps: list[bytes]) -> Iterator[BlockAddress]:
    for level, bitmap in enumerate(bitmaps):
        columns = lattice.block_counts(level)[0]
        for place, byte in enumerate(bitmap):
            for bit in range(8) if byte else ():
                if byte >> bit & 1:
                    y, x = divmod(8 * place + bit, columns)
                    yield BlockAddress(level, x, y)


def _write_indexes(store: Store, path: str, ledger: Ledger, lattice: Lattice) -> None:
    for level in range(lattice.levels):
        store.write(index_key(path, level), ledger.index(level))


def _write_manifest(plan: Plan, store: Store, dataset: Manifest | None, entry: Layer) -> Manifest:
    layers = {} if dataset is None else dict(dataset.layers)
    layers[plan.name] = entry
    manifest = Manifest.create(generator=f"clipmap {version('clipmap')}", world=plan.placement.world, layers=layers)
    store.sync()
    store.write(MANIFEST_NAME, manifest.to_json())
    store.sync()
    return manifest


def _layer_entry(plan: Plan, path: str, patches: list[Patch], ledger: Ledger) -> Layer:
    kernel = plan.recipe.kernel
    return Layer(
        kind=plan.source.conversion.kind,
        path=path,
        patches=patches,
        registration=plan.lattice.registration,
        width=plan.lattice.width,
        height=plan.lattice.height,
        block=plan.lattice.block,
        pad=plan.lattice.pad,
        channels=plan.block.channels,
        alpha=plan.block.alpha,
        dtype=plan.block.dtype,
        unit="metre" if plan.source.conversion.kind == "height" else None,
        codec=plan.codec.spec,
        suffix=plan.codec.suffix,
        media_type=plan.codec.media_type,
        max_error=plan.codec.max_error,
        transform=plan.placement.transform,
        ground_spacing_m=plan.placement.ground_spacing_m,
        filter=Filter(
            kernel=kernel.name,
            radius=kernel.radius,
            edge=plan.recipe.edge,
            clamp="local" if plan.recipe.clamp else "none",
            linear_light=plan.linear_light,
        ),
        source=_source_entry(plan),
        fill=plan.fill,
        enhance=plan.enhance,
        light=plan.light,
        normals=plan.normals,
        statistics=ledger.statistics(),
        levels=[ledger.level(level) for level in range(plan.lattice.levels)],
    )


def _source_entry(plan: Plan) -> Source:
    info, conversion = plan.source.info, plan.source.conversion
    return Source(
        name=info.path.name,
        files=max(1, len({part.path for part in info.parts})),
        format=info.format,
        width=info.width,
        height=info.height,
        channels=info.channels,
        dtype=info.dtype.name,
        file_bytes=info.file_bytes,
        nodata=conversion.nodata,
        decode=conversion.decode,
        scale=conversion.scale,
        offset=conversion.offset,
        stretch=None if conversion.stretch is None else list(conversion.stretch),
        placement=plan.placement.how,
    )
