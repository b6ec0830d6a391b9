"""A decoded block as a PNG to look at: pictures as they are, heights and normals as shaded relief, voids transparent."""

from math import cos, radians, sin
from typing import Any, Final

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from schemas.light import Normals
from schemas.manifest import Layer
from tiler.checking.blockreader import DecodedBlock

Picture = NDArray[np.uint8]

_SUN_AZIMUTH_DEG: Final = 315.0
_SUN_ELEVATION_DEG: Final = 45.0
"""Light from the upper left, the convention of relief maps: from below, valleys look like ridges."""
_GREYS: Final = 0.3, 0.8
"""Grey of the lowest and of the highest height, so that shading can darken and brighten both."""
_CUT_PERCENT: Final = 2.0
"""Share of imagery samples cut off at either end when it is stretched: a few clouds would leave nothing but black."""


def preview_png(layer: Layer, level: int, core: DecodedBlock) -> bytes:
    """Return the PNG of a decoded core (rows, columns, channels), 8 bits a channel; alpha only if there are voids or an alpha channel."""
    if layer.normals is not None:
        return bytes(imagecodecs.png_encode(_faced(layer.normals, core)))
    return bytes(imagecodecs.png_encode(_relief(layer, level, core) if layer.kind == "height" else _picture(layer, core)))


def _picture(layer: Layer, core: DecodedBlock) -> Picture:
    """Return imagery with its alpha; wider types are stretched between the 2nd and the 98th percentile of all colours together."""
    colours = core.samples[..., : layer.channels - layer.alpha]
    if colours.dtype != np.uint8:
        colours = _bytes(_stretched(colours, core.valid, _CUT_PERCENT))
    if layer.alpha:
        top = np.iinfo(core.samples.dtype).max if core.samples.dtype.kind == "u" else 1
        alpha = _bytes(core.samples[..., -1:].astype(np.float64) / top)
        colours = np.concatenate([colours, alpha], axis=-1)
    return _squeezed(colours)


def _relief(layer: Layer, level: int, core: DecodedBlock) -> Picture:
    """Return heights as grey from the lowest to the highest, shaded where the ground spacing is known; voids are transparent."""
    darkest, brightest = _GREYS
    grey = darkest + (brightest - darkest) * _stretched(core.samples, core.valid)
    if layer.ground_spacing_m is not None and min(core.samples.shape[:2]) > 1:
        east_m, south_m = (spacing * 2**level for spacing in layer.ground_spacing_m)
        grey *= _shade(np.where(core.valid, core.samples[..., 0].astype(np.float64), np.nan), east_m, south_m)[..., np.newaxis]
    if not core.valid.all():
        return np.concatenate([_bytes(grey), _bytes(core.valid[..., np.newaxis].astype(np.float64))], axis=-1)
    return _squeezed(_bytes(grey))


def _faced(normals: Normals, core: DecodedBlock) -> Picture:
    """Return Lambert's cosine between normals and sun as grey; voids are transparent."""
    x, y = np.moveaxis((core.samples[..., :2].astype(np.float64) - normals.zero) / normals.one, -1, 0)
    azimuth, elevation = radians(_SUN_AZIMUTH_DEG), radians(_SUN_ELEVATION_DEG)
    upright = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    grey = _bytes(sin(elevation) * upright + cos(elevation) * (sin(azimuth) * x + cos(azimuth) * y))
    return grey if core.valid.all() else np.stack([grey, _bytes(core.valid.astype(np.float64))], axis=-1)


def _shade(heights_m: NDArray[np.float64], east_m: float, south_m: float) -> NDArray[np.float64]:
    """Return Lambert's cosine between surface and sun, relative to level ground, at most 1.4; beside voids the ground counts as level."""
    down, right = np.gradient(heights_m, south_m, east_m)
    azimuth, elevation = radians(_SUN_AZIMUTH_DEG), radians(_SUN_ELEVATION_DEG)
    towards_sun = sin(elevation) + cos(elevation) * (cos(azimuth) * down - sin(azimuth) * right)
    shade = towards_sun / np.sqrt(1 + down**2 + right**2) / sin(elevation)
    return np.asarray(np.clip(np.nan_to_num(shade, nan=1.0), 0.0, 1.4))


def _stretched(samples: NDArray[Any], valid: NDArray[np.bool_], cut_percent: float = 0.0) -> NDArray[np.float64]:
    """Return ``samples`` scaled so that the valid ones, less ``cut_percent`` at either end, reach from 0 to 1; 0.5 if all are the same."""
    seen = samples[valid].astype(np.float64)
    low, high = np.percentile(seen, (cut_percent, 100 - cut_percent)) if len(seen) else (0.0, 0.0)
    if high == low:
        return np.full(samples.shape, 0.5)
    return np.asarray((samples - low) / (high - low), np.float64)


def _bytes(values: NDArray[np.float64]) -> Picture:
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255), np.uint8)


def _squeezed(picture: NDArray[Any]) -> Picture:
    return np.ascontiguousarray(picture[..., 0] if picture.shape[-1] == 1 else picture)
