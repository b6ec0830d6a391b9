"""The counted geometry, by hand and against what the float64 pyramid really reads."""

import numpy as np
import pytest

from tests.reference.brute_lattice import blocks_of, fine_samples, level_sizes, rectangle, window
from tests.reference.edges import Edge
from tests.reference.kernels import Registration
from tests.reference.pyramid import coarsen
from tests.reference.terrain import impulse


def test_level_sizes_by_hand() -> None:
    assert level_sizes(1000, 300, 256) == [(1000, 300), (500, 150), (250, 75)]
    assert level_sizes(257, 1, 256) == [(257, 1), (129, 1)]
    assert level_sizes(256, 256, 256) == [(256, 256)]
    assert level_sizes(9, 5, 2) == [(9, 5), (5, 3), (3, 2), (2, 1)]


def test_blocks_by_hand() -> None:
    assert blocks_of(rectangle(-1, 7, 9, 9), 8) == {(-1, 0), (0, 0), (1, 0), (-1, 1), (0, 1), (1, 1)}
    assert blocks_of(rectangle(3, 3, 3, 9), 8) == set()


@pytest.mark.parametrize(("registration", "edge"), [("area", "mirror"), ("point", "antisymmetric")])
def test_fine_samples_are_those_that_change_the_coarse_one(registration: Registration, edge: Edge) -> None:
    read = set()
    for x in range(40):
        values, _ = coarsen(impulse(40, 40, 20, x), None, kernel="blackman-sinc", radius=3, registration=registration, edge=edge)
        if values[10, 10, 0] != 0:
            read.add(x)
    assert read == {x for x, _ in fine_samples({(10, 10)}, "blackman-sinc", 3, registration)}


def test_window_repeats_the_edge() -> None:
    level = np.arange(6).reshape(2, 3, 1)
    assert window(level, -2, -1, 5, 2)[:, :, 0].tolist() == [[0, 0, 0, 1, 2, 2, 2], [0, 0, 0, 1, 2, 2, 2], [3, 3, 3, 4, 5, 5, 5]]
