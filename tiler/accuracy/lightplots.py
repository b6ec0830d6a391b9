"""The picture of what accuracy of light costs: error against time, a panel for each thing that is found."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from tiler.accuracy.lightexperiments import SUNS, LightResult, light_frontier
from tiler.accuracy.plots import drawing, plain_ticks

_ORANGE: Final = "#c2410c"
_DARK: Final = "#1b2a38"
_GREY: Final = "#8a97a3"
_TITLES: Final = {
    "shadow": ("hard shadows", "wrong samples [%]"),
    "horizon": ("horizons toward one azimuth", "rms error [degrees]"),
    "disc": ("the sun's disc", "rms error [8-bit codes]"),
    "sky": ("light of the sky", "rms error [8-bit codes]"),
    "bounce": ("light thrown back", "rms error [8-bit codes]"),
}
_SHIPPED: Final = "clipmap light"
_NEAR_X: Final = 0.22
_NEAR_Y: Final = 0.03
"""Shares of a panel within which two labels would lie upon each other."""
_SHORT: Final = (
    ("clipmap light --", "--"),
    (" azimuths of rays", " az of rays"),
    ("mean within", "mean in"),
    (" exact steps", ""),
    (" azimuths,", " az, K"),
    ("hulls,", "K"),
    ("sweep, ", ""),
    ("1 horizon,", "K"),
    ("horizons,", "az, K"),
    (" sample", ""),
    ("interpolated", "linear"),
)


def light_pareto(name: str, results: Sequence[LightResult], path: Path) -> None:
    """Draw all methods; the frontier is coloured and joined, what is exact stands on the lower edge."""
    best = light_frontier(results)
    with drawing(path, (18.5, 4.4), len(_TITLES)) as panels:
        for axes, (experiment, (title, label)) in zip(panels, _TITLES.items(), strict=True):
            own = [one for one in results if one.experiment == experiment and one.azimuth_deg in (None, SUNS[1][0])]
            _panel(axes, own, [one for one in best if one in own])
            axes.set_title(
                f"{title}" + (f", sun at {SUNS[1][1]:g}°" if experiment in ("shadow", "disc", "bounce") else ""), loc="left", fontsize=10
            )
            axes.set(ylabel=label, xlabel="time [ns per sample]", xscale="log", yscale="log")
            axes.grid(which="both", alpha=0.15)
            low, high = axes.get_xlim()
            axes.set_xlim(right=high * max(6, (high / low) ** 0.3))
            plain_ticks([axes.xaxis], (1.0,))
            plain_ticks([axes.yaxis], (1.0, 3.0))
        panels[0].figure.suptitle(
            f"{name}: error against time, K = exact steps, diamonds = clipmap light; the frontier is joined", x=0.01, ha="left", fontsize=11
        )


def _panel(axes: Any, results: Sequence[LightResult], best: Sequence[LightResult]) -> None:  # noqa: ANN401 - matplotlib has no types
    floor = min((one.error for one in results if one.error > 0), default=1.0) / 4
    axes.plot([one.ns_per_sample for one in best], [max(one.error, floor) for one in best], "--", color=_DARK, linewidth=1, zorder=2)
    spots = [(math.log(one.ns_per_sample), math.log(max(one.error, floor))) for one in results]
    wide, tall = (max(1e-9, max(axis) - min(axis)) for axis in zip(*spots, strict=True))
    labelled: list[tuple[float, float]] = []
    # What the command runs first: where methods meet, one label is enough.
    order = sorted(zip(results, spots, strict=True), key=lambda pair: (not pair[0].method.startswith(_SHIPPED), pair[0] not in best))
    for one, (right, up) in order:
        place = one.ns_per_sample, max(one.error, floor)
        colour = _ORANGE if one in best else _GREY
        shipped = one.method.startswith(_SHIPPED)
        axes.plot(*place, "v" if one.error == 0 else "D" if shipped else "o", color=colour, markersize=6, zorder=4 if shipped else 3)
        if any(abs(right - x) < _NEAR_X * wide and abs(up - y) < _NEAR_Y * tall for x, y in labelled):
            continue
        labelled.append((right, up))
        axes.annotate(_label(one), place, (5, 3), textcoords="offset points", fontsize=7, color=colour)


def _label(one: LightResult) -> str:
    label = one.method
    for long, short in _SHORT:
        label = label.replace(long, short)
    return ("0 exact" if label == "" else label) + (", 0 wrong" if one.error == 0 else "")
