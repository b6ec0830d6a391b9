"""Light on small terrains by brute force, float64: horizons from samples along every ray, no sweep, no hull, no pyramid.

A surface between samples is bilinear or made of triangles with either diagonal. What is sampled of a ray is never more than the truth,
so a bound that is below it is wrong.
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["bilinear", "diagonal", "antidiagonal"]
KINDS: tuple[Kind, ...] = ("bilinear", "diagonal", "antidiagonal")


def surface(z: Array, x: Array, y: Array, kind: Kind) -> Array:
    """Return heights of ``z`` (h, w) at columns ``x`` and rows ``y``; NaN outside and where a sample with weight is void."""
    h, w = z.shape
    inside = (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left, top = np.minimum(x.astype(int), max(w - 2, 0)), np.minimum(y.astype(int), max(h - 2, 0))
    u, v = x - left, y - top
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    if kind == "bilinear":
        weights = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    elif kind == "diagonal":  # from (0, 0) to (1, 1)
        weights = (1 - np.maximum(u, v), np.maximum(u - v, 0), np.maximum(v - u, 0), np.minimum(u, v))
    else:
        weights = (np.maximum(1 - u - v, 0), np.minimum(u, 1 - v), np.minimum(1 - u, v), np.maximum(u + v - 1, 0))
    corners = (z[top, left], z[top, right], z[bottom, left], z[bottom, right])
    total = np.zeros_like(x)
    for weight, corner in zip(weights, corners, strict=True):
        total = total + np.where(weight > 0, weight * np.where(weight > 0, corner, 0.0), 0.0)
    return np.where(inside, total, np.nan)


def horizons(
    z: Array, cell: tuple[float, float], azimuth_deg: float, kind: Kind = "bilinear", radius_m: float = math.inf, per_row: int = 4
) -> Array:
    """Return the steepest slope (h, w) to ground in an azimuth, minus infinity if there is none; ``radius_m`` curves the ground.

    A ray is sampled ``per_row`` times between the grid lines it crosses along its major axis, and on them.
    """
    a = math.radians(azimuth_deg)
    dx, dy = math.sin(a) / cell[0], -math.cos(a) / cell[1]
    rows, columns = np.mgrid[0 : z.shape[0], 0 : z.shape[1]].astype(np.float64)
    step = 1 / max(abs(dx), abs(dy)) / per_row
    steepest = np.full(z.shape, -np.inf)
    for n in range(1, per_row * max(z.shape) + 1):
        t = n * step
        height = surface(z, columns + t * dx, rows + t * dy, kind)
        steepest = np.fmax(steepest, (height - z) / t - t / (2 * radius_m))
    return np.where(np.isnan(z), np.nan, steepest)


def slopes(z: Array, cell: tuple[float, float]) -> tuple[Array, Array]:
    """Return slopes along rows and along columns (h, w): central differences, one-sided at borders, 0 on an axis of one sample."""
    x = np.gradient(z, cell[0], axis=1) if z.shape[1] > 1 else np.zeros_like(z)
    y = np.gradient(z, cell[1], axis=0) if z.shape[0] > 1 else np.zeros_like(z)
    return x, y


def facing(z: Array, cell: tuple[float, float], azimuth_deg: float, elevation_deg: float) -> Array:
    """Return n.s (h, w)."""
    x, y = slopes(z, cell)
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    result: Array = (math.sin(e) - math.cos(e) * (x * math.sin(a) - y * math.cos(a))) / np.sqrt(1 + x * x + y * y)
    return result


def disc_part(horizon_tan: Array, elevation_deg: float, radius_deg: float) -> Array:
    """Return the visible part of the sun's disc above a level horizon; of a point, 1 if it is not below."""
    h = np.degrees(np.arctan(horizon_tan))
    if radius_deg == 0:
        return (h <= elevation_deg).astype(np.float64)
    u = np.clip((elevation_deg - h) / radius_deg, -1, 1)
    return 0.5 + (u * np.sqrt(1 - u * u) + np.arcsin(u)) / math.pi


def open_part(z: Array, cell: tuple[float, float], horizon: dict[float, Array], *, sky_only: bool) -> Array:
    """Return the part of the hemisphere above each sample, weighed by its normal, that lies above ``horizon`` by azimuth [degrees].

    ``sky_only`` leaves out what lies below the horizontal.
    """
    x, y = slopes(z, cell)
    cosine = 1 / np.sqrt(1 + x * x + y * y)
    total = np.zeros_like(z)
    for azimuth, found in horizon.items():
        a = math.radians(azimuth)
        rise = x * math.sin(a) - y * math.cos(a)
        edge = np.arctan(np.fmax(found, rise))
        if sky_only:
            edge = np.maximum(edge, 0)
        # 2 * integral from the edge to the zenith of (cos b sin e - rise cos b cos e) cos e, by the midpoint rule: no closed form shared.
        count = 400
        e = edge + (np.pi / 2 - edge) * ((np.arange(count) + 0.5) / count)[:, None, None]
        part = 2 * cosine * (np.sin(e) - rise * np.cos(e)) * np.cos(e)
        total += (part * (np.pi / 2 - edge) / count).sum(axis=0)
    return total / len(horizon)


def facet_gradients(z: Array, cell: tuple[float, float]) -> Array:
    """Return the gradients (n, 2) of the triangles of both triangulations whose corners are all valid, one by one."""
    found = []
    for i in range(z.shape[0] - 1):
        for j in range(z.shape[1] - 1):
            z00, z01, z10, z11 = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
            across, down = ((z01 - z00) / cell[0], (z11 - z10) / cell[0]), ((z10 - z00) / cell[1], (z11 - z01) / cell[1])
            found += [(a, b) for a in across for b in down if not math.isnan(a + b)]
    return np.array(found).reshape(-1, 2)


def four_point(row: Array) -> Array:
    """Return ``row`` (n,) refined once by the 4-point scheme, (2 n - 7,): only what has all its neighbours."""
    middle = (-row[:-3] + 9 * row[1:-2] + 9 * row[2:-1] - row[3:]) / 16
    result = np.empty(2 * len(middle) - 1)
    result[::2], result[1::2] = middle, row[2:-2]
    return result
