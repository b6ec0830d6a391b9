import numpy as np
import pytest

from viewer.footprint import Patch, centre, grid_mesh, meshes, patches, perimeter_mesh, ring, shape_sizes, trim

SIDES = (15, 31, 63, 127, 255)


def cover(n: int, parts: tuple[Patch, ...]) -> np.ndarray:
    """How often each quad of a level is drawn, counted from the meshes themselves."""
    counted = np.zeros((n - 1, n - 1), int)
    for patch in parts:
        if patch.shape == "perimeter":
            continue
        mesh = grid_mesh(*shape_sizes(n)[patch.shape])
        corners = mesh.vertices[mesh.triangles].astype(int)
        # Two triangles share a quad: its lowest corner is the lowest of their vertices.
        for x, y in corners.min(axis=1) + np.array([patch.x, patch.y]):
            counted[y, x] += 1
    assert (counted % 2 == 0).all()
    return counted // 2


@pytest.mark.parametrize("n", SIDES)
@pytest.mark.parametrize("right", [0, 1])
@pytest.mark.parametrize("down", [0, 1])
def test_a_ring_covers_all_but_the_finer_level_once(n: int, right: int, down: int) -> None:
    m = (n + 1) // 4
    x, y = m - 1 + right, m - 1 + down
    expected = np.ones((n - 1, n - 1), int)
    expected[y : y + (n - 1) // 2, x : x + (n - 1) // 2] = 0
    np.testing.assert_array_equal(cover(n, ring(n) + trim(n, x, y)), expected)


@pytest.mark.parametrize("n", SIDES)
def test_ring_and_centre_cover_the_level_once(n: int) -> None:
    assert (cover(n, ring(n) + centre(n)) == 1).all()


@pytest.mark.parametrize("n", SIDES)
def test_every_triangle_is_half_a_quad_and_its_diagonal_runs_from_0_0_to_1_1(n: int) -> None:
    for shape, mesh in meshes(n).items():
        if shape == "perimeter":
            continue
        a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
        area2 = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (np.abs(area2) == 1).all()
        for edge in (b - a, c - b, a - c):
            diagonal = np.abs(edge).sum(axis=1) == 2
            assert (edge[diagonal][:, 0] == edge[diagonal][:, 1]).all()


@pytest.mark.parametrize("n", SIDES)
def test_the_perimeter_covers_every_coarse_edge_with_a_triangle_of_no_area(n: int) -> None:
    mesh = perimeter_mesh(n)
    assert len(mesh.triangles) == 2 * (n - 1)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(int) for k in range(3))
    assert ((b - a)[:, 0] * (c - a)[:, 1] == (b - a)[:, 1] * (c - a)[:, 0]).all()
    assert (a + c == 2 * b).all()
    last = n - 1
    edges = {frozenset([tuple(p), tuple(q)]) for p, q in zip(a.tolist(), c.tolist(), strict=True)}
    along = [(k, k + 2) for k in range(0, last, 2)]
    wanted = {frozenset([(p, fixed), (q, fixed)]) for p, q in along for fixed in (0, last)}
    wanted |= {frozenset([(fixed, p), (fixed, q)]) for p, q in along for fixed in (0, last)}
    assert edges == wanted


def test_triangles_of_eleven_levels_are_those_of_losasso_and_hoppe() -> None:
    n, sizes = 255, shape_sizes(255)
    origins = [(0, 0)]
    for _ in range(10):
        origins.append((origins[-1][0] // 2 - 63, origins[-1][1] // 2 - 64))
    drawn = patches(n, origins)
    quads = sum(sizes[patch.shape][0] * sizes[patch.shape][1] for level in drawn for patch in level if patch.shape != "perimeter")
    assert 2 * quads == 1_096_772


def test_a_finer_level_elsewhere_does_not_nest() -> None:
    with pytest.raises(ValueError, match="does not nest"):
        trim(15, 5, 3)
