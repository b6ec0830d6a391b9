"""Generated files are what their generators would write now; after a change run `make docs`."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import pytest

from schemas.address import block_name, parse_block_name
from schemas.blockindex import RECORD_BYTES
from schemas.manifest import FORMAT_VERSION
from tests.schemas.sample_manifest import make_manifest
from tiler.codecs import CODEC_NAMES

DOCS = Path(__file__).parents[2] / "docs"
SCRIPTS = sorted((DOCS / "generate").glob("*.py"))


def load(script: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"generate_{script.stem}", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_there_are_generators() -> None:
    assert {"cli_reference", "format_fields", "lattice_figure", "manifest_schema"} <= {script.stem for script in SCRIPTS}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_generated_files_are_up_to_date(script: Path) -> None:
    module = load(script)
    target: Path = module.TARGET
    assert target.read_text(encoding="utf-8") == module.generate(), f"{target.relative_to(DOCS.parent)} is out of date: run `make docs`"


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = json.loads((DOCS / "manifest.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_a_manifest_is_valid_under_the_schema(validator: Any) -> None:
    validator.validate(json.loads(make_manifest().to_json()))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("format",), "zarr"),
        (("format_version",), 0),
        (("version",), "abc"),
        (("cover",), "blue"),
        (("layers",), {}),
        (("world", "unit"), "yard"),
        (("layers", "height", "path"), "../x"),
        (("layers", "height", "channels"), 5),
        (("layers", "height", "transform"), [1.0, 0.0]),
        (("layers", "height", "levels"), []),
        (("layers", "height", "levels", 0, "stored"), -1),
        (("layers", "height", "filter", "kernel"), "sinc"),
    ],
    ids=str,
)
def test_the_schema_refuses(validator: Any, path: tuple[Any, ...], value: Any) -> None:
    content = node = json.loads(make_manifest().to_json())
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    assert not validator.is_valid(content)


@pytest.mark.parametrize("name", sorted(json.loads(make_manifest().to_json())))
def test_the_schema_demands_every_field(validator: Any, name: str) -> None:
    content = json.loads(make_manifest().to_json())
    del content[name]
    assert not validator.is_valid(content)


def test_the_format_document_agrees_with_the_code() -> None:
    text = (DOCS / "FORMAT.md").read_text(encoding="utf-8")
    assert f"Format version {FORMAT_VERSION}." in text
    assert f"- **{FORMAT_VERSION}** — " in text.split("## Changelog")[1]
    assert f"one record of {RECORD_BYTES} bytes" in text
    table = text.split("| codec | content |")[1].split("\n\n")[0]
    assert {name for name in CODEC_NAMES if f"`{name}" in table} == set(CODEC_NAMES)
    for name in ("imagery-0-122.jpg", "height-3.lerc", "imagery-3.jpg"):
        assert name in text
        parsed = parse_block_name(name)
        assert parsed.levels == 4
        assert block_name(parsed.layer, parsed.address, parsed.levels, parsed.suffix) == name
    assert (parse_block_name("imagery-0-122.jpg").address.x, parse_block_name("imagery-0-122.jpg").address.y) == (4, 4)


def test_help_has_no_escapes() -> None:
    r"""In a raw docstring click's mark for paragraphs that stay as they are, \b, is two characters that reach the user."""
    assert "\\b" not in (DOCS / "CLI.md").read_text(encoding="utf-8")
