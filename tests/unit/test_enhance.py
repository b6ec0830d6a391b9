"""Wavelet enhancement: against two independent transforms of the whole picture, and what it must not do to a picture."""

import itertools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import pywt
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cli.main import run
from schemas.errors import MissingExtraError, UsageError
from schemas.region import Rect
from tests.integration.files import assemble, settings, tree_digest, write_tiff
from tests.reference.terrain import photo, power_law_field
from tiler.building.build import build_layer
from tiler.samples.enhance import REACH, EnhancedSource, Enhancement, parse_enhancement
from tiler.sources import FileInfo
from tiler.sources.convert import Conversion
from tiler.stores.dataset import open_dataset

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Parts = tuple[list[Float64], list[Float64], Float64]
"""Details and trust per scale, and brightness."""

SCALES: Final = 3
HALF_UNIT: Final = {"uint8": 2**-17, "uint16": 2**-9}
"""Half a unit in the last place of float32 just below the type's end: results are rounded to float32 once."""


@dataclass
class ArraySource:
    """Samples in memory; ``read_rows`` notes what was asked for."""

    values: Float32
    coverage: Float32 | None = None
    dtype: Any = "uint8"
    kind: Any = "imagery"
    chunk_rows: int = 16
    masked: bool = field(init=False)
    info: FileInfo = field(init=False)
    conversion: Conversion = field(init=False)
    read_rows: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rows, columns, channels = self.values.shape
        self.masked = self.coverage is not None
        self.info = FileInfo(Path("array"), "array", columns, rows, channels, np.dtype(self.dtype), 1, "tiled", self.chunk_rows)
        self.conversion = Conversion(self.kind, tuple(range(channels)), None, False, None, None, 1.0, 0.0, self.dtype)

    def read(self, window: Rect) -> tuple[Float32, Float32 | None]:
        assert window & self.info.rect == window, "inside the file"
        self.read_rows.append((window.y0, window.y1))
        part = np.s_[window.y0 : window.y1, window.x0 : window.x1]
        return self.values[part].copy(), None if self.coverage is None else self.coverage[part].copy()

    def read_lean(self, window: Rect) -> tuple[Float32, Float32 | None]:
        return self.read(window)

    def begin(self) -> None:
        """Nothing to digest."""

    def digest(self) -> str:
        return ""

    def close(self) -> None:
        """Nothing to close."""


def enhanced(source: ArraySource, gain: float = 1.5, window: Rect | None = None) -> tuple[Float32, Float32 | None]:
    return EnhancedSource(source, Enhancement(gain)).read(window or source.info.rect)


def picture(height: int, width: int, dtype: str = "uint8", seed: int = 1, voids: bool = False, chunk_rows: int = 16) -> ArraySource:
    """A photograph, for uint16 with noise in the low byte; with soft alpha around holes if ``voids``."""
    pixels = photo(max(height, 2), max(width, 2), seed)[:height, :width].astype(np.float32)
    if dtype == "uint16":
        pixels = pixels * 256 + np.random.default_rng(seed).integers(0, 256, pixels.shape).astype(np.float32)
    if not voids:
        return ArraySource(pixels, None, dtype, chunk_rows=chunk_rows)
    alpha = np.clip(power_law_field(max(height, 2), max(width, 2), seed + 7, 3.0)[:height, :width] * 200 + 180, 0, 255)
    coverage = (np.rint(alpha) / 255).astype(np.float32)
    pixels[coverage == 0] = 0
    return ArraySource(pixels, coverage, dtype, chunk_rows=chunk_rows)


def reflected(plane: NDArray[Any]) -> NDArray[Any]:
    """Mirror a plane far enough for the whole transform; sides become multiples of 8."""
    more = [32 + -side % 8 for side in plane.shape[:2]]
    return np.pad(plane, [(32, more[0]), (32, more[1])], mode="symmetric")


def smoothed_in_integers(plane: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """c1, c2, c3 times 256, 256**2, 256**3: five taps by hand, in integers."""
    result = []
    for hole in (1, 2, 4):
        for axis in (0, 1):
            taps = [np.roll(plane, shift * hole, axis) * weight for shift, weight in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True)]
            plane = np.sum(taps, axis=0)
        result.append(plane)
    return result


