"""How far the coarse levels of each program are from float64 references.

References, none of which shares code with a program: *ideal*, everything below a level's Nyquist frequency kept and everything above
removed, by one FFT of the source, which is exact because the source is periodic; and the filters *box*, *blackman-sinc* and *lanczos*
by ``tests/reference``, level from unrounded level. Blocks are stored without loss, so what is seen is filtering and rounding.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from tests.bench.inputs import Kind, Source, samples_of
from tests.bench.peers_levels import BLOCK, clipmap_level, cog_level, vips_level
from tests.bench.peers_measure import run_once
from tests.bench.peers_programs import Program, clipmap, cog, vips
from tests.bench.peers_room import Room
from tests.reference.pyramid import pyramid

Array = NDArray[np.float64]
Row = dict[str, Any]
Registration = Literal["area", "point"]

LEVELS: Final = (1, 2, 4)
"""Compared where the source is large enough: the coarsest level is one block."""
MARGIN: Final = 16
"""Coarse samples left out at each border: more than any of these filters reaches through any number of levels."""
FILTERS: Final[dict[Kind, tuple[tuple[str, int], ...]]] = {
    "rgb": (("box", 1), ("blackman-sinc", 3), ("lanczos", 3)),
    "height": (("box", 1), ("blackman-sinc", 6), ("lanczos", 3)),
}


@dataclass(frozen=True, slots=True)
class Subject:
    """A program named as in the tables of times, here with a lossless codec, and how its levels are read."""

    name: str
    filter: str
    command: tuple[str, ...]
    read: Callable[[Path, int, int], NDArray[Any]]
    registration: Registration = "area"


LOSSLESS: Final = ("COMPRESS=DEFLATE", "PREDICTOR=YES")
SUBJECTS: Final[dict[Kind, tuple[Subject, ...]]] = {
    "rgb": (
        Subject("clipmap", "blackman-sinc", clipmap("imagery", "png"), clipmap_level),
        Subject("clipmap --filter box", "box", clipmap("imagery", "png", "--filter", "box"), clipmap_level),
        Subject("GDAL COG, average", "box", cog(*LOSSLESS, "RESAMPLING=AVERAGE"), cog_level),
        Subject("GDAL COG, lanczos", "lanczos", cog(*LOSSLESS, "RESAMPLING=LANCZOS"), cog_level),
        Subject("vips dzsave", "box", vips(".png"), vips_level),
    ),
    "height": (
        Subject("clipmap lerc:0.1", "blackman-sinc", clipmap("height", "exr:float"), clipmap_level, "point"),
        Subject("clipmap lerc:0.1 --filter box", "box", clipmap("height", "exr:float", "--filter", "box"), clipmap_level, "point"),
        Subject("GDAL COG LERC, average", "box", cog(*LOSSLESS, "RESAMPLING=AVERAGE"), cog_level),
        Subject("GDAL COG LERC, lanczos", "lanczos", cog(*LOSSLESS, "RESAMPLING=LANCZOS"), cog_level),
    ),
}


def ideal(values: Array, level: int, registration: Registration) -> Array:
    """Return level ``level`` of a periodic channel (n, n) by brick-wall decimation; n is a power of two."""
    side, step = len(values), 1 << level
    coarse = side // step
    shift = (step - 1) / 2 if registration == "area" else 0.0
    phase = np.exp(2j * np.pi * np.fft.fftfreq(side) * shift)
    spectrum = np.fft.fft2(values) * phase[:, np.newaxis] * phase
    kept = np.r_[0 : coarse // 2, side - coarse // 2 + 1 : side]
    place = np.r_[0 : coarse // 2, coarse // 2 + 1 : coarse]  # what lies exactly at the Nyquist frequency is left out
    band = np.zeros((coarse, coarse), np.complex128)
    band[np.ix_(place, place)] = spectrum[np.ix_(kept, kept)]
    return np.asarray(np.fft.ifft2(band).real / step**2, np.float64)


def levels_of(side: int) -> list[int]:
    """Return the levels that are compared."""
    return [level for level in LEVELS if side >> level >= BLOCK]


def references(kind: Kind, values: Array, registration: Registration) -> Iterator[tuple[str, int, Array]]:
    """Yield name, level and samples of every reference of one channel (n, n)."""
    edge: Literal["mirror", "antisymmetric"] = "mirror" if kind == "rgb" else "antisymmetric"
    chosen, fine = levels_of(len(values)), values[..., np.newaxis]
    for name, radius in FILTERS[kind]:
        levels = pyramid(fine, None, max(chosen) + 1, kernel=name, radius=radius, registration=registration, edge=edge)
        yield from ((name, level, levels[level][0][..., 0]) for level in chosen)
    yield from (("ideal", level, ideal(values, level, registration)) for level in chosen)


def measure_errors(kind: Kind, side: int, room: Room) -> list[Row]:
    """Return one row per program, reference and level: root of the mean square and largest difference, codes or metres."""
    source = Source(kind, side)
    path, fine = room.source(source), samples_of(source)
    subjects = [subject for subject in SUBJECTS[kind] if Program(subject.name, "", subject.command, source).installed]
    stored = {subject.name: _levels(subject, source, path, room) for subject in subjects}
    squares: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
    for registration in sorted({subject.registration for subject in subjects}):
        for channel in range(fine.shape[2]):
            for reference, level, exact in references(kind, fine[..., channel].astype(np.float64), registration):
                inside = exact[MARGIN:-MARGIN, MARGIN:-MARGIN]
                if kind == "rgb":
                    inside = np.clip(inside, 0, 255)  # no program can store what lies beyond
                for subject in subjects:
                    if subject.registration == registration:
                        found = stored[subject.name][level][MARGIN:-MARGIN, MARGIN:-MARGIN, channel]
                        difference = np.abs(found - inside)
                        of = squares.setdefault((subject.name, reference, level), [])
                        of.append((float(np.mean(difference**2)), float(difference.max())))
    own = {subject.name: subject.filter for subject in subjects}
    return [
        {
            "kind": kind,
            "side": side,
            "program": name,
            "filter": own[name],
            "reference": reference,
            "level": level,
            "rms": float(np.sqrt(np.mean([square for square, _ in found]))),
            "max": max(most for _, most in found),
        }
        for (name, reference, level), found in squares.items()
    ]


def _levels(subject: Subject, source: Source, path: Path, room: Room) -> dict[int, NDArray[Any]]:
    output = room.folder / "outputs" / f"{room.count + 1:04}"
    run_once(Program(subject.name, subject.filter, subject.command, source), path, room)
    return {level: subject.read(output, source.side, level) for level in levels_of(source.side)}


def check_box(side: int, room: Room) -> list[Row]:
    """Return for every coarse level how many samples of ``--filter box`` differ from 2 x 2 means kept in float64, rounded once."""
    source = Source("rgb", side)
    output = room.folder / "outputs" / f"{room.count + 1:04}"
    run_once(Program("clipmap", "", clipmap("imagery", "png", "--filter", "box"), source), room.source(source), room)
    means, rows = samples_of(source).astype(np.float64), []
    for level in range(1, (side // 256).bit_length()):
        means = (means[::2, ::2] + means[::2, 1::2] + means[1::2, ::2] + means[1::2, 1::2]) / 4
        found = clipmap_level(output, side, level)
        rows.append({"level": level, "samples": found.size, "different": int(np.count_nonzero(found != np.rint(means)))})
    return rows
