"""What parts of a dataset say of each other: manifest of index, index of files, index of samples. Each check returns findings."""

from math import isfinite
from typing import Final

import numpy as np

from schemas.address import BlockAddress, parse_block_name
from schemas.blockindex import RECORD_BYTES, BlockIndex, BlockRecord
from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.findings import Finding, FindingKind
from schemas.manifest import Layer, Level, digest
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.stores.dataset import Dataset
from tiler.tasks.measure import measure
from tiler.tasks.records import TASKS

REBUILD: Final = "rebuild the layer (clipmap build --overwrite)"
RESTORE: Final = "restore it with clipmap verify --repair, or rebuild the layer (clipmap build --overwrite)"
"""What helps where bytes differ from their digest: they can be made again, and checked against it."""


def finding(
    kind: FindingKind,
    dataset: Dataset,
    name: str,
    what: str,
    remedy: str,
    address: BlockAddress | None = None,
    *,
    level: int | None = None,
    file: str | None = None,
) -> Finding:
    """Return a finding about a block, a level or a layer; its file, unless given, is the block's, the index's or the manifest."""
    layer = dataset.manifest.layer(name)
    if file is None:
        file = layer.block_key(name, address) if address else "manifest.json" if level is None else layer.index_key(level)
    if address is not None:
        level = address.level
    x, y = (None, None) if address is None else (address.x, address.y)
    # Errors of a store begin with the path, which the finding names already.
    what = what.removeprefix(f"{dataset.store.location}/{file}: ")
    return Finding(kind=kind, layer=name, level=level, x=x, y=y, file=file, what=what, remedy=remedy)


def check_codec(reader: BlockReader) -> list[Finding]:
    """Compare what the manifest says of a layer's codec with the codec itself."""
    layer, codec = reader.layer, reader.codec
    claims = {
        "codec": (layer.codec, codec.spec),
        "suffix": (layer.suffix, codec.suffix),
        "media_type": (layer.media_type, codec.media_type),
        "max_error": (layer.max_error, codec.max_error),
    }
    return [
        finding("codec", reader.dataset, reader.name, f"{name} is {said!r}, but that of codec {codec.spec} is {true!r}", REBUILD)
        for name, (said, true) in claims.items()
        if said != true
    ]


def check_index(dataset: Dataset, name: str, number: int) -> tuple[BlockIndex | None, list[Finding]]:
    """Return a level's index, None if it cannot be trusted, and what is wrong with it or with what the manifest says of it."""
    layer = dataset.manifest.layer(name)
    level = layer.levels[number]
    blocks = level.columns * level.rows

    def wrong(kind: FindingKind, what: str) -> Finding:
        return finding(kind, dataset, name, what, RESTORE, level=number)

    skipped = f"the level's {blocks} blocks were not checked"
    try:
        data = dataset.store.read(layer.index_key(number))
    except NotFoundError:
        return None, [wrong("index", f"the index is missing; {skipped}")]
    except StorageError as error:
        return None, [wrong("unreadable", f"{error}; {skipped}")]
    if len(data) != blocks * RECORD_BYTES:
        return None, [wrong("index", f"has {len(data)} bytes instead of {blocks * RECORD_BYTES} for {blocks} blocks; {skipped}")]
    if digest(data) != level.index:
        return None, [wrong("index", f"differs from the digest in the manifest; {skipped}")]
    index = BlockIndex(data, blocks, layer.index_key(number))
    return index, [
        finding(kind, dataset, name, what, REBUILD, level=number, file="manifest.json") for kind, what in _against_manifest(level, index)
    ]


