"""Codecs for heights in metres with voids: ``lerc:E`` (bounded error) and ``png16:SCALE,OFFSET`` (16-bit integers)."""

import threading
from dataclasses import dataclass
from math import frexp, ldexp
from typing import Final

import imagecodecs
import numpy as np

from schemas.errors import InputError, UsageError
from tiler.codecs import (
    PNG_END,
    BlockFormat,
    Factory,
    Mask,
    Samples,
    checked,
    decoding,
    number_text,
    require_picture_end,
    voids_zeroed,
)
from tiler.codecs.pngfile import png_file

_FLOAT32_BITS: Final = 24
_PNG_COLOUR_TYPE: Final = 25
"""Where the header of a PNG says which channels it has."""
_PNG_GREY_ALPHA: Final = b"\x04"


_ROOMS: Final = threading.local()


def _lerc_room(sample_bytes: int) -> bytearray:
    """Return this thread's scratch for a blob of so many bytes of samples: they as they are, a mask of a bit per sample, headers."""
    needed = sample_bytes + sample_bytes // 16 + 4096
    room: bytearray | None = getattr(_ROOMS, "room", None)
    if room is None or len(room) < needed:
        room = _ROOMS.room = bytearray(needed)
    return room


@dataclass(frozen=True, slots=True)
class LercCodec:
    """Limited error raster compression: every decoded height is within ``max_error`` metres, 0 means lossless but for the sign of 0."""

    block: BlockFormat
    spec: str
    max_error: float
    suffix: str = "lerc"
    media_type: str = "application/vnd.lerc"
    value_range: tuple[float, float] | None = None

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the LERC2 blob of ``samples`` (side, side, 1) float32 and ``mask``."""
        samples, mask = voids_zeroed(samples, mask)
        masks = None if mask is None else np.ascontiguousarray(mask)
        # LERC bounds the error before it rounds to float32: half a unit in the last place (0.5 mm at 8848 m) must fit in as well.
        _, exponent = frexp(float(np.abs(samples).max()))
        bound = max(0.0, self.max_error - ldexp(1.0, exponent - _FLOAT32_BITS))
        # Room for the worst case: left to find the size first, the library does all work twice, which takes 1.5 times as long.
        return bytes(imagecodecs.lerc_encode(np.ascontiguousarray(samples[..., 0]), bound, masks=masks, out=_lerc_room(samples.nbytes)))

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, 1) float32 and mask; raises InputError if ``data`` is damaged."""
        with decoding(self.spec):
            samples, mask = imagecodecs.lerc_decode(data, masks=True)
        samples = checked(np.asarray(samples)[..., np.newaxis], self.block, self.spec)
        valid = np.asarray(mask, np.bool_)
        return voids_zeroed(samples, None if valid.ndim == 0 else valid)


@dataclass(frozen=True, slots=True)
class Png16Codec:
    """16-bit grey PNG of ``round((height - offset) / scale)``; a block with voids has an alpha channel as its mask."""

    block: BlockFormat
    scale_m: float
    offset_m: float
    suffix: str = "png"
    media_type: str = "image/png"

    @property
    def spec(self) -> str:
        """``png16:SCALE,OFFSET`` in metres."""
        return f"png16:{number_text(self.scale_m)},{number_text(self.offset_m)}"

    @property
    def max_error(self) -> float:
        """Half a step [m]."""
        return self.scale_m / 2

    @property
    def value_range(self) -> tuple[float, float]:
        """Lowest and highest height that fit into 16 bits [m]."""
        return self.offset_m, self.offset_m + 65535 * self.scale_m

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the PNG of ``samples`` (side, side, 1) float32; raises InputError if a valid height is out of range."""
        heights, mask = samples[..., 0].astype(np.float64), None if mask is None or mask.all() else mask
        if mask is not None:
            heights[~mask] = self.offset_m
        steps = np.rint((heights - self.offset_m) / self.scale_m)
        if steps.min() < 0 or steps.max() > 65535:
            low, high = self.value_range
            raise InputError(f"codec {self.spec} holds heights from {low:g} to {high:g} m only; use another scale and offset, or lerc")
        grey = steps.astype(np.uint16)
        if mask is not None:
            grey = np.stack([grey, np.where(mask, np.uint16(65535), np.uint16(0))], axis=-1)
        return png_file(grey)

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, 1) float32 metres and mask; raises InputError if ``data`` is damaged."""
        masked = data[_PNG_COLOUR_TYPE : _PNG_COLOUR_TYPE + 1] == _PNG_GREY_ALPHA
        grey = np.empty((self.block.side, self.block.side, 2) if masked else (self.block.side, self.block.side), np.uint16)
        with decoding(self.spec):
            require_picture_end(data, PNG_END, "end chunk")
            imagecodecs.png_decode(data, out=grey)
        steps = grey[..., 0] if masked else grey
        heights = (steps * self.scale_m + self.offset_m).astype(np.float32)[..., np.newaxis]
        return voids_zeroed(heights, grey[..., 1] > 0 if masked else None)


def _require_heights(block: BlockFormat, name: str) -> None:
    if block.kind != "height" or block.channels != 1 or block.dtype != "float32":
        raise UsageError(f"codec {name} holds heights, not {block}; use jpeg, png or webp")


def _number(text: str, name: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise UsageError(f"codec {name}: {what} {text!r} is not a number")
    return value


def _lerc(block: BlockFormat, parameters: str) -> LercCodec:
    _require_heights(block, "lerc")
    max_error = _number(parameters or "0.01", "lerc", "the error bound")
    if max_error < 0:
        raise UsageError(f"codec lerc:{parameters}: the error bound must be 0 (lossless) or more metres")
    return LercCodec(block, f"lerc:{number_text(max_error)}", max_error)


def _png16(block: BlockFormat, parameters: str) -> Png16Codec:
    _require_heights(block, "png16")
    scale, _, offset = parameters.partition(",")
    if not scale or not offset:
        raise UsageError("codec png16 needs a scale and an offset in metres for this source, e.g. png16:0.1,-500; or use lerc")
    scale_m, offset_m = _number(scale, "png16", "the scale"), _number(offset, "png16", "the offset")
    if not abs(offset_m) + 65535 * scale_m < 1e30:
        raise UsageError(f"codec png16:{parameters}: such heights are beyond any planet")
    if scale_m <= 0:
        raise UsageError(f"codec png16:{parameters}: the scale must be more than 0 metres")
    return Png16Codec(block, scale_m, offset_m)


FACTORIES: Final[dict[str, Factory]] = {"lerc": _lerc, "png16": _png16}
