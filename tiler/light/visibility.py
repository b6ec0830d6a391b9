"""What every sample of a grid sees of the sun and of the sky, as shares of 65535 in scratch files."""

import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.light.bands import Sweep, sweep_bands
from tiler.light.certified import CertifiedSweep
from tiler.light.frame import Earth, Frame, Shape, SunPosition, curvature_per_m, sine_cosine_deg, tangent_deg
from tiler.light.horizons import HorizonSweep
from tiler.light.penumbra import PenumbraSweep, can_march
from tiler.light.place import GridPlace
from tiler.light.shading import add_sky, share_of_disc
from tiler.light.shadow import ShadowSweep
from tiler.light.sweeping import LIT, Float32, Float64
from tiler.light.zones import Zone
from tiler.rowfile import RowFile

TOP: Final = 65535
"""The share of what is seen as a whole."""
_NEAR_STEPS: Final = 16
"""Exact steps of a horizon: with them the error of a penumbra is about one code of 8 bits, that of the sky a tenth of one. Without, the sky
is 2.4 codes off on rough ground, however many azimuths there are."""
_BAND_SAMPLES: Final = 1 << 21
"""Samples that are swept at once by hulls, which hold some 30 bytes of each."""
_LEAN_BAND_SAMPLES: Final = 1 << 24
"""Samples that are swept at once for the sun: 12 to 20 bytes of each are held. Columns of a scratch file are read in as many pieces as
there are rows; at 16384 x 16384 that is what a hard sweep takes its time for, and a wide band reads the fewest."""
_UNIT: Final = 1 << 20
"""Of the shares that directions of the sky add up to."""

Shares = NDArray[np.uint16]


class Heights(Protocol):
    """A grid of heights as ``HeightGrid`` has them, or a window of one."""

    @property
    def shape(self) -> Shape:
        """Rows and columns."""

    @property
    def block(self) -> int:
        """Rows and columns that are best read at once."""

    @property
    def range_m(self) -> tuple[float, float]:
        """Bounds on the heights [m]."""

    def read(self, window: Rect, /) -> Float32:
        """Return the heights (h, w) of a window."""

    def read_around(self, window: Rect, /) -> Float32:
        """Return the heights (h + 2, w + 2) of a window and around it, NaN beyond the grid."""


@dataclass(frozen=True)
class HeightWindow:
    """A ``window`` of ``heights`` as a grid of its own, as far as sweeps are concerned; slopes at its edges are those of the whole."""

    heights: Heights
    window: Rect

    @property
    def shape(self) -> Shape:
        """Rows and columns."""
        return self.window.height, self.window.width

    @property
    def block(self) -> int:
        """Rows and columns that are best read at once."""
        return self.heights.block

    @property
    def range_m(self) -> tuple[float, float]:
        """Bounds on the heights [m]: those of the whole, so that no window has other bounds than its neighbour."""
        return self.heights.range_m

    def read(self, window: Rect, /) -> Float32:
        """Return the heights (h, w) of a window."""
        return self.heights.read(window.shifted(self.window.x0, self.window.y0))

    def read_around(self, window: Rect, /) -> Float32:
        """Return the heights (h + 2, w + 2) of a window and around it."""
        return self.heights.read_around(window.shifted(self.window.x0, self.window.y0))


@dataclass(frozen=True)
class SunSetting:
    """How the sun's visibility is found: by ``lines`` per sample or, without, free of wrong samples; of a disc if it has a radius."""

    lines: int | None
    radius_deg: float | None
    earth: Earth | None


def make_shares(heights: Heights, scratch: Path) -> RowFile:
    """Return a scratch file for one share per sample."""
    return RowFile(heights.shape[1], heights.shape[0], 1, np.dtype(np.uint16), scratch, heights.block)


