"""``clipmap inspect``: what is in a dataset, a layer, a level, a block, or at a place."""

from math import isfinite
from pathlib import Path

import click

from cli.exit_codes import DONE, FOUND
from cli.facts_text import coverage_cells, show_block, show_dataset, show_layer, show_level, show_point
from cli.output import emit_json
from schemas.address import BlockAddress
from schemas.errors import NotFoundError, StorageError, UsageError
from schemas.facts import PointFacts
from tiler.stores.dataset import Dataset, open_dataset

Pair = tuple[float, float]


def _pair(context: click.Context, parameter: click.Parameter, value: str | None) -> Pair | None:
    if value is None:
        return None
    try:
        first, second = map(float, value.split(","))
    except ValueError:
        first = second = float("nan")
    if not isfinite(first) or not isfinite(second):
        raise click.BadParameter(f"{value!r}: two numbers with a comma between them, e.g. 86.925,27.988")
    return first, second


def _whole_pair(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    pair = _pair(context, parameter, value)
    if pair is None:
        return None
    if not all(number.is_integer() for number in pair):
        raise click.BadParameter(f"{value!r}: two whole numbers with a comma between them, e.g. 512,300")
    return int(pair[0]), int(pair[1])


@click.command(short_help="Show a dataset, a level, a block or the values at a place.")
@click.argument("dataset")
@click.argument("target", required=False)
@click.option("--at", metavar="LON,LAT", callback=_pair, help="Values at a place in WGS 84, in degrees.")
@click.option("--at-world", metavar="X,Y", callback=_pair, help="Values at a place in the dataset's own coordinates.")
@click.option("--at-pixel", metavar="X,Y", callback=_whole_pair, help="Values at a sample of level 0, counted from the top left.")
@click.option("--png", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the block's picture to FILE.")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def command(
    dataset: str,
    target: str | None,
    at: Pair | None,
    at_world: Pair | None,
    at_pixel: tuple[int, int] | None,
    png: Path | None,
    as_json: bool,
) -> int:
    """Show what is in DATASET, a folder or the URL of an object store, or in one part of it, or at one place.

    TARGET is a layer, a level, or a block by address or by name. A level is drawn as a map of its blocks. A block is decoded, and
    its bytes are compared with their digest; the exit status is 1 if it is damaged. --png writes its core: imagery as it is, 16 bits
    stretched to 8; heights as grey from the lowest to the highest, shaded; voids transparent.

    --at, --at-world and --at-pixel show the nearest stored sample on each level, of all layers or of the layer TARGET; nothing is
    interpolated.

    \b
    clipmap inspect out/puget
    clipmap inspect out/puget height/1
    clipmap inspect out/puget height/1/0/2 --png block.png
    clipmap inspect out/puget height-1-12.lerc
    clipmap inspect out/everest --at 86.925,27.9881
    """
    opened = open_dataset(dataset)
    places = {"--at": at, "--at-world": at_world, "--at-pixel": at_pixel}
    given = [name for name, place in places.items() if place is not None]
    if len(given) > 1 or (given and png is not None):
        raise UsageError(f"{' and '.join([*given, *(['--png'] if png else [])])}: give only one of them")
    if given:
        return _inspect_place(opened, target, at, at_world, at_pixel, as_json)
    return _inspect_part(opened, target, png, as_json)


def _inspect_place(
    dataset: Dataset, target: str | None, at: Pair | None, at_world: Pair | None, at_pixel: tuple[int, int] | None, as_json: bool
) -> int:
    from tiler.inspecting.probe import probe_geographic, probe_pixel, probe_world

    names = list(dataset.manifest.layers)
    if target is not None:
        dataset.manifest.layer(target)
        names = [target]
    facts: PointFacts
    if at is not None:
        facts = probe_geographic(dataset, *at, names)
    elif at_world is not None:
        facts = probe_world(dataset, *at_world, names)
    else:
        facts = probe_pixel(dataset, *(at_pixel or (0, 0)), names)
    if as_json:
        emit_json(facts.model_dump(mode="json"))
    else:
        show_point(facts)
    return DONE


def _inspect_part(dataset: Dataset, target: str | None, png: Path | None, as_json: bool) -> int:
    from tiler.inspecting.facts import describe_dataset, describe_layer, describe_level, parse_target

    name, level, address = ("", None, None) if target is None else parse_target(dataset, target)
    if address is not None:
        return _inspect_block(dataset, name, address, png, as_json)
    if png is not None:
        raise UsageError(
            f"--png draws one block: name it, e.g. clipmap inspect {dataset.store.location} {next(iter(dataset.manifest.layers))}/0/0/0"
        )
    if target is None:
        whole = describe_dataset(dataset)
        emit_json(whole.model_dump(mode="json")) if as_json else show_dataset(whole)
    elif level is None:
        layer = describe_layer(dataset, name)
        emit_json(layer.model_dump(mode="json")) if as_json else show_layer(layer)
    elif as_json:
        emit_json(describe_level(dataset, name, level).model_dump(mode="json"))
    else:
        show_level(describe_level(dataset, name, level, coverage_cells()))
    return DONE


def _inspect_block(dataset: Dataset, name: str, address: BlockAddress, png: Path | None, as_json: bool) -> int:
    from tiler.inspecting.facts import describe_block
    from tiler.inspecting.preview import preview_png

    facts, decoded = describe_block(dataset, name, address)
    if png is not None:
        if decoded is None:
            raise NotFoundError(f"{facts.name}: is {'blank' if facts.blank else 'damaged'}, so there is no picture to write")
        try:
            png.write_bytes(preview_png(dataset.manifest.layer(name), address.level, decoded))
        except OSError as error:
            raise StorageError(f"{png}: cannot be written: {error.strerror}") from error
    if as_json:
        emit_json(facts.model_dump(mode="json"))
    else:
        show_block(facts)
    return DONE if facts.intact else FOUND
