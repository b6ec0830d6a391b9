"""Runs the experiments and keeps what they gave in a folder: raw results as JSON and CSV, pictures, and a page that shows them."""

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from schemas.errors import MissingExtraError, StorageError, UsageError
from tiler.accuracy import plots
from tiler.accuracy.experiments import Candidate, measure_candidates
from tiler.accuracy.findings import default_of, dominating, findings, frontier
from tiler.accuracy.light_planner import (
    PLANNER_PLOT,
    PlannerResult,
    measure_planner,
    planner_findings,
    planner_plot,
    planner_rows,
    planner_scenes,
    planner_section,
)
from tiler.accuracy.lightground import Ground
from tiler.accuracy.lightplots import light_pareto
from tiler.accuracy.lightreport import PLOT, LightReport, light_section, measure_light
from tiler.accuracy.machine import describe_machine
from tiler.accuracy.page import page
from tiler.accuracy.precision import Rung, measure_precision
from tiler.accuracy.sample import Sample
from tiler.accuracy.voids import VoidResult, measure_voids

RAW: Final = "accuracy.json"
_MARK: Final = "clipmap accuracy"
"""Says in the raw results that a folder is a report, so that a later one may take its place."""


@dataclass(frozen=True, slots=True)
class Report:
    """All results of one sample."""

    sample: Sample
    runs: int
    machine: dict[str, str]
    candidates: tuple[Candidate, ...]
    precision: tuple[Rung, ...]
    voids: tuple[VoidResult, ...]
    light: LightReport | None = None
    planner: tuple[PlannerResult, ...] = ()

    @property
    def findings(self) -> list[str]:
        """What the figures mean, one sentence each."""
        return findings(self.sample, self.candidates, self.voids)

    @property
    def light_findings(self) -> list[str]:
        """What the figures of light mean, one sentence each; none if light was not measured."""
        return [] if self.light is None else [*self.light.findings, *planner_findings(self.planner)]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values, ready for JSON."""
        default = default_of(self.sample, self.candidates)
        height, width, channels = self.sample.values.shape
        return {
            "report": _MARK,
            "sample": {
                "name": self.sample.name,
                "kind": self.sample.kind,
                "registration": self.sample.registration,
                "edge": self.sample.edge,
                "unit": self.sample.unit,
                "width": width,
                "height": height,
                "channels": channels,
                "remarks": list(self.sample.remarks),
            },
            "runs": self.runs,
            "machine": self.machine,
            "findings": self.findings,
            "default": default.name,
            "frontier": [candidate.name for candidate in frontier(self.candidates)],
            "default_dominated_by": [candidate.name for candidate in dominating(default, self.candidates)],
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "precision": [asdict(rung) for rung in self.precision],
            "voids": [asdict(result) for result in self.voids],
        } | ({} if self.light is None else {"light": self.light.as_dict(), "planner": planner_rows(self.planner)})


def measure(sample: Sample, runs: int, on_stage: Callable[[str], None] = lambda stage: None, ground: Ground | None = None) -> Report:
    """Run all experiments, those on light if there is a ground for it; ``on_stage`` is told what comes next."""
    on_stage("kernels and rivals: error and time")
    candidates = measure_candidates(sample, runs)
    on_stage("precision of the arithmetic")
    precision = measure_precision(sample)
    on_stage("voids")
    voids = measure_voids(sample)
    light = None if ground is None else measure_light(ground, runs, on_stage)
    planner = [] if ground is None else measure_planner(planner_scenes(sample, ground), runs, on_stage)
    return Report(sample, runs, describe_machine(), tuple(candidates), tuple(precision), tuple(voids), light, tuple(planner))


def prepare_folder(folder: Path) -> None:
    """Make ``folder`` where there is none, before anything is measured.

    Raises UsageError if it holds something else than a report, StorageError if it cannot be made, MissingExtraError without matplotlib.
    """
    if find_spec("matplotlib") is None:
        raise MissingExtraError("the report's plots need matplotlib; install it with pip install 'clipmap[report]'")
    try:
        if folder.is_dir() and not _is_report(folder) and any(folder.iterdir()):
            raise UsageError(f"{folder}: holds something else than an accuracy report; choose another folder for -o")
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise UsageError(f"{folder}: is a file; choose another folder for -o") from error
    except OSError as error:
        raise StorageError(f"{folder}: cannot be made: {error.strerror}") from error


def _is_report(folder: Path) -> bool:
    try:
        content = json.loads((folder / RAW).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("report") == _MARK


def write_report(report: Report, folder: Path) -> Path:
    """Write the page, its pictures and the raw results to ``folder``, and return the page's path.

    Raises what ``prepare_folder`` does, and StorageError if a file cannot be written.
    """
    prepare_folder(folder)
    content = report.as_dict()
    try:
        (folder / RAW).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        _write_csv(folder / "kernels.csv", [row for candidate in report.candidates for row in kernel_rows(candidate)])
        _write_csv(folder / "precision.csv", content["precision"])
        _write_csv(folder / "voids.csv", content["voids"])
        plots.pareto(report.sample, report.candidates, folder / "pareto.svg")
        plots.responses(report.sample, report.candidates, folder / "response.svg")
        plots.differences(report.sample, folder / "differences.png")
        plots.voids(report.sample, report.voids, folder / "voids.svg")
        index = folder / "index.html"
        section = ""
        if report.light is not None:
            _write_csv(folder / "light.csv", content["light"]["results"])
            light_pareto(report.sample.name, report.light.results, folder / PLOT)
            section = light_section(content["light"])
        if report.planner:
            _write_csv(folder / "planner.csv", content["planner"])
            planner_plot(report.planner, folder / PLANNER_PLOT)
            section += planner_section(report.planner)
        index.write_text(page(content, section), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: the report cannot be written: {error.strerror or error}") from error
    return index


def kernel_rows(candidate: Candidate) -> list[dict[str, Any]]:
    """Return one flat row per level of a candidate."""
    figures = asdict(candidate.figures) if candidate.figures else {}
    timing = {
        "ms_per_megasample": candidate.ms_per_megasample,
        "median_ms_per_megasample": candidate.median_ms_per_megasample,
    }
    head = {"name": candidate.name, "maker": candidate.maker, "kernel": candidate.kernel, "radius": candidate.radius}
    return [head | asdict(error) | timing | figures for error in candidate.errors]


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
