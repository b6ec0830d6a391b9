"""``clipmap demo``: the whole way from files to a picture on a built-in terrain, by the commands a user would type."""

import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from cli.commands.view import parse_size
from schemas.errors import StorageError

_URL_MARK = " at http://"


@click.command(short_help="Build, serve and render a built-in terrain.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("demo"), show_default=True, help="Folder to work in.")
@click.option("--side", type=click.IntRange(64, 8192), default=1024, show_default=True, help="Cells along an edge of the terrain.")
@click.option("--size", metavar="WxH", callback=parse_size, default="1280x720", show_default=True, help="Size of the picture in pixels.")
def command(output: Path, side: int, size: tuple[int, int]) -> int:
    """Make an island, build a dataset of its heights and picture, serve it, and render it over HTTP to OUTPUT/demo.png.

    Every step is the command that is printed; try them yourself afterwards. Nothing is downloaded.
    """
    from viewer.options import ViewOptions

    ViewOptions(size=size)  # a size that the last step would refuse is refused before the first
    heights, picture = _sources(output / "source", side)
    dataset, image = output / "datasets" / "island", output / "demo.png"
    spacing = f"{20480 / side:g}"
    steps = (
        ["build", str(heights), "--layer", "height", "--spacing", spacing, "--overwrite", "-o", str(dataset)],
        ["build", str(picture), "--layer", "imagery", "--overwrite", "-o", str(dataset)],
        ["inspect", str(dataset)],
    )
    for step in steps:
        if status := _run(step):
            return status
    with _served(dataset.parent) as url:
        if status := _run(["view", f"{url}/{dataset.name}", "--headless", "--size", f"{size[0]}x{size[1]}", "--out", str(image)]):
            return status
    click.echo(f"\nThe picture is {image}. Fly over it with: clipmap view {shlex.quote(str(dataset))}")
    return 0


def _sources(folder: Path, side: int) -> tuple[Path, Path]:
    """Write the terrain as two ordinary files, as if they came from somewhere else."""
    import OpenImageIO

    from tiler.terrain import make_island

    click.echo(f"Making an island of {side} x {side} cells in {folder}")
    island = make_island(side, 20480 / side)
    paths = folder / "heights.tif", folder / "picture.tif"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be made: {error.strerror}") from error
    for path, pixels, sample in ((paths[0], island.heights_m[..., None], "float"), (paths[1], island.colour, "uint8")):
        rows, columns, channels = pixels.shape
        spec = OpenImageIO.ImageSpec(columns, rows, channels, sample)
        spec.tile_width = spec.tile_height = 256
        output = OpenImageIO.ImageOutput.create(str(path))
        if output is None or not output.open(str(path), spec) or not output.write_image(pixels) or not output.close():
            raise StorageError(f"{path}: cannot be written: {OpenImageIO.geterror() if output is None else output.geterror()}")
    return paths


def _run(arguments: list[str]) -> int:
    from cli.main import run

    click.echo(f"\n$ clipmap {shlex.join(arguments)}")
    return run(arguments)


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    """Run ``clipmap serve`` on a free port for as long as the block lasts; gives its URL."""
    arguments = ["serve", str(folder), "--port", "0"]
    click.echo(f"\n$ clipmap {shlex.join(arguments)} &")
    program = [sys.executable, "-c", "import sys; from cli.main import run; sys.exit(run(sys.argv[1:]))", *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as server:
        try:
            line = server.stdout.readline() if server.stdout is not None else ""
            click.echo(line.rstrip())
            if _URL_MARK not in line:
                raise StorageError("clipmap serve did not start; run the command above to see why")
            yield line.split(" at ")[-1].strip().rstrip("/")
        finally:
            server.terminate()
