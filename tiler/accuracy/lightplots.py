"""The picture of what accuracy of light costs: error against time, a panel for each thing that is found."""

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
}
_SHORT: Final = (
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
    with drawing(path, (15, 4.4), len(_TITLES)) as panels:
        for axes, (experiment, (title, label)) in zip(panels, _TITLES.items(), strict=True):
            own = [one for one in results if one.experiment == experiment and one.azimuth_deg in (None, SUNS[1][0])]
            _panel(axes, own, [one for one in best if one in own])
            axes.set_title(f"{title}" + (f", sun at {SUNS[1][1]:g}°" if experiment in ("shadow", "disc") else ""), loc="left", fontsize=10)
            axes.set(ylabel=label, xlabel="time [ns per sample]", xscale="log", yscale="log")
            axes.grid(which="both", alpha=0.15)
            axes.set_xlim(right=6 * axes.get_xlim()[1])
            plain_ticks([axes.xaxis], (1.0,))
            plain_ticks([axes.yaxis], (1.0, 3.0))
        panels[0].figure.suptitle(f"{name}: error against time, K = exact steps; the frontier is joined", x=0.01, ha="left", fontsize=11)


def _panel(axes: Any, results: Sequence[LightResult], best: Sequence[LightResult]) -> None:  # noqa: ANN401 - matplotlib has no types
    floor = min((one.error for one in results if one.error > 0), default=1.0) / 4
    axes.plot([one.ns_per_sample for one in best], [max(one.error, floor) for one in best], "--", color=_DARK, linewidth=1, zorder=2)
    for one in results:
        place = one.ns_per_sample, max(one.error, floor)
        colour = _ORANGE if one in best else _GREY
        axes.plot(*place, "v" if one.error == 0 else "o", color=colour, markersize=6, zorder=3)
        label = one.method
        for long, short in _SHORT:
            label = label.replace(long, short)
        label = "0 exact" if label == "" else label
        axes.annotate(label + (", 0 wrong" if one.error == 0 else ""), place, (5, 3), textcoords="offset points", fontsize=7, color=colour)
