"""What a build of clipmap is to reach beside other programs, and what was measured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

from tests.bench.peers_tables import Result, Row, programs_of, ratios, rows_of, runs_of, stored_bytes, table

Measure = Callable[[Result], list[float]]


@dataclass(frozen=True, slots=True)
class Target:
    """A bound on the median of some figures; ``measure`` returns one per round, or none where something was not measured."""

    work: str
    quantity: str
    bound: float
    at_least: bool
    measure: Measure
    unit: str = "×"

    @property
    def demand(self) -> str:
        """The bound in words."""
        unit = f" {self.unit}"
        return f"{'≥' if self.at_least else '≤'} {self.bound:g}{unit}"

    @property
    def digits(self) -> int:
        """Decimals that show on which side of the bound a figure lies."""
        if self.unit != "×":
            return 0
        return 4 if self.quantity.startswith("size") else 2 if self.bound > 1.5 else 3

    def met(self, values: Sequence[float]) -> bool:
        """Return whether the median reaches the bound."""
        return median(values) >= self.bound if self.at_least else median(values) <= self.bound


def faster(case: str, peer: str, own: str) -> Measure:
    """Return how to find the wall time of ``peer`` over that of ``own``, start of both included."""
    return lambda result: ratios(runs_of(result, case, peer), runs_of(result, case, own))


def size(case: str, own: str, peer: str) -> Measure:
    """Return how to find the stored bytes of ``own`` over those of ``peer``."""

    def measure(result: Result) -> list[float]:
        return [stored_bytes(a) / stored_bytes(b) for a, b in zip(runs_of(result, case, own), runs_of(result, case, peer), strict=False)]

    return measure


def memory_mb(case: str, own: str) -> Measure:
    """Return how to find the largest resident size of all runs."""

    def measure(result: Result) -> list[float]:
        found = [row["peak_rss_bytes"] / 1e6 for row in runs_of(result, case, own)]
        return [max(found)] if found else []

    return measure


def _differing(result: Result) -> list[float]:
    found = result.get("box", [])
    return [float(sum(row["different"] for row in found))] if found else []


def _growth(of: Callable[[Row], float]) -> Measure:
    """Return how to find a figure of the large source over that of the small one."""

    def measure(result: Result) -> list[float]:
        programs = list(programs_of(rows_of(result, "growth")).values())
        if len(programs) != 2:
            return []
        small = {row["run"]: of(row) for row in programs[0]}
        return [of(row) / small[row["run"]] for row in programs[1] if row["run"] in small]

    return measure


def _workers(codec: str) -> Measure:
    one, two = f"clipmap {codec} --workers 1", f"clipmap {codec} --workers 2"
    return lambda result: ratios(runs_of(result, "workers", one), runs_of(result, "workers", two), "build_s")


LERC: Final = "clipmap lerc:0.1"
TARGETS: Final = (
    Target("large RGB to JPEG", "faster than `vips dzsave`", 2.0, True, faster("jpeg", "vips dzsave", "clipmap")),
    Target("large RGB to JPEG", "faster than `gdal2tiles.py` (WebP)", 20, True, faster("jpeg", "gdal2tiles.py, WebP", "clipmap")),
    Target("large RGB to JPEG", "peak RSS", 400, False, memory_mb("jpeg", "clipmap"), "MB"),
    Target("the same, box", "time beside Blackman-sinc", 1.0, False, faster("jpeg", "clipmap --filter box", "clipmap")),
    Target("the same, box", "samples that are not the 2 × 2 mean", 0, False, _differing, "samples"),
    Target("small RGB to JPEG", "faster than `vips dzsave`, with start", 1.3, True, faster("jpeg-small", "vips dzsave", "clipmap")),
    Target("large RGB to PNG", "faster than `vips dzsave`", 1.0, True, faster("png", "vips dzsave", "clipmap")),
    Target("large RGB to PNG", "size beside `vips dzsave`", 1.0, False, size("png", "clipmap", "vips dzsave")),
    Target("large heights", "faster than GDAL COG LERC, lanczos", 2.0, True, faster("heights", "GDAL COG LERC, lanczos", LERC)),
    Target("large heights", "faster than GDAL COG LERC, average", 2.0, True, faster("heights", "GDAL COG LERC, average", LERC)),
    Target("large heights", "size beside GDAL COG LERC", 1.0, False, size("heights", LERC, "GDAL COG LERC, lanczos")),
    Target("growth, 4 times the side", "time per sample", 1.1, False, _growth(lambda row: float(row["wall_s"] / row["side"] ** 2))),
    Target(
        "growth, 4 times the side",
        "time per sample, start left out",
        1.1,
        False,
        _growth(lambda row: float(row["build_s"] / row["side"] ** 2)),
    ),
    Target("growth, 4 times the side", "peak RSS", 1.1, False, _growth(lambda row: float(row["peak_rss_bytes"]))),
    Target("second core, PNG", "faster with 2 workers", 1.8, True, _workers("png")),
    Target("second core, JPEG (not bound by encoding)", "faster with 2 workers", 1.8, True, _workers("jpeg:85")),
)


def targets(result: Result) -> str:
    """Return every target, the median that was measured, its spread, and whether that is enough."""
    lines = []
    for target in TARGETS:
        values = target.measure(result)
        found = ["not measured", "", ""]
        if values:
            digits = target.digits
            several = f"{min(values):.{digits}f}–{max(values):.{digits}f}" if len(values) > 1 else "one figure"
            found = [f"{median(values):.{digits}f}", several, "yes" if target.met(values) else "**no**"]
        lines.append([target.work, target.quantity, target.demand, *found])
    return table(("work", "what", "target", "median", "spread of rounds", "met"), lines)
