"""A plan put to the proof: a window is baked with and without every effect, and no sample may change by more than the plan says.

Horizons are marched to exactly and hard shadows are certified, as bounds are of light as it is: a sweep with one line per sample may
shade samples that are lit. What lies off the window is open sky.
"""

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.effects import EffectName, EffectPlan, EffectProof, PlannedEffect, ProvedEffect
from schemas.region import Rect
from schemas.scene import Scene
from tiler.effects.bounds import FULL_SCALE, refraction_deg
from tiler.effects.statistics import HeightStatistics
from tiler.light.certified import certified_shadow
from tiler.light.disc import disc_coverage
from tiler.light.frame import Earth, SunPosition, curvature_per_m, frame_of, sine_cosine_deg
from tiler.light.hulls import NO_HORIZON, near_steps
from tiler.light.place import GridPlace
from tiler.light.shading import add_sky, shade_window
from tiler.light.sweeping import LIT
from tiler.light.turning import turned
from tiler.light.visibility import sun_slopes
from tiler.samples.transfer import encode_srgb

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Effects = frozenset[EffectName]
Progress = Callable[[int, int], None]

ROUNDING_CODES: Final = 0.02
"""Of a bake: the sun's and the sky's shares are rounded to 1/65535 of 222 codes, horizons to float32."""
ROUNDING_DEG: Final = 1e-5
"""Of an angle between horizons in float32."""
_TOP: Final = 65535
_SKY_UNIT: Final = 1 << 20
"""Of the shares that ``add_sky`` adds up."""


