"""Where a layer lies in the world: by its file's georeference, by a given spacing, or over the dataset's extent."""

from dataclasses import dataclass
from math import hypot
from typing import Literal

from schemas.errors import UsageError
from schemas.lattice import Registration
from schemas.manifest import Layer, Manifest, Transform, World
from tiler.geodesy import ground_spacing_m
from tiler.sources import FileInfo


@dataclass(frozen=True, slots=True)
class Placement:
    """A layer's coordinate system and transform, how it was found, and the ground distance between samples [m] if known."""

    world: World
    transform: Transform
    how: Literal["georeferenced", "spacing", "fitted", "assumed"]
    ground_spacing_m: tuple[float, float] | None


def place(info: FileInfo, registration: Registration, spacing: float | None, dataset: Manifest | None, name: str) -> Placement:
    """Return where the layer ``name`` made from a file of ``info`` lies, beside the other layers of ``dataset``.

    Raises UsageError if the file's place, ``spacing`` [m] and the dataset contradict each other.
    """
    others = {} if dataset is None else {key: layer for key, layer in dataset.layers.items() if key != name}
    world = dataset.world if dataset is not None and others else None
    georeference = info.georeference
    how: Literal["georeferenced", "spacing", "fitted", "assumed"]
    if georeference is not None:
        if spacing is not None:
            raise UsageError(f"{info.path}: has a georeference; leave out --spacing")
        found = World(crs=georeference.crs, unit=georeference.unit)
        transform, how = _registered(georeference.transform, registration), "georeferenced"
    elif spacing is not None:
        found, how = World(crs=None, unit="metre"), "spacing"
        transform = (spacing, 0.0, 0.0, 0.0, -spacing, 0.0)
    elif world is not None:
        reference = others.get("height") or next(iter(others.values()))
        found, how = world, "fitted"
        transform = _fitted(reference, info.width, info.height, registration)
    else:
        found, how = World(crs=None, unit="unknown"), "assumed"
        transform = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    if world is not None and found != world:
        raise UsageError(
            f"{info.path}: is in {_named(found)}, but the dataset is in {_named(world)}; "
            "bring the file there first, e.g. with gdalwarp -t_srs, or build another dataset"
        )
    return Placement(found, transform, how, _spacing_m(found, transform, info))


def _registered(transform: Transform, registration: Registration) -> Transform:
    """Turn a transform of pixel corners into one of sample coordinates: a vertex sits in its pixel's centre."""
    if registration == "area":
        return transform
    a, b, c, d, e, f = transform
    return a, b, c + (a + b) / 2, d, e, f + (d + e) / 2


def _fitted(reference: Layer, width: int, height: int, registration: Registration) -> Transform:
    """Return the transform that spreads ``width`` x ``height`` samples over the extent of ``reference``."""
    reference_gap, gap = (0 if reg == "area" else 1 for reg in (reference.registration, registration))
    a, b, c, d, e, f = reference.transform
    x_ratio = (reference.width - reference_gap) / max(1, width - gap)
    y_ratio = (reference.height - reference_gap) / max(1, height - gap)
    return a * x_ratio, b * y_ratio, c, d * x_ratio, e * y_ratio, f


def _spacing_m(world: World, transform: Transform, info: FileInfo) -> tuple[float, float] | None:
    if world.crs is not None:
        return ground_spacing_m(transform, world.crs, info.width / 2, info.height / 2)
    if world.unit == "metre":
        a, b, _, d, e, _ = transform
        return hypot(a, d), hypot(b, e)
    return None


def _named(world: World) -> str:
    crs = world.crs or "coordinates without a reference system"
    return f"{crs if len(crs) < 40 else crs[:37] + '...'} ({world.unit})"
