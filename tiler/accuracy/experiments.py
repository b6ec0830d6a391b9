"""Error and time of every kernel and rival on one sample, and what the precision of the arithmetic costs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from statistics import median
from time import process_time
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.manifest import KernelName
from schemas.region import Rect
from tiler.accuracy import plain, rivals
from tiler.accuracy.ideal import band_limited, ideal_level, interior, predicted_errors
from tiler.accuracy.response import Figures, figures
from tiler.accuracy.sample import DEFAULT_RADIUS, EXPONENT, RMS_M, Sample
from tiler.filters.cascade import Cascade, Coverage, Recipe, Values, halve
from tiler.filters.edges import EdgeRule
from tiler.filters.kernels import DESIGNS, FIXED_RADIUS, Kernel, frequency_response

Array = NDArray[np.float64]
Maker = Literal["clipmap", "numpy", "openimageio"]

RADII: Final = range(1, 9)
_SHORTEST_S: Final = 0.005
_PUSHED_ROWS: Final = 64
"""Rows that a build hands to a cascade at once."""
_LARGEST_HALF: Final = 65504.0
"""What float16 can hold."""


@dataclass(frozen=True, slots=True)
class LevelError:
    """How far a level is from the ideal one, in the sample's unit."""

    level: int
    rms: float
    p999: float
    """What 99.9 % of absolute errors do not exceed."""
    largest: float
    droop_rms: float | None = None
    """The part that comes from what the ideal level keeps (u < 0.5): detail that was weakened."""
    alias_rms: float | None = None
    """The part that comes from what it removes (u > 0.5): detail that shows at a wrong frequency."""
    rms_float64: float | None = None
    """The same kernel in float64."""
    rms_float16: float | None = None
    """The same loops on samples that were kept as float16; None where float16 cannot hold them."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One way to make coarser levels: its errors, finest level first, and the processor time of each run of one halving [s]."""

    name: str
    maker: Maker
    errors: tuple[LevelError, ...]
    times_s: tuple[float, ...]
    ms_per_megasample: float
    """Least time of one halving per million samples of the finer level; pooled over kernels that run the same loops."""
    median_ms_per_megasample: float
    kernel: KernelName | None = None
    radius: int | None = None
    figures: Figures | None = None
    predicted_droop_rms: float | None = None
    """Level 1, from the response and the known spectrum only."""
    predicted_alias_rms: float | None = None


_EVERY_SECOND: Final = "every second sample"


def run_cascade(
    values: Values, coverage: Coverage | None, kernel: Kernel, edge: EdgeRule, count: int
) -> list[tuple[Values, Coverage | None]]:
    """Return levels 1 to ``count`` (values, coverage) of ``values`` (h, w, c), by the loops that a build runs."""
    size = values.shape[1], values.shape[0]
    results: list[tuple[Values, Coverage | None]] = []
    for _ in range(count):
        size = halve(size)
        covered = None if coverage is None else np.empty(size[::-1], np.float32)
        results.append((np.empty((size[1], size[0], values.shape[2]), np.float32), covered))

    def sink(level: int, first: int, rows: Values, covered: Coverage | None) -> None:
        if level:
            target, target_coverage = results[level - 1]
            target[first : first + len(rows)] = rows
            if target_coverage is not None:
                target_coverage[first : first + len(rows)] = 1 if covered is None else covered

    _push(values, coverage, kernel, edge, count, sink)
    return results


def _push(values: Values, coverage: Coverage | None, kernel: Kernel, edge: EdgeRule, count: int, sink: Any) -> None:  # noqa: ANN401
    size = values.shape[1], values.shape[0]
    windows = [Rect(0, 0, *size)]
    for _ in range(count):
        windows.append(Rect(0, 0, *halve((windows[-1].x1, windows[-1].y1))))
    cascade = Cascade(size, windows, values.shape[2], Recipe(kernel, edge, coverage is not None), sink)
    for row in range(0, size[1], _PUSHED_ROWS):
        part = slice(row, row + _PUSHED_ROWS)
        cascade.push(values[part], None if coverage is None else coverage[part])


