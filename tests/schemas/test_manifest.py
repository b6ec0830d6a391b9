"""Manifests: round trips, versions, and that nothing damaged, edited, unknown or newer is accepted."""

import base64
import copy
import hashlib
import json
import tracemalloc
import zlib
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError
from schemas.manifest import FORMAT_VERSION, Level, Manifest, digest, pack_bitmap, parse_manifest, transformed_extent
from tests.schemas.sample_manifest import GENERATOR, WORLD, make_layer, make_levels, make_manifest

WHERE = "some/folder/manifest.json"


def refusal(data: bytes) -> str:
    """The sentence with which ``data`` is refused."""
    with pytest.raises(InputError) as caught:
        parse_manifest(data, WHERE)
    sentence = str(caught.value)
    assert sentence.startswith(f"{WHERE}: ")
    assert "\n" not in sentence
    assert "http" not in sentence, "no links to a validation library's manual"
    return sentence


def as_json(manifest: Manifest) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(manifest.to_json())
    return content


def leaves(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values that are neither lists nor objects, and of empty ones."""
    inner: list[tuple[Any, Any]] = list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else []
    if not inner:
        yield path
    for key, value in inner:
        yield from leaves(value, (*path, key))


def at(node: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        node = node[key]
    return node


def other_than(value: Any) -> Any:
    """A value of the same type that differs."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    if value is None or value == []:
        return 1.0
    return ("0" if value[0] != "0" else "1") + value[1:]


def test_round_trip() -> None:
    manifest = make_manifest()
    data = manifest.to_json()
    parsed = parse_manifest(data, WHERE)
    assert parsed == manifest
    assert parsed.to_json() == data
    assert list(parsed.layers) == ["height", "imagery"]


def test_json_is_readable_text() -> None:
    data = make_manifest().to_json()
    assert data.endswith(b"}\n")
    assert json.loads(data)["format_version"] == FORMAT_VERSION == 1


def test_the_version_is_what_the_format_document_says() -> None:
    content = json.loads(make_manifest().to_json())
    text = json.dumps({"layers": content["layers"], "world": content["world"]}, sort_keys=True, separators=(",", ":"))
    assert content["version"] == hashlib.blake2b(text.encode("ascii"), digest_size=16).hexdigest()


names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
numbers = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=60)
@given(
    st.dictionaries(
        names, st.tuples(st.sampled_from(["imagery", "height"]), st.integers(1, 3000), st.integers(1, 3000)), min_size=1, max_size=4
    ),
    st.tuples(*[numbers] * 6),
    st.text(),
)
def test_any_dataset_survives_the_trip(layers: dict[str, Any], transform: Any, source: str) -> None:
    made = {}
    for number, (name, (kind, width, height)) in enumerate(layers.items()):
        layer = make_layer(kind, width, height, transform=transform, path=f"{name}.{number}")
        made[name] = layer.model_copy(update={"source": layer.source.model_copy(update={"name": source})})
    manifest = Manifest.create(generator=GENERATOR, world=WORLD, layers=made)
    assert parse_manifest(manifest.to_json(), WHERE) == manifest
    backwards = Manifest.create(generator="another program", world=WORLD, layers=dict(reversed(made.items())))
    assert backwards.version == manifest.version, "the version depends on nothing but the content"


CONTENT = as_json(make_manifest())
VERSIONED = [path for path in leaves(CONTENT) if path[0] in ("world", "layers")]


@pytest.mark.parametrize("path", VERSIONED, ids=lambda path: ".".join(map(str, path)))
def test_no_value_can_be_edited(path: tuple[Any, ...]) -> None:
    raw = copy.deepcopy(CONTENT)
    at(raw, path[:-1])[path[-1]] = other_than(at(raw, path))
    refusal(json.dumps(raw).encode())


def test_an_edit_that_fits_the_model_is_told_by_the_version() -> None:
    raw = copy.deepcopy(CONTENT)
    raw["layers"]["height"]["source"]["name"] = "other.tif"
    assert "version does not match the content" in refusal(json.dumps(raw).encode())


OPTIONAL = {"patches", "files", "void", "clamp", "linear_light", "fill", "enhance", "stretch"}
"""Fields that say how a step was done that is left out by default; a manifest without them means the default."""


@pytest.mark.parametrize("path", [path for path in leaves(CONTENT) if path[-1] not in OPTIONAL], ids=lambda path: ".".join(map(str, path)))
def test_no_field_can_be_left_out(path: tuple[Any, ...]) -> None:
    raw = copy.deepcopy(CONTENT)
    del at(raw, path[:-1])[path[-1]]
    refusal(json.dumps(raw).encode())


@pytest.mark.parametrize("path", [path for path in leaves(CONTENT) if path[-1] in OPTIONAL], ids=lambda path: ".".join(map(str, path)))
def test_optional_fields_have_defaults(path: tuple[Any, ...]) -> None:
    raw = copy.deepcopy(CONTENT)
    del at(raw, path[:-1])[path[-1]]
    assert parse_manifest(json.dumps(raw).encode(), "here") == make_manifest()


