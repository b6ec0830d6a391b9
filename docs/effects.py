"""Draws the figures of ``docs/EFFECTS.md`` and writes its table of terrains: bounds beside light by brute force.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python docs/effects.py

Takes a minute. The built-in island needs nothing, Puget Sound the folder of real inputs; without it the table stays as it is.
"""

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import imagecodecs
import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from docs.markers import with_content
from schemas import viewbounds
from schemas.scene import Scene, Sun
from tests.reference import effects as reference
from tiler.effects import bounds
from tiler.effects.plan import plan_effects
from tiler.effects.statistics import HeightStatistics, measure_heights
from tiler.effects.text import plan_rows
from tiler.effects.tiles import surroundings
from tiler.terrain import make_island

DOCS: Final = Path(__file__).parent
TARGET: Final = DOCS / "EFFECTS.md"
BEGIN: Final = "<!-- four terrains: written by docs/effects.py -->"
END: Final = "<!-- end of the four terrains -->"
SHARE: Final = 0.15
EARTH_M: Final = 6_371_008.8
BOUND, ACTUAL, OTHER, GREY = "#c2410c", "#1d6fa5", "#2f7d4f", "#8a97a3"

Array = NDArray[np.float64]


@contextmanager
def drawing(name: str, **labels: Any) -> Iterator[Any]:  # noqa: ANN401 - what matplotlib takes
    """Give the axes of a new figure, and write it to ``docs/images/effects-name.svg`` in the end."""
    # Fixed salt and no date: the same figures give the same file.
    with rc_context({"svg.hashsalt": "clipmap", "svg.fonttype": "path", "font.size": 9}):
        figure = Figure(figsize=(6, 3.4), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        yield axes
        axes.set(**labels)
        axes.grid(alpha=0.2)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, frameon=False)
        figure.savefig(DOCS / "images" / f"effects-{name}.svg", metadata={"Date": None})


def terrains(count: int, side: int = 10) -> Iterator[tuple[Array, HeightStatistics]]:
    """Rough random terrains of every steepness, 1 m between samples, and what was measured on them for a sun in the west."""
    rng = np.random.default_rng(5)
    for _ in range(count):
        z = np.cumsum(np.cumsum(rng.normal(size=(side, side)), axis=0), axis=1) if rng.random() < 0.5 else rng.normal(size=(side, side))
        z = z / np.abs(np.diff(z)).max() * 10 ** rng.uniform(-2, 0.7)
        yield z, measure_heights([z], z.shape, (1.0, 1.0), (270.0, 20.0))


def azimuths(count: int) -> list[float]:
    """Even azimuths, half a step off the grid's own [degrees]."""
    return [360 * (n + 0.5) / count for n in range(count)]


def scatter(name: str, unit: str, points: list[tuple[float, float]]) -> None:
    """Draw bounds against what is true: nothing may lie above the diagonal."""
    bound, actual = (np.array(values) for values in zip(*points, strict=True))
    with drawing(name, xscale="log", yscale="log", xlabel=f"bound [{unit}]", ylabel=f"largest change, brute force [{unit}]") as axes:
        ends = [bound.min(), bound.max()]
        axes.plot(ends, ends, color=BOUND, label="bound = truth")
        shown = actual > bound.min() / 1e4
        axes.plot(bound[shown], actual[shown], ".", color=ACTUAL, markersize=4, label=f"{len(bound)} random cases")


def cast_shadow() -> None:
    """A ray that meets the ground has a facet before it that rises faster than the ray."""
    z = make_island(256).heights_m[128, 30:226:2].astype(np.float64)
    x, slope = 40.0 * np.arange(z.size), math.tan(math.radians(20))
    top = np.maximum.accumulate((z - slope * x)[::-1])[::-1] + slope * x
    with drawing("shadow", xlabel="distance, the sun to the right [m]", ylabel="height [m]") as axes:
        axes.fill_between(x, z, top, color=GREY, alpha=0.5, label="shaded")
        axes.plot(x, z, color="#1b2a38", linewidth=1)
        steep = np.flatnonzero(np.diff(z) > slope * 40)
        for n in steep:
            axes.plot(x[n : n + 2], z[n : n + 2], color=BOUND, linewidth=2.5, label="facet steeper than the ray" if n == steep[0] else None)


