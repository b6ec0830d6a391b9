"""One window of a picture through the cascade: what tests of levels share."""

import numpy as np

from schemas.lattice import Registration
from schemas.manifest import KernelName
from schemas.region import Rect
from tiler.filters.cascade import Cascade, Coverage, Recipe, Values, held_windows
from tiler.filters.edges import EdgeRule
from tiler.filters.kernels import DESIGNS

LevelRows = tuple[Rect, Values, Coverage | None]
HEIGHT: tuple[Registration, EdgeRule] = ("point", "antisymmetric")
IMAGERY: tuple[Registration, EdgeRule] = ("area", "mirror")
LIGHT: tuple[Registration, EdgeRule] = ("point", "mirror-sample")
KINDS = {"height": HEIGHT, "imagery": IMAGERY, "light": LIGHT}


def run_cascade(
    values: Values,
    coverage: Coverage | None,
    *,
    levels: int,
    kind: str = "height",
    radius: int = 6,
    core: Rect | None = None,
    pad: int = 0,
    clamp: bool = False,
    name: KernelName = "blackman-sinc",
    portion: int = 1 << 30,
    lean: bool = False,
) -> list[LevelRows]:
    """Return (held window, values, coverage) of every level for one window of the whole picture.

    ``lean``: the coverage of portions that are whole is left out, as sources do.
    """
    registration, edge = KINDS[kind]
    height, width, channels = values.shape
    kernel = DESIGNS[name](radius, registration)
    windows = held_windows((width, height), core or Rect(0, 0, width, height), [pad] * levels, kernel.reach)
    rows: list[list[tuple[int, Values, Coverage | None]]] = [[] for _ in range(levels)]

    def covered_part(part: Values, covered: Coverage | None) -> Coverage | None:
        if coverage is None:
            assert covered is None
            return None
        return np.ones(part.shape[:2], np.float32) if covered is None else covered.copy()

    cascade = Cascade(
        (width, height),
        windows,
        channels,
        Recipe(kernel, edge, coverage is not None, clamp),
        lambda level, first, part, covered: rows[level].append((first, part.copy(), covered_part(part, covered))),
    )
    whole = windows[0]
    for y in range(whole.y0, whole.y1, portion):
        rows_columns = np.s_[y : min(whole.y1, y + portion), whole.x0 : whole.x1]
        covered = None if coverage is None else np.ascontiguousarray(coverage[rows_columns])
        if lean and covered is not None and (covered == 1).all():
            covered = None
        cascade.push(np.ascontiguousarray(values[rows_columns]), covered)
    result: list[LevelRows] = []
    for level, window in enumerate(windows):
        firsts = [first for first, _, _ in rows[level]]
        lengths = [len(part) for _, part, _ in rows[level]]
        assert firsts == [window.y0 + sum(lengths[:index]) for index in range(len(lengths))], "rows come in order, without gaps"
        coverages = [part for _, _, part in rows[level] if part is not None]
        result.append((window, np.concatenate([part for _, part, _ in rows[level]]), np.concatenate(coverages) if coverages else None))
    return result
