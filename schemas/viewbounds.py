"""How much an effect of the viewer can be seen at most: plain arithmetic on numbers, for the viewer itself and for plans.

Each is an upper bound for every terrain, picture and camera that fits its arguments; docs/EFFECTS.md has the proofs, under the same names.
"""

import math
from collections.abc import Sequence
from typing import Final

MORPH_SLACK: Final = 1e-3
"""Part of the morph's width by which a level is all coarse before its rim, so that it is in float32 too."""

KOSCHMIEDER: Final = 3.912
"""-ln 0.02: at the visibility a black object's contrast against the haze is 2 % (Koschmieder 1924; WMO No. 8, I.9)."""

SRGB_TOE: Final = 12.92
"""Slope of the sRGB encoding at black (IEC 61966-2-1), its largest."""

FOUR_POINT_NORM: Final = 1.2512
"""What up to 16 steps of the 4-point scheme (-1, 9, 9, -1) / 16 enlarge absolute values by at most, along one axis: the largest sum of
absolute weights, 1.25 after one step and 1.25112 after sixteen."""


def srgb_codes(linear_codes: float) -> float:
    """Return what a difference of light [codes] becomes at most in sRGB codes: that of the same light next to black.

    The encoding g is concave and g(0) = 0, so g(a) - g(b) <= g(a - b).
    """
    light = linear_codes / 255.0
    return 255.0 * (SRGB_TOE * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055)


def linear_codes(srgb: float) -> float:
    """Return the difference of light [codes] that can be at most ``srgb`` codes after encoding; inverse of ``srgb_codes``."""
    code = srgb / 255.0
    return 255.0 * (code / SRGB_TOE if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4)


def focal_px(width_px: float, fov_deg: float) -> float:
    """Return the distance of the image plane [pixels] of a camera of ``width_px`` pixels and a horizontal field of ``fov_deg`` degrees."""
    return width_px / 2 / math.tan(math.radians(fov_deg) / 2)


def corner_stretch(width_px: float, height_px: float, fov_deg: float) -> float:
    """Return ``1 + tan**2`` of the angle between the view's axis and a corner of the picture, at least 1.

    A plane picture shows a small angle there so much longer than in its middle: 1.44 times at 60 degrees and 16:9.
    """
    return picture_stretch(width_px, height_px, focal_px(width_px, fov_deg))


def picture_stretch(width_px: float, height_px: float, focal: float) -> float:
    """Return what ``corner_stretch`` does, given the distance of the image plane [pixels]."""
    return 1 + (math.hypot(width_px, height_px) / 2 / focal) ** 2


def shift_px(error_m: float, distance_m: float, focal: float, stretch: float = 1.0) -> float:
    """Return how far a point moves on the screen at most [pixels] if it is displaced by up to ``error_m`` metres in any direction.

    ``distance_m`` is the camera's distance to the point [m], ``focal`` what ``focal_px`` returns, ``stretch`` what ``corner_stretch`` does.
    Seen from the camera the displacement takes an angle of at most asin(error / distance); a picture stretches angles by at most
    ``stretch``. Infinite if the displacement can reach the camera.
    """
    if error_m <= 0:
        return 0.0
    return math.inf if error_m >= distance_m else focal * stretch * math.asin(error_m / distance_m)


def haze_codes(distance_m: float, visibility_m: float) -> float:
    """Return what haze changes at most over ``distance_m`` metres [codes of 255], ``255 (1 - exp(-3.912 d / visibility))``."""
    return -255.0 * math.expm1(-KOSCHMIEDER * distance_m / visibility_m)


def haze_distance_m(codes: float, visibility_m: float) -> float:
    """Return the distance up to which haze changes at most ``codes``, below 255 [m]: 0.001 of the visibility for one code."""
    return -math.log1p(-codes / 255.0) * visibility_m / KOSCHMIEDER


def first_distance_m(grid: int, spacing_m: float) -> float:
    """Return the least horizontal distance [m] at which a level of ``spacing_m`` metres is drawn unblended, inside of it a finer one.

    The finer level, of ``grid`` vertices ``spacing_m / 2`` apart, is centred on the viewer up to one sample, and all coarse ``MORPH_SLACK``
    of the morph's width (a tenth of the grid) before its rim. Where it is blended by alpha, the part alpha of the error is seen from a
    distance d, and alpha / d grows up to there.
    """
    return ((grid - 1) / 2 - 1 - MORPH_SLACK * grid / 10) * spacing_m / 2


def geomorph_px(differences_m: Sequence[float], spacing_m: float, grid: int, focal: float, stretch: float = 1.0) -> float:
    """Return how far a vertex jumps at most [pixels] when it changes its level and levels are not blended.

    ``differences_m[l]`` is the largest absolute difference between level l and level l + 1 drawn as triangles [m], ``spacing_m`` the
    distance of samples of level 0 [m].
    """
    jumps = (
        shift_px(difference, first_distance_m(grid, spacing_m * 2 ** (level + 1)), focal, stretch)
        for level, difference in enumerate(differences_m)
    )
    return max(jumps, default=0.0)


def level_of_detail_px(differences_m: Sequence[float], spacing_m: float, grid: int, focal: float, stretch: float = 1.0) -> float:
    """Return how far a point on any level lies from where level 0 has it, at most [pixels]; arguments as for ``geomorph_px``.

    Drawing a level as triangles does not enlarge differences, so those of consecutive levels add up.
    """
    largest, total = 0.0, 0.0
    for level, difference in enumerate(differences_m):
        total += difference
        largest = max(largest, shift_px(total, first_distance_m(grid, spacing_m * 2 ** (level + 1)), focal, stretch))
    return largest


def synthesis_amplitude_m(sigma_m: float, hurst: float, octaves: int, largest_deviate: float) -> float:
    """Return the largest absolute height [m] that ``octaves`` octaves of synthetic detail add.

    Octave k = 1, 2, ... adds a table entry of at most ``largest_deviate`` times ``sigma_m 2**(-hurst k)``. All but the last are then
    refined by the 4-point scheme along both axes, which enlarges them up to the square of ``FOUR_POINT_NORM``.
    """
    steps = (2 ** (-hurst * octave) * (FOUR_POINT_NORM**2 if octave < octaves else 1.0) for octave in range(1, octaves + 1))
    return largest_deviate * sigma_m * sum(steps)


def curvature_shift_m(distance_m: float, height_m: float, radius_m: float) -> float:
    """Return how far a point lies at most [m] from its place on a flat map, ``distance_m`` metres along the ground from the map's centre.

    On a globe of ``radius_m`` metres the ground sinks by R (1 - cos(s / R)) <= s**2 / 2 R and draws nearer by s - R sin(s / R) <=
    s**3 / 6 R**2; a point ``height_m`` metres above or below it tilts by s / R.
    """
    sag = distance_m**2 / (2 * radius_m)
    return sag * math.hypot(1, distance_m / (3 * radius_m)) + abs(height_m) * distance_m / radius_m


def curvature_px(distance_m: float, height_m: float, radius_m: float, focal: float, stretch: float = 1.0) -> float:
    """Return how far curvature moves a point on the screen at most [pixels], up to ``distance_m`` metres of ground from the camera."""
    return shift_px(curvature_shift_m(distance_m, height_m, radius_m), distance_m, focal, stretch)