def penumbra() -> None:
    """The part of a disc that is seen, and half a step."""
    u = np.linspace(-1.6, 1.6, 400)
    with drawing("penumbra", xlabel="(elevation - horizon) / radius of the disc", ylabel="part of the sun seen") as axes:
        axes.plot(u, reference.disc_part(np.tan(np.radians(20 - u)), 20.0, 1.0), color=ACTUAL, label="disc")
        axes.step(u, u >= 0, color=GREY, where="mid", label="point")
        axes.plot([-math.pi / 4, math.pi / 4], [0, 1], color=BOUND, linewidth=0.9, label="slope 2 / pi, its steepest")


def sky_and_bounce() -> None:
    """Hidden sky and seen ground."""
    sky, ground = [], []
    for z, found in terrains(150):
        around = surroundings(found)
        h, b = float(around.horizon_tan.max()), float(around.tilt_tan.max())
        horizons = {a: reference.horizons(z, (1.0, 1.0), a) for a in azimuths(16)}
        nothing = dict.fromkeys(horizons, np.full_like(z, -np.inf))
        open_sky, seen = (reference.open_part(z, (1.0, 1.0), one, sky_only=True) for one in (nothing, horizons))
        sky.append((bounds.sky_codes(h, b, SHARE), float(bounds.code_scale(SHARE) * SHARE * (open_sky - seen).max())))
        part = 1 - reference.open_part(z, (1.0, 1.0), horizons, sky_only=False)
        ground.append((bounds.bounce_codes(h, b, 0.3), float(255 * 0.3 * part.max())))
    scatter("sky", "codes", sky)
    scatter("bounce", "codes", ground)


def curvature_shadow() -> None:
    """Horizons lowered on small globes."""
    points = []
    for n, (z, found) in enumerate(terrains(200)):
        globe = 10.0 ** (2 + n % 5)
        flat, curved = (reference.horizons(z, (1.0, 1.0), 270.0, radius_m=radius) for radius in (math.inf, globe))
        parts = [reference.disc_part(one, 20.0, 1.0) for one in (flat, curved)]
        shift = bounds.lowering_deg(found.relief_m, found.diagonal_m, 19.0, globe)
        points.append((bounds.disc_codes(shift, 1.0, SHARE), float(bounds.code_scale(SHARE) * np.abs(parts[0] - parts[1]).max())))
    scatter("curvature-shadow", "codes", points)


def curvature_sky() -> None:
    """What level ground and a slope gain."""
    relief = np.linspace(1, 6000, 200)
    with drawing("curvature-sky", xlabel="relief [m]", ylabel="gain of sky light, at most [codes]") as axes:
        for slope, colour in ((0.0, GREY), (0.3, ACTUAL), (1.0, OTHER), (5.0, BOUND)):
            codes = [bounds.curvature_sky_codes(z, 1e6, slope, 16, SHARE, EARTH_M) for z in relief]
            axes.plot(relief, codes, color=colour, label=f"slopes up to {slope:g}" if slope else "level ground")


def refraction() -> None:
    """The sun's lift, and the bending of rays on their way."""
    elevation = np.linspace(0.5, 60, 300)
    with drawing("refraction-sun", yscale="log", xlabel="elevation of the sun [degrees]", ylabel="at most [codes]") as axes:
        lifts = [bounds.refraction_deg(e) for e in elevation]
        axes.plot(elevation, [bounds.turned_sun_codes(r, SHARE) for r in lifts], color=ACTUAL, label="without shadows: K r")
        edges = [bounds.disc_codes(r, 0.2666, SHARE) + bounds.turned_sun_codes(r, SHARE) for r in lifts]
        axes.plot(elevation, edges, color=BOUND, label="in soft edges: K r + 2 K / pi r / disc")
    with drawing(
        "refraction-path", yscale="log", xlabel="elevation of the sun [degrees]", ylabel="horizon lowered, at most [degrees]"
    ) as axes:
        for relief, colour in ((200.0, GREY), (1000.0, ACTUAL), (4000.0, BOUND)):
            curved = [bounds.lowering_deg(relief, 2e5, e, EARTH_M) for e in elevation]
            axes.plot(elevation, curved, color=colour, label=f"curvature, relief {relief:g} m")
            axes.plot(elevation, [0.13 * one for one in curved], color=colour, linestyle="--", label="bending, k = 0.13")


