"""The everyday picture codecs: ``jpeg:Q``, ``png`` and ``webp:Q``, through imagecodecs; PNG is written by ``pngfile``.

All work on byte strings and release the GIL: two threads encode JPEG at 1.9 times the rate of one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import imagecodecs
import numpy as np

from schemas.errors import UsageError
from tiler.codecs import PNG_END, BlockFormat, Factory, Mask, Samples, decoding, require_picture_end
from tiler.codecs.pngfile import png_file


@dataclass(frozen=True, slots=True)
class PictureCodec:
    """A codec whose library turns an array into a picture file and back; masks are the alpha channel's business.

    ``_decode`` fills the array it is given and raises ValueError if the picture has another size or type, so that a file that
    declares gigapixels cannot make a reader allocate them.
    """

    block: BlockFormat
    spec: str
    suffix: str
    media_type: str
    max_error: float | None
    _encode: Callable[[Samples], bytes]
    _decode: Callable[[bytes, Samples], Any]
    value_range: tuple[float, float] | None = None

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the picture file of ``samples`` (side, side, channels); ``mask`` must be None."""
        if mask is not None:
            raise UsageError(f"codec {self.spec}: a mask must be given as the alpha channel")
        squeezed = samples[..., 0] if self.block.channels == 1 else samples
        return self._encode(np.ascontiguousarray(squeezed))

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, channels) samples and None; raises InputError if ``data`` is damaged."""
        samples = np.empty((self.block.side, self.block.side, self.block.channels), self.block.dtype)
        with decoding(self.spec):
            self._decode(data, samples[..., 0] if self.block.channels == 1 else samples)
        return samples, None


def _quality(parameters: str, default: int, name: str) -> int:
    if not parameters:
        return default
    if not parameters.isdecimal() or not 1 <= int(parameters) <= 100:
        raise UsageError(f"codec {name}:{parameters}: the quality must be a whole number from 1 to 100")
    return int(parameters)


def _jpeg(block: BlockFormat, parameters: str) -> PictureCodec:
    quality = _quality(parameters, 85, "jpeg")
    if block.kind == "height" or block.alpha or block.channels not in (1, 3) or block.dtype != "uint8":
        raise UsageError(f"codec jpeg holds 8-bit imagery of 1 or 3 channels without alpha, not {block}; use png")
    # Full chroma from quality 90 on, as libvips does: below it the loss by subsampling is the smaller one.
    subsampling = "444" if quality >= 90 else "420"

    def encode(samples: Samples) -> bytes:
        return bytes(imagecodecs.jpeg8_encode(samples, level=quality, subsampling=subsampling))

    return PictureCodec(block, f"jpeg:{quality}", "jpg", "image/jpeg", None, encode, _decode_jpeg)


def _decode_jpeg(data: bytes, out: Samples) -> None:
    require_picture_end(data, b"\xff\xd9", "end-of-image marker")
    imagecodecs.jpeg8_decode(data, out=out)


def _decode_png(data: bytes, out: Samples) -> None:
    require_picture_end(data, PNG_END, "end chunk")
    imagecodecs.png_decode(data, out=out)


def _png(block: BlockFormat, parameters: str) -> PictureCodec:
    if parameters:
        raise UsageError(f"codec png:{parameters}: png has no parameters")
    if block.kind == "height" or block.dtype == "float32":
        raise UsageError(f"codec png holds imagery of 8 or 16 bits, not {block}; for heights use lerc, png16 or exr")

    return PictureCodec(block, "png", "png", "image/png", 0.0, png_file, _decode_png)


def _webp(block: BlockFormat, parameters: str) -> PictureCodec:
    quality = _quality(parameters, 85, "webp")
    is_grey = block.kind == "light" and block.channels in (1, 2)
    if block.kind in ("height", "normal") or not (is_grey or block.channels in (3, 4)) or block.dtype != "uint8":
        raise UsageError(f"codec webp holds 8-bit imagery of 3 or 4 channels and 8-bit light, not {block}; use png")
    return _grey_webp(block, quality) if is_grey else _coloured_webp(block, quality)


def _coloured_webp(block: BlockFormat, quality: int) -> PictureCodec:
    def encode(samples: Samples) -> bytes:
        return bytes(imagecodecs.webp_encode(samples, level=quality, lossless=False))

    def decode(data: bytes, out: Samples) -> None:
        # libwebp drops an alpha channel that is opaque everywhere, and gives it back when asked for one.
        imagecodecs.webp_decode(data, hasalpha=block.channels == 4, out=out)

    return PictureCodec(block, f"webp:{quality}", "webp", "image/webp", None, encode, decode)


def _grey_webp(block: BlockFormat, quality: int) -> PictureCodec:
    """Return the codec of one channel, and alpha: three equal ones, as WebP knows no grey; they come back equal to a code."""

    def encode(samples: Samples) -> bytes:
        grey, alpha = np.split(samples.reshape(*samples.shape[:2], block.channels), [1], axis=-1)
        return bytes(imagecodecs.webp_encode(np.concatenate([grey, grey, grey, alpha], axis=-1), level=quality, lossless=False))

    def decode(data: bytes, out: Samples) -> None:
        colours = np.empty((block.side, block.side, 2 + block.channels), np.uint8)
        imagecodecs.webp_decode(data, hasalpha=block.channels == 2, out=colours)
        # Green, of which brightness has most, and alpha if there is one.
        out[...] = colours[..., 1::2].reshape(out.shape)

    return PictureCodec(block, f"webp:{quality}", "webp", "image/webp", None, encode, decode)


FACTORIES: Final[dict[str, Factory]] = {"jpeg": _jpeg, "png": _png, "webp": _webp}
