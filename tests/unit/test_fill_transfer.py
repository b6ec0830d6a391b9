"""Filling of voids, and linear light."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.region import Rect
from tests.integration.files import assemble, settings, write_tiff
from tests.reference.terrain import terrain
from tiler.building.build import build_layer
from tiler.samples.fill import FilledSource
from tiler.samples.transfer import LinearLight, encode_srgb, light_of_codes
from tiler.sources import FileInfo
from tiler.sources.convert import Conversion
from tiler.stores.dataset import open_dataset

Float32 = NDArray[np.float32]


@dataclass
class ArraySource:
    """Samples in memory."""

    values: Float32
    coverage: Float32 | None
    dtype: Any = "float32"
    masked: bool = True
    info: FileInfo = field(init=False)
    conversion: Conversion = field(init=False)

    def __post_init__(self) -> None:
        rows, columns, channels = self.values.shape
        self.info = FileInfo(Path("array"), "array", columns, rows, channels, np.dtype(self.dtype), 1, "tiled", 1)
        self.conversion = Conversion("height", tuple(range(channels)), None, False, None, None, 1.0, 0.0, self.dtype)

    def read(self, window: Rect) -> tuple[Float32, Float32 | None]:
        part = np.s_[window.y0 : window.y1, window.x0 : window.x1]
        return self.values[part], None if self.coverage is None else self.coverage[part]

    def read_lean(self, window: Rect) -> tuple[Float32, Float32 | None]:
        return self.read(window)

    def begin(self) -> None:
        """Nothing to digest."""

    def digest(self) -> str:
        return ""

    def close(self) -> None:
        """Nothing to close."""


def holed(seed: int, void_share: float) -> ArraySource:
    rng = np.random.default_rng(seed)
    coverage = (rng.random((40, 50)) >= void_share).astype(np.float32)
    coverage[10:20, 15:35] = 0
    values = terrain(40, 50, seed=seed).astype(np.float32)
    values[coverage == 0] = 0
    return ArraySource(values, coverage)


def filled_by_definition(source: ArraySource, across: int) -> tuple[Float32, NDArray[np.bool_]]:
    """The rule as it is documented, one sample at a time in plain Python."""
    assert source.coverage is not None
    values, valid = source.values[..., 0].astype(float), source.coverage > 0
    out, known = values.copy(), valid.copy()
    rows, columns = valid.shape
    for y, x in zip(*np.nonzero(~valid), strict=True):
        lines = []
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            ends = []
            for sign in (1, -1):
                for step in range(1, across + 1):
                    v, u = y + sign * step * dy, x + sign * step * dx
                    if not (0 <= v < rows and 0 <= u < columns):
                        break
                    if valid[v, u]:
                        ends.append((step, values[v, u]))
                        break
            if len(ends) == 2 and ends[0][0] + ends[1][0] - 1 <= across:
                (ahead, first), (behind, second) = ends
                length = (ahead + behind) * np.hypot(dy, dx)
                lines.append((length**-2, (first * behind + second * ahead) / (ahead + behind)))
        if lines:
            out[y, x] = sum(w * z for w, z in lines) / sum(w for w, _ in lines)
            known[y, x] = True
    return out.astype(np.float32), known


@pytest.mark.parametrize("across", [1, 3, 8])
@pytest.mark.parametrize("void_share", [0.02, 0.4])
def test_fill_follows_its_definition(across: int, void_share: float) -> None:
    source = holed(3, void_share)
    expected, known = filled_by_definition(source, across)
    values, coverage = FilledSource(source, across).read(Rect(0, 0, 50, 40))
    assert coverage is not None
    assert ((coverage > 0) == known).all()
    assert np.abs(values[..., 0] - expected)[known].max() <= 2 * np.spacing(np.float32(3000))
    assert (values[~known] == 0).all()
    assert not known.all() or across == 8


@given(st.integers(0, 30), st.integers(0, 30), st.integers(1, 20), st.integers(1, 10))
def test_fill_does_not_depend_on_the_window(x: int, y: int, side: int, across: int) -> None:
    source = FilledSource(holed(5, 0.3), across)
    whole, covered = source.read(Rect(0, 0, 50, 40))
    window = Rect(x, y, min(50, x + side), min(40, y + side))
    part, part_covered = source.read(window)
    assert covered is not None
    assert part_covered is not None
    there = np.s_[window.y0 : window.y1, window.x0 : window.x1]
    assert part.tobytes() == np.ascontiguousarray(whole[there]).tobytes()
    assert part_covered.tobytes() == np.ascontiguousarray(covered[there]).tobytes()


def test_a_ramp_is_filled_exactly() -> None:
    y, x = np.mgrid[0:20, 0:20]
    ramp = (4 * x + 2 * y).astype(np.float32)[..., np.newaxis]
    coverage = np.ones((20, 20), np.float32)
    coverage[8:11, 8:11] = 0
    values, covered = FilledSource(ArraySource(np.where(coverage[..., np.newaxis] > 0, ramp, np.float32(0)), coverage), 3).read(
        Rect(0, 0, 20, 20)
    )
    assert covered is not None
    assert covered.all()
    assert np.abs(values - ramp).max() < 1e-4


def test_fill_is_in_the_manifest_and_changes_only_voids(tmp_path: Path) -> None:
    pixels = terrain(100, 120, seed=2).astype(np.float32)
    pixels[50:53, 60:63] = np.nan
    pixels[20:60, 20:50] = np.nan
    source = write_tiff(tmp_path / "holes.tif", pixels)
    for name, options in (("plain", {}), ("filled", {"fill": 5})):
        build_layer(source, tmp_path / name, settings(**options))
    plain, filled = (open_dataset(tmp_path / name) for name in ("plain", "filled"))
    assert [dataset.manifest.layer("height").fill for dataset in (plain, filled)] == [0, 5]
    (before, valid), (after, valid_after) = (assemble(dataset, "height", 0) for dataset in (plain, filled))
    assert (before[valid] == after[valid]).all()
    assert valid_after[50:53, 60:63].all()
    assert not valid_after[25:55, 25:45].any()


@pytest.mark.parametrize("top", [255, 65535])
def test_every_code_survives_linear_light(top: int) -> None:
    assert (np.rint(encode_srgb(light_of_codes(top), top)) == np.arange(top + 1)).all()


def test_linear_light_reads_codes_as_light() -> None:
    codes = np.arange(256, dtype=np.float32).reshape(16, 16, 1)
    light, _ = LinearLight(ArraySource(codes, None, dtype="uint8")).read(Rect(0, 0, 16, 16))
    assert light.min() == 0
    assert light.max() == 1
    assert light[0, 10, 0] == pytest.approx(10 / 255 / 12.92, rel=1e-6)
    assert light[11, 12, 0] == pytest.approx(((188 / 255 + 0.055) / 1.055) ** 2.4, rel=1e-6)


@pytest.mark.parametrize(("options", "expected"), [({}, 128), ({"linear_light": True}, 188)])
def test_black_and_white_pattern(options: dict[str, Any], expected: int, tmp_path: Path) -> None:
    """Half black, half white is half the light: code 188, not 128."""
    pattern = (255 * (np.indices((64, 64)).sum(axis=0) % 2)).astype(np.uint8)[..., np.newaxis]
    source = write_tiff(tmp_path / "pattern.tif", pattern)
    report = build_layer(source, tmp_path / "out", settings(layer="imagery", filter="box", **options))
    samples, _ = assemble(open_dataset(tmp_path / "out"), "imagery", 1)
    assert (samples[:32, :32] == expected).all()
    assert report.manifest.layer("imagery").filter.linear_light == bool(options)
    finest, _ = assemble(open_dataset(tmp_path / "out"), "imagery", 0)
    assert (finest[:64, :64] == pattern).all()


@pytest.mark.parametrize(("options", "message"), [({"linear_light": True}, "--linear-light is for imagery")])
def test_wrong_kind_is_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "height.tif", terrain(40, 40).astype(np.float32))
    with pytest.raises(UsageError, match=message):
        build_layer(source, tmp_path / "out", settings(**options))
