"""Checks printed JSON against the published schemas."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema

SCHEMA = Path(__file__).parents[2] / "docs" / "reports.schema.json"


@cache
def validator(report: str) -> Any:
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    assert report in schema["$defs"]
    whole = {key: value for key, value in schema.items() if key != "anyOf"} | {"$ref": f"#/$defs/{report}"}
    jsonschema.Draft202012Validator.check_schema(whole)
    return jsonschema.Draft202012Validator(whole)


def parsed(text: str, report: str) -> Any:
    """The JSON document ``text``, which must be a ``report``."""
    document = json.loads(text)
    validator(report).validate(document)
    return document