def test_the_version_changes_with_blocks_and_names_but_not_with_the_generator() -> None:
    manifest = make_manifest()
    height = manifest.layers["height"]
    levels = [level.model_copy(update={"index": digest(b"another index")}) if level.level == 0 else level for level in height.levels]
    variants = [
        Manifest.create(
            generator=GENERATOR, world=WORLD, layers=manifest.layers | {"height": height.model_copy(update={"levels": levels})}
        ),
        Manifest.create(generator=GENERATOR, world=WORLD, layers={"height": height}),
        Manifest.create(generator=GENERATOR, world=WORLD, layers={"heights": height, "imagery": manifest.layers["imagery"]}),
        Manifest.create(generator=GENERATOR, world=WORLD.model_copy(update={"crs": None}), layers=dict(manifest.layers)),
    ]
    assert len({manifest.version, *(variant.version for variant in variants)}) == 5
    assert Manifest.create(generator="x", world=WORLD, layers=dict(manifest.layers)).version == manifest.version


def dictionaries(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(node, dict):
        yield path
        for key, value in node.items():
            yield from dictionaries(value, (*path, key))
    if isinstance(node, list):
        for number, value in enumerate(node):
            yield from dictionaries(value, (*path, number))


@pytest.mark.parametrize("path", [path for path in dictionaries(CONTENT) if path != ("layers",)], ids=lambda path: ".".join(map(str, path)))
def test_unknown_fields_are_refused_everywhere(path: tuple[Any, ...]) -> None:
    raw = copy.deepcopy(CONTENT)
    at(raw, path)["colour_of_the_cover"] = "blue"
    assert "colour_of_the_cover" in refusal(json.dumps(raw).encode())


@pytest.mark.parametrize("found", [2, 3, 10**30])
def test_newer_formats_are_refused_before_anything_else_is_looked_at(found: int) -> None:
    sentence = refusal(json.dumps({"format": "clipmap", "format_version": found, "whatever": []}).encode())
    assert f"format version {found} is newer than this clipmap reads (1); upgrade clipmap" in sentence


@pytest.mark.parametrize("found", [0, -1, 2.0, "2", True, None, [1]])
def test_other_format_versions_are_refused(found: Any) -> None:
    assert "format_version" in refusal(json.dumps(CONTENT | {"format_version": found}).encode())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b'"clipmap"',
        b"{}",
        b'{"format": "zarr"}',
        b"\xff\xfe",
        b"\x89PNG\r\n\x1a\n",
        b"[" * 200_000,
        b'{"format": "clipmap", "format_version": ' + b"9" * 5000 + b"}",
    ],
    ids=lambda data: repr(data[:12]),
)
def test_what_is_no_manifest_is_refused(data: bytes) -> None:
    assert "manifest" in refusal(data)


@given(st.data())
def test_a_cut_manifest_is_refused(data: st.DataObject) -> None:
    text = make_manifest().to_json()
    refusal(text[: data.draw(st.integers(0, len(text) - 3))])


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_are_none_are_refused(text: str) -> None:
    data = json.dumps(CONTENT).replace("812.25", text, 1).encode()
    assert text.encode() in data
    refusal(data)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("block", 100, "power of two"),
        ("pad", 129, "half the block side"),
        ("width", 1, "levels do not fit a lattice of 1 x"),
        ("registration", "corner", "area"),
        ("path", "../../etc", "path"),
        ("path", "/etc", "path"),
        ("suffix", "jpg/..", "suffix"),
        ("channels", 5, "channels"),
        ("levels", [], "levels"),
    ],
)
def test_contradictions_name_the_place(field: str, value: Any, message: str) -> None:
    raw = copy.deepcopy(CONTENT)
    raw["layers"]["imagery"][field] = value
    sentence = refusal(json.dumps(raw).encode())
    assert message in sentence
    assert "layers.imagery" in sentence


def test_layers_may_not_share_a_path_or_have_odd_names() -> None:
    layers = {"a": make_layer("height", 9, 9), "b": make_layer("height", 9, 9)}
    with pytest.raises(ValidationError, match="two layers have the same path"):
        Manifest.create(generator=GENERATOR, world=WORLD, layers=layers)
    with pytest.raises(ValidationError, match="lower-case letters"):
        Manifest.create(generator=GENERATOR, world=WORLD, layers={"a/b": make_layer("height", 9, 9)})
    with pytest.raises(ValidationError, match="at least 1"):
        Manifest.create(generator=GENERATOR, world=WORLD, layers={})


def test_levels_must_be_numbered_from_0() -> None:
    layer = make_layer("imagery", 1000, 700)
    odd = [level.model_copy(update={"level": 1}) for level in layer.levels]
    with pytest.raises(ValidationError, match="listed from 0, without gaps"):
        make_layer("imagery", 1000, 700, levels=odd)
    with pytest.raises(ValidationError, match="do not fit a lattice"):
        make_layer("imagery", 1000, 700, levels=layer.levels[:-1])


