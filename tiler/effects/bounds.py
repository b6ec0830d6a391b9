"""How much each effect of light can change a sample at most: one pure function per effect, of numbers.

Light of a sample is ``K (V_sun max(0, n.s) + share V_sky + albedo F B)`` codes with ``K = 255 / (1 + share)``: n the unit normal, s the
direction of the sun, V_sun the visible part of its disc, V_sky the visible part of the open sky weighed by n (1 on level open ground),
F the part of that weight that falls on ground, B that ground's brightness (at most 1 + share). Angles are in degrees where a name says so,
``..._tan`` are slopes, heights and distances in metres. docs/EFFECTS.md has the proofs, one heading per effect.
"""

import math
from typing import Final

FULL_SCALE: Final = 255.0


def code_scale(sky_share: float) -> float:
    """Return K, the codes of the sun on a surface that faces it: the most that one sample's direct light can be."""
    return FULL_SCALE / (1 + sky_share)


def least_facing(margin_deg: float) -> float:
    """Return the n.s from which a facet faces every point within ``margin_deg`` of the sun.

    If a ray toward such a point met a surface on its way, the surface would rise faster than the ray somewhere before, and a facet
    there would face away from the point (mean-value theorem). So ground whose facets all face the points is lit by all of them.
    """
    return math.sin(math.radians(margin_deg))


def lowest_ray_tan(elevation_deg: float, margin_deg: float) -> float:
    """Return the slope of the lowest ray within ``margin_deg`` of the sun; what is seen no steeper hides none of them.

    NaN, which nothing is below, if it comes from below the horizontal: the globe itself may hide that.
    """
    lowest = elevation_deg - margin_deg
    return math.tan(math.radians(lowest)) if lowest >= 0 else math.nan


def shadow_codes(is_lit: bool, sky_share: float) -> float:
    """Return what cast shadows change at most [codes]: 0 where all is lit, else K."""
    return 0.0 if is_lit else code_scale(sky_share)


def penumbra_codes(is_lit: bool, sky_share: float) -> float:
    """Return what a disc changes against a point at most [codes]: 0 where all of it is seen, else K / 2.

    The horizon in the sun's azimuth cuts the disc; a point counts as seen if at least half of the disc is.
    """
    return 0.0 if is_lit else code_scale(sky_share) / 2


def hidden_sky(horizon_tan: float, tilt_tan: float) -> float:
    """Return the largest part of the open sky's light that can be hidden, 0 to 1.

    ``horizon_tan`` is at least the slope to every horizon and at least ``tilt_tan``, that at least the slope of the ground. All above
    the horizon h is seen and gives cos b cos^2 h on ground of slope b, of (1 + cos b) / 2: their difference is linear in cos b, so
    largest on level ground or on the steepest.
    """
    seen = 1 / (1 + horizon_tan * horizon_tan)
    cosine = 1 / math.sqrt(1 + tilt_tan * tilt_tan)
    return max(1 - seen, (1 + cosine) / 2 - cosine * seen)


def sky_codes(horizon_tan: float, tilt_tan: float, sky_share: float) -> float:
    """Return what hidden sky takes at most [codes]; arguments as for ``hidden_sky``."""
    return code_scale(sky_share) * sky_share * hidden_sky(horizon_tan, tilt_tan)


def seen_ground(horizon_tan: float, tilt_tan: float) -> float:
    """Return the largest part F of what a sample sees, weighed by its normal, that can be ground; arguments as for ``hidden_sky``."""
    cosine = 1 / math.sqrt(1 + tilt_tan * tilt_tan)
    return 1 - cosine / (1 + horizon_tan * horizon_tan)


def bounce_codes(horizon_tan: float, tilt_tan: float, albedo: float, brightest: float = 1.0) -> float:
    """Return what light reflected by other ground adds at most [codes].

    Ground is lit by at most 1 + share, and K (1 + share) is 255. ``brightest`` is the most it is lit by, relative to that: 1 for one
    reflection, 1 / (1 - albedo F) for any number, F the largest there is on the map.
    """
    return min(1.0, seen_ground(horizon_tan, tilt_tan)) * albedo * FULL_SCALE * brightest


def reach_m(relief_m: float, lowest_deg: float, diagonal_m: float) -> float:
    """Return the largest distance [m] from which ground can shade ground, of a sun at ``lowest_deg`` or higher."""
    slope = math.tan(math.radians(min(lowest_deg, 89.999999)))
    return diagonal_m if slope <= 0 else min(diagonal_m, relief_m / slope)


def lowering_deg(relief_m: float, diagonal_m: float, lowest_deg: float, radius_m: float) -> float:
    """Return by how much a horizon at ``lowest_deg`` or higher sinks at most if the ground curves with ``radius_m`` [degrees].

    At distance d it sinks by d^2 / 2 R metres, so its slope by d / 2 R, and its angle by at most cos^2 as much. d is at most the reach.
    With the effect, the shadow lies between those without it of two suns, one lower by this than the other.
    """
    slope = reach_m(relief_m, lowest_deg, diagonal_m) / (2 * radius_m)
    share = math.cos(math.radians(lowest_deg)) ** 2 if lowest_deg > 0 else 1.0
    return math.degrees(slope * share)


