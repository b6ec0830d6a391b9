"""What the arithmetic alone loses: float32 levels against float64 ones of the same samples, at small and at large offsets."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from tiler.accuracy import plain
from tiler.accuracy.experiments import default_kernel, rms_of, run_cascade
from tiler.accuracy.ideal import interior
from tiler.accuracy.sample import Sample

OFFSETS: Final = (0.0, 1e5, 1e7)


@dataclass(frozen=True, slots=True)
class Rung:
    """Rounding of one level on a sample of standard deviation 1 around ``offset``: difference to float64 on the same float32 input."""

    offset: float
    level: int
    spacing: float
    """Distance between neighbouring float32 numbers at ``offset``, or at 1 if that is larger."""
    shipped_rms: float
    shipped_largest: float
    plain_rms: float
    plain_largest: float
    """A plain float32 sum, not over differences to a reference sample."""


def measure_precision(sample: Sample) -> list[Rung]:
    """Return what rounding costs the default kernel at each offset and level, as shipped and as a plain float32 sum."""
    kernel, count = default_kernel(sample), sample.level_count
    field = sample.values[..., :1].astype(np.float64)
    field = (field - field.mean()) / field.std()
    rungs: list[Rung] = []
    for offset in OFFSETS:
        single = (field + offset).astype(np.float32)
        exact = plain.levels(single.astype(np.float64), kernel, sample.edge, count)
        shipped = run_cascade(single, None, kernel, sample.edge, count)
        summed = plain.levels(single, kernel, sample.edge, count)
        for level in range(1, count + 1):
            ours = interior(shipped[level - 1][0] - exact[level - 1])
            theirs = interior(summed[level - 1] - exact[level - 1])
            rungs.append(
                Rung(
                    offset,
                    level,
                    float(np.spacing(np.float32(max(offset, 1.0)))),
                    rms_of(ours),
                    float(np.abs(ours).max()),
                    rms_of(theirs),
                    float(np.abs(theirs).max()),
                )
            )
    return rungs
