"""``clipmap view``: the reference client."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.output import emit_json, emit_pairs, format_bytes
from schemas.errors import MissingExtraError, UsageError

if TYPE_CHECKING:
    from viewer.camera import Camera
    from viewer.gl.headless import Picture
    from viewer.options import ViewOptions
    from viewer.scene import Scene


def _numbers(_: click.Context, option: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    """Return the numbers of an option, as many as its metavar names."""
    if value is None:
        return None
    names = str(option.metavar)
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != names.count(",") + 1 or not all(map(math.isfinite, numbers)):
        raise click.BadParameter(f"{value!r}: expected numbers {names}")
    return numbers


def parse_size(_: click.Context, __: click.Parameter, value: str) -> tuple[int, int]:
    """Return width and height in pixels of ``1280x720``; a callback of click."""
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", value.lower())
    if found is None:
        raise click.BadParameter(f"{value!r}: expected WIDTHxHEIGHT, e.g. 1280x720")
    return int(found[1]), int(found[2])


@click.command(name="view")
@click.argument("dataset", metavar="DATASET_OR_URL")
@click.option("--headless", is_flag=True, help="Draw without a window, into PNG files. --out implies it.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="PNG to write; %d or %04d is the frame's number.")
@click.option(
    "--frames",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Pictures to take on a circle around the view; numbered _0000, _0001, ... unless --out says where the number goes.",
)
@click.option(
    "--size", metavar="WxH", callback=parse_size, default="1280x720", show_default=True, help="Size of the picture or window in pixels."
)
@click.option("--view", metavar="X,Y,Z,YAW,PITCH", callback=_numbers, help="World position X, Y, metres Z, degrees from north and up.")
@click.option("--look-at", metavar="X,Y", callback=_numbers, help="World position to look at from a place chosen for it.")
@click.option("--fov", type=float, default=45.0, show_default=True, help="Vertical field of view in degrees.")
@click.option("--exaggeration", type=float, default=1.0, show_default=True, help="Factor on heights.")
@click.option(
    "--sun", metavar="AZ,EL", callback=_numbers, default="315,40", show_default=True, help="Azimuth and elevation of the sun in degrees."
)
@click.option("--no-light", is_flag=True, help="Show imagery as it is, without a sun.")
@click.option("--haze", type=float, metavar="KM", help="Distance in km at which haze hides 63 %; off by default.")
@click.option(
    "--curvature",
    type=click.Choice(["auto", "on", "off"]),
    default="auto",
    show_default=True,
    help="Let distant ground sink as on a globe; auto: where the dataset lies on the Earth and it would be seen.",
)
@click.option(
    "--grid", type=click.Choice(["63", "127", "255", "511"]), default="255", show_default=True, help="Vertices on a side of a level."
)
@click.option(
    "--texture-window",
    type=click.Choice(["256", "512", "1024", "2048", "4096"]),
    default="1024",
    show_default=True,
    help="Texels along a texture level.",
)
@click.option("--samples", type=click.IntRange(min=0), default=4, show_default=True, help="Antialiasing samples per pixel, 0 for none.")
@click.option("--wireframe", is_flag=True, help="Draw edges only.")
@click.option("--color-by-level", is_flag=True, help="Tint by level of detail.")
@click.option("--height", "height_layer", metavar="NAME", help="Height layer, if there are several.")
@click.option(
    "--imagery",
    "imagery_layer",
    metavar="NAME",
    help="Imagery layer, if there are several; or one of light, or of normals, which shade the ground.",
)
@click.option("--workers", type=click.IntRange(1, 64), default=4, show_default=True, help="Threads that load and decode blocks.")
@click.option("--json", "as_json", is_flag=True, help="Report as JSON.")
def command(dataset: str, **given: Any) -> None:  # noqa: ANN401 - click passes options by name
    """Render a dataset, from a directory or from `clipmap serve`, in a window or headless.

    In the window: WASD and Q/E to fly, drag the mouse to look, shift for speed, F1 wireframe, F2 levels, F3 freeze,
    P to print the view, Esc to quit.
    """
    view_options = _options(given)
    _require_moderngl()
    paths = _picture_paths(dataset, given)
    from cli.stored_source import open_block_source
    from viewer.scene import open_scene

    source = open_block_source(dataset, view_options.workers)
    try:
        scene = open_scene(source, view_options)
        try:
            scene.load_coarsest()
            camera = _camera(scene, view_options, given["view"], given["look_at"])
            if paths:
                _render(scene, view_options, camera, paths, given["as_json"])
            else:
                _open_window(scene, view_options, camera, dataset)
        finally:
            scene.close()
    finally:
        source.close()


def _options(given: dict[str, Any]) -> "ViewOptions":
    from viewer.options import ViewOptions

    if given["view"] is not None and given["look_at"] is not None:
        raise UsageError("--view and --look-at both place the camera; give one of them")
    return ViewOptions(
        size=given["size"],
        fov_deg=given["fov"],
        exaggeration=given["exaggeration"],
        sun_deg=None if given["no_light"] else given["sun"],
        haze_m=None if given["haze"] is None else given["haze"] * 1000.0,
        curvature=given["curvature"],
        grid=int(given["grid"]),
        texture_window=int(given["texture_window"]),
        samples=given["samples"],
        wireframe=given["wireframe"],
        color_by_level=given["color_by_level"],
        workers=given["workers"],
        height_layer=given["height_layer"],
        imagery_layer=given["imagery_layer"],
    )


def _require_moderngl() -> None:
    from importlib.util import find_spec

    if find_spec("moderngl") is None:
        raise MissingExtraError("viewing needs moderngl: pip install 'clipmap[view]'")


def _picture_paths(dataset: str, given: dict[str, Any]) -> list[Path]:
    """Return the pictures to write, none if a window is wanted."""
    from viewer.gl.headless import frame_paths

    if given["out"] is None and not given["headless"]:
        return []
    return frame_paths(given["out"] or Path(_default_name(dataset)), given["frames"])


def _default_name(dataset: str) -> str:
    """Return the file name for a dataset's picture; a % of its URL would mark the place of a number."""
    return f"{Path(dataset.rstrip('/')).name.replace('%', '_') or 'view'}.png"


