"""From rows of a level to stored blocks: round once, cut, pad, measure, encode, store."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from schemas.address import BlockAddress
from schemas.blockindex import BLANK, BlockRecord
from schemas.errors import InputError
from schemas.lattice import Lattice
from schemas.manifest import digest
from schemas.region import Rect
from tiler.codecs import BlockFormat, Codec, Mask, Samples
from tiler.filters.cascade import Coverage, Values
from tiler.stores import Store
from tiler.tasks.destination import Destination
from tiler.tasks.measure import measure
from tiler.tasks.overlap import TaskWrites
from tiler.tasks.rounding import round_samples


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
    """Where the blocks of a layer go and in what form.

    ``unnamed``: nothing names them before their task's record does, and no two processes run a task at a time; so a part of one that
    a killed process leaves is made anew.
    """

    store: Store
    destination: Destination
    lattice: Lattice
    block: BlockFormat
    codec: Codec
    linear_light: bool = False
    unnamed: bool = False


class _Strip:
    """Rounded rows of a level, from row ``top`` on, that wait for the block row ``block_y`` to be complete.

    Rows that come when there are none stay where they are; only those that must wait are copied, to an array that is kept.

    ``whole`` are the samples of the level, ``core`` those of the task's blocks, ``padded`` those with what of their pad there is.
    """

    def __init__(self, whole: Rect, core: Rect, padded: Rect, block_y: int) -> None:
        self.whole, self.core, self.padded = whole, core, padded
        self.top, self.block_y = padded.y0, block_y
        self.rows = 0
        self._samples: Samples | None = None
        self._mask: Mask | None = None
        self._own: Samples | None = None

    def append(self, samples: Samples, mask: Mask | None, capacity: int) -> None:
        """Add rows at the bottom; ``capacity`` is how many rows there will be at most."""
        if not self.rows:
            self._samples, self._mask, self.rows = samples, mask, len(samples)
            return
        held = self._owned(max(capacity, self.rows + len(samples)))
        held[self.rows : self.rows + len(samples)] = samples
        if mask is not None or self._mask is not None:
            parts = ((self._mask, self.rows), (mask, len(samples)))
            whole = samples.shape[1]
            self._mask = np.concatenate([np.ones((rows, whole), np.bool_) if part is None else part[:rows] for part, rows in parts])
        self.rows += len(samples)

    def _owned(self, capacity: int) -> Samples:
        """Return the rows held in an array of our own that has room for ``capacity``."""
        assert self._samples is not None
        own = self._own
        if own is None or len(own) < capacity:
            own = np.empty((capacity, *self._samples.shape[1:]), self._samples.dtype)
        if own is not self._samples:
            own[: self.rows] = self._samples[: self.rows]
        self._samples = self._own = own
        return own

    def window(self, rows: slice, columns: slice) -> tuple[Samples, Mask | None]:
        """Return samples, contiguous, and mask, None if all are valid; rows count from ``top``."""
        assert self._samples is not None
        samples = np.ascontiguousarray(self._samples[rows, columns])
        return samples, None if self._mask is None else self._mask[rows, columns]

    def drop_above(self, y: int) -> None:
        """Forget the rows above ``y``."""
        assert self._samples is not None
        gone = max(0, y - self.top)
        kept = max(0, self.rows - gone)
        samples, mask = self._samples[gone : self.rows], None if self._mask is None else self._mask[gone:]
        self.top, self.rows = self.top + gone, kept
        self._samples = samples if kept else None
        self._mask = None if mask is None or mask.all() else mask
        if kept:
            self._owned(kept)  # or all that came with these rows would be held


class Cutter:
    """Takes the rows a cascade emits for one task and stores the blocks of its levels.

    ``core`` are the task's samples of level ``first_level``; rows and columns beyond it and its pad (the halo) are dropped.
    ``on_block`` is called once per finished block; ``written`` counts those whose bytes were stored. After the
    last rows ``finish`` must be called: until then blocks may be on their way.
    """

    def __init__(self, target: Target, first_level: int, core: Rect, on_block: Callable[[CutBlock], None]) -> None:
        self.times = StageTimes()
        self.written = 0
        self._target = target
        self._first_level = first_level
        self._core = core
        self._on_block = on_block
        self._strips: dict[int, _Strip] = {}
        self._writes = TaskWrites(target.store, target.unnamed)

    def finish(self) -> None:
        """Return when all blocks are stored; raises StorageError if one could not be."""
        started = perf_counter()
        self._writes.finish()
        self.times.write_s += perf_counter() - started

    def take(self, level: int, first: int, values: Values, coverage: Coverage | None, left: int) -> None:
        """Take rows ``first`` and following of ``level``, whose first column is ``left``."""
        lattice = self._target.lattice
        strip = self._strips.get(level)
        if strip is None:
            core = self._core.coarsened(level - self._first_level)
            whole = lattice.level_rect(level)
            strip = self._strips[level] = _Strip(whole, core, core.grown(lattice.pad) & whole, core.y0 // lattice.block)
        padded = strip.padded
        rows, columns = slice(max(padded.y0 - first, 0), max(padded.y1 - first, 0)), slice(padded.x0 - left, padded.x1 - left)
        part, covered = values[rows, columns], None if coverage is None else coverage[rows, columns]
        if not len(part):
            return
        held = lattice.block + 2 * lattice.pad + len(part)
        strip.append(*round_samples(part, covered, self._target.block, self._target.linear_light), held)
        self._cut_complete(level, strip)

    def _cut_complete(self, level: int, strip: _Strip) -> None:
        block, pad = self._target.lattice.block, self._target.lattice.pad
        core, padded = strip.core, strip.padded
        while strip.block_y * block < core.y1 and strip.top + strip.rows >= min((strip.block_y + 1) * block + pad, padded.y1):
            top = strip.block_y * block
            for x in range(core.x0 // block, -(-core.x1 // block)):
                whole = Rect(x * block - pad, top - pad, (x + 1) * block + pad, top + block + pad)
                seen = whole & padded
                rows, columns = slice(seen.y0 - strip.top, seen.y1 - strip.top), slice(seen.x0 - padded.x0, seen.x1 - padded.x0)
                samples, mask = strip.window(rows, columns)
                own = whole.grown(-pad) & strip.whole if pad or seen != whole else whole
                self._on_block(self._finish(BlockAddress(level, x, strip.block_y), whole, seen, own, samples, mask))
            strip.block_y += 1
            strip.drop_above(strip.block_y * block - pad)

    def _finish(self, address: BlockAddress, whole: Rect, seen: Rect, own: Rect, samples: Samples, mask: Mask | None) -> CutBlock:
        """Measure ``own``, the core's samples, encode ``whole``, the padded block, store; ``samples`` are those of ``seen``, its part."""
        target = self._target
        if address.level and target.codec.value_range is not None:
            # What the filter overshot is clipped; it is measured as readers will see it.
            lowest, highest = target.codec.value_range
            samples = np.clip(samples, np.float32(lowest), np.float32(highest))
        core, valid = samples, mask
        if own != seen:
            place = np.s_[own.y0 - seen.y0 : own.y1 - seen.y0, own.x0 - seen.x0 : own.x1 - seen.x0]
            core, valid = samples[place], None if mask is None else mask[place]
        if target.block.alpha:
            valid = core[..., -1] > 0
        count, found = measure(core, valid, samples.shape[-1] - target.block.alpha)
        if not count:
            return CutBlock(address, BLANK, (), (), ())
        minima, maxima, sums = map(tuple, found.tolist())
        low, high = min(minima), max(maxima)
        if address.level == 0:
            self._check_range(address, low, high)
        started = perf_counter()
        data = target.codec.encode(*_completed(samples, mask, seen, whole, target.block))
        encoded = perf_counter()
        record = BlockRecord(digest(data), len(data), count, low, high)
        key = target.destination.key(address, record)
        if key is not None:
            self._writes.write(key, data)
            self.written += 1
        self.times.encode_s += encoded - started
        self.times.write_s += perf_counter() - encoded
        return CutBlock(address, record, minima, maxima, sums)

    def _check_range(self, address: BlockAddress, low: float, high: float) -> None:
        """Refuse source values the codec cannot hold; a value beside the end of the range by rounding is none of them."""
        limits = self._target.codec.value_range
        if limits is None:
            return
        margin = 1e-6 * (limits[1] - limits[0])
        if low < limits[0] - margin or high > limits[1] + margin:
            raise InputError(
                f"codec {self._target.codec.spec} holds values from {limits[0]:.9g} to {limits[1]:.9g} only, but the source has "
                f"{low:.9g} to {high:.9g} in block {address}; use another scale and offset, or lerc"
            )


def _completed(samples: Samples, mask: Mask | None, seen: Rect, whole: Rect, block: BlockFormat) -> tuple[Samples, Mask | None]:
    """Fill what of ``whole`` lies outside its level by repeating the edge, never black; transparent if there is alpha, void for floats.

    Void padding is what a client must see (there is no ground), and it costs nothing: coded as ground, the repeated last row of a
    1025 x 1025 terrain takes as many bytes as a full block.
    """
    if seen == whole:
        return samples, mask
    missing = ((seen.y0 - whole.y0, whole.y1 - seen.y1), (seen.x0 - whole.x0, whole.x1 - seen.x1))
    completed = np.pad(samples, (*missing, (0, 0)), mode="edge")
    if block.alpha:
        completed[..., -1] = np.pad(samples[..., -1], missing)
    if block.dtype == "float32":
        mask = np.pad(np.ones(samples.shape[:2], np.bool_) if mask is None else mask, missing)
    return completed, mask
