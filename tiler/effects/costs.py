"""What effects cost: processor time per sample of the map on one core, for the sentence "this saves so much".

One table, so that it can be measured anew in one place: ``python -m tests.bench.effects`` prints its lines. Figures are of 2026-11-23, of
4096 x 4096 samples on one thread of an AMD EPYC with AVX-512 that others were using as well; read them as +- 30 %, and less for other
machines.
"""

from dataclasses import dataclass
from typing import Final

from schemas.effects import EffectName


@dataclass(frozen=True, slots=True)
class Cost:
    """Time per sample of the map [ns], once and for each azimuth in which horizons are looked for, and what was measured."""

    ns: float
    ns_per_azimuth: float
    source: str


ON_THE_CARD: Final = Cost(0.0, 0.0, "on the graphics card, when it is looked at")

COSTS: Final[dict[EffectName, Cost]] = {
    "shadow": Cost(4.0, 0.0, "line sweep with one line per sample, and the turns of the grid"),
    "penumbra": Cost(26.0, 0.0, "horizons that cut the disc, and what is above them, less the line sweep"),
    "sky": Cost(0.5, 60.0, "horizon with 16 exact near steps, its share of the sky: 55 to 70 ns"),
    "bounce": Cost(24.0, 0.0, "light once more, for the mean of the map"),
    "curvature_shadow": Cost(0.1, 0.0, "one multiplication and subtraction per sample and sweep"),
    "curvature_sky": Cost(0.0, 14.0, "the same per azimuth, and hulls with more corners: 10 to 19 ns, 2 at 2048 x 2048"),
    "refraction_sun": Cost(0.0, 0.0, "another angle"),
    "refraction_path": Cost(0.0, 0.0, "another radius"),
    "sun_direction": Cost(0.0, 0.0, "another angle per task"),
    "far_occluders": Cost(0.0, 0.0, "a hull stack costs the same however far it sees; what is saved is reading"),
    "normal_map": Cost(20.0, 0.0, "not measured: four samples of two channels instead of one"),
    "linear_filter": Cost(5.0, 0.0, "decoding one sample, encoding a quarter of one"),
    "haze": ON_THE_CARD,
    "geomorph": ON_THE_CARD,
    "synthesis": ON_THE_CARD,
    "curvature_view": ON_THE_CARD,
}


def cost_s(effect: EffectName, samples: int, azimuths: int) -> float:
    """Return the processor time of an effect on a map of ``samples`` samples, horizons in ``azimuths`` directions [seconds]."""
    cost = COSTS[effect]
    return samples * (cost.ns + azimuths * cost.ns_per_azimuth) * 1e-9
