"""What every stage of a build takes beside what it would take at this machine's limits, and which stage binds."""

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from tests.bench.peers_tables import NOTHING, STAGES, Result, runs_of, stage_seconds, stored_bytes, table

LEVELS_SHARE: Final = 4 / 3
"""Samples of all levels over those of the finest."""
FILTER_BYTES: Final = 9 * LEVELS_SHARE
"""Moved per source sample and channel by the two loops of every halving: float32 rows in, half as many out, these in, a quarter out."""
LIMITS: Final = (
    ("copy_bytes_1_thread", "copying memory, 1 thread", 1e9, "GB/s, read and written"),
    ("copy_bytes_all_threads", "copying memory, all processors", 1e9, "GB/s, read and written"),
    ("read_bytes", "a source out of the page cache, not decoded", 1e9, "GB/s, 1 thread"),
    ("filter_rgb_blackman_sinc_3", "one halving, RGB, blackman-sinc 3", 1e6, "Msamples/s, 1 thread"),
    ("filter_rgb_box", "one halving, RGB, box", 1e6, "Msamples/s, 1 thread"),
    ("filter_height_blackman_sinc_6", "one halving, heights, blackman-sinc 6", 1e6, "Msamples/s, 1 thread"),
    ("filter_height_box", "one halving, heights, box", 1e6, "Msamples/s, 1 thread"),
    ("encode_jpeg_85", "JPEG encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_png", "PNG encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_lerc_0.1", "LERC encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_exr_float", "OpenEXR encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("encode_png16", "16-bit PNG encoder alone", 1e6, "Msamples/s, 1 thread"),
    ("files_1_thread", "new files of 25 kB, not waited for, 1 thread", 1e3, "thousand/s"),
    ("files_all_threads", "the same, all processors, a folder each", 1e3, "thousand/s"),
    ("disk_bytes", "one file of 256 MiB until the disk has it", 1e6, "MB/s"),
)
SINC_3: Final = "filter_rgb_blackman_sinc_3"
SINC_6: Final = "filter_height_blackman_sinc_6"
BUILDS: Final = (
    ("jpeg", "clipmap", SINC_3, "encode_jpeg_85"),
    ("jpeg", "clipmap --filter box", "filter_rgb_box", "encode_jpeg_85"),
    ("png", "clipmap", SINC_3, "encode_png"),
    ("heights", "clipmap lerc:0.1", SINC_6, "encode_lerc_0.1"),
    ("heights", "clipmap lerc:0.1 --filter box", "filter_height_box", "encode_lerc_0.1"),
    ("heights", "clipmap exr:float", SINC_6, "encode_exr_float"),
    ("heights", "clipmap png16", SINC_6, "encode_png16"),
)
CAPTION: Final = (
    "% of the build. Upper bar: measured; lower, pale bar: each stage at this machine's limit\n"
    "Figures: thread milliseconds per million samples"
)
COLOURS: Final = ("#7a9e7e", "#1b6ca8", "#c8803c", "#8c5a91", "#c5ccd1")


@dataclass(frozen=True, slots=True)
class Roof:
    """One build: thread milliseconds per megasample of each stage, measured and at the limits, and bytes moved per source sample."""

    name: str
    measured: dict[str, float]
    limits: dict[str, float]
    moved: dict[str, float]
    memory_ms: float


def roofs(result: Result) -> Iterator[Roof]:
    """Yield every build that was measured, if the limits were measured too."""
    rates = result.get("limits")
    if not rates:
        return
    for case, name, halving, encoder in BUILDS:
        runs = runs_of(result, case, name)
        if not runs:
            continue
        kind, samples = runs[0]["source"]["kind"], runs[0]["side"] ** 2
        channels, sample_bytes = (3, 3) if kind == "rgb" else (1, 4)
        processors = result["cases"][case]["machine"]["processors"]
        out = median(map(stored_bytes, runs)) / samples
        moved = {
            "read": 2.0 * sample_bytes,
            "filter": FILTER_BYTES * channels,
            "encode": LEVELS_SHARE * sample_bytes + out,
            "write": 2 * out,
        }
        yield Roof(
            f"RGB to {case.upper()}{name.removeprefix('clipmap')}" if kind == "rgb" else f"heights to {name.removeprefix('clipmap ')}",
            {stage: 1000 * seconds for stage, seconds in stage_seconds(runs, processors).items()},
            {
                "read": 1e9 * sample_bytes / rates["read_bytes"],
                "filter": 1e9 * LEVELS_SHARE / rates[halving],
                "encode": 1e9 * LEVELS_SHARE / rates[encoder],
                "write": 1e9 * (median(run["files"] for run in runs) / samples) / rates["files_1_thread"],
            },
            moved,
            1e9 * processors * sum(moved.values()) / rates["copy_bytes_all_threads"],
        )


def limits(result: Result) -> str:
    """Return the rates that were measured on their own."""
    found = result.get("limits", {})
    return table(("what", "rate", "unit"), [[what, f"{found[key] / unit:,.4g}", of] for key, what, unit, of in LIMITS if key in found])


def roofline(result: Result) -> str:
    """Return stages beside limits, what binds, and the bytes moved beside the rate at which memory is copied."""
    stages, memory = [], []
    for roof in roofs(result):
        parts = [f"{roof.measured[stage]:.1f} / {roof.limits[stage]:.1f}" for stage in STAGES]
        largest = max((*STAGES, "rest"), key=lambda stage: roof.measured[stage])
        share = f"{largest}, {100 * roof.measured[largest] / roof.measured['given']:.0f} %"
        stages.append(
            [roof.name, *parts, f"{roof.measured['rest']:.1f}", f"{roof.measured['given']:.1f} / {sum(roof.limits.values()):.1f}", share]
        )
        bytes_ = [f"{roof.moved[stage]:.1f}" for stage in STAGES]
        used = f"{100 * roof.memory_ms / roof.measured['given']:.0f} %"
        memory.append([roof.name, *bytes_, f"{sum(roof.moved.values()):.1f}", f"{roof.memory_ms:.1f}", used])
    if not stages:
        return NOTHING
    first = table(("build", *STAGES, "rest", "all", "what binds"), stages)
    second = table(("bytes moved per source sample", *STAGES, "all", "at the rate of copying", "of the build"), memory)
    return f"{first}\n\n{second}"


def draw_roofline(result: Result, path: Any) -> None:
    """Draw for every build its stages, stacked, and under them what they would take at the limits."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = list(roofs(result))
    figure = Figure(figsize=(9, 1.2 + 0.75 * len(found)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, roof in enumerate(found):
        whole = sum(roof.measured[stage] for stage in (*STAGES, "rest"))
        for offset, values, alpha in ((-0.19, roof.measured, 1.0), (0.19, roof.limits, 0.55)):
            left = 0.0
            for stage, colour in zip((*STAGES, "rest"), COLOURS, strict=True):
                width = 100 * max(0.0, values.get(stage, 0.0)) / whole
                axes.barh(place + offset, width, 0.36, left, color=colour, alpha=alpha, label=stage if place == 0 and alpha == 1 else None)
                left += width
            total = sum(values.get(stage, 0.0) for stage in (*STAGES, "rest"))
            axes.annotate(f"{total:.1f} ms", (left, place + offset), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(range(len(found)), [roof.name for roof in found])
    axes.invert_yaxis()
    axes.set_xlim(0, 115)
    axes.set_xlabel(CAPTION)
    axes.spines[["top", "right"]].set_visible(False)
    if found:
        axes.legend(ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=9)
    else:
        axes.set_title(NOTHING)
    figure.savefig(path, dpi=90)
