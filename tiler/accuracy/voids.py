"""How filters stand voids: from none to 95 % of the samples removed, scattered or in holes, clipmap beside GDAL's overviews."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.lattice import Registration
from tiler.accuracy import rivals
from tiler.accuracy.experiments import default_kernel, rms_of, run_cascade
from tiler.accuracy.ideal import ideal_level, interior
from tiler.accuracy.sample import Sample

Flags = NDArray[np.bool_]
Pattern = Literal["scattered", "holes"]
SHARES: Final = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.95)
_CROP: Final = 512
"""Cells along an edge: voids make every sample of the default kernel cost hundreds of multiplications."""
_ENOUGH: Final = 100
"""Fewer values say nothing about an error."""
_HOLE_WAVELENGTH: Final = 24
"""Samples from hole to hole, about."""


@dataclass(frozen=True, slots=True)
class VoidResult:
    """Level 1 of a sample of which ``share`` is void, away from the border; errors and overshoot of the samples that hold a value."""

    pattern: Pattern
    share: float
    filter: str
    hole_share: float
    """Share of level 1 without a value."""
    lost_share: float
    """Share of level 1 without a value although at least one of the samples it stands for holds one."""
    overshoot_percent: float | None
    """How far values leave the range of the samples that hold one, of that range; None where no value is left."""
    rms: float | None
    """Against the ideal level of the whole sample, over all values that are left: a filter that gives up beside voids looks better."""
    whole_rms: float | None
    """The same where the samples next to the coarse one (2 x 2 cells, 3 x 3 around a vertex) all hold a value; None for fewer than 100."""


def measure_voids(sample: Sample) -> list[VoidResult]:
    """Return the results of the default kernel and of GDAL's methods for both patterns and all shares; one channel is used."""
    side = min(_CROP, *(length // 8 * 8 for length in sample.values.shape[:2]))
    vertex = 1 if sample.registration == "point" else 0
    values = np.ascontiguousarray(sample.values[: side + vertex, : side + vertex, :1])
    exact = values.astype(np.float64)
    ideals = [ideal_level(exact, 1, registration, sample.edge) for registration in (sample.registration, "area")]
    results: list[VoidResult] = []
    for pattern in ("scattered", "holes"):
        rank = _ranks(values.shape[:2], pattern)
        for share in SHARES:
            valid = rank >= share
            if not interior(valid).any():
                continue
            results.append(_ours(sample, values, valid, ideals[0], pattern, share))
            for method in rivals.GDAL_METHODS:
                coarse, held = rivals.gdal_overview(values[:side, :side, 0], valid[:side, :side], method)
                aim = ideals[1][: side // 2, : side // 2, 0]
                near = _near(valid[:side, :side], "area")
                results.append(_result((pattern, share, f"GDAL {method}"), (coarse, held), near, aim, values[..., 0][valid]))
    return results


def _ours(
    sample: Sample, values: NDArray[np.float32], valid: Flags, ideal: NDArray[np.float64], pattern: Pattern, share: float
) -> VoidResult:
    kernel = default_kernel(sample)
    premasked = np.where(valid[..., np.newaxis], values, np.float32(0))
    coarse, coverage = run_cascade(premasked, valid.astype(np.float32), kernel, sample.edge, 1)[0]
    if coverage is None:
        raise AssertionError("a masked cascade gives coverage")
    name = f"clipmap {kernel.name} {kernel.radius}"
    near = _near(valid, sample.registration)
    return _result((pattern, share, name), (coarse[..., 0], coverage > 0), near, ideal[..., 0], values[..., 0][valid])


def _near(valid: Flags, registration: Registration) -> tuple[Flags, Flags]:
    """Return whether a sample that a coarse one stands for holds a value, and whether all of those next to it do."""
    if registration == "area":
        rows = valid[::2].astype(np.int8) + valid[1::2]
        cells = rows[:, ::2] + rows[:, 1::2]
        return cells > 0, cells == 4
    padded = np.pad(valid, 1, mode="edge")
    height, width = valid.shape
    around = [padded[dy : dy + height : 2, dx : dx + width : 2] for dy in range(3) for dx in range(3)]
    return valid[::2, ::2], np.logical_and.reduce(around)


def _result(
    what: tuple[Pattern, float, str],
    level: tuple[NDArray[np.float32], Flags],
    near: tuple[Flags, Flags],
    ideal: NDArray[np.float64],
    inputs: NDArray[np.float32],
) -> VoidResult:
    values, held = interior(level[0]), interior(level[1])
    seen, whole = interior(near[0]), interior(near[1])
    error, found = values - interior(ideal), values[held]
    low, high = float(inputs.min()), float(inputs.max())
    beyond = max(0.0, low - float(found.min()), float(found.max()) - high) if found.size else None
    return VoidResult(
        *what,
        hole_share=float(1 - held.mean()),
        lost_share=float((seen & ~held).mean()),
        overshoot_percent=None if beyond is None or high == low else 100 * beyond / (high - low),
        rms=rms_of(error[held]) if found.size else None,
        whole_rms=rms_of(error[held & whole]) if np.count_nonzero(held & whole) >= _ENOUGH else None,
    )


def _ranks(shape: tuple[int, ...], pattern: Pattern) -> NDArray[np.float64]:
    """Return a number from 0 to 1 per sample, equally distributed; samples below a share are void at that share."""
    noise = np.random.default_rng(4).standard_normal(shape)
    if pattern == "holes":
        frequency = np.hypot(np.fft.fftfreq(shape[0])[:, np.newaxis], np.fft.rfftfreq(shape[1])[np.newaxis, :])
        smooth = np.exp(-0.5 * (frequency * _HOLE_WAVELENGTH) ** 2)
        noise = np.fft.irfft2(np.fft.rfft2(noise) * smooth, s=shape)
    ranks = np.empty(noise.size)
    ranks[np.argsort(noise, axis=None)] = np.arange(noise.size) / noise.size
    return ranks.reshape(shape)
