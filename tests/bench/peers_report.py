"""Writes the tables and the picture of ``docs/PERFORMANCE.md`` from the results of ``peers.py``."""

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

DOCS: Final = Path(__file__).parents[2] / "docs"
TARGET: Final = DOCS / "PERFORMANCE.md"
PICTURE: Final = DOCS / "images/performance.png"
BEGIN: Final = "<!-- {name}: written by tests/bench/peers.py -->"
END: Final = "<!-- end of {name} -->"
STAGES: Final = ("read", "filter", "encode", "write")
LIMITS: Final = (
    ("copy_bytes_1_thread", "copying memory, 1 thread", 1e9, "GB/s, read and written"),
    ("copy_bytes_all_threads", "copying memory, all processors", 1e9, "GB/s, read and written"),
    ("read_rgb", "bytes of the source out of the page cache", 1e6, "Msamples/s of RGB"),
    ("filter_rgb_blackman_sinc_3", "one halving, RGB, blackman-sinc 3", 1e6, "Msamples/s, 1 thread"),
    ("filter_rgb_box", "one halving, RGB, box", 1e6, "Msamples/s, 1 thread"),
    ("filter_height_blackman_sinc_6", "one halving, heights, blackman-sinc 6", 1e6, "Msamples/s, 1 thread"),
    ("encode_jpeg_85", "JPEG encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_png", "PNG encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_lerc_0.1", "LERC encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("files_of_8_kB", "new files of 8 kB, not waited for", 1e3, "thousand/s"),
    ("disk_bytes", "one file of 256 MiB until the disk has it", 1e6, "MB/s"),
)

Row = dict[str, Any]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _of(rows: Sequence[Row], case: str) -> dict[str, list[Row]]:
    """Return the runs of every program of a case."""
    names = dict.fromkeys(row["program"] for row in rows if row["case"] == case)
    return {name: [row for row in rows if row["case"] == case and row["program"] == name] for name in names}


def _ratios(runs: Sequence[Row], own: Sequence[Row]) -> list[float]:
    """Return the wall time of a program over that of clipmap's default in the same round, for each round."""
    of_round = {row["run"]: row["wall_s"] for row in own}
    return [row["wall_s"] / of_round[row["run"]] for row in runs if row["run"] in of_round]


def _spread(values: Sequence[float]) -> str:
    return f"{median(values):.2f} ({min(values):.2f}–{max(values):.2f})"


def _case(rows: Sequence[Row], case: str) -> str:
    programs = _of(rows, case)
    own = next(iter(programs.values()))
    lines = []
    for name, runs in programs.items():
        first = runs[0]
        middle = {key: median(run[key] for run in runs) for key in ("cpu_s", "flush_s", "output_bytes", "record_bytes", "files")}
        built = f"{median(run['build_s'] for run in runs):.2f}" if "build_s" in first else ""
        records = f" + {middle['record_bytes'] / 1e6:.1f}" if middle["record_bytes"] else ""
        lines.append(
            [
                f"{name} ({first['remark']})" if first["remark"] else name,
                first["filter"],
                f"{len(runs)}",
                _spread([run["wall_s"] for run in runs]),
                built,
                f"{median(_ratios(runs, own)):.2f}",
                f"{middle['cpu_s']:.2f}",
                f"{middle['flush_s']:.2f}",
                f"{max(run['peak_rss_bytes'] for run in runs) / 2**20:.0f}",
                f"{(middle['output_bytes'] - middle['record_bytes']) / 1e6:.1f}{records}",
                f"{middle['files']:.0f}",
            ]
        )
    head = ("program", "filter", "runs", "wall s", "build s", "× clipmap", "CPU s", "flush s", "RSS MiB", "output MB", "files")
    return _table(head, lines)


def tables(results: Sequence[Row]) -> str:
    """Return one table per case and size, with the conditions under which it was measured."""
    parts = []
    for result in results:
        size = result["size"]
        for case in dict.fromkeys(row["case"] for row in result["rows"]):
            runs = [row for row in result["rows"] if row["case"] == case]
            others = [100 * row["other_cpu_s"] / (row["wall_s"] * result["machine"]["processors"]) for row in runs]
            busy = f"Other processes used {median(others):.1f} % of the processors (median of the runs; at most {max(others):.0f} %)."
            parts.append(f"### {size} × {size}: {case}\n\n{_case(result['rows'], case)}\n\n{busy}")
    return "\n\n".join(parts)


def _claimed_s(run: Row) -> float:
    return float(sum(run[f"{stage}_s_per_megasample"] for stage in STAGES))


def stages(results: Sequence[Row]) -> str:
    """Return what clipmap's stages take per megasample of the source, workers added up, and what is left of their time."""
    lines = []
    for result in results:
        million, workers = result["size"] ** 2 / 1e6, result["machine"]["processors"]
        for case in dict.fromkeys(row["case"] for row in result["rows"]):
            for name, runs in _of(result["rows"], case).items():
                if "build_s" not in runs[0]:
                    continue
                took = [median(run[f"{stage}_s_per_megasample"] for run in runs) for stage in STAGES]
                given = [workers * run["build_s"] / million for run in runs]
                start = median(run["wall_s"] - run["build_s"] for run in runs)
                took.append(median(all_s - _claimed_s(run) for all_s, run in zip(given, runs, strict=True)))
                shares = [f"{1000 * value:.1f} ({100 * value / median(given):.0f} %)" for value in took]
                what = f"{case}: {name.removeprefix('clipmap').strip() or 'default'}"
                lines.append([f"{result['size']}²", what, *shares, f"{start:.2f}"])
    return _table(("source", "build", *STAGES, "rest", "before and after s"), lines)


def limits(result: Row) -> str:
    """Return the rates that were measured on their own."""
    found = result["limits"]
    return _table(("what", "rate", "unit"), [[what, f"{found[key] / unit:,.4g}", of] for key, what, unit, of in LIMITS])


def conditions(results: Sequence[Row]) -> str:
    """Return machine, versions and load of each measurement."""
    lines = []
    for result in results:
        machine, load = result["machine"], result["load"]
        versions = "; ".join(f"{name}: {said.removeprefix(f'{name}, ')}" for name, said in result["versions"].items())
        lines.append(
            f"- **{result['size']}²**, {machine['time']}: {machine['processors']} processors ({machine['processor']}), "
            f"{machine['memory_bytes'] / 2**30:.0f} GiB, Python {machine['python']}; {versions}. "
            f"Load average before the first run {load[0]:.1f}, later {min(load[1:]):.1f} to {max(load[1:]):.1f}, these runs included."
        )
    return "\n".join(lines)


def draw(results: Sequence[Row], path: Path) -> None:
    """Draw the wall time of every program, a bar each with its spread, one panel per case of each result."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [(result, case) for result in results for case in dict.fromkeys(row["case"] for row in result["rows"])]
    counts = [len(_of(result["rows"], case)) for result, case in panels]
    figure = Figure(figsize=(9, 0.8 * len(panels) + 0.32 * sum(counts)), layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(len(panels), 1, squeeze=False, height_ratios=[count + 1 for count in counts])[:, 0]
    for axes, (result, case) in zip(every, panels, strict=True):
        programs = _of(result["rows"], case)
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
        axes.set_title(f"{result['size']} × {result['size']}: {case}, wall time of the command [s]", loc="left", fontsize=10)
    figure.savefig(path, dpi=90)


def _replaced(text: str, name: str, content: str) -> str:
    """Return ``text`` with ``content`` between the markers of ``name``."""
    begin, end = BEGIN.format(name=name), END.format(name=name)
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{TARGET}: the markers of {name} are missing")
    return f"{before}{begin}\n\n{content}\n\n{end}{after}"


def write_report(folder: Path) -> None:
    """Write the generated parts of ``docs/PERFORMANCE.md``, and its picture, from all results in ``folder``."""
    results = [json.loads(path.read_text()) for path in folder.glob("peers-*.json")]
    results.sort(key=lambda result: int(result["size"]))
    text = TARGET.read_text(encoding="utf-8")
    text = _replaced(text, "comparison", tables(results))
    text = _replaced(text, "stages", stages(results))
    text = _replaced(text, "limits", limits(results[0]))
    text = _replaced(text, "conditions", conditions(results))
    draw(results, PICTURE)
    TARGET.write_text(text, encoding="utf-8")
