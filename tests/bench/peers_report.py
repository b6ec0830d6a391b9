"""Writes the generated parts of ``docs/PERFORMANCE.md``, and its pictures, from the results of ``peers.py``."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import Any, Final

from tests.bench.peers_roofline import draw_roofline, limits, roofline
from tests.bench.peers_tables import (
    NOTHING,
    Result,
    beside,
    comparison,
    conditions,
    heading,
    losses,
    programs_of,
    runs_of,
    stages,
    table,
)
from tests.bench.peers_targets import targets

RESULTS: Final = Path(__file__).parent / "results"
RAW: Final = RESULTS / "peers.json"
DOCS: Final = Path(__file__).parents[2] / "docs"
TARGET: Final = DOCS / "PERFORMANCE.md"
BEGIN: Final = "<!-- {name}: written by tests/bench/peers.py -->"
END: Final = "<!-- end of {name} -->"
KINDS: Final = (("rgb", "jpeg", "RGB, codes of 8 bit"), ("height", "heights", "heights, metres"))
REFERENCES: Final = ("ideal", "box", "blackman-sinc", "lanczos")


def _error(result: Result, kind: str, program: str, reference: str, level: int) -> dict[str, Any] | None:
    wanted = (kind, program, reference, level)
    return next((row for row in result["errors"] if (row["kind"], row["program"], row["reference"], row["level"]) == wanted), None)


def _digits(value: float) -> str:
    return f"{value:.2f}" if value >= 0.01 else f"{value:.0e}"


def time_and_error(result: Result) -> str:
    """Return for each program its time beside clipmap's and how far its levels are from the ideal."""
    parts = []
    for kind, case, title in KINDS:
        of_kind = [row for row in result.get("errors", []) if row["kind"] == kind]
        levels = sorted({row["level"] for row in of_kind})
        lines = []
        for program in dict.fromkeys(row["program"] for row in of_kind):
            own = next(row["filter"] for row in of_kind if row["program"] == program)
            runs = runs_of(result, case, program)
            time = beside(runs, runs_of(result, case, runs[0]["against"])) if runs else "not measured"
            found = [_error(result, kind, program, "ideal", level) for level in levels]
            lines.append([program, own, time, *(f"{row['rms']:.2f} ({row['max']:.1f})" if row else "" for row in found)])
        if lines:
            parts.append(table((title, "filter", "time", *(f"level {level}" for level in levels)), lines))
    return "\n\n".join(parts) or NOTHING


def errors(result: Result) -> str:
    """Return the error of every program's levels against all references, and what the box filter's check found."""
    parts = []
    for kind, _, title in KINDS:
        of_kind = [row for row in result.get("errors", []) if row["kind"] == kind]
        lines = []
        for program, level in sorted({(row["program"], row["level"]) for row in of_kind}):
            found = [_error(result, kind, program, reference, level) for reference in REFERENCES]
            lines.append([program, f"{level}", *(f"{_digits(row['rms'])} ({_digits(row['max'])})" if row else "" for row in found)])
        if lines:
            parts.append(table((title, "level", *REFERENCES), lines))
    checked = result.get("box", [])
    if checked:
        samples, different = sum(row["samples"] for row in checked), sum(row["different"] for row in checked)
        parts.append(
            f"`--filter box`: of {samples:,} samples on {len(checked)} coarse levels, {different:,} differ from 2 × 2 means that were kept "
            "in float64 from level to level and rounded once, half to even."
        )
    return "\n\n".join(parts) or NOTHING


GENERATED: Final[Mapping[str, Callable[[Result], str]]] = MappingProxyType(
    {
        "conditions": conditions,
        "targets": targets,
        "losses": losses,
        "comparison": comparison,
        "time and error": time_and_error,
        "errors": errors,
        "stages": stages,
        "limits": limits,
        "roofline": roofline,
    }
)


def _replaced(text: str, name: str, content: str) -> str:
    """Return ``text`` with ``content`` between the markers of ``name``."""
    begin, end = BEGIN.format(name=name), END.format(name=name)
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{TARGET}: the markers of {name} are missing")
    return f"{before}{begin}\n\n{content}\n\n{end}{after}"


def document(text: str, result: Result) -> str:
    """Return the document ``text`` with its generated parts as ``result`` has them."""
    for name, generate in GENERATED.items():
        text = _replaced(text, name, generate(result))
    return text


def draw_times(result: Result, path: Path) -> None:
    """Draw the wall time of every program, a bar each with its spread, one panel per case."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels: Sequence[Any] = list(result["cases"].values())
    counts = [len(programs_of(case["rows"])) for case in panels]
    figure = Figure(figsize=(9, 0.8 * len(panels) + 0.32 * sum(counts)), layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(len(panels), 1, squeeze=False, height_ratios=[count + 1 for count in counts])[:, 0]
    for axes, case in zip(every, panels, strict=True):
        programs = programs_of(case["rows"])
        for place, (name, runs) in enumerate(programs.items()):
            wall = [run["wall_s"] for run in runs]
            colour = "#1b6ca8" if name.startswith("clipmap") else "#9aa5ad"
            axes.barh(place, median(wall), color=colour, xerr=[[median(wall) - min(wall)], [max(wall) - median(wall)]], ecolor="#333333")
            axes.annotate(f"{median(wall):.2f} s", (max(wall), place), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9)
        axes.set_yticks(range(len(programs)), list(programs))
        axes.invert_yaxis()
        axes.margins(x=0.1)
        axes.set_xlim(left=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(f"{heading(case)} [s]", loc="left", fontsize=10)
    figure.savefig(path, dpi=90)


def write_report(raw: Path = RAW) -> Result:
    """Write the generated parts of ``docs/PERFORMANCE.md``, and its pictures, from all results, which are returned."""
    result: Result = json.loads(raw.read_text(encoding="utf-8"))
    text = document(TARGET.read_text(encoding="utf-8"), result)
    draw_times(result, DOCS / "images/performance.png")
    draw_roofline(result, DOCS / "images/roofline.png")
    TARGET.write_text(text, encoding="utf-8")
    return result
