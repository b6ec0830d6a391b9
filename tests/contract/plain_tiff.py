"""TIFF files put together by hand (TIFF 6.0, section 2): any tag, any number of bits, no library that would correct them."""

import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from tests.contract.picture_files import Kind, Written, content

_SHORT, _LONG = 3, 4
MIN_IS_WHITE, MIN_IS_BLACK, RGB, PALETTE, SEPARATED = 0, 1, 2, 3, 5
ROWS_PER_STRIP = 10


def packed(pixels: NDArray[Any], bits: int) -> bytes:
    """Return whole numbers (rows, columns, channels) in ``bits`` bits each, highest first, rows filled up to whole bytes."""
    if bits == 16:
        return pixels.astype("<u2").tobytes()
    each = pixels.reshape(len(pixels), -1, 1).astype(np.uint32) >> np.arange(bits - 1, -1, -1, dtype=np.uint32) & 1
    return np.packbits(each.reshape(len(pixels), -1).astype(np.uint8), axis=1).tobytes()


def tiff_bytes(pixels: NDArray[Any], bits: int, photometric: int, deflate: bool = False, **tags: list[int]) -> bytes:
    """Return a little-endian TIFF of ``pixels`` (rows, columns, channels) in strips; ``tags`` are more of type SHORT, ``t274=[6]``."""
    height, width, channels = pixels.shape
    strips = [packed(pixels[row : row + ROWS_PER_STRIP], bits) for row in range(0, height, ROWS_PER_STRIP)]
    strips = [zlib.compress(strip) for strip in strips] if deflate else strips
    offsets = [8 + sum(map(len, strips[:number])) for number in range(len(strips))]
    fields = {
        256: (_SHORT, [width]),
        257: (_SHORT, [height]),
        258: (_SHORT, [bits] * channels),
        259: (_SHORT, [8 if deflate else 1]),
        262: (_SHORT, [photometric]),
        273: (_LONG, offsets),
        277: (_SHORT, [channels]),
        278: (_SHORT, [ROWS_PER_STRIP]),
        279: (_LONG, [len(strip) for strip in strips]),
        **{int(name[1:]): (_SHORT, numbers) for name, numbers in tags.items()},
    }
    body = b"".join(strips)
    body += bytes(len(body) % 2)
    start = 8 + len(body)
    extra_start = start + 2 + 12 * len(fields) + 4
    entries, extra = b"", b""
    for tag, (kind, numbers) in sorted(fields.items()):
        data = struct.pack(f"<{len(numbers)}{'H' if kind == _SHORT else 'I'}", *numbers)
        if len(data) <= 4:
            value = data.ljust(4, b"\0")
        else:
            value = struct.pack("<I", extra_start + len(extra))
            extra += data + bytes(len(data) % 2)
        entries += struct.pack("<HHI", tag, kind, len(numbers)) + value
    return struct.pack("<2sHI", b"II", 42, start) + body + struct.pack("<H", len(fields)) + entries + bytes(4) + extra


def few_bits(path: Path, bits: int, channels: int = 1, deflate: bool = False) -> Written:
    """Numbers of 9 to 15 bits, which are what is wanted, not 16 times as much."""
    pixels = content(channels, "uint16") >> (16 - bits)
    path.write_bytes(tiff_bytes(pixels, bits, RGB if channels == 3 else MIN_IS_BLACK, deflate))
    return Written(pixels)


def bilevel(path: Path, photometric: int) -> Written:
    ones = (content(1, "uint8") > 127).astype(np.uint8)
    path.write_bytes(tiff_bytes(ones, 1, photometric))
    return Written(np.where(ones == (photometric == MIN_IS_BLACK), 255, 0).astype(np.uint8))


def palette(path: Path, bits: int) -> Written:
    indices = content(1, "uint8") >> (8 - bits)
    table = np.random.default_rng(1).integers(0, 256, (2**bits, 3), dtype=np.uint8)
    path.write_bytes(tiff_bytes(indices, bits, PALETTE, t320=(table.T.astype(int) * 257).reshape(-1).tolist()))
    return Written(table[indices[..., 0]])


def inks(path: Path) -> Written:
    """CMYK: what is left of white after cyan, magenta, yellow and black."""
    pixels = content(4, "uint8")
    path.write_bytes(tiff_bytes(pixels, 8, SEPARATED))
    left = 1 - pixels / 255
    return Written(np.rint(255 * left[..., :3] * left[..., 3:]).astype(np.uint8), tolerance=1)


def gif(path: Path) -> Written:
    """A palette picture whose reader counts its channels from another number than its alpha."""
    indices = content(1, "uint8")[..., 0] // 32
    table = np.random.default_rng(1).integers(0, 256, (256, 3), dtype=np.uint8)
    path.write_bytes(imagecodecs.gif_encode(indices, colormap=table))
    return Written(np.dstack([table[indices], np.full_like(indices, 255)]), alpha=3)


PLAIN_KINDS = [
    *(Kind(f"tiff-{bits}-bits", "tif", "striped", partial(few_bits, bits=bits)) for bits in (10, 12, 14)),
    Kind("tiff-3x12-bits", "tif", "striped", partial(few_bits, bits=12, channels=3)),
    Kind("tiff-12-bits-deflate", "tif", "striped", partial(few_bits, bits=12, deflate=True)),
    Kind("tiff-bilevel", "tif", "striped", partial(bilevel, photometric=MIN_IS_BLACK)),
    Kind("tiff-bilevel-inverse", "tif", "striped", partial(bilevel, photometric=MIN_IS_WHITE)),
    Kind("tiff-palette-8", "tif", "striped", partial(palette, bits=8)),
    Kind("tiff-palette-4", "tif", "striped", partial(palette, bits=4)),
    Kind("tiff-cmyk", "tif", "striped", inks),
    Kind("gif-palette", "gif", "sequential", gif),
]