@dataclass(frozen=True)
class LightBake:
    """Light on ``heights_m`` (h, w) float32 [m], NaN where void, that lie as ``place`` says, with any effects of ``scene``.

    The scene's sun stands where it is seen from the grid. Beyond ``sky_reach_m`` [m] occluders of the sky are far.
    """

    heights_m: Float32
    place: GridPlace
    scene: Scene
    sky_reach_m: float
    workers: int

    def codes(self, effects: Effects) -> Float64:
        """Return the light (h, w) of every sample with just these effects [codes of light]; 0 where void."""
        sun, sky = self._sun(effects), self._sky(effects)
        lit = self._shaded(effects, sun, sky, 0.0)
        if "bounce" not in effects:
            return lit
        valid = ~np.isnan(self.heights_m)
        mean = float(lit[valid].mean()) / FULL_SCALE * (1 + self.scene.sky.share) if valid.any() else 0.0
        return self._shaded(effects, sun, sky, self.scene.ground.albedo * mean)

    def elevation_deg(self, effects: Effects) -> float:
        """Return how high the sun is seen [degrees]."""
        elevation = self.scene.sun.direction_deg[1]
        return elevation + (refraction_deg(elevation) if "refraction_sun" in effects else 0.0)

    def slopes(self, effects: Effects) -> Float64:
        """Return the tangent of the sun's elevation at all samples, as ``sun_slopes`` gives it: that of the middle one, or of each."""
        sun = SunPosition(self.scene.sun.direction_deg[0], min(self.elevation_deg(effects), 90.0))
        shape = (self.heights_m.shape[0], self.heights_m.shape[1])
        # The vertical turns with the globe itself, not with the larger one over which bent rays are straight.
        globe = Earth(self.scene.ground.radius_m, 0.0) if "sun_direction" in effects else None
        return sun_slopes(shape, self.place.cell_m, sun, globe, Rect(0, 0, shape[1], shape[0]))

    def elevations_deg(self, effects: Effects) -> Float64:
        """Return the sun's elevation at every sample, (h, w) [degrees]."""
        slope, by_row, by_column, first_row, first_column = self.slopes(effects)
        rows, columns = np.ogrid[: self.heights_m.shape[0], : self.heights_m.shape[1]]
        tangents = slope + ((first_row + rows) * by_row + (first_column + columns) * by_column)
        return np.asarray(np.degrees(np.arctan(tangents)), np.float64)

    def earth(self, effects: Effects, of: EffectName) -> Earth | None:
        """Return the Earth between ground and what hides sun or sky: flat without the effect ``of`` its curvature."""
        bent = self.scene.air.refraction if of == "curvature_sky" or "refraction_path" in effects else 0.0
        return Earth(self.scene.ground.radius_m, bent) if of in effects else None

    def horizon(self, azimuth_deg: float, earth: Earth | None, reach_m: float = math.inf) -> Float32:
        """Return the tangents (h, w) of the horizons toward an azimuth on the grid, of ground up to ``reach_m`` away, by exact march."""
        shape = (self.heights_m.shape[0], self.heights_m.shape[1])
        frame = frame_of(shape, self.place.cell_m, azimuth_deg)
        rows = turned(self.heights_m, frame.turns)
        tangents = np.full(rows.shape, np.float32(NO_HORIZON), np.float32)
        steps = int(min(frame.rows, reach_m / frame.step_m))
        near_steps(rows, frame.shift, frame.step_m, curvature_per_m(earth), steps, tangents)
        return turned(tangents, -frame.turns)

    def _sun(self, effects: Effects) -> NDArray[np.uint16]:
        """Return the share of the sun that every sample sees, of 65535."""
        if "shadow" not in effects:
            return np.full(self.heights_m.shape, _TOP, np.uint16)
        azimuth, elevation = self.scene.sun.direction_deg[0], self.elevation_deg(effects)
        earth, radius = self.earth(effects, "curvature_shadow"), self.scene.sun.radius_deg
        soft = radius > 0 and "penumbra" in effects
        if not soft and earth is None and elevation > 0 and "sun_direction" not in effects:
            codes = certified_shadow(self.heights_m, self.place.cell_m, SunPosition(azimuth, min(elevation, 90.0)))
            return np.asarray((codes == LIT) * np.uint16(_TOP), np.uint16)
        horizon = np.nan_to_num(self.horizon(azimuth, earth), nan=NO_HORIZON, neginf=NO_HORIZON)
        elevations = self.elevations_deg(effects)
        share = disc_coverage(horizon, elevations, radius) if soft else np.degrees(np.arctan(horizon)) <= elevations
        return np.asarray(np.rint(share * np.float32(_TOP)), np.uint16)

    def _sky(self, effects: Effects) -> NDArray[np.uint16]:
        """Return the share of the sky above the horizontal that every sample sees, of 65535; without the effect its own slope hides."""
        if "sky" not in effects:
            return self._open_sky
        earth = self.earth(effects, "curvature_sky")
        return self._hidden_sky(earth, self.sky_reach_m if "far_occluders" not in effects else math.inf)

    @cached_property
    def _open_sky(self) -> NDArray[np.uint16]:
        return self._sky_shares(lambda azimuth: np.zeros(self.heights_m.shape, np.float32))

    def _hidden_sky(self, earth: Earth | None, reach_m: float) -> NDArray[np.uint16]:
        known, key = self._skies, (earth, reach_m)
        if key not in known:
            known[key] = self._sky_shares(lambda azimuth: self._raised_horizon(azimuth, earth, reach_m))
        return known[key]

    def _raised_horizon(self, azimuth_deg: float, earth: Earth | None, reach_m: float) -> Float32:
        """Return horizons that are nowhere below the horizontal, from under which no sky shines."""
        return np.asarray(np.fmax(self.horizon(azimuth_deg, earth, reach_m), np.float32(0)), np.float32)

    @cached_property
    def _skies(self) -> dict[tuple[Earth | None, float], NDArray[np.uint16]]:
        return {}

    def _sky_shares(self, horizon: Callable[[float], Float32]) -> NDArray[np.uint16]:
        azimuths = self.scene.sky.azimuths
        seen = np.zeros(self.heights_m.shape, np.uint32)
        turns = [(number + 0.5) * 360.0 / azimuths for number in range(azimuths)]
        with ThreadPoolExecutor(self.workers) as pool:
            for azimuth, tangents in zip(turns, pool.map(horizon, turns), strict=True):
                add_sky(self._around, self._cells, tangents, *sine_cosine_deg(azimuth), seen)
        return np.asarray(np.minimum(np.rint(seen * (_TOP / (azimuths * _SKY_UNIT))), _TOP), np.uint16)

    @cached_property
    def _around(self) -> Float32:
        return np.pad(self.heights_m, 1, constant_values=np.float32(np.nan))

    @cached_property
    def _cells(self) -> Float64:
        return np.ascontiguousarray(self.place.cells_m)

    def _shaded(self, effects: Effects, sun: NDArray[np.uint16], sky: NDArray[np.uint16], bounced: float) -> Float64:
        lit = np.empty(self.heights_m.shape, np.float32)
        east, north = sine_cosine_deg(self.scene.sun.direction_deg[0])
        shade_window(self._around, self._cells, east, north, self.slopes(effects), sun, sky, self.scene.sky.share, bounced, lit)
        return FULL_SCALE * lit.astype(np.float64)


