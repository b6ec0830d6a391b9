"""What is proved of light holds for the kernels that simulate it."""

import numpy as np
from hypothesis import given, settings

from tests.unit.effect_terrains import Case, cases
from tiler.effects.statistics import measure_heights
from tiler.effects.tiles import lit_tiles, surroundings
from tiler.light.certified import certified_shadow
from tiler.light.frame import SunPosition
from tiler.light.horizons import horizon_tangents
from tiler.light.sweeping import SHADED


@settings(max_examples=200)
@given(case=cases(largest=24))
def test_certified_shadows_and_horizons_keep_to_the_bounds(case: Case) -> None:
    """Certified, as a sweep with few lines per sample shades some samples of a narrow valley that are lit: 7 terrains of 1722."""
    z = case.z.astype(np.float32)
    found = measure_heights([z], (z.shape[0], z.shape[1]), case.cell, case.sun, 3)
    if lit_tiles(found, case.elevation, 0.0).all():
        assert not (certified_shadow(z, case.cell, SunPosition(*case.sun)) == SHADED).any()
    steepest = float(np.nanmax(horizon_tangents(z, case.cell, case.azimuth)))
    slack = 1e-6 * (1 + float(np.nanmax(np.abs(z)))) / min(case.cell)
    assert steepest <= float(surroundings(found).horizon_tan.max()) * (1 + 1e-5) + slack