def band_size(frame: Frame, block: int, threads: int = 1, samples: int = _BAND_SAMPLES) -> int:
    """Return how many rows or columns of a grid are swept at once, whole blocks of them."""
    return max(1, samples // threads // (frame.columns * block)) * block


def whole_zone(heights: Heights, place: GridPlace, sun: SunPosition) -> Zone:
    """Return a map as its only zone."""
    height, width = heights.shape
    whole = Rect(0, 0, width, height)
    return Zone(whole, whole, place.cell_m, sun, ((height - 1) / 2, (width - 1) / 2))


def sun_shares(heights: Heights, zones: list[Zone], setting: SunSetting, workers: int, shares: RowFile) -> None:
    """Write into ``shares`` how much of the sun is seen from every sample, zone by zone, several at once."""
    threads = max(1, min(workers, len(zones)))

    def find(zone: Zone) -> None:
        if zone.dark:
            shares.write(zone.core.x0, zone.core.y0, np.zeros((zone.core.height, zone.core.width, 1), np.uint16))
            return
        view = HeightWindow(heights, zone.window)
        soft = setting.radius_deg is not None
        parts = soft_sun(view, zone, setting, threads, max(1, workers // threads)) if soft else hard_sun(view, zone, setting, threads)
        for window, seen in parts:
            _keep(zone, window, seen, shares)

    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(find, zones):
            pass


def _keep(zone: Zone, window: Rect, seen: Shares, shares: RowFile) -> None:
    """Write what was found in a window of a zone's window, as far as it is in the zone."""
    moved = window.shifted(zone.window.x0, zone.window.y0)
    kept = moved & zone.core
    if kept:
        part = seen[kept.y0 - moved.y0 : kept.y1 - moved.y0, kept.x0 - moved.x0 : kept.x1 - moved.x0]
        shares.write(kept.x0, kept.y0, part[..., np.newaxis])


def hard_sun(heights: Heights, zone: Zone, setting: SunSetting, threads: int = 1) -> Iterator[tuple[Rect, Shares]]:
    """Yield where the sun's centre is seen in windows of a zone's window, all of it or nothing."""
    sweep = (
        CertifiedSweep(heights.shape, zone.cell_m, zone.sun, setting.earth, range_m=heights.range_m, reference=zone.reference)
        if setting.lines is None
        else ShadowSweep(heights.shape, zone.cell_m, zone.sun, setting.earth, lines=setting.lines, reference=zone.reference)
    )
    for window, codes in sweep_bands(sweep, heights.read, band_size(sweep.frame, heights.block, threads, _LEAN_BAND_SAMPLES)):
        yield window, (codes == LIT) * np.uint16(TOP)


def soft_sun(heights: Heights, zone: Zone, setting: SunSetting, threads: int = 1, helpers: int = 1) -> Iterator[tuple[Rect, Shares]]:
    """Yield how much of the sun's disc is seen in windows of a zone's window, found by so many ``helpers``, threads of its own.

    Beyond the grid is the sea, at height 0: level with the horizon on a flat Earth, and below it on a round one, seen from above.
    """
    radius, curvature = setting.radius_deg or 0.0, curvature_per_m(setting.earth)
    with ThreadPoolExecutor(helpers) as pool:
        sweep = _disc_sweep(heights, zone, setting, pool if helpers > 1 else None)
        last: list[Float32] = []

        def read(window: Rect) -> Float32:
            last[:] = [heights.read(window)]
            return last[0]

        most = _LEAN_BAND_SAMPLES // 2 if isinstance(sweep, PenumbraSweep) else _BAND_SAMPLES
        for window, tangents in sweep_bands(sweep, read, band_size(sweep.frame, heights.block, threads, most)):
            seen = np.empty(tangents.shape, np.uint16)
            around = np.ascontiguousarray(last[0])
            slopes = sun_slopes(heights.shape, zone.cell_m, zone.sun, setting.earth, window, zone.reference)
            share_of_disc(tangents, around, slopes, curvature, radius, seen)
            yield window, seen


def _disc_sweep(heights: Heights, zone: Zone, setting: SunSetting, pool: Executor | None) -> Sweep[np.float32]:
    """Return what finds the horizons that cut the sun's disc: by marches, or by hulls where too much would have to be kept for those."""
    radius, bounds = setting.radius_deg or 0.0, heights.range_m
    shape, earth, reference = heights.shape, setting.earth, zone.reference
    if can_march(shape, zone.cell_m, zone.sun, radius, earth, reference, bounds):
        return PenumbraSweep(shape, zone.cell_m, zone.sun, radius, earth, reference=reference, range_m=bounds, pool=pool)
    return HorizonSweep(shape, zone.cell_m, zone.sun.azimuth_deg, earth, near_steps=_NEAR_STEPS, pool=pool)


def sun_slopes(
    shape: Shape,
    cell_m: tuple[float, float],
    sun: SunPosition,
    earth: Earth | None,
    window: Rect,
    reference: tuple[float, float] | None = None,
) -> Float64:
    """Return what the tangent of the sun's elevation is made of at the samples of a window.

    That at the ``reference`` (row, column), by default the grid's centre, how it changes by row and by column, and the row and column of
    the window's first sample, from there: whole or half numbers, so that a sample's tangent does not depend on the window. Parallel rays
    stand lower above a round Earth the farther a sample lies away from the sun, by the angle between the verticals.
    """
    east, north = sine_cosine_deg(sun.azimuth_deg)
    lower = 2 * curvature_per_m(earth)
    row, column = reference or ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
    return np.array(
        [
            tangent_deg(sun.elevation_deg),
            -lower * north * cell_m[1],
            lower * east * cell_m[0],
            window.y0 - row,
            window.x0 - column,
        ]
    )


def sky_shares(
    heights: Heights, place: GridPlace, azimuths: int, earth: Earth | None, workers: int, scratch: Path, zones: list[Zone] | None = None
) -> RowFile:
    """Return the share of 65535 of an even sky that every sample sees, weighed by the cosine of its incidence.

    Horizons are looked for in so many ``azimuths``, none of them along the rows or the columns of the grid. The sky is what lies above the
    horizontal; beyond the grid nothing rises into it. What is missing of 65535 is filled by ground.
    """
    height, width = heights.shape
    sums = RowFile(width, height, 1, np.dtype(np.uint32), scratch, heights.block)
    lock = threading.Lock()
    strips = [Rect(0, y, width, min(height, y + 256)) for y in range(0, height, 256)]
    found = zones or [whole_zone(heights, place, SunPosition(0.0, 90.0))]
    threads = max(1, min(workers, azimuths))

    def add(number: int, zone: Zone) -> None:
        for window, seen in _sky_of(heights, zone, place, (number + 0.5) * 360.0 / azimuths, earth, 2 * threads):
            with lock:
                sums.write(window.x0, window.y0, sums.read(window) + seen[..., np.newaxis])

    try:
        for strip in strips:
            sums.write(0, strip.y0, np.zeros((strip.height, width, 1), np.uint32))
        with ThreadPoolExecutor(threads) as pool:
            jobs = [(number, zone) for zone in found for number in range(azimuths)]
            for _ in pool.map(lambda job: add(*job), jobs):
                pass
        shares = make_shares(heights, scratch)
        for strip in strips:
            mean = sums.read(strip) * (TOP / (azimuths * _UNIT))
            shares.write(0, strip.y0, np.minimum(np.rint(mean), TOP).astype(np.uint16))
    finally:
        sums.close()
    return shares


def _sky_of(
    heights: Heights, zone: Zone, place: GridPlace, azimuth: float, earth: Earth | None, threads: int
) -> Iterator[tuple[Rect, NDArray[np.uint32]]]:
    """Yield windows of a zone, on the map, and what is seen of the sky in one direction there."""
    east, north = sine_cosine_deg(azimuth)
    view = HeightWindow(heights, zone.window)
    cells = place.cells_in(zone.core)
    sweep = HorizonSweep(view.shape, zone.cell_m, azimuth, earth, near_steps=_NEAR_STEPS, lowest_m=heights.range_m[0])
    for window, tangents in sweep_bands(sweep, view.read, band_size(sweep.frame, heights.block, threads)):
        moved = window.shifted(zone.window.x0, zone.window.y0)
        kept = moved & zone.core
        if not kept:
            continue
        part = tangents[kept.y0 - moved.y0 : kept.y1 - moved.y0, kept.x0 - moved.x0 : kept.x1 - moved.x0]
        seen = np.zeros((kept.height, kept.width), np.uint32)
        rows = slice(kept.y0 - zone.core.y0, kept.y1 - zone.core.y0)
        add_sky(heights.read_around(kept), np.ascontiguousarray(cells[:, rows]), np.ascontiguousarray(part), east, north, seen)
        yield kept, seen
