"""The pictures of a report, drawn with matplotlib without a display."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tiler.accuracy.experiments import Candidate, default_kernel, kernels_of, run_cascade
from tiler.accuracy.findings import default_of, frontier
from tiler.accuracy.ideal import ideal_level, interior
from tiler.accuracy.sample import Sample
from tiler.accuracy.voids import VoidResult
from tiler.filters.kernels import frequency_response

_COLOURS: Final = {"blackman-sinc": "#c2410c", "kaiser": "#1d6fa5", "lanczos": "#2f7d4f", "box": "#6b4fa0", "triangle": "#6b4fa0"}
_SINCS: Final = ("blackman-sinc", "kaiser", "lanczos")
_RIVAL: Final = "#1b2a38"
_GREY: Final = "#b8c2cb"
_SHOWN: Final = 128
"""Side of the part of level 1 in the difference picture."""


@contextmanager
def drawing(path: Path, size: tuple[float, float], panels: int = 1) -> Iterator[Any]:
    """Give the axes of a new figure and write it to ``path`` in the end."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Fixed salt and no date: the same figures give the same file.
    with rc_context({"svg.hashsalt": "clipmap", "svg.fonttype": "path", "font.size": 10}):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(1, panels)
        yield axes
        figure.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else None)


def pareto(sample: Sample, candidates: Sequence[Candidate], path: Path) -> None:
    """Draw error against time: all candidates, and beside them clipmap's kernels closer up; the frontier as a line, the rest grey."""
    default = default_of(sample, candidates)
    own = [one for one in candidates if one.maker == "clipmap"]
    with drawing(path, (11, 5.2), 2) as (every, close):
        for axes, shown in ((every, candidates), (close, own)):
            best = frontier(candidates)
            axes.step(*_places([one for one in best if one in shown]), where="post", color=_RIVAL, linewidth=1.1, linestyle="--", zorder=2)
            for one in shown:
                _point(axes, one, one in best, axes is close)
            axes.plot(*_places([default]), "o", markersize=13, fillstyle="none", color=_COLOURS["blackman-sinc"], markeredgewidth=1.8)
            axes.set(yscale="log", xlabel="time of one halving [ms per million samples]", ylabel=f"rms error of level 1 [{sample.unit}]")
            axes.grid(which="both", alpha=0.2)
        every.set(xscale="log")
        every.set_xlim(right=20 * every.get_xlim()[1])
        every.set_title(f"{sample.name}: error against time", loc="left")
        close.set_title("clipmap's kernels, with their radius; circled: the default", loc="left", fontsize=10)
        plain_ticks([every.yaxis, close.yaxis], (1.0, 2.0, 5.0))
        plain_ticks([every.xaxis], (1.0,))
        _legend(close)


def _legend(axes: Any) -> None:  # noqa: ANN401 - matplotlib has no types
    handles = [axes.plot([], [], "o-", color=_COLOURS[name], label=name)[0] for name in _SINCS]
    handles.append(axes.plot([], [], "o", color=_GREY, label="dominated")[0])
    handles.append(axes.plot([], [], "--", color=_RIVAL, label="frontier")[0])
    axes.legend(handles=handles, loc="upper right")


def _places(candidates: Sequence[Candidate]) -> tuple[list[float], list[float]]:
    return [one.ms_per_megasample for one in candidates], [one.errors[0].rms for one in candidates]


def _point(axes: Any, one: Candidate, on_frontier: bool, with_radius: bool) -> None:  # noqa: ANN401
    colour = _COLOURS.get(one.kernel or "", _RIVAL)
    x, y = one.ms_per_megasample, one.errors[0].rms
    size, order = (6, 4) if on_frontier else (5, 3)
    marker = "o" if one.maker == "clipmap" else "s"
    axes.plot([x], [y], marker, color=colour if on_frontier else _GREY, markersize=size, zorder=order)
    label = one.name if one.kernel not in _SINCS else str(one.radius) if with_radius else ""
    axes.annotate(label, (x, y), xytext=(6, 3), textcoords="offset points", fontsize=8, color=colour, zorder=order)


