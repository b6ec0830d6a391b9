"""A layer's levels as other forms want them: stored bytes, decoded windows, and the levels beyond the last one.

Stored levels are never filtered again. Only where a form goes on below our last level (a single block) are coarser ones made,
from the last level's decoded samples, by the same cascade with the layer's own filter.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

import numpy as np

from schemas.address import BlockAddress
from schemas.errors import InputError
from schemas.region import Rect, blocks_in
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.checking.checkedread import read_block
from tiler.filters.cascade import Cascade, Coverage, Recipe, Values, halve, held_windows
from tiler.filters.kernels import DESIGNS
from tiler.samples.transfer import light_of_codes
from tiler.stores.dataset import Dataset
from tiler.tasks.rounding import round_samples

_QUEUED_PER_WORKER: Final = 2
"""Finished tiles that may wait for a slower one before them: enough to keep workers busy, and what bounds the memory."""

Task = TypeVar("Task")
Result = TypeVar("Result")


class Pyramid:
    """The levels of one layer, the stored ones and below them as many as it takes for a side of at most ``smallest`` samples.

    Safe to use from several threads. Raises what ``BlockReader`` raises, and InputError if the last level is damaged.
    """

    def __init__(self, dataset: Dataset, name: str, smallest: int) -> None:
        self.reader = BlockReader(dataset, name)
        self.layer, self.lattice, self.codec = self.reader.layer, self.reader.lattice, self.reader.codec
        self._sizes = [self.lattice.level_size(level) for level in range(self.lattice.levels)]
        while max(self._sizes[-1]) > smallest:
            self._sizes.append(halve(self._sizes[-1]))
        self._made = self._coarser() if self.levels > self.lattice.levels else []

    @property
    def levels(self) -> int:
        """Number of levels, made ones included."""
        return len(self._sizes)

    def rect(self, level: int) -> Rect:
        """All samples of ``level``."""
        return Rect(0, 0, *self._sizes[level])

    def is_stored(self, level: int) -> bool:
        """Whether ``level`` is one of the dataset's, not one made from its last."""
        return level < self.lattice.levels

    def stored_bytes(self, address: BlockAddress) -> bytes | None:
        """Return the bytes of a stored block, None for a blank; raises InputError or StorageError if they are not what the index says."""
        dataset, name = self.reader.dataset, self.reader.name
        record = dataset.record(name, address)
        return None if record.blank else read_block(dataset, name, address, record)

    def _core(self, address: BlockAddress) -> DecodedBlock | None:
        data = self.stored_bytes(address)
        if data is None:
            return None
        try:
            return self.reader.core(address, self.reader.decode(data))
        except InputError as error:
            key = self.layer.block_key(self.reader.name, address)
            raise InputError(f"{self.reader.dataset.store.location}/{key}: {error}") from error

    def window(self, level: int, wanted: Rect) -> DecodedBlock:
        """Return samples (rows, columns, channels) and validity of the part of ``wanted`` that lies on ``level``.

        Blank blocks are 0 and not valid. Raises InputError or StorageError if a block is missing or damaged.
        """
        inside = wanted & self.rect(level)
        if not self.is_stored(level):
            made = self._made[level - self.lattice.levels]
            part = _slices(inside)
            return DecodedBlock(made.samples[part], made.valid[part])
        whole = DecodedBlock(
            np.zeros((inside.height, inside.width, self.layer.channels), self.layer.dtype),
            np.zeros((inside.height, inside.width), np.bool_),
        )
        for address in blocks_in(inside, level, self.lattice.block):
            core = self._core(address)
            if core is None:
                continue
            there = self.lattice.valid_core(address)
            seen = there & inside
            source = seen.shifted(-there.x0, -there.y0)
            target = seen.shifted(-inside.x0, -inside.y0)
            into, part = _slices(target), _slices(source)
            whole.samples[into] = core.samples[part]
            whole.valid[into] = core.valid[part]
        return whole

    def _coarser(self) -> list[DecodedBlock]:
        """Make the levels below the last stored one."""
        layer, last = self.layer, self.lattice.levels - 1
        size, count = self._sizes[last], self.levels - self.lattice.levels + 1
        values, coverage = self._values(self.window(last, self.rect(last)))
        kernel = DESIGNS[layer.filter.kernel](layer.filter.radius, layer.registration)
        recipe = Recipe(kernel, layer.filter.edge, coverage is not None, layer.filter.clamp == "local")
        made: dict[int, list[DecodedBlock]] = {level: [] for level in range(count)}

        def take(level: int, first: int, values: Values, coverage: Coverage | None) -> None:
            samples, mask = round_samples(values, coverage, self.reader.block, layer.filter.linear_light)
            if self.reader.block.alpha:
                mask = samples[..., -1] > 0
            valid = np.ones(samples.shape[:2], np.bool_) if mask is None else mask
            made[level].append(DecodedBlock(np.where(valid[..., np.newaxis], samples, samples.dtype.type(0)), valid))

        windows = held_windows(size, self.rect(last), [0] * count, kernel.reach)
        Cascade(size, windows, values.shape[2], recipe, take).push(values, coverage)
        return [
            DecodedBlock(np.concatenate([part.samples for part in parts]), np.concatenate([part.valid for part in parts]))
            for level, parts in made.items()
            if level
        ]

    def _values(self, block: DecodedBlock) -> tuple[Values, Coverage | None]:
        """Return what the cascade filters: colours or heights, in linear light if the layer was filtered so, and their coverage."""
        samples, alpha = block.samples, self.reader.block.alpha
        colours = samples[..., : samples.shape[-1] - alpha]
        top = np.iinfo(samples.dtype).max if samples.dtype.kind == "u" else 1
        values = light_of_codes(top)[colours] if self.layer.filter.linear_light else colours.astype(np.float32)
        values = np.ascontiguousarray(np.where(block.valid[..., np.newaxis], values, np.float32(0)))
        if alpha:
            return values, samples[..., -1].astype(np.float32) / np.float32(top)
        return values, None if block.valid.all() else block.valid.astype(np.float32)


def _slices(rect: Rect) -> tuple[slice, slice]:
    return slice(rect.y0, rect.y1), slice(rect.x0, rect.x1)


def in_order(work: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[Result]:
    """Yield the results of ``work`` in the order of ``tasks``, from ``workers`` threads, with only a few tasks ahead of the yielded one."""
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="clipmap") as pool:
        try:
            for task in tasks:
                waiting.append(pool.submit(work, task))
                if len(waiting) > _QUEUED_PER_WORKER * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def tiles(whole: Rect, side: int) -> Iterator[Rect]:
    """Yield the squares of ``side`` samples that cover ``whole``, in row order; the last of a row or column may overhang."""
    for y in range(whole.y0, whole.y1, side):
        for x in range(whole.x0, whole.x1, side):
            yield Rect(x, y, x + side, y + side)


def tile_count(whole: Rect, side: int) -> int:
    """Return how many squares of ``side`` samples cover ``whole``."""
    return -(-whole.width // side) * -(-whole.height // side)
