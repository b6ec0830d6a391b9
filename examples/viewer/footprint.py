"""The rings of a geometry clipmap, put together from a few small meshes that every level shares.

A level of n x n vertices draws the ring around the next finer one with 12 blocks, 4 strips that fix up what the blocks
leave, and an L-shaped trim that fills the gap beside the finer level; the finest level drawn fills its centre too
(Asirvatham & Hoppe, section 2.3.2). m = (n + 1) / 4, and the sizes below are in quads.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Shape = Literal["block", "wide", "tall", "centre", "trim_row", "trim_column", "perimeter"]


@dataclass(frozen=True, slots=True)
class Patch:
    """A mesh put at vertex (x, y) of its level."""

    shape: Shape
    x: int
    y: int


def shape_sizes(n: int) -> dict[Shape, tuple[int, int]]:
    """Return (columns, rows) of quads of every mesh; ``perimeter`` has none of its own and spans the level."""
    m = (n + 1) // 4
    s = m - 1
    return {
        "block": (s, s),
        "wide": (s, 2),
        "tall": (2, s),
        "centre": (2, 2),
        "trim_row": (2 * m, 1),
        "trim_column": (1, 2 * m - 1),
        "perimeter": (n - 1, n - 1),
    }


def _block_origins(n: int) -> tuple[int, int, int, int]:
    s = (n + 1) // 4 - 1
    return 0, s, n - 1 - 2 * s, n - 1 - s


@cache
def ring(n: int) -> tuple[Patch, ...]:
    """Return the blocks and fix-up strips outside the hole of 2m x 2m quads, and the strip of zero area on the perimeter."""
    at = _block_origins(n)
    s = at[1]
    blocks = [Patch("block", at[i], at[j]) for j in range(4) for i in range(4) if i in (0, 3) or j in (0, 3)]
    strips = [Patch("wide", 0, 2 * s), Patch("wide", at[3], 2 * s), Patch("tall", 2 * s, 0), Patch("tall", 2 * s, at[3])]
    return (*blocks, *strips, Patch("perimeter", 0, 0))


@cache
def trim(n: int, finer_x: int, finer_y: int) -> tuple[Patch, ...]:
    """Return the L-shape beside the finer level, which begins at vertex (finer_x, finer_y): m - 1 or m on either axis."""
    m = (n + 1) // 4
    s = m - 1
    if finer_x not in (s, m) or finer_y not in (s, m):
        raise ValueError(f"a finer level at ({finer_x}, {finer_y}) does not nest in a grid of {n} vertices")
    right, below = finer_x == s, finer_y == s
    row = Patch("trim_row", s, s + (2 * m - 1 if below else 0))
    column = Patch("trim_column", s + (2 * m - 1 if right else 0), s + (0 if below else 1))
    return row, column


@cache
def centre(n: int) -> tuple[Patch, ...]:
    """Return what fills the hole of the finest level drawn."""
    at = _block_origins(n)
    s = at[1]
    blocks = [Patch("block", at[i], at[j]) for j in (1, 2) for i in (1, 2)]
    wide = [Patch("wide", at[1], 2 * s), Patch("wide", at[2], 2 * s)]
    tall = [Patch("tall", 2 * s, at[1]), Patch("tall", 2 * s, at[2])]
    return (*blocks, *wide, *tall, Patch("centre", 2 * s, 2 * s))


@dataclass(frozen=True, slots=True)
class Mesh:
    """Vertices (count, 2) int32 in grid units and triangles (count, 3) uint32."""

    vertices: NDArray[np.int32]
    triangles: NDArray[np.uint32]


def grid_mesh(columns: int, rows: int) -> Mesh:
    """Return a mesh of ``columns`` x ``rows`` quads, each cut along its diagonal from (0, 0) to (1, 1).

    The diagonal is the one along which ``morph.coarse_height`` interpolates, so a fully morphed level lies on the coarser one.
    """
    y, x = np.mgrid[0 : rows + 1, 0 : columns + 1]
    vertices = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.int32)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    right, below, opposite = corner + 1, corner + columns + 1, corner + columns + 2
    triangles = np.stack([corner, right, opposite, corner, opposite, below], axis=-1).reshape(-1, 3)
    return Mesh(vertices, triangles.astype(np.uint32))


def perimeter_mesh(n: int) -> Mesh:
    """Return the 2 (n - 1) triangles of zero area that close the T-junctions between a level and the coarser one.

    Each spans one edge of the coarser grid: two vertices the levels share and the finer level's vertex between them.
    """
    last = n - 1
    run = np.arange(last)
    sides = [(run, 0 * run), (0 * run + last, run), (last - run, 0 * run + last), (0 * run, last - run)]
    vertices = np.concatenate([np.stack(side, axis=-1) for side in sides]).astype(np.int32)
    first = np.arange(0, len(vertices), 2)
    triangles = np.stack([first, first + 1, (first + 2) % len(vertices)], axis=-1)
    return Mesh(vertices, triangles.astype(np.uint32))


def meshes(n: int) -> dict[Shape, Mesh]:
    """Return every mesh of a clipmap of n x n vertices."""
    return {shape: perimeter_mesh(n) if shape == "perimeter" else grid_mesh(*size) for shape, size in shape_sizes(n).items()}


def patches(n: int, origins: Sequence[tuple[int, int]]) -> list[list[Patch]]:
    """Return the patches of each level drawn, given the levels' origins, finest first, each in samples of its own level."""
    drawn = [[*ring(n), *centre(n)]]
    for finer, coarser in pairwise(origins):
        drawn.append([*ring(n), *trim(n, finer[0] // 2 - coarser[0], finer[1] // 2 - coarser[1])])
    return drawn
