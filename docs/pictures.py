"""Renders the pictures of the README and of docs/ by the commands that the README shows.

    CLIPMAP_TEST_DATA=/path/to/data .venv/bin/python docs/pictures.py

``puget.png`` needs the folder of real inputs; ``island.png`` needs nothing. Run it when the viewer's picture changes, and
look at the result before you commit it.
"""

import os
import sys
import tempfile
from pathlib import Path

from cli.main import run

IMAGES = Path(__file__).parent / "images"


def _clipmap(*arguments: str) -> None:
    if status := run(list(arguments)):
        sys.exit(status)


def island(folder: Path) -> None:
    """The built-in terrain, as ``clipmap demo`` renders it."""
    _clipmap("demo", "-o", str(folder))
    (IMAGES / "island.png").write_bytes((folder / "demo.png").read_bytes())


def puget(folder: Path, data: Path) -> None:
    """Puget Sound with Mount Rainier: 1025 x 1025 heights at 160 m and a 1024 x 1024 texture."""
    dataset = str(folder / "puget")
    height = str(data / "puget/ps_height_1k.png")
    _clipmap("build", height, "--layer", "height", "--height-scale", "0.1", "--spacing", "160", "-o", dataset)
    _clipmap("build", str(data / "puget/ps_texture_1k.png"), "--layer", "imagery", "-o", dataset)
    _clipmap("view", dataset, "--headless", "--out", str(IMAGES / "puget.png"))


def main() -> None:
    """Render what can be rendered here."""
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        island(Path(folder) / "demo")
        if "CLIPMAP_TEST_DATA" in os.environ:
            puget(Path(folder), Path(os.environ["CLIPMAP_TEST_DATA"]))


if __name__ == "__main__":
    main()
