"""The tables of what programs cost, made from the raw results."""

from collections.abc import Sequence
from statistics import median
from typing import Any, Final

Row = dict[str, Any]
Result = dict[str, Any]

STAGES: Final = ("read", "filter", "encode", "write")
NOTHING: Final = "Not measured."
BETTER: Final = 0.995
"""A ratio below this is a loss: it reads as less than 1.00."""
BUSY: Final = 0.1
"""Share of all processors used by others from which a run is called disturbed."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table, or that there is nothing to show."""
    if not rows:
        return NOTHING
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def runs_of(result: Result, case: str, program: str) -> list[Row]:
    """Return the runs of a program in a case, none if it was not measured."""
    return [row for row in rows_of(result, case) if row["program"] == program]


def rows_of(result: Result, case: str) -> list[Row]:
    """Return all runs of a case, none if it was not measured."""
    return list(result["cases"].get(case, {"rows": []})["rows"])


def programs_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the runs of every program, in the order in which they were measured."""
    return {name: [row for row in rows if row["program"] == name] for name in dict.fromkeys(row["program"] for row in rows)}


def ratios(over: Sequence[Row], under: Sequence[Row], key: str = "wall_s") -> list[float]:
    """Return ``key`` of one program over that of another in the same round, for each round that both took part in."""
    of_round = {row["run"]: row[key] for row in under}
    return [row[key] / of_round[row["run"]] for row in over if row["run"] in of_round]


def spread(values: Sequence[float], digits: int = 2) -> str:
    """Return median, least and most."""
    return f"{median(values):.{digits}f} ({min(values):.{digits}f}–{max(values):.{digits}f})"


def beside(runs: Sequence[Row], own: Sequence[Row]) -> str:
    """Return the spread of the ratios of wall time, or nothing if the two have no round in common."""
    found = ratios(runs, own)
    return spread(found) if found else ""


def stored_bytes(row: Row) -> int:
    """Return the bytes of a run's output without what clipmap keeps for updates and repairs."""
    return int(row["output_bytes"] - row["record_bytes"])


def sides(rows: Sequence[Row]) -> str:
    """Return the size of the sources of a case, or the sizes."""
    return " and ".join(f"{side} × {side}" for side in sorted({row["side"] for row in rows}))


def heading(case: Row) -> str:
    """Return what a case is called over its table and in the picture."""
    return f"{sides(case['rows'])}: {case['title']}"


def _line(name: str, runs: Sequence[Row], own: Sequence[Row]) -> list[str]:
    first = runs[0]
    middle = {key: median(run[key] for run in runs) for key in ("cpu_s", "flush_s", "record_bytes", "files")}
    records = f" + {middle['record_bytes'] / 1e6:.1f}" if middle["record_bytes"] else ""
    return [
        f"{name} ({first['remark']})" if first["remark"] else name,
        first["filter"],
        f"{len(runs)}",
        spread([run["wall_s"] for run in runs]),
        f"{median(run['build_s'] for run in runs):.2f}" if "build_s" in first else "",
        beside(runs, own),
        f"{middle['cpu_s']:.2f}",
        f"{middle['flush_s']:.2f}",
        f"{max(run['peak_rss_bytes'] for run in runs) / 1e6:.0f}",
        f"{median(stored_bytes(run) for run in runs) / 1e6:.1f}{records}",
        f"{middle['files']:.0f}",
    ]


def _disturbance(rows: Sequence[Row]) -> str:
    others = [100 * row["others"] for row in rows]
    said = f"Others used {median(others):.1f} % of the processors (median of the runs; at most {max(others):.0f} %)"
    again = sum(row.get("tries", 1) > 1 for row in rows)
    left = sum(row["others"] > BUSY for row in rows)
    if again:
        said += f"; {again} of {len(rows)} runs were repeated because of that"
    if left:
        said += f"; {left} runs were disturbed by more than {100 * BUSY:.0f} % in every try"
    return f"{said}."


