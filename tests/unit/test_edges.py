"""What a filter sees beyond the edge, against the rules' own words: one reflection after the other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tiler.filters.edges import EdgeRule, extend

Line = NDArray[np.float64]


def antisymmetric(lines: list[Line], index: int) -> Line:
    """z[-k] = 2 z[0] - z[k] and z[n-1+k] = 2 z[n-1] - z[n-1-k], until inside; a single line is repeated."""
    last = len(lines) - 1
    if last == 0 or 0 <= index <= last:
        return lines[min(max(index, 0), last)]
    if index < 0:
        return 2 * lines[0] - antisymmetric(lines, -index)
    return 2 * lines[last] - antisymmetric(lines, 2 * last - index)


def mirror(lines: list[Line], index: int) -> Line:
    """z[-1-k] = z[k] and z[n+k] = z[n-1-k], until inside."""
    if index < 0:
        return mirror(lines, -1 - index)
    return lines[index] if index < len(lines) else mirror(lines, 2 * len(lines) - 1 - index)


def mirror_sample(lines: list[Line], index: int) -> Line:
    """z[-k] = z[k] and z[n-1+k] = z[n-1-k], until inside; a single line is repeated."""
    last = len(lines) - 1
    if last == 0 or 0 <= index <= last:
        return lines[min(max(index, 0), last)]
    return mirror_sample(lines, -index if index < 0 else 2 * last - index)


RULES = {"antisymmetric": antisymmetric, "mirror": mirror, "mirror-sample": mirror_sample}


def lines_needed(size: int, index: int) -> set[int]:
    """The lines an antisymmetric extension is made of."""
    last = size - 1
    if last == 0 or 0 <= index <= last:
        return {min(max(index, 0), last)}
    return {0 if index < 0 else last} | lines_needed(size, -index if index < 0 else 2 * last - index)


def lines(size: int, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).integers(-1000, 9000, (size, 5, 2)).astype(np.float32)


@pytest.mark.parametrize("rule", RULES)
@given(size=st.integers(1, 12), start=st.integers(-40, 40), length=st.integers(1, 20))
def test_extension_is_the_definition(rule: EdgeRule, size: int, start: int, length: int) -> None:
    """Whole numbers, so that sums in any order are exact; up to five reflections."""
    values = lines(size)
    indices = range(start, start + length)
    found, coverage = extend(values, None, rule=rule, size=size, origin=0, indices=indices)
    plain = [line.astype(np.float64) for line in values]
    expected = np.stack([RULES[rule](plain, index) for index in indices])
    assert coverage is None
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("rule", RULES)
@given(size=st.integers(1, 9), start=st.integers(-30, 30), length=st.integers(1, 12))
def test_an_extended_line_is_as_covered_as_the_least_of_its_lines(rule: EdgeRule, size: int, start: int, length: int) -> None:
    cover = np.random.default_rng(1).choice(np.array([0, 0.25, 1], np.float32), (size, 5))
    kept = cover.copy()
    indices = range(start, start + length)
    _, found = extend(lines(size), cover, rule=rule, size=size, origin=0, indices=indices)
    assert found is not None
    np.testing.assert_array_equal(cover, kept, "the input was changed")
    for place, index in enumerate(indices):
        if rule != "antisymmetric":
            expected = RULES[rule]([line.astype(np.float64) for line in cover], index)
        else:
            expected = np.min([cover[line] for line in lines_needed(size, index)], axis=0)
        np.testing.assert_array_equal(found[place], expected)


@pytest.mark.parametrize("rule", RULES)
def test_only_the_lines_near_the_edge_need_be_at_hand(rule: EdgeRule) -> None:
    """At either edge of a level of 100 lines, from the 12 lines next to it."""
    values = lines(100)
    near, _ = extend(values[:12], None, rule=rule, size=100, origin=0, indices=range(-9, 0))
    far, _ = extend(values[88:], None, rule=rule, size=100, origin=88, indices=range(100, 109))
    np.testing.assert_array_equal(near, extend(values, None, rule=rule, size=100, origin=0, indices=range(-9, 0))[0])
    np.testing.assert_array_equal(far, extend(values, None, rule=rule, size=100, origin=0, indices=range(100, 109))[0])


@given(size=st.integers(2, 9), start=st.integers(-30, 30))
def test_a_ramp_goes_on_for_ever(size: int, start: int) -> None:
    ramp = (8848 + 30 * np.arange(size, dtype=np.float32))[:, np.newaxis, np.newaxis]
    found, _ = extend(ramp, None, rule="antisymmetric", size=size, origin=0, indices=range(start, start + 5))
    assert found[:, 0, 0].tolist() == [8848 + 30 * index for index in range(start, start + 5)]


@pytest.mark.parametrize("rule", ["mirror", "mirror-sample"])
@given(size=st.integers(1, 9), start=st.integers(-30, 30))
def test_a_mirror_never_leaves_the_range_of_the_picture(rule: EdgeRule, size: int, start: int) -> None:
    values = lines(size)
    found, _ = extend(values, None, rule=rule, size=size, origin=0, indices=range(start, start + 9))
    assert {line.tobytes() for line in found} <= {line.tobytes() for line in values}


@pytest.mark.parametrize("rule", RULES)
def test_a_single_line_is_repeated(rule: EdgeRule) -> None:
    values = lines(1)
    found, _ = extend(values, None, rule=rule, size=1, origin=0, indices=range(-5, 6))
    assert (found == values[0]).all()


def test_sums_are_rounded_once() -> None:
    """2 * 16777215 - 16777213 has no room for its parts in float32 but is itself exact."""
    values = np.array([16777215, 16777213], np.float32)[:, np.newaxis, np.newaxis]
    found, _ = extend(values, None, rule="antisymmetric", size=2, origin=0, indices=range(-1, 0))
    assert found.item() == np.float32(16777217)


def test_slopes_of_heights_that_go_on_antisymmetrically_are_mirrored_at_the_sample() -> None:
    """Why normals and light have this rule: theirs are those of the continued heights."""
    heights = lines(12)
    beyond, _ = extend(heights, None, rule="antisymmetric", size=12, origin=0, indices=range(-9, 21))
    slopes = (beyond[2:] - beyond[:-2]) / 2
    inside = slopes[8:20].astype(np.float32)
    found, _ = extend(inside, None, rule="mirror-sample", size=12, origin=0, indices=range(-8, 20))
    np.testing.assert_array_equal(found, slopes)
