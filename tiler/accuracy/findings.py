"""What the figures mean, in sentences computed from them; nothing here is written down beforehand but the words."""

from collections.abc import Sequence
from typing import Final

from tiler.accuracy.experiments import Candidate
from tiler.accuracy.sample import DEFAULT_RADIUS, Sample
from tiler.accuracy.voids import VoidResult

_LISTED: Final = 4
_CLOSER: Final = 0.999


def frontier(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates than which no other is both faster and closer at level 1, fastest first."""
    best: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda one: (one.ms_per_megasample, one.errors[0].rms)):
        if not best or candidate.errors[0].rms < best[-1].errors[0].rms:
            best.append(candidate)
    return best


def default_of(sample: Sample, candidates: Sequence[Candidate]) -> Candidate:
    """Return the candidate that a build takes for this kind of layer."""
    return _named(candidates, f"blackman-sinc {DEFAULT_RADIUS[sample.kind]}")


def dominating(default: Candidate, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that are at least as fast as ``default`` and closer by more than rounding, closest first."""
    better = [
        other
        for other in candidates
        if other.ms_per_megasample <= default.ms_per_megasample and other.errors[0].rms < _CLOSER * default.errors[0].rms
    ]
    return sorted(better, key=lambda other: other.errors[0].rms)


def findings(sample: Sample, candidates: Sequence[Candidate], voids: Sequence[VoidResult]) -> list[str]:
    """Return what the default costs and buys, where it is beaten, and how it stands voids, one sentence each."""
    default = default_of(sample, candidates)
    sentences = [_against_radius(sample, default, candidates), _against_box(sample, default, candidates)]
    sentences += [_against_design(design, default, candidates) for design in ("kaiser", "lanczos")]
    sentences += [_dominated(default, candidates), _precision(sample, default)]
    sentences += [_rival(default, other) for other in candidates if other.maker == "openimageio" and "box" not in other.name]
    return sentences + _voids(voids)


def _named(candidates: Sequence[Candidate], name: str) -> Candidate:
    return next(candidate for candidate in candidates if candidate.name == name)


def _less(new: float, old: float) -> str:
    """Say how much smaller ``new`` is than ``old``."""
    percent = 100 * (1 - new / old)
    return f"{abs(percent):.0f} % {'less' if percent >= 0 else 'more'}"


def _against_radius(sample: Sample, default: Candidate, candidates: Sequence[Candidate]) -> str:
    low, high = _named(candidates, "blackman-sinc 3"), _named(candidates, "blackman-sinc 6")
    times = high.ms_per_megasample / low.ms_per_megasample
    removed = 100 * (1 - high.errors[0].rms / low.errors[0].rms)
    errors = f"{low.errors[0].rms:.3g} to {high.errors[0].rms:.3g} {sample.unit} rms at level 1"
    which = "the default" if default is high else f"where {DEFAULT_RADIUS[sample.kind]} is the default"
    return f"Radius 6 ({which}) takes {times:.2f} times the time of radius 3 and removes {removed:.0f} % of its error ({errors})."


def _against_box(sample: Sample, default: Candidate, candidates: Sequence[Candidate]) -> str:
    box = _named(candidates, "box")
    times = default.ms_per_megasample / box.ms_per_megasample
    removed = 100 * (1 - default.errors[0].rms / box.errors[0].rms)
    return (
        f"The default, {default.name}, takes {times:.2f} times the time of the box filter and removes {removed:.0f} % of its error "
        f"({box.errors[0].rms:.3g} to {default.errors[0].rms:.3g} {sample.unit}): "
        f"{default.ms_per_megasample - box.ms_per_megasample:.2f} ms more per million samples."
    )


def _overshoot(candidate: Candidate) -> float:
    return candidate.figures.step_overshoot_percent if candidate.figures else 0.0


def _against_design(design: str, default: Candidate, candidates: Sequence[Candidate]) -> str:
    parts: list[str] = []
    for radius in sorted({3, default.radius or 3}):
        own, other = _named(candidates, f"blackman-sinc {radius}"), _named(candidates, f"{design} {radius}")
        overshoot = f"overshoots a step by {_overshoot(other):.1f} % instead of {_overshoot(own):.1f} %"
        parts.append(f"at radius {radius} it errs {_less(other.errors[0].rms, own.errors[0].rms)} and {overshoot}")
    return f"Tap for tap, in the same time, {design.capitalize()} against Blackman: {'; '.join(parts)}."


def _dominated(default: Candidate, candidates: Sequence[Candidate]) -> str:
    better = dominating(default, candidates)
    if not better:
        return "By error and time the default is not dominated: nothing as fast is closer."
    names = ", ".join(other.name for other in better[:_LISTED]) + (f" and {len(better) - _LISTED} more" if len(better) > _LISTED else "")
    calmer = [other for other in better if other.figures and _overshoot(other) <= _overshoot(default)]
    sentence = f"By error and time the default is dominated by {names}"
    if calmer:
        return f"{sentence}, and by {', '.join(other.name for other in calmer)} even if step overshoot counts as well."
    known = [other for other in better if other.figures]
    least, most = (pick(map(_overshoot, known), default=0.0) for pick in (min, max))
    return (
        f"{sentence}; they overshoot a step by {least:.1f} to {most:.1f} %, the default by {_overshoot(default):.1f} %, "
        "so with overshoot as a third criterion nothing measured here dominates it."
    )


def _precision(sample: Sample, default: Candidate) -> str:
    first = default.errors[0]
    if first.rms_float64 is None:
        raise AssertionError("a kernel of clipmap is measured in float64 as well")
    sentence = f"Float32 arithmetic changes the default's error by {_change(first.rms_float64, first.rms)}"
    if first.rms_float16 is None:
        return f"{sentence}; float16 cannot hold these samples."
    return f"{sentence}, keeping samples as float16 by {_change(first.rms_float16, first.rms)}."


def _change(one: float, other: float) -> str:
    """Say how far apart two errors are, to a significant digit."""
    percent = 100 * abs(one / other - 1)
    return "less than 0.001 %" if percent < 0.001 else f"{percent:.1g} %"


def _rival(default: Candidate, other: Candidate) -> str:
    times = other.ms_per_megasample / default.ms_per_megasample
    return f"{other.name} takes {times:.1f} times as long as the default and errs {_less(other.errors[0].rms, default.errors[0].rms)}."


def _voids(voids: Sequence[VoidResult]) -> list[str]:
    """Say how much of level 1 is left at 30 % voids."""
    sentences: list[str] = []
    for pattern, where in (("scattered", "scattered at random"), ("holes", "in holes")):
        found = [result for result in voids if result.pattern == pattern and result.share == 0.3]
        if found:
            shares = ", ".join(f"{result.filter} {100 * result.lost_share:.1f} %" for result in found)
            sentences.append(
                f"With 30 % of the samples void, {where}, level 1 has no value although its own samples hold one in: {shares}."
            )
    return sentences