def prove_plan(
    plan: EffectPlan,
    scene: Scene,
    heights_m: Float32,
    place: GridPlace,
    window: Rect,
    on_progress: Progress = lambda done, total: None,
) -> EffectProof:
    """Return what the effects of ``plan`` change on a ``window`` of its map, beside what they can.

    ``heights_m`` (h, w) float32 [m] and ``place`` are the window's, ``scene`` has its sun as seen from the grid. Time grows with the number
    of samples times the window's side: seconds for 512 x 512. ``on_progress`` is told of effects.
    """
    workers = len(os.sched_getaffinity(0))
    bake = LightBake(np.ascontiguousarray(heights_m, np.float32), place, scene, plan.sky_reach_m or math.inf, workers)
    of_the_bake = [one for one in plan.effects if one.stage == "bake"]
    wanted = [one for one in of_the_bake if one.verdict != "forced off"]
    everything, planned = _names(wanted), _names(one for one in wanted if one.runs)
    proved = []
    for done, one in enumerate(wanted):
        on_progress(done, len(wanted) + 1)
        proved.append(_proved(bake, one, everything))
    # An edge of a shadow that moves changes single samples entirely, so what turns the sun is told by its angle alone.
    turning = [one for one in wanted if one.unit == "degrees of sun" and not one.runs]
    different = np.abs(_picture(bake, everything - _names(turning)) - _picture(bake, planned))
    turned_deg = math.fsum(one.actual for one in proved if one.effect in _names(turning))
    on_progress(len(wanted) + 1, len(wanted) + 1)
    allowed, turn = scene.tolerance.codes, scene.tolerance.sun_deg
    over = int((different > allowed + ROUNDING_CODES).sum())
    return EffectProof(
        plan=plan,
        x0=window.x0,
        y0=window.y0,
        width=window.width,
        height=window.height,
        effects=proved,
        difference_codes=float(different.max()),
        allowed_codes=allowed,
        samples_over=over,
        turned_deg=turned_deg,
        allowed_deg=turn,
        holds=all(one.holds for one in proved) and not over and turned_deg <= turn + ROUNDING_DEG,
    )


def roughest_window(found: HeightStatistics, side: int) -> Rect:
    """Return a window of up to ``side`` x ``side`` samples around the steepest tile: there a bound is the most likely to fail."""
    row, column = np.unravel_index(int(np.argmax(found.tiles.steepest)), found.tiles.steepest.shape)
    width, height = min(side, found.width), min(side, found.height)
    middle = (int(column) * found.tiles.side + found.tiles.side // 2, int(row) * found.tiles.side + found.tiles.side // 2)
    x0 = min(max(middle[0] - width // 2, 0), found.width - width)
    y0 = min(max(middle[1] - height // 2, 0), found.height - height)
    return Rect(x0, y0, x0 + width, y0 + height)


def _names(effects: Iterable[PlannedEffect]) -> Effects:
    return frozenset(one.effect for one in effects)


def _proved(bake: LightBake, one: PlannedEffect, everything: Effects) -> ProvedEffect:
    if one.unit == "codes":
        # Reflected light is proved by itself; what is left out of other light, times its reflections, is what the plan allows for.
        base = everything if one.effect == "bounce" else everything - {"bounce"}
        actual, margin = float(np.abs(bake.codes(base) - bake.codes(base - {one.effect})).max()), ROUNDING_CODES
    else:
        actual, margin = _turn_deg(bake, one.effect, everything), ROUNDING_DEG
    return ProvedEffect(
        effect=one.effect,
        verdict=one.verdict,
        unit=one.unit,
        bound=one.bound,
        actual=actual,
        holds=one.bound is None or actual <= one.bound + margin,
    )


def _turn_deg(bake: LightBake, effect: EffectName, everything: Effects) -> float:
    """Return by how much an effect turns the sun, or lowers a horizon that is as high as the sun, at most [degrees]."""
    if effect in ("refraction_sun", "sun_direction"):
        # One turn at a time: of a sun that is lifted already, a degree more is another tangent.
        one = everything & {effect}
        return float(np.abs(bake.elevations_deg(one) - bake.elevations_deg(one - {effect})).max())
    without = everything - {effect}
    azimuth, elevation = bake.scene.sun.direction_deg
    higher, lower = (bake.horizon(azimuth, bake.earth(names, "curvature_shadow")) for names in (without, everything))
    if effect == "refraction_path":
        higher, lower = lower, higher
    first, second = (np.degrees(np.arctan(one.astype(np.float64))) for one in (higher, lower))
    matters = first > elevation
    return float((first - second)[matters].max()) if matters.any() else 0.0


def _picture(bake: LightBake, effects: Effects) -> Float64:
    """Return the codes of a picture, in the transfer that the tolerance is of."""
    codes = bake.codes(effects)
    if bake.scene.tolerance.transfer == "linear":
        return codes
    return np.asarray(encode_srgb((codes / FULL_SCALE).astype(np.float32), 255), np.float64)