def parts_in_integers(source: ArraySource) -> Parts:
    """The definition: normalised smoothing as ratio of two integers."""
    height, width = source.values.shape[:2]
    inside = np.s_[32 : 32 + height, 32 : 32 + width]
    alpha = np.full((height, width), 255) if source.coverage is None else np.rint(source.coverage * 255.0).astype(np.int64)
    weights = smoothed_in_integers(reflected(alpha.astype(np.int64)))
    covered = np.maximum(alpha, 1)
    fine = np.moveaxis(source.values, -1, 0).astype(np.float64)
    sums = [smoothed_in_integers(reflected(plane.astype(np.int64) * alpha)) for plane in fine]
    details, trust = [], []
    for scale in range(SCALES):
        weight = np.where(alpha > 0, weights[scale][inside], 1)
        coarse = np.stack([channel[scale][inside] / weight for channel in sums])
        details.append(fine - coarse)
        trust.append(np.clip(2 * weights[scale][inside] / 256.0 ** (scale + 1) / covered - 1, 0, 1) ** 2)
        fine = coarse
    return details, trust, fine.mean(axis=0)


def parts_by_pywavelets(source: ArraySource) -> Parts:
    """PyWavelets' own detail bands of the whole picture: horizontal, vertical and diagonal ones add up to the isotropic ones."""
    height, width, channels = source.values.shape
    inside = np.s_[32 : 32 + height, 32 : 32 + width]
    low, delta = np.array([0, 1, 4, 6, 4, 1]) / 16, np.array([0, 0, 0, 1, 0, 0.0])
    wavelet = pywt.Wavelet("b3", filter_bank=[low, delta - low, delta, delta])
    details = [np.empty((channels, height, width)) for _ in range(SCALES)]
    coarse = np.zeros((height, width))
    for channel in range(channels):
        last, *bands = pywt.swt2(reflected(source.values[..., channel].astype(np.float64)), wavelet, SCALES, trim_approx=True)
        coarse += last[inside] / channels
        for scale, band in enumerate(bands[::-1]):
            details[scale][channel] = sum(band)[inside]
    return details, [np.ones((height, width))] * SCALES, coarse


def by_definition(source: ArraySource, parts: Parts, gain: float) -> Float64:
    """y = x + (gain - 1) sum w e / (e + T**2) S / (S + sqrt e), clipped."""
    details, trust, brightness = parts
    total = np.moveaxis(source.values, -1, 0).astype(np.float64)
    for detail, sure in zip(details, trust, strict=True):
        energy = (detail**2).mean(axis=0)
        edge = 1 + brightness / 4
        total += (gain - 1) * detail * sure * energy / (energy + 1 + (brightness / 100) ** 2) * edge / (edge + np.sqrt(energy))
    result = np.clip(np.moveaxis(total, 0, -1), 0, np.iinfo(source.dtype).max)
    if source.coverage is not None:
        result[source.coverage == 0] = 0
    return result


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("gain", [1.5, 4.0])
@pytest.mark.parametrize("size", [(150, 201), (40, 33)])
def test_agrees_with_pywavelets_on_the_whole_picture(dtype: str, gain: float, size: tuple[int, int]) -> None:
    source = picture(*size, dtype)
    expected = by_definition(source, parts_by_pywavelets(source), gain)
    found, coverage = enhanced(source, gain)
    assert coverage is None
    assert found.dtype == np.float32
    assert np.abs(found - expected).max() <= 1.01 * HALF_UNIT[dtype]
    assert np.abs(found - source.values).max() > 10, "there is something to compare"


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("voids", [False, True])
def test_agrees_with_the_definition_in_integers(dtype: str, voids: bool) -> None:
    source = picture(140, 90, dtype, seed=2, voids=voids)
    found, coverage = enhanced(source, 2.0)
    expected = by_definition(source, parts_in_integers(source), 2.0)
    assert np.abs(found - expected).max() <= 1.01 * HALF_UNIT[dtype]
    if source.coverage is not None:
        assert coverage is not None
        assert (source.coverage == 0).any()
        assert ((source.coverage > 0) & (source.coverage < 1)).any()
        assert coverage.tobytes() == source.coverage.tobytes(), "coverage is that of the file"


@given(
    seed=st.integers(0, 1000),
    size=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    step=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    portion=st.integers(1, 40),
    voids=st.booleans(),
    chunk_rows=st.sampled_from([1, 7, 16, 5000]),
    dtype=st.sampled_from(["uint8", "uint16"]),
)
def test_any_window_gives_the_bits_of_the_whole(
    seed: int, size: tuple[int, int], step: tuple[int, int], portion: int, voids: bool, chunk_rows: int, dtype: str
) -> None:
    """Windows of any size, read in portions of any height by one source that keeps rows, from a picture of any size."""
    source = picture(*size, dtype, seed, voids, chunk_rows)
    whole, covered = enhanced(source, 3.0)
    pieces = EnhancedSource(source, Enhancement(3.0))
    for y, x in itertools.product(range(0, size[0], step[0]), range(0, size[1], step[1])):
        bottom, right = min(y + step[0], size[0]), min(x + step[1], size[1])
        for top in range(y, bottom, portion):
            window = Rect(x, top, right, min(top + portion, bottom))
            values, coverage = pieces.read(window)
            place = np.s_[window.y0 : window.y1, window.x0 : window.x1]
            assert values.tobytes() == whole[place].tobytes()
            if covered is not None:
                assert coverage is not None
                assert coverage.tobytes() == covered[place].tobytes()


