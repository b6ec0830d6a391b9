"""The levels of a layer as the windows see them: any rectangle of samples, put together from blocks.

What lies outside a level is made by replicating its edge; for heights it is marked void, so it is never drawn. Content
depends on level and sample only, never on where a window is or how it came there.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import Lattice
from schemas.manifest import Layer
from schemas.region import Rect, blocks_in
from viewer.blocks import BlockKey
from viewer.decode import Block, HeightBlock, ImageBlock

Fetch = Callable[[BlockKey], Block | None]
Planes = tuple[NDArray[Any], ...]
"""What one rectangle of samples puts into the textures, one array (height, width, channels) per texture."""
Heights = tuple[NDArray[np.float32], NDArray[np.bool_]]
"""Heights [m] and validity, (height, width)."""


class Pyramid(Protocol):
    """A layer as windows of it are filled."""

    @property
    def levels(self) -> int:
        """Number of levels."""
        ...

    def extent(self, level: int) -> Rect:
        """The samples that exist on ``level``."""
        ...

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        """Return the blocks that ``planes`` of ``rect`` needs, blank ones left out."""
        ...

    def planes(self, level: int, rect: Rect) -> Planes | None:
        """Return the contents of ``rect``, None while a block is missing."""
        ...


class HeightPyramid(Pyramid, Protocol):
    """A pyramid whose planes are (height, validity) float32 and (slope east, slope north) float16."""

    def heights(self, level: int, rect: Rect) -> Heights | None:
        """Return heights and validity of ``rect``, None while a block is missing."""
        ...


class _Assembler:
    """Puts rectangles together from the blocks of a layer, as far as the layer's own levels reach."""

    def __init__(self, name: str, layer: Layer, fetch: Fetch) -> None:
        self._name = name
        self._fetch = fetch
        self.lattice: Lattice = layer.lattice
        self._stored = [level.stored_bitmap() for level in layer.levels]

    def inside(self, level: int, rect: Rect) -> Rect:
        """The samples of the level that ``rect`` shows, its edge where ``rect`` lies beside it."""
        width, height = self.lattice.level_size(level)
        x0, x1 = min(max(rect.x0, 0), width - 1), min(max(rect.x1 - 1, 0), width - 1)
        y0, y1 = min(max(rect.y0, 0), height - 1), min(max(rect.y1 - 1, 0), height - 1)
        return Rect(x0, y0, x1 + 1, y1 + 1)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        """The stored blocks that show in ``rect``."""
        return [
            BlockKey(self._name, address)
            for address in blocks_in(self.inside(level, rect), level, self.lattice.block)
            if self._is_stored(level, self.lattice.block_number(address))
        ]

    def blocks(self, level: int, rect: Rect) -> list[tuple[Rect, Block | None]] | None:
        """Return the blocks of ``inside`` with their cores, None for blanks; None altogether while one is missing."""
        found: list[tuple[Rect, Block | None]] = []
        for address in blocks_in(rect, level, self.lattice.block):
            block = None
            if self._is_stored(level, self.lattice.block_number(address)):
                block = self._fetch(BlockKey(self._name, address))
                if block is None:
                    return None
            found.append((self.lattice.core(address), block))
        return found

    def _is_stored(self, level: int, number: int) -> bool:
        return bool(self._stored[level][number >> 3] >> (number & 7) & 1)


def _paste(target: NDArray[Any], area: Rect, core: Rect, samples: NDArray[Any]) -> None:
    part = area & core
    rows, columns = slice(part.y0 - core.y0, part.y1 - core.y0), slice(part.x0 - core.x0, part.x1 - core.x0)
    target[part.y0 - area.y0 : part.y1 - area.y0, part.x0 - area.x0 : part.x1 - area.x0] = samples[rows, columns]


