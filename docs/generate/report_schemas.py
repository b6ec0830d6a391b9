"""Write ``docs/reports.schema.json``, the JSON Schemas of what ``inspect``, ``verify``, ``diff`` and others print with ``--json``."""

import json
from pathlib import Path
from typing import Any, Final

from pydantic.json_schema import models_json_schema

from schemas.batch import BatchReport
from schemas.effects import EffectPlan, EffectProof
from schemas.estimates import BuildEstimate
from schemas.facts import BlockFacts, DatasetFacts, LayerFacts, LevelFacts, PointFacts
from schemas.findings import DiffReport, VerifyReport
from schemas.model import Model

TARGET = Path(__file__).parents[1] / "reports.schema.json"

REPORTS: Final[tuple[type[Model], ...]] = (
    DatasetFacts,
    LayerFacts,
    LevelFacts,
    BlockFacts,
    PointFacts,
    VerifyReport,
    DiffReport,
    BuildEstimate,
    BatchReport,
    EffectPlan,
    EffectProof,
)


def schema() -> dict[str, Any]:
    """Return one schema with a definition for every report (JSON Schema 2020-12)."""
    _, definitions = models_json_schema([(model, "serialization") for model in REPORTS], title="clipmap reports")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": "Generated from facts.py, findings.py, estimates.py, batch.py and effects.py of schemas/ by "
        f"docs/generate/{Path(__file__).name}. "
        "inspect prints DatasetFacts, LayerFacts, LevelFacts, BlockFacts or PointFacts, verify VerifyReport, diff DiffReport, "
        "build --plan BuildEstimate, batch BatchReport; plan EffectPlan, plan --prove EffectProof.",
        "anyOf": [{"$ref": f"#/$defs/{model.__name__}"} for model in REPORTS],
        **definitions,
    }


def generate() -> str:
    """Return the text of the file."""
    return json.dumps(schema(), indent=2, sort_keys=True) + "\n"


if __name__ == "__main__":
    TARGET.write_text(generate(), encoding="utf-8")
