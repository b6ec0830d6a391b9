"""What the accuracy report says about figures, and which part of a source it takes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.settings import BuildSettings
from tests.reference.terrain import terrain
from tiler.accuracy.experiments import Candidate, LevelError, default_kernel
from tiler.accuracy.findings import dominating, findings, frontier
from tiler.accuracy.response import Figures
from tiler.accuracy.sample import EDGE, REGISTRATION, Sample, largest_covered_square, load_sample
from tiler.accuracy.voids import VoidResult
from tiler.building.build import build_layer


def heights(side: int) -> Sample:
    return Sample("heights", "height", terrain(side + 1, side + 1).astype(np.float32))


# Findings


def candidate(name: str, ms: float, rms: float, overshoot: float = 0.0) -> Candidate:
    own = Figures(1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, overshoot, 1.0)
    errors = (LevelError(1, rms, rms, rms, rms_float64=0.9999 * rms, rms_float16=1.02 * rms),)
    return Candidate(name, "clipmap", errors, (ms / 1e3,), ms, ms, figures=own)


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=12))
def test_the_frontier_is_what_nothing_dominates(places: list[tuple[int, int]]) -> None:
    everyone = [candidate(str(index), ms, rms) for index, (ms, rms) in enumerate(places)]
    expected = {place for place in places if not any(other != place and other[0] <= place[0] and other[1] <= place[1] for other in places)}
    found = frontier(everyone)
    assert {(int(one.ms_per_megasample), int(one.errors[0].rms)) for one in found} == expected
    assert [one.ms_per_megasample for one in found] == sorted({ms for ms, _ in expected})


def family(kaiser_overshoot: float = 6.0) -> list[Candidate]:
    """A made-up world in which radius 6 takes 1.6 times the time of radius 3 and removes 37 % of its error."""
    everyone = [
        replace(candidate("blackman-sinc 3", 10, 1.0, 3.4), kernel="blackman-sinc", radius=3),
        replace(candidate("blackman-sinc 6", 16, 0.63, 5.9), kernel="blackman-sinc", radius=6),
        candidate("kaiser 3", 10, 0.8, 5.2),
        candidate("kaiser 6", 16, 0.6, kaiser_overshoot),
        candidate("lanczos 3", 10, 0.9, 5.6),
        candidate("lanczos 6", 17, 0.5, 6.4),
        candidate("box", 8, 2.0),
    ]
    return [*everyone, replace(candidate("OpenImageIO lanczos3", 32, 1.26), maker="openimageio", figures=None)]


def test_findings_say_what_the_figures_say() -> None:
    sample = heights(96)
    voids = [VoidResult("scattered", 0.3, name, 0.5, lost, 0.0, 1.0, 1.0) for name, lost in (("clipmap", 0.0), ("GDAL lanczos", 0.991))]
    said = "\n".join(findings(sample, family(), voids))
    assert (
        "Radius 6 (the default) takes 1.60 times the time of radius 3 and removes 37 % of its error (1 to 0.63 m rms at level 1)." in said
    )
    assert "blackman-sinc 6, takes 2.00 times the time of the box filter and removes 68 % of its error" in said
    assert "at radius 3 it errs 20 % less and overshoots a step by 5.2 % instead of 3.4 %" in said
    assert "dominated by kaiser 6; they overshoot a step by 6.0 to 6.0 %, the default by 5.9 %" in said
    assert "OpenImageIO lanczos3 takes 2.0 times as long as the default and errs 100 % more." in said
    assert "clipmap 0.0 %, GDAL lanczos 99.1 %" in said
    assert "Float32 arithmetic changes the default's error by 0.01 %, keeping samples as float16 by 2 %." in said
    assert [one.name for one in dominating(family()[1], family())] == ["kaiser 6"]


def test_findings_do_not_spare_the_default() -> None:
    said = "\n".join(findings(heights(96), family(kaiser_overshoot=5.0), []))
    assert "dominated by kaiser 6, and by kaiser 6 even if step overshoot counts as well" in said
    spared = "\n".join(findings(heights(96), [one for one in family() if one.name != "kaiser 6"] + [candidate("kaiser 6", 17, 0.6)], []))
    assert "the default is not dominated" in spared


# The sample


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 0.4, 1.0]))
def test_the_largest_square_without_voids(height: int, width: int, seed: int, share: float) -> None:
    covered = np.random.default_rng(seed).random((height, width)) >= share
    rows, columns = largest_covered_square(covered)
    side = rows.stop - rows.start
    assert side == columns.stop - columns.start
    assert covered[rows, columns].all()
    larger = [covered[y : y + side + 1, x : x + side + 1].all() for y in range(height - side) for x in range(width - side)]
    assert not any(larger)


def write_heights(path: Path, values: NDArray[np.float32]) -> Path:
    profile = {"driver": "GTiff", "width": values.shape[1], "height": values.shape[0], "count": 1, "dtype": "float32", "nodata": -1.0}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, 1, 0, -1, 1), **profile) as file:
        file.write(values, 1)
    return path


def test_a_sample_is_the_middle_of_its_source(tmp_path: Path) -> None:
    values = np.arange(150 * 260, dtype=np.float32).reshape(150, 260)
    path = write_heights(tmp_path / "source.tif", values)
    sample = load_sample(path, BuildSettings(height_scale=0.5), crop=115)
    assert (sample.kind, sample.registration, sample.edge, sample.remarks) == ("height", "point", "antisymmetric", ())
    assert sample.values.shape == (113, 113, 1)
    assert sample.values[0, 0, 0] == values[(150 - 116) // 2 + 1, (260 - 116) // 2 + 1] / 2, "of 115 cells the middle 112"


def test_a_sample_avoids_voids(tmp_path: Path) -> None:
    values = np.arange(300.0 * 300, dtype=np.float32).reshape(300, 300)
    values[150] = -1
    sample = load_sample(write_heights(tmp_path / "source.tif", values), BuildSettings(), crop=290)
    assert sample.values.shape == (145, 145, 1), "rows 4 to 149 of the crop, in cells a multiple of 8"
    assert (sample.values > 0).all()
    assert "voids in 0.34" in sample.remarks[0]


def test_samples_that_tell_nothing_are_refused(tmp_path: Path) -> None:
    flat = write_heights(tmp_path / "flat.tif", np.full((128, 128), 7, np.float32))
    with pytest.raises(InputError, match="the crop is constant"):
        load_sample(flat, BuildSettings(), 128)
    small = write_heights(tmp_path / "small.tif", np.arange(90 * 128, dtype=np.float32).reshape(90, 128))
    with pytest.raises(InputError, match="89 cells along an edge without voids, at least 96"):
        load_sample(small, BuildSettings(), 128)
    void = write_heights(tmp_path / "void.tif", np.full((128, 128), -1, np.float32))
    with pytest.raises(InputError, match="0 cells along an edge without voids"):
        load_sample(void, BuildSettings(), 128)


def test_the_default_is_what_a_build_uses(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "source.tif", np.arange(64.0 * 64, dtype=np.float32).reshape(64, 64))
    built = build_layer(path, tmp_path / "out", BuildSettings()).manifest.layers["height"]
    kernel = default_kernel(heights(96))
    assert (built.filter.kernel, built.filter.radius, built.filter.edge) == (kernel.name, kernel.radius, EDGE["height"])
    assert built.registration == REGISTRATION["height"]
