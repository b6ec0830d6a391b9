"""Changing stored datasets, with and without what vouches for the change."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES, BlockRecord, pack_record
from schemas.manifest import Layer, Manifest, digest, parse_manifest
from tiler.codecs import BlockFormat, Mask, Samples, open_codec

Change = Callable[[Samples, Mask], None]


def manifest_of(folder: Path) -> Manifest:
    return parse_manifest((folder / "manifest.json").read_bytes(), str(folder))


def block_path(folder: Path, name: str, address: BlockAddress) -> Path:
    return folder / manifest_of(folder).layers[name].block_key(name, address)


def edit_layer(folder: Path, name: str, **changes: Any) -> None:
    """Change fields of a layer and publish the manifest with a version that fits."""
    manifest = manifest_of(folder)
    layer = Layer.model_validate(json.loads(manifest.layers[name].model_dump_json()) | changes)
    layers = dict(manifest.layers) | {name: layer}
    changed = Manifest.create(generator=manifest.generator, world=manifest.world, layers=layers)
    (folder / "manifest.json").write_bytes(changed.to_json())


def edit_level(folder: Path, name: str, number: int, **changes: Any) -> None:
    """Change fields of a level, as ``edit_layer`` does."""
    levels = [json.loads(level.model_dump_json()) for level in manifest_of(folder).layers[name].levels]
    levels[number] |= changes
    edit_layer(folder, name, levels=levels)


def edit_record(folder: Path, name: str, address: BlockAddress, record: BlockRecord) -> None:
    """Replace a block's record in the index; the manifest's digest and sums follow."""
    layer = manifest_of(folder).layers[name]
    path = folder / layer.index_key(address.level)
    data = bytearray(path.read_bytes())
    first = layer.lattice.block_number(address) * RECORD_BYTES
    data[first : first + RECORD_BYTES] = pack_record(record)
    path.write_bytes(data)
    lengths = [int.from_bytes(data[i + 16 : i + 20], "little") for i in range(0, len(data), RECORD_BYTES)]
    edit_level(folder, name, address.level, index=digest(bytes(data)), stored_bytes=sum(lengths))


def record_of(folder: Path, name: str, address: BlockAddress) -> BlockRecord:
    layer = manifest_of(folder).layers[name]
    first = layer.lattice.block_number(address) * RECORD_BYTES
    data = (folder / layer.index_key(address.level)).read_bytes()[first : first + RECORD_BYTES]
    low, high = np.frombuffer(data[24:], "<f4")
    valid = int.from_bytes(data[20:24], "little")
    return BlockRecord(data[:16].hex(), int.from_bytes(data[16:20], "little"), valid, float(low), float(high))


def replace_bytes(folder: Path, name: str, address: BlockAddress, data: bytes) -> None:
    """Store other bytes for a block, with a digest and a length that fit."""
    block_path(folder, name, address).write_bytes(data)
    old = record_of(folder, name, address)
    edit_record(folder, name, address, BlockRecord(digest(data), len(data), old.valid, old.min, old.max))


def change_samples(folder: Path, name: str, address: BlockAddress, change: Change) -> None:
    """Decode a block with its pad, let ``change`` work on samples and mask, and store it so that every digest fits."""
    layer = manifest_of(folder).layers[name]
    block = BlockFormat(layer.kind, layer.lattice.stored_side, layer.channels, layer.dtype, layer.alpha)
    codec = open_codec(layer.codec, block)
    samples, mask = codec.decode(block_path(folder, name, address).read_bytes())
    samples = samples.copy()
    whole = np.ones(samples.shape[:2], np.bool_) if mask is None else mask.copy()
    change(samples, whole)
    replace_bytes(folder, name, address, codec.encode(samples, whole if layer.kind == "height" else None))
