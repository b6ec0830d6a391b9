"""Hard cases of filtering, edges and sizes. The number in a name is the case's; the docstring states what must come out."""

import ast
from pathlib import Path

import numpy as np
import pytest

from schemas.region import Rect
from tests.levels import KINDS, run_cascade
from tests.reference import kernels as reference_kernels
from tests.reference import pyramid as reference
from tiler.codecs import BlockFormat
from tiler.filters.cascade import Values
from tiler.filters.decimate import coarsen_columns, coarsen_rows
from tiler.filters.edges import extend
from tiler.filters.kernels import blackman_sinc
from tiler.rowfile import RowFile
from tiler.tasks.rounding import round_samples

ROOT = Path(__file__).parents[2]
UINT8 = BlockFormat("imagery", 16, 1, "uint8")


def heights(array: np.typing.NDArray[np.float64]) -> Values:
    return array.astype(np.float32)[..., np.newaxis]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [0.0, 1.0, 8848.86, -430.5, 1e9])
def test_c01_constant_field(kind: str, value: float) -> None:
    """Every level equals the constant, bit for bit."""
    for _, values, _ in run_cascade(np.full((67, 83, 1), value, np.float32), None, levels=7, kind=kind):
        assert (values == np.float32(value)).all()


def test_c02_large_offset_with_unit_noise() -> None:
    """1e7 + noise: within one unit in the last place (1.0) of float64; a plain float32 sum of products misses by more."""
    values = (1e7 + np.random.default_rng(2).normal(size=(96, 96, 1))).astype(np.float32)
    expected = reference.coarsen(values.astype(float), None, kernel="blackman-sinc", radius=6, registration="point", edge="antisymmetric")[
        0
    ]
    assert np.abs(run_cascade(values, None, levels=2)[1][1] - expected).max() <= 1.0
    offsets, weights = blackman_sinc(6, "point").taps()
    naive = np.zeros((96, 36), np.float32)
    for offset, weight in zip(offsets, weights.astype(np.float32), strict=True):
        naive += weight * values[:, 12 + offset : 84 + offset : 2, 0]
    exact = sum(weight * values[:, 12 + offset : 84 + offset : 2, 0].astype(float) for offset, weight in zip(offsets, weights, strict=True))
    assert np.abs(naive - exact).max() > 1.0, "the guard of this test: the naive sum must be worse"


def test_c03_ramp_with_edges() -> None:
    """ax + by is exact on every level, edges included, within 2 units in the last place per level."""
    y, x = np.mgrid[0:129, 0:129]
    ramp = heights(1.5 * x - 0.75 * y + 100)
    for level, (_, values, _) in enumerate(run_cascade(ramp, None, levels=7)):
        assert np.abs(values - ramp[:: 2**level, :: 2**level]).max() <= 2 * max(1, level) * np.spacing(np.float32(292))


