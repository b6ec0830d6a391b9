"""What there is to say about a dataset, a layer, a level or a block."""

from math import ceil

import numpy as np

from schemas.address import BlockAddress, block_name, parse_block_name, quadcode
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.facts import BlockFacts, CoverageMap, DatasetFacts, Extent, LayerFacts, LevelFacts, LevelSummary
from schemas.manifest import Layer, Level
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.inspecting.footprint import measure_footprint
from tiler.stores.dataset import Dataset
from tiler.tasks.measure import measure


def describe_dataset(dataset: Dataset) -> DatasetFacts:
    """Return the facts of a dataset: version, coordinate system, every layer."""
    manifest = dataset.manifest
    return DatasetFacts(
        dataset=dataset.store.location,
        version=manifest.version,
        generator=manifest.generator,
        format_version=manifest.format_version,
        crs=manifest.world.crs,
        unit=manifest.world.unit,
        layers=[describe_layer(dataset, name) for name in manifest.layers],
    )


def describe_layer(dataset: Dataset, name: str) -> LayerFacts:
    """Return the facts of a layer; raises NotFoundError if there is none of that name."""
    layer = dataset.manifest.layer(name)
    return LayerFacts(
        layer=name,
        kind=layer.kind,
        width=layer.width,
        height=layer.height,
        patches=len(layer.patches),
        registration=layer.registration,
        channels=layer.channels,
        alpha=layer.alpha,
        dtype=layer.dtype,
        sample_unit=layer.unit,
        block=layer.block,
        pad=layer.pad,
        codec=layer.codec,
        max_error=layer.max_error,
        filter=layer.filter,
        fill=layer.fill,
        enhance=layer.enhance,
        light=layer.light,
        normals=layer.normals,
        transform=layer.transform,
        extent=layer.extent,
        ground_spacing_m=layer.ground_spacing_m,
        footprint=measure_footprint(layer, dataset.manifest.world.crs),
        source=layer.source,
        statistics=layer.statistics,
        valid_share=layer.statistics.valid / (layer.width * layer.height),
        blocks_stored=sum(level.stored for level in layer.levels),
        blocks_blank=sum(level.blank for level in layer.levels),
        stored_bytes=sum(level.stored_bytes for level in layer.levels),
        levels=[_level_summary(layer, level) for level in layer.levels],
    )


def describe_level(dataset: Dataset, name: str, number: int, cells: int = 64) -> LevelFacts:
    """Return the facts of a level with the range of its values and a map of at most ``cells`` x ``cells`` cells.

    Raises NotFoundError if the level does not exist, InputError if its index is damaged.
    """
    layer = dataset.manifest.layer(name)
    layer.lattice.level_size(number)
    stored = [record for record in dataset.index(name, number) if not record.blank]
    footprint = measure_footprint(layer, dataset.manifest.world.crs)
    return LevelFacts(
        **_level_summary(layer, layer.levels[number]).model_dump(),
        dataset=dataset.store.location,
        layer=name,
        row_spacing_m=None if footprint is None else _coarser(footprint.row_spacing_m, number),
        column_spacing_m=None if footprint is None else _coarser(footprint.column_spacing_m, number),
        min=min((record.min for record in stored), default=None),
        max=max((record.max for record in stored), default=None),
        valid=sum(record.valid for record in stored),
        block_bytes_min=min((record.length_bytes for record in stored), default=None),
        block_bytes_max=max((record.length_bytes for record in stored), default=None),
        coverage=_coverage_map(dataset, name, number, cells),
    )


def _coarser(spacing_m: tuple[float, float], level: int) -> tuple[float, float]:
    """Return a spacing of level 0 for ``level``, whose samples lie ``2**level`` times as far apart."""
    return spacing_m[0] * 2**level, spacing_m[1] * 2**level


