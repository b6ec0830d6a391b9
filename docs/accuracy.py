"""Measures what accuracy costs in time and writes the figures and plots of ``docs/ACCURACY.md``.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python docs/accuracy.py

The built-in terrain needs nothing, Puget Sound the folder of real inputs. Takes about two minutes. Times are this machine's: run it
on a quiet one, and read the sentences before you commit them.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from schemas.settings import BuildSettings
from tiler.accuracy import plots
from tiler.accuracy.experiments import Candidate
from tiler.accuracy.findings import default_of, frontier
from tiler.accuracy.report import Report, measure
from tiler.accuracy.sample import Sample, built_in, load_sample

DOCS = Path(__file__).parent
TARGET = DOCS / "ACCURACY.md"
IMAGES = DOCS / "images"
CROP: Final = 1024
RUNS: Final = 15
SHOWN: Final = (
    "box",
    "triangle",
    *(f"blackman-sinc {radius}" for radius in (2, 3, 4, 6, 8)),
    "kaiser 3",
    "kaiser 6",
    "lanczos 3",
    "lanczos 6",
)
VOID_SHARES: Final = (0.0, 0.05, 0.1, 0.3, 0.5, 0.9)


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (names, ["---"] * len(names), *rows))


def number(value: float | None) -> str:
    """Return three significant digits, nothing for None."""
    return "" if value is None else f"{value:.3g}"


def kernels(report: Report) -> str:
    """Return the table of kernels and rivals."""
    unit, levels = report.sample.unit, len(report.candidates[0].errors)
    names = [
        "",
        "ms / Msample",
        f"rms [{unit}]",
        "p99.9",
        "droop",
        "aliasing",
        "step overshoot %",
        *(f"rms level {n}" for n in range(2, levels + 1)),
    ]
    best, default = frontier(report.candidates), default_of(report.sample, report.candidates)

    def row(one: Candidate) -> list[str]:
        name = f"**{one.name}**" if one is default else one.name
        first, overshoot = one.errors[0], one.figures.step_overshoot_percent if one.figures else None
        figures = [number(value) for value in (one.ms_per_megasample, first.rms, first.p999, first.droop_rms, first.alias_rms)]
        mark = " ●" if one in best else ""
        return [name + mark, *figures, "" if overshoot is None else f"{overshoot:.1f}", *(number(error.rms) for error in one.errors[1:])]

    return table(names, (row(one) for one in report.candidates if one.maker != "clipmap" or one.name in SHOWN))


def precision(report: Report) -> str:
    """Return the precision ladder."""
    names = ["offset", "level", "float32 spacing", "shipped rms", "max", "plain sum rms", "max"]
    return table(
        names,
        (
            [f"{one.offset:g}", str(one.level)]
            + [number(value) for value in (one.spacing, one.shipped_rms, one.shipped_largest, one.plain_rms, one.plain_largest)]
            for one in report.precision
        ),
    )


def voids(report: Report) -> str:
    """Return what is lost and how far off the rest is, as "lost % / rms where samples are whole"."""
    filters = list(dict.fromkeys(one.filter for one in report.voids))
    cells = {(one.pattern, one.share, one.filter): f"{100 * one.lost_share:.1f} / {number(one.whole_rms) or '–'}" for one in report.voids}
    rows = [
        [f"{100 * share:g} % {pattern}", *(cells[pattern, share, name] for name in filters)]
        for pattern in ("scattered", "holes")
        for share in VOID_SHARES
        if share or pattern == "scattered"
    ]
    return table(["voids", *filters], rows)


def section(sample: Sample, stem: str) -> tuple[Report, str]:
    """Measure a sample, draw its plots and return its report and text."""
    report = measure(sample, RUNS)
    plots.pareto(sample, report.candidates, IMAGES / f"{stem}.svg")
    said = "\n".join(f"- {sentence}" for sentence in report.findings)
    return report, f"![Error against time]({IMAGES.name}/{stem}.svg)\n\n{said}\n\n{kernels(report)}"


def replaced(text: str, name: str, content: str) -> str:
    """Return ``text`` with ``content`` between the markers of ``name``."""
    begin, end = f"<!-- {name}: measured by docs/accuracy.py -->", f"<!-- end of {name} -->"
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise ValueError(f"{TARGET}: the markers of {name} are missing")
    return f"{before}{begin}\n\n{content}\n\n{end}{after}"


def machine(report: Report) -> str:
    """Return what it was measured on, in one line."""
    return f"Measured on: {', '.join(f'{name} {value}' for name, value in report.machine.items())}; {RUNS} runs."


def main() -> None:
    """Measure what can be measured here."""
    text = TARGET.read_text(encoding="utf-8")
    report, island = section(built_in(CROP), "accuracy-built-in")
    text = replaced(replaced(text, "built-in terrain", island), "machine", machine(report))
    if "CLIPMAP_TEST_DATA" in os.environ:
        data = Path(os.environ["CLIPMAP_TEST_DATA"]) / "puget"
        sample = load_sample(data / "ps_height_1k.png", BuildSettings(layer="height", height_scale=0.1), CROP)
        report, puget = section(sample, "accuracy-puget")
        plots.differences(sample, IMAGES / "accuracy-difference.png")
        text = replaced(text, "Puget Sound", puget)
        text = replaced(replaced(text, "precision", precision(report)), "voids", voids(report))
        _, texture = section(load_sample(data / "ps_texture_1k.png", BuildSettings(), CROP), "accuracy-texture")
        text = replaced(text, "texture", texture)
    TARGET.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
