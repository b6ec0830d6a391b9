"""Draws ``docs/images/light-twice.png``: Mount Rainier lit from its heights, and at twice their resolution.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python -m docs.light_twice

Puget Sound at 160 m, built and lit by ``clipmap build`` and ``clipmap light`` in a folder of its own; every sample is a square of 6
pixels above, of 3 below. Takes some seconds. Look at the result before you commit it.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Final

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from cli.main import run
from schemas.region import Rect
from tiler.export.pyramid import Pyramid
from tiler.stores.dataset import open_dataset

IMAGE: Final = Path(__file__).parent / "images/light-twice.png"
RAINIER: Final = Rect(768, 512, 908, 582)
"""The summit and its shadow."""
ZOOM: Final = 6


def picture(dataset: Path, layer: str, density: int) -> NDArray[np.uint8]:
    """Return the samples of ``RAINIER``, ``ZOOM / density`` pixels each."""
    seen = Rect(*(density * side for side in (RAINIER.x0, RAINIER.y0, RAINIER.x1, RAINIER.y1)))
    codes = Pyramid(open_dataset(dataset), layer, 1).window(0, seen).samples[..., 0]
    return np.kron(codes, np.ones((ZOOM // density, ZOOM // density), np.uint8))


def main() -> int:
    """Draw the picture."""
    data = os.environ.get("CLIPMAP_TEST_DATA")
    if data is None:
        sys.stderr.write("CLIPMAP_TEST_DATA is not set\n")
        return 2
    with tempfile.TemporaryDirectory() as folder:
        dataset = Path(folder) / "puget"
        heights = ["--layer", "height", "--spacing", "160", "--height-scale", "0.1"]
        run(["build", str(Path(data) / "puget/ps_height_1k.png"), *heights, "-o", str(dataset)])
        for layer, density in (("light", []), ("fine", ["--twice"])):
            run(["light", str(dataset), "--sun", "270,15", "--sky", "16", "--layer", layer, *density])
        parts = [picture(dataset, "light", 1), picture(dataset, "fine", 2)]
    imagecodecs.imwrite(IMAGE, np.concatenate([parts[0], np.full((ZOOM, parts[0].shape[1]), 255, np.uint8), parts[1]]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