def _replicated(area: Rect, rect: Rect) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return, for the rows and columns of ``rect``, the nearest ones of ``area``, counted from its corner."""
    rows = np.clip(np.arange(rect.y0, rect.y1), area.y0, area.y1 - 1) - area.y0
    columns = np.clip(np.arange(rect.x0, rect.x1), area.x0, area.x1 - 1) - area.x0
    return rows.astype(np.intp), columns.astype(np.intp)


class _HalvedLevels:
    """The levels of given ``sizes`` (width, height), and halved ones after them until one is at most ``coarsest`` samples on a side."""

    def __init__(self, sizes: list[tuple[int, int]], coarsest: int) -> None:
        self._sizes = sizes.copy()
        while max(self._sizes[-1]) > coarsest:
            width, height = self._sizes[-1]
            self._sizes.append((-(-width // 2), -(-height // 2)))

    @property
    def levels(self) -> int:
        """Number of levels, those beyond the given ones included."""
        return len(self._sizes)

    def extent(self, level: int) -> Rect:
        """The samples that exist on ``level``."""
        return Rect(0, 0, *self._sizes[level])


class BlockHeights(_HalvedLevels):
    """The heights of a layer, with levels beyond its last one until a level has at most ``coarsest`` samples on a side.

    Beyond the last stored level every second sample of it is taken: point registration puts coarse sample i on fine sample
    2i, so what is far away still lies on the surface. ``gradient`` is the 2 x 2 matrix from slopes per sample (along a row,
    along a column) to slopes per metre (east, north).
    """

    def __init__(self, name: str, layer: Layer, fetch: Fetch, gradient: NDArray[np.float64], coarsest: int) -> None:
        self._assembler = _Assembler(name, layer, fetch)
        self._gradient = gradient
        lattice = self._assembler.lattice
        self._stored_levels = lattice.levels
        super().__init__([lattice.level_size(level) for level in range(lattice.levels)], coarsest)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        """Return the stored blocks under ``rect`` and the samples next to it, which its slopes need."""
        last = self._stored_levels - 1
        if level > last:
            return self._assembler.needs(last, self._assembler.lattice.level_rect(last))
        return self._assembler.needs(level, rect.grown(1))

    def heights(self, level: int, rect: Rect) -> Heights | None:
        """Return heights and validity of ``rect``, None while a block is missing; what lies outside the level is not valid."""
        found = self._replicated(level, rect)
        return None if found is None else (found[0], found[1] & _exists(self.extent(level), rect))

    def planes(self, level: int, rect: Rect) -> Planes | None:
        """Return ((h, w, 2) float32 of height and validity, (h, w, 2) float16 of slopes), None while a block is missing."""
        around = rect.grown(1)
        found = self._replicated(level, around)
        if found is None:
            return None
        z, valid = found
        drawn = valid & _exists(_covering(self.extent(0), level), around)
        return height_planes(z, valid & _exists(self.extent(level), around), drawn, self._gradient * 0.5**level)

    def _replicated(self, level: int, rect: Rect) -> Heights | None:
        """Return heights and validity of ``rect``, both repeated beyond the level's edge."""
        stored = min(level, self._stored_levels - 1)
        step = 1 << (level - stored)
        whole = self.extent(level)
        area = self._assembler.inside(stored, rect) if step == 1 else self._assembler.lattice.level_rect(stored)
        blocks = self._assembler.blocks(stored, area)
        if blocks is None:
            return None
        z = np.zeros((area.height, area.width), np.float32)
        valid = np.zeros(z.shape, np.bool_)
        for core, block in blocks:
            if isinstance(block, HeightBlock):
                _paste(z, area, core, block.z)
                _paste(valid, area, core, block.valid)
        if step > 1:
            z, valid, area = z[::step, ::step], valid[::step, ::step], whole
        rows, columns = _replicated(area, rect)
        return z[np.ix_(rows, columns)], valid[np.ix_(rows, columns)]


