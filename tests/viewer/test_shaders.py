"""The shaders against their mirrors in numpy, value by value."""

import re
from importlib import resources

import moderngl
import numpy as np
import pytest

from schemas.errors import StorageError, UsageError
from schemas.region import Rect
from tests.viewer.scenes import EndlessHeights
from viewer.drawplan import MAX_LEVELS, plan_geometry, texture_records
from viewer.gl.context import bind_block, check_errors, set_uniforms, shader_source
from viewer.gl.stack import HEIGHT_PLANES, IMAGE_PLANES, TextureStack
from viewer.gl.terrain import terrain_defines
from viewer.morph import alpha, coarse_height, morphed, ramp
from viewer.options import ViewOptions
from viewer.placement import grid_origin
from viewer.stack import ClipStack
from viewer.texlod import EVERYWHERE, NOWHERE, choose_levels, preferred_level
from viewer.torus import Arc, TorusRect


def test_no_shader_uses_the_remainder_operator() -> None:
    """Of negative numbers it is undefined in GLSL; llvmpipe happens to return the floor modulo, so no picture would tell."""
    folder = resources.files("viewer.gl") / "shaders"
    names = [entry.name for entry in folder.iterdir() if entry.name.endswith((".glsl", ".vert", ".frag"))]
    assert len(names) >= 7
    for name in names:
        code = re.sub(r"//.*", "", (folder / name).read_text("utf-8"))
        assert not re.search(r"%|\bmod\s*\(", code), name