@pytest.mark.parametrize("voids", [False, True])
def test_a_gain_of_one_changes_no_bit(voids: bool) -> None:
    source = picture(50, 60, voids=voids)
    assert enhanced(source, 1.0)[0].tobytes() == source.values.tobytes()


@pytest.mark.parametrize(("dtype", "value"), [("uint8", 0), ("uint8", 3), ("uint8", 255), ("uint16", 43_798), ("uint16", 65_535)])
@pytest.mark.parametrize("voids", [False, True])
def test_a_constant_stays_bit_constant(dtype: str, value: int, voids: bool) -> None:
    coverage = picture(60, 70, voids=True).coverage if voids else None
    values = np.full((60, 70, 3), value, np.float32)
    if coverage is not None:
        values[coverage == 0] = 0
    found, _ = enhanced(ArraySource(values, coverage, dtype), 4.0)
    assert (found == values).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_mean_stays_within_half_a_code(seed: int) -> None:
    """Smoothing with mirrored edges keeps the mean exactly; what is left comes from amplification and clipping: 0.06 codes here."""
    source = picture(256, 256, seed=seed)
    found, _ = enhanced(source)
    assert found.std() > 1.02 * source.values.std()
    assert abs(found.mean(dtype=np.float64) - source.values.mean(dtype=np.float64)) < 0.5


@pytest.mark.parametrize("voids", [False, True])
def test_nothing_moves_further_than_promised_or_leaves_the_range(voids: bool) -> None:
    """The unkindest picture: black and white noise, of which every detail is an edge."""
    rng = np.random.default_rng(3)
    values = rng.choice(np.array([0, 255], np.float32), (90, 80, 3))
    coverage = (rng.random((90, 80)) > 0.4).astype(np.float32) if voids else None
    if coverage is not None:
        values[coverage == 0] = 0
    source = ArraySource(values, coverage)
    found, _ = enhanced(source, 4.0)
    edge = 1 + parts_in_integers(source)[2] / 4
    assert found.min() >= 0
    assert found.max() <= 255
    assert (np.abs(found - values) <= 3 * SCALES * np.sqrt(3) * edge[..., np.newaxis]).all()


def test_what_lies_under_voids_reaches_nothing() -> None:
    source = picture(80, 90, voids=True)
    assert source.coverage is not None
    loud = source.values.copy()
    loud[source.coverage == 0] = 255
    expected, found = enhanced(source, 4.0)[0], enhanced(ArraySource(loud, source.coverage), 4.0)[0]
    assert found.tobytes() == expected.tobytes()
    assert (found[source.coverage == 0] == 0).all()


def test_voids_cast_no_edge() -> None:
    """On a ramp of 2 codes per sample, one-sided means would move samples beside a void by 4.1 codes; fading leaves 0.8."""
    ramp = np.broadcast_to(2 * np.arange(20, 110, dtype=np.float32)[np.newaxis, :, np.newaxis], (60, 90, 3)).copy()
    coverage = np.ones((60, 90), np.float32)
    coverage[20:40, 40:60] = 0
    ramp[coverage == 0] = 0
    found, _ = enhanced(ArraySource(ramp, coverage), 2.0)
    inside = np.s_[REACH:-REACH, REACH:-REACH]
    assert np.abs(found - ramp)[inside].max() < 1


def test_noise_is_left_alone_and_texture_is_not() -> None:
    rng = np.random.default_rng(4)
    shares = {}
    for amplitude in (0.5, 8.0):
        values = np.rint(100 + amplitude * rng.normal(size=(100, 100, 1))).astype(np.float32)
        shares[amplitude] = enhanced(ArraySource(values), 2.0)[0].std() / values.std() - 1
    assert shares[0.5] < 0.25
    assert shares[8.0] > 0.5


def test_hue_of_a_detail_is_kept() -> None:
    """A shadow scales all channels; so it does when it is amplified."""
    shade = 1 + 0.2 * np.sin(np.arange(96) / 2)[:, np.newaxis] * np.sin(np.arange(96) / 3)
    values = np.rint(shade[..., np.newaxis] * np.array([20_000, 40_000, 10_000])).astype(np.float32)
    found, _ = enhanced(ArraySource(values, dtype="uint16"), 2.0)
    assert np.abs(found[..., 1] / found[..., 0] - 2).max() < 1e-3
    assert np.abs(found[..., 1] / found[..., 2] - 4).max() < 1e-3
    assert np.abs(found - values).max() > 500


