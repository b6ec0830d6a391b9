"""The block index of a level: one fixed record per block, in row order.

A record is 32 bytes, little-endian: 16 bytes BLAKE2b-128 of the stored bytes (zeros if blank), uint32 number of stored
bytes (0 = blank), uint32 number of valid samples in the core, float32 minimum and maximum of the core's valid samples
over all colour channels before encoding (both 0 if blank). A reader finds a block without a search, and
tells blank from missing, size, digest and range without touching the block.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from schemas.errors import InputError

_RECORD: Final = struct.Struct("<16sIIff")
RECORD_BYTES: Final = _RECORD.size


@dataclass(frozen=True, slots=True)
class BlockRecord:
    """What the index says of one block; ``digest`` is 32 hexadecimal digits, or empty for a blank."""

    digest: str
    length_bytes: int
    valid: int
    min: float
    max: float

    @property
    def blank(self) -> bool:
        """Whether the block holds no valid sample and has no bytes."""
        return self.length_bytes == 0


BLANK: Final = BlockRecord("", 0, 0, 0.0, 0.0)


def pack_record(record: BlockRecord) -> bytes:
    """Return the 32 bytes of a record."""
    if record.blank:
        return bytes(RECORD_BYTES)
    return _RECORD.pack(bytes.fromhex(record.digest), record.length_bytes, record.valid, record.min, record.max)


class BlockIndex:
    """The records of one level, read from the bytes of its index file.

    Raises InputError if ``data`` does not hold exactly ``count`` records; ``where`` names the file in messages.
    """

    def __init__(self, data: bytes, count: int, where: str) -> None:
        if len(data) != count * RECORD_BYTES:
            raise InputError(f"{where}: has {len(data)} bytes instead of {count * RECORD_BYTES} ({count} blocks); rebuild the layer")
        self._data = data

    @property
    def data(self) -> bytes:
        """The bytes of the index file."""
        return self._data

    def __len__(self) -> int:
        return len(self._data) // RECORD_BYTES

    def __getitem__(self, number: int) -> BlockRecord:
        if not 0 <= number < len(self):
            raise IndexError(number)
        digest, length, valid, low, high = _RECORD.unpack_from(self._data, number * RECORD_BYTES)
        return BlockRecord(digest.hex(), length, valid, low, high) if length else BLANK

    def __iter__(self) -> Iterator[BlockRecord]:
        return (self[number] for number in range(len(self)))
