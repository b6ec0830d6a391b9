"""``clipmap plan``: which effects of light a scene calls for on a dataset, and why."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from cli.exit_codes import DONE, FOUND
from cli.output import emit_json
from cli.progress import progress_bar
from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.scene import Scene, parse_scene

if TYPE_CHECKING:
    from schemas.effects import EffectPlan, EffectProof
    from tiler.effects.dataset import MeasuredMap
    from tiler.stores.dataset import Dataset

_MAX_BYTES = 1 << 20


@click.command(short_help="Say which effects of light a scene calls for on a dataset.")
@click.argument("scene", required=False)
@click.argument("dataset", required=False)
@click.option("--layer", default="height", show_default=True, help="Layer of heights that the light falls on.")
@click.option("--estimate/--no-estimate", default=None, help="May effects be left out by an estimate?  [default: what the scene says]")
@click.option("--prove", is_flag=True, help="Bake with and without every effect, and hold what it changes against its bound.")
@click.option(
    "--crop",
    type=click.IntRange(1, 4096),
    default=512,
    show_default=True,
    metavar="SIDE",
    help="Samples along a side of what --prove bakes, where the ground is steepest.",
)
@click.option("--example", is_flag=True, help="Print a scene file to start from.")
@click.option("--json", "as_json", is_flag=True, help="Print the plan, or the proof with its plan, as JSON.")
def command(
    scene: str | None,
    dataset: str | None,
    layer: str,
    estimate: bool | None,
    prove: bool,
    crop: int,
    example: bool,
    as_json: bool,
) -> int:
    """Say which effects of light the file SCENE (TOML or JSON) calls for on the heights of DATASET.

    The heights are measured in one pass. What an effect can change anywhere on the map follows from that, and what all effects together
    change by less than the scene tolerates is left out. Where a bound is too loose an estimate on a coarse level decides, and the
    plan says so. docs/EFFECTS.md proves the bounds.

    With --prove the exit status is 1 if an effect changes more than its bound, or the picture by more than is tolerated, as an
    estimate may let it.

    \b
    clipmap plan --example > scene.toml
    clipmap plan scene.toml out/alps
    clipmap plan scene.toml out/alps --prove --crop 1024
    """
    if example:
        from cli.scene_example import example_scene

        click.echo(example_scene(), nl=False)
        return DONE
    if scene is None or dataset is None:
        raise UsageError("give a scene and a dataset, e.g. clipmap plan scene.toml out/alps; --example prints a scene to start from")
    wanted = _read_scene(scene)
    if estimate is not None:
        wanted = wanted.model_copy(update={"tolerance": wanted.tolerance.model_copy(update={"estimates": estimate})})
    from tiler.effects.dataset import measure_dataset
    from tiler.stores.dataset import open_dataset

    opened = open_dataset(dataset)
    with progress_bar("rows of blocks") as on_progress:
        measured = measure_dataset(opened, layer, wanted, on_progress=on_progress)
    plan = measured.plan()
    proof = _prove(opened, layer, measured, plan, crop) if prove else None
    if as_json:
        emit_json((proof or plan).model_dump(mode="json"))
    else:
        _show(plan, proof)
    return DONE if proof is None or proof.holds else FOUND


def _read_scene(name: str) -> Scene:
    """Return the scene that a file says; raises NotFoundError, StorageError or InputError."""
    path = Path(name)
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise NotFoundError(f"{name}: no such file; clipmap plan --example prints a scene to start from") from None
    except (OSError, ValueError) as error:
        raise StorageError(f"{name!r}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(content) > _MAX_BYTES:
        raise InputError(f"{name}: is larger than {_MAX_BYTES >> 20} MiB, so it is no scene")
    try:
        return parse_scene(content.decode("utf-8"), name)
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: is not UTF-8 text, so it is no scene") from error


def _prove(dataset: "Dataset", layer: str, measured: "MeasuredMap", plan: "EffectPlan", crop: int) -> "EffectProof":
    from tiler.checking.blockreader import BlockReader
    from tiler.effects.dataset import place_of_window, read_heights
    from tiler.effects.prove import prove_plan, roughest_window

    window = roughest_window(measured.found, crop)
    heights = read_heights(BlockReader(dataset, layer), window)
    with progress_bar("effects") as on_progress:
        return prove_plan(plan, measured.scene, heights, place_of_window(measured.place, window), window, on_progress)


def _show(plan: "EffectPlan", proof: "EffectProof | None") -> None:
    from cli.effects_text import show_effects, show_proof

    show_effects(plan)
    if proof is not None:
        click.echo()
        show_proof(proof)
