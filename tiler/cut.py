"""From rows of a level to stored blocks: round once, cut, pad, measure, encode, store."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.blockindex import BLANK, BlockRecord
from schemas.errors import InputError
from schemas.lattice import Lattice
from schemas.manifest import block_key, digest
from schemas.region import Rect
from tiler.cascade import Coverage, Values
from tiler.codecs import BlockFormat, Codec, Mask, Samples
from tiler.measure import measure
from tiler.stores import Store


@dataclass(slots=True)
class StageTimes:
    """Seconds of thread time spent per stage."""

    read_s: float = 0.0
    filter_s: float = 0.0
    encode_s: float = 0.0
    write_s: float = 0.0

    def add(self, other: "StageTimes") -> None:
        """Add the seconds of another part of the build."""
        self.read_s += other.read_s
        self.filter_s += other.filter_s
        self.encode_s += other.encode_s
        self.write_s += other.write_s


@dataclass(frozen=True, slots=True)
class CutBlock:
    """What became of one block; ``minima``, ``maxima`` and ``sums`` are per colour channel over its valid samples."""

    address: BlockAddress
    record: BlockRecord
    minima: tuple[float, ...]
    maxima: tuple[float, ...]
    sums: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Target:
    """Where the blocks of a layer go and in what form."""

    store: Store
    path: str
    name: str
    lattice: Lattice
    block: BlockFormat
    codec: Codec

    def key(self, address: BlockAddress) -> str:
        """Return the store key of a block."""
        return block_key(self.path, self.name, address, self.lattice.levels, self.codec.suffix)


def round_samples(values: Values, coverage: Coverage | None, block: BlockFormat) -> tuple[Samples, Mask | None]:
    """Round float32 ``values`` (rows, columns, channels) to the stored type, once, to nearest (ties to even), within its range.

    Coverage becomes the alpha channel of imagery, or the mask of heights (True where any of the sample is covered). Colour
    under an alpha of 0 is set to 0.
    """
    if block.dtype == "float32":
        return values, None if coverage is None else coverage > 0
    dtype = np.dtype(block.dtype)
    top = np.iinfo(dtype).max
    rounded = np.clip(np.rint(values), 0, top).astype(dtype)
    if not block.alpha:
        return rounded, None
    alpha = np.full(values.shape[:2], top, dtype) if coverage is None else np.rint(coverage * np.float32(top)).astype(dtype)
    rounded[alpha == 0] = 0
    return np.concatenate([rounded, alpha[..., np.newaxis]], axis=-1), None


@dataclass(slots=True)
class _Strip:
    """Rounded rows of a level that wait for their block row to be complete."""

    samples: list[Samples] = field(default_factory=list)
    masks: list[Mask] = field(default_factory=list)


class Cutter:
    """Takes the rows a cascade emits for one task and stores the blocks of its levels.

    ``core`` are the task's samples of level ``first_level``; rows and columns outside it (the halo) are dropped. ``on_block`` is
    called once per finished block.
    """

    def __init__(self, target: Target, first_level: int, core: Rect, on_block: Callable[[CutBlock], None]) -> None:
        self.times = StageTimes()
        self._target = target
        self._first_level = first_level
        self._core = core
        self._on_block = on_block
        self._strips: dict[int, _Strip] = {}

    def take(self, level: int, first: int, values: Values, coverage: Coverage | None, left: int) -> None:
        """Take rows ``first`` and following of ``level``, whose first column is ``left``."""
        shift = level - self._first_level
        core = Rect(self._core.x0 >> shift, self._core.y0 >> shift, -(-self._core.x1 >> shift), -(-self._core.y1 >> shift))
        rows = slice(max(core.y0 - first, 0), core.y1 - first)
        columns = slice(core.x0 - left, core.x1 - left)
        values, coverage = values[rows, columns], None if coverage is None else coverage[rows, columns]
        y = max(first, core.y0)
        block = self._target.lattice.block
        done = 0
        while done < len(values):
            end = min(done + block - (y + done) % block, len(values))
            samples, mask = round_samples(values[done:end], None if coverage is None else coverage[done:end], self._target.block)
            strip = self._strips.setdefault(level, _Strip())
            strip.samples.append(samples)
            if mask is not None:
                strip.masks.append(mask)
            done = end
            if (y + done) % block == 0 or y + done == core.y1:
                self._cut_strip(level, core.x0, (y + done - 1) // block, self._strips.pop(level))

    def _cut_strip(self, level: int, x0: int, block_y: int, strip: _Strip) -> None:
        samples = np.concatenate(strip.samples)
        mask = np.concatenate(strip.masks) if strip.masks else None
        block = self._target.lattice.block
        for start in range(0, samples.shape[1], block):
            address = BlockAddress(level, (x0 + start) // block, block_y)
            part = slice(start, start + block)
            self._on_block(self._finish(address, samples[:, part], None if mask is None else mask[:, part]))

    def _finish(self, address: BlockAddress, samples: Samples, mask: Mask | None) -> CutBlock:
        target = self._target
        valid = samples[..., -1] > 0 if target.block.alpha else mask
        count, (minima, maxima, sums) = measure(samples, valid, samples.shape[-1] - target.block.alpha)
        if not count:
            return CutBlock(address, BLANK, (), (), ())
        low, high = float(minima.min()), float(maxima.max())
        started = perf_counter()
        data = target.codec.encode(*_padded(self._within_range(address, samples, low, high), mask, target.block))
        encoded = perf_counter()
        target.store.write(target.key(address), data)
        self.times.encode_s += encoded - started
        self.times.write_s += perf_counter() - encoded
        return CutBlock(address, BlockRecord(digest(data), len(data), count, low, high), _floats(minima), _floats(maxima), _floats(sums))

    def _within_range(self, address: BlockAddress, samples: Samples, low: float, high: float) -> Samples:
        """Refuse source values the codec cannot hold; clip what the filter overshot on coarser levels."""
        limits = self._target.codec.value_range
        if limits is None or (limits[0] <= low and high <= limits[1]):
            return samples
        if address.level == 0:
            raise InputError(
                f"codec {self._target.codec.spec} holds values from {limits[0]:g} to {limits[1]:g} only, but the source has "
                f"{low:g} to {high:g} in block {address}; use another scale and offset, or lerc"
            )
        return np.clip(samples, np.float32(limits[0]), np.float32(limits[1]))


def _floats(values: NDArray[np.generic]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _padded(samples: Samples, mask: Mask | None, block: BlockFormat) -> tuple[Samples, Mask | None]:
    """Fill a block that overhangs its level by repeating the edge, never black; transparent if there is alpha, void for heights.

    Void padding is what a client must see (there is no ground), and it costs nothing: coded as ground, the repeated last row of a
    1025 x 1025 terrain takes as many bytes as a full block.
    """
    rows, columns = samples.shape[:2]
    if (rows, columns) == (block.side, block.side):
        return samples, mask
    missing = ((0, block.side - rows), (0, block.side - columns))
    padded = np.pad(samples, (*missing, (0, 0)), mode="edge")
    if block.alpha:
        padded[rows:, :, -1] = 0
        padded[:, columns:, -1] = 0
    if block.kind == "height":
        mask = np.pad(np.ones((rows, columns), np.bool_) if mask is None else mask, missing)
    return padded, mask
