"""Write ``docs/scene.schema.json``, the JSON Schema of a scene, from the models in ``schemas/scene.py``."""

import json
from pathlib import Path
from typing import Any

from schemas.scene import Scene

TARGET = Path(__file__).parents[1] / "scene.schema.json"


def schema() -> dict[str, Any]:
    """Return the schema of a scene as it is written by people, who leave out what they do not care about (JSON Schema 2020-12)."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": f"Generated from schemas/scene.py by docs/generate/{Path(__file__).name}; docs/EFFECTS.md says what follows.",
        **Scene.model_json_schema(),
        "title": "clipmap scene",
    }


def generate() -> str:
    """Return the text of the file."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"


if __name__ == "__main__":
    TARGET.write_text(generate(), encoding="utf-8")
