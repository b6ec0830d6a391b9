import numpy as np
import pytest

from viewer.morph import STILL, alpha, coarse_height, morphed, ramp
from viewer.placement import grid_origin

SIDES = (15, 31, 63, 127, 255)


@pytest.mark.parametrize("n", SIDES)
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_alpha_is_1_on_the_rim_and_0_on_the_inner_boundary_for_every_viewer(n: int, precision: type) -> None:
    rng = np.random.default_rng(n)
    viewers = np.concatenate([rng.uniform(-1e5, 1e5, (400, 2)), np.rint(rng.uniform(-1e4, 1e4, (200, 2)))])
    side = np.arange(n)
    for x, y in viewers.tolist():
        origin = grid_origin(x, n, 0), grid_origin(y, n, 0)
        here = float(precision(x - origin[0])), float(precision(y - origin[1]))
        for fixed in (0, n - 1):
            across = np.full(n, fixed)
            for column, row in ((side, across), (across, side)):
                start, rate = precision(ramp(n).start), precision(ramp(n).rate)
                x_distance, y_distance = (
                    np.abs(part.astype(precision) - precision(at)) for part, at in ((column, here[0]), (row, here[1]))
                )
                assert ((np.maximum(x_distance, y_distance) - start) * rate >= 1).all()
        finer = grid_origin(2 * x, n, 0) // 2 - origin[0], grid_origin(2 * y, n, 0) // 2 - origin[1]
        inner = np.arange((n - 1) // 2 + 1, dtype=np.float64)
        for edge in (0, (n - 1) // 2):
            across = np.full(len(inner), float(edge))
            assert (alpha(inner + finer[0], across + finer[1], here, ramp(n)) == 0).all()
            assert (alpha(across + finer[0], inner + finer[1], here, ramp(n)) == 0).all()


def test_the_coarsest_level_does_not_morph() -> None:
    assert (alpha(np.arange(63.0), np.zeros(63), (31.0, 31.0), STILL) == 0).all()


def test_the_coarse_height_lies_on_the_coarse_triangles() -> None:
    rng = np.random.default_rng(4)
    coarse = rng.normal(size=(9, 9))
    y, x = np.mgrid[0:16, 0:16]
    got = coarse_height(coarse, x, y)
    for j in range(16):
        for i in range(16):
            # Barycentric interpolation in the quad's two triangles, cut from (0, 0) to (1, 1).
            qx, qy, fx, fy = i // 2, j // 2, (i % 2) / 2, (j % 2) / 2
            z00, z10, z01, z11 = coarse[qy, qx], coarse[qy, qx + 1], coarse[qy + 1, qx], coarse[qy + 1, qx + 1]
            expected = z00 + fx * (z10 - z00) + fy * (z11 - z10) if fx >= fy else z00 + fy * (z01 - z00) + fx * (z11 - z01)
            assert got[j, i] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("n", [15, 31, 63])
def test_levels_that_contradict_each_other_still_meet(n: int) -> None:
    rng = np.random.default_rng(n)
    levels = [rng.normal(size=(1024 >> level, 1024 >> level)) * 50 for level in range(3)]
    for _ in range(40):
        viewer = rng.uniform(400, 600, 2)
        surfaces, origins = [], []
        for level in range(2):
            x, y = (viewer / 2**level).tolist()
            origin = grid_origin(viewer[0], n, level), grid_origin(viewer[1], n, level)
            row, column = np.mgrid[0:n, 0:n]
            fine = levels[level][row + origin[1], column + origin[0]]
            below = coarse_height(levels[level + 1], column + origin[0], row + origin[1])
            weight = alpha(column + 0.0, row + 0.0, (x - origin[0], y - origin[1]), ramp(n))
            surfaces.append(morphed(fine, below, weight))
            origins.append(origin)
        half = (n - 1) // 2
        at_x, at_y = origins[0][0] // 2 - origins[1][0], origins[0][1] // 2 - origins[1][1]
        hole = surfaces[1][at_y : at_y + half + 1, at_x : at_x + half + 1]
        for rim, edge in (
            (np.s_[0, :], np.s_[0, :]),
            (np.s_[-1, :], np.s_[-1, :]),
            (np.s_[:, 0], np.s_[:, 0]),
            (np.s_[:, -1], np.s_[:, -1]),
        ):
            fine, coarse = surfaces[0][rim], hole[edge]
            np.testing.assert_array_equal(fine[::2], coarse)
            np.testing.assert_array_equal(fine[1::2], 0.5 * (coarse[:-1] + coarse[1:]))