def default_kernel(sample: Sample) -> Kernel:
    """Return the kernel that a build takes for this kind of layer."""
    return DESIGNS["blackman-sinc"](DEFAULT_RADIUS[sample.kind], sample.registration)


def kernels_of(sample: Sample) -> dict[str, Kernel]:
    """Return all kernels to compare, by name; of those with the same taps (all of radius 1, for point registration) only the first."""
    fixed = {name: DESIGNS[name](1, sample.registration) for name in ("box", "triangle")}
    free = {
        f"{name} {radius}": design(radius, sample.registration)
        for name, design in DESIGNS.items()
        if name not in FIXED_RADIUS
        for radius in RADII
    }
    chosen: dict[tuple[float, ...], tuple[str, Kernel]] = {}
    for name, kernel in (fixed | free).items():
        chosen.setdefault(kernel.weights, (name, kernel))
    return dict(chosen.values())


def measure_candidates(sample: Sample, runs: int) -> list[Candidate]:
    """Return every kernel and rival with its errors and times; times are taken in turn, on one thread."""
    kernels = kernels_of(sample)
    times = timed(_halvings(sample, kernels), runs)
    pooled: dict[int, list[float]] = {}
    for name, kernel in kernels.items():
        pooled.setdefault(len(kernel.weights), []).extend(times[name])
    exact = sample.values.astype(np.float64)
    ideals = [ideal_level(exact, level, sample.registration, sample.edge) for level in _levels(sample)]
    bands = [band_limited(exact, level, sample.edge) for level in _levels(sample)]
    result = [
        Candidate(
            name,
            "clipmap",
            _kernel_errors(sample, kernel, ideals, bands),
            tuple(times[name]),
            *_ms_per_megasample(sample, pooled[len(kernel.weights)]),
            kernel.name,
            kernel.radius,
            figures(kernel),
            *_predicted(sample, kernel),
        )
        for name, kernel in kernels.items()
    ]
    return result + _rival_candidates(sample, times, ideals)


def _ms_per_megasample(sample: Sample, times: Sequence[float]) -> tuple[float, float]:
    return 1e3 * min(times) / sample.megasamples, 1e3 * median(times) / sample.megasamples


def _levels(sample: Sample) -> range:
    return range(1, sample.level_count + 1)