def distances() -> None:
    """One sun for a map, far ground, haze, curvature seen."""
    diagonal = np.linspace(1, 500, 200)
    with drawing("sun-direction", xlabel="diagonal of the map [km]", ylabel="sun turned at its corners [degrees]") as axes:
        axes.plot(diagonal, [bounds.sun_direction_deg(1000 * d, EARTH_M) for d in diagonal], color=BOUND)
    away = np.geomspace(1, 400, 200)
    labels = {"xscale": "log", "yscale": "log", "xlabel": "distance [km]", "ylabel": "sky hidden from there, at most [codes]"}
    with drawing("far", **labels) as axes:
        for relief, colour in ((200.0, GREY), (1000.0, ACTUAL), (4000.0, BOUND)):
            codes = [bounds.far_sky_codes(relief, 1000 * d, 1.0, 16, SHARE) for d in away]
            axes.plot(away, codes, color=colour, label=f"relief {relief:g} m, slopes up to 1")
    with drawing("haze", xscale="log", xlabel="distance [km]", ylabel="changed, at most [codes]") as axes:
        for visibility, colour in ((5.0, GREY), (50.0, ACTUAL), (300.0, BOUND)):
            axes.plot(away, [viewbounds.haze_codes(d, visibility) for d in away], color=colour, label=f"visibility {visibility:g} km")
    focal, stretch = viewbounds.focal_px(1920, 60), viewbounds.corner_stretch(1920, 1080, 60)
    labels = {"xscale": "log", "yscale": "log", "xlabel": "distance [km]", "ylabel": "shift on the screen, at most [pixels]"}
    with drawing("curvature-view", **labels) as axes:
        for height, colour in ((0.0, ACTUAL), (4000.0, BOUND)):
            shifts = [viewbounds.curvature_px(1000 * d, height, EARTH_M, focal, stretch) for d in away]
            axes.plot(away, shifts, color=colour, label=f"{height:g} m above the ground")


def levels() -> None:
    """Shifts on the screen, across a picture; synthetic detail by octave."""
    focal = viewbounds.focal_px(1920, 60)
    across = np.linspace(0, 1101, 200)
    with drawing("geomorph", xlabel="from the middle of the picture [pixels]", ylabel="1 m at 1000 m shows as [pixels]") as axes:
        # The ray turned by asin(1 / 1000) toward the middle, which is what the displacement can do at most.
        turned = [focal * (a / focal - math.tan(math.atan(a / focal) - math.asin(1e-3))) for a in across]
        axes.plot(across, turned, color=ACTUAL, label="truth")
        axes.axhline(focal * 1e-3, color=GREY, label="f e / d")
        axes.axhline(viewbounds.shift_px(1, 1000, focal, viewbounds.corner_stretch(1920, 1080, 60)), color=BOUND, label="bound")
    octaves = range(1, 7)
    rng = np.random.default_rng(2)
    with drawing("synthesis", xlabel="octaves", ylabel="largest height added [standard deviations]") as axes:
        for hurst, colour in ((0.5, BOUND), (0.8, ACTUAL)):
            axes.plot(
                octaves, [viewbounds.synthesis_amplitude_m(1, hurst, n, 4) for n in octaves], color=colour, label=f"bound, H = {hurst:g}"
            )
            z, seen = np.zeros((40, 40)), []
            for n in octaves:
                z = np.apply_along_axis(reference.four_point, 0, np.apply_along_axis(reference.four_point, 1, z))[:90, :90]
                z = z + 4 * 2 ** (-hurst * n) * rng.choice([-1.0, 1.0], z.shape)
                seen.append(np.abs(z).max())
            axes.plot(octaves, seen, "o--", color=colour, markersize=4, label="largest of random signs")


def normals_and_gamma() -> None:
    """Normals of other slopes, codes filtered instead of light."""
    rng = np.random.default_rng(9)
    normals, filters = [], []
    sun = np.array([math.cos(0.5), 0.0, math.sin(0.5)])
    for _ in range(300):
        here = rng.normal(size=2) * 10 ** rng.uniform(-2, 0.5)
        there = here + rng.normal(size=2) * 10 ** rng.uniform(-4, 0)
        unit = [np.array([-x, -y, 1.0]) / math.sqrt(1 + x * x + y * y) for x, y in (here, there)]
        light = [max(0.0, float(n @ sun)) + SHARE * (1 + n[2]) / 2 for n in unit]
        bound = bounds.normal_map_codes(float(np.hypot(*(there - here))), SHARE)
        normals.append((bound, bounds.code_scale(SHARE) * abs(light[0] - light[1])))
        low, span = rng.uniform(0, 1), 10 ** rng.uniform(-3, 0)
        y = np.clip(low + span * rng.choice([0.0, 1.0], 8), 0, 1)
        if np.ptp(y) > 0:
            decoded = np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)
            mean = y.mean()
            whole = mean / 12.92 if mean <= 0.04045 else ((mean + 0.055) / 1.055) ** 2.4
            filters.append((bounds.gamma_filter_codes(float(np.ptp(y)), 1.0), 255 * abs(float(decoded.mean()) - whole)))
    scatter("normals", "codes", normals)
    scatter("gamma", "codes", filters)


