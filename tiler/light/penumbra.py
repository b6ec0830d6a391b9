"""Horizons where they cut the sun's disc, and only there: the rest sees all of it or nothing, which two sweeps prove.

Bounds as of ``tiler.light.certified`` tell, under the sun's lower edge, which samples see all of the disc, and under the upper edge which
see nothing. From what is left, a few percent, rays are marched over a pyramid of maxima: each is lifted to what it meets, so that at
its end it is the horizon, exactly. The hulls of ``tiler.light.horizons`` find all horizons, with errors, and take as long or longer.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Final, TypeVar

import numpy as np

from tiler.light.bracketing import UNDECIDED
from tiler.light.certified import Brackets, HeightExtent, reach_rows, slack_of
from tiler.light.frame import Earth, Frame, Shape, SunPosition, tangent_deg
from tiler.light.marching import march_horizons
from tiler.light.shadow import Rays, check_rows, rays_of
from tiler.light.sweeping import SHADED, Codes, Float32
from tiler.light.terrainkept import KeptTerrain

Result = TypeVar("Result")

_MARCHED_ROWS: Final = 32
"""Rows that one thread marches for at a time."""
_MOST_KEPT_BYTES: Final = 384 << 20
_HIGHEST_DEG: Final = 89.0
"""The upper edge of the sun up to which this works: at the zenith a ray has no slope."""
_ROUNDING: Final = 1e-6
"""Of slopes of the sun's edges: where they are local ones is found at some places only."""


class PenumbraSweep:
    """Horizons of a grid toward a sun of ``radius_deg``, band by band: ``push`` rows of the frame, get the tangents of their horizons.

    They are above the local horizontal; minus infinity where they are under all of the disc, and ``DARK`` where they are over it. A
    ``pool`` of threads may help; other parameters are as of ``CertifiedSweep``. ``marched`` counts the rays that had to be marched.
    """

    def __init__(
        self,
        shape: Shape,
        cell_m: tuple[float, float],
        sun: SunPosition,
        radius_deg: float,
        earth: Earth | None = None,
        *,
        reference: tuple[float, float] | None = None,
        range_m: tuple[float, float],
        pool: Executor | None = None,
    ) -> None:
        self._pool = pool
        self._low, self._high = edges_of(rays_of(shape, cell_m, sun, earth, reference=reference), radius_deg)
        self.marched = 0
        self._row = 0
        self._kept = KeptTerrain(self._low, reach_rows(self._low, range_m[1] - range_m[0]))
        self._brackets = Brackets(self._low), Brackets(self._high)
        self._extent = HeightExtent(self._low, range_m)

    @property
    def frame(self) -> Frame:
        """How the grid is turned so that its rows can be pushed from the sun's side."""
        return self._low.frame

    def push(self, rows_m: Float32) -> Float32:
        """Return the tangents (h, columns) float32 of the next ``rows_m`` (h, columns) float32 [m] of the frame; voids are NaN."""
        check_rows(self.frame, self._row, rows_m)
        highest = self._extent.grown(rows_m)
        kept = self._later(lambda: self._kept.push(rows_m))
        beside = self._later(lambda: self._brackets[1].push(rows_m, highest))
        below = self._brackets[0].push(rows_m, highest)
        above = beside()
        kept()
        below[below == SHADED] = UNDECIDED
        below[(below == UNDECIDED) & (above == SHADED)] = SHADED
        tangents = self._march(below, highest)
        self._row += rows_m.shape[0]
        return tangents

    def _later(self, work: Callable[[], Result]) -> Callable[[], Result]:
        """Begin ``work`` in the pool, if there is one; return what waits for its result."""
        return work if self._pool is None else self._pool.submit(work).result

    def _march(self, codes: Codes, highest: float) -> Float32:
        """Return the tangents of the last rows, given which of their samples have to be marched for."""
        low, frame, kept = self._low, self.frame, self._kept
        tangents = np.empty(codes.shape, np.float32)
        peaks, table, maxima = kept.pyramid()
        slack, above = slack_of(low, highest), kept.heights.shape[0] - codes.shape[0]

        def march(start: int) -> int:
            part = slice(start, start + _MARCHED_ROWS)
            return march_horizons(
                kept.heights,
                above + start,
                kept.first,
                frame.shift,
                low.slope,
                self._high.slope,
                frame.step_m,
                slack,
                low.lift,
                peaks,
                table,
                maxima,
                codes[part],
                tangents[part],
            )

        starts = range(0, codes.shape[0], _MARCHED_ROWS)
        self.marched += sum(map(march, starts) if self._pool is None else self._pool.map(march, starts))
        return tangents


def edges_of(rays: Rays, radius_deg: float) -> tuple[Rays, Rays]:
    """Return the rays to the sun's lower and upper edge: no sample of the grid sees the disc reach beyond them.

    The disc is as wide everywhere, above local horizontals, and so its edges' slopes at the reference differ between samples, a little.
    """
    row_m, column_m, row, column, curvature = rays.lift
    frame = rays.frame
    corners = [row_m * (y - row) + column_m * (x - column) for y in (0, frame.rows - 1) for x in (0, frame.columns - 1)]
    with np.errstate(under="ignore"):
        away = 2 * curvature * np.linspace(min(corners), max(corners), 65)
    local = np.degrees(np.arctan(rays.slope - away))
    lowest = min(tangent_deg(angle - radius_deg) + drop for angle, drop in zip(local.tolist(), away.tolist(), strict=True))
    highest = max(tangent_deg(min(angle + radius_deg, 89.9)) + drop for angle, drop in zip(local.tolist(), away.tolist(), strict=True))
    return tuple(  # type: ignore[return-value]
        Rays(frame, slope, rays.lift, rays.bias_m, rays.sea_m) for slope in (lowest - _ROUNDING, highest + _ROUNDING)
    )


def can_march(
    shape: Shape,
    cell_m: tuple[float, float],
    sun: SunPosition,
    radius_deg: float,
    earth: Earth | None,
    reference: tuple[float, float] | None,
    range_m: tuple[float, float],
) -> bool:
    """Whether what must be kept of a grid fits into memory, and the sun is neither at the zenith nor below a flat horizon."""
    if sun.elevation_deg + radius_deg > _HIGHEST_DEG:
        return False
    low, _ = edges_of(rays_of(shape, cell_m, sun, earth, reference=reference), radius_deg)
    return reach_rows(low, range_m[1] - range_m[0]) * low.frame.columns * 4 <= _MOST_KEPT_BYTES
