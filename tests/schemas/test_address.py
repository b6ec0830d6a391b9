"""Addresses, quadtree codes and block names, against a quadtree that is grown by hand, square by square."""

import random
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas.address import BlockAddress, ParsedName, address_of, block_name, parse_block_name, quadcode
from schemas.errors import UsageError

MAX_LEVELS = 40


def grown_quadtree(depth: int) -> list[dict[str, tuple[int, int]]]:
    """Every square of a full quadtree by its code, as (x, y counted UPWARDS), one dictionary per number of digits."""
    trees = [{"": (0, 0)}]
    for _ in range(depth):
        trees.append(
            {
                code + digit: (2 * x + right, 2 * y + up)
                for code, (x, y) in trees[-1].items()
                for digit, right, up in (("0", 0, 0), ("1", 1, 0), ("2", 0, 1), ("3", 1, 1))
            }
        )
    return trees


@st.composite
def addresses(draw: st.DrawFn) -> tuple[BlockAddress, int]:
    levels = draw(st.integers(1, MAX_LEVELS))
    level = draw(st.integers(0, levels - 1))
    side = 2 ** (levels - 1 - level)
    return BlockAddress(level, draw(st.integers(0, side - 1)), draw(st.integers(0, side - 1))), levels


@pytest.mark.parametrize("depth", range(9))
def test_every_block_of_a_full_quadtree(depth: int) -> None:
    levels = depth + 1
    for digits, squares in enumerate(grown_quadtree(depth)):
        assert len(squares) == 4**digits
        for code, (x, y_up) in squares.items():
            address = BlockAddress(depth - digits, x, 2**digits - 1 - y_up)
            assert quadcode(address, levels) == code
            assert address_of(code, levels) == address
            name = block_name("imagery", address, levels, "jpg")
            assert name == (f"imagery-{depth - digits}-{code}.jpg" if code else f"imagery-{depth}.jpg")
            assert parse_block_name(name) == ParsedName("imagery", address, levels, "jpg")


@given(addresses())
@example((BlockAddress(0, 2**39 - 1, 0), 40))
def test_round_trips_in_deep_quadtrees(case: tuple[BlockAddress, int]) -> None:
    address, levels = case
    code = quadcode(address, levels)
    assert len(code) == levels - 1 - address.level
    assert address_of(code, levels) == address
    assert parse_block_name(block_name("h_1", address, levels, "lerc")) == ParsedName("h_1", address, levels, "lerc")


@given(st.text("0123", max_size=MAX_LEVELS - 1), st.integers(0, 5))
def test_every_code_is_the_code_of_its_address(code: str, extra: int) -> None:
    levels = len(code) + 1 + extra
    assert quadcode(address_of(code, levels), levels) == code


def test_tians_example() -> None:
    """Tian et al. II-A: 122, 123, 300 and 301 form a square of 2 x 2 blocks; x and y counted from the bottom left."""
    from_bottom_left = {"122": (4, 3), "123": (5, 3), "300": (4, 4), "301": (5, 4)}
    for code, (x, y_up) in from_bottom_left.items():
        assert address_of(code, 4) == BlockAddress(0, x, 7 - y_up)
        assert quadcode(BlockAddress(0, x, 7 - y_up), 4) == code


def test_digits_of_the_four_quadrants() -> None:
    corners = {"2": (0, 0), "3": (1, 0), "0": (0, 1), "1": (1, 1)}
    assert {code: (address_of(code, 2).x, address_of(code, 2).y) for code in "0123"} == corners


def test_a_code_does_not_depend_on_the_number_of_finer_levels() -> None:
    codes = [quadcode(BlockAddress(level, 5, 2), level + 4) for level in range(20)]
    assert set(codes) == {"303"}


@given(addresses())
def test_the_fathers_code_is_the_code_without_its_last_digit(case: tuple[BlockAddress, int]) -> None:
    address, levels = case
    code = quadcode(address, levels)
    if code:
        assert quadcode(address.parent, levels) == code[:-1]
    if address.level:
        children = address.children()
        assert [child.parent for child in children] == [address] * 4
        assert sorted(quadcode(child, levels) for child in children) == [code + digit for digit in "0123"]
        assert [quadcode(child, levels)[-1] for child in children] == ["2", "3", "0", "1"], "row order from the top"


