"""The heights of a stored dataset as plans of effects need them: measured in one pass, every block decoded once.

A pass walks through the finest level in bands of one block row; a coarser band follows as soon as the two finer ones above it are
done, so two block rows per level are in memory.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.effects import EffectPlan
from schemas.errors import MissingExtraError, UsageError
from schemas.manifest import Layer
from schemas.region import Rect
from schemas.scene import Scene
from tiler.checking.blockreader import BlockReader
from tiler.effects.candidates import PyramidFacts
from tiler.effects.imagery import ImageryMeter
from tiler.effects.levels import LevelDifference, compare_levels
from tiler.effects.plan import plan_effects
from tiler.effects.statistics import HeightMeter, HeightStatistics
from tiler.effects.turning import sun_turn_deg
from tiler.light.place import GridPlace, place_of
from tiler.light.sunposition import sun_position
from tiler.stores.dataset import Dataset

Float32 = NDArray[np.float32]
Progress = Callable[[int, int], None]

_CHUNK: Final = 4096
"""Columns that two levels are compared in at once: some 40 MiB of float64."""
_COLLAPSED: Final = 1e-6
"""Samples of a row nearer to each other than this share of the distance between rows are one place: a pole, which has no slopes."""
_SAME: Final = 1e-9
"""Distances that differ by less, relative to each other, are one: it is the margin of all statistics."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedStatistics(HeightStatistics):
    """Statistics of a map whose samples lie from ``cell_m`` to ``widest_m`` metres (along a row, along a column) apart.

    On it the sun is turned by up to ``turned_deg`` from where it stands at the centre.
    """

    widest_m: tuple[float, float]
    turned_deg: float

    @property
    def diagonal_m(self) -> float:
        """At least the distance between opposite corners of the map [m]."""
        return math.hypot((self.width - 1) * self.widest_m[0], (self.height - 1) * self.widest_m[1])

    @property
    def sun_turn_deg(self) -> float:
        """At least by how much the grid's directions turn the sun anywhere [degrees]."""
        return self.turned_deg


@dataclass(frozen=True, slots=True)
class MeasuredMap:
    """What a plan rests on. ``scene`` has its sun as seen from the grid, ``azimuth_deg`` is its azimuth from true north."""

    scene: Scene
    azimuth_deg: float
    place: GridPlace
    found: HeightStatistics
    facts: PyramidFacts

    def plan(self) -> EffectPlan:
        """Return which effects the scene calls for; the plan's azimuth is from true north."""
        return plan_effects(self.scene, self.found, self.facts).model_copy(update={"azimuth_deg": self.azimuth_deg})


