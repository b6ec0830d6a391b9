"""Write ``docs/manifest.schema.json``, the JSON Schema of ``manifest.json``, from the models in ``schemas/manifest.py``."""

import json
from pathlib import Path
from typing import Any

from schemas.manifest import FORMAT_VERSION, Manifest

TARGET = Path(__file__).parents[1] / "manifest.schema.json"


def schema() -> dict[str, Any]:
    """Return the schema of a written manifest, in which no field is left out (JSON Schema 2020-12)."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": f"Generated from schemas/manifest.py by docs/generate/{Path(__file__).name}; docs/FORMAT.md explains it.",
        **Manifest.model_json_schema(mode="serialization"),
        "title": f"clipmap manifest, format version {FORMAT_VERSION}",
    }


def generate() -> str:
    """Return the text of the file."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"


if __name__ == "__main__":
    TARGET.write_text(generate(), encoding="utf-8")
