"""Stored borders against the neighbours' cores: what a client's filters see beyond a block is what the neighbour shows there."""

from dataclasses import dataclass

import numpy as np

from schemas.address import BlockAddress
from schemas.lattice import Lattice
from schemas.manifest import Layer
from schemas.region import Rect
from tiler.checking.blockreader import DecodedBlock
from tiler.codecs import Mask, Samples


@dataclass(frozen=True, slots=True)
class Seam:
    """How the border of ``block`` differs from the core of ``neighbour``."""

    block: BlockAddress
    neighbour: BlockAddress
    compared: int
    """Samples compared."""
    differing: int
    """Samples that differ by more than is allowed, or are valid in one of the two only."""
    largest: float
    """Largest difference over all channels of samples valid in both; 0 if there are none."""
    first: tuple[int, int] | None
    """Column and row on the level of the first differing sample in row order."""


def seam_tolerance(layer: Layer) -> float | None:
    """Return how far a stored border may be from the neighbour's core: both err by at most ``max_error``; None if not bounded."""
    return None if layer.max_error is None else 2 * layer.max_error


def compare_seam(
    layer: Layer, block: BlockAddress, own: DecodedBlock, neighbour: BlockAddress, other: DecodedBlock | None, tolerance: float | None
) -> Seam:
    """Compare the border of ``own`` with the core of ``other``, decoded blocks with their pads; ``other`` is None if blank.

    A ``tolerance`` of None allows any difference of values. Voids must agree exactly, but for the alpha of a codec without a bound.
    """
    lattice = layer.lattice
    border = lattice.core(block).grown(lattice.pad) & lattice.valid_core(neighbour)
    mine = own.samples[_window(lattice, block, border)]
    valid = own.valid[_window(lattice, block, border)]
    if other is None:
        theirs, there = mine, np.zeros_like(valid)
    else:
        theirs, there = other.samples[_window(lattice, neighbour, border)], other.valid[_window(lattice, neighbour, border)]
    both = valid & there
    distance = np.where(both, np.abs(mine.astype(np.float64) - theirs.astype(np.float64)).max(axis=-1), 0.0)
    wrong = np.zeros_like(valid) if tolerance is None else ~(distance <= tolerance + _rounding(layer, mine, both))
    if tolerance is not None or layer.kind == "height":
        wrong |= valid != there
    places = np.argwhere(wrong)
    first = None if not len(places) else (border.x0 + int(places[0][1]), border.y0 + int(places[0][0]))
    return Seam(block, neighbour, border.area, len(places), float(distance.max()), first)


def _window(lattice: Lattice, address: BlockAddress, samples: Rect) -> tuple[slice, slice]:
    """Return where ``samples`` of the level lie in a stored block."""
    core = lattice.core(address)
    inside = samples.shifted(lattice.pad - core.x0, lattice.pad - core.y0)
    return np.s_[inside.y0 : inside.y1, inside.x0 : inside.x1]


def _rounding(layer: Layer, samples: Samples, valid: Mask) -> float:
    """Return what rounding to float32 may add to a bounded error: half a unit in the last place on either side."""
    if not layer.max_error or layer.dtype != "float32" or not valid.any():
        return 0.0
    return float(np.spacing(np.abs(samples[valid]).max()))
