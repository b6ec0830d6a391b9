"""Error and time of every way to find shadows, horizons, the sun's disc, the sky and the light that the ground throws back.

The reference is rays that were all walked in float64. What ``clipmap light`` runs is among the methods, by its options.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.scene import SUN_RADIUS_DEG
from tiler.accuracy.experiments import rms_of, timed
from tiler.accuracy.lightbounce import direct_light, gathered_light, local_mean
from tiler.accuracy.lightground import Ground, Margins, inner
from tiler.accuracy.lightparts import disc_by_chords, disc_points, sky_share
from tiler.accuracy.lightshipped import ShippedLight
from tiler.accuracy.lightwalk import walked_horizons, walked_lit
from tiler.light.certified import certified_shadow
from tiler.light.disc import disc_coverage
from tiler.light.frame import SunPosition, tangent_deg
from tiler.light.horizons import horizon_tangents
from tiler.light.shadow import cast_shadow
from tiler.light.sweeping import LIT

Experiment = Literal["shadow", "horizon", "disc", "sky", "bounce"]
Work = Callable[[], NDArray[Any]]
Array = NDArray[np.float64]

SUNS: Final = ((300.0, 30.0), (290.0, 10.0), (247.0, 3.0))
"""Azimuth and elevation [degrees]: none along a row, a column or a diagonal."""
LINES: Final = (1, 2, 4, 8)
STEPS: Final = (0, 1, 2, 4, 8, 16, 32)
AZIMUTHS: Final = (4, 8, 16, 32, 64)
SKY_STEPS: Final = (0, 16)
REFERENCE_AZIMUTHS: Final = 256
REFERENCE_CHORDS: Final = 31
DISC_SIDE: Final = 384
SKY_SIDE: Final = 128
"""Samples along an edge that are compared; they see all of the ground. A reference walks 31 or 256 rays from each."""
RADII: Final = (4, 16, 64, 256)
GATHERED: Final = (4, 8, 16, 32, 64)
BOUNCE_AZIMUTHS: Final = 16
"""What ``clipmap light --bounce`` looks in for the share that is ground."""
SHARE: Final = 0.15
ALBEDO: Final = 0.3
"""Light of the sky beside the sun's, and what the ground throws back of both: the command's defaults."""
_MEAN_STEPS: Final = 1024
_CODES: Final = 255


@dataclass(frozen=True, slots=True)
class LightResult:
    """One way to find one thing: its error, and the processor time of each run over all of the ground [s]."""

    experiment: Experiment
    method: str
    azimuth_deg: float | None
    elevation_deg: float | None
    unit: str
    error: float
    """Wrong samples [%] of shadows, otherwise the root of the mean square, in ``unit``."""
    p999: float | None
    """What 99.9 % of absolute errors do not exceed; None for shadows, as the next."""
    largest: float | None
    times_s: tuple[float, ...]
    ns_per_sample: float
    """Least time; ``median_ns_per_sample`` is the median."""
    median_ns_per_sample: float
    compared: int
    """Samples that were compared with the reference."""

    @property
    def place(self) -> tuple[str, float | None, float | None]:
        """What results can be compared by: experiment and sun."""
        return self.experiment, self.azimuth_deg, self.elevation_deg


def light_frontier(results: Sequence[LightResult]) -> list[LightResult]:
    """Return the results than which no other of the same experiment and sun is both faster and closer, fastest first."""
    best: dict[tuple[str, float | None, float | None], LightResult] = {}
    chosen = []
    for one in sorted(results, key=lambda one: (one.ns_per_sample, one.error)):
        if one.place not in best or one.error < best[one.place].error:
            best[one.place] = one
            chosen.append(one)
    return chosen


def measure_lights(ground: Ground, runs: int) -> list[LightResult]:
    """Return the results of all experiments; times are taken in turn within each, on one thread, over all of the ground."""
    results: list[LightResult] = []
    for azimuth, elevation in SUNS:
        results += measure_shadows(ground, SunPosition(azimuth, elevation), runs)
    results += measure_horizons(ground, SUNS[1][0], runs)
    for azimuth, elevation in SUNS:
        results += measure_discs(ground, SunPosition(azimuth, elevation), max(1, runs // 2))
    results += measure_skies(ground, max(1, runs // 5))
    for azimuth, elevation in SUNS:
        results += measure_bounces(ground, SunPosition(azimuth, elevation), max(1, runs // 5))
    return results


def measure_shadows(ground: Ground, sun: SunPosition, runs: int) -> list[LightResult]:
    """Return the results of sweeps with more and more lines, of the certified one, and of walks from every sample."""
    heights, cell = ground.heights_m, ground.cell_m
    work: dict[str, Work] = {_lines(lines): partial(cast_shadow, heights, cell, sun, lines=lines) for lines in LINES}
    work["certified"] = partial(certified_shadow, heights, cell, sun)
    shipped = ShippedLight(ground)
    work |= {"clipmap light --hard": partial(shipped.hard, sun, 1), "clipmap light --certified": partial(shipped.hard, sun, None)}
    slow: dict[str, Work] = {
        "march, nearest sample": partial(walked_lit, ground, sun, nearest=True),
        "march, interpolated": partial(walked_lit, ground, sun),
    }
    margins = ground.margins(max(heights.shape))
    expected = walked_lit(ground, sun, margins)
    times, found = _timed(work, runs, slow)
    results = []
    for name, codes in found.items():
        wrong = (inner(codes.astype(np.float32), margins) == LIT) != expected
        results.append(_result("shadow", name, sun, "% wrong", (100 * float(wrong.mean()), None, None), times[name], ground, wrong.size))
    return results


def _lines(lines: int) -> str:
    return f"sweep, {lines} line" + ("s" if lines > 1 else "")


def measure_horizons(ground: Ground, azimuth_deg: float, runs: int) -> list[LightResult]:
    """Return the results of hulls with more and more exact steps, and of walks; errors in degrees."""
    sweep = partial(horizon_tangents, ground.heights_m, ground.cell_m, azimuth_deg)
    work: dict[str, Work] = {f"hulls, {steps} exact steps": partial(sweep, near_steps=steps) for steps in STEPS}
    slow: dict[str, Work] = {
        "march, nearest sample": partial(walked_horizons, ground, azimuth_deg, nearest=True),
        "march, interpolated": partial(walked_horizons, ground, azimuth_deg),
    }
    margins = ground.margins(max(ground.heights_m.shape))
    expected = _degrees(walked_horizons(ground, azimuth_deg, margins))
    times, found = _timed(work, runs, slow)
    sun = (azimuth_deg, None)
    return [
        _compared("horizon", name, sun, "degrees", _degrees(inner(tangents, margins)), expected, times, ground)
        for name, tangents in found.items()
    ]


def _degrees(tangents: NDArray[np.floating]) -> Array:
    angles: Array = np.degrees(np.arctan(tangents.astype(np.float64)))
    return angles


def measure_discs(ground: Ground, sun: SunPosition, runs: int) -> list[LightResult]:
    """Return the results of hard shadows, of several of them spread over the disc, and of horizons; errors in 8-bit codes."""
    margins = ground.margins(DISC_SIDE)
    floor = tangent_deg(sun.elevation_deg - SUN_RADIUS_DEG)
    expected = disc_by_chords(lambda azimuth: walked_horizons(ground, azimuth, margins, floor=floor), sun, REFERENCE_CHORDS)
    work: dict[str, Work] = {f"{count} hard shadows": partial(_hard_mean, ground, sun, count) for count in (4, 16)}
    work = {"1 hard shadow": partial(_hard_mean, ground, sun, 1)} | work
    for steps in STEPS:
        work[f"1 horizon, {steps} exact steps"] = partial(_one_horizon, ground, sun, steps)
    work["clipmap light --soft"] = partial(ShippedLight(ground).soft, sun)
    work["3 horizons, 16 exact steps"] = partial(disc_by_chords, _swept(ground, 16), sun, 3)
    return _in_codes("disc", (sun.azimuth_deg, sun.elevation_deg), work, margins, expected, runs, ground)


def _hard_mean(ground: Ground, sun: SunPosition, count: int) -> NDArray[np.float32]:
    total = np.zeros(ground.heights_m.shape, np.float32)
    for point in disc_points(sun, count) if count > 1 else [sun]:
        total += cast_shadow(ground.heights_m, ground.cell_m, point)
    return total / np.float32(count)


def _one_horizon(ground: Ground, sun: SunPosition, steps: int) -> NDArray[np.float32]:
    return disc_coverage(horizon_tangents(ground.heights_m, ground.cell_m, sun.azimuth_deg, near_steps=steps), sun.elevation_deg)


def _swept(ground: Ground, steps: int) -> Callable[[float], NDArray[np.float32]]:
    return lambda azimuth: horizon_tangents(ground.heights_m, ground.cell_m, azimuth, near_steps=steps)


def measure_skies(ground: Ground, runs: int) -> list[LightResult]:
    """Return the results of more and more azimuths; errors in 8-bit codes, if open ground under the whole sky is 255."""
    margins, slopes = ground.margins(SKY_SIDE), ground.slopes()
    inner_slopes = (np.ascontiguousarray(inner(slopes[0], margins)), np.ascontiguousarray(inner(slopes[1], margins)))
    expected = sky_share(lambda azimuth: walked_horizons(ground, azimuth, margins, floor=0.0), inner_slopes, REFERENCE_AZIMUTHS)
    work: dict[str, Work] = {
        f"{count} azimuths, {steps} exact steps": partial(sky_share, _swept(ground, steps), slopes, count)
        for steps in SKY_STEPS
        for count in AZIMUTHS
    }
    shipped = ShippedLight(ground)
    work |= {f"clipmap light --sky {count}": partial(shipped.sky, count) for count in AZIMUTHS}
    return _in_codes("sky", (None, None), work, margins, expected, runs, ground)


def measure_bounces(ground: Ground, sun: SunPosition, runs: int) -> list[LightResult]:
    """Return the results of nothing, means of all or of near ground, and of rays; errors in 8-bit codes of light.

    All are given the direct light of all ground; their time is what then has to be added, the horizons of ``BOUNCE_AZIMUTHS`` included.
    """
    margins, shipped = ground.margins(SKY_SIDE), ShippedLight(ground)
    codes = certified_shadow(ground.heights_m, ground.cell_m, sun)
    light = direct_light(ground, sun, codes, shipped.sky(AZIMUTHS[-1]), SHARE)
    unit = ALBEDO / (1 + SHARE)
    expected = unit * gathered_light(ground, light, margins, REFERENCE_AZIMUTHS)

    def filled(bounced: Callable[[], Array | float]) -> Array:
        ground_share: Array = 1.0 - shipped.sky(BOUNCE_AZIMUTHS).astype(np.float64)
        return unit * ground_share * bounced()

    work: dict[str, Work] = {
        "none": lambda: np.zeros(light.shape),
        "clipmap light --bounce": lambda: filled(lambda: round(float(light.mean()) * _MEAN_STEPS) / _MEAN_STEPS),
    }
    for radius in RADII:
        work[f"mean within {radius}"] = partial(filled, partial(local_mean, light, radius))
    rays: dict[str, Work] = {
        f"{count} azimuths of rays": partial(lambda count: unit * gathered_light(ground, light, margins, count), count)
        for count in GATHERED
    }
    times, found = _timed(work, runs, rays)
    scale = light.size / expected.size
    times |= {name: [scale * seconds for seconds in times[name]] for name in rays}
    cropped: dict[str, Array] = {name: share if name in rays else inner(share, margins).astype(np.float64) for name, share in found.items()}
    place = (sun.azimuth_deg, sun.elevation_deg)
    return [_compared("bounce", name, place, "codes", _CODES * share, _CODES * expected, times, ground) for name, share in cropped.items()]


def _in_codes(
    experiment: Experiment,
    sun: tuple[float | None, float | None],
    work: Mapping[str, Work],
    margins: Margins,
    expected: Array,
    runs: int,
    ground: Ground,
) -> list[LightResult]:
    times, found = _timed(work, runs, {})
    return [
        _compared(experiment, name, sun, "codes", _CODES * inner(share, margins).astype(np.float64), _CODES * expected, times, ground)
        for name, share in found.items()
    ]


def _timed(work: Mapping[str, Work], runs: int, slow: Mapping[str, Work]) -> tuple[dict[str, list[float]], dict[str, NDArray[Any]]]:
    """Return the times of all work, of ``slow`` once, and what it gave."""
    found: dict[str, NDArray[Any]] = {}

    def keep(name: str, do: Work) -> None:
        found[name] = do()

    quick_times = timed({name: partial(keep, name, do) for name, do in work.items()}, runs)
    return quick_times | timed({name: partial(keep, name, do) for name, do in slow.items()}, 1), found


def _compared(
    experiment: Experiment,
    name: str,
    sun: tuple[float | None, float | None],
    unit: str,
    found: Array,
    expected: Array,
    times: Mapping[str, Sequence[float]],
    ground: Ground,
) -> LightResult:
    error = np.abs(found - expected)
    figures = rms_of(error), float(np.percentile(error, 99.9)), float(error.max())
    return _result(experiment, name, sun, unit, figures, times[name], ground, error.size)


def _result(
    experiment: Experiment,
    name: str,
    sun: SunPosition | tuple[float | None, float | None],
    unit: str,
    figures: tuple[float, float | None, float | None],
    times_s: Sequence[float],
    ground: Ground,
    compared: int,
) -> LightResult:
    azimuth, elevation = (sun.azimuth_deg, sun.elevation_deg) if isinstance(sun, SunPosition) else sun
    scale = 1e9 / ground.heights_m.size
    return LightResult(
        experiment, name, azimuth, elevation, unit, *figures, tuple(times_s), scale * min(times_s), scale * median(times_s), compared
    )
