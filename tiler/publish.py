"""From finished tasks to a published layer: indexes, patches, manifest; and what may be deleted once it is published."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version

from schemas.address import BlockAddress, parse_block_name
from schemas.blockindex import RECORD_BYTES
from schemas.errors import UsageError
from schemas.lattice import Lattice
from schemas.manifest import MANIFEST_NAME, Filter, Layer, Manifest, Patch, Source, index_key, pack_bitmap, unpack_bitmap
from tiler.ledger import Ledger
from tiler.plan import Plan
from tiler.records import TASKS
from tiler.stores import Store
from tiler.stores.dataset import Dataset

_DIGEST_BYTES = 16


@dataclass(frozen=True, slots=True)
class Published:
    """What publishing did: the new manifest, and what no manifest names any more, as keys and as prefixes."""

    manifest: Manifest
    changed: bool
    superseded_keys: list[str]
    superseded_paths: list[str]


def publish_layer(plan: Plan, store: Store, path: str, ledger: Ledger, dataset: Manifest | None) -> Published:
    """Publish a layer whose blocks all lie under ``path``, in place of the one that ``dataset`` may have."""
    _write_indexes(store, path, ledger, plan.lattice)
    replaced = None if dataset is None else dataset.layers.get(plan.name)
    manifest = _write_manifest(plan, store, dataset, _layer_entry(plan, path, [], ledger))
    return Published(manifest, True, [], [] if replaced is None else replaced.paths)


def publish_update(plan: Plan, store: Store, path: str, ledger: Ledger, published: Dataset) -> Published:
    """Publish a layer of which ``path`` has the blocks that differ from those of ``published``; nothing happens if nothing differs."""
    old = published.manifest.layers[plan.name]
    changed = [_changed(ledger.index(level), published.index(plan.name, level).data) for level in range(plan.lattice.levels)]
    if not any(any(bitmap) for bitmap, _ in changed):
        entry = _layer_entry(plan, old.path, old.patches, ledger)
        if entry == old:
            return Published(published.manifest, False, [], [])
        return Published(_write_manifest(plan, store, published.manifest, entry), True, [], [])
    _write_indexes(store, path, ledger, plan.lattice)
    counts = [level.columns * level.rows for level in old.levels]
    patches, dropped = _trimmed(old, [bitmap for bitmap, _ in changed], counts)
    stored = [pack_bitmap(bitmap, count) for (_, bitmap), count in zip(changed, counts, strict=True)]
    manifest = _write_manifest(
        plan, store, published.manifest, _layer_entry(plan, old.path, [*patches, Patch(path=path, levels=stored)], ledger)
    )
    keys = [old.index_key(level) for level in range(plan.lattice.levels)]
    keys += [old.block_key(plan.name, address) for address in _addresses(plan.lattice, [bitmap for bitmap, _ in changed])]
    return Published(manifest, True, [key for key in keys if key.partition("/")[0] not in dropped], dropped)


def _changed(new: bytes, old: bytes) -> tuple[bytes, bytes]:
    """Return the bitmaps of the blocks whose bytes differ between two indexes, and of those among them that are stored now."""
    count = len(new) // RECORD_BYTES
    differing, stored = bytearray(-(-count // 8)), bytearray(-(-count // 8))
    for number in range(count if new != old else 0):
        digest = slice(number * RECORD_BYTES, number * RECORD_BYTES + _DIGEST_BYTES)
        if new[digest] != old[digest]:
            differing[number // 8] |= 1 << number % 8
            if any(new[digest]):
                stored[number // 8] |= 1 << number % 8
    return bytes(differing), bytes(stored)


def _trimmed(old: Layer, changed: list[bytes], counts: list[int]) -> tuple[list[Patch], list[str]]:
    """Return the layer's patches without the blocks that are ``changed``, and the paths of those that have none left."""
    patches, dropped = [], []
    for patch in old.patches:
        bitmaps = [unpack_bitmap(text, count, f"patch {patch.path!r}") for text, count in zip(patch.levels, counts, strict=True)]
        left = [
            bytes(own & ~gone & 0xFF for own, gone in zip(bitmap, lost, strict=True)) for bitmap, lost in zip(bitmaps, changed, strict=True)
        ]
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


def find_superseded(store: Store, name: str, layer: Layer) -> list[str]:
    """Return the keys under a layer's paths that older versions of it had: what an update that was killed did not come to delete.

    Files that never were a block of the layer are not among them.
    """
    indexes = {layer.index_key(level) for level in range(len(layer.levels))}
    found = []
    for path in layer.paths:
        for key in store.keys(path):
            folder, _, file = key.removeprefix(f"{path}/").partition("/")
            if folder == TASKS or key in indexes:
                continue
            if key in {index_key(path, level) for level in range(len(layer.levels))}:
                found.append(key)
                continue
            try:
                address = parse_block_name(file).address
            except UsageError:
                continue
            if layer.lattice.contains(address) and layer.block_key(name, address) != key:
                found.append(key)
    return found


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
        kind=plan.block.kind,
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
        unit="metre" if plan.block.kind == "height" else None,
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
