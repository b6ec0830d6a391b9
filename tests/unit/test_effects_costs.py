"""The table of what effects cost: every effect is in it, and what measures it runs."""

from typing import get_args

import pytest

from schemas.effects import EffectName
from tests.bench.effects import measure
from tiler.effects.costs import COSTS, cost_s


def test_every_effect_has_a_cost() -> None:
    assert set(COSTS) == set(get_args(EffectName))
    assert all(one.ns >= 0 and one.ns_per_azimuth >= 0 and one.source for one in COSTS.values())
    assert cost_s("sky", 10**9, 16) == pytest.approx(COSTS["sky"].ns + 16 * COSTS["sky"].ns_per_azimuth)


def test_what_measures_the_table_runs() -> None:
    rows = {row["effect"]: row for row in measure(96, 1)}
    assert set(rows) < set(COSTS)
    assert rows["sky"]["ns_per_azimuth"] > 0
    assert rows["shadow"]["ns"] > 0
