"""The page of a report: one HTML file without scripts, made from the raw results; its pictures lie beside it."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, Final

_STYLE: Final = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b2a38; max-width: 72rem; margin: 2rem auto; padding: 0 1rem }
h1, h2 { line-height: 1.2 } h2 { margin-top: 2.5rem }
img { max-width: 100%; height: auto }
.table { overflow-x: auto } table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums }
th, td { padding: 0.2rem 0.55rem; text-align: right; border-bottom: 1px solid #dde4ea; white-space: nowrap }
th:first-child, td:first-child { text-align: left } thead th { border-bottom: 2px solid #1b2a38; white-space: normal }
tr.default td { font-weight: bold; background: #fff3e0 } tr.frontier td:first-child::after { content: " ●"; color: #c2410c }
figcaption, .note { color: #52616f; font-size: 0.9rem }
@media (prefers-color-scheme: dark) {
  body { background: #12181e; color: #dbe4ec } img { background: white } tr.default td { background: #43300f }
  th, td { border-color: #2c3944 } thead th { border-color: #dbe4ec } figcaption, .note { color: #9fb0bf }
}
"""


def page(content: dict[str, Any], light: str = "") -> str:
    """Return the page for the raw results of a report, as ``Report.as_dict`` gives them; ``light`` is a section of its own."""
    sample, unit = content["sample"], content["sample"]["unit"]
    size = f"{sample['width']} × {sample['height']}" + (f" × {sample['channels']}" if sample["channels"] > 1 else "")
    sections = [
        f"<h1>What accuracy costs in time</h1><p>{escape(sample['name'])}, {size} samples, filtered as {sample['kind']}.</p>",
        *(f"<p>Note: {escape(remark)}.</p>" for remark in sample["remarks"]),
        "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in content["findings"]) + "</ul>",
        _figure(
            "pareto.svg", "Error of level 1 against the time of one halving. The line is the frontier: all else is slower or further off."
        ),
        f"<h2>Kernels and rivals</h2>{_kernels(content)}{_KERNEL_NOTE.format(unit=unit)}",
        f"<h2>What the taps say</h2>{_figure('response.svg', 'Gain at frequencies in cycles per coarse sample.')}{_figures(content)}",
        "<h2>What it looks like</h2>" + _figure("differences.png", "Level 1 minus the ideal level, where the box filter is furthest off."),
        f"<h2>Precision</h2>{_precision(content)}{_PRECISION_NOTE}",
        f"<h2>Voids</h2>{_figure('voids.svg', 'Level 1 of a sample from which more and more was removed.')}{_voids(content)}{_VOID_NOTE}",
        light,
        f"<h2>How it was measured</h2>{_METHOD[sample['edge']]}{_machine(content)}",
    ]
    body = "\n".join(sections)
    head = (
        f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>Accuracy and time</title><style>{_STYLE}</style>'
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


_KERNEL_NOTE: Final = """<p class="note">Errors in {unit}. Droop is what the filter takes from frequencies that the level can hold
(u &lt; 0.5), aliasing what it leaves of those it cannot. ● lies on the frontier; the default is highlighted. Kernels with as many
taps run the same loops, so their times are pooled. OpenImageIO takes samples as cells: it is compared with the ideal between them.</p>"""
_PRECISION_NOTE: Final = """<p class="note">Default kernel, one channel scaled to a standard deviation of 1 and moved by the offset.
Differences to float64 filtering of the same float32 samples. Columns “plain” sum weighted samples as they are; the shipped loops sum
differences to a reference sample. What rounding the samples themselves to float16 costs is in the table above.</p>"""
_VOID_NOTE: Final = """<p class="note">“Empty”: share of level 1 without a value. “Lost”: without a value although a sample it stands for
holds one. Overshoot: how far values leave the range of the samples that hold one, in per cent of that range. “rms whole” counts only
places whose neighbouring samples all hold a value: rms over all values flatters a filter that gives up beside voids.</p>"""
_BORDERS: Final = """<p>Ideal levels come from the Fourier transform of each axis, with everything from the coarse Nyquist frequency on
removed. Beyond the border they assume what clipmap's filters assume there: {rule}. As nobody knows what really lies there, 16 samples of
each level are left out of all statistics at every border. What remains of its influence adds about 1 % to the default's rms on a
sample of 1024 cells, 3 % on one of 256, and most to the sharpest kernels. The ideal is the best level for detail, not for looks: it rings
at cliffs more than any kernel here.</p>
<p>Times are processor times of one halving, on one thread, of samples in memory, by the loops of a build. All candidates take turns,
each run right after one that is not counted; the least time is shown, every single one is in <a href="accuracy.json">accuracy.json</a>.
Tables: <a href="kernels.csv">kernels.csv</a>, <a href="precision.csv">precision.csv</a>, <a href="voids.csv">voids.csv</a>.</p>"""
_METHOD: Final = {
    "antisymmetric": _BORDERS.format(
        rule="heights go on by reflection through the outermost sample (a sine series, once the line from end to end is taken off)"
    ),
    "mirror": _BORDERS.format(rule="the picture is mirrored at its border (a cosine series)"),
}


def _figure(name: str, caption: str) -> str:
    return f'<figure><img src="{name}" alt="{escape(caption)}"><figcaption>{escape(caption)}</figcaption></figure>'


def table(header: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return a table; each row is (class of the row, cells)."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "\n".join(f'<tr class="{kind}">' + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>" for kind, cells in rows)
    return f'<div class="table"><table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'


def _number(value: float | None, digits: int = 3) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _class(name: str, content: dict[str, Any]) -> str:
    marks = {"default": name == content["default"], "frontier": name in content["frontier"]}
    return " ".join(mark for mark, holds in marks.items() if holds)


def _kernels(content: dict[str, Any]) -> str:
    levels = range(len(content["candidates"][0]["errors"]))
    predicted = any(candidate["predicted_droop_rms"] is not None for candidate in content["candidates"])
    header = ["", "ms/Msample", "median", "rms", "p99.9", "max", "droop", "aliasing"]
    header += ["droop predicted", "aliasing predicted"] if predicted else []
    header += ["rms float64", "rms float16 samples", *(f"rms level {level + 1}" for level in levels if level)]
    rows = []
    for candidate in content["candidates"]:
        first = candidate["errors"][0]
        numbers = [candidate["ms_per_megasample"], candidate["median_ms_per_megasample"]]
        numbers += [first[key] for key in ("rms", "p999", "largest", "droop_rms", "alias_rms")]
        numbers += [candidate["predicted_droop_rms"], candidate["predicted_alias_rms"]] if predicted else []
        numbers += [first["rms_float64"], first["rms_float16"]]
        numbers += [candidate["errors"][level]["rms"] for level in levels if level]
        rows.append((_class(candidate["name"], content), [candidate["name"], *(_number(number, 4) for number in numbers)]))
    return table(header, rows)


def _figures(content: dict[str, Any]) -> str:
    header = ["", "taps", "DC gain", "gain u = 1", "dB u = .25", "dB u = .40", "dB u ≥ .6", "dB u ≥ .75", "step overshoot %", "2-D L1 norm"]
    rows = []
    for candidate in content["candidates"]:
        if (own := candidate["figures"]) is not None:
            decibels = [own[key] for key in ("droop_quarter_db", "droop_passband_db", "stopband_db", "far_stopband_db")]
            cells = [
                str(own["taps"]),
                f"{own['dc_gain']:.9g}",
                f"{own['nyquist_gain']:.2g}",
                *(f"{value:.2f}".replace("-0.00", "0.00") for value in decibels),
            ]
            cells += [f"{own['step_overshoot_percent']:.2f}", f"{own['l1_norm']:.3f}"]
            rows.append((_class(candidate["name"], content), [candidate["name"], *cells]))
    return table(header, rows)


def _precision(content: dict[str, Any]) -> str:
    header = ["offset", "level", "float32 spacing", "shipped rms", "shipped max", "plain rms", "plain max"]
    keys = ("spacing", "shipped_rms", "shipped_largest", "plain_rms", "plain_largest")
    return table(
        header, (("", [f"{rung['offset']:g}", str(rung["level"]), *(_number(rung[key]) for key in keys)]) for rung in content["precision"])
    )


def _voids(content: dict[str, Any]) -> str:
    header = ["voids", "share %", "filter", "empty %", "lost %", "overshoot %", "rms", "rms whole"]
    rows = []
    for result in content["voids"]:
        shares = [f"{100 * result[key]:.2f}" for key in ("hole_share", "lost_share")]
        rest = [_number(result[key]) for key in ("overshoot_percent", "rms", "whole_rms")]
        rows.append(("", [result["pattern"], f"{100 * result['share']:g}", result["filter"], *shares, *rest]))
    return table(header, rows)


def _machine(content: dict[str, Any]) -> str:
    return table(["", ""], (("", [name, value]) for name, value in [*content["machine"].items(), ("runs", str(content["runs"]))]))
