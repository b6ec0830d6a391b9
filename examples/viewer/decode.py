"""From stored bytes to what the windows take: float32 heights with a mask, or RGBA8 texels. Runs in worker threads."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from schemas.light import Normals
from schemas.manifest import Layer
from tiler.codecs import BlockFormat, Codec, open_codec


@dataclass(frozen=True, slots=True)
class HeightBlock:
    """Heights (B, B) float32 in metres, and which of them are valid (B, B) bool. Void heights are 0."""

    z: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def nbytes(self) -> int:
        """Memory it takes [bytes]."""
        return self.z.nbytes + self.valid.nbytes


@dataclass(frozen=True, slots=True)
class ImageBlock:
    """Texels (B, B, 4) uint8, colour premultiplied by alpha so that transparent texels cannot bleed when filtered."""

    texels: NDArray[np.uint8]

    @property
    def nbytes(self) -> int:
        """Memory it takes [bytes]."""
        return self.texels.nbytes


NORMAL_ZERO: Final = 127
"""Texel of a normal's part that is 0; of one that is 1 it is twice that."""

Block = HeightBlock | ImageBlock
Decoder = Callable[[bytes | None], Block]
"""Turns a block's bytes into a block, None into a blank one; raises InputError if the bytes are damaged."""


def layer_codec(layer: Layer) -> Codec:
    """Return the codec of a layer's blocks; raises UsageError if this installation has none such."""
    block = BlockFormat(layer.kind, layer.lattice.stored_side, layer.channels, layer.dtype, layer.alpha)
    return open_codec(layer.codec, block)


def layer_decoder(layer: Layer) -> Decoder:
    """Return the decoder of a layer's blocks."""
    if layer.kind == "height":
        if layer.channels != 1:
            raise UsageError(f"a height layer of {layer.channels} channels cannot be drawn; it must have 1")
        return _HeightDecoder(layer)
    return _ImageDecoder(layer) if layer.normals is None else _NormalDecoder(layer, layer.normals)


class _Decoder:
    def __init__(self, layer: Layer) -> None:
        self._codec = layer_codec(layer)
        self._side = layer.block
        self._core = slice(layer.pad, layer.pad + layer.block)
        self._channels = layer.channels

    def _decode(self, data: bytes) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        samples, mask = self._codec.decode(data)
        stored = self._side + 2 * self._core.start
        if samples.shape != (stored, stored, self._channels):
            raise InputError(f"a block decodes to {samples.shape} instead of {(stored, stored, self._channels)}; rebuild the layer")
        return samples[self._core, self._core], None if mask is None else mask[self._core, self._core]


class _HeightDecoder(_Decoder):
    def __call__(self, data: bytes | None) -> HeightBlock:
        side = self._side
        if data is None:
            return HeightBlock(np.zeros((side, side), np.float32), np.zeros((side, side), np.bool_))
        samples, mask = self._decode(data)
        z = samples[..., 0].astype(np.float32)
        valid = np.isfinite(z)
        if mask is not None:
            valid &= mask
        z[~valid] = 0.0
        return HeightBlock(z, valid)


class _NormalDecoder(_Decoder):
    """Texels of normals: x in red and y in green, ``NORMAL_ZERO`` codes and as many times them; alpha 0 where void, else 255."""

    def __init__(self, layer: Layer, normals: Normals) -> None:
        super().__init__(layer)
        self._alpha = layer.alpha
        self._zero, self._one = np.float32(normals.zero), np.float32(normals.one)

    def __call__(self, data: bytes | None) -> ImageBlock:
        texels = np.zeros((self._side, self._side, 4), np.uint8)
        if data is None:
            return ImageBlock(texels)
        samples, mask = self._decode(data)
        parts = (samples[..., :2].astype(np.float32) - self._zero) / self._one
        valid = samples[..., 2] > 0 if self._alpha else np.ones(parts.shape[:2], np.bool_) if mask is None else mask
        codes = np.rint(np.clip(np.nan_to_num(parts), -1.0, 1.0) * NORMAL_ZERO + NORMAL_ZERO)
        texels[valid, :2] = codes[valid].astype(np.uint8)
        texels[valid, 3] = 255
        return ImageBlock(texels)


class _ImageDecoder(_Decoder):
    def __init__(self, layer: Layer) -> None:
        super().__init__(layer)
        self._alpha = layer.alpha
        self._low, self._high = _value_range(layer)
        self._alpha_full = 255.0 if layer.dtype == "uint8" else 65535.0 if layer.dtype == "uint16" else 1.0
        self._eight_bit = layer.dtype == "uint8"
        self._is_light = layer.kind == "light" and layer.dtype == "float32"

    def __call__(self, data: bytes | None) -> ImageBlock:
        texels = np.zeros((self._side, self._side, 4), np.uint8)
        if data is None:
            return ImageBlock(texels)
        samples, mask = self._decode(data)
        colours = samples[..., :-1] if self._alpha else samples
        # One or two channels are grey; of four channels without alpha the first three are taken for colour.
        colours = colours[..., :3] if colours.shape[-1] >= 3 else colours[..., :1]
        if self._is_light:
            colours = _encoded(colours)
        texels[..., :3] = colours if self._eight_bit else self._stretched(colours)
        texels[..., 3] = 255 if not self._alpha else np.rint(samples[..., -1] * (255.0 / self._alpha_full))
        if mask is not None:
            texels[..., 3][~mask] = 0
        if self._alpha or mask is not None:
            opacity = texels[..., 3:].astype(np.uint16)
            texels[..., :3] = (texels[..., :3] * opacity + 127) // 255
        return ImageBlock(texels)

    def _stretched(self, colours: NDArray[Any]) -> NDArray[np.uint8]:
        channels = colours.shape[-1]
        low, high = self._low[:channels], self._high[:channels]
        scaled = (colours.astype(np.float32) - low) * (255.0 / np.maximum(high - low, 1e-30))
        codes: NDArray[np.uint8] = np.rint(np.clip(np.nan_to_num(scaled), 0.0, 255.0)).astype(np.uint8)
        return codes


def _encoded(light: NDArray[Any]) -> NDArray[np.float32]:
    """Return the sRGB encoding (IEC 61966-2-1) of light from 0 to 1, which is what texels hold."""
    lit = np.clip(np.nan_to_num(light), 0.0, 1.0)
    codes: NDArray[np.float32] = np.where(lit <= 0.0031308, 12.92 * lit, 1.055 * np.power(lit, 1 / 2.4) - 0.055).astype(np.float32)
    return codes


def _value_range(layer: Layer) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the values shown as black and as white, one pair for all channels so that hues stay as they are; of light all codes."""
    if layer.kind == "light":
        return np.zeros(3, np.float32), np.full(3, 65535.0 if layer.dtype == "uint16" else 1.0, np.float32)
    low, high = layer.statistics.min, layer.statistics.max
    bottom, top = (min(low), max(high)) if low and high else (0.0, 1.0)
    return np.full(3, bottom, np.float32), np.full(3, top, np.float32)
