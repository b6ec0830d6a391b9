"""What a build decides before the first pixel is read."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Final

import numpy as np
from pydantic import JsonValue

from schemas.errors import UsageError
from schemas.lattice import Lattice, Registration
from schemas.light import Light, Normals
from schemas.manifest import LayerKind, Manifest, digest
from schemas.region import Rect
from schemas.settings import BuildSettings, LightSettings, NormalSettings
from tiler.building.placement import Placement, place
from tiler.codecs import BlockFormat, Codec, open_codec
from tiler.filters.cascade import Recipe
from tiler.filters.edges import EdgeRule
from tiler.filters.kernels import DESIGNS, FIXED_RADIUS
from tiler.sources.convert import SampleSource
from tiler.tasks.partition import Task, Tier, choose_task_side, count_tasks, plan_tasks, plan_tiers
from tiler.tasks.records import Partition

_MAX_BLOCKS: Final = 1 << 27
"""The block index is held in memory: 6 GiB for all levels at this number."""


@dataclass(frozen=True, slots=True)
class _Defaults:
    """How a kind of layer is filtered unless told otherwise."""

    registration: Registration
    edge: EdgeRule
    radius: int


_DEFAULTS: Final[dict[LayerKind, _Defaults]] = {
    "height": _Defaults("point", "antisymmetric", 6),
    "imagery": _Defaults("area", "mirror", 3),
}


@dataclass(frozen=True)
class Plan:
    """One layer to build: what is read, on which lattice, how it is filtered, encoded and placed, in which tasks, by how many threads."""

    source: SampleSource
    name: str
    lattice: Lattice
    recipe: Recipe
    block: BlockFormat
    codec: Codec
    placement: Placement
    partition: Partition
    workers: int
    linear_light: bool
    fill: int
    enhance: str | None
    light: Light | None = None
    light_settings: LightSettings | None = None
    normals: Normals | None = None
    normal_settings: NormalSettings | None = None

    @cached_property
    def tiers(self) -> tuple[Tier, ...]:
        """The tiers of levels that the partition gives."""
        return tuple(plan_tiers(self.lattice, self.partition.task))

    @cached_property
    def signature(self) -> dict[str, JsonValue]:
        """Everything that a block's bytes depend on besides the source's pixels, by the names that users know."""
        conversion, kernel, info = self.source.conversion, self.recipe.kernel, self.source.info
        return {
            "size": [self.lattice.width, self.lattice.height],
            "layer": conversion.kind,
            "source type": f"{info.channels} x {info.dtype.name}" + (f" of {info.bits} bits" if info.bits else ""),
            "bands": [channel + 1 for channel in conversion.colours],
            "alpha": None if conversion.alpha is None else f"channel {conversion.alpha + 1}" + " premultiplied" * conversion.premultiplied,
            "voids": self.recipe.masked,
            "nodata": conversion.nodata,
            "decode": conversion.decode,
            "scale": conversion.scale,
            "offset": conversion.offset,
            "stretch": None if conversion.stretch is None else [list(limits) for limits in conversion.stretch],
            "block": self.lattice.block,
            "pad": self.lattice.pad,
            "codec": self.codec.spec,
            "filter": kernel.name,
            "radius": kernel.radius,
            "edge": self.recipe.edge,
            "clamp": "local" if self.recipe.clamp else "none",
            "linear-light": self.linear_light,
            "fill": self.fill,
            "enhance": self.enhance,
            **({} if self.light is None else {"light": self.light.model_dump(mode="json", exclude={"voids", "left_out"})}),
            **({} if self.normals is None else {"normals": self.normals.model_dump(mode="json", exclude={"voids"})}),
            **{name: version(name) for name in self.libraries},
        }

    @property
    def libraries(self) -> list[str]:
        """The packages whose next version may make other bytes: of this plan, and only those that it uses."""
        names = ["clipmap", "OpenEXR" if self.codec.spec.startswith("exr") else "imagecodecs"]
        return names + ["rasterio"] * bool(self.source.info.parts) + ["PyWavelets"] * (self.enhance is not None)

    @cached_property
    def digest(self) -> str:
        """Digest of the signature; task records with another one belong to another plan."""
        return digest(json.dumps(self.signature, sort_keys=True).encode())

    @property
    def place(self) -> dict[str, JsonValue]:
        """Where the layer lies."""
        return {
            "coordinates": self.placement.world.crs or self.placement.world.unit,
            "transform": list(self.placement.transform),
            "placement": self.placement.how,
        }

    def tasks(self, tier: Tier, within: Rect | None = None) -> Iterator[Task]:
        """Yield the tasks of a tier whose cores meet the samples ``within`` of its first level, by default all."""
        return plan_tasks(self.lattice, tier, self.partition.layout, within)

    @property
    def task_count(self) -> int:
        """Number of tasks of all tiers."""
        return count_tasks(self.lattice, self.tiers, self.partition.layout)


def plan_layer(source: SampleSource, dataset: Manifest | None, settings: BuildSettings) -> Plan:
    """Return the plan for the layer that ``source`` becomes beside those of ``dataset``.

    Raises UsageError if its codec cannot hold it, or it does not go with the dataset.
    """
    info, conversion = source.info, source.conversion
    name = conversion.kind
    defaults = _DEFAULTS[conversion.kind]
    lattice = Lattice(info.width, info.height, settings.block, defaults.registration, settings.pad)
    columns, rows = lattice.block_counts(0)
    if columns * rows > _MAX_BLOCKS:
        raise UsageError(f"{info.path}: would make {columns * rows} blocks, more than {_MAX_BLOCKS}; use a larger --block")
    alpha = conversion.kind == "imagery" and source.masked
    block = BlockFormat(
        kind=conversion.kind,
        side=lattice.stored_side,
        channels=conversion.channels + alpha,
        dtype=conversion.dtype,
        alpha=alpha,
    )
    radius = settings.radius or (1 if settings.filter in FIXED_RADIUS else defaults.radius)
    kernel = DESIGNS[settings.filter](radius, defaults.registration)
    workers = settings.workers or len(os.sched_getaffinity(0))
    return Plan(
        source=source,
        name=name,
        lattice=lattice,
        recipe=Recipe(kernel, defaults.edge, source.masked, settings.clamp == "local"),
        block=block,
        codec=open_codec(_codec_spec(source, block, settings), block),
        placement=place(info, defaults.registration, settings.spacing, dataset, name),
        partition=Partition(task=settings.task or choose_task_side(lattice, workers), layout=info.layout),
        workers=workers,
        linear_light=settings.linear_light,
        fill=settings.fill,
        enhance=None if settings.enhance is None else _enhancement(settings.enhance),
    )


def _enhancement(text: str) -> str:
    """Return the enhancement asked for with all its parameters."""
    from tiler.samples.enhance import parse_enhancement  # noqa: PLC0415 - 4 ms of every start, used by few

    return parse_enhancement(text).spec


def _codec_spec(source: SampleSource, block: BlockFormat, settings: BuildSettings) -> str:
    """Return the codec asked for, or: lerc for heights, jpeg for opaque 8-bit imagery, png for the rest."""
    if settings.codec == "png16" and source.conversion.decode is None and source.info.dtype.kind in "iu":
        return _png16_spec(source)
    if settings.codec is not None:
        return settings.codec
    if block.kind == "height":
        return "lerc"
    return "png" if block.alpha or block.dtype != "uint8" else "jpeg"


def _png16_spec(source: SampleSource) -> str:
    """Fit 16 bits to what the source's integers can be, so that level 0 is stored without loss."""
    limits = np.iinfo(source.info.dtype)
    if limits.bits > 16:
        return "png16"
    scale, offset = source.conversion.scale, source.conversion.offset
    lowest = min(limits.min * scale, limits.max * scale) + offset
    return f"png16:{abs(scale)!r},{lowest!r}"
