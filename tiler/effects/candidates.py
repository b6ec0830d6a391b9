"""Every effect with its bound on one map: what a plan chooses from.

All bounds hold whatever is done about the other effects, so what is left out together changes no more than their sum.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas import viewbounds
from schemas.effects import EffectName, Unit
from schemas.scene import Scene
from tiler.effects import bounds
from tiler.effects.statistics import HeightStatistics
from tiler.effects.tiles import lit_tiles, surroundings

Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PyramidFacts:
    """What is known beyond level 0; None or empty: not measured, so nothing is proved by it."""

    differences_m: tuple[float, ...] = ()
    """Largest absolute difference between level l and level l + 1 drawn as triangles, for l = 0, 1, ... [m]."""
    gradient_difference: float | None = None
    """Largest difference of slopes, as vectors, between level 0 and level 1 drawn as triangles."""
    local_range: float | None = None
    """At least the largest range of sRGB values (0 to 1) of imagery under the taps of its filter."""
    filter_norm: float = 1.52
    """Sum of absolute weights of that filter over both axes."""
    detail_sigma_m: float | None = None
    """Standard deviation of level 0 about level 1 drawn as triangles, from which synthetic detail starts [m]."""
    hurst: float = 0.8
    """By which that falls from level to level, as 2**-hurst: the Hurst exponent of the roughness, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One effect and the most it changes."""

    effect: EffectName
    unit: Unit
    bound: float | None
    """In ``unit``; None if it was not measured."""
    statistic: str
    formula: str
    anchor: str
    codes: float = 0.0
    """What leaving it out takes of the tolerance of light [codes]."""
    sun_deg: float = 0.0
    """What leaving it out takes of the tolerance of the sun's direction [degrees]."""
    tiles: Float64 | None = None
    """The bound of every tile; None if it is the same everywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class MapBounds:
    """Candidates of a map, and what else follows from the same numbers."""

    bake: dict[EffectName, Candidate]
    view: dict[EffectName, Candidate]
    is_lit: bool
    """Whether all of the sun lights all of the map."""
    ground_seen: float
    """Largest part of what a sample sees that can be ground."""
    reach_m: float
    """Distance beyond which nothing shades anything [m]."""
    sky_reach_m: float
    """Distance beyond which ground is far [m]."""


_ANCHORS: Final[dict[EffectName, str]] = {
    "shadow": "cast-shadow",
    "penumbra": "penumbra",
    "sky": "sky-occlusion",
    "bounce": "one-bounce",
    "curvature_shadow": "curvature-and-shadows",
    "curvature_sky": "curvature-and-sky",
    "refraction_sun": "refraction-of-the-sun",
    "refraction_path": "refraction-on-the-way",
    "sun_direction": "one-sun-for-the-whole-map",
    "far_occluders": "far-occluders",
    "normal_map": "normals-of-a-coarser-level",
    "linear_filter": "filtering-in-gamma-space",
    "haze": "haze",
    "geomorph": "levels-of-detail-and-geomorphs",
    "synthesis": "detail-synthesis",
    "curvature_view": "curvature-and-the-viewer",
}


def map_bounds(scene: Scene, found: HeightStatistics, facts: PyramidFacts, soft: bool, far_codes: float) -> MapBounds:
    """Return every effect with its bound for ``scene`` on the map that ``found`` describes.

    ``soft`` says whether the sun's disc gives shadows soft edges. Ground that takes up to ``far_codes`` of the sky's light is far.
    """
    bake = _BakeBounds(scene, found, soft)
    rows = (*bake.lit_by_the_sun(), *bake.lit_by_the_rest(), *bake.of_the_sun(), bake.far_away(far_codes))
    return MapBounds(
        {one.effect: one for one in rows},
        {one.effect: one for one in _view_bounds(scene, found, facts)},
        bake.is_lit,
        bake.ground_seen,
        0.0 if bake.is_lit else bake.reach_m,
        bake.sky_reach_m(far_codes),
    )


def _each(function: Callable[..., float], *arrays: Float64) -> Float64:
    """Return a function of numbers of every tile."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), np.float64)


