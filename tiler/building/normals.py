"""Building a layer of normals from the heights of a dataset, with the same tasks, records and manifest as any other layer."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from schemas.address import LAYER_NAME
from schemas.errors import UsageError
from schemas.lattice import Lattice
from schemas.light import Normals
from schemas.manifest import Layer, Manifest, SampleType
from schemas.settings import NormalSettings
from tiler.building.build import BuildReport
from tiler.building.heightlayers import HeightStamps, Opened, build_from_heights, build_settings
from tiler.building.layer import Progress
from tiler.building.placement import Placement
from tiler.building.plan import Plan
from tiler.checking.blockreader import BlockReader
from tiler.codecs import BlockFormat, open_codec
from tiler.filters.cascade import Recipe
from tiler.filters.kernels import DESIGNS
from tiler.light.heights import refined_layer
from tiler.light.normals import NormalSource
from tiler.light.place import place_of
from tiler.stores.dataset import Dataset
from tiler.tasks.engine import Engine
from tiler.tasks.partition import choose_task_side
from tiler.tasks.records import Partition

_RADIUS: Final = 3
_CODECS: Final = ("png", "raw", "exr")
_CODES: Final[dict[SampleType, tuple[int, int]]] = {"uint8": (127, 127), "uint16": (32767, 32767), "float32": (0, 1)}
"""Sample that means 0, and by how much one that means 1 is greater: level ground is a whole number, and as far from either end."""


@dataclass(frozen=True, slots=True)
class NormalReport:
    """What a build of normals did, and the seconds it took to decode the heights; none if nothing was to be done."""

    build: BuildReport
    normals: Normals
    stages_s: dict[str, float]


def build_normals(
    output: str | Path, settings: NormalSettings, on_progress: Progress = lambda done, total: None, engine: Engine | None = None
) -> NormalReport:
    """Build the layer of normals that ``settings`` describe from the heights of the dataset at ``output``, and publish it.

    Resumes and updates as ``build_layer`` does; for an ``engine`` whose tasks run in other processes the normals are copied into the store,
    as ``build_light`` copies light. Raises NotFoundError without the dataset or its heights, UsageError, InputError or
    StorageError.
    """

    def opened(dataset: Dataset) -> Opened[NormalSource]:
        return *open_normals(dataset, settings), build_settings(settings)

    report, source = build_from_heights(output, settings.break_lock, opened, on_progress, engine=engine)
    return NormalReport(report, source.normals, source.stages_s)


def open_normals(dataset: Dataset, settings: NormalSettings) -> tuple[Plan, NormalSource, HeightStamps]:
    """Return the plan of the normals of a dataset's heights, the normals, not yet baked, and the state of the heights.

    Raises NotFoundError without the heights, UsageError or InputError if they, the layer's name or its codec do not do.
    """
    reader = BlockReader(dataset, settings.height)
    layer, where = reader.layer, f"{dataset.store.location}: layer {settings.height!r}"
    if layer.kind != "height":
        raise UsageError(f"{where}: is of kind {layer.kind}; normals are those of heights, name their layer with --from")
    place = place_of(refined_layer(layer, settings.density), dataset.manifest.world, where)
    dtype: SampleType = "float32" if _codec(settings) == "exr" else "uint16" if settings.bits == 16 else "uint8"
    zero, one = _CODES[dtype]
    normals = Normals(
        height=settings.height,
        density=settings.density,
        zero=zero,
        one=one,
        up_deg=place.up_deg,
        voids=layer.width * layer.height - layer.statistics.valid,
    )
    workers = settings.workers or len(os.sched_getaffinity(0))
    source = NormalSource(reader, normals, place.cells_m, dtype, dataset.store.scratch, workers)
    return _plan(source, normals, dataset.manifest, settings, workers), source, HeightStamps(layer)


def _codec(settings: NormalSettings) -> str:
    return settings.codec.partition(":")[0]


def _plan(source: NormalSource, normals: Normals, manifest: Manifest, settings: NormalSettings, workers: int) -> Plan:
    _require_free(manifest.layers.get(settings.layer), settings)
    heights = refined_layer(manifest.layer(normals.height), normals.density)
    lattice = Lattice(heights.width, heights.height, settings.block or heights.block, "point")
    dtype = source.conversion.dtype
    # PNG knows two channels only as grey and alpha, by which programs multiply; so the mask, all valid or not, is its third.
    alpha = dtype != "float32" and (source.masked or _codec(settings) == "png")
    block = BlockFormat("normal", lattice.stored_side, 2 + alpha, dtype, alpha)
    return Plan(
        source=source,
        name=settings.layer,
        lattice=lattice,
        # As heights go on beyond the edge, their slopes are mirrored at the outermost sample.
        recipe=Recipe(DESIGNS["blackman-sinc"](_RADIUS, "point"), "mirror-sample", source.masked, False),
        block=block,
        codec=open_codec(settings.codec, block),
        placement=Placement(manifest.world, heights.transform, heights.source.placement, heights.ground_spacing_m),
        partition=Partition(task=settings.task or choose_task_side(lattice, workers), layout="tiled"),
        workers=workers,
        linear_light=False,
        fill=0,
        enhance=None,
        normals=normals,
        normal_settings=settings.model_copy(update={"overwrite": False, "update": False, "break_lock": False}),
    )


def _require_free(taken: Layer | None, settings: NormalSettings) -> None:
    if not LAYER_NAME.fullmatch(settings.layer) or (taken is not None and taken.kind != "normal"):
        reason = "use lower-case letters, digits and underscores, a letter first" if taken is None else "is there and holds no normals"
        raise UsageError(f"--layer {settings.layer}: {reason}; choose another name")
    if _codec(settings) not in _CODECS:
        raise UsageError(f"--codec {settings.codec}: normals are stored as {', '.join(_CODECS)}; loss in x and y would tilt the ground")