def truth(z: Array, cell: tuple[float, float], sun: tuple[float, float]) -> dict[str, float]:
    """Return the largest changes by brute force [codes], hard shadows and 16 azimuths."""
    scale, (azimuth, elevation) = bounds.code_scale(SHARE), sun
    facing = np.maximum(reference.facing(z, cell, azimuth, elevation), 0)
    horizon, curved = (reference.horizons(z, cell, azimuth, radius_m=radius, per_row=1) for radius in (math.inf, EARTH_M / 0.87))
    soft = reference.disc_part(horizon, elevation, 0.2666)
    horizons = {a: reference.horizons(z, cell, a, per_row=1) for a in azimuths(16)}
    nothing = dict.fromkeys(horizons, np.full_like(z, -np.inf))
    hidden = [reference.open_part(z, cell, one, sky_only=True) for one in (nothing, horizons)]
    lifted = elevation + bounds.refraction_deg(elevation)
    higher = np.maximum(reference.facing(z, cell, azimuth, lifted), 0) * reference.disc_part(horizon, lifted, 0.2666)
    return {
        "shadow": float(scale * (facing * (horizon > math.tan(math.radians(elevation)))).max()),
        "penumbra": float(scale * (facing * np.abs(soft - (horizon <= math.tan(math.radians(elevation))))).max()),
        "sky": float(scale * SHARE * (hidden[0] - hidden[1]).max()),
        "bounce": float(255 * 0.3 * (1 - reference.open_part(z, cell, horizons, sky_only=False)).max()),
        "curvature_shadow": float(scale * (facing * np.abs(reference.disc_part(curved, elevation, 0.2666) - soft)).max()),
        "refraction_sun": float(scale * np.abs(higher - facing * soft).max()),
    }


def number(codes: float) -> str:
    """Return codes for people."""
    return f"{codes:.0f}" if codes >= 10 else f"{codes:.2g}"


def four_terrains(puget: Array) -> str:
    """Return the table of verdicts, bounds and truths."""
    island = make_island(512).heights_m[180:308, 180:308].astype(np.float64)
    plain = (puget - puget.min()) * 20 / np.ptp(puget)
    scenes: list[tuple[str, Array, float, tuple[float, float]]] = [
        ("Puget Sound, 160 m, sun at 10°", puget, 160.0, (270.0, 10.0)),
        ("Puget Sound, 160 m, sun at 45°", puget, 160.0, (200.0, 45.0)),
        ("island, 20 m, sun at 30°", island, 20.0, (290.0, 30.0)),
        ("plain of 20 m relief, 160 m, sun at 40°", plain, 160.0, (200.0, 40.0)),
    ]
    shown = ("shadow", "penumbra", "sky", "bounce", "curvature_shadow", "refraction_sun")
    lines = ["|  | " + " | ".join(name.replace("_", " ") for name in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    for title, z, cell, sun in scenes:
        found = measure_heights([z], z.shape, (cell, cell), sun)
        plan = plan_effects(Scene(sun=Sun(azimuth_deg=sun[0], elevation_deg=sun[1])), found)
        actual, cells = truth(z, (cell, cell), sun), []
        for name, row in zip((one.effect for one in plan.effects), plan_rows(plan), strict=True):
            if name in shown:
                bound = plan.effect(name).bound or 0.0
                if actual[name] > bound + 0.02:
                    raise ValueError(f"{title}: {name} is {actual[name]}, more than {bound}")
                cells.append(f"{row[1]}: {number(bound)} ≥ {number(actual[name])}")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


FIGURES: Final[tuple[Callable[[], None], ...]] = (
    cast_shadow,
    penumbra,
    sky_and_bounce,
    curvature_shadow,
    curvature_sky,
    refraction,
    distances,
    levels,
    normals_and_gamma,
)


def main() -> None:
    """Draw all figures; write the table where real inputs are."""
    for draw in FIGURES:
        draw()
    if "CLIPMAP_TEST_DATA" in os.environ:
        picture = imagecodecs.imread(Path(os.environ["CLIPMAP_TEST_DATA"]) / "puget" / "ps_height_1k.png")
        puget = 0.1 * np.asarray(picture)[480:608, 600:728].astype(np.float64)
        TARGET.write_text(with_content(TARGET, BEGIN, END, four_terrains(puget)), encoding="utf-8")


if __name__ == "__main__":
    main()