class _BakeBounds:
    """Bounds of what a light layer holds."""

    def __init__(self, scene: Scene, found: HeightStatistics, soft: bool) -> None:
        self._scene, self._found, self._soft = scene, found, soft
        self._share = scene.sky.share
        self._elevation = scene.sun.direction_deg[1]
        disc = scene.sun.radius_deg
        # Somewhere on the map the sun stands lower than at its centre: every bound holds for that sun too.
        self._turn_deg = max(bounds.sun_direction_deg(found.diagonal_m, scene.ground.radius_m), found.sun_turn_deg)
        self._lowest = max(-90.0, self._elevation - self._turn_deg - (disc if soft else 0.0))
        self.reach_m = bounds.reach_m(found.relief_m, self._lowest, found.diagonal_m)
        around = surroundings(found)
        self._horizon, self._tilt = around.horizon_tan, around.tilt_tan

        self._point, self._disc = (lit_tiles(found, self._elevation, self._turn_deg + more) for more in (0.0, disc))
        self.is_lit = bool(self._disc.all())
        self._seen = _each(bounds.seen_ground, self._horizon, self._tilt)
        self.ground_seen = float(self._seen.max())

    def _candidate(self, effect: EffectName, tiles: Float64 | float, statistic: str, formula: str) -> Candidate:
        """Return an effect bounded in codes."""
        most = float(np.max(tiles))
        return Candidate(
            effect,
            "codes",
            most,
            statistic,
            formula,
            _ANCHORS[effect],
            codes=most,
            tiles=tiles if isinstance(tiles, np.ndarray) else None,
        )

    def lit_by_the_sun(self) -> list[Candidate]:
        """Cast shadows and their edges."""
        found, scale = self._found, bounds.code_scale(self._share)
        statistic = f"slope toward the sun <= {found.toward:.4g}, tan(elevation) {math.tan(math.radians(self._elevation)):.4g}"
        disc = 0.0 if not self._scene.sun.radius_deg else np.where(self._disc, 0.0, scale / 2)
        shadow, formula = np.where(self._point, 0.0, scale), "0 if n.s >= sin(turn) on every facet, else K"
        if self._soft:
            # Soft edges go with their shadow: where only the sun's centre is proved to be seen, up to half of the disc is hidden.
            shadow = np.maximum(shadow, disc)
            formula = "0 if n.s >= sin(disc + turn) on every facet, K / 2 if >= sin(turn), else K"
        return [
            self._candidate("shadow", shadow, statistic, formula),
            self._candidate("penumbra", disc, f"n.s >= {found.facing:.4g}", "0 if n.s >= sin(disc + turn) on every facet, else K / 2"),
        ]

    def lit_by_the_rest(self) -> list[Candidate]:
        """Sky and reflected light, and what changes them."""
        found, scene, share = self._found, self._scene, self._share
        radius = scene.ground.radius_m / (1 - scene.air.refraction)
        tilt, azimuths = found.steepest, scene.sky.azimuths
        slopes = f"slope to any horizon <= {float(self._horizon.max()):.4g}, of ground <= {tilt:.4g}"
        brightest = 1 / (1 - scene.ground.albedo * min(1.0, self.ground_seen))
        return [
            self._candidate(
                "sky",
                _each(lambda horizon, steep: bounds.sky_codes(horizon, steep, share), self._horizon, self._tilt),
                slopes,
                "K share max(sin^2 h, (1 + cos b) / 2 - cos b cos^2 h)",
            ),
            self._candidate(
                "bounce",
                _each(lambda h, b: bounds.bounce_codes(h, b, scene.ground.albedo, brightest), self._horizon, self._tilt),
                slopes,
                "255 albedo F / (1 - albedo F), F <= 1 - cos b cos^2 h",
            ),
            self._candidate(
                "curvature_sky",
                bounds.curvature_sky_codes(found.relief_m, found.diagonal_m, tilt, azimuths, share, radius),
                f"relief {found.relief_m:.4g} m, slope <= {tilt:.4g}",
                "K share (z / R + 2 sin b min(sqrt(z / 2 R), d / 2 R) / (n sin(pi / n)))",
            ),
        ]

    def of_the_sun(self) -> list[Candidate]:
        """What moves the sun, or what shades it, up or down."""
        found, scene = self._found, self._scene
        globe, bend = scene.ground.radius_m, scene.air.refraction
        relief = f"relief {found.relief_m:.4g} m, seen up to {self.reach_m:.4g} m"
        lowered = bounds.lowering_deg(found.relief_m, found.diagonal_m, self._lowest, globe / (1 - bend))
        bent = bounds.lowering_deg(found.relief_m, found.diagonal_m, self._lowest, globe) * bend
        lift = bounds.refraction_deg(self._elevation - self._turn_deg)
        rows = [
            self._moved("curvature_shadow", lowered, 0.0, relief, "reach cos^2(lowest) / 2 R"),
            self._moved("refraction_path", bent, 0.0, relief, "k reach cos^2(lowest) / 2 R"),
            self._moved("refraction_sun", lift, lift, f"elevation {self._elevation:.4g} degrees", "r(elevation)"),
        ]
        # A sun whose azimuth turns throws its shadows elsewhere, so a soft edge does not help.
        turned = bounds.turned_sun_codes(self._turn_deg, self._share)
        on_grid = f", on the grid {found.sun_turn_deg:.3g} degrees" if found.sun_turn_deg else ""
        statistic, formula = f"diagonal {found.diagonal_m:.4g} m{on_grid}", "diagonal / 2 R, or more on the grid"
        if self.is_lit:
            return [*rows, self._candidate("sun_direction", turned, statistic, f"K {formula}")]
        return [*rows, self._angle("sun_direction", self._turn_deg, turned, statistic, formula)]

    def sky_reach_m(self, far_codes: float) -> float:
        """Return the distance [m] from which ground takes at most ``far_codes`` of the sky's light, up to the map's diagonal."""
        near, far = 0.0, self._found.diagonal_m
        if self._far_codes(far) > far_codes:
            return far
        while far - near > 1e-3 * far:
            middle = (near + far) / 2
            near, far = (near, middle) if self._far_codes(middle) <= far_codes else (middle, far)
        return far

    def _far_codes(self, distance_m: float) -> float:
        sky = self._scene.sky
        return bounds.far_sky_codes(self._found.relief_m, distance_m, self._found.steepest, sky.azimuths, sky.share)

    def far_away(self, far_codes: float) -> Candidate:
        """Ground too far away to hide much of the sky."""
        distance = self.sky_reach_m(far_codes)
        statistic = f"relief {self._found.relief_m:.4g} m, beyond {distance:.4g} m"
        formula = "K share (sin^2 h + 2 h sin b / (n sin(pi / n))), h = atan(relief / distance)"
        far = self._candidate("far_occluders", self._far_codes(distance), statistic, formula)
        # Where all of the map is near, nothing can be left out.
        return far if far.codes <= far_codes else replace(far, codes=math.inf)

    def _moved(self, effect: EffectName, shift_deg: float, turn_deg: float, statistic: str, formula: str) -> Candidate:
        """Return an effect that lowers horizons or lifts the sun by ``shift_deg``, and turns it by ``turn_deg`` for all ground."""
        turned = bounds.turned_sun_codes(turn_deg, self._share)
        if self.is_lit:
            return self._candidate(effect, turned, statistic, f"K {formula}" if turn_deg else "0 where nothing is shaded")
        if self._soft:
            edge = bounds.disc_codes(shift_deg, self._scene.sun.radius_deg, self._share)
            return self._candidate(effect, edge + turned, statistic, f"2 K / pi {formula} / disc" + (" + K r" if turn_deg else ""))
        return self._angle(effect, shift_deg, turned, statistic, formula)

    def _angle(self, effect: EffectName, angle_deg: float, codes: float, statistic: str, formula: str) -> Candidate:
        """Return an effect bounded as an error of the sun's direction."""
        return Candidate(effect, "degrees of sun", angle_deg, statistic, formula, _ANCHORS[effect], codes=codes, sun_deg=angle_deg)


