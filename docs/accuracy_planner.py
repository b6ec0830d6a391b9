"""Measures what planning effects saves on four scenes and writes the part of ``docs/ACCURACY.md`` that says so, with its figure.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python -m docs.accuracy_planner         # a minute, on a quiet machine
    .venv/bin/python -m docs.accuracy_planner --report                                # writes it anew from the raw results

``docs/accuracy_light.py`` does the same beside everything else that it measures. Without the folder of real inputs the built-in scenes
stand in for them. Raw results go to ``tests/bench/results/accuracy-planner.json``.
"""

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from docs.markers import with_content
from schemas.region import Rect
from schemas.settings import BuildSettings
from tiler.accuracy.light_planner import (
    HEADER,
    METHOD,
    PlannerResult,
    PlannerScene,
    built_in_scenes,
    measure_planner,
    planner_cells,
    planner_plot,
    planner_rows,
)
from tiler.accuracy.lightground import Ground
from tiler.accuracy.machine import describe_machine
from tiler.building.build import build_layer
from tiler.checking.blockreader import BlockReader
from tiler.effects.dataset import read_heights
from tiler.stores.dataset import open_dataset

DOCS: Final = Path(__file__).parent
TARGET: Final = DOCS / "ACCURACY.md"
PLOT: Final = DOCS / "images" / "accuracy-planner.svg"
RAW: Final = DOCS.parent / "tests" / "bench" / "results" / "accuracy-planner.json"
BEGIN: Final = "<!-- planning: measured, written by docs/accuracy_planner.py -->"
END: Final = "<!-- end of planning -->"
CROP: Final = 1024
RUNS: Final = 3


def loaded(name: str, settings: BuildSettings) -> Ground:
    """Return a real elevation model as it is built, voids included."""
    path = Path(os.environ["CLIPMAP_TEST_DATA"]) / name
    with tempfile.TemporaryDirectory() as folder:
        layer = build_layer(path, Path(folder) / "dataset", settings).manifest.layer("height")
        reader = BlockReader(open_dataset(Path(folder) / "dataset"), "height")
        heights = read_heights(reader, Rect(0, 0, layer.width, layer.height))
    if layer.ground_spacing_m is None:
        raise ValueError(name)
    return Ground(heights, layer.ground_spacing_m)


def scenes() -> list[PlannerScene]:
    """Return mountains, a coast, a survey by lidar and a plain: real ones where there are any."""
    if "CLIPMAP_TEST_DATA" not in os.environ:
        return built_in_scenes(CROP)
    puget = loaded("puget/ps_height_1k.png", BuildSettings(layer="height", height_scale=0.1, spacing=160.0))
    plain = Ground(np.asarray(puget.heights_m * np.float32(20 / puget.relief_m), np.float32), puget.cell_m)
    return [
        PlannerScene("Mount Everest, 90 m, with voids", loaded("dem/mt_everest_90m.tif", BuildSettings(layer="height")), 290.0, 8.0),
        PlannerScene("Puget Sound, 160 m", puget, 270.0, 30.0),
        PlannerScene("lidar, 1 m, with voids", loaded("dem/slovenia_lidar_nan.tif", BuildSettings(layer="height")), 200.0, 60.0),
        PlannerScene("a plain: Puget Sound with 20 m of relief", plain, 200.0, 40.0),
    ]


def measure() -> None:
    """Measure all scenes and keep the raw results."""
    rows = planner_rows(measure_planner(scenes(), RUNS, print))
    content = {"runs": RUNS, "machine": describe_machine(), "scenes": rows}
    RAW.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def result_of(row: dict[str, Any]) -> PlannerResult:
    """Return a result from its row."""
    return PlannerResult(**(row | {"left_out": tuple(row["left_out"].split())}))


def text() -> str:
    """Return what is said, from the raw results, and draw the figure."""
    content = json.loads(RAW.read_text(encoding="utf-8"))
    results = [result_of(row) for row in content["scenes"]]
    planner_plot(results, PLOT)
    lines = [HEADER, ["---"] * len(HEADER), *map(planner_cells, results)]
    rows = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    where = ", ".join(f"{name} {value}" for name, value in content["machine"].items())
    plot = f"![Time with everything, and as planned](images/{PLOT.name})"
    return f"{METHOD}\n\n{rows}\n\n{plot}\n\nMeasured on: {where}; {content['runs']} runs."


def write() -> None:
    """Write the text between its markers."""
    TARGET.write_text(with_content(TARGET, BEGIN, END, text()), encoding="utf-8")


def main() -> None:
    """Measure, unless only the text is wanted, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", action="store_true", help="measure nothing, write the text from the raw results")
    if not parser.parse_args().report:
        measure()
    write()


if __name__ == "__main__":
    main()
