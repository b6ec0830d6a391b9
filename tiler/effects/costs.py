"""What effects cost: processor time per sample of the map on one core, for the sentence "this saves so much".

One table, so that it can be measured anew in one place. Figures are of numba kernels on 4096 x 4096 samples, minimum of several runs on one
thread of an AMD EPYC with AVX-512; read them as +- 30 %, and less for other machines.
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
    "shadow": Cost(1.0, 0.0, "line sweep, one line per sample: 0.6 to 1.5 ns"),
    "penumbra": Cost(47.0, 0.0, "horizon in the sun's azimuth with 16 exact near steps 38 ns, part of the disc 9 ns"),
    "sky": Cost(0.0, 20.0, "horizon by hull stack 14 ns, its share of the sky 6 ns"),
    "bounce": Cost(2.0, 0.0, "one product per sample once the sky's light is known"),
    "curvature_shadow": Cost(0.3, 0.0, "one multiplication and subtraction per sample and sweep"),
    "curvature_sky": Cost(0.0, 0.6, "the same per azimuth, there and back"),
    "refraction_sun": Cost(0.0, 0.0, "another angle"),
    "refraction_path": Cost(0.0, 0.0, "another radius"),
    "sun_direction": Cost(0.0, 0.0, "another angle per task"),
    "far_occluders": Cost(0.0, 0.0, "a hull stack costs the same however far it sees; what is saved is reading"),
    "normal_map": Cost(20.0, 0.0, "four samples of two channels instead of one"),
    "linear_filter": Cost(8.0, 0.0, "decoding and encoding of one sample by table"),
    "haze": ON_THE_CARD,
    "geomorph": ON_THE_CARD,
    "synthesis": ON_THE_CARD,
    "curvature_view": ON_THE_CARD,
}


def cost_s(effect: EffectName, samples: int, azimuths: int) -> float:
    """Return the processor time of an effect on a map of ``samples`` samples, horizons in ``azimuths`` directions [seconds]."""
    cost = COSTS[effect]
    return samples * (cost.ns + azimuths * cost.ns_per_azimuth) * 1e-9