def test_manifests_are_frozen() -> None:
    manifest = make_manifest()
    with pytest.raises(ValidationError, match="frozen"):
        manifest.world.unit = "degree"  # type: ignore[misc]  # the point of the test


def test_unknown_layers_are_refused_with_the_known_ones() -> None:
    assert make_manifest().layer("height").kind == "height"
    with pytest.raises(NotFoundError, match="no layer 'light' in the dataset; it has height, imagery"):
        make_manifest().layer("light")


def test_keys_of_blocks_and_indexes() -> None:
    layer = make_manifest().layer("imagery")
    assert len(layer.levels) == 3
    assert layer.block_key("imagery", BlockAddress(0, 3, 1)) == "imagery.0123abcd/0/imagery-0-31.jpg"
    assert layer.block_key("imagery", BlockAddress(2, 0, 0)) == "imagery.0123abcd/2/imagery-2.jpg"
    assert layer.index_key(1) == "imagery.0123abcd/1/index.bin"


def test_extents_of_cells_and_of_vertices() -> None:
    area, point = make_manifest().layer("imagery"), make_manifest().layer("height")
    assert area.extent == (500000.0, 5200000.0 - 30 * 700, 500000.0 + 30 * 1000, 5200000.0)
    assert point.extent == (500000.0, 5200000.0 - 30 * 350, 500000.0 + 30 * 500, 5200000.0)


@given(st.tuples(*[st.integers(-9, 9)] * 6), st.integers(1, 9), st.integers(1, 9))
def test_transformed_extent_is_the_box_of_all_points(transform: Any, width: int, height: int) -> None:
    a, b, c, d, e, f = transform
    points = [(a * x + b * y + c, d * x + e * y + f) for x in range(width + 1) for y in range(height + 1)]
    xs, ys = [x for x, _ in points], [y for _, y in points]
    assert transformed_extent(transform, width, height) == (min(xs), min(ys), max(xs), max(ys))


def test_a_lattice_without_bound_is_refused() -> None:
    raw = copy.deepcopy(CONTENT)
    raw["layers"]["imagery"].update(width=2**40, height=2**40)
    assert "more than 2147483648 are not supported" in refusal(json.dumps(raw).encode())


def level_of(count: int, availability: str) -> Level:
    """A level of ``count`` blocks in one row with the given field."""
    whole = make_levels(make_layer("imagery", 256 * count, 1).lattice)[0]
    return whole.model_copy(update={"availability": availability})


@given(st.lists(st.booleans(), min_size=1, max_size=300))
def test_availability_of_any_blocks(stored: list[bool]) -> None:
    bitmap = bytearray(-(-len(stored) // 8))
    for number, bit in enumerate(stored):
        bitmap[number // 8] |= bit << (number % 8)
    field = pack_bitmap(bytes(bitmap), len(stored))
    assert (field == "all") == all(stored)
    assert level_of(len(stored), field).stored_bitmap() == bytes(bitmap)


@given(st.integers(9, 200), st.binary(min_size=1, max_size=40), st.data())
def test_a_damaged_availability_is_refused(count: int, noise: bytes, data: st.DataObject) -> None:
    good = zlib.compress(bytes(-(-count // 8)), 9)
    place = data.draw(st.integers(0, len(good) - 1))
    damaged = data.draw(
        st.sampled_from([good[:place], noise, good + noise, good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :]])
    )
    with pytest.raises(InputError, match="availability of level 0"):
        level_of(count, base64.b64encode(damaged).decode()).stored_bitmap()


@pytest.mark.parametrize("field", ["", "None", "****", "Zm9v", "\N{SNOWMAN}", "ALL", "eJxjYAAAAAIAAQ=", "eJxj\nYAAAAAIAAQ=="])
def test_an_availability_that_is_not_base64_of_zlib_is_refused(field: str) -> None:
    with pytest.raises(InputError, match="availability of level 0"):
        level_of(9, field).stored_bitmap()


@pytest.mark.parametrize("size", [1, 3])
def test_an_availability_of_another_size_is_refused(size: int) -> None:
    with pytest.raises(InputError, match="bytes instead of 2"):
        level_of(9, base64.b64encode(zlib.compress(bytes(size))).decode()).stored_bitmap()


def test_bits_beyond_the_last_block_are_refused() -> None:
    with pytest.raises(InputError, match="bits too many"):
        level_of(9, base64.b64encode(zlib.compress(b"\x00\x02")).decode()).stored_bitmap()


def test_a_bomb_is_not_inflated() -> None:
    bomb = level_of(9, base64.b64encode(zlib.compress(bytes(200_000_000), 9)).decode())
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="bytes instead of 2"):
            bomb.stored_bitmap()
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 1_000_000
