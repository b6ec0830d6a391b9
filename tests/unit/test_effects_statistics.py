"""What is measured on heights, against facets taken one by one; the same bits however rows come."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas.errors import InputError, UsageError
from tests.reference import effects as reference
from tests.unit.effect_terrains import Case, cases
from tiler.effects.statistics import HeightStatistics, measure_heights
from tiler.effects.tiles import surroundings


def measured(case: Case, tile_side: int | None = None) -> HeightStatistics:
    return measure_heights([case.z], case.z.shape, case.cell, case.sun, tile_side)


def bits(found: object) -> list[bytes]:
    """Every number of the statistics, as bytes."""
    assert dataclasses.is_dataclass(found)
    parts: list[bytes] = []
    for one in dataclasses.fields(found):
        value = getattr(found, one.name)
        parts += bits(value) if dataclasses.is_dataclass(value) else [np.asarray(value).tobytes()]
    return parts


@given(case=cases(largest=40), cuts=st.lists(st.integers(0, 40), max_size=6), side=st.sampled_from([None, 1, 3, 8]))
@example(case=Case(np.zeros((1, 1)), (1.0, 1.0), 0.0, 10.0), cuts=[], side=None)
def test_any_bands_give_the_same_bits(case: Case, cuts: list[int], side: int | None) -> None:
    edges = [0, *sorted(cuts), case.z.shape[0]]
    bands = [case.z[first:last] for first, last in pairwise(edges)]
    assert bits(measure_heights(bands, case.z.shape, case.cell, case.sun, side)) == bits(measured(case, side))


@given(case=cases())
def test_no_facet_is_steeper_than_measured(case: Case) -> None:
    found = measured(case)
    assert (found.low_m, found.high_m) == (np.nanmin(case.z), np.nanmax(case.z))
    assert (found.voids > 0) == bool(np.isnan(case.z).any())
    gradients = reference.facet_gradients(case.z, case.cell)
    a, e = math.radians(case.azimuth), math.radians(case.elevation)
    for p, q in gradients:
        toward = p * math.sin(a) - q * math.cos(a)
        assert math.hypot(p, q) <= found.steepest
        assert toward <= found.toward
        assert (math.sin(e) - math.cos(e) * toward) / math.sqrt(1 + p * p + q * q) >= found.facing
    if len(gradients) and not np.isnan(case.z).any():
        assert max(math.hypot(p, q) for p, q in gradients) >= found.steepest * (1 - 1e-8)
        assert max(p * math.sin(a) - q * math.cos(a) for p, q in gradients) >= found.toward - 1e-8 * (1 + found.steepest)


@given(case=cases(voids=False))
def test_shading_sees_no_steeper_ground(case: Case) -> None:
    """Central differences, one-sided at borders, are means of facets' slopes."""
    found = measured(case)
    x, y = reference.slopes(case.z, case.cell)
    assert np.hypot(x, y).max() <= found.steepest + 1e-12
    assert reference.facing(case.z, case.cell, *case.sun).min() >= found.facing


@given(case=cases(largest=24), side=st.sampled_from([1, 2, 3, 5, 64]), azimuth=st.integers(0, 360), kind=st.sampled_from(reference.KINDS))
def test_no_horizon_is_steeper_than_a_tile_says(case: Case, side: int, azimuth: float, kind: reference.Kind) -> None:
    """Between samples that are whole, anywhere on a ray; beside voids, where it crosses the grid's lines."""
    found = measured(case, side)
    bound = surroundings(found).horizon_tan
    holed = bool(np.isnan(case.z).any())
    actual = reference.horizons(case.z, case.cell, azimuth, kind, per_row=1 if holed else 4)
    slack = 1e-9 * (1 + float(np.nanmax(np.abs(case.z)))) / min(case.cell)
    for i, j in np.ndindex(case.z.shape):
        if math.isnan(case.z[i, j]):
            continue
        # A sample on the edge of a tile belongs to either.
        for y in {min(i // side, bound.shape[0] - 1), min(max(i - 1, 0) // side, bound.shape[0] - 1)}:
            for x in {min(j // side, bound.shape[1] - 1), min(max(j - 1, 0) // side, bound.shape[1] - 1)}:
                assert actual[i, j] <= bound[y, x] + slack


def test_a_plane_is_as_steep_as_it_is() -> None:
    i, j = np.mgrid[0:200, 0:300].astype(np.float64)
    found = measure_heights([0.3 * 10 * j - 0.4 * 20 * i], (200, 300), (10.0, 20.0), (90.0, 30.0))
    assert found.steepest == pytest.approx(0.5, rel=1e-8)
    assert found.toward == pytest.approx(0.3, rel=1e-8)
    assert found.facing == pytest.approx((0.5 - math.sqrt(0.75) * 0.3) / math.sqrt(1.25), rel=1e-7)
    assert found.relief_m == pytest.approx(0.3 * 10 * 299 + 0.4 * 20 * 199)
    assert (found.tiles.side, found.tiles.low_m.shape) == (64, (4, 5))


def test_float32_heights_are_not_rounded_again() -> None:
    z = np.random.default_rng(3).normal(1e7, 1, (50, 60)).astype(np.float32)
    exact = measure_heights([z.astype(np.float64)], z.shape, (1.0, 1.0), (10.0, 10.0))
    assert bits(measure_heights([z], z.shape, (1.0, 1.0), (10.0, 10.0))) == bits(exact)


@pytest.mark.parametrize(("shape", "tiles"), [((1, 10_000_000), 65536), ((100_000, 100_000), 65536), ((4097, 4097), 4096)])
def test_there_are_never_many_tiles(shape: tuple[int, int], tiles: int) -> None:
    from tiler.effects.statistics import HeightMeter

    meter = HeightMeter(shape, (1.0, 1.0), (0.0, 10.0))
    assert meter._tiles[..., 0].size <= tiles


def test_infinite_heights_are_voids() -> None:
    z = np.zeros((5, 5))
    z[2, 2], z[0, 0] = np.inf, -np.inf
    found = measure_heights([z], z.shape, (1.0, 1.0), (0.0, 10.0))
    assert (found.low_m, found.high_m, found.steepest) == (0, 0, 0)
    assert found.voids > 0


def test_what_makes_no_sense_is_refused() -> None:
    flat = np.zeros((3, 4), np.float32)
    with pytest.raises(InputError, match="void everywhere"):
        measure_heights([np.full((3, 4), np.nan)], (3, 4), (1.0, 1.0), (0.0, 10.0))
    for bands in ([flat[:2]], [flat, flat], [flat[:, :3]], [flat.astype(np.int16)]):
        with pytest.raises(UsageError):
            measure_heights(bands, (3, 4), (1.0, 1.0), (0.0, 10.0))
    for cell, sun in (((0.0, 1.0), (0.0, 10.0)), ((1.0, math.nan), (0.0, 10.0)), ((1.0, 1.0), (math.nan, 1.0)), ((1.0, 1.0), (0.0, 91.0))):
        with pytest.raises(UsageError):
            measure_heights([flat], (3, 4), cell, sun)