def test_level_0_has_no_children() -> None:
    assert BlockAddress(0, 3, 4).children() == ()


def test_neighbours_by_brute_force() -> None:
    side = 6
    grid = [BlockAddress(3, x, y) for y in range(side + 1) for x in range(side + 1)]
    for y in range(side):
        for x in range(side):
            expected = [other for other in grid if max(abs(other.x - x), abs(other.y - y)) == 1]
            assert list(BlockAddress(3, x, y).neighbours()) == expected


def test_addresses_sort_by_level_and_print_as_paths() -> None:
    shuffled = [BlockAddress(level, x, y) for level in range(3) for x in range(3) for y in range(3)]
    random.Random(1).shuffle(shuffled)
    assert all((a.level, a.x, a.y) < (b.level, b.x, b.y) for a, b in pairwise(sorted(shuffled)))
    assert str(BlockAddress(2, 7, 1)) == "2/7/1"


@pytest.mark.parametrize(("level", "x", "y"), [(-1, 0, 0), (0, -1, 0), (0, 0, -1)])
def test_negative_addresses_are_refused(level: int, x: int, y: int) -> None:
    with pytest.raises(UsageError, match="must not be negative"):
        BlockAddress(level, x, y)


@pytest.mark.parametrize(("level", "x", "y", "levels"), [(3, 0, 0, 3), (0, 4, 0, 3), (0, 0, 4, 3), (2, 1, 0, 3), (0, 0, 0, 0)])
def test_codes_outside_the_quadtree_are_refused(level: int, x: int, y: int, levels: int) -> None:
    with pytest.raises(UsageError, match="outside a quadtree"):
        quadcode(BlockAddress(level, x, y), levels)


@pytest.mark.parametrize("code", ["4", "0a", "-", " 1", "1\n", "\N{ARABIC-INDIC DIGIT ONE}"])
def test_codes_with_other_digits_are_refused(code: str) -> None:
    with pytest.raises(UsageError, match="digits 0, 1, 2 and 3"):
        address_of(code, 9)


def test_too_long_codes_are_refused() -> None:
    with pytest.raises(UsageError, match="longer than the 2 digits of a pyramid of 3 levels"):
        address_of("012", 3)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "imagery",
        "imagery-0",
        "imagery.jpg",
        "imagery-.jpg",
        "imagery-01-2.jpg",
        "imagery--1.jpg",
        "imagery-0-.jpg",
        "imagery-0-4.jpg",
        "imagery-0-1.JPG",
        "imagery-0-1.",
        "imagery-0-1.jpg\n",
        "imagery-0-1.jpg.tmp",
        "Imagery-0-1.jpg",
        "1magery-0-1.jpg",
        "../imagery-0-1.jpg",
        "imagery-\N{SUPERSCRIPT TWO}-1.jpg",
        f"imagery-{'9' * 5000}-1.jpg",
        f"imagery-0-{'1' * 100_000}.jpg",
    ],
)
def test_malformed_names_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match="expected <layer>-<level>"):
        parse_block_name(name)


@given(st.one_of(st.text(), st.from_regex(r"[a-z0-9_]{1,4}-[0-9]{1,3}(-[0-4]{0,9})?\.[a-z]*", fullmatch=True)))
def test_any_text_is_parsed_or_refused(name: str) -> None:
    try:
        parsed = parse_block_name(name)
    except UsageError:
        return
    assert block_name(parsed.layer, parsed.address, parsed.levels, parsed.suffix) == name


@pytest.mark.parametrize("layer", ["", "Height", "1st", "a-b", "a/b", "a.b", "a\n"])
def test_malformed_layer_names_are_refused(layer: str) -> None:
    with pytest.raises(UsageError, match="lower-case letters"):
        block_name(layer, BlockAddress(0, 0, 0), 1, "png")
