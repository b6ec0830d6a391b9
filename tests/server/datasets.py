"""Writes small datasets of arbitrary bytes, without the build: what a server hands out it never looks into."""

import random
from collections.abc import Collection
from pathlib import Path

from schemas.address import BlockAddress, block_name
from schemas.blockindex import BLANK, BlockRecord, pack_record
from schemas.lattice import Lattice
from schemas.manifest import Filter, Layer, LayerKind, Level, Manifest, Source, Statistics, World, digest, pack_bitmap

FORMATS: dict[LayerKind, tuple[str, str, str]] = {
    "imagery": ("webp:90", "webp", "image/webp"),
    "height": ("lerc:0.01", "lerc", "application/octet-stream"),
}


def block_bytes(seed: int, address: BlockAddress) -> bytes:
    """What the writer stores for a block: 200 to 455 bytes that differ from block to block and from seed to seed."""
    draw = random.Random(f"{seed} {address}")
    return draw.randbytes(draw.randrange(200, 456))


def write_layer(
    folder: Path, name: str, kind: LayerKind, size: tuple[int, int], *, seed: int, blank: Collection[BlockAddress] = (), block: int = 4
) -> Layer:
    """Store the blocks and indexes of a layer below ``folder`` and return its part of the manifest."""
    lattice = Lattice(*size, block, "area" if kind == "imagery" else "point")
    codec, suffix, media_type = FORMATS[kind]
    path = f"{name}.{seed}"
    levels = []
    for level in range(lattice.levels):
        parent = folder / path / str(level)
        parent.mkdir(parents=True)
        records = []
        for address in lattice.addresses(level):
            if address in blank:
                records.append(BLANK)
                continue
            data = block_bytes(seed, address)
            (parent / block_name(name, address, lattice.levels, suffix)).write_bytes(data)
            records.append(BlockRecord(digest(data), len(data), block * block, 0.0, 1.0))
        levels.append(_level(lattice, level, records, parent))
    return Layer(
        kind=kind,
        path=path,
        registration=lattice.registration,
        width=size[0],
        height=size[1],
        block=block,
        pad=0,
        channels=3 if kind == "imagery" else 1,
        alpha=False,
        dtype="uint8" if kind == "imagery" else "float32",
        unit=None if kind == "imagery" else "metre",
        codec=codec,
        suffix=suffix,
        media_type=media_type,
        max_error=None,
        transform=(2.0, 0.0, 100.0, 0.0, -2.0, 500.0),
        ground_spacing_m=(2.0, 2.0),
        filter=Filter(kernel="blackman-sinc", radius=3, edge="mirror"),
        source=_source(size),
        statistics=Statistics(min=[0.0], max=[1.0], mean=[0.5], valid=size[0] * size[1]),
        levels=levels,
    )


def _level(lattice: Lattice, level: int, records: list[BlockRecord], folder: Path) -> Level:
    index = b"".join(map(pack_record, records))
    (folder / "index.bin").write_bytes(index)
    bitmap = sum((not record.blank) << number for number, record in enumerate(records))
    width, height = lattice.level_size(level)
    columns, rows = lattice.block_counts(level)
    return Level(
        level=level,
        width=width,
        height=height,
        columns=columns,
        rows=rows,
        stored=sum(not record.blank for record in records),
        blank=sum(record.blank for record in records),
        stored_bytes=sum(record.length_bytes for record in records),
        availability=pack_bitmap(bitmap.to_bytes(-(-len(records) // 8), "little"), len(records)),
        index=digest(index),
    )


def _source(size: tuple[int, int]) -> Source:
    return Source(
        name="source.tif",
        format="tiff",
        width=size[0],
        height=size[1],
        channels=1,
        dtype="uint8",
        file_bytes=1,
        nodata=None,
        decode=None,
        scale=1.0,
        offset=0.0,
        placement="georeferenced",
    )


def publish(folder: Path, layers: dict[str, Layer]) -> Manifest:
    """Write the manifest of ``layers`` as a build does: to another name, then renamed."""
    manifest = Manifest.create(generator="tests", world=World(crs="EPSG:32632", unit="metre"), layers=layers)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / ".tmp-manifest.json"
    temporary.write_bytes(manifest.to_json())
    temporary.replace(folder / "manifest.json")
    return manifest


def write_dataset(folder: Path, *, seed: int = 1, blank: Collection[BlockAddress] = (), size: tuple[int, int] = (19, 13)) -> Manifest:
    """Write a dataset with a height and an imagery layer of the same size; the height layer has ``blank`` blocks.

    19 x 13 samples in blocks of 4 make levels of 5 x 4, 3 x 2, 2 x 1 and 1 x 1 blocks.
    """
    layers = {
        "height": write_layer(folder, "height", "height", size, seed=seed, blank=blank),
        "imagery": write_layer(folder, "imagery", "imagery", size, seed=seed + 1000),
    }
    return publish(folder, layers)
