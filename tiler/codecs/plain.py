"""Codecs without compression: ``raw`` little-endian samples, and ``rgb565``, the fixed-size texels of Backes et al."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from tiler.codecs import BlockFormat, Factory, Mask, Samples, decoding, voids_zeroed


@dataclass(frozen=True, slots=True)
class RawCodec:
    """Samples as they lie in memory, little-endian, row by row; a block with voids is followed by its mask, one bit a sample."""

    block: BlockFormat
    spec: str = "raw"
    suffix: str = "raw"
    media_type: str = "application/octet-stream"
    max_error: float | None = 0.0
    value_range: tuple[float, float] | None = None

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the bytes of ``samples`` (side, side, channels) and, if any sample is void, of the packed ``mask``."""
        if mask is not None and self.block.kind == "imagery":
            raise UsageError("codec raw: the mask of imagery must be given as the alpha channel")
        samples, mask = voids_zeroed(samples, mask)
        data = np.ascontiguousarray(samples).astype(self._dtype, copy=False).tobytes()
        return data if mask is None else data + np.packbits(mask, bitorder="little").tobytes()

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return samples (side, side, channels) and mask; raises InputError if ``data`` has a wrong length."""
        side, shape = self.block.side, (self.block.side, self.block.side, self.block.channels)
        plain = int(np.prod(shape)) * self._dtype.itemsize
        with decoding(self.spec):
            if len(data) != plain and (self.block.kind == "imagery" or len(data) != plain + -(-side * side // 8)):
                raise ValueError(f"{len(data)} bytes instead of {plain}")
            samples = np.frombuffer(data[:plain], self._dtype).reshape(shape).astype(self.block.dtype)
        if len(data) == plain:
            return samples, None
        bits = np.frombuffer(data[plain:], np.uint8)
        return voids_zeroed(samples, np.unpackbits(bits, count=side * side, bitorder="little").reshape(side, side).astype(np.bool_))

    @property
    def _dtype(self) -> np.dtype[np.generic]:
        return np.dtype(self.block.dtype).newbyteorder("<")


@dataclass(frozen=True, slots=True)
class Rgb565Codec:
    """Two bytes a sample, little-endian, red in the high bits: what a GPU takes as it is (Backes et al., section 4).

    Rounded to nearest, so red and blue err by at most 4 codes, green by at most 2.
    """

    block: BlockFormat
    spec: str = "rgb565"
    suffix: str = "565"
    media_type: str = "application/octet-stream"
    max_error: float | None = 4.0
    value_range: tuple[float, float] | None = None

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the texels of ``samples`` (side, side, 3) uint8; ``mask`` must be None."""
        if mask is not None:
            raise UsageError("codec rgb565 has no room for a mask; use png or webp")
        wide = samples.astype(np.uint32)
        red, green, blue = ((wide[..., channel] * top + 127) // 255 for channel, top in enumerate((31, 63, 31)))
        return (red << 11 | green << 5 | blue).astype("<u2").tobytes()

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, 3) uint8 and None; raises InputError if ``data`` has a wrong length."""
        with decoding(self.spec):
            texels: NDArray[np.uint16] = np.frombuffer(data, "<u2").reshape(self.block.side, self.block.side)
        red, green, blue = texels >> 11, texels >> 5 & 63, texels & 31
        # Repeating the high bits below the low ones is what GPUs do to expand a channel.
        channels = [red << 3 | red >> 2, green << 2 | green >> 4, blue << 3 | blue >> 2]
        return np.stack(channels, axis=-1).astype(np.uint8), None


def _raw(block: BlockFormat, parameters: str) -> RawCodec:
    if parameters:
        raise UsageError(f"codec raw:{parameters}: raw has no parameters")
    return RawCodec(block)


def _rgb565(block: BlockFormat, parameters: str) -> Rgb565Codec:
    if parameters:
        raise UsageError(f"codec rgb565:{parameters}: rgb565 has no parameters")
    if block.kind != "imagery" or block.channels != 3 or block.dtype != "uint8":
        raise UsageError(f"codec rgb565 holds 8-bit imagery of 3 channels, not {block}; use png")
    return Rgb565Codec(block)


FACTORIES: Final[dict[str, Factory]] = {"raw": _raw, "rgb565": _rgb565}
