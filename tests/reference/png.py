"""PNG by the letter of its specification, one byte at a time: chunks, and the filters of rows there and back.

W3C, Portable Network Graphics (PNG) Specification, third edition, sections 5 (chunks), 9 (filters) and 12.7 (choice of a filter).
"""

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}
"""By colour type: grey, RGB, grey and alpha, RGB and alpha."""


@dataclass(frozen=True)
class Png:
    """A file taken apart: its filtered rows, each with the number of its filter in front."""

    columns: int
    rows: int
    bits: int
    channels: int
    filtered: list[bytes]

    @property
    def step(self) -> int:
        """Bytes per pixel."""
        return self.channels * self.bits // 8


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return the kind and content of every chunk; their check sums and the signature must be right."""
    assert data[:8] == bytes([137, 80, 78, 71, 13, 10, 26, 10])
    found, place = [], 8
    while place < len(data):
        (size,) = struct.unpack_from(">I", data, place)
        kind, content = data[place + 4 : place + 8], data[place + 8 : place + 8 + size]
        assert len(content) == size
        assert struct.unpack_from(">I", data, place + 8 + size) == (zlib.crc32(kind + content),)
        found.append((kind, content))
        place += 12 + size
    return found


def take_apart(data: bytes) -> Png:
    """Return the rows of a file of one IHDR, one IDAT and one IEND."""
    (header, ihdr), (image, idat), (end, nothing) = chunks(data)
    assert (header, image, end, nothing) == (b"IHDR", b"IDAT", b"IEND", b"")
    columns, rows, bits, colour_type, compression, filtering, interlace = struct.unpack(">IIBBBBB", ihdr)
    assert (compression, filtering, interlace) == (0, 0, 0)
    content = zlib.decompress(idat)
    size = 1 + columns * CHANNELS[colour_type] * bits // 8
    assert len(content) == rows * size
    return Png(columns, rows, bits, CHANNELS[colour_type], [content[y * size : (y + 1) * size] for y in range(rows)])


def predict(number: int, a: int, b: int, c: int) -> int:
    """Return what a filter expects of a byte from those left of it (a), above it (b), and above left (c)."""
    if number == 4:
        nearest = a + b - c
        return min((abs(nearest - a), 0, a), (abs(nearest - b), 1, b), (abs(nearest - c), 2, c))[2]
    return (0, a, b, (a + b) // 2)[number]


def unfiltered(png: Png) -> list[bytes]:
    """Return the rows as they were before they were filtered."""
    above = bytes(png.columns * png.step)
    rows = []
    for number, *differences in png.filtered:
        row = bytearray()
        for x, difference in enumerate(differences):
            left, corner = (row[x - png.step], above[x - png.step]) if x >= png.step else (0, 0)
            row.append((difference + predict(number, left, above[x], corner)) % 256)
        above = bytes(row)
        rows.append(above)
    return rows


def samples(png: Png) -> NDArray[Any]:
    """Return the samples (rows, columns, channels), uint8 or uint16, of the machine's byte order."""
    flat = np.frombuffer(b"".join(unfiltered(png)), f">u{png.bits // 8}")
    return flat.reshape(png.rows, png.columns, png.channels).astype(flat.dtype.newbyteorder("="))


def filter_row(number: int, row: bytes, above: bytes, step: int) -> bytes:
    """Return ``row`` under a filter, the filter's number in front; ``above`` is the row before it, or zeros."""
    out = bytearray([number])
    for x, value in enumerate(row):
        left, corner = (row[x - step], above[x - step]) if x >= step else (0, 0)
        out.append((value - predict(number, left, above[x], corner)) % 256)
    return bytes(out)


def best_filtered(rows: list[bytes], step: int) -> list[bytes]:
    """Return ``rows`` each under the filter with the least sum of absolute differences, the first of them if several have it."""
    above, found = bytes(len(rows[0])), []
    for row in rows:
        candidates = [filter_row(number, row, above, step) for number in range(5)]
        found.append(min(candidates, key=lambda candidate: sum(min(value, 256 - value) for value in candidate[1:])))
        above = row
    return found