def _cells(sample: Sample) -> Values:
    """Return the samples without the last row and column of heights, so that both sides are even."""
    height, width = (length // 8 * 8 for length in sample.values.shape[:2])
    return np.ascontiguousarray(sample.values[:height, :width])


def _halvings(sample: Sample, kernels: Mapping[str, Kernel]) -> dict[str, Callable[[], Any]]:
    """Return one halving by every candidate, ready to run."""

    def discard(level: int, first: int, rows: Values, covered: Coverage | None) -> None:
        """Drop the rows: what happens to them is no part of filtering."""

    halvings: dict[str, Callable[[], Any]] = {
        name: partial(_push, sample.values, None, kernel, sample.edge, 1, discard) for name, kernel in kernels.items()
    }
    default, double = default_kernel(sample), sample.values.astype(np.float64)
    halvings[_float64_name(sample)] = lambda: plain.halved(double, default, sample.edge)
    if sample.registration == "point":
        halvings[_EVERY_SECOND] = lambda: np.ascontiguousarray(sample.values[::2, ::2])
    cells = _cells(sample)
    return halvings | {f"OpenImageIO {name}": rivals.oiio_halving(cells, name) for name in rivals.OIIO_FILTERS}


def _float64_name(sample: Sample) -> str:
    return f"blackman-sinc {DEFAULT_RADIUS[sample.kind]} in NumPy, float64"


def timed(work: Mapping[str, Callable[[], Any]], runs: int) -> dict[str, list[float]]:
    """Return the processor seconds of ``runs`` runs of each, in turn so that a disturbance hits all alike.

    Processor time is what one thread takes on a machine with nothing else to do, also where there is something else to do.
    Each follows a run of the same that is not counted: what came before leaves caches and heap in another state (25 % on the fastest).
    Work of less than 5 ms is repeated within a run, and the mean taken.
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(runs):
        for name, do in work.items():
            started = process_time()
            do()
            repeats = ceil(_SHORTEST_S / max(process_time() - started, 1e-6))
            started = process_time()
            for _ in range(repeats):
                do()
            times[name].append((process_time() - started) / repeats)
    return times


def level_error(level: int, found: NDArray[np.floating], ideal: Array, **more: float | None) -> LevelError:
    """Return the statistics of ``found - ideal`` (h, w, c) away from the border."""
    error = np.abs(interior(found.astype(np.float64) - ideal))
    return LevelError(level, rms_of(error), float(np.percentile(error, 99.9)), float(error.max()), **more)


def rms_of(error: NDArray[np.floating]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error, dtype=np.float64))))


def _kernel_errors(sample: Sample, kernel: Kernel, ideals: list[Array], bands: list[Array]) -> tuple[LevelError, ...]:
    """Return the errors of a kernel; ``bands`` are the samples without what each level cannot hold."""
    count, edge = sample.level_count, sample.edge
    found = [level for level, _ in run_cascade(sample.values, None, kernel, edge, count)]
    double = plain.levels(sample.values.astype(np.float64), kernel, edge, count)
    half = _from_half(sample, kernel)
    errors: list[LevelError] = []
    for level, ideal, band in zip(_levels(sample), ideals, bands, strict=True):
        kept = plain.levels(band, kernel, edge, level)[-1]
        errors.append(
            level_error(
                level,
                found[level - 1],
                ideal,
                droop_rms=rms_of(interior(kept - ideal)),
                alias_rms=rms_of(interior(double[level - 1] - kept)),
                rms_float64=rms_of(interior(double[level - 1] - ideal)),
                rms_float16=None if half is None else rms_of(interior(half[level - 1] - ideal)),
            )
        )
    return tuple(errors)


def _from_half(sample: Sample, kernel: Kernel) -> list[Values] | None:
    if np.abs(sample.values).max() > _LARGEST_HALF:
        return None
    rounded = sample.values.astype(np.float16).astype(np.float32)
    return [level for level, _ in run_cascade(rounded, None, kernel, sample.edge, sample.level_count)]


def _predicted(sample: Sample, kernel: Kernel) -> tuple[float | None, float | None]:
    if not sample.known_spectrum:
        return None, None
    side = sample.values.shape[0] - 1
    return predicted_errors(side, EXPONENT, RMS_M, frequency_response(kernel, 2 * np.arange(side // 2 + 1) / side))


def _rival_candidates(sample: Sample, times: Mapping[str, list[float]], ideals: list[Array]) -> list[Candidate]:
    count, exact, cells = sample.level_count, sample.values.astype(np.float64), _cells(sample)
    between: list[Array] = []
    for level in _levels(sample):
        height, width = cells.shape[0] >> level, cells.shape[1] >> level
        between.append(ideal_level(exact, level, "area", sample.edge)[:height, :width])
    found: dict[str, tuple[Maker, Sequence[NDArray[np.floating]], list[Array]]] = {
        _float64_name(sample): ("numpy", plain.levels(exact, default_kernel(sample), sample.edge, count), ideals)
    }
    if sample.registration == "point":
        found[_EVERY_SECOND] = ("numpy", [sample.values[:: 2**level, :: 2**level] for level in _levels(sample)], ideals)
    for name in rivals.OIIO_FILTERS:
        found[f"OpenImageIO {name}"] = ("openimageio", rivals.oiio_levels(cells, name, count), between)
    return [
        Candidate(
            name,
            maker,
            tuple(level_error(level, values, aim) for level, values, aim in zip(_levels(sample), levels, aims, strict=True)),
            tuple(times[name]),
            *_ms_per_megasample(sample, times[name]),
        )
        for name, (maker, levels, aims) in found.items()
    ]
