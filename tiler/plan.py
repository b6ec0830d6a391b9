"""What a build decides before the first pixel is read."""

import os
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.errors import UsageError
from schemas.lattice import Lattice, Registration
from schemas.manifest import LayerKind, Manifest
from schemas.settings import BuildSettings
from tiler.cascade import Recipe
from tiler.codecs import BlockFormat, Codec, open_codec
from tiler.edges import EdgeRule
from tiler.enhance import parse_enhancement
from tiler.kernels import DESIGNS, FIXED_RADIUS
from tiler.placement import Placement, place
from tiler.sources.convert import SampleSource
from tiler.tasks import Tier, plan_tiers

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


@dataclass(frozen=True, slots=True)
class Plan:
    """One layer to build: what is read, on which lattice, how it is filtered, encoded and placed, by how many threads."""

    source: SampleSource
    name: str
    lattice: Lattice
    recipe: Recipe
    block: BlockFormat
    codec: Codec
    placement: Placement
    tiers: tuple[Tier, ...]
    workers: int
    linear_light: bool
    fill: int
    enhance: str | None


def plan_layer(source: SampleSource, dataset: Manifest | None, settings: BuildSettings) -> Plan:
    """Return the plan for the layer that ``source`` becomes beside those of ``dataset``.

    Raises UsageError if the layer is there already, its codec cannot hold it, or it does not go with the dataset.
    """
    info, conversion = source.info, source.conversion
    name = conversion.kind
    if dataset is not None and name in dataset.layers and not settings.overwrite:
        raise UsageError(f"the dataset has a layer {name!r} already; add --overwrite to replace it, or choose another folder")
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
    return Plan(
        source=source,
        name=name,
        lattice=lattice,
        recipe=Recipe(kernel, defaults.edge, source.masked, settings.clamp == "local"),
        block=block,
        codec=open_codec(_codec_spec(source, block, settings), block),
        placement=place(info, defaults.registration, settings.spacing, dataset, name),
        tiers=tuple(plan_tiers(lattice, settings.task)),
        workers=settings.workers or len(os.sched_getaffinity(0)),
        linear_light=settings.linear_light,
        fill=settings.fill,
        enhance=None if settings.enhance is None else parse_enhancement(settings.enhance).spec,
    )


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
