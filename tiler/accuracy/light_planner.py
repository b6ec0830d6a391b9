"""What planning effects saves: scenes lit with everything, and with what the plan of effects (``tiler.effects``) leaves of it.

Both go through the very code of ``clipmap light``, from stored heights to samples of light; only encoding is left out, which is the same.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from html import escape
from math import sqrt
from pathlib import Path
from time import process_time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import StorageError
from schemas.region import Rect
from schemas.settings import BuildSettings, LightSettings
from tiler.accuracy.lightfindings import brief
from tiler.accuracy.lightground import CELL_M, Ground, ground_of
from tiler.accuracy.page import table
from tiler.accuracy.plots import drawing
from tiler.accuracy.sample import Sample, built_in
from tiler.building.build import build_layer
from tiler.building.light import open_light
from tiler.building.lightplan import EffectChoice, scene_of
from tiler.stores.dataset import Dataset, open_dataset
from tiler.terrain import make_island

PLANNER_PLOT: Final = "planner.svg"
CODES: Final = 1.0
"""What may be left out [codes of light, of 255]."""
_LARGEST: Final = 1024
_RUNS: Final = 3
_SUNS: Final = ((290.0, 10.0), (200.0, 45.0))
_STRIP_ROWS: Final = 256
_PLAIN_M, _PLAIN_CELL_M, _LIDAR_CELL_M = 20.0, 160.0, 1.0
_TREES, _TREE_M = 0.002, 12.0
"""Share of the samples of the built-in lidar ground on which something stands, and its height."""
METHOD: Final = (
    "Everything: the sun's disc, 16 azimuths of sky, one reflection, curvature and refraction. Planned: what a tolerance of "
    f"{CODES:g} code does not let go, by proof alone, planning included. Processor times on one thread, from stored heights to samples of "
    "light, encoding left out; the least of all runs. The difference is the largest of all samples."
)

Light = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class PlannerScene:
    """A ground under a sun, which may have voids, NaN. Its samples are taken to be as far apart along rows as along columns."""

    name: str
    ground: Ground
    azimuth_deg: float
    elevation_deg: float


@dataclass(frozen=True, slots=True)
class PlannerResult:
    """What planning one scene gave: times [s], the largest difference of a sample [codes], and the sum of all bounds [codes]."""

    scene: str
    width: int
    height: int
    cell_m: float
    relief_m: float
    elevation_deg: float
    tolerance_codes: float
    everything_s: float
    planned_s: float
    planning_s: float
    left_out: tuple[str, ...]
    bound_codes: float
    difference_codes: float


def built_in_scenes(crop: int) -> list[PlannerScene]:
    """Return four grounds of up to ``crop`` cells along an edge: mountains, an island in the sea, a survey by lidar, a plain."""
    side = min(crop, _LARGEST) // 8 * 8
    alpine = ground_of(built_in(side))
    rough = alpine.heights_m * np.float32(_LIDAR_CELL_M / CELL_M)
    wooded = np.where(np.random.default_rng(1).random(rough.shape) < _TREES, rough + _TREE_M, rough).astype(np.float32)
    plain = alpine.heights_m * np.float32(_PLAIN_M / alpine.relief_m)
    island = make_island(side, 20_480 / side)
    return [
        PlannerScene("mountains at 90 m", alpine, 290.0, 8.0),
        PlannerScene(f"an island in the sea at {island.spacing_m:g} m", Ground(island.heights_m, (island.spacing_m,) * 2), 270.0, 30.0),
        PlannerScene("rough ground with trees at 1 m", Ground(wooded, (_LIDAR_CELL_M,) * 2), 200.0, 60.0),
        PlannerScene("a plain of 20 m relief at 160 m", Ground(plain, (_PLAIN_CELL_M,) * 2), 200.0, 40.0),
    ]


def planner_scenes(sample: Sample, ground: Ground) -> list[PlannerScene]:
    """Return the built-in scenes, and before them what was given, as mountains often are lit: low, and from the side."""
    given = [] if sample.known_spectrum else [PlannerScene(sample.name, ground, *sun) for sun in _SUNS]
    return [*given, *built_in_scenes(max(ground.heights_m.shape) - 1)]


def measure_planner(scenes: Sequence[PlannerScene], runs: int, on_stage: Callable[[str], None] = lambda stage: None) -> list[PlannerResult]:
    """Return what planning saves on each of ``scenes``; ``on_stage`` is told which comes. Raises StorageError without room for scratch."""
    results = []
    for scene in scenes:
        on_stage(f"planning of effects: {scene.name}")
        with tempfile.TemporaryDirectory(prefix="clipmap-accuracy-") as folder:
            results.append(_measure(scene, _store(scene.ground, Path(folder)), min(runs, _RUNS)))
    return results


def _store(ground: Ground, folder: Path) -> Dataset:
    """Build a dataset of the ground, as heights come to be lit."""
    import OpenImageIO  # noqa: PLC0415 - a report that measures no light need not load it

    rows, columns = ground.heights_m.shape
    path = folder / "heights.tif"
    output = OpenImageIO.ImageOutput.create(str(path))
    spec = OpenImageIO.ImageSpec(columns, rows, 1, "float")
    heights = np.ascontiguousarray(ground.heights_m[..., np.newaxis])
    if output is None or not output.open(str(path), spec) or not output.write_image(heights) or not output.close():
        raise StorageError(f"{path}: cannot be written: {OpenImageIO.geterror() if output is None else output.geterror()}")
    build_layer(path, folder / "dataset", BuildSettings(layer="height", codec="raw", spacing=_cell_m(ground)))
    return open_dataset(folder / "dataset")


def _cell_m(ground: Ground) -> float:
    return sqrt(ground.cell_m[0] * ground.cell_m[1])


def _measure(scene: PlannerScene, dataset: Dataset, runs: int) -> PlannerResult:
    asked = LightSettings(
        azimuth_deg=scene.azimuth_deg,
        elevation_deg=scene.elevation_deg,
        shadows="soft",
        sky=16,
        bounce=True,
        refraction=True,
        codec="exr:float",
        workers=1,
    )
    everything, planned, planning = [], [], []
    # Once more than is counted: the first run loads the kernels.
    for _ in range(runs + 1):
        started = process_time()
        whole = _lit(dataset, asked)
        halfway = process_time()
        choice = EffectChoice(scene_of(asked, CODES))
        chosen = choice(dataset, asked)
        planning.append(process_time() - halfway)
        part = _lit(dataset, chosen)
        everything.append(halfway - started)
        planned.append(process_time() - halfway)
    height, width = whole.shape
    return PlannerResult(
        scene=scene.name,
        width=width,
        height=height,
        cell_m=_cell_m(scene.ground),
        relief_m=float(np.nanmax(scene.ground.heights_m) - np.nanmin(scene.ground.heights_m)),
        elevation_deg=scene.elevation_deg,
        tolerance_codes=CODES,
        everything_s=min(everything[1:]),
        planned_s=min(planned[1:]),
        planning_s=min(planning[1:]),
        left_out=tuple(one.effect for one in chosen.left_out),
        bound_codes=sum(one.bound or 0.0 for one in chosen.left_out if one.unit == "codes"),
        difference_codes=255 * float(np.abs(whole.astype(np.float64) - part).max()),
    )


def _lit(dataset: Dataset, settings: LightSettings) -> Light:
    """Return the light (h, w) of all samples."""
    plan, source, _ = open_light(dataset, settings)
    with closing(source):
        source.bake()
        strips = [source.read(window)[0][..., 0] for window in _strips(plan.lattice.width, plan.lattice.height)]
    return np.concatenate(strips)


def _strips(width: int, height: int) -> Iterator[Rect]:
    for y in range(0, height, _STRIP_ROWS):
        yield Rect(0, y, width, min(height, y + _STRIP_ROWS))


def planner_findings(results: Sequence[PlannerResult]) -> list[str]:
    """Return what planning saves and what it changes, one sentence per scene."""
    return [_finding(one) for one in results]


def _finding(one: PlannerResult) -> str:
    times = (
        f"{brief(one.everything_s)} s with everything, {brief(one.planned_s)} s as planned, {brief(one.planning_s)} s of it for the plan"
    )
    if not one.left_out:
        return f"Planning, {one.scene}, sun at {one.elevation_deg:g} degrees: {times}; nothing can be left out, and no sample differs."
    names = ", ".join(name.replace("_", " ") for name in one.left_out)
    return (
        f"Planning, {one.scene}, sun at {one.elevation_deg:g} degrees: {times}; left out are {names}, which change "
        f"{brief(one.difference_codes)} codes at most where {brief(one.tolerance_codes)} are tolerated."
    )


def planner_rows(results: Sequence[PlannerResult]) -> list[dict[str, Any]]:
    """Return one flat row per scene."""
    return [asdict(one) | {"left_out": " ".join(one.left_out)} for one in results]


HEADER: Final = (
    "",
    "samples",
    "relief [m]",
    "sun at",
    "everything [s]",
    "planned [s]",
    "of it the plan [s]",
    "left out",
    "bounds",
    "differs [codes]",
)


def planner_cells(one: PlannerResult) -> list[str]:
    """Return one row of the table, in the order of ``HEADER``."""
    return [
        one.scene,
        f"{one.width} × {one.height}",
        brief(one.relief_m),
        f"{one.elevation_deg:g}°",
        brief(one.everything_s),
        brief(one.planned_s),
        brief(one.planning_s),
        ", ".join(name.replace("_", " ") for name in one.left_out) or "nothing",
        brief(one.bound_codes) if one.left_out else "",
        brief(one.difference_codes),
    ]


def planner_section(results: Sequence[PlannerResult]) -> str:
    """Return the section of the page."""
    said = "".join(f"<li>{escape(sentence)}</li>" for sentence in planner_findings(results))
    picture = f'<figure><img src="{PLANNER_PLOT}" alt=""><figcaption>Time with everything, and as planned.</figcaption></figure>'
    rows = table(HEADER, (("", planner_cells(one)) for one in results))
    note = f'<p class="note">{escape(METHOD)} Raw results: <a href="planner.csv">planner.csv</a>.</p>'
    return f"<h2>What planning saves</h2><ul>{said}</ul>{picture}{rows}{note}"


def planner_plot(results: Sequence[PlannerResult], path: Path) -> None:
    """Draw a pair of bars per scene: time with everything, and as planned, of it that of the plan itself."""
    places = np.arange(len(results), dtype=np.float64)
    with drawing(path, (9, 0.7 + 0.75 * len(results))) as axes:
        nanoseconds = [[1e9 * time / (one.width * one.height) for time in _times(one)] for one in results]
        whole, plan, rest = zip(*nanoseconds, strict=True)
        axes.barh(places - 0.19, whole, 0.36, color="#8a97a3", label="everything")
        axes.barh(places + 0.19, plan, 0.36, color="#1b2a38", label="planning")
        axes.barh(places + 0.19, rest, 0.36, left=plan, color="#c2410c", label="what is left to simulate")
        axes.set_yticks(places, [f"{one.scene}, sun at {one.elevation_deg:g}°" for one in results])
        axes.invert_yaxis()
        axes.set(xlabel="processor time [ns per sample]")
        axes.grid(axis="x", alpha=0.2)
        axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)


def _times(one: PlannerResult) -> tuple[float, float, float]:
    return one.everything_s, one.planning_s, one.planned_s - one.planning_s
