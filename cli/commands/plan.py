"""``clipmap plan``: which effects of light a scene calls for on a dataset, and why."""

from typing import TYPE_CHECKING, Final

import click

from cli.exit_codes import DONE, FOUND
from cli.output import emit_json
from cli.progress import progress_bar
from cli.scene_file import read_scene
from schemas.errors import UsageError

if TYPE_CHECKING:
    from schemas.effects import EffectPlan, EffectProof
    from tiler.effects.dataset import MeasuredMap
    from tiler.stores.dataset import Dataset

_CROP: Final = 512


@click.command(short_help="Say which effects of light a scene calls for on a dataset.")
@click.argument("scene", required=False)
@click.argument("dataset", required=False)
@click.option("--layer", default="height", show_default=True, help="Layer of heights that the light falls on.")
@click.option("--estimate/--no-estimate", default=None, help="May effects be left out by an estimate?  [default: what the scene says]")
@click.option("--prove", is_flag=True, help="Bake with and without every effect, and hold what it changes against its bound.")
@click.option(
    "--crop",
    type=click.IntRange(1, 4096),
    metavar="SIDE",
    help=f"Samples along a side of what --prove bakes, where the ground is steepest.  [default: {_CROP}]",
)
@click.option("--example", is_flag=True, help="Print a scene file to start from.")
@click.option("--json", "as_json", is_flag=True, help="Print the plan, or the proof with its plan, as JSON.")
def command(
    scene: str | None,
    dataset: str | None,
    layer: str,
    estimate: bool | None,
    prove: bool,
    crop: int | None,
    example: bool,
    as_json: bool,
) -> int:
    """Say which effects of light the file SCENE (TOML or JSON) calls for on the heights of DATASET.

    The heights are measured in one pass. What an effect can change anywhere on the map follows from that, and what all effects together
    change by less than the scene tolerates is left out. With --estimate, hidden sky and reflected light may be left out by an estimate on
    a coarse level where a bound is too loose, and the plan says so. docs/EFFECTS.md proves the bounds.

    With --prove the exit status is 1 if an effect changes more than its bound, or the picture by more than is tolerated, as an
    estimate may let it.

    \b
    clipmap plan --example > scene.toml
    clipmap plan scene.toml out/alps
    clipmap plan scene.toml out/alps --prove --crop 1024
    """
    if crop is not None and not prove:
        raise UsageError("--crop says how much --prove bakes; give --prove as well, or leave --crop out")
    if example:
        from cli.scene_example import example_scene

        click.echo(example_scene(), nl=False)
        return DONE
    if scene is None or dataset is None:
        raise UsageError("give a scene and a dataset, e.g. clipmap plan scene.toml out/alps; --example prints a scene to start from")
    wanted = read_scene(scene)
    if estimate is not None:
        wanted = wanted.model_copy(update={"tolerance": wanted.tolerance.model_copy(update={"estimates": estimate})})
    from tiler.effects.dataset import measure_dataset
    from tiler.stores.dataset import open_dataset

    opened = open_dataset(dataset)
    with progress_bar("rows of blocks") as on_progress:
        measured = measure_dataset(opened, layer, wanted, on_progress=on_progress, imagery=True)
    plan = measured.plan()
    proof = _prove(opened, layer, measured, plan, crop or _CROP) if prove else None
    if as_json:
        emit_json((proof or plan).model_dump(mode="json"))
    else:
        _show(plan, proof)
    return DONE if proof is None or proof.holds else FOUND


def _prove(dataset: "Dataset", layer: str, measured: "MeasuredMap", plan: "EffectPlan", crop: int) -> "EffectProof":
    from tiler.checking.blockreader import BlockReader
    from tiler.effects.dataset import place_of_window, read_heights
    from tiler.effects.prove import prove_plan, roughest_window
    from tiler.effects.proveview import prove_view

    window = roughest_window(measured.found, crop)
    heights = read_heights(BlockReader(dataset, layer), window)
    with progress_bar("effects") as on_progress:
        proof = prove_plan(plan, measured.scene, heights, place_of_window(measured.place, window), window, on_progress)
        return proof.with_view(prove_view(dataset, layer, measured, plan, window))


def _show(plan: "EffectPlan", proof: "EffectProof | None") -> None:
    from cli.effects_text import show_effects, show_proof

    show_effects(plan)
    if proof is not None:
        click.echo()
        show_proof(proof)
