"""What the figures of light mean, in sentences computed from them."""

from collections.abc import Sequence

from tiler.accuracy.lightexperiments import AZIMUTHS, GATHERED, LINES, RADII, STEPS, SUNS, LightResult


def light_findings(results: Sequence[LightResult]) -> list[str]:
    """Return what a shadow, a horizon, the disc and the sky cost and what one gets for it, one sentence each."""
    by_name = {(one.place, one.method): one for one in results}
    sentences = [_shadows(by_name, azimuth, elevation) for azimuth, elevation in SUNS]
    sentences += [_horizons(by_name), _disc(by_name)]
    sentences += [_sky(by_name, 0), _sky(by_name, 16)]
    return [*sentences, *(_bounce(by_name, azimuth, elevation) for azimuth, elevation in SUNS)]


def brief(value: float) -> str:
    """Return three significant digits, as people write numbers."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


_Found = dict[tuple[tuple[str, float | None, float | None], str], LightResult]


def _ratio(first: float, second: float) -> str:
    return f"{first / second:.3g}" if second else "infinitely many"


def _shadows(found: _Found, azimuth: float, elevation: float) -> str:
    place = ("shadow", azimuth, elevation)
    one, many = found[place, "sweep, 1 line"], found[place, f"sweep, {LINES[-1]} lines"]
    exact, march, nearest = found[place, "certified"], found[place, "march, interpolated"], found[place, "march, nearest sample"]
    return (
        f"Sun at {elevation:g} degrees: one line per sample has {brief(one.error)} % of the samples wrong in {brief(one.ns_per_sample)} ns "
        f"each, {LINES[-1]} lines {brief(many.error)} % in {brief(many.ns_per_sample)} ns; certified, {brief(exact.error)} % in "
        f"{brief(exact.ns_per_sample)} ns, {_ratio(march.ns_per_sample, exact.ns_per_sample)} times as fast as the walk it equals; "
        f"a walk by nearest samples takes {brief(nearest.ns_per_sample)} ns and has {brief(nearest.error)} % wrong."
    )


def _horizons(found: _Found) -> str:
    place = ("horizon", SUNS[1][0], None)
    hulls = {steps: found[place, f"hulls, {steps} exact steps"] for steps in STEPS}
    walk = found[place, "march, interpolated"]
    near = found[place, "march, nearest sample"]
    return (
        f"Horizons: hulls alone are {brief(hulls[0].error)} degrees off (rms) in {brief(hulls[0].ns_per_sample)} ns, with 16 exact steps "
        f"{brief(hulls[16].error)} degrees in {brief(hulls[16].ns_per_sample)} ns, with 32 {brief(hulls[32].error)} degrees; walked rays "
        f"take {_ratio(walk.ns_per_sample, hulls[16].ns_per_sample)} times as long as 16 steps, and by nearest samples are "
        f"{brief(near.error)} degrees off."
    )


def _disc(found: _Found) -> str:
    place = ("disc", *SUNS[1])
    hard, sweeps = found[place, "1 hard shadow"], found[place, "16 hard shadows"]
    least, most = found[place, "1 horizon, 16 exact steps"], found[place, "1 horizon, 32 exact steps"]
    shipped = found[place, "clipmap light --soft"]
    return (
        f"The sun's disc at {SUNS[1][1]:g} degrees: a hard shadow is {brief(hard.error)} codes off (rms), 16 of them over the disc "
        f"{brief(sweeps.error)} codes in {brief(sweeps.ns_per_sample)} ns; one horizon with 16 exact steps {brief(least.error)} codes in "
        f"{brief(least.ns_per_sample)} ns, with 32 {brief(most.error)} codes in {brief(most.ns_per_sample)} ns; clipmap light --soft "
        f"{brief(shipped.error)} codes in {brief(shipped.ns_per_sample)} ns."
    )


def _sky(found: _Found, steps: int) -> str:
    place = ("sky", None, None)
    listed = [found[place, f"{count} azimuths, {steps} exact steps"] for count in AZIMUTHS]
    figures = ", ".join(f"{count} azimuths {brief(one.error)}" for count, one in zip(AZIMUTHS, listed, strict=True))
    return f"The sky with {steps} exact steps, codes rms: {figures}; {brief(listed[0].ns_per_sample / AZIMUTHS[0])} ns per azimuth."


def _bounce(found: _Found, azimuth: float, elevation: float) -> str:
    place = ("bounce", azimuth, elevation)
    none, mean, rays = found[place, "none"], found[place, "clipmap light --bounce"], found[place, f"{GATHERED[-1]} azimuths of rays"]
    near = {radius: found[place, f"mean within {radius}"] for radius in RADII}
    best = min(RADII, key=lambda radius: near[radius].error)
    near_by = near[best]
    return (
        f"Light thrown back, sun at {elevation:g} degrees: without it {brief(none.error)} codes are missing (rms; {_most(none)} at most); "
        f"the mean of the map is {brief(mean.error)} codes off ({_most(mean)} at most), the mean within {best} samples, the best of its "
        f"kind, {brief(near_by.error)} ({_most(near_by)}); {GATHERED[-1]} azimuths of rays {brief(rays.error)} codes in "
        f"{_ratio(rays.ns_per_sample, mean.ns_per_sample)} times the time."
    )


def _most(one: LightResult) -> str:
    return brief(one.largest or 0.0)
