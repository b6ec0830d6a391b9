"""Layers of pixels on top of each other: one form for all files of a mosaic, and what shows where they overlap."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from tiler.sources import FileInfo, Pixels
from tiler.sources.convert import void_value

Opacity = NDArray[Any]
"""(rows, columns), from 0, through which all below shows, to ``Form.full``."""


@dataclass(frozen=True, slots=True)
class Form:
    """What all files of a mosaic become: colours first, then alpha if any file has it.

    ``full`` is the largest opacity: of the alpha channel, else 255 of a mask. ``bits`` as in ``FileInfo``.
    """

    colours: int
    dtype: np.dtype[Any]
    alpha: bool
    premultiplied: bool
    bits: int | None

    @property
    def full(self) -> float:
        """The opacity of what hides all below."""
        if not self.alpha:
            return 255
        if self.dtype.kind == "f":
            return 1
        return int(np.iinfo(self.dtype).max) if self.bits is None else (1 << self.bits) - 1

    @property
    def opacity_dtype(self) -> np.dtype[Any]:
        """The type of opacities."""
        return self.dtype if self.alpha else np.dtype(np.uint8)


def common_form(infos: Sequence[FileInfo]) -> Form:
    """Return the form that holds the samples of all files; raises InputError naming two files that do not go together."""
    first = infos[0]
    dtype = first.dtype
    for info in infos:
        if _colours(info) != _colours(first):
            raise InputError(_unlike(info, first, f"{_colours(info)} colours", f"{_colours(first)}", "choose with gdal_translate -b"))
        if info.dtype != dtype:
            dtype = np.result_type(dtype, info.dtype)
            # Heights keep their value in a wider type; brightness would not keep its meaning.
            if _colours(info) != 1 or dtype.kind == "u" or any(other.alpha is not None for other in infos):
                raise InputError(_unlike(info, first, f"samples of {info.dtype}", f"{first.dtype}", "convert one with gdal_translate -ot"))
        if (info.bits or 0) != (first.bits or 0) and any(other.alpha is not None for other in infos):
            raise InputError(_unlike(info, first, f"{_bits(info)} bits", f"{_bits(first)}", "convert one with gdal_translate -scale"))
    with_alpha = [info for info in infos if info.alpha is not None]
    bits = None if any(info.bits is None for info in infos) else max(info.bits or 0 for info in infos)
    return Form(_colours(first), dtype, bool(with_alpha), bool(with_alpha) and all(info.premultiplied for info in with_alpha), bits)


def _colours(info: FileInfo) -> int:
    return info.channels - (info.alpha is not None)


def _bits(info: FileInfo) -> int:
    return info.bits or 8 * info.dtype.itemsize


def _unlike(info: FileInfo, first: FileInfo, has: str, other: str, remedy: str) -> str:
    return f"{info.path}: has {has}, but {first.path} has {other}, and a mosaic holds one kind of samples; {remedy}"


class Layerer:
    """Turns pixels of one file into the form of the mosaic; ``nodata`` marks its voids instead of what it declares.

    ``opaque`` says that none of its pixels can be void or transparent, by the header.
    """

    def __init__(self, info: FileInfo, form: Form, nodata: float | None) -> None:
        self._info, self._form = info, form
        self._void = void_value(info, nodata)
        self.opaque = self._void is None and info.alpha is None and not info.has_mask and info.dtype.kind != "f"
        self._channels = [channel for channel in range(info.channels) if channel != info.alpha]

    def __call__(self, pixels: Pixels, mask: NDArray[np.uint8] | None) -> tuple[Pixels, Opacity]:
        """Return colours of the mosaic's type, 0 where void, and their opacity."""
        form, info = self._form, self._info
        colours = pixels if info.alpha is None else pixels[..., self._channels]
        opacity = self._alpha(pixels)
        if self.opaque:
            return colours.astype(form.dtype, copy=False), opacity
        if mask is not None:
            opacity = np.where(mask == 255, opacity, _rounded(opacity * (mask / 255.0), form.opacity_dtype))
        if self._void is not None:
            with np.errstate(under="ignore"):
                mark = colours.dtype.type(self._void)
            opacity[(colours == mark).all(axis=-1)] = 0
        if colours.dtype.kind == "f":
            opacity[~np.isfinite(colours).all(axis=-1)] = 0
        colours = np.where(opacity[..., np.newaxis] > 0, colours, colours.dtype.type(0)).astype(form.dtype, copy=False)
        if info.premultiplied and info.alpha is not None and not form.premultiplied:
            colours = _divided(colours, opacity, form)
        return colours, opacity

    def _alpha(self, pixels: Pixels) -> Opacity:
        form, info = self._form, self._info
        if info.alpha is None:
            return np.full(pixels.shape[:2], form.full, form.opacity_dtype)
        alpha: Opacity = pixels[..., info.alpha]
        if alpha.dtype.kind == "f":
            return np.asarray(np.clip(np.nan_to_num(alpha, nan=0.0), 0, 1), form.opacity_dtype)
        return np.array(alpha)


