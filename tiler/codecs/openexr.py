"""The ``exr:float`` and ``exr:half`` codecs: OpenEXR files, for interchange with film and game tools."""

import io
from dataclasses import dataclass
from typing import Final

import numpy as np
import OpenEXR

from schemas.errors import InputError, UsageError
from tiler.codecs import BlockFormat, Factory, Mask, Samples, checked, decoding

_HALF_MAX: Final = 65504.0


@dataclass(frozen=True, slots=True)
class ExrCodec:
    """A ZIP-compressed scan-line EXR with channel Y, and A (1 valid, 0 void) if the block has voids.

    ``half`` keeps 11 significant bits: 0.25 m from 256 to 512 m, 4 m from 4096 to 8192 m. Prefer ``float`` for heights.
    """

    block: BlockFormat
    half: bool
    suffix: str = "exr"
    media_type: str = "image/x-exr"

    @property
    def spec(self) -> str:
        """``exr:half`` or ``exr:float``."""
        return "exr:half" if self.half else "exr:float"

    @property
    def max_error(self) -> float | None:
        """0 for float; None for half, whose error grows with the value."""
        return None if self.half else 0.0

    @property
    def value_range(self) -> tuple[float, float] | None:
        """The finite range of half floats."""
        return (-_HALF_MAX, _HALF_MAX) if self.half else None

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the EXR file of ``samples`` (side, side, 1) float32; raises InputError if half cannot hold a height."""
        if self.half and np.abs(samples).max() > _HALF_MAX:
            raise InputError(f"codec exr:half holds values up to {_HALF_MAX:g} only; use exr:float")
        dtype = np.float16 if self.half else np.float32
        channels = {"Y": np.ascontiguousarray(samples[..., 0], dtype)}
        if mask is not None and not mask.all():
            channels["A"] = mask.astype(dtype)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        buffer = io.BytesIO()
        with OpenEXR.File(header, channels) as file:
            file.write(buffer)
        return buffer.getvalue()

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, 1) float32 and mask; raises InputError if ``data`` is damaged."""
        with decoding(self.spec), OpenEXR.File(io.BytesIO(data)) as file:
            pixels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
            samples = pixels["Y"][..., np.newaxis]
            mask = pixels["A"] > 0.5 if "A" in pixels else None
        return checked(samples, self.block, self.spec), mask


def _exr(block: BlockFormat, parameters: str) -> ExrCodec:
    if parameters not in ("", "half", "float"):
        raise UsageError(f"codec exr:{parameters}: use exr:half or exr:float")
    if block.channels != 1 or block.dtype != "float32":
        raise UsageError(f"codec exr holds heights, not {block}; use png")
    return ExrCodec(block, parameters == "half")


FACTORIES: Final[dict[str, Factory]] = {"exr": _exr}
