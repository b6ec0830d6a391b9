"""Light that the ground throws back once: every ray of it gathered in float64, and the approximations that are quicker. Compiled.

A sample gets, from the part of its hemisphere that is ground, the light of that ground, weighed by the cosine of incidence. Toward one
azimuth the ground that is seen are the samples that rise above all before them, and each fills the angles from the highest before it to
itself. How much light passes above an angle is what Dozier and Frew integrate for the sky (1990, eq. 7, as in ``tiler.light.shading``),
so a sample's part is the difference of two such integrals: with ground as bright everywhere as the sky, both together are exactly 1.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tiler.accuracy.lightground import Ground, Margins, inner
from tiler.accuracy.lightwalk import left_out_of_frame, met
from tiler.compiled import compiled
from tiler.light.frame import SunPosition, frame_of, sine_cosine_deg, tangent_deg
from tiler.light.sweeping import LIT, Codes

Array = NDArray[np.float64]


@compiled
def _above(tangent: float, own: float) -> float:
    """Return what reaches a sample from above an angle toward one azimuth; ``own`` is the rise of its own plane, and below ``tangent``."""
    square = 1.0 / (1.0 + tangent * tangent)
    return square - own * (0.5 * math.pi - math.atan(tangent) - tangent * square)


@compiled
def _gather(
    rows: Array, lit: Array, own: Array, shift: float, step: float, top: float, beyond: float, margins: Margins, gathered: Array
) -> None:
    """Set ``gathered`` to what one azimuth brings to the samples within the margins; heights and light lie in the frame of a walk."""
    for i in range(gathered.shape[0]):
        for j in range(gathered.shape[1]):
            row, column = i + margins[0], j + margins[1]
            height, plane = rows[row, column], own[i, j]
            highest, passing, total = plane, _above(plane, plane), 0.0
            for k in range(1, row + 1):
                there = met(rows, row - k, column + shift * k, False)
                if math.isnan(there) or (highest > 0 and top - height < highest * k * step):
                    break
                tangent = (there - height) / (k * step)
                if tangent > highest:
                    left = _above(tangent, plane)
                    total += (passing - left) * met(lit, row - k, column + shift * k, False)
                    highest, passing = tangent, left
            if highest < 0:
                total += (passing - _above(0.0, plane)) * beyond
            gathered[i, j] = total


def gathered_light(ground: Ground, light: Array, margins: Margins, count: int) -> Array:
    """Return the light (h, w) that comes from ground to each sample within the margins, from ``count`` azimuths; 1 if all were ground of 1.

    ``light`` (all of the ground) is what each sample throws back into any direction. Below the horizontal, where nothing is met up to the
    edge, is ground too: as bright as all of it on the average.
    """
    east, north = (inner(slope, margins).astype(np.float64) for slope in ground.slopes())
    top, beyond = float(ground.heights_m.max()) + 1e-6, float(light.mean())
    shape = ground.heights_m.shape[0], ground.heights_m.shape[1]
    total = np.zeros(east.shape)
    for n in range(count):
        azimuth = 360 * (n + 0.5) / count
        sine, cosine = sine_cosine_deg(azimuth)
        frame = frame_of(shape, ground.cell_m, azimuth)
        rows, lit, own = (
            np.ascontiguousarray(np.rot90(grid, frame.turns), np.float64)
            for grid in (ground.heights_m, light, east * sine + north * cosine)
        )
        found = np.empty(own.shape)
        _gather(rows, lit, own, frame.shift, frame.step_m, top, beyond, left_out_of_frame(frame.turns, margins), found)
        total += np.rot90(found, -frame.turns)
    share: Array = total / (count * np.sqrt(1 + east * east + north * north))
    return share


def direct_light(ground: Ground, sun: SunPosition, codes: Codes, sky: NDArray[np.floating], share: float) -> Array:
    """Return the light (h, w) of sun and sky, relative to the sun's: ``codes`` say where it is seen, ``sky`` how much of that."""
    east, north = ground.slopes()
    sine, cosine = sine_cosine_deg(sun.azimuth_deg)
    slope = tangent_deg(sun.elevation_deg)
    facing = (slope - (east * sine + north * cosine)) / (np.sqrt(1 + east * east + north * north) * math.hypot(1, slope))
    lit: Array = np.maximum(facing, 0) * (codes == LIT) + share * sky
    return lit


def local_mean(light: Array, radius: int) -> Array:
    """Return the mean (h, w) of the samples that are at most ``radius`` rows and columns away and within the grid."""
    for axis in (0, 1):
        size = light.shape[axis]
        sums = np.insert(np.cumsum(light, axis=axis), 0, 0, axis=axis)
        before = np.maximum(np.arange(size) - radius, 0)
        after = np.minimum(np.arange(size) + radius + 1, size)
        counts = np.expand_dims((after - before).astype(np.float64), 1 - axis)
        light = (np.take(sums, after, axis=axis) - np.take(sums, before, axis=axis)) / counts
    return light