def _divided(colours: Pixels, opacity: Opacity, form: Form) -> Pixels:
    """Take the opacity out of premultiplied colours."""
    partial = (opacity > 0) & (opacity < form.full)
    if not partial.any():
        return colours
    straight = colours.copy()
    straight[partial] = _rounded(colours[partial] * (form.full / opacity[partial].astype(np.float64))[:, np.newaxis], form.dtype, form.bits)
    return straight


def _rounded(values: NDArray[Any], dtype: np.dtype[Any], bits: int | None = None) -> NDArray[Any]:
    if dtype.kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.asarray(np.clip(np.rint(values), limits.min, limits.max if bits is None else (1 << bits) - 1), dtype)


def lay(below: Pixels, below_opacity: Opacity, colours: Pixels, opacity: Opacity, form: Form) -> None:
    """Lay ``colours`` over ``below``, in place: what is opaque hides, what is void shows, the rest is mixed.

    Mixed is what Porter and Duff call "over" (Compositing Digital Images, 1984), rounded to the type once for each overlap.
    """
    hiding = (opacity >= form.full) | ((opacity > 0) & (below_opacity == 0))
    below[hiding] = colours[hiding]
    mixing = (opacity > 0) & ~hiding
    if mixing.any():
        upper, lower = (part[mixing].astype(np.float64) / form.full for part in (opacity, below_opacity))
        total = upper + lower * (1 - upper)
        weights = (np.ones_like(upper), 1 - upper) if form.premultiplied else (upper / total, lower * (1 - upper) / total)
        mixed = colours[mixing] * weights[0][:, np.newaxis] + below[mixing] * weights[1][:, np.newaxis]
        below[mixing] = _rounded(mixed, form.dtype, form.bits)
        below_opacity[mixing] = _rounded(total * form.full, form.opacity_dtype, form.bits if form.alpha else None)
    below_opacity[hiding] = opacity[hiding]


def to_warp(colours: Pixels, opacity: Opacity, form: Form) -> NDArray[Any]:
    """Return straight colours and opacity from 0 to 255 as channels of one float array, exact for every type that heights have."""
    exact = np.float64 if form.dtype.itemsize > 2 and form.dtype != np.float32 else np.float32
    if form.premultiplied:
        colours = _straight(colours.astype(exact), opacity, form)
    scale = 1.0 if form.full == 255 else 255 / form.full
    return np.concatenate([colours, (opacity * scale)[..., np.newaxis]], axis=-1, dtype=exact, casting="same_kind")


def _straight(colours: NDArray[Any], opacity: Opacity, form: Form) -> NDArray[Any]:
    """Take the opacity out of premultiplied colours without rounding."""
    shares = np.where(opacity > 0, opacity, form.full).astype(colours.dtype) / colours.dtype.type(form.full)
    return np.asarray(colours / shares[..., np.newaxis])


def from_warp(values: NDArray[Any], form: Form) -> tuple[Pixels, Opacity]:
    """Return what ``to_warp`` was given, rounded to the mosaic's types; without alpha, what is covered by half or more is opaque."""
    shares = np.clip(values[..., -1] / 255, 0, 1)
    if not form.alpha:
        shares = np.where(shares >= 0.5, 1.0, 0.0)
    opacity = _rounded(shares * form.full, form.opacity_dtype, form.bits if form.alpha else None)
    colours = values[..., :-1] * shares[..., np.newaxis] if form.premultiplied else values[..., :-1]
    colours = np.where(opacity[..., np.newaxis] > 0, colours, 0)
    return _rounded(colours, form.dtype, form.bits), opacity
