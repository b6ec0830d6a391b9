"""The ground on which light is measured: heights without voids, how far apart they are, and the strip at their border that is left out."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.settings import BuildSettings
from tiler.accuracy.ideal import MARGIN
from tiler.accuracy.sample import Sample
from tiler.geodesy import ground_spacing_m
from tiler.sources.files import open_file

CELL_M: Final = 90.0
"""Distance between samples of the built-in terrain: with it half of the slopes are steeper than 1 in 3, as in young mountains."""

Margins = tuple[int, int]
"""Rows at the top and at the bottom, and columns to the left and to the right, that are left out."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Heights (h, w) float32 [m], all finite, and the distance [m] between samples along a row and along a column."""

    heights_m: NDArray[np.float32]
    cell_m: tuple[float, float]

    @property
    def relief_m(self) -> float:
        """How far the highest sample is above the lowest."""
        return float(np.ptp(self.heights_m))

    def slopes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how the ground rises to the east and to the north (h, w), by central differences."""
        heights = self.heights_m.astype(np.float64)
        east: NDArray[np.float64] = np.gradient(heights, self.cell_m[0], axis=1)
        down: NDArray[np.float64] = np.gradient(heights, self.cell_m[1], axis=0)
        return east, -down

    def margins(self, side: int) -> Margins:
        """Return what to leave out so that at most ``side`` samples along each edge stay, and never those at the very border."""
        height, width = self.heights_m.shape
        return max(MARGIN, (height - side + 1) // 2), max(MARGIN, (width - side + 1) // 2)


def inner(grid: NDArray[np.floating], margins: Margins) -> NDArray[np.floating]:
    """Return ``grid`` (h, w) without the margins."""
    rows, columns = margins
    return grid[rows : grid.shape[0] - rows, columns : grid.shape[1] - columns]


def ground_of(sample: Sample, cell_m: tuple[float, float] = (CELL_M, CELL_M)) -> Ground:
    """Return the ground of a sample of heights; raises UsageError for a picture."""
    if sample.kind != "height":
        raise UsageError(f"{sample.name}: light falls on heights, and this is {sample.kind}; leave out --light, or say --layer height")
    return Ground(np.ascontiguousarray(sample.values[..., 0]), cell_m)


def cell_of(path: Path, settings: BuildSettings) -> tuple[float, float]:
    """Return the distance [m] between the samples of a source, x first: by ``settings.spacing``, or else by its georeference.

    Raises UsageError if neither tells it.
    """
    if settings.spacing is not None:
        return settings.spacing, settings.spacing
    reader = open_file(path, None)
    try:
        info = reader.info
    finally:
        reader.close()
    place = info.georeference
    found = None if place is None else ground_spacing_m(place.transform, place.crs, info.width / 2, info.height / 2)
    if found is None:
        raise UsageError(f"{path}: says nothing of the distance between its samples; give it with --spacing [m]")
    return found


def light_ground(source: Path | None, sample: Sample, settings: BuildSettings) -> Ground:
    """Return the ground of a sample that was taken from ``source``, or of the built-in terrain; raises what the two functions above do."""
    ground = ground_of(sample)
    return ground if source is None else replace(ground, cell_m=cell_of(source, settings))
