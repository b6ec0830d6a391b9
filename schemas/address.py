"""Block addresses, quadtree codes and block names.

An address is ``(level, x, y)``: level 0 is the finest, x counts columns of blocks from the left and y rows of blocks
from the top. The quadtree code is that of Tian et al., "Dual cache and quadtree" (section II-A), with the repair its
own example (122, 123, 300, 301 form a 2 x 2 square) demands: digits 0 = bottom-left, 1 = bottom-right, 2 = top-left,
3 = top-right, most significant first, y counted upwards. The father's code is the code without its last digit.
"""

import re
from dataclasses import dataclass
from typing import Final

from schemas.errors import UsageError

LAYER_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_BLOCK_NAME: Final = re.compile(
    r"(?P<layer>[a-z][a-z0-9_]*)-(?P<level>0|[1-9][0-9]{0,3})(?:-(?P<code>[0-3]{1,999}))?\.(?P<suffix>[a-z0-9]+)"
)
_QUADCODE: Final = re.compile(r"[0-3]*")


@dataclass(frozen=True, order=True, slots=True)
class BlockAddress:
    """Where a block lies in the quadtree: level (0 = finest), x from the left, y from the top, in blocks."""

    level: int
    x: int
    y: int

    def __post_init__(self) -> None:
        if self.level < 0 or self.x < 0 or self.y < 0:
            raise UsageError(f"block address {self}: level, x and y must not be negative")

    def __str__(self) -> str:
        return f"{self.level}/{self.x}/{self.y}"

    @property
    def parent(self) -> "BlockAddress":
        """The block of the next coarser level that covers this one."""
        return BlockAddress(self.level + 1, self.x >> 1, self.y >> 1)

    def children(self) -> tuple["BlockAddress", ...]:
        """The four blocks of the next finer level in row order; empty on level 0."""
        if self.level == 0:
            return ()
        x, y = 2 * self.x, 2 * self.y
        return tuple(BlockAddress(self.level - 1, x + i, y + j) for j in (0, 1) for i in (0, 1))

    def neighbours(self) -> tuple["BlockAddress", ...]:
        """The up to eight surrounding blocks of the same level with no negative coordinate, in row order."""
        return tuple(
            BlockAddress(self.level, self.x + i, self.y + j)
            for j in (-1, 0, 1)
            for i in (-1, 0, 1)
            if (i, j) != (0, 0) and self.x + i >= 0 and self.y + j >= 0
        )


def quadcode(address: BlockAddress, levels: int) -> str:
    """Return the quadtree code of ``address`` in a pyramid of ``levels`` levels.

    The code has ``levels - 1 - level`` digits, the root none (Tian et al., section II-A, as repaired above).
    Raises UsageError if the address lies outside the quadtree of ``2**(levels - 1)`` blocks on a side.
    """
    digits = levels - 1 - address.level
    if digits < 0 or address.x >> digits or address.y >> digits:
        raise UsageError(f"block {address} lies outside a quadtree of {levels} levels")
    if not digits:
        return ""
    y_up = (1 << digits) - 1 - address.y
    # Binary digits read as decimal ones add without a carry, digit by digit.
    return f"{int(f'{address.x:b}') + 2 * int(f'{y_up:b}'):0{digits}d}"


def address_of(code: str, levels: int) -> BlockAddress:
    """Return the address whose quadtree code is ``code`` in a pyramid of ``levels`` levels.

    Raises UsageError if the code has a digit other than 0 to 3 or is longer than the quadtree is deep.
    """
    if not _QUADCODE.fullmatch(code):
        raise UsageError(f"quadtree code {code!r}: only the digits 0, 1, 2 and 3 may occur")
    level = levels - 1 - len(code)
    if level < 0:
        raise UsageError(f"quadtree code {code!r} is longer than the {levels - 1} digits of a pyramid of {levels} levels")
    x = y_up = 0
    for digit in map(int, code):
        x = 2 * x + (digit & 1)
        y_up = 2 * y_up + (digit >> 1)
    return BlockAddress(level, x, (1 << len(code)) - 1 - y_up)


def block_name(layer: str, address: BlockAddress, levels: int, suffix: str) -> str:
    """Return the name of a block, ``<layer>-<level>[-<quadcode>].<suffix>``; the root block has no code."""
    if not LAYER_NAME.fullmatch(layer):
        raise UsageError(f"layer name {layer!r}: use lower-case letters, digits and underscores, a letter first")
    code = quadcode(address, levels)
    return f"{layer}-{address.level}{'-' + code if code else ''}.{suffix}"


@dataclass(frozen=True, slots=True)
class ParsedName:
    """The parts of a block name; ``levels`` is implied by the level and the length of the code."""

    layer: str
    address: BlockAddress
    levels: int
    suffix: str


def parse_block_name(name: str) -> ParsedName:
    """Split a block name into layer, address, number of levels and suffix.

    Raises UsageError if ``name`` does not have the form ``<layer>-<level>[-<quadcode>].<suffix>``.
    """
    match = _BLOCK_NAME.fullmatch(name)
    if match is None:
        raise UsageError(f"block name {name!r}: expected <layer>-<level>[-<quadcode>].<suffix>, e.g. height-2-031.lerc")
    code = match["code"] or ""
    levels = int(match["level"]) + 1 + len(code)
    return ParsedName(match["layer"], address_of(code, levels), levels, match["suffix"])
