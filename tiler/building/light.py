"""Building a layer of light: the heights of a dataset, one sun, and the same tasks, records and manifest as any other layer."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from schemas.address import LAYER_NAME
from schemas.errors import UsageError
from schemas.lattice import Lattice
from schemas.light import Light
from schemas.manifest import Layer, Manifest, SampleType
from schemas.settings import LightSettings
from tiler.building.build import BuildReport
from tiler.building.heightlayers import HeightStamps, Opened, build_from_heights, build_settings
from tiler.building.layer import Progress
from tiler.building.placement import Placement
from tiler.building.plan import Plan
from tiler.checking.blockreader import BlockReader
from tiler.codecs import BlockFormat, open_codec
from tiler.filters.cascade import Recipe
from tiler.filters.kernels import DESIGNS
from tiler.light.frame import MEAN_RADIUS_M
from tiler.light.heights import refined_layer
from tiler.light.lightsource import LightSource, Simulation
from tiler.light.place import GridPlace, place_of
from tiler.light.sunposition import refracted_deg, sun_position
from tiler.stores.dataset import Dataset
from tiler.tasks.engine import Engine
from tiler.tasks.partition import choose_task_side
from tiler.tasks.records import Partition

_RADIUS: Final = 3
REFRACTION: Final = 0.13
"""Curvature of a level ray relative to that of the Earth, where rays are bent at all."""
_BOUNCE_AZIMUTHS: Final = 16
_CODECS: Final = ("png", "jpeg", "webp", "raw", "exr")


@dataclass(frozen=True, slots=True)
class LightReport:
    """What a build of light did, and the seconds that the parts of the simulation took; none if nothing was to be done."""

    build: BuildReport
    light: Light
    stages_s: dict[str, float]


def build_light(
    output: str | Path,
    settings: LightSettings,
    on_progress: Progress = lambda done, total: None,
    on_stage: Callable[[str], None] = lambda name: None,
    engine: Engine | None = None,
    choose: Callable[[Dataset, LightSettings], LightSettings] = lambda dataset, settings: settings,
) -> LightReport:
    """Build the layer of light that ``settings`` describe from the heights of the dataset at ``output``, and publish it.

    Resumes and updates as ``build_layer`` does. Sun and sky are found by this process in any case; with an ``engine`` whose tasks run in
    others, the light is copied into the store for them, as long as the build lasts. ``choose`` may change what is simulated, once nobody
    else can change the heights. Raises NotFoundError without the dataset or its heights, UsageError, InputError or StorageError, and
    MissingExtraError if a time is given and PyEphem is missing.
    """

    def opened(dataset: Dataset) -> Opened[LightSource]:
        chosen = choose(dataset, settings)
        return *open_light(dataset, chosen), build_settings(chosen)

    report, source = build_from_heights(output, settings.break_lock, opened, on_progress, on_stage, engine)
    return LightReport(report, source.simulation.light, source.stages_s)


def open_light(dataset: Dataset, settings: LightSettings) -> tuple[Plan, LightSource, HeightStamps]:
    """Return the plan of the light on a dataset's heights, its samples, not yet baked, and the state of the heights."""
    reader = BlockReader(dataset, settings.height)
    simulation = simulate(reader.layer, dataset.manifest, settings, f"{dataset.store.location}: layer {settings.height!r}")
    workers = settings.workers or len(os.sched_getaffinity(0))
    source = LightSource(reader, simulation, _dtype(settings), dataset.store.scratch, workers)
    return plan_light(source, simulation.light, dataset.manifest, settings, workers), source, HeightStamps(reader.layer)


def simulate(layer: Layer, manifest: Manifest, settings: LightSettings, where: str) -> Simulation:
    """Return what is simulated over the heights of ``layer``, its sun found if only a time is given."""
    if layer.kind != "height":
        raise UsageError(f"{where}: is of kind {layer.kind}; light falls on heights, name their layer with --from")
    place = place_of(refined_layer(layer, settings.density), manifest.world, where)
    azimuth, elevation = _sun_of(settings, place, where)
    if settings.refraction:
        elevation = refracted_deg(elevation)
    return Simulation(
        Light(
            height=settings.height,
            density=settings.density,
            azimuth_deg=azimuth % 360.0 % 360.0,
            elevation_deg=elevation,
            grid_azimuth_deg=place.on_grid(azimuth, elevation).azimuth_deg,
            when=None if settings.when is None else settings.when.isoformat(),
            shadows=settings.shadows,
            lines=settings.lines if settings.shadows == "hard" else None,
            radius_deg=settings.radius_deg if settings.shadows == "soft" else None,
            sky_azimuths=settings.sky or (_BOUNCE_AZIMUTHS if settings.bounce else 0),
            sky_share=settings.share if settings.sky or settings.open_sky else 0.0,
            albedo=settings.albedo if settings.bounce else 0.0,
            radius_m=MEAN_RADIUS_M if settings.curvature else None,
            refraction=REFRACTION if settings.refraction else 0.0,
            voids=layer.width * layer.height - layer.statistics.valid,
            left_out=list(settings.left_out),
        ),
        place,
    )


def _sun_of(settings: LightSettings, place: GridPlace, where: str) -> tuple[float, float]:
    if settings.azimuth_deg is not None and settings.elevation_deg is not None:
        return settings.azimuth_deg, settings.elevation_deg
    if settings.when is None or place.longitude_deg is None or place.latitude_deg is None:
        raise UsageError(f"{where}: nothing says where on the Earth it lies, so --when cannot tell where the sun is; give --sun AZ,EL")
    return sun_position(settings.when, place.longitude_deg, place.latitude_deg)


def _dtype(settings: LightSettings) -> SampleType:
    if settings.codec.partition(":")[0] == "exr":
        return "float32"
    return "uint16" if settings.bits == 16 else "uint8"


def plan_light(source: LightSource, light: Light, manifest: Manifest, settings: LightSettings, workers: int) -> Plan:
    """Return the plan for a layer of light beside those of ``manifest``; raises UsageError if name or codec do not do."""
    name = settings.layer
    taken = manifest.layers.get(name)
    if not LAYER_NAME.fullmatch(name) or (taken is not None and taken.kind != "light"):
        reason = "use lower-case letters, digits and underscores, a letter first" if taken is None else "is there and no light"
        raise UsageError(f"--layer {name}: {reason}; choose another name")
    if settings.codec.partition(":")[0] not in _CODECS:
        raise UsageError(f"--codec {settings.codec}: light is stored as {', '.join(_CODECS)}")
    heights = refined_layer(manifest.layer(light.height), light.density)
    lattice = Lattice(heights.width, heights.height, settings.block or heights.block, "point")
    dtype = source.conversion.dtype
    alpha = source.masked and dtype != "float32"
    # Light in floats has its voids in a mask, as heights have.
    block = BlockFormat("light", lattice.stored_side, 1 + alpha, dtype, alpha)
    return Plan(
        source=source,
        name=name,
        lattice=lattice,
        # A shadow beside the edge must not be continued as the opposite of itself.
        recipe=Recipe(DESIGNS["blackman-sinc"](_RADIUS, "point"), "mirror-sample", source.masked, False),
        block=block,
        codec=open_codec(settings.codec, block),
        placement=Placement(manifest.world, heights.transform, heights.source.placement, heights.ground_spacing_m),
        partition=Partition(task=settings.task or choose_task_side(lattice, workers), layout="tiled"),
        workers=workers,
        linear_light=dtype != "float32",
        fill=0,
        enhance=None,
        light=light,
        light_settings=settings.model_copy(update={"overwrite": False, "update": False, "break_lock": False}),
    )
