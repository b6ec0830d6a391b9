"""The part of a report on light: all results of one ground, as raw values, as rows, and as a section of the page."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from html import escape
from typing import Any, Final

import numpy as np

from tiler.accuracy.lightexperiments import (
    ALBEDO,
    BOUNCE_AZIMUTHS,
    DISC_SIDE,
    REFERENCE_AZIMUTHS,
    REFERENCE_CHORDS,
    SHARE,
    SKY_SIDE,
    SUNS,
    LightResult,
    light_frontier,
    measure_lights,
)
from tiler.accuracy.lightfindings import brief, light_findings
from tiler.accuracy.lightground import Ground
from tiler.accuracy.lightprecision import LightRung, measure_light_precision
from tiler.accuracy.page import table

PLOT: Final = "light.svg"
_NAMES: Final = {
    "shadow": "Hard shadows",
    "horizon": "Horizons",
    "disc": "The sun's disc",
    "sky": "The light of the sky",
    "bounce": "Light that the ground throws back",
}
METHOD: Final = (
    "Truth is a walk in float64 along every ray: up to the edge, or to where even the highest sample could change nothing. Between the two "
    f"samples beside a ray the ground is a straight line. The disc is compared with {REFERENCE_CHORDS} upright chords, each with a walked "
    f"horizon, on the middle {DISC_SIDE} x {DISC_SIDE} samples; the sky with {REFERENCE_AZIMUTHS} azimuths, on the middle {SKY_SIDE} x "
    f"{SKY_SIDE}; shadows and horizons on all samples but 16 at each border. Codes are those of 8 bits: 255 is the whole sun, or sky. "
    "Times are processor times on one thread for all of the ground, turning it included: the least of all runs; walks are timed once. "
    "The interpolated walk is its own truth, so its error is 0 by definition. "
    f"Light that the ground throws back is gathered from {REFERENCE_AZIMUTHS} azimuths of walked rays, from every sample of the ground "
    f"that is seen, by the cosine law, on the middle {SKY_SIDE} x {SKY_SIDE}; ground beyond the edge is as bright as the mean. Codes are "
    f"those of light as it is stored, with a sky of {SHARE:g} and an albedo of {ALBEDO:g}. Times there are what is added to direct light, "
    f"the horizons of {BOUNCE_AZIMUTHS} azimuths included where they are needed; rays are timed on the samples that are compared."
)


@dataclass(frozen=True, slots=True)
class LightReport:
    """All results of one ground."""

    ground: Ground
    results: tuple[LightResult, ...]
    precision: tuple[LightRung, ...]

    @property
    def findings(self) -> list[str]:
        """What the figures mean, one sentence each."""
        return light_findings(self.results)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values, ready for JSON."""
        height, width = self.ground.heights_m.shape
        steepness = np.hypot(*self.ground.slopes())
        slopes = {f"slope_p{share}": float(np.percentile(steepness, share)) for share in (50, 99)}
        return {
            "ground": {"width": width, "height": height, "cell_m": list(self.ground.cell_m), "relief_m": self.ground.relief_m} | slopes,
            "findings": self.findings,
            "results": self.rows(),
            "precision": [asdict(rung) for rung in self.precision],
        }

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row per result, with whether it lies on the frontier."""
        best = light_frontier(self.results)
        return [asdict(one) | {"frontier": one in best} for one in self.results]


def measure_light(ground: Ground, runs: int, on_stage: Callable[[str], None] = lambda stage: None) -> LightReport:
    """Run all experiments on light; ``on_stage`` is told what comes next."""
    on_stage("light: shadows, horizons, the sun's disc, the sky, light thrown back")
    results = measure_lights(ground, runs)
    on_stage("light: precision")
    return LightReport(ground, tuple(results), tuple(measure_light_precision(ground, SUNS)))


def light_section(light: dict[str, Any]) -> str:
    """Return the section of the page, for the raw values that ``LightReport.as_dict`` gives."""
    ground = light["ground"]
    about = (
        f"{ground['width']} × {ground['height']} samples of {ground['cell_m'][0]:.4g} × {ground['cell_m'][1]:.4g} m, relief "
        f"{ground['relief_m']:.4g} m; half of the slopes exceed {ground['slope_p50']:.2g}, one in a hundred {ground['slope_p99']:.2g}."
    )
    said = "".join(f"<li>{escape(sentence)}</li>" for sentence in light["findings"])
    tables = "".join(f"<h3>{title}</h3>{_table(light, experiment)}" for experiment, title in _NAMES.items())
    picture = f'<figure><img src="{PLOT}" alt=""><figcaption>Error against time. The line is the frontier.</figcaption></figure>'
    note = f'<p class="note">{escape(METHOD)} Raw results: <a href="light.csv">light.csv</a>.</p>'
    return f"<h2>Light</h2><p>{about}</p><ul>{said}</ul>{picture}{tables}{_precision(light)}{note}"


def _table(light: dict[str, Any], experiment: str) -> str:
    rows = [row for row in light["results"] if row["experiment"] == experiment]
    head = ["", "sun", "ns/sample", "median", f"error [{rows[0]['unit']}]", "p99.9", "max"]
    lines = []
    for row in rows:
        sun = "" if row["azimuth_deg"] is None else f"{row['azimuth_deg']:g}°"
        sun += "" if row["elevation_deg"] is None else f" at {row['elevation_deg']:g}°"
        figures = [row[key] for key in ("ns_per_sample", "median_ns_per_sample", "error", "p999", "largest")]
        cells = [row["method"], sun, *("" if value is None else brief(value) for value in figures)]
        lines.append(("frontier" if row["frontier"] else "", cells))
    return table(head, lines)


def _precision(light: dict[str, Any]) -> str:
    head = ["heights moved by [m]", "sun at", "state float32: changed %", "float64: changed %"]
    keys = ("wrong_float32_percent", "wrong_float64_percent")
    rows = [
        ("", [f"{r['offset_m']:,.0f}".replace(",", " "), f"{r['elevation_deg']:g}°", *(f"{r[key]:.3g}" for key in keys)])
        for r in light["precision"]
    ]
    return f"<h3>Precision of a sweep's state</h3>{table(head, rows)}"
