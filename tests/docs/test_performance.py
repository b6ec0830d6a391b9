"""``docs/PERFORMANCE.md`` says what the committed results of the benchmark say; after a measurement its script writes it."""

import csv
import json
from typing import Any

import pytest

from tests.bench.peers_report import GENERATED, RAW, TARGET, document
from tests.bench.peers_targets import TARGETS


@pytest.fixture(scope="module")
def result() -> Any:
    return json.loads(RAW.read_text(encoding="utf-8"))


def test_the_generated_parts_are_up_to_date(result: Any) -> None:
    text = TARGET.read_text(encoding="utf-8")
    assert text == document(text, result), "run `python tests/bench/peers.py --report`"


def test_every_generated_part_changes_with_the_results() -> None:
    text = TARGET.read_text(encoding="utf-8")
    nothing = document(text, {"versions": {}, "cases": {}})
    assert nothing.count("Not measured.") >= len(GENERATED) - 2  # conditions and targets have lines all the same
    assert nothing.count("| not measured |") == len(TARGETS)


def test_raw_results_are_there_as_csv_too(result: Any) -> None:
    rows = [row for case in result["cases"].values() for row in case["rows"]]
    with open(RAW.with_suffix(".csv"), newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert [(row["program"], row["run"], row["wall_s"]) for row in rows] == [
        (line["program"], int(line["run"]), float(line["wall_s"])) for line in lines
    ]