def _against_manifest(level: Level, index: BlockIndex) -> list[tuple[FindingKind, str]]:
    """Compare the counts and the availability that the manifest says with those of the index."""
    found: list[tuple[FindingKind, str]] = []
    bitmap = bytearray(-(-len(index) // 8))
    stored_bytes = 0
    for number, record in enumerate(index):
        if not record.blank:
            bitmap[number // 8] |= 1 << number % 8
            stored_bytes += record.length_bytes
    stored = int.from_bytes(bitmap, "little").bit_count()
    for what, said, true in (
        ("stored", level.stored, stored),
        ("blank", level.blank, len(index) - stored),
        ("stored_bytes", level.stored_bytes, stored_bytes),
    ):
        if said != true:
            found.append(("counts", f"{what} of level {level.level} is {said}, but the index has {true}"))
    try:
        differing = int.from_bytes(level.stored_bitmap(), "little") ^ int.from_bytes(bitmap, "little")
    except InputError as error:
        return [*found, ("availability", str(error).removeprefix("manifest: ").removesuffix("; rebuild the layer"))]
    if differing:
        y, x = divmod((differing & -differing).bit_length() - 1, level.columns)
        what = (
            f"availability of level {level.level} contradicts the index for {differing.bit_count()} blocks, first for {level.level}/{x}/{y}"
        )
        found.append(("availability", what))
    return found


def check_statistics(dataset: Dataset, name: str, finest: BlockIndex | None) -> list[Finding]:
    """Compare the manifest's statistics with the records of level 0; nothing is found if there is no index to compare with."""
    if finest is None:
        return []
    said = dataset.manifest.layer(name).statistics
    stored = [record for record in finest if not record.blank]
    claims = {
        "valid": (said.valid, sum(record.valid for record in stored)),
        "min": (min(said.min, default=None), min((record.min for record in stored), default=None)),
        "max": (max(said.max, default=None), max((record.max for record in stored), default=None)),
    }
    return [
        finding("statistics", dataset, name, f"statistics.{field} is {claim}, but the index of level 0 has {true}", REBUILD)
        for field, (claim, true) in claims.items()
        if claim != true
    ]


def check_files(dataset: Dataset, name: str, indexes: dict[int, BlockIndex]) -> list[Finding]:
    """Name the files in a layer's folder that no block or index has; hidden ones are unfinished writes and may be there."""
    layer = dataset.manifest.layer(name)
    own = {layer.index_key(level) for level in range(len(layer.levels))}
    found = []
    for key in (key for path in layer.paths for key in dataset.store.keys(path)):
        if key in own or key.split("/")[1] == TASKS:
            continue
        address = _block_of(layer, name, key)
        if address is None:
            found.append(finding("stray", dataset, name, "belongs to no block", "delete it", file=key))
        elif address.level in indexes and indexes[address.level][layer.lattice.block_number(address)].blank:
            found.append(finding("stray", dataset, name, "the block is blank, and has a file all the same", "delete it", address))
    return found


def _block_of(layer: Layer, name: str, key: str) -> BlockAddress | None:
    """Return the block of the lattice whose key this is, None if there is none."""
    try:
        address = parse_block_name(key.rpartition("/")[2]).address
        return address if layer.lattice.contains(address) and layer.block_key(name, address) == key else None
    except UsageError:
        return None


def read_checked(dataset: Dataset, name: str, address: BlockAddress, record: BlockRecord) -> bytes | Finding:
    """Return the bytes of a stored block, or why they are not those that the index means."""
    try:
        data = dataset.store.read(dataset.manifest.layer(name).block_key(name, address))
    except NotFoundError:
        return finding("missing", dataset, name, "the file is missing", RESTORE, address)
    except StorageError as error:
        return finding("unreadable", dataset, name, str(error), "check the disk and the file's permissions", address)
    if len(data) != record.length_bytes:
        return finding("length", dataset, name, f"has {len(data)} bytes, the index says {record.length_bytes}", RESTORE, address)
    if digest(data) != record.digest:
        return finding("digest", dataset, name, "differs from the digest in the index", RESTORE, address)
    return data


def decode_checked(
    reader: BlockReader, address: BlockAddress, record: BlockRecord, data: bytes
) -> tuple[DecodedBlock | None, Finding | None]:
    """Return a block's samples, None if its bytes cannot be decoded, and what is wrong with them, None if nothing is."""
    try:
        whole = reader.decode(data)
    except InputError as error:
        return None, finding("undecodable", reader.dataset, reader.name, f"the digest is right, but {error}", REBUILD, address)
    what = _against_record(reader, record, address, whole)
    return whole, finding("statistics", reader.dataset, reader.name, what, REBUILD, address) if what else None


def _against_record(reader: BlockReader, record: BlockRecord, address: BlockAddress, whole: DecodedBlock) -> str:
    """Say how a decoded block differs from its index record; '' if it does not.

    Lossless codecs must agree exactly, bounded ones within their bound. Of codecs without a bound only the number of valid samples
    is compared, and not that either if it hangs on a lossy alpha channel.
    """
    layer, bound = reader.layer, reader.codec.max_error
    core = reader.core(address, whole)
    count, (minima, maxima, sums) = measure(core.samples, core.valid, layer.channels - layer.alpha)
    if (bound is not None or not layer.alpha) and count != record.valid:
        return f"{count} samples are valid, the index says {record.valid}"
    if not count or bound is None:
        return ""
    if not all(map(isfinite, sums)):
        return "a valid sample is not a finite number"
    for which, decoded, said in (("smallest", minima.min(), record.min), ("largest", maxima.max(), record.max)):
        rounding = float(np.spacing(np.float32(max(abs(decoded), abs(said))))) if bound and layer.dtype == "float32" else 0.0
        if not abs(decoded - said) <= bound + rounding:
            allowed = f", and may differ by {bound:g}" if bound else ""
            return f"the {which} sample is {decoded:.9g}, the index says {said:.9g}{allowed}"
    return ""