@pytest.mark.parametrize("viewer", [(0.0, 0.0), (-1234.625, 777.375), (2.0**30 + 0.5, -(2.0**29) - 0.25)])
@pytest.mark.parametrize("n", [15, 31])
def test_vertices_are_those_of_the_mirror(context: moderngl.Context, n: int, viewer: tuple[float, float]) -> None:
    pyramid, levels = EndlessHeights(3), 3
    textures = TextureStack(context, n + 1, levels, HEIGHT_PLANES)
    stack = ClipStack(pyramid, n + 1, textures)
    origins = [(grid_origin(viewer[0], n, level), grid_origin(viewer[1], n, level)) for level in range(levels)]
    for level, origin in enumerate(origins):
        stack.move(level, origin)
    plan = plan_geometry(viewer, origins, 0, n)
    defines = terrain_defines(ViewOptions(grid=n), 0)
    program = context.program(
        vertex_shader=shader_source("levels.glsl", "surface.glsl", "morph.glsl", "terrain.vert", defines=defines),
        varyings=("v_relative", "v_surface"),
    )
    bind_block(program, "GeometryLevels", 0)
    buffer = context.buffer(plan.levels.tobytes())
    buffer.bind_to_uniform_block(0)
    textures.textures[0].use(0)
    set_uniforms(program, {"u_surface": 0, "u_fraction": plan.fraction})
    context.simple_framebuffer((4, 4)).use()  # captures too want a complete one
    rows, columns = np.mgrid[0:n, 0:n]
    for level, (ox, oy) in enumerate(origins):
        corners = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype("i4")
        content = [
            (context.buffer(corners.tobytes()), "2i", "in_vertex"),
            (context.buffer(np.array([0, 0, level], "i4").tobytes()), "3i/i", "in_patch"),
        ]
        array = context.vertex_array(program, content)
        out = context.buffer(reserve=n * n * 16)
        array.transform(out, moderngl.POINTS, vertices=n * n, instances=1)
        got = np.frombuffer(out.read(), "f4").reshape(n, n, 4)
        fine = pyramid.heights(level, Rect(ox, oy, ox + n, oy + n))[0].astype(float)
        if level + 1 < levels:
            coarse = pyramid.heights(level + 1, Rect(ox // 2, oy // 2, ox // 2 + n, oy // 2 + n))[0].astype(float)
            here = viewer[0] / 2**level - ox, viewer[1] / 2**level - oy
            fine = morphed(fine, coarse_height(coarse, columns, rows), alpha(columns + 0.0, rows + 0.0, here, ramp(n)))
        np.testing.assert_allclose(got[..., 2], fine, atol=2e-5)
        np.testing.assert_array_equal(got[..., 3], 1.0)
        exact = np.stack([(columns + ox) * 2**level - viewer[0], (rows + oy) * 2**level - viewer[1]], axis=-1)
        np.testing.assert_allclose(got[..., :2], exact, rtol=1e-6, atol=1e-6)
    textures.release()


LOD_TEST = """
uniform sampler2D u_cases;  // texel x y, preferred level
out vec3 f_chosen;
void main() {
    vec4 one = texelFetch(u_cases, ivec2(gl_FragCoord.xy), 0);
    f_chosen = choose_levels(one.xy, one.z);
}
"""


def test_texture_levels_are_those_of_the_mirror(context: moderngl.Context) -> None:
    rng = np.random.default_rng(9)
    side, levels, cases = 256, 5, 64
    viewer = 5000.0, 7000.0
    origins = [(int(viewer[0] / 2**k) - 128 + int(rng.integers(-90, 90)), int(viewer[1] / 2**k) - 128) for k in range(levels)]
    lagging: list[tuple[int, int] | None] = [*origins]
    lagging[2] = None
    # Sixteenths are exact in float32, so both sides decide alike where a fragment lies on a boundary.
    points = np.zeros((cases, cases, 4), "f4")
    points[..., :2] = np.rint(rng.normal(size=(cases, cases, 2)) * 3000) / 16
    points[..., 2] = np.maximum(0, np.rint(rng.uniform(-1, 6, (cases, cases)) * 16) / 16)
    program = context.program(
        vertex_shader=shader_source("sky.vert", defines={}),
        fragment_shader=shader_source("texlod.glsl", defines=terrain_defines(ViewOptions(texture_window=side), levels)) + LOD_TEST,
    )
    bind_block(program, "TextureLevels", 1)
    source = context.texture((cases, cases), 4, points.tobytes(), dtype="f4")
    source.use(3)
    set_uniforms(program, {"u_cases": 3})
    target = context.framebuffer([context.texture((cases, cases), 3, dtype="f4")])
    array = context.vertex_array(program, [])
    for places in (origins, lagging):
        sizes = [(100_000 >> k, 100_000 >> k) for k in range(levels)]
        records = texture_records(viewer, places, sizes, side, "area")
        buffer = context.buffer(records.tobytes())
        buffer.bind_to_uniform_block(1)
        target.use()
        array.render(moderngl.TRIANGLES, vertices=3)
        got = np.frombuffer(target.read(components=3, dtype="f4"), "f4").reshape(cases, cases, 3)
        bounds = [tuple(float(v) for v in record["bounds"]) for record in records[:levels]]
        assert (bounds[2] == pytest.approx(NOWHERE)) == (places is lagging)
        assert bounds[-1] == pytest.approx(EVERYWHERE)
        expected = [[choose_levels((p[0], p[1]), float(p[2]), bounds) for p in row.tolist()] for row in points]  # type: ignore[arg-type]
        np.testing.assert_allclose(got, expected, atol=1e-4)
        assert len(np.unique(np.array(expected)[..., 0])) >= 4


def test_a_pixel_as_wide_as_four_texels_takes_level_2() -> None:
    assert preferred_level((4.0, 0.0), (0.0, 1.0)) == pytest.approx(2.0)
    assert preferred_level((0.1, 0.0), (0.0, 0.1)) == 0.0
    assert preferred_level((0.0, 0.0), (0.0, 0.0)) == 0.0


def test_a_stack_takes_only_what_fits(context: moderngl.Context) -> None:
    stack = TextureStack(context, 16, 2, IMAGE_PLANES)
    whole = TorusRect(Arc(0, 0, 16), Arc(0, 0, 16))
    stack.write(1, whole, (np.full((16, 16, 4), 7, np.uint8),))
    assert (stack.read(0)[1] == 7).all()
    assert stack.written_bytes == 1024
    beyond = TorusRect(Arc(0, 1, 16), Arc(0, 0, 16))
    for level, rect, samples in (
        (2, whole, np.zeros((16, 16, 4), np.uint8)),
        (0, beyond, np.zeros((16, 16, 4), np.uint8)),
        (0, whole, np.zeros((16, 16, 3), np.uint8)),
        (0, whole, np.zeros((16, 16, 4), np.float32)),
    ):
        with pytest.raises(ValueError, match="slots"):
            stack.write(level, rect, (samples,))
    stack.release()
    with pytest.raises(UsageError, match="exceed this machine's textures"):
        TextureStack(context, 2**20, 2, IMAGE_PLANES)


def test_a_stack_wraps_around_the_torus_on_the_gpu_as_in_arrays(context: moderngl.Context) -> None:
    rng = np.random.default_rng(2)
    pyramid, side = EndlessHeights(3), 32
    textures = TextureStack(context, side, 3, HEIGHT_PLANES)
    stack = ClipStack(pyramid, side, textures)
    origin = np.array([-7, 5])
    for _ in range(25):
        origin = origin + rng.integers(-40, 40, 2) // rng.choice([1, 8])
        x, y = int(origin[0]), int(origin[1])
        stack.move(1, (x, y))
        rows, columns = np.arange(y, y + side) % side, np.arange(x, x + side) % side
        expected = pyramid.planes(1, Rect(x, y, x + side, y + side))
        for plane in (0, 1):
            np.testing.assert_array_equal(textures.read(plane)[1][np.ix_(rows, columns)], expected[plane])
    textures.release()


def test_silent_errors_of_opengl_are_noticed(context: moderngl.Context) -> None:
    texture = context.texture_array((4, 4, 1), 4)
    texture.write(bytes(64), viewport=(1, 0, 0, 4, 4, 1))
    with pytest.raises(StorageError, match="GL_INVALID_VALUE"):
        check_errors(context, "writing")
    assert MAX_LEVELS * 48 <= 16384