def _view_bounds(scene: Scene, found: HeightStatistics, facts: PyramidFacts) -> list[Candidate]:
    """Return the effects of the viewer, of filters and of normals."""
    viewer = scene.viewer
    focal = viewbounds.focal_px(viewer.width_px, viewer.fov_deg)
    stretch = viewbounds.corner_stretch(viewer.width_px, viewer.height_px, viewer.fov_deg)

    def view(effect: EffectName, unit: Unit, bound: float | None, statistic: str, formula: str) -> Candidate:
        measured = bound if bound is not None and bound < math.inf else None
        return Candidate(effect, unit, measured, statistic, formula, _ANCHORS[effect])

    jump = viewbounds.geomorph_px(facts.differences_m, min(found.cell_m), viewer.grid, focal, stretch) if facts.differences_m else None
    largest = max(facts.differences_m, default=0.0)
    detail, sigma, rough = None, facts.detail_sigma_m, "the roughness of the finest level is not known"
    if sigma is not None:
        amplitude = viewbounds.synthesis_amplitude_m(sigma, facts.hurst, viewer.detail_octaves, viewer.largest_deviate)
        detail = viewbounds.shift_px(amplitude, viewer.clearance_m, focal, stretch)
        reaches = ", which it reaches" if detail == math.inf else ""
        rough = f"sigma {sigma:.4g} m, H {facts.hurst:.2f}, {viewer.clearance_m:.4g} m away{reaches}"
    slopes, contrast = facts.gradient_difference, facts.local_range
    return [
        view(
            "haze",
            "codes",
            viewbounds.haze_codes(math.hypot(found.diagonal_m, found.relief_m + viewer.clearance_m), scene.air.visibility_m),
            f"diagonal {found.diagonal_m:.4g} m",
            "255 (1 - exp(-3.912 d / visibility))",
        ),
        view(
            "geomorph",
            "pixels",
            jump,
            f"levels differ by <= {largest:.4g} m" if facts.differences_m else "levels were not compared",
            "f (1 + tan^2 corner) asin(difference / distance)",
        ),
        view(
            "synthesis",
            "pixels",
            detail,
            rough,
            "f (1 + tan^2 corner) asin(amplitude / distance)",
        ),
        view(
            "curvature_view",
            "pixels",
            viewbounds.curvature_px(found.diagonal_m, found.relief_m, scene.ground.radius_m, focal, stretch),
            f"diagonal {found.diagonal_m:.4g} m, relief {found.relief_m:.4g} m",
            "f (1 + tan^2 corner) asin((d^2 / 2 R + z d / R) / d)",
        ),
        view(
            "normal_map",
            "codes",
            None if slopes is None else bounds.normal_map_codes(slopes, scene.sky.share),
            "levels were not compared" if slopes is None else f"slopes of levels 0 and 1 differ by <= {slopes:.4g}",
            "K (1 + share / 2) difference of slopes",
        ),
        view(
            "linear_filter",
            "codes",
            None if contrast is None else bounds.gamma_filter_codes(contrast, facts.filter_norm),
            "the contrast of imagery is not known" if contrast is None else f"range under a filter <= {contrast:.4g} of 1",
            "255 L (3.0188 / 2 r^2 + 0.0014 r), r = range (1 + L) / 2",
        ),
    ]