def test_rows_are_read_once() -> None:
    """Portions that end where the file's tiles do share their border with the next: without read-ahead each tile were decoded thrice."""
    source = picture(200, 40, chunk_rows=32)
    pieces = EnhancedSource(source, Enhancement(2.0))
    for y in range(0, 200, 32):
        pieces.read(Rect(0, y, 40, min(y + 32, 200)))
    assert source.read_rows == [(0, 64), (64, 96), (96, 128), (128, 160), (160, 192), (192, 200)]


@pytest.mark.parametrize("layout", [{"tiled": True}, {"tiled": False, "blockysize": 16}], ids=["tiled", "striped"])
def test_builds_do_not_depend_on_tasks_and_equal_the_whole(layout: dict[str, Any], tmp_path: Path) -> None:
    pixels = photo(350, 610, seed=3)
    source = write_tiff(tmp_path / "photo.tif", pixels, **layout)
    digests = set()
    for index, (workers, task) in enumerate(itertools.product((1, 3), (64, 128, 4096))):
        build_layer(source, tmp_path / str(index), settings(workers=workers, task=task, enhance="wavelet:2"))
        digests.add(tree_digest(tmp_path / str(index)))
    assert len(digests) == 1
    whole, _ = enhanced(ArraySource(pixels.astype(np.float32)), 2.0)
    dataset = open_dataset(tmp_path / "0")
    assert dataset.manifest.layer("imagery").enhance == "wavelet:2"
    assert (assemble(dataset, "imagery", 0)[0][:350, :610] == np.rint(whole)).all()
    plain = tmp_path / "plain"
    build_layer(source, plain, settings())
    assert open_dataset(plain).manifest.layer("imagery").enhance is None
    assert (assemble(open_dataset(plain), "imagery", 0)[0][:350, :610] == pixels).all(), "off by default"


def test_a_build_with_a_gain_of_one_has_the_blocks_of_one_without(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(100, 90, seed=3))
    for name, enhance in (("with", "wavelet:1"), ("without", None)):
        build_layer(source, tmp_path / name, settings(enhance=enhance))
    assert tree_digest(tmp_path / "with/imagery") == tree_digest(tmp_path / "without/imagery")


@pytest.mark.parametrize(
    ("spec", "gain"),
    [("wavelet", 1.5), ("wavelet:1", 1.0), ("wavelet:2.25", 2.25), ("wavelet:1.3333333333333333", 4 / 3), ("wavelet:4", 4.0)],
)
def test_forms(spec: str, gain: float) -> None:
    enhancement = parse_enhancement(spec)
    assert enhancement.gain == gain
    assert parse_enhancement(enhancement.spec) == enhancement
    assert spec in (enhancement.spec, "wavelet")


@pytest.mark.parametrize(
    "spec", ["", "sharpen", "wavelet:", "wavelet:x", "wavelet:0.5", "wavelet:9", "wavelet:nan", "wavelet:inf", "wavelets:2"]
)
def test_other_forms_are_refused(spec: str) -> None:
    with pytest.raises(UsageError, match=r"--enhance .*: expected wavelet or wavelet:GAIN with a gain from 1 to 4, e\.g\. wavelet:1\.5"):
        parse_enhancement(spec)


def test_heights_are_refused() -> None:
    source = ArraySource(np.zeros((9, 9, 1), np.float32), None, "float32", kind="height")
    with pytest.raises(UsageError, match=r"array: --enhance is for imagery, enhanced heights would be false; leave it out"):
        EnhancedSource(source, Enhancement(1.5))


def test_without_pywavelets_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pywt", None)
    with pytest.raises(MissingExtraError, match=r"--enhance needs PyWavelets: pip install 'clipmap\[enhance\]'"):
        EnhancedSource(picture(9, 9), Enhancement(1.5))


def test_the_command_line_enhances_and_shows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = write_tiff(tmp_path / "photo.tif", photo(70, 80, seed=5)), tmp_path / "out"
    assert run(["build", str(source), "-o", str(out), "--enhance", "wavelet"]) == 0
    capsys.readouterr()
    assert run(["inspect", str(out)]) == 0
    assert "enhanced  wavelet:1.5\n" in capsys.readouterr().out
    assert run(["inspect", str(out), "imagery", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["enhance"] == "wavelet:1.5"
    heights = write_tiff(tmp_path / "dem.tif", np.zeros((40, 40, 1), np.float32))
    assert run(["build", str(heights), "-o", str(tmp_path / "dem"), "--enhance", "wavelet"]) == 2
    assert "--enhance is for imagery" in capsys.readouterr().err