def disc_codes(shift_deg: float, sun_radius_deg: float, sky_share: float) -> float:
    """Return what a change of the angle between a sun's disc and its horizon by ``shift_deg`` changes at most [codes].

    The visible part is 1/2 + (u sqrt(1 - u^2) + asin u) / pi with u the angle in disc radii: it changes by 2 / pi per unit at most.
    """
    if shift_deg <= 0:
        return 0.0
    return code_scale(sky_share) * (min(1.0, 2 / math.pi * shift_deg / sun_radius_deg) if sun_radius_deg > 0 else 1.0)


def lowered_sky(sine_square: float, angle_rad: float, tilt_tan: float, azimuths: int) -> float:
    """Return the part of the open sky's light gained at most if horizons sink by so much, on ground of slope up to ``tilt_tan``.

    ``sine_square`` bounds the change of sin^2, ``angle_rad`` that of the angle of every horizon above 0. Level ground weighs by the first,
    a slope b adds 2 sin b max(0, cos) times the second, whose mean over n even azimuths is at most 1 / (n sin(pi / n)).
    """
    cosine = 1 / math.sqrt(1 + tilt_tan * tilt_tan)
    tilted = 2 * math.sqrt(max(0.0, 1 - cosine * cosine)) * angle_rad / (azimuths * math.sin(math.pi / azimuths))
    return min(1.0, min(sine_square, 1.0) + tilted)


def curvature_sky_codes(relief_m: float, diagonal_m: float, tilt_tan: float, azimuths: int, sky_share: float, radius_m: float) -> float:
    """Return what curvature adds to the sky's light at most [codes].

    A horizon of slope t = z / d sinks by d / 2 R: sin^2 by at most z / R, wherever it is, and the angle by min(t, d / 2 R), which is at
    most sqrt(z / 2 R).
    """
    angle = min(math.sqrt(relief_m / (2 * radius_m)), diagonal_m / (2 * radius_m))
    return code_scale(sky_share) * sky_share * lowered_sky(relief_m / radius_m, angle, tilt_tan, azimuths)


def refraction_deg(elevation_deg: float) -> float:
    """Return by how much a sun at a true elevation is seen higher at most, near sea level [degrees] (Saemundsson 1986; Meeus, ch. 16).

    Below -1.9 degrees, where the formula turns round, it is what it is there: such a sun is not seen.
    """
    h = max(elevation_deg, -1.9006)
    return max(0.0, 1.02 / math.tan(math.radians(h + 10.3 / (h + 5.11)))) / 60


def turned_sun_codes(turn_deg: float, sky_share: float) -> float:
    """Return what a sun turned by ``turn_deg`` changes at most where nothing is shaded [codes]: n.s by 2 sin(turn / 2) <= turn."""
    return code_scale(sky_share) * min(2.0, math.radians(turn_deg))


def sun_direction_deg(diagonal_m: float, radius_m: float) -> float:
    """Return the largest angle between the verticals of the map's centre and of another place on it [degrees].

    The diagonal is taken on a map that keeps distances; WGS 84 is curved most along the meridian at the equator, where its radius is
    0.9944 of the mean.
    """
    return min(180.0, math.degrees(diagonal_m / 2 / (0.994 * radius_m)))


def far_sky_codes(relief_m: float, distance_m: float, tilt_tan: float, azimuths: int, sky_share: float) -> float:
    """Return what ground further than ``distance_m`` takes of the sky's light at most [codes]: horizons of atan(relief / distance)."""
    angle = math.atan2(relief_m, distance_m)
    return code_scale(sky_share) * sky_share * lowered_sky(math.sin(angle) ** 2, angle, tilt_tan, azimuths)


def normal_map_codes(gradient_difference: float, sky_share: float) -> float:
    """Return what normals of another level change at most [codes], whose slopes differ by ``gradient_difference`` at most, as vectors.

    The unit normal of a slope differs by no more than the slope; n.s changes by no more than n, and the open sky's (1 + n_z) / 2 by half.
    """
    return min(FULL_SCALE, code_scale(sky_share) * gradient_difference * (1 + sky_share / 2))


def gamma_filter_codes(local_range: float, norm: float) -> float:
    """Return what filtering sRGB codes instead of light changes at most [codes of light].

    ``local_range`` (0 to 1) is the largest range of encoded values under the filter's taps, ``norm`` the sum of their absolute weights over
    both axes. With f the decoding, f(y) differs from its tangent at the mean by at most f''/2 times the distance squared, plus what
    its slope jumps at 0.04045 (by 0.0014); distances are at most ``(1 + norm) / 2`` ranges.
    """
    reach = local_range * (1 + norm) / 2
    curved = 3.0188 / 2 * norm * reach * reach + 0.0014 * norm * reach
    if norm <= 1:
        # A mean of weights that are not negative: Popoviciu's quarter.
        curved = 3.0188 / 8 * local_range * local_range + 0.0014 / 4 * local_range
    return FULL_SCALE * min(1.0, curved)
