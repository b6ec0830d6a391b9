"""Large maps in zones: within one the sun has one azimuth on the grid and samples one distance, as a sweep needs them.

A zone is halved until the sun's direction in it, as a sweep takes it, leads the longest shadow there can be nowhere farther astray than
half a sample, or a quarter of the sun's radius, whichever is more: an eighth of the width over which the real sun's disc blurs that
shadow's edge. Shadows of less than all of the map's relief are led astray in proportion. While the sun is right to within its radius,
no side of a zone is made shorter than the shadow that crosses it: more of what is swept would be margin than zone.

Zones are of the map alone, so nothing depends on tasks, bands or workers. What is swept for a zone is its own window, grown toward the
sun by the longest shadow, so that what is found in the zone is what a sweep of the whole map with the zone's sun would find.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.region import Rect
from tiler.light.frame import Earth, SunPosition, curvature_per_m
from tiler.light.ground import SunField, SunView
from tiler.light.sweeping import Float64

SUN_RADIUS_RAD: Final = math.radians(0.2666)
ASTRAY_SAMPLES: Final = 0.5
ASTRAY_RAD: Final = SUN_RADIUS_RAD / 4
_LOW_RAD: Final = math.radians(5.0)
"""So near to the horizon a zone's sun must itself be right, whatever the relief: it decides where the night begins."""
_MOST_ZONES: Final = 64
_SHORTEST_SIDE: Final = 8, 256
"""Samples: no side of a zone is shorter than a 64th of the map, if that is between the two. Around a pole of a geographic grid no zone is
small enough, and shadows are longer than the map in samples: nor is any side shorter than an eighth of the shadow."""
_HALO: Final = 3
"""Samples around what a ray can reach: its neighbours, and rounding."""
CELL_RATIO: Final = 0.02
"""By how much distances between samples may differ in a zone of the sky: horizons of 20 degrees are then 0.4 degrees off, at its edges."""
_WIDER: Final = 5.0
"""So many times the ratio is allowed where a zone of the sky would otherwise be shorter than what is swept around it."""
_LEAST_TANGENT: Final = 0.02
"""Farther away than where all of the map's relief is so high, nothing is looked for in a zone: it would hide 0.0004 of the sky."""


@dataclass(frozen=True)
class Zone:
    """A part ``core`` of a map, the ``window`` of the map that is swept for it, and the sun and the distances [m] at the core's centre.

    ``dark`` if no sample of it can see the sun. ``centre`` is (row, column) on the map.
    """

    core: Rect
    window: Rect
    cell_m: tuple[float, float]
    sun: SunPosition
    centre: tuple[float, float]
    dark: bool = False

    @property
    def reference(self) -> tuple[float, float]:
        """The centre's (row, column) in the window."""
        return self.centre[0] - self.window.y0, self.centre[1] - self.window.x0


