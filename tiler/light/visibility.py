"""What every sample of a grid sees of the sun and of the sky, as shares of 65535 in scratch files."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np

from schemas.region import Rect
from tiler.light.bands import sweep_bands
from tiler.light.certified import CertifiedSweep
from tiler.light.frame import Earth, Frame, Shape, SunPosition, curvature_per_m, sine_cosine_deg, tangent_deg
from tiler.light.heights import HeightGrid
from tiler.light.horizons import HorizonSweep
from tiler.light.place import GridPlace
from tiler.light.shading import add_sky, share_of_disc
from tiler.light.shadow import ShadowSweep
from tiler.light.sweeping import LIT, Float64
from tiler.rowfile import RowFile

TOP: Final = 65535
"""The share of what is seen as a whole."""
_NEAR_STEPS: Final = 16
"""Exact steps of the sun's horizon: with them the error of a penumbra is about one code of 8 bits."""
_BAND_SAMPLES: Final = 1 << 21
"""Samples that are swept at once: a sweep holds some 30 bytes of each."""
_UNIT: Final = 1 << 20
"""Of the shares that directions of the sky add up to."""


def make_shares(grid: HeightGrid, scratch: Path) -> RowFile:
    """Return a scratch file for one share per sample."""
    return RowFile(grid.shape[1], grid.shape[0], 1, np.dtype(np.uint16), scratch)


def band_size(frame: Frame, block: int, threads: int = 1) -> int:
    """Return how many rows or columns of a grid are swept at once, whole blocks of them."""
    return max(1, _BAND_SAMPLES // threads // (frame.columns * block)) * block


def hard_sun(grid: HeightGrid, place: GridPlace, sun: SunPosition, earth: Earth | None, lines: int | None, shares: RowFile) -> None:
    """Write into ``shares`` where the sun's centre is seen, all of it or nothing; ``lines`` None: without a wrong sample."""
    sweep = (
        CertifiedSweep(grid.shape, place.cell_m, sun, earth, range_m=grid.range_m)
        if lines is None
        else ShadowSweep(grid.shape, place.cell_m, sun, earth, lines=lines)
    )
    for window, codes in sweep_bands(sweep, grid.read, band_size(sweep.frame, grid.block)):
        shares.write(window.x0, window.y0, ((codes == LIT) * np.uint16(TOP))[..., np.newaxis])


def soft_sun(grid: HeightGrid, place: GridPlace, sun: SunPosition, radius_deg: float, earth: Earth | None, shares: RowFile) -> None:
    """Write into ``shares`` how much of the sun's disc is seen.

    Beyond the grid is the sea, at height 0: level with the horizon on a flat Earth, and below it on a round one, seen from above.
    """
    sweep = HorizonSweep(grid.shape, place.cell_m, sun.azimuth_deg, earth, near_steps=_NEAR_STEPS)
    curvature = curvature_per_m(earth)
    for window, tangents in sweep_bands(sweep, grid.read, band_size(sweep.frame, grid.block)):
        seen = np.empty(tangents.shape, np.uint16)
        heights = np.ascontiguousarray(grid.read(window))
        share_of_disc(tangents, heights, sun_slopes(grid.shape, place.cell_m, sun, earth, window), curvature, radius_deg, seen)
        shares.write(window.x0, window.y0, seen[..., np.newaxis])


def sun_slopes(shape: Shape, cell_m: tuple[float, float], sun: SunPosition, earth: Earth | None, window: Rect) -> Float64:
    """Return what the tangent of the sun's elevation is made of at the samples of a window.

    That at the grid's centre, how it changes by row and by column, and the row and column of the window's first sample, from the centre:
    whole or half numbers, so that a sample's tangent does not depend on the window. Parallel rays stand lower above a round Earth the
    farther a sample lies away from the sun, by the angle between the verticals.
    """
    east, north = sine_cosine_deg(sun.azimuth_deg)
    lower = 2 * curvature_per_m(earth)
    return np.array(
        [
            tangent_deg(sun.elevation_deg),
            -lower * north * cell_m[1],
            lower * east * cell_m[0],
            window.y0 - (shape[0] - 1) / 2,
            window.x0 - (shape[1] - 1) / 2,
        ]
    )


def sky_shares(grid: HeightGrid, place: GridPlace, azimuths: int, earth: Earth | None, workers: int, scratch: Path) -> RowFile:
    """Return the share of 65535 of an even sky that every sample sees, weighed by the cosine of its incidence.

    Horizons are looked for in so many ``azimuths``, none of them along the rows or the columns of the grid. What lies beyond the grid is
    sky, so what is missing of 65535 is filled by ground.
    """
    height, width = grid.shape
    sums = RowFile(width, height, 1, np.dtype(np.uint32), scratch)
    lock = threading.Lock()
    strips = [Rect(0, y, width, min(height, y + 256)) for y in range(0, height, 256)]
    threads = max(1, min(workers, azimuths))
    try:
        for strip in strips:
            sums.write(0, strip.y0, np.zeros((strip.height, width, 1), np.uint32))

        def add(number: int) -> None:
            azimuth = (number + 0.5) * 360.0 / azimuths
            east, north = sine_cosine_deg(azimuth)
            sweep = HorizonSweep(grid.shape, place.cell_m, azimuth, earth, near_steps=0)
            for window, tangents in sweep_bands(sweep, grid.read, band_size(sweep.frame, grid.block, 2 * threads)):
                seen = np.zeros((window.height, window.width), np.uint32)
                add_sky(
                    grid.read_around(window), np.ascontiguousarray(place.cells_m[:, window.y0 : window.y1]), tangents, east, north, seen
                )
                with lock:
                    sums.write(window.x0, window.y0, sums.read(window) + seen[..., np.newaxis])

        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(add, range(azimuths)):
                pass
        shares = make_shares(grid, scratch)
        for strip in strips:
            mean = sums.read(strip) * (TOP / (azimuths * _UNIT))
            shares.write(0, strip.y0, np.minimum(np.rint(mean), TOP).astype(np.uint16))
    finally:
        sums.close()
    return shares
