"""Makes the picture of docs/ENHANCE.md: crops of level 0 and level 2 as they are, with the default gain, and with a gain of 3.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python docs/enhance.py

The upper rows are the built-in island and need nothing; the lower ones a piece of the Blue Marble from the folder of real inputs.
Run it when the enhancement changes, and look at the result before you commit it.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from cli.main import run
from schemas.region import Rect
from tiler.codecs import BlockFormat, open_codec
from tiler.stores.dataset import Dataset, open_dataset
from tiler.terrain import make_island

TARGET: Final = Path(__file__).parent / "images" / "enhance.jpg"
ENHANCEMENTS: Final = ((), ("--enhance", "wavelet"), ("--enhance", "wavelet:3"))
LEVELS: Final = (0, 2)
SIDE: Final = 288
"""Side of a crop; those of coarse levels are magnified to it."""
_GAP: Final = 6

Pixels = NDArray[Any]


def crop(dataset: Dataset, level: int, window: Rect) -> Pixels:
    """Return the samples of a window of a level of the layer ``imagery``."""
    layer = dataset.manifest.layer("imagery")
    codec = open_codec(layer.codec, BlockFormat(layer.kind, layer.lattice.stored_side, layer.channels, layer.dtype, layer.alpha))
    columns, rows = layer.lattice.block_counts(level)
    picture = np.zeros((rows * layer.block, columns * layer.block, layer.channels), layer.dtype)
    for address in layer.lattice.addresses(level):
        core = layer.lattice.core(address)
        data = dataset.block("imagery", address) if core & window else None
        if data is not None:
            picture[core.y0 : core.y1, core.x0 : core.x1] = codec.decode(data)[0]
    return picture[window.y0 : window.y1, window.x0 : window.x1]


def rows_of(source: Path, x: int, y: int, folder: Path) -> list[Pixels]:
    """Build ``source`` once per enhancement; return one row of crops per level, whose sample (x, y) of level 0 is the top left one."""
    datasets = []
    for number, options in enumerate(ENHANCEMENTS):
        output = folder / f"{source.stem}-{number}"
        if status := run(["build", str(source), "-o", str(output), "--layer", "imagery", "--codec", "png", *options]):
            sys.exit(status)
        datasets.append(open_dataset(output))
    rows = []
    for level in LEVELS:
        # A level's crop shows as many samples as fit, magnified so that they can be seen one by one.
        zoom = 1 << level
        side = SIDE >> level
        window = Rect(x >> level, y >> level, (x >> level) + side, (y >> level) + side)
        rows.append(side_by_side([crop(dataset, level, window).repeat(zoom, axis=0).repeat(zoom, axis=1) for dataset in datasets], axis=1))
    return rows


def side_by_side(pictures: list[Pixels], axis: int) -> Pixels:
    """Return pictures in a row (``axis`` 1) or a column (0), with white between them."""
    shape = list(pictures[0].shape)
    shape[axis] = _GAP
    gap = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=axis)


def main() -> None:
    """Write the picture of what can be built here."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        island = folder / "island.png"
        island.write_bytes(imagecodecs.png_encode(make_island().colour))
        rows = rows_of(island, 1040, 780, folder)
        if "CLIPMAP_TEST_DATA" in os.environ:
            marble = Path(os.environ["CLIPMAP_TEST_DATA"]) / "bluemarble/world_topo_bathy_200411_3x5400x2700.jpg"
            rows += rows_of(marble, 2780, 560, folder)
    TARGET.write_bytes(imagecodecs.jpeg_encode(np.ascontiguousarray(side_by_side(rows, axis=0)), level=90))


if __name__ == "__main__":
    main()
