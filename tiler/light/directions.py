"""The sun's direction and the distances between samples all over a large map: known at nodes, interpolated between them.

Nodes are so dense that from one to the next the sun turns by no more than a degree: interpolated, its vector is then short by at most
1 / 26 000, a hundredth of a code of 8 bits, and there is no step anywhere. On a map over which the sun turns by less than a
sixteenth of a degree from what is true at the centre, and distances by less than half a percent, there is nothing to interpolate.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.region import Rect
from tiler.light.frame import Earth, SunPosition, curvature_per_m, sine_cosine_deg, tangent_deg
from tiler.light.ground import SunField, SunView
from tiler.light.place import GridPlace
from tiler.light.sweeping import Float64
from tiler.light.zones import ASTRAY_RAD, lattice

_NODE_RAD: Final = math.radians(1.0)
_CELL_RATIO: Final = 0.005
_TRIAL: Final = 17
"""Nodes along each side at which it is found how many there have to be."""
_MOST_NODES: Final = 1025


@dataclass(frozen=True)
class Patch:
    """A ``window`` of a map between four nodes: what ``shade_patch`` takes."""

    window: Rect
    corners: Float64
    place: Float64


class SunDirections:
    """Nodes (5, rows, columns): the sun's unit vector on the grid and the distances [m] between samples along a row and along a column."""

    def __init__(self, nodes: Float64, rows: Float64, columns: Float64) -> None:
        self._nodes, self._rows, self._columns = nodes, rows, columns

    def patches(self, window: Rect) -> Iterator[Patch]:
        """Yield the parts of a window between nodes."""
        for i in _between(self._rows, window.y0, window.y1):
            for j in _between(self._columns, window.x0, window.x1):
                top, left = self._rows[i], self._columns[j]
                below, beside = self._rows[i + 1], self._columns[j + 1]
                part = window & Rect(_start(left, j), _start(top, i), _stop(beside, j, self._columns), _stop(below, i, self._rows))
                if part:
                    corners = np.ascontiguousarray(self._nodes[:, i : i + 2, j : j + 2])
                    yield Patch(part, corners, np.array([part.y0 - top, part.x0 - left, below - top, beside - left], np.float64))


def _between(nodes: Float64, start: int, stop: int) -> range:
    """Return the gaps between nodes that a half-open interval of samples meets."""
    first = int(np.searchsorted(nodes, start, "right")) - 1
    last = int(np.searchsorted(nodes, stop - 1, "right")) - 1
    return range(min(max(first, 0), nodes.size - 2), min(max(last, 0), nodes.size - 2) + 1)


def _start(node: float, number: int) -> int:
    return -1 if number == 0 else math.ceil(node)


def _stop(node: float, number: int, nodes: Float64) -> int:
    return math.ceil(node) + (1 if number == nodes.size - 2 else 0)


def sun_directions(field: SunField, place: GridPlace, sun: SunPosition, earth: Earth) -> SunDirections | None:
    """Return the sun's directions over a map; None if those at its centre do, or if a part of the map is no place on the Earth."""
    height, width = field.ground.shape
    whole = Rect(0, 0, width, height)
    trial = field.view(*lattice(whole, _TRIAL))
    if trial is None or min(height, width) < 2 or not _matters(trial, whole, place, sun, earth):
        return None
    vectors = np.stack([trial.east, trial.north, trial.up]).reshape(3, _TRIAL, _TRIAL)
    counts = [
        min(math.ceil(_steepest(np.diff(vectors, axis=axis)) * (_TRIAL - 1) / _NODE_RAD) + 1, _MOST_NODES, size)
        for axis, size in ((1, height), (2, width))
    ]
    rows, columns = np.linspace(0, height - 1, max(counts[0], 2)), np.linspace(0, width - 1, max(counts[1], 2))
    grid = np.meshgrid(rows, columns, indexing="ij")
    view = field.view(grid[0].ravel(), grid[1].ravel())
    if view is None:
        return None
    nodes = np.concatenate([np.stack([view.east, view.north, view.up]), view.cells_m]).reshape(5, rows.size, columns.size)
    return SunDirections(nodes, rows, columns)


def _steepest(differences: Float64) -> float:
    """Return the largest turn [radians] between neighbouring vectors, whose differences these are."""
    return float(np.sqrt((differences**2).sum(axis=0)).max())


def _matters(view: SunView, whole: Rect, place: GridPlace, sun: SunPosition, earth: Earth) -> bool:
    """Whether somewhere on the map sun or distances differ from what they are taken as, given those of the centre."""
    rows, columns = lattice(whole, _TRIAL)
    row, column = (whole.height - 1) / 2, (whole.width - 1) / 2
    east, north = sine_cosine_deg(sun.azimuth_deg)
    toward = (columns - column) * place.cell_m[0] * east - (rows - row) * place.cell_m[1] * north
    tangents = np.clip(tangent_deg(sun.elevation_deg), -1e18, 1e18) + 2 * curvature_per_m(earth) * toward
    up = np.arctan(tangents)
    taken = np.stack([np.cos(up) * east, np.cos(up) * north, np.sin(up)])
    turned = _steepest(np.stack([view.east, view.north, view.up]) - taken)
    cells = place.cells_m[:, rows.astype(int)]
    return turned > ASTRAY_RAD or float((np.abs(view.cells_m - cells) / np.minimum(view.cells_m, cells)).max()) > _CELL_RATIO
