"""The ``exr:float`` and ``exr:half`` codecs: OpenEXR files, for interchange with film and game tools."""

import io
import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
import OpenEXR

from schemas.errors import InputError, UsageError
from tiler.codecs import BlockFormat, Factory, Mask, Samples, checked, decoding, voids_zeroed

_HALF_MAX: Final = 65504.0
_MAGIC: Final = b"\x76\x2f\x31\x01"
_ZIP: Final = b"\x03"
_CHANNELS: Final = {1: ("Y",), 2: ("N.X", "N.Y")}
"""OpenEXR's name for brightness alone; the parts of a vector, as renderers name those of normals."""
_ZIP_ROWS: Final = 16
"""Rows that are compressed together, a chunk of the file."""


@dataclass(frozen=True, slots=True)
class ExrCodec:
    """A ZIP-compressed scan-line EXR with channel Y, or N.X and N.Y of normals, and A (1 valid, 0 void) if the block has voids.

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

    @property
    def _names(self) -> tuple[str, ...]:
        return _CHANNELS[self.block.channels]

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the EXR file of ``samples`` (side, side, channels) float32; raises InputError if half cannot hold a height."""
        samples, mask = voids_zeroed(samples, mask)
        if self.half and np.abs(samples).max() > _HALF_MAX:
            raise InputError(f"codec exr:half holds values up to {_HALF_MAX:g} only; use exr:float")
        dtype = np.float16 if self.half else np.float32
        with np.errstate(under="ignore"):
            channels = {name: np.ascontiguousarray(samples[..., place], dtype) for place, name in enumerate(self._names)}
        if mask is not None:
            channels["A"] = mask.astype(dtype)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        buffer = io.BytesIO()
        with OpenEXR.File(header, channels) as file:
            file.write(buffer)
        return buffer.getvalue()

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return (side, side, channels) float32 and mask; raises InputError if ``data`` is damaged."""
        with decoding(self.spec):
            _require_complete(data, self.block.side)
            with OpenEXR.File(io.BytesIO(data)) as file:
                pixels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
            samples = checked(np.stack([pixels[name] for name in self._names], axis=-1), self.block, self.spec)
        return voids_zeroed(samples, pixels["A"] > 0.5 if "A" in pixels else None)


def _require_complete(data: bytes, side: int) -> None:
    """Raise ValueError unless ``data`` is laid out as a whole EXR of ``side`` x ``side`` samples (OpenEXR File Layout, ILM 2013).

    OpenEXR prints on its own about a file that is cut off, and makes room for whatever size a damaged header declares.
    """
    if not data.startswith(_MAGIC):
        raise ValueError("not an EXR file")
    header, offset = _header(data)
    window = struct.pack("<4i", 0, 0, side - 1, side - 1)
    if header.get(b"dataWindow") != window or header.get(b"compression") != _ZIP:
        raise ValueError(f"not {side} x {side} samples with ZIP compression")
    chunks = -(-side // _ZIP_ROWS)
    end = offset + 8 * chunks
    for number in range(chunks):
        start = int.from_bytes(data[offset + 8 * number : offset + 8 * number + 8], "little")
        y, size = struct.unpack("<ii", data[start : start + 8]) if start == end and start + 8 <= len(data) else (-1, 0)
        end = start + 8 + size
        if y != number * _ZIP_ROWS or size <= 0 or end > len(data):
            raise ValueError(f"rows from {number * _ZIP_ROWS} on are missing")


def _header(data: bytes) -> tuple[dict[bytes, bytes], int]:
    """Return the attributes of an EXR file and where its table of chunk offsets begins."""
    attributes: dict[bytes, bytes] = {}
    place = 8
    while data[place : place + 1] not in (b"", b"\0"):
        name_end = data.index(b"\0", place)
        type_end = data.index(b"\0", name_end + 1)
        begin = type_end + 5
        size = int.from_bytes(data[type_end + 1 : begin], "little")
        attributes[data[place:name_end]] = data[begin : begin + size]
        place = begin + size
    return attributes, place + 1


def _exr(block: BlockFormat, parameters: str) -> ExrCodec:
    if parameters not in ("", "half", "float"):
        raise UsageError(f"codec exr:{parameters}: use exr:half or exr:float")
    if block.channels != (2 if block.kind == "normal" else 1) or block.dtype != "float32":
        raise UsageError(f"codec exr holds heights, not {block}; use png")
    return ExrCodec(block, parameters == "half")


FACTORIES: Final[dict[str, Factory]] = {"exr": _exr}
