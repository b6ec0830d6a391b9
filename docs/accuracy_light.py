"""Measures what accuracy of light costs in time and writes the part of ``docs/ACCURACY.md`` that says so, with its plots.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python -m docs.accuracy_light           # some minutes, on a quiet machine
    .venv/bin/python -m docs.accuracy_light --report                                  # writes it anew from the raw results

The built-in terrain needs nothing, Puget Sound the folder of real inputs. Raw results go to ``tests/bench/results/accuracy-light.json``.
The comparison with other programs is measured by ``tests/bench/peers_light.py`` and only written here.
"""

import argparse
import csv
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from docs import accuracy_planner
from docs.markers import with_content
from schemas.settings import BuildSettings
from tiler.accuracy.lightexperiments import LightResult
from tiler.accuracy.lightfindings import brief
from tiler.accuracy.lightground import ground_of
from tiler.accuracy.lightplots import light_pareto
from tiler.accuracy.lightreport import METHOD, measure_light
from tiler.accuracy.machine import describe_machine
from tiler.accuracy.sample import Sample, built_in, load_sample

DOCS: Final = Path(__file__).parent
TARGET: Final = DOCS / "ACCURACY.md"
IMAGES: Final = DOCS / "images"
RESULTS: Final = DOCS.parent / "tests" / "bench" / "results"
RAW: Final = RESULTS / "accuracy-light.json"
PEERS: Final = RESULTS / "peers-light.json"
CROP: Final = 1024
RUNS: Final = 5
PUGET_CELL_M: Final = (160.0, 160.0)
TITLES: Final = {
    "shadow": "Hard shadows",
    "horizon": "Horizons",
    "disc": "The sun's disc",
    "sky": "The light of the sky",
    "bounce": "Light that the ground throws back",
}

Row = dict[str, Any]


def grounds() -> dict[str, tuple[Sample, tuple[float, float] | None]]:
    """Return what is measured here, by the stem of its plot: samples, and their distance where it is not that of the built-in terrain."""
    found: dict[str, tuple[Sample, tuple[float, float] | None]] = {"accuracy-light-built-in": (built_in(CROP), None)}
    if "CLIPMAP_TEST_DATA" in os.environ:
        path = Path(os.environ["CLIPMAP_TEST_DATA"]) / "puget" / "ps_height_1k.png"
        found["accuracy-light-puget"] = load_sample(path, BuildSettings(layer="height", height_scale=0.1), CROP), PUGET_CELL_M
    return found


def measure() -> None:
    """Measure all grounds and keep the raw results."""
    content: Row = {"runs": RUNS, "machine": describe_machine(), "grounds": {}}
    for stem, (sample, cell_m) in grounds().items():
        ground = ground_of(sample) if cell_m is None else ground_of(sample, cell_m)
        content["grounds"][stem] = {"name": sample.name} | measure_light(ground, RUNS).as_dict()
    RAW.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    rows = [{"ground": part["name"]} | row for part in content["grounds"].values() for row in part["results"]]
    with RAW.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (names, ["---"] * len(names), *rows))


def number(value: float | None) -> str:
    """Return three significant digits, nothing for None."""
    return "" if value is None else brief(value)


def methods(part: Row, experiment: str) -> str:
    """Return the table of one experiment: a line per method, for each sun its time and error."""
    rows = [row for row in part["results"] if row["experiment"] == experiment]
    suns = list(dict.fromkeys((row["azimuth_deg"], row["elevation_deg"]) for row in rows))
    found = {(row["method"], row["azimuth_deg"], row["elevation_deg"]): row for row in rows}
    unit, head, lines = rows[0]["unit"], [""], []
    for _, elevation in suns:
        where = "" if elevation is None else f"{elevation:g}°: "
        head += [f"{where}ns / sample", unit if unit == "% wrong" else f"rms [{unit}]"] + ([] if unit == "% wrong" else ["p99.9"])
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = [method]
        for sun in suns:
            row = found[method, *sun]
            cells += [number(row["ns_per_sample"]) + (" ●" if row["frontier"] else ""), number(row["error"])]
            cells += [] if unit == "% wrong" else [number(row["p999"])]
        lines.append(cells)
    return table(head, lines)


def ground_text(stem: str, part: Row) -> str:
    """Return what is said of one ground, and draw its plot."""
    results = [LightResult(**{key: value for key, value in row.items() if key != "frontier"}) for row in part["results"]]
    light_pareto(part["name"], results, IMAGES / f"{stem}.svg")
    size = part["ground"]
    about = (
        f"{size['width']} × {size['height']} samples at {size['cell_m'][0]:g} m, relief {size['relief_m']:.0f} m; half of the slopes "
        f"exceed {size['slope_p50']:.2g}, one in a hundred {size['slope_p99']:.2g}."
    )
    said = "\n".join(f"- {sentence}" for sentence in part["findings"])
    tables = "\n\n".join(f"{title}:\n\n{methods(part, experiment)}" for experiment, title in TITLES.items())
    precision = table(
        ["heights moved by [m]", "sun at", "state float32: changed %", "float64: changed %"],
        (
            [
                f"{r['offset_m']:,.0f}".replace(",", " "),
                f"{r['elevation_deg']:g}°",
                number(r["wrong_float32_percent"]),
                number(r["wrong_float64_percent"]),
            ]
            for r in part["precision"]
        ),
    )
    plot = f"![Error against time]({IMAGES.name}/{stem}.svg)"
    return f"### {part['name']}\n\n{about}\n\n{plot}\n\n{said}\n\n{tables}\n\nPrecision of a sweep's state:\n\n{precision}"


def peers_text() -> str:
    """Return the comparison with other programs, from its raw results."""
    content = json.loads(PEERS.read_text(encoding="utf-8"))
    head = ["samples", "finds", "program", "start [s]", "CPU [s]", "ns / sample", "kernel ns / sample", "error"]
    lines = []
    for row in content["rows"]:
        if "wrong_percent" in row:
            error = f"{row['wrong_percent']:.2g} % wrong"
        else:
            unit = "deg" if "rms_deg" in row else "codes"
            error = f"{brief(row[f'rms_{unit}'])} {unit} rms, {brief(row[f'largest_{unit}'])} at most"
        figures = [number(row.get(key)) for key in ("start_s", "cpu_s", "ns_per_sample", "kernel_ns_per_sample")]
        lines.append([f"{row['side']}²", row["finds"], row["program"], *figures, error])
    about = ", ".join([*content["versions"].values(), content["machine"]["processor"]])
    sun = f"sun at azimuth {content['azimuth']:g}°, elevation {content['elevation']:g}°"
    return f"{content['heights']}, {content['cell_m'][0]:g} m, {sun}. {about}.\n\n{table(head, lines)}"


def main() -> None:
    """Measure, unless only the text is wanted, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", action="store_true", help="measure nothing, write the text from the raw results")
    if not parser.parse_args().report:
        measure()
        accuracy_planner.measure()
    content = json.loads(RAW.read_text(encoding="utf-8"))
    where = ", ".join(f"{name} {value}" for name, value in content["machine"].items())
    parts = [ground_text(stem, part) for stem, part in content["grounds"].items()]
    text = "\n\n".join([METHOD, *parts, f"Measured on: {where}; {content['runs']} runs."])
    for name, written in (("light", text), ("light, other programs", peers_text())):
        begin, end = f"<!-- {name}: measured, written by docs/accuracy_light.py -->", f"<!-- end of {name} -->"
        TARGET.write_text(with_content(TARGET, begin, end, written), encoding="utf-8")
    accuracy_planner.write()


if __name__ == "__main__":
    main()