class FlatHeights(_HalvedLevels):
    """Heights of 0 on a lattice of ``width`` x ``height`` samples: the ground under imagery that has no heights."""

    def __init__(self, width: int, height: int, coarsest: int) -> None:
        super().__init__([(width, height)], coarsest)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        """Nothing is ever needed."""
        return []

    def heights(self, level: int, rect: Rect) -> Heights:
        """Return zeros, valid where the level has samples."""
        return np.zeros((rect.height, rect.width), np.float32), _exists(self.extent(level), rect)

    def planes(self, level: int, rect: Rect) -> Planes:
        """Return height and validity (h, w, 2) float32, and level slopes (h, w, 2) float16."""
        around = rect.grown(1)
        z, valid = self.heights(level, around)
        return height_planes(z, valid, _exists(_covering(self.extent(0), level), around), np.eye(2))


class ImagePyramid:
    """The imagery of a layer; its planes are RGBA8 texels."""

    def __init__(self, name: str, layer: Layer, fetch: Fetch) -> None:
        self._assembler = _Assembler(name, layer, fetch)

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self._assembler.lattice.levels

    def extent(self, level: int) -> Rect:
        """The texels that exist on ``level``."""
        return self._assembler.lattice.level_rect(level)

    def needs(self, level: int, rect: Rect) -> list[BlockKey]:
        """Return the stored blocks that show in ``rect``."""
        return self._assembler.needs(level, rect)

    def planes(self, level: int, rect: Rect) -> Planes | None:
        """Return ((h, w, 4) uint8,), None while a block is missing."""
        area = self._assembler.inside(level, rect)
        blocks = self._assembler.blocks(level, area)
        if blocks is None:
            return None
        texels = np.zeros((area.height, area.width, 4), np.uint8)
        for core, block in blocks:
            if isinstance(block, ImageBlock):
                _paste(texels, area, core, block.texels)
        if area == rect:
            return (texels,)
        return (texels[np.ix_(*_replicated(area, rect))],)


def _exists(whole: Rect, rect: Rect) -> NDArray[np.bool_]:
    x, y = np.arange(rect.x0, rect.x1), np.arange(rect.y0, rect.y1)
    return ((y >= whole.y0) & (y < whole.y1))[:, None] & ((x >= whole.x0) & (x < whole.x1))[None, :]


def _covering(finest: Rect, level: int) -> Rect:
    """The samples of ``level`` whose cells cover all of level 0.

    Unless the finest size is 2**k + 1, a coarse level ends before level 0 does; one more sample, which repeats the edge, closes
    the gap. The fragment shader cuts what hangs over.
    """
    return Rect(0, 0, -(-(finest.x1 - 1) >> level) + 1, -(-(finest.y1 - 1) >> level) + 1)


def height_planes(z: NDArray[np.float32], valid: NDArray[np.bool_], drawn: NDArray[np.bool_], gradient: NDArray[np.float64]) -> Planes:
    """Return the planes of a rectangle from heights, validity, and what is drawn, of it and one sample around, (h + 2, w + 2).

    Slopes are central differences; beside a void or the layer's edge they are one-sided, and 0 between two voids.
    ``gradient`` turns slopes per sample into slopes per metre.
    """
    along_row = _difference(z[1:-1, :-2], z[1:-1, 1:-1], z[1:-1, 2:], valid[1:-1, :-2], valid[1:-1, 2:])
    along_column = _difference(z[:-2, 1:-1], z[1:-1, 1:-1], z[2:, 1:-1], valid[:-2, 1:-1], valid[2:, 1:-1])
    slopes = np.stack([along_row, along_column], axis=-1) @ gradient.T
    largest = float(np.finfo(np.float16).max)
    surface = np.stack([z[1:-1, 1:-1], drawn[1:-1, 1:-1].astype(np.float32)], axis=-1)
    with np.errstate(under="ignore"):
        return surface, np.clip(slopes, -largest, largest).astype(np.float16)


def _difference(
    before: NDArray[np.float32],
    here: NDArray[np.float32],
    after: NDArray[np.float32],
    has_before: NDArray[np.bool_],
    has_after: NDArray[np.bool_],
) -> NDArray[np.float32]:
    rise = np.where(has_after, after - here, 0) + np.where(has_before, here - before, 0)
    sides = has_after.astype(np.float32) + has_before
    return np.asarray(rise / np.maximum(sides, 1), np.float32)