def describe_block(dataset: Dataset, name: str, address: BlockAddress) -> tuple[BlockFacts, DecodedBlock | None]:
    """Return the facts of a block, and its decoded core: None if it is blank or damaged.

    Raises NotFoundError outside the lattice, InputError if the index is damaged.
    """
    layer = dataset.manifest.layer(name)
    lattice = layer.lattice
    record = dataset.record(name, address)
    core = lattice.valid_core(address)
    intact, decoded = _decoded(dataset, name, address)
    minima, maxima, means = (None, None, None) if decoded is None else _measured(layer, decoded)
    facts = BlockFacts(
        dataset=dataset.store.location,
        layer=name,
        level=address.level,
        x=address.x,
        y=address.y,
        quadcode=quadcode(address, lattice.levels),
        name=block_name(name, address, lattice.levels, layer.suffix),
        key=layer.block_key(name, address),
        samples=(core.x0, core.y0, core.x1, core.y1),
        extent=_block_extent(layer, address),
        blank=record.blank,
        stored_bytes=record.length_bytes,
        digest=record.digest or None,
        intact=intact,
        valid=record.valid,
        min=None if record.blank else record.min,
        max=None if record.blank else record.max,
        decoded_min=minima,
        decoded_max=maxima,
        decoded_mean=means,
        parent=str(address.parent) if address.level + 1 < lattice.levels else None,
        children=[str(child) for child in address.children() if lattice.contains(child)],
        neighbours=[str(other) for other in address.neighbours() if lattice.contains(other)],
    )
    return facts, decoded


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
    if len(numbers) not in (0, 1, 3) or not all(number.isascii() and number.isdecimal() and len(number) < 20 for number in numbers):
        shown = target if len(target) <= 60 else f"{target[:57]}..."
        raise UsageError(f"{shown!r}: expected LAYER, LAYER/LEVEL, LAYER/LEVEL/X/Y or the name of a block")
    dataset.manifest.layer(name)
    if not numbers:
        return name, None, None
    level = int(numbers[0])
    return name, level, BlockAddress(level, int(numbers[1]), int(numbers[2])) if len(numbers) == 3 else None


def _level_summary(layer: Layer, level: Level) -> LevelSummary:
    spacing = layer.ground_spacing_m
    return LevelSummary(
        **level.model_dump(exclude={"availability", "index"}),
        ground_spacing_m=None if spacing is None else _coarser(spacing, level.level),
    )


def _coverage_map(dataset: Dataset, name: str, number: int, cells: int) -> CoverageMap:
    lattice = dataset.manifest.layer(name).lattice
    columns, rows = lattice.block_counts(number)
    step = ceil(max(columns, rows) / cells)
    shape = -(-rows // step), -(-columns // step)
    valid, whole = np.zeros(shape), np.zeros(shape)
    for address, record in zip(lattice.addresses(number), dataset.index(name, number), strict=True):
        cell = address.y // step, address.x // step
        valid[cell] += record.valid
        whole[cell] += lattice.valid_core(address).area
    return CoverageMap(blocks_per_cell=step, valid_share=(valid / whole).tolist())


def _decoded(dataset: Dataset, name: str, address: BlockAddress) -> tuple[bool, DecodedBlock | None]:
    """Return whether a block's stored bytes are intact, and its core if there is one."""
    reader = BlockReader(dataset, name)
    try:
        return True, reader.read_core(address)
    except (InputError, NotFoundError):
        return False, None


def _measured(layer: Layer, core: DecodedBlock) -> tuple[list[float], list[float], list[float]] | tuple[None, None, None]:
    """Return minimum, maximum and mean per colour channel of the valid samples; nothing if none is valid."""
    count, (minima, maxima, sums) = measure(core.samples, core.valid, layer.channels - layer.alpha)
    return (minima.tolist(), maxima.tolist(), (sums / count).tolist()) if count else (None, None, None)


def _block_extent(layer: Layer, address: BlockAddress) -> Extent:
    """(x min, y min, x max, y max) in world coordinates of what the block's samples stand for."""
    core = layer.lattice.valid_core(address)
    last = 0 if layer.registration == "area" else 1
    a, b, c, d, e, f = layer.transform
    scale = 2**address.level
    right, bottom = min(scale * (core.x1 - last), layer.width - last), min(scale * (core.y1 - last), layer.height - last)
    corners = [(x, y) for x in (scale * core.x0, right) for y in (scale * core.y0, bottom)]
    xs, ys = zip(*((a * x + b * y + c, d * x + e * y + f) for x, y in corners), strict=True)
    return min(xs), min(ys), max(xs), max(ys)
