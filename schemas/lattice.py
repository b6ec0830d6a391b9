"""The integer geometry of all levels of a layer: sizes, block counts, windows with halo.

Every size is a Python int: pyramids of more than 2**31 samples are ordinary. Sizes follow Backes et al., "Rendering of
Large Textures", eq. 1 (padded sizes are multiples of the block side), with the quadtree anchored at the top left.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from schemas.address import BlockAddress
from schemas.errors import NotFoundError, UsageError
from schemas.region import Rect

Registration = Literal["area", "point"]
"""``area``: samples are cell centres, a coarse cell spans two fine ones. ``point``: coarse sample i sits on fine sample 2i."""

MAX_BLOCK = 4096


@dataclass(frozen=True, slots=True)
class Lattice:
    """The lattice of a layer of ``width`` by ``height`` samples, cut into blocks of ``block`` by ``block`` core samples.

    ``block`` is a power of two from 2 to 4096 samples; ``pad`` is the stored border in samples. Raises UsageError otherwise.
    """

    width: int
    height: int
    block: int = 256
    registration: Registration = "area"
    pad: int = 0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise UsageError(f"a lattice of {self.width} x {self.height} samples is empty")
        if not 2 <= self.block <= MAX_BLOCK or self.block & (self.block - 1):
            raise UsageError(f"block side {self.block}: must be a power of two from 2 to {MAX_BLOCK}")
        if self.registration not in ("area", "point"):
            raise UsageError(f"registration {self.registration!r}: must be 'area' or 'point'")
        if not 0 <= self.pad <= self.block // 2:
            raise UsageError(f"pad {self.pad}: must be between 0 and half the block side ({self.block // 2})")

    @property
    def levels(self) -> int:
        """Number of levels; the last one is a single block: ``1 + max(0, ceil(log2(max(W, H) / B)))`` in exact arithmetic."""
        return 1 + (-(-max(self.width, self.height) // self.block) - 1).bit_length()

    def level_size(self, level: int) -> tuple[int, int]:
        """(width, height) of ``level`` in samples: ``ceil(W / 2**level)``, for both registrations."""
        self._check_level(level)
        return -(-self.width >> level), -(-self.height >> level)

    def level_rect(self, level: int) -> Rect:
        """All samples of ``level``."""
        return Rect(0, 0, *self.level_size(level))

    def block_counts(self, level: int) -> tuple[int, int]:
        """(columns, rows) of blocks on ``level``."""
        width, height = self.level_size(level)
        return -(-width // self.block), -(-height // self.block)

    def padded_size(self, level: int) -> tuple[int, int]:
        """(width, height) of ``level`` rounded up to whole blocks (Backes eq. 1)."""
        columns, rows = self.block_counts(level)
        return columns * self.block, rows * self.block

    @property
    def stored_side(self) -> int:
        """Side of a stored block in samples: core plus the pad on both sides."""
        return self.block + 2 * self.pad

    def contains(self, address: BlockAddress) -> bool:
        """Whether the block exists on this lattice."""
        if not 0 <= address.level < self.levels:
            return False
        columns, rows = self.block_counts(address.level)
        return address.x < columns and address.y < rows

    def check(self, address: BlockAddress) -> BlockAddress:
        """Return ``address`` if the lattice has it, else raise NotFoundError with the valid range."""
        if not 0 <= address.level < self.levels:
            raise NotFoundError(f"level {address.level} does not exist: levels run from 0 to {self.levels - 1}")
        columns, rows = self.block_counts(address.level)
        if not self.contains(address):
            raise NotFoundError(f"block {address} lies outside level {address.level}, which has {columns} x {rows} blocks")
        return address

    def core(self, address: BlockAddress) -> Rect:
        """The samples of a block's core, padding included: always ``block`` by ``block``; may overhang the level."""
        x, y = address.x * self.block, address.y * self.block
        return Rect(x, y, x + self.block, y + self.block)

    def valid_core(self, address: BlockAddress) -> Rect:
        """The part of a block's core that holds samples of the level, without the padding beyond its right and bottom edge."""
        return self.core(address) & self.level_rect(address.level)

    def addresses(self, level: int) -> Iterator[BlockAddress]:
        """All blocks of ``level`` in row order, the order of the block index."""
        columns, rows = self.block_counts(level)
        for y in range(rows):
            for x in range(columns):
                yield BlockAddress(level, x, y)

    def block_number(self, address: BlockAddress) -> int:
        """Position of a block in the row order of its level."""
        return address.y * self.block_counts(address.level)[0] + address.x

    def _check_level(self, level: int) -> None:
        if not 0 <= level < self.levels:
            raise NotFoundError(f"level {level} does not exist: levels run from 0 to {self.levels - 1}")


def support(coarse: Rect, reach: tuple[int, int]) -> Rect:
    """Return the samples of the finer level under ``coarse`` samples whose filter reaches ``reach`` = (before, after) fine sample 2i.

    The rectangle is not clipped to the level: what lies outside it is made by the edge rule.
    """
    before, after = reach
    return Rect(2 * coarse.x0 - before, 2 * coarse.y0 - before, 2 * (coarse.x1 - 1) + after + 1, 2 * (coarse.y1 - 1) + after + 1)
