"""How two datasets differ: in what their manifests say, in stored bytes, in decoded samples."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import fsum, sqrt
from os import cpu_count
from typing import Any, Final

import numpy as np
from pydantic import JsonValue

from schemas.address import BlockAddress
from schemas.findings import DiffReport, FieldDifference, LayerDifference, LevelDifference
from schemas.manifest import Layer
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.stores.dataset import Dataset
from tiler.tasks.engine import run_tasks

Progress = Callable[[int, int], None]
"""Called with (differing blocks decoded, differing blocks in all)."""

_NAMED_BLOCKS: Final = 4
_BATCH_BLOCKS: Final = 16


def diff(a: Dataset, b: Dataset, workers: int | None = None, on_progress: Progress = lambda done, total: None) -> DiffReport:
    """Compare two datasets; where blocks lie (``path``) and which program wrote them do not count.

    Blocks are compared by the digests in the indexes; only those that differ are read and decoded. Raises InputError or
    NotFoundError if an index or one of these blocks is damaged or missing.
    """
    common = [name for name in a.manifest.layers if name in b.manifest.layers]
    pairs = [_LayerPair(a, b, name) for name in common]
    total, done = sum(pair.to_decode for pair in pairs), 0
    for pair in pairs:
        for count in pair.decode(workers or cpu_count() or 1):
            done += count
            on_progress(done, total)
    world = field_differences(a.manifest.world.model_dump(mode="json"), b.manifest.world.model_dump(mode="json"))
    only_in_a = [name for name in a.manifest.layers if name not in b.manifest.layers]
    only_in_b = [name for name in b.manifest.layers if name not in a.manifest.layers]
    layers = [pair.difference() for pair in pairs]
    return DiffReport(
        a=a.store.location,
        b=b.store.location,
        version_a=a.manifest.version,
        version_b=b.manifest.version,
        same=not (
            world or only_in_a or only_in_b or any(layer.fields or any(level.differing for level in layer.levels) for layer in layers)
        ),
        world=world,
        only_in_a=only_in_a,
        only_in_b=only_in_b,
        layers=layers,
    )


def field_differences(a: dict[str, Any], b: dict[str, Any], prefix: str = "") -> list[FieldDifference]:
    """Return the fields of two JSON objects with the same keys that differ, those of nested objects with dots in their names."""
    found = []
    for name, value in a.items():
        if isinstance(value, dict) and isinstance(b[name], dict):
            found += field_differences(value, b[name], f"{prefix}{name}.")
        elif value != b[name]:
            found.append(FieldDifference(field=prefix + name, a=value, b=b[name]))
    return found


@dataclass(frozen=True, slots=True)
class _BlockDifference:
    """How one decoded block differs: squares are summed over all channels of samples valid in both."""

    largest: float
    squares: float
    numbers: int
    valid_in_one: int


class _LayerPair:
    """One layer in two datasets: finds the differing blocks when it is made, decodes them when told to."""

    def __init__(self, a: Dataset, b: Dataset, name: str) -> None:
        self._a, self._b, self._name = a, b, name
        layers = a.manifest.layer(name), b.manifest.layer(name)
        self._levels = [level.level for level in layers[0].levels] if _frame(layers[0]) == _frame(layers[1]) else []
        self._differing = {level: self._find_differing(level) for level in self._levels}
        self._not_compared = _why_not_compared(*layers)
        self._found: dict[int, list[_BlockDifference]] = {level: [] for level in self._levels}
        self.to_decode = 0 if self._not_compared else sum(map(len, self._differing.values()))

    def _find_differing(self, level: int) -> list[BlockAddress]:
        layer = self._a.manifest.layer(self._name)
        if layer.levels[level].index == self._b.manifest.layer(self._name).levels[level].index:
            return []
        records = zip(self._a.index(self._name, level), self._b.index(self._name, level), strict=True)
        return [
            address for address, (one, other) in zip(layer.lattice.addresses(level), records, strict=True) if one.digest != other.digest
        ]

    def decode(self, workers: int) -> Iterator[int]:
        """Decode and compare the differing blocks; yields how many as they are done."""
        if not self.to_decode:
            return
        readers = BlockReader(self._a, self._name), BlockReader(self._b, self._name)

        def compare(batch: list[BlockAddress]) -> tuple[int, list[_BlockDifference]]:
            return batch[0].level, [_compared(*(reader.read_core(address) for reader in readers)) for address in batch]

        batches = (
            addresses[first : first + _BATCH_BLOCKS]
            for addresses in self._differing.values()
            for first in range(0, len(addresses), _BATCH_BLOCKS)
        )
        for level, found in run_tasks(compare, batches, workers):
            self._found[level] += found
            yield len(found)

    def difference(self) -> LayerDifference:
        """Return what was found."""
        contents = [_fields(dataset.manifest.layer(self._name)) for dataset in (self._a, self._b)]
        return LayerDifference(
            layer=self._name,
            fields=field_differences(contents[0], contents[1]),
            not_compared=self._not_compared,
            levels=[self._level(level) for level in self._levels],
        )

    def _level(self, level: int) -> LevelDifference:
        differing, found = self._differing[level], self._found[level]
        entry = self._a.manifest.layer(self._name).levels[level]
        numbers = sum(block.numbers for block in found)
        return LevelDifference(
            level=level,
            blocks=entry.columns * entry.rows,
            differing=len(differing),
            first=[str(address) for address in differing[:_NAMED_BLOCKS]],
            largest=max(block.largest for block in found) if numbers else None,
            rms=sqrt(fsum(block.squares for block in found) / numbers) if numbers else None,
            valid_in_one=None if self._not_compared else sum(block.valid_in_one for block in found),
        )


def _frame(layer: Layer) -> tuple[int, int, int, str]:
    return layer.width, layer.height, layer.block, layer.registration


def _why_not_compared(a: Layer, b: Layer) -> str | None:
    if _frame(a) != _frame(b):
        return "the lattices differ"
    if (a.channels, a.alpha, a.dtype, a.kind) != (b.channels, b.alpha, b.dtype, b.kind):
        return "the samples are of different types"
    return None


def _fields(layer: Layer) -> dict[str, JsonValue]:
    return layer.model_dump(mode="json", exclude={"path", "patches", "levels"})


def _compared(a: DecodedBlock | None, b: DecodedBlock | None) -> _BlockDifference:
    """Compare two decoded cores; None is a blank."""
    if a is None or b is None:
        stored = a or b
        return _BlockDifference(0.0, 0.0, 0, 0 if stored is None else int(stored.valid.sum()))
    both = a.valid & b.valid
    distance = a.samples[both].astype(np.float64) - b.samples[both].astype(np.float64)
    largest = float(np.abs(distance).max(initial=0.0))
    return _BlockDifference(largest, float(np.square(distance).sum()), distance.size, int((a.valid ^ b.valid).sum()))