class SunZones:
    """What is needed to cut a map with a relief [m] of ``range_m`` above and below the sea into zones for a sun of ``radius_deg``."""

    def __init__(self, field: SunField, range_m: tuple[float, float], earth: Earth, radius_deg: float) -> None:
        self.field = field
        self._relief, self._highest = steady(range_m[1] - range_m[0]), steady(range_m[1])
        self._curvature, self._radius = curvature_per_m(earth), math.radians(radius_deg)

    def plan(self) -> list[Zone] | None:
        """Return the zones of the map; None if a part of it is no place on the Earth, or if one is enough."""
        height, width = self.field.ground.shape
        zones = list(split(Rect(0, 0, width, height), self._axis))
        if len(zones) == 1 or any(view is None for _, view in zones):
            return None
        return [self._zone(core, view) for core, view in zones if view is not None]

    def _axis(self, core: Rect) -> tuple[int | None, SunView | None]:
        """Return the axis along which ``core`` has to be halved, 0 for rows, None if it is a zone; and the sun at 5 x 5 of its samples."""
        view = self.field.view(*lattice(core))
        if view is None:
            return None, None
        tips, found = self._tips(view), self._modelled(core, view)
        model = found[0]
        astray, length = np.hypot(*(tips - model)), np.hypot(*model)
        elevations, taken = view_elevations(view), np.arctan(found[1])
        near = _LOW_RAD + np.ptp(elevations) / 4
        turned = np.where(np.minimum(np.abs(elevations), np.abs(taken)) < near, np.abs(taken - elevations), 0.0)
        dark = (found[1] < self._darkest) & (np.tan(elevations) < self._darkest)
        astray, rough = np.where(dark, 0.0, astray), np.where(dark, 0.0, astray - SUN_RADIUS_RAD * length)
        excess = np.maximum(astray / np.maximum(ASTRAY_SAMPLES, ASTRAY_RAD * length), turned / ASTRAY_RAD)
        if excess.max() <= 1.0:
            return None, view
        far_off = bool(max(rough.max(), (turned - SUN_RADIUS_RAD).max()) > 0.0)
        return _halved(core, max(self.field.ground.shape), excess.reshape(5, 5), np.abs(model).max(axis=1), far_off), view

    @property
    def _darkest(self) -> float:
        """The tangent of the sun's elevation under which even the highest ground is in the shadow of the Earth."""
        return -math.sqrt(4.0 * self._curvature * self._highest) - math.tan(self._radius) - ASTRAY_RAD

    def _reach_m(self, tangents: Float64) -> Float64:
        """Return how far away [m] terrain can shade a sample that sees the sun at such a tangent: on flat ground relief / tangent."""
        root = np.sqrt(tangents * tangents + 4.0 * self._curvature * self._relief)
        rising = np.maximum(tangents, self._darkest)
        down = (np.sqrt(rising * rising + 4.0 * self._curvature * self._relief) - rising) / (2.0 * self._curvature)
        with np.errstate(over="ignore"):
            return np.where(tangents > 0, 2.0 * self._relief / np.maximum(tangents + root, 1e-300), down)

    def _tips(self, view: SunView) -> Float64:
        """Return how far the shadows of all the relief reach, (2, n) [samples] to the right and upward, toward the sun."""
        level = np.hypot(view.east, view.north)
        reach = self._reach_m(np.tan(view_elevations(view)) - math.tan(self._radius))
        return reach * np.stack([view.east, view.north]) / np.where(level > 0, level, 1.0) / view.cells_m

    def _modelled(self, core: Rect, view: SunView) -> tuple[Float64, Float64]:
        """Return the same as a sweep with the sun and distances of the core's centre takes it, and the tangents of the sun's elevation."""
        middle = view.east.size // 2
        level = math.hypot(view.east[middle], view.north[middle]) or 1.0
        across, along = view.east[middle] / level, view.north[middle] / level
        cells = view.cells_m[:, middle]
        rows, columns = lattice(core)
        toward = (columns - columns[middle]) * cells[0] * across - (rows - rows[middle]) * cells[1] * along
        tangents = view.up[middle] / max(level, 1e-300) + 2.0 * self._curvature * toward
        reach = self._reach_m(tangents - math.tan(self._radius))
        return reach * np.array([[across], [along]]) / cells[:, np.newaxis], tangents

    def _zone(self, core: Rect, view: SunView) -> Zone:
        """Return the zone of a core: its window reaches as far toward the sun as anything that shades it can stand."""
        middle = view.east.size // 2
        tips, tangents = self._modelled(core, view)
        right, left = max(tips[0].max(), 0.0), max(-tips[0].min(), 0.0)
        upward, downward = max(tips[1].max(), 0.0), max(-tips[1].min(), 0.0)
        height, width = self.field.ground.shape
        window = Rect(
            math.floor(max(core.x0 - left - _HALO, 0)),
            math.floor(max(core.y0 - upward - _HALO, 0)),
            math.ceil(min(core.x1 + right + _HALO, width)),
            math.ceil(min(core.y1 + downward + _HALO, height)),
        )
        sun = SunPosition(float(view.azimuths_deg[middle]), float(view.elevations_deg[middle]))
        cell = float(view.cells_m[0, middle]), float(view.cells_m[1, middle])
        return Zone(core, window, cell, sun, centre_of(core), bool(tangents.max() < self._darkest))


