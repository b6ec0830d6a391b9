"""What a layer of light would make and take: windows of the heights are lit by themselves, as if there were nothing around them.

So a shadow from far away is missing in a trial. That changes what is encoded, not how much: it has as many edges. Times of sweeps grow
with the number of samples, whatever these are.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.errors import NotFoundError
from schemas.estimates import BuildEstimate
from schemas.lattice import Lattice
from schemas.region import Rect
from schemas.settings import LightSettings
from tiler.building.heightlayers import build_settings
from tiler.building.light import open_light
from tiler.checking.blockreader import BlockReader, DecodedBlock
from tiler.effects.dataset import place_of_window
from tiler.estimate.build import Beside, estimate_of
from tiler.estimate.machine import PROCESS_BYTES
from tiler.estimate.standing import SeenClaim, find_standing
from tiler.estimate.trial import try_windows
from tiler.light.lightsource import LightSource
from tiler.sources import Pixels
from tiler.sources.convert import SampleSource
from tiler.stores.dataset import Dataset, read_manifest
from tiler.stores.locate import open_store

_SWEEP_BYTES: Final = 140 << 20
"""What bands of sweeps take at their peak, whatever the size of the map: two threads with 2 million samples of some 30 bytes each."""
_HEIGHT_BYTES: Final = 4
_SHARE_BYTES: Final = 2
_SUM_BYTES: Final = 4
"""Of a sample in scratch files: its height, what it sees of the sun and of the sky, and the sum of that while it is looked for."""
_THREADED: Final = frozenset({"heights", "sky"})
"""Stages that all threads work on."""


def estimate_light(
    output: str | Path,
    settings: LightSettings,
    choose: Callable[[Dataset, LightSettings], LightSettings] | None = None,
) -> BuildEstimate:
    """Return what ``build_light`` with the same arguments would make and take on this machine; writes nothing at ``output``.

    Raises UsageError, InputError or StorageError where the build would, but for what contradicts the layer that lies there: that is part
    of the answer.
    """
    store = open_store(output)
    manifest = read_manifest(store)
    if manifest is None:
        raise NotFoundError(f"{store.location}: no dataset there; build one with heights first: clipmap build DEM -o {output}")
    dataset = Dataset(store, manifest)
    chosen = settings if choose is None else choose(dataset, settings)
    plan, source, stamps = open_light(dataset, chosen)
    try:
        standing = find_standing(store, SeenClaim(store, output), output, manifest, plan, stamps, build_settings(chosen))
        threads = max(1, min(plan.workers, len(os.sched_getaffinity(0))))
        windows = _LitWindows(BlockReader(dataset, chosen.height), source)
        trial = try_windows(plan, stamps, threads, windows.open)
    finally:
        source.close()
    samples, light = plan.lattice.width * plan.lattice.height, source.simulation.light
    sky = _SHARE_BYTES * (light.sky_azimuths > 0)
    beside = Beside(
        seconds=windows.seconds_per_sample(threads) * samples,
        memory_bytes=PROCESS_BYTES + _SWEEP_BYTES,
        scratch_bytes=samples * (_HEIGHT_BYTES + _SHARE_BYTES + sky + _SUM_BYTES * (sky > 0)),
    )
    return estimate_of(plan, output, trial, standing, store.location, beside)


class _LitWindows:
    """Light on windows of a map, each as if it were all of it; counts the time that finding sun and sky takes."""

    def __init__(self, reader: BlockReader, whole: LightSource) -> None:
        self._reader, self._whole = reader, whole
        self._stages: list[tuple[int, dict[str, float]]] = []

    @contextmanager
    def open(self, window: Rect) -> Iterator[SampleSource]:
        """Give the light around a ``window`` of the map, lit by whole blocks of heights."""
        whole = self._whole
        density = whole.simulation.light.density
        part = _PartReader(self._reader, window, density)
        first = part.first
        lit = Rect(
            density * first.x0,
            density * first.y0,
            density * first.x0 + density * (part.lattice.width - 1) + 1,
            density * first.y0 + density * (part.lattice.height - 1) + 1,
        )
        # A window has one direction of the sun.
        simulation = replace(whole.simulation, place=replace(place_of_window(whole.simulation.place, lit), ground=None))
        source = LightSource(part, simulation, whole.conversion.dtype, Path(tempfile.gettempdir()), 1)
        try:
            source.bake()
            self._stages.append((lit.area, dict(source.stages_s)))
            yield _Shifted(source, whole, lit)
        finally:
            source.close()

    def seconds_per_sample(self, threads: int) -> float:
        """Return the time of all stages; the first window loads or compiles the kernels, so it counts only if there is no other."""
        timed = self._stages[1:] or self._stages
        samples = sum(area for area, _ in timed)
        total = sum(seconds / (threads if name in _THREADED else 1) for _, stages in timed for name, seconds in stages.items())
        return total / max(1, samples)


class _PartReader(BlockReader):
    """The blocks of a height layer under a window of light, as if they were a layer."""

    def __init__(self, whole: BlockReader, window: Rect, density: int) -> None:
        self.dataset, self.name, self.block, self.codec = whole.dataset, whole.name, whole.block, whole.codec
        side, all_of_it = whole.lattice.block, Rect(0, 0, whole.lattice.width, whole.lattice.height)
        heights = Rect(window.x0 // density, window.y0 // density, -(-window.x1 // density) + 1, -(-window.y1 // density) + 1)
        self._blocks = Rect(heights.x0 // side, heights.y0 // side, -(-heights.x1 // side), -(-heights.y1 // side))
        inside = Rect(self._blocks.x0 * side, self._blocks.y0 * side, self._blocks.x1 * side, self._blocks.y1 * side)
        self.first = inside & all_of_it
        self._whole = whole
        self.lattice = Lattice(self.first.width, self.first.height, side, whole.lattice.registration, whole.lattice.pad)
        layer, area = whole.layer, self.first.area
        is_masked = layer.statistics.valid < all_of_it.area
        self.layer = layer.model_copy(
            update={
                "width": self.first.width,
                "height": self.first.height,
                "statistics": layer.statistics.model_copy(update={"valid": 0 if is_masked else area}),
            }
        )

    def read_core(self, address: BlockAddress) -> DecodedBlock | None:
        """Return the core of a block of the part."""
        return self._whole.read_core(BlockAddress(0, address.x + self._blocks.x0, address.y + self._blocks.y0))


class _Shifted:
    """The light of a part, read by windows of the whole."""

    def __init__(self, source: LightSource, whole: LightSource, lit: Rect) -> None:
        self.info, self.conversion, self.masked = whole.info, whole.conversion, whole.masked
        self._source, self._lit = source, lit

    def _shift(self, window: Rect) -> Rect:
        x, y = self._lit.x0, self._lit.y0
        return Rect(window.x0 - x, window.y0 - y, window.x1 - x, window.y1 - y)

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return light and coverage, as LightSource does."""
        return self._source.read(self._shift(window))

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return light and coverage, as LightSource does."""
        return self._source.read_lean(self._shift(window))

    def begin(self) -> None:
        """Start anew what ``digest`` covers."""
        self._source.begin()

    def digest(self) -> str:
        """Return the digest of what was read."""
        return self._source.digest()

    def close(self) -> None:
        """Do nothing: the part closes itself."""