def comparison(result: Result) -> str:
    """Return one table per case, with what others used meanwhile."""
    parts = []
    head = ("program", "filter", "runs", "wall s", "build s", "ratio", "CPU s", "flush s", "RSS MB", "output MB", "files")
    for case in result["cases"].values():
        programs = programs_of(case["rows"])
        lines = [_line(name, runs, programs.get(runs[0]["against"], [])) for name, runs in programs.items() if runs]
        parts.append(f"### {heading(case)}\n\n{table(head, lines)}\n\n{_disturbance(case['rows'])}")
    return "\n\n".join(parts) or NOTHING


def stage_seconds(runs: Sequence[Row], processors: int) -> dict[str, float]:
    """Return the medians of the stages of a build [thread seconds per megasample], of ``rest``, which none claims, and ``given``."""
    million = runs[0]["side"] ** 2 / 1e6
    took = {stage: median(run[f"{stage}_s_per_megasample"] for run in runs) for stage in STAGES}
    given = [processors * run["build_s"] / million for run in runs]
    claimed = [sum(run[f"{stage}_s_per_megasample"] for stage in STAGES) for run in runs]
    return took | {"rest": median(a - c for a, c in zip(given, claimed, strict=True)), "given": median(given)}


def stages(result: Result) -> str:
    """Return what clipmap's stages take per megasample of the source, workers added up, and what is left of their time."""
    lines = []
    for key, case in result["cases"].items():
        for name, runs in programs_of(case["rows"]).items():
            if "build_s" not in runs[0] or key == "layouts":
                continue
            workers = 1 if name.endswith("--workers 1") else case["machine"]["processors"]
            took = stage_seconds(runs, workers)
            shares = [f"{1000 * took[stage]:.1f} ({100 * took[stage] / took['given']:.0f} %)" for stage in (*STAGES, "rest")]
            start = median(run["wall_s"] - run["build_s"] for run in runs)
            lines.append([f"{runs[0]['side']}²", f"{case['title']}: {name}", *shares, f"{start:.2f}"])
    return table(("source", "build", *STAGES, "rest", "before and after s"), lines)


def losses(result: Result) -> str:
    """Return every program that was faster than the build of clipmap it is compared with, or needed less memory or space."""
    lines = []
    for case in result["cases"].values():
        programs = programs_of(case["rows"])
        for name, runs in programs.items():
            own = programs.get(runs[0]["against"], [])
            if name.startswith("clipmap") or not ratios(runs, own):
                continue
            found = {
                "wall": median(ratios(runs, own)),
                "cpu": median(ratios(runs, own, "cpu_s")),
                "rss": max(r["peak_rss_bytes"] for r in runs) / max(r["peak_rss_bytes"] for r in own),
                "size": median(map(stored_bytes, runs)) / median(map(stored_bytes, own)),
            }
            if min(found.values()) < BETTER and not runs[0]["remark"].startswith("coarse levels only"):
                marked = [f"**{value:.2f}**" if value < BETTER else f"{value:.2f}" for value in found.values()]
                lines.append([heading(case), name, runs[0]["against"], *marked])
    return table(("work", "program", "beside", "time", "CPU", "memory", "size"), lines)


def conditions(result: Result) -> str:
    """Return the machine, the programs, and when and where each case was measured."""
    about: dict[str, list[str]] = {}
    for case in result["cases"].values():
        machine = case["machine"]
        where = f"{machine['processors']} processors ({machine['processor']}), {machine['memory_bytes'] / 2**30:.0f} GiB of memory, "
        where += f"{machine['system']}, Python {machine['python']}; output on {case['file_system']}"
        when = f"{heading(case)}: {case['time']}, load average before it {case['load']:.1f}"
        about.setdefault(where, []).append(when)
    lines = [f"- {where}." for where in about]
    lines.append(f"- Programs: {'; '.join(f'{name}: {said}' for name, said in result['versions'].items())}.")
    lines += [f"- {when}." for several in about.values() for when in several]
    return "\n".join(lines)