def _halved(core: Rect, map_side: int, excess: Float64, margins: Float64, far_off: bool) -> int | None:
    """Return the axis to halve, by what is wrong along the middle column (0) and row (1); None if that is not worth its margins."""
    wrong = [float(excess[:, 2].max()), float(excess[2].max())]
    if max(wrong) <= 1.0:  # only the corners are wrong
        wrong = [2.0, 2.0]
    sides, shadows = (core.height, core.width), (margins[1], margins[0])
    shortest = min(max(map_side // _MOST_ZONES, _SHORTEST_SIDE[0]), _SHORTEST_SIDE[1])
    for axis in sorted((0, 1), key=lambda axis: (-wrong[axis], -sides[axis])):
        if wrong[axis] > 1.0 and sides[axis] >= 2 * max(shortest, shadows[axis] / (8 if far_off else 1)):
            return axis
    return None


def split(core: Rect, axis_of: Callable[[Rect], tuple[int | None, SunView | None]]) -> Iterator[tuple[Rect, SunView | None]]:
    """Halve a window along the axes that ``axis_of`` tells, until it tells none; yield the parts in order, with what came beside."""
    axis, view = axis_of(core)
    if axis is None:
        yield core, view
    elif axis == 0:
        middle = (core.y0 + core.y1) // 2
        yield from split(Rect(core.x0, core.y0, core.x1, middle), axis_of)
        yield from split(Rect(core.x0, middle, core.x1, core.y1), axis_of)
    else:
        middle = (core.x0 + core.x1) // 2
        yield from split(Rect(core.x0, core.y0, middle, core.y1), axis_of)
        yield from split(Rect(middle, core.y0, core.x1, core.y1), axis_of)


def steady(size_m: float) -> float:
    """Return a height [m], not negative, rounded up by an eighth at most: an update that lifts the highest summit moves no zone."""
    if size_m <= 0:
        return 0.0
    step = 2.0 ** (math.floor(math.log2(size_m)) - 3)
    return math.ceil(size_m / step) * step


def centre_of(core: Rect) -> tuple[float, float]:
    """Return the row and column of a window's centre."""
    return (core.y0 + core.y1 - 1) / 2, (core.x0 + core.x1 - 1) / 2


def lattice(core: Rect, count: int = 5) -> tuple[Float64, Float64]:
    """Return rows and columns (count * count,) of samples all over a window, its centre in the middle."""
    rows, columns = np.meshgrid(np.linspace(core.y0, core.y1 - 1, count), np.linspace(core.x0, core.x1 - 1, count), indexing="ij")
    return rows.ravel(), columns.ravel()


def view_elevations(view: SunView) -> Float64:
    """Return elevations [radians]."""
    return np.arctan2(view.up, np.hypot(view.east, view.north))


def sky_zones(field: SunField, range_m: tuple[float, float], earth: Earth) -> list[Zone] | None:
    """Return zones in which samples are as far apart as at their centres, to 2 or 10 %; None if one will do, or a part has no place.

    Their windows reach as far as all of the map's relief is higher than a fiftieth of its distance. Their sun is in the zenith.
    """
    height, width = field.ground.shape
    relief, curvature = steady(range_m[1] - range_m[0]), curvature_per_m(earth)
    reach = (math.sqrt(_LEAST_TANGENT**2 + 4 * curvature * relief) - _LEAST_TANGENT) / (2 * curvature)

    def axis_of(core: Rect) -> tuple[int | None, SunView | None]:
        view = field.view(*lattice(core))
        if view is None:
            return None, None
        middle = view.cells_m[:, 12:13]
        wrong = (np.abs(view.cells_m - middle) / np.minimum(view.cells_m, middle)).max(axis=0) / CELL_RATIO
        if wrong.max() <= 1.0:
            return None, view
        return _halved(core, max(height, width), wrong.reshape(5, 5), reach / middle[:, 0], bool(wrong.max() > _WIDER)), view

    zones = list(split(Rect(0, 0, width, height), axis_of))
    if len(zones) == 1 or any(view is None for _, view in zones):
        return None
    found = []
    for core, view in zones:
        assert view is not None
        cell = float(view.cells_m[0, 12]), float(view.cells_m[1, 12])
        x, y = (math.ceil(min(reach / side, 1e9)) + _HALO for side in cell)
        window = Rect(max(core.x0 - x, 0), max(core.y0 - y, 0), min(core.x1 + x, width), min(core.y1 + y, height))
        found.append(Zone(core, window, cell, SunPosition(0.0, 90.0), centre_of(core)))
    return found