@pytest.mark.parametrize(("kind", "margin"), [("height", 6), ("imagery", 6)])
def test_c04_checkerboard_at_the_nyquist_frequency(kind: str, margin: int) -> None:
    """A +-1 checkerboard vanishes: exactly with the half-band kernel, and by symmetry with the even one."""
    board = heights(1.0 - 2 * (np.indices((80, 80)).sum(axis=0) % 2))
    coarse = run_cascade(board, None, levels=2, kind=kind)[1][1]
    assert (coarse[margin:-margin, margin:-margin] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", [(40, 40), (40, 41), (41, 40), (41, 41)])
def test_c05_impulse(kind: str, place: tuple[int, int]) -> None:
    """Wherever it sits, an impulse's coarse samples sum to a quarter of it: no phase gains or loses energy."""
    impulse = np.zeros((82, 82, 1), np.float32)
    impulse[place] = 1000
    coarse = run_cascade(impulse, None, levels=2, kind=kind)[1][1]
    assert np.isfinite(coarse).all()
    assert coarse.sum(dtype=np.float64) * 4 == pytest.approx(1000, abs=1e-3)


def test_c16_no_fast_math_anywhere() -> None:
    """numba's fastmath makes isnan() always false; no kernel may have it, nor parallel reductions of undefined order."""
    kernels, made = 0, 0
    for path in (ROOT / "tiler").rglob("*.py"):
        text = path.read_text()
        assert path.name == "kernelcache.py" or "numba" not in {name.partition(".")[0] for name in imported(text)}, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                kernels += any(isinstance(decorator, ast.Name) and decorator.id == "compiled" for decorator in node.decorator_list)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("njit", "jit", "vectorize"):
                made += 1
                assert {keyword.arg for keyword in node.keywords} == {"nogil"}, f"{path}:{node.lineno}"
    assert made == 1, "every kernel is made by tiler.kernelcache, without options"
    assert kernels >= 8


def imported(text: str) -> set[str]:
    """The modules that a module's text imports, wherever it does."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def test_c16_nan_survives_the_kernels() -> None:
    """A NaN under a tap makes the sum NaN; masks are what keeps it out, not arithmetic that loses it."""
    kernel = blackman_sinc(3, "area")
    low, high, weights = np.array(kernel.low), np.array(kernel.high), np.array(kernel.weights, np.float32)
    fine = np.ones((12, 12, 1), np.float32)
    fine[5, 5] = np.nan
    rows, columns = np.zeros((1, 12), np.float32), np.zeros((12, 1, 1), np.float32)
    coarsen_rows(fine[..., 0], 5, low, high, weights, 1, rows)
    coarsen_columns(fine, 5, low, high, weights, 1, columns)
    assert np.isnan(rows[0, 5])
    assert np.isnan(columns[5, 0, 0])


@pytest.mark.parametrize(
    ("value", "expected"), [(-0.4, 0), (-3.0, 0), (0.5, 0), (1.5, 2), (2.5, 2), (254.5, 254), (255.4, 255), (300.0, 255), (1e9, 255)]
)
def test_c18_round_half_to_even_and_saturate(value: float, expected: int) -> None:
    """Rounded to nearest once, ties to even, saturated at the type's ends: nothing wraps."""
    assert round_samples(np.full((1, 1, 1), value, np.float32), None, UINT8)[0] == expected


def test_c21_denormals() -> None:
    """1e-40 stays a constant 1e-40: no flush to zero on the way."""
    tiny = np.full((40, 40, 1), 1e-40, np.float32)
    assert all((values == np.float32(1e-40)).all() for _, values, _ in run_cascade(tiny, None, levels=3))


def test_c23_huge_values_do_not_overflow_within_reason() -> None:
    """Alternating +-1e30: sums of differences stay finite, within the overshoot bound."""
    values = np.where(np.random.default_rng(4).random((64, 64, 1)) < 0.5, -1e30, 1e30).astype(np.float32)
    coarse = run_cascade(values, None, levels=4)[3][1]
    assert np.isfinite(coarse).all()
    assert np.abs(coarse).max() < 1e32


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 1), (1, 100), (5, 2)])
def test_c24_tiny_and_thin_pictures(kind: str, size: tuple[int, int]) -> None:
    """Each axis halves on its own down to one sample; a reflection of period 0 is a constant, not an index error."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=(*size, 1)).astype(np.float32)
    registration, edge = KINDS[kind]
    expected = reference.pyramid(values.astype(float), None, 8, kernel="blackman-sinc", radius=6, registration=registration, edge=edge)
    for (_, found, _), (right, _) in zip(run_cascade(values, None, levels=8, kind=kind), expected, strict=True):
        assert found.shape == right.shape
        assert np.abs(found - right).max() < 1e-3


def test_c24_reflection_of_a_single_line() -> None:
    """n = 1: what lies beyond the edge is the line itself, for both rules."""
    line = np.full((1, 3, 1), 7, np.float32)
    for rule in ("antisymmetric", "mirror"):
        beyond, _ = extend(line, None, rule=rule, size=1, origin=0, indices=range(-12, 0))
        assert (beyond == 7).all()


def test_c25_extreme_aspect() -> None:
    """2 x 100000 samples: 17 levels, the last a single sample, all finite and within the range of the input's overshoot."""
    values = np.random.default_rng(9).random((2, 100_000, 1)).astype(np.float32)
    levels = run_cascade(values, None, levels=18, kind="imagery", radius=3, portion=1)
    assert [found.shape[:2] for _, found, _ in levels][-1] == (1, 1)
    assert all(np.isfinite(found).all() for _, found, _ in levels)
    assert abs(float(levels[-1][1][0, 0, 0]) - 0.5) < 0.02


