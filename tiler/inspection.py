"""What there is to say about a dataset, a layer, a level or a block, as plain dictionaries; nothing is decoded."""

from typing import Any

from schemas.address import BlockAddress, block_name, parse_block_name, quadcode
from schemas.errors import NotFoundError, UsageError
from schemas.manifest import Layer, Level, digest
from tiler.stores.dataset import Dataset

Facts = dict[str, Any]


def describe_dataset(dataset: Dataset) -> Facts:
    """Return the facts of a dataset: version, coordinate system, every layer."""
    manifest = dataset.manifest
    return {
        "dataset": dataset.store.location,
        "version": manifest.version,
        "generator": manifest.generator,
        "format_version": manifest.format_version,
        "crs": manifest.world.crs,
        "unit": manifest.world.unit,
        "layers": [describe_layer(dataset, name) for name in manifest.layers],
    }


def describe_layer(dataset: Dataset, name: str) -> Facts:
    """Return the facts of a layer; raises NotFoundError if there is none of that name."""
    layer = dataset.manifest.layer(name)
    return {
        "layer": name,
        "kind": layer.kind,
        "width": layer.width,
        "height": layer.height,
        "registration": layer.registration,
        "channels": layer.channels,
        "alpha": layer.alpha,
        "dtype": layer.dtype,
        "sample_unit": layer.unit,
        "block": layer.block,
        "pad": layer.pad,
        "codec": layer.codec,
        "max_error": layer.max_error,
        "filter": layer.filter.model_dump(mode="json"),
        "transform": list(layer.transform),
        "extent": list(layer.extent),
        "ground_spacing_m": None if layer.ground_spacing_m is None else list(layer.ground_spacing_m),
        "source": layer.source.model_dump(mode="json"),
        "statistics": layer.statistics.model_dump(mode="json"),
        "valid_share": layer.statistics.valid / (layer.width * layer.height),
        "blocks_stored": sum(level.stored for level in layer.levels),
        "blocks_blank": sum(level.blank for level in layer.levels),
        "stored_bytes": sum(level.stored_bytes for level in layer.levels),
        "levels": [_level_facts(layer, level) for level in layer.levels],
    }


def describe_level(dataset: Dataset, name: str, number: int) -> Facts:
    """Return the facts of a level with the range of its values; raises NotFoundError if it does not exist."""
    layer = dataset.manifest.layer(name)
    layer.lattice.level_size(number)
    stored = [record for record in dataset.index(name, number) if not record.blank]
    facts = {"dataset": dataset.store.location, "layer": name, **_level_facts(layer, layer.levels[number])}
    return {
        **facts,
        "min": min((record.min for record in stored), default=None),
        "max": max((record.max for record in stored), default=None),
        "valid": sum(record.valid for record in stored),
        "block_bytes_min": min((record.length_bytes for record in stored), default=None),
        "block_bytes_max": max((record.length_bytes for record in stored), default=None),
    }


def describe_block(dataset: Dataset, name: str, address: BlockAddress) -> Facts:
    """Return the facts of a block and whether its stored bytes are intact; raises NotFoundError outside the lattice."""
    layer = dataset.manifest.layer(name)
    lattice = layer.lattice
    record = dataset.record(name, address)
    core = lattice.valid_core(address)
    parent = address.parent if address.level + 1 < lattice.levels else None
    return {
        "dataset": dataset.store.location,
        "layer": name,
        "level": address.level,
        "x": address.x,
        "y": address.y,
        "quadcode": quadcode(address, lattice.levels),
        "name": block_name(name, address, lattice.levels, layer.suffix),
        "key": layer.block_key(name, address),
        "samples": [core.x0, core.y0, core.x1, core.y1],
        "extent": _block_extent(layer, address),
        "blank": record.blank,
        "stored_bytes": record.length_bytes,
        "digest": record.digest or None,
        "intact": _intact(dataset, name, address),
        "valid": record.valid,
        "min": None if record.blank else record.min,
        "max": None if record.blank else record.max,
        "parent": None if parent is None else str(parent),
        "children": [str(child) for child in address.children() if lattice.contains(child)],
        "neighbours": [str(other) for other in address.neighbours() if lattice.contains(other)],
    }


def parse_target(dataset: Dataset, target: str) -> tuple[str, int | None, BlockAddress | None]:
    """Split ``LAYER``, ``LAYER/LEVEL``, ``LAYER/LEVEL/X/Y`` or a block name into layer, level and address.

    Raises UsageError if ``target`` has none of these forms, NotFoundError if the dataset has no such thing.
    """
    if "." in target and "/" not in target:
        parsed = parse_block_name(target)
        layer = dataset.manifest.layer(parsed.layer)
        if (parsed.levels, parsed.suffix) != (len(layer.levels), layer.suffix):
            example = block_name(parsed.layer, BlockAddress(0, 0, 0), len(layer.levels), layer.suffix)
            raise NotFoundError(f"{target}: layer {parsed.layer!r} has {len(layer.levels)} levels, its blocks are called like {example}")
        return parsed.layer, parsed.address.level, parsed.address
    name, *numbers = target.split("/")
    if len(numbers) not in (0, 1, 3) or not all(number.isascii() and number.isdecimal() for number in numbers):
        raise UsageError(f"{target!r}: expected LAYER, LAYER/LEVEL, LAYER/LEVEL/X/Y or the name of a block")
    dataset.manifest.layer(name)
    if not numbers:
        return name, None, None
    level = int(numbers[0])
    return name, level, BlockAddress(level, int(numbers[1]), int(numbers[2])) if len(numbers) == 3 else None


def _level_facts(layer: Layer, level: Level) -> Facts:
    facts = level.model_dump(mode="json", exclude={"availability", "index"})
    spacing = layer.ground_spacing_m
    facts["ground_spacing_m"] = None if spacing is None else [distance * 2**level.level for distance in spacing]
    return facts


def _block_extent(layer: Layer, address: BlockAddress) -> list[float]:
    """(x min, y min, x max, y max) in world coordinates of what the block's samples stand for."""
    core = layer.lattice.valid_core(address)
    last = 0 if layer.registration == "area" else 1
    a, b, c, d, e, f = layer.transform
    scale = 2**address.level
    right, bottom = min(scale * (core.x1 - last), layer.width - last), min(scale * (core.y1 - last), layer.height - last)
    corners = [(x, y) for x in (scale * core.x0, right) for y in (scale * core.y0, bottom)]
    xs, ys = zip(*((a * x + b * y + c, d * x + e * y + f) for x, y in corners), strict=True)
    return [min(xs), min(ys), max(xs), max(ys)]


def _intact(dataset: Dataset, name: str, address: BlockAddress) -> bool:
    record = dataset.record(name, address)
    if record.blank:
        return True
    try:
        data = dataset.store.read(dataset.manifest.layer(name).block_key(name, address))
    except NotFoundError:
        return False
    return digest(data) == record.digest
