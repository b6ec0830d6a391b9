"""Which effects a picture calls for: those whose bound says that somebody could see them.

The bounds are those of plans (``schemas.viewbounds``, docs/EFFECTS.md): what an effect can change at most in this picture, whatever the
terrain is like. An effect within what nobody notices is not drawn; the reason is told with the numbers of a picture.
"""

from dataclasses import dataclass
from typing import Final, Literal

from schemas import viewbounds
from schemas.scene import EARTH_RADIUS_M, Tolerance
from viewer.options import Choice, ViewOptions

Name = Literal["haze", "curvature", "geomorph"]

FLAT_M: Final = 600_000.0
"""Farthest distance [m] at which a globe is drawn as a parabola: there it is 21 m too low. Larger maps stay flat."""


@dataclass(frozen=True, slots=True)
class View:
    """What bounds need to know of a picture: lengths in metres, ``focal_px`` and ``size`` in pixels."""

    size: tuple[int, int]
    focal_px: float
    farthest_m: float
    """At least the horizontal distance from the camera to any ground."""
    depth_m: float
    """At least the distance from the camera to any ground."""
    relief_m: float
    """At least the difference of any two heights, exaggerated."""
    spacing_m: float
    """Distance of samples of level 0."""
    levels: int
    on_earth: bool
    """Whether the dataset says where on the Earth it lies."""


@dataclass(frozen=True, slots=True)
class ViewEffect:
    """One effect: whether it is drawn, the most it changes, and why."""

    name: Name
    runs: bool
    bound: float
    """Codes of sRGB for haze, else pixels; infinite if there is no limit."""
    unit: Literal["codes", "px"]
    why: str

    @property
    def text(self) -> str:
        """The effect in words."""
        return f"{'drawn' if self.runs else 'left out'}: {self.why}"


@dataclass(frozen=True, slots=True)
class ViewEffects:
    """All effects of a picture, and what the shaders need of them."""

    haze: ViewEffect
    curvature: ViewEffect
    geomorph: ViewEffect
    extinction_per_m: float
    """Of haze; 0 for none."""
    sag_per_m: float
    """Ground at distance d sinks by this times d squared; 0 for a flat map."""

    @property
    def all(self) -> tuple[ViewEffect, ...]:
        """Every one."""
        return self.haze, self.curvature, self.geomorph


def decide_effects(view: View, options: ViewOptions) -> ViewEffects:
    """Return which effects ``view`` calls for."""
    haze, curvature = _haze(view, options.haze_m), _curvature(view, options.curvature)
    return ViewEffects(
        haze,
        curvature,
        _geomorph(view, options.grid),
        1 / options.haze_m if haze.runs and options.haze_m is not None else 0.0,
        0.5 / EARTH_RADIUS_M if curvature.runs else 0.0,
    )


def _haze(view: View, haze_m: float | None) -> ViewEffect:
    if haze_m is None:
        return ViewEffect("haze", False, 0.0, "codes", "not asked for")
    # What hides 63 % at this distance hides 98 % at the visibility. Haze is mixed as light, and seen as sRGB codes.
    bound = viewbounds.srgb_codes(viewbounds.haze_codes(view.depth_m, viewbounds.KOSCHMIEDER * haze_m))
    noticed = Tolerance().codes
    return ViewEffect("haze", bound > noticed, bound, "codes", f"it changes up to {bound:.4g} codes, {noticed:g} is noticed")


def _curvature(view: View, choice: Choice) -> ViewEffect:
    stretch = viewbounds.picture_stretch(*view.size, view.focal_px)
    bound = viewbounds.curvature_px(view.farthest_m, view.relief_m, EARTH_RADIUS_M, view.focal_px, stretch)
    moved, noticed = f"it moves ground by up to {bound:.4g} px", Tolerance().pixels
    runs, why = bound > noticed, f"{moved}, {noticed:g} is noticed"
    if choice != "auto":
        runs, why = choice == "on", f"--curvature {choice}; {moved}"
    elif runs and not view.on_earth:
        runs, why = False, "the dataset does not say that it lies on the Earth"
    elif runs and view.farthest_m > FLAT_M:
        runs, why = False, f"ground is up to {view.farthest_m / 1000:.4g} km away, too far for a map that is drawn flat"
    return ViewEffect("curvature", runs, bound, "px", why)


def _geomorph(view: View, grid: int) -> ViewEffect:
    stretch = viewbounds.picture_stretch(*view.size, view.focal_px)
    # Two levels differ by no more than the relief; how far they do differ is known to nobody who has not read them all.
    bound = viewbounds.geomorph_px([view.relief_m] * (view.levels - 1), view.spacing_m, grid, view.focal_px, stretch)
    if view.levels == 1:
        return ViewEffect("geomorph", False, 0.0, "px", "there is one level only")
    # It stays even where nothing jumps: it makes levels meet without cracks, and blends their normals.
    jumps = f"vertices would jump by up to {bound:.4g} px" if bound < float("inf") else "vertices could jump by any length"
    return ViewEffect("geomorph", True, bound, "px", f"it joins levels without cracks; without it {jumps}")