def _camera(
    scene: "Scene", options: "ViewOptions", view: tuple[float, float, float, float, float] | None, look_at: tuple[float, float] | None
) -> "Camera":
    from viewer.framing import camera_at, default_camera, place_at

    if view is not None:
        return camera_at(scene, view, options.fov_deg)
    target = None if look_at is None else place_at(scene, *look_at)
    return default_camera(scene, options, target)


def _render(scene: "Scene", options: "ViewOptions", camera: "Camera", paths: list[Path], as_json: bool) -> None:
    from viewer.framing import view_text
    from viewer.gl.headless import HeadlessView, render_frames

    view = HeadlessView(scene, options)
    pictures = list(render_frames(view, scene, camera, paths, options.exaggeration))
    result = {
        "renderer": view.renderer_name,
        "pictures": [_picture(picture, view_text(scene, picture.camera)) for picture in pictures],
        "width": options.size[0],
        "height": options.size[1],
        "blocks": scene.loader.counts.blocks,
        "fetched_bytes": scene.loader.counts.fetched_bytes,
        "uploaded_bytes": view.uploaded_bytes,
    }
    if as_json:
        emit_json(result)
        return
    first = pictures[0]
    emit_pairs(
        [
            ("renderer", view.renderer_name),
            ("picture", str(first.path) if len(pictures) == 1 else f"{first.path} to {pictures[-1].path}"),
            ("size", f"{options.size[0]} x {options.size[1]}, {options.samples or 1} samples"),
            ("view", f"--view={view_text(scene, first.camera)}"),
            ("triangles", f"{first.triangles:,}"),
            ("blocks", f"{scene.loader.counts.blocks}, {format_bytes(scene.loader.counts.fetched_bytes)}"),
            ("loading", f"{1e3 * sum(picture.load_s for picture in pictures):.0f} ms"),
            ("drawing", f"{1e3 * sum(picture.draw_s for picture in pictures) / len(pictures):.0f} ms a frame"),
            *((effect.name, effect.text) for effect in first.effects.all),
        ]
    )


def _picture(picture: "Picture", view: str) -> dict[str, Any]:
    return {
        "path": str(picture.path),
        "view": view,
        "triangles": picture.triangles,
        "load_s": round(picture.load_s, 6),
        "draw_s": round(picture.draw_s, 6),
        "effects": [
            {"name": one.name, "runs": one.runs, "bound": one.bound if math.isfinite(one.bound) else None, "unit": one.unit, "why": one.why}
            for one in picture.effects.all
        ],
    }


def _open_window(scene: "Scene", options: "ViewOptions", camera: "Camera", title: str) -> None:
    from viewer.framing import view_text
    from viewer.gl.app import run_window

    last = run_window(scene, options, camera, title, click.echo)
    click.echo(f"--view={view_text(scene, last)}")