def measure_dataset(
    dataset: Dataset,
    layer: str,
    scene: Scene,
    workers: int | None = None,
    on_progress: Progress = lambda done, total: None,
    imagery: bool = False,
) -> MeasuredMap:
    """Return what is to be known of the heights of ``layer`` under ``scene``; ``on_progress`` is told of block rows.

    With ``imagery`` all imagery of the dataset is measured as well, on which the bound of filtering rests.

    Raises NotFoundError if the layer or a block is missing, UsageError if it has no heights or lies nowhere, InputError if a block is
    damaged or all is void, MissingExtraError if the sun is given as a time and PyEphem is missing.
    """
    reader = BlockReader(dataset, layer)
    where = f"{dataset.store.location}: layer {layer!r}"
    if reader.layer.kind != "height":
        raise UsageError(f"{where}: is of kind {reader.layer.kind}; effects of light are planned on heights, name their layer with --layer")
    place = place_of(reader.layer, dataset.manifest.world, where)
    scene = with_known_sun(scene, place, where)
    azimuth, elevation = scene.sun.direction_deg
    scene = scene.with_sun(place.on_grid(azimuth, elevation).azimuth_deg, elevation)
    meter = ImageryMeter(dataset) if imagery else None
    more = 0 if meter is None else meter.rows
    with ThreadPoolExecutor(workers or len(os.sched_getaffinity(0))) as pool:
        found, facts = _Pass(reader, place, scene, pool).run(lambda done, total: on_progress(done, total + more))
        if meter is not None and more:
            known = sum(-(-level.height // reader.lattice.block) for level in reader.layer.levels)
            contrast = meter.measure(pool, lambda done, total: on_progress(known + done, known + total))
            facts = replace(facts, local_range=contrast.local_range, filter_norm=contrast.filter_norm)
    found = replace(found, turned_deg=sun_turn_deg(place, azimuth, elevation))
    return MeasuredMap(scene, azimuth, place, found, facts)


def with_known_sun(scene: Scene, place: GridPlace, where: str) -> Scene:
    """Return the scene with azimuth (from true north) and elevation of its sun; raises UsageError if there is no place on the Earth."""
    if scene.sun.when is None:
        return scene
    if place.longitude_deg is None or place.latitude_deg is None:
        raise UsageError(
            f"{where}: nothing says where on the Earth it lies, so sun.when cannot tell where the sun is; give its azimuth and elevation"
        )
    try:
        return scene.with_sun(*sun_position(scene.sun.when, place.longitude_deg, place.latitude_deg))
    except MissingExtraError as error:
        raise MissingExtraError("a sun given as a time needs PyEphem: pip install 'clipmap[light]'") from error


def read_heights(reader: BlockReader, window: Rect, level: int = 0) -> Float32:
    """Return the heights (h, w) [m] of a ``window`` of a level, NaN where void; raises InputError or NotFoundError."""
    block = reader.lattice.block
    heights = np.full((window.height, window.width), np.float32(np.nan), np.float32)
    for y in range(window.y0 // block, -(-window.y1 // block)):
        for x in range(window.x0 // block, -(-window.x1 // block)):
            core = reader.read_core(BlockAddress(level, x, y))
            if core is None:
                continue
            found = Rect(x * block, y * block, x * block + core.valid.shape[1], y * block + core.valid.shape[0])
            part = found & window
            here = np.s_[part.y0 - found.y0 : part.y1 - found.y0, part.x0 - found.x0 : part.x1 - found.x0]
            there = np.s_[part.y0 - window.y0 : part.y1 - window.y0, part.x0 - window.x0 : part.x1 - window.x0]
            heights[there] = np.where(core.valid[here], core.samples[..., 0][here], np.float32(np.nan))
    return heights


def place_of_window(place: GridPlace, window: Rect) -> GridPlace:
    """Return how a ``window`` of a grid lies."""
    cells = place.cells_m[:, window.y0 : window.y1]
    middle = cells[:, window.height // 2]
    return replace(place, cells_m=cells, cell_m=(float(middle[0]), float(middle[1])))


class _Pass:
    """One walk through all levels of a layer."""

    def __init__(self, reader: BlockReader, place: GridPlace, scene: Scene, pool: ThreadPoolExecutor) -> None:
        layer = reader.layer
        self._reader, self._pool = reader, pool
        self._cells = _extremes(layer, place)
        shape = (layer.height, layer.width)
        # A gradient lies in the box between those that the extreme distances give it. Slope, and n.s from 0 on, are largest and least
        # in a corner of the box, as they are convex.
        self._meters = [HeightMeter(shape, cell, scene.sun.direction_deg) for cell in _corners(*self._cells)]
        self._kept: list[dict[int, Float32]] = [{} for _ in layer.levels]
        self._differences: list[list[LevelDifference]] = [[] for _ in layer.levels[1:]]

    def run(self, on_progress: Progress) -> tuple[PlacedStatistics, PyramidFacts]:
        """Return what was measured."""
        levels, block = self._reader.layer.levels, self._reader.lattice.block
        bands = [-(-level.height // block) for level in levels]
        done, total = 0, sum(bands)
        for first in range(bands[0]):
            for level, band in _walk(0, first, bands):
                if level == 0:
                    for meter in self._meters:
                        meter.push(self._row(0, band))
                if level + 1 < len(levels):
                    self._compare(level, band)
                self._kept[level].pop(band, None)
                done += 1
                on_progress(done, total)
        return self._statistics(), self._facts()

    def _facts(self) -> PyramidFacts:
        """Return how far levels are from each other."""
        heights = tuple(max(one.height_m for one in level) for level in self._differences)
        if not heights:
            return PyramidFacts()
        # A row or column that two windows share counts twice, which no deviation notices.
        deviations = [
            math.sqrt(math.fsum(one.squares_m2 for one in level) / max(1, sum(one.samples for one in level)))
            for level in self._differences[:2]
        ]
        found = PyramidFacts(heights, max(one.gradient for one in self._differences[0]), detail_sigma_m=deviations[0])
        if len(deviations) < 2 or not min(deviations) > 0:
            return found
        return replace(found, hurst=min(1.0, max(0.0, math.log2(deviations[1] / deviations[0]))))

    def _statistics(self) -> PlacedStatistics:
        """Return the largest and the least of what the meters found."""
        # The first meter's distances are the least, so its slopes are the steepest.
        nearest, *others = [meter.finish() for meter in self._meters]
        facing, toward = nearest.tiles.facing, nearest.toward
        for other in others:
            facing, toward = np.minimum(facing, other.tiles.facing), max(toward, other.toward)
        values = {one.name: getattr(nearest, one.name) for one in fields(nearest)}
        tiles = replace(nearest.tiles, facing=facing)
        return PlacedStatistics(
            **{**values, "tiles": tiles, "toward": toward, "facing": float(facing.min())}, widest_m=self._cells[1], turned_deg=0.0
        )

    def _row(self, level: int, y: int) -> Float32:
        """Return the heights of a block row of a level, decoded once."""
        kept = self._kept[level]
        if y not in kept:
            facts, block = self._reader.layer.levels[level], self._reader.lattice.block
            top, bottom = y * block, min((y + 1) * block, facts.height)
            windows = [Rect(x, top, min(x + block, facts.width), bottom) for x in range(0, facts.width, block)]
            kept[y] = np.concatenate(list(self._pool.map(lambda window: read_heights(self._reader, window, level), windows)), axis=1)
        return kept[y]

    def _rows(self, level: int, top: int, bottom: int) -> Float32:
        """Return some rows of a level."""
        block = self._reader.lattice.block
        parts = [self._row(level, y)[max(top - y * block, 0) : bottom - y * block] for y in range(top // block, (bottom - 1) // block + 1)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _compare(self, level: int, band: int) -> None:
        """Note how far a band of a level is from the next coarser one."""
        facts, block = self._reader.layer.levels[level], self._reader.lattice.block
        top, bottom = band * block, min((band + 1) * block + 1, facts.height)
        fine, coarse = self._rows(level, top, bottom), self._rows(level + 1, top // 2, -(-bottom // 2))
        cell = (self._cells[0][0] * 2**level, self._cells[0][1] * 2**level)
        for left in range(0, facts.width, _CHUNK):
            right = min(left + _CHUNK + 1, facts.width)
            found = compare_levels(
                np.ascontiguousarray(fine[:, left:right]), np.ascontiguousarray(coarse[:, left // 2 : -(-right // 2)]), cell
            )
            self._differences[level].append(found)


def _walk(level: int, band: int, bands: list[int]) -> Iterator[tuple[int, int]]:
    """Give a band of a level, and after it the coarser bands that end with it."""
    yield level, band
    if level + 1 < len(bands) and (band % 2 == 1 or band == bands[level] - 1):
        yield from _walk(level + 1, band // 2, bands)


def _extremes(layer: Layer, place: GridPlace) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the least and the largest distances between samples along a row and along a column [m]."""
    across, along = place.cells_m[:, place.cells_m[0] > _COLLAPSED * place.cells_m[1]]
    if across.size == 0:
        raise UsageError(f"a layer of {layer.width} x {layer.height} samples at one place of the Earth cannot be lit")
    return (float(across.min()), float(along.min())), (float(across.max()), float(along.max()))


def _corners(least: tuple[float, float], widest: tuple[float, float]) -> list[tuple[float, float]]:
    """Return all pairs of extreme distances, the least first; distances that are nearly the same count once."""
    axes = [[low] if high <= low * (1 + _SAME) else [low, high] for low, high in zip(least, widest, strict=True)]
    return [(across, along) for across in axes[0] for along in axes[1]]