def plain_ticks(logarithmic: Sequence[Any], digits: tuple[float, ...]) -> None:
    """Label logarithmic axes at these digits, with numbers as people write them."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for axis in logarithmic:
        axis.set_major_locator(LogLocator(subs=digits))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def responses(sample: Sample, candidates: Sequence[Candidate], path: Path) -> None:
    """Draw the gain of the default, of the other designs at its radius, and of box."""
    kernels, radius = kernels_of(sample), default_kernel(sample).radius
    frequency = np.linspace(0, 1, 801)
    with drawing(path, (9, 3.8), 2) as (linear, decibel):
        for name in ("box", f"blackman-sinc {radius}", f"kaiser {radius}", f"lanczos {radius}"):
            gain = frequency_response(kernels[name], frequency)
            style = {"color": _COLOURS[name.split()[0]], "label": name, "linewidth": 1.6}
            linear.plot(frequency, gain, **style)
            decibel.plot(frequency, 20 * np.log10(np.maximum(np.abs(gain), 1e-6)), **style)
        linear.plot([0, 0.5, 0.5, 1], [1, 1, 0, 0], color=_GREY, linewidth=1, label="ideal", zorder=0)
        linear.set(xlabel="u [cycles per coarse sample]", ylabel="gain", xlim=(0, 1))
        decibel.set(xlabel="u [cycles per coarse sample]", ylabel="gain [dB]", xlim=(0, 1), ylim=(-100, 5))
        linear.legend()
        for axes in (linear, decibel):
            axes.axvline(0.5, color=_GREY, linestyle=":", zorder=0)
            axes.grid(alpha=0.2)


def differences(sample: Sample, path: Path) -> None:
    """Draw a part of the ideal level 1 and what box and the default make of it, on one scale; the first channel."""
    kernels, default = kernels_of(sample), default_kernel(sample)
    ideal = ideal_level(sample.values.astype(np.float64), 1, sample.registration, sample.edge)
    chosen = {"box": kernels["box"], f"{default.name} {default.radius}": default}
    errors = {
        name: interior(run_cascade(sample.values, None, kernel, sample.edge, 1)[0][0] - ideal)[..., 0] for name, kernel in chosen.items()
    }
    part = _worst_part(errors["box"])
    scale = float(np.percentile(np.abs(errors["box"][part]), 99.5))
    with drawing(path, (10, 3.9), 3) as axes:
        axes[0].imshow(interior(ideal)[..., 0][part], cmap="gray", interpolation="nearest")
        axes[0].set_title("ideal level 1", loc="left")
        for panel, (name, error) in zip(axes[1:], errors.items(), strict=True):
            picture = panel.imshow(error[part], cmap="RdBu_r", vmin=-scale, vmax=scale, interpolation="nearest")
            panel.set_title(f"{name}: rms {np.sqrt(np.mean(error[part] ** 2)):.3g} {sample.unit}", loc="left")
        panel.figure.colorbar(picture, ax=axes[1:], label=f"level 1 - ideal [{sample.unit}]", shrink=0.85)
        for panel in axes:
            panel.set(xticks=[], yticks=[])


def _worst_part(error: NDArray[np.float64]) -> tuple[slice, slice]:
    """Return the part, of a grid of such parts, in which the mean square is largest."""
    side = min(_SHOWN, *error.shape)
    corners = [(y, x) for y in range(0, error.shape[0] - side + 1, side) for x in range(0, error.shape[1] - side + 1, side)]
    y, x = max(corners, key=lambda corner: float((error[corner[0] : corner[0] + side, corner[1] : corner[1] + side] ** 2).sum()))
    return slice(y, y + side), slice(x, x + side)


def voids(sample: Sample, results: Sequence[VoidResult], path: Path) -> None:
    """Draw what is lost, and the error where samples are whole, against the share of voids; scattered full, holes dashed."""
    names = list(dict.fromkeys(result.filter for result in results))
    colours = dict(zip(names, ("#c2410c", "#1d6fa5", "#2f7d4f", "#6b4fa0"), strict=True))
    with drawing(path, (9, 3.8), 2) as (lost, error):
        for pattern, style in (("scattered", "o-"), ("holes", "s--")):
            for name in names:
                own = [result for result in results if (result.filter, result.pattern) == (name, pattern)]
                shares = [100 * result.share for result in own]
                label = name if pattern == "scattered" else None
                lost.plot(shares, [100 * result.lost_share for result in own], style, color=colours[name], markersize=3.5, label=label)
                rms = [np.nan if result.whole_rms is None else result.whole_rms for result in own]
                error.plot(shares, rms, style, color=colours[name], markersize=3.5)
        lost.set(xlabel="void samples [%]", ylabel="level 1 lost [%]")
        error.set(xlabel="void samples [%]", ylabel=f"rms where samples are whole [{sample.unit}]")
        lost.plot([], [], "k-", label="scattered")
        lost.plot([], [], "k--", label="in holes")
        lost.legend(fontsize=8)
        for axes in (lost, error):
            axes.grid(alpha=0.2)