def test_c28_more_than_two_to_the_32_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Offsets beyond 2**32 bytes reach their own place: a corner of a sparse 70000 x 70000 scratch file."""
    rows = RowFile(70_000, 70_000, 1, np.dtype(np.uint8), tmp_path)
    try:
        corner = np.arange(16, dtype=np.uint8).reshape(4, 4, 1)
        rows.write(69_996, 69_996, corner)
        rows.write(0, 0, corner[::-1])
        assert (rows.read(Rect(69_996, 69_996, 70_000, 70_000)) == corner).all()
        assert (rows.read(Rect(0, 0, 4, 4)) == corner[::-1]).all()
        assert (rows.read(Rect(69_992, 69_992, 69_996, 69_996)) == 0).all()
    finally:
        rows.close()


@pytest.mark.parametrize(("linear_light", "expected"), [(False, 128), (True, 188)])
def test_c61_gamma(linear_light: bool, expected: int) -> None:
    """A black and white 2 x 2 pattern: 188 as light, 128 as codes."""
    codes = np.array([[0, 255], [255, 0]], np.float32)[..., np.newaxis]
    values = np.where(codes > 0, np.float32(1), np.float32(0)) if linear_light else codes
    coarse = run_cascade(values, None, levels=2, kind="imagery", radius=1, name="box")[1][1]
    assert round_samples(coarse, None, UINT8, linear_light)[0] == expected


def test_c63_opaque_stays_opaque() -> None:
    """Alpha 255 everywhere is alpha 255 on every level: coverage is exactly 1, not 0.9999."""
    values = np.random.default_rng(3).uniform(0, 255, (60, 60, 3)).astype(np.float32)
    for _, _, coverage in run_cascade(values, np.ones((60, 60), np.float32), levels=6, kind="imagery", radius=3):
        assert coverage is not None
        assert (coverage == 1).all()


def test_c64_step_of_full_range_saturates() -> None:
    """A 0 | 255 edge overshoots by 5 % in float32; stored, it stays in 0..255 and monotone plateaus stay plateaus."""
    step = np.zeros((64, 64, 1), np.float32)
    step[:, 31:] = 255
    coarse = run_cascade(step, None, levels=2, kind="imagery", radius=3)[1][1]
    assert coarse.min() < 0
    assert coarse.max() > 255
    stored, _ = round_samples(coarse, None, UINT8)
    assert stored.dtype == np.uint8
    assert set(np.unique(stored[:, :12])) == {0}
    assert set(np.unique(stored[:, 20:])) == {255}


def test_c65_plateau_stays_a_plateau() -> None:
    """Where all taps see 255, the result is 255 exactly."""
    plateau = np.full((40, 40, 1), 255, np.float32)
    plateau[:8] = 10
    coarse = run_cascade(plateau, None, levels=2, kind="imagery", radius=3)[1][1]
    assert (coarse[8:] == 255).all()


def test_reference_and_kernels_share_nothing() -> None:
    """The oracle must not import what it judges."""
    for module in (reference, reference_kernels):
        assert "tiler" not in Path(str(module.__file__)).read_text()
