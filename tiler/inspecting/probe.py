"""What the layers of a dataset hold at one place: the nearest stored sample of every level, not interpolated."""

from math import floor

from schemas.address import BlockAddress, block_name
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.facts import LayerPoint, PointFacts, PointSample
from schemas.manifest import Layer
from tiler.checking.blockreader import BlockReader
from tiler.geodesy import transformed
from tiler.stores.dataset import Dataset

Point = tuple[float, float]

_GEOGRAPHIC = "EPSG:4326"
_GEOGRAPHIC_NAMES = (_GEOGRAPHIC, "OGC:CRS84")


def probe_geographic(dataset: Dataset, longitude_deg: float, latitude_deg: float, names: list[str]) -> PointFacts:
    """Return what the layers ``names`` hold at a place given in WGS 84.

    Raises UsageError if it is no place on Earth or the dataset has no reference system, NotFoundError if no layer reaches there.
    """
    if not -360 <= longitude_deg <= 360 or not -90 <= latitude_deg <= 90:
        raise UsageError(f"--at {longitude_deg:g},{latitude_deg:g}: longitude must be from -360 to 360 degrees, latitude from -90 to 90")
    world = dataset.manifest.world
    if world.crs is None:
        raise UsageError(f"{dataset.store.location}: has no coordinate reference system; use --at-world X,Y or --at-pixel X,Y instead")
    there = _reprojected(_GEOGRAPHIC, world.crs, (longitude_deg, latitude_deg))
    if there is None:
        where = f"{_short(world.crs)}, the system of {dataset.store.location}"
        raise NotFoundError(f"longitude {longitude_deg:g}, latitude {latitude_deg:g} has no place in {where}")
    turns = (0, 360, -360) if world.unit == "degree" else (0,)
    places = [(there[0] + turn, there[1]) for turn in turns]
    return _probe(dataset, next((place for place in places if _inside_any(dataset, place, names)), there), names)


def probe_world(dataset: Dataset, x: float, y: float, names: list[str]) -> PointFacts:
    """Return what the layers ``names`` hold at world coordinates; raises NotFoundError if none reaches there."""
    return _probe(dataset, (x, y), names)


def probe_pixel(dataset: Dataset, column: int, row: int, names: list[str]) -> PointFacts:
    """Return what the layers ``names`` hold at sample (column, row) of level 0.

    Raises UsageError if the layers' samples lie in different places, NotFoundError if there is no such sample.
    """
    layers = [dataset.manifest.layer(name) for name in names]
    first = layers[0]
    if any((layer.width, layer.height, layer.transform, layer.registration) != _frame(first) for layer in layers):
        raise UsageError(f"--at-pixel: samples of {', '.join(names)} lie in different places; name the layer meant, e.g. {names[0]}")
    if not (0 <= column < first.width and 0 <= row < first.height):
        raise NotFoundError(f"sample {column},{row} lies outside layer {names[0]!r}, which has {first.width} x {first.height} samples")
    shift = 0.5 if first.registration == "area" else 0.0
    a, b, c, d, e, f = first.transform
    x, y = column + shift, row + shift
    return _probe(dataset, (a * x + b * y + c, d * x + e * y + f), names, (x, y))


def _probe(dataset: Dataset, place: Point, names: list[str], position: Point | None = None) -> PointFacts:
    """Read every layer at world coordinates ``place``; ``position`` is the same in sample coordinates, where it is known exactly."""
    world = dataset.manifest.world
    if position is None and not _inside_any(dataset, place, names):
        raise NotFoundError(f"{_coordinates(place)} lies outside {dataset.store.location}: {_extents(dataset, names)}")
    return PointFacts(
        dataset=dataset.store.location,
        longitude_latitude=None if world.crs is None else _reprojected(world.crs, _GEOGRAPHIC, place),
        world=place,
        crs=world.crs,
        layers=[_layer_point(dataset, name, position or _position(dataset.manifest.layer(name), place)) for name in names],
    )


def _layer_point(dataset: Dataset, name: str, position: Point) -> LayerPoint:
    layer = dataset.manifest.layer(name)
    levels = []
    if _inside(layer, position):
        reader = BlockReader(dataset, name)
        levels = [_sample(reader, level.level, position) for level in layer.levels]
    return LayerPoint(layer=name, unit=layer.unit, position=position, levels=levels)


def _sample(reader: BlockReader, level: int, position: Point) -> PointSample:
    """Return the sample of ``level`` whose cell holds ``position``, or that is the nearest vertex."""
    layer, lattice = reader.layer, reader.lattice
    half = 0.0 if layer.registration == "area" else 0.5
    column, row = (
        min(max(0, floor(place / 2**level + half)), size - 1) for place, size in zip(position, lattice.level_size(level), strict=True)
    )
    address = BlockAddress(level, column // layer.block, row // layer.block)
    core = reader.read_core(address)
    value = None
    if core is not None and core.valid[row % layer.block, column % layer.block]:
        value = [float(channel) for channel in core.samples[row % layer.block, column % layer.block]]
    name = block_name(reader.name, address, lattice.levels, layer.suffix)
    return PointSample(level=level, sample=(column, row), block=str(address), name=name, value=value)


def _frame(layer: Layer) -> tuple[object, ...]:
    return layer.width, layer.height, layer.transform, layer.registration


def _position(layer: Layer, place: Point) -> Point:
    """Return level-0 sample coordinates of world coordinates; raises InputError if the layer's transform cannot be inverted."""
    a, b, c, d, e, f = layer.transform
    determinant = a * e - b * d
    if determinant == 0:
        raise InputError(f"the transform {layer.transform} of a layer is singular: it cannot be asked for a place; rebuild the layer")
    x, y = place[0] - c, place[1] - f
    return (e * x - b * y) / determinant, (a * y - d * x) / determinant


def _inside(layer: Layer, position: Point) -> bool:
    """Whether a layer has a sample there; a vertex reaches half a sample beyond the outermost ones, as the source's pixels do."""
    first = 0.0 if layer.registration == "area" else -0.5
    return all(first <= place <= size + first for place, size in zip(position, (layer.width, layer.height), strict=True))


def _inside_any(dataset: Dataset, place: Point, names: list[str]) -> bool:
    layers = (dataset.manifest.layer(name) for name in names)
    return any(_inside(layer, _position(layer, place)) for layer in layers)


def _reprojected(source: str, target: str, place: Point) -> Point | None:
    """Return ``place`` in another coordinate system, x or longitude first; None where that cannot be."""
    if source in _GEOGRAPHIC_NAMES and target in _GEOGRAPHIC_NAMES:
        return place
    found = transformed(source, target, [place[0]], [place[1]])
    return None if found is None else (float(found[0][0]), float(found[1][0]))


def _extents(dataset: Dataset, names: list[str]) -> str:
    boxes = {name: dataset.manifest.layer(name).extent for name in names}
    return "; ".join(f"{name} reaches from {_coordinates(box[:2])} to {_coordinates(box[2:])}" for name, box in boxes.items())


def _coordinates(place: tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in place)


def _short(crs: str) -> str:
    return crs if len(crs) <= 40 else f"{crs[:37]}..."
