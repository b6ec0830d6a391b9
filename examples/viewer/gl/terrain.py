"""Drawing a frame: the sky, then every patch of every level in one instanced call per mesh."""

import math
from collections.abc import Mapping
from typing import Final

import moderngl
import numpy as np

from viewer.decode import NORMAL_ZERO
from viewer.drawplan import GEOMETRY_LEVEL, MAX_LEVELS, TEXTURE_LEVEL
from viewer.footprint import Shape, meshes
from viewer.frames import Frame
from viewer.gl.context import UniformValue, bind_block, set_uniforms, shader_source
from viewer.gl.stack import HEIGHT_PLANES, IMAGE_PLANES, TextureStack
from viewer.options import ViewOptions
from viewer.scene import Scene
from viewer.texlod import BLEND_PX

AMBIENT: Final = 0.4
"""Part of the light that comes from the whole sky."""

_GEOMETRY_BINDING, _TEXTURE_BINDING = 0, 1
_SURFACE_UNIT, _SLOPES_UNIT, _IMAGERY_UNIT = 0, 1, 2


def terrain_defines(
    options: ViewOptions, texture_levels: int, *, bare_ground: bool = True, normals: bool = False
) -> dict[str, str | int | float]:
    """Return the constants compiled into the terrain's shaders.

    ``texture_levels`` is 0 without imagery; ``bare_ground`` says that ground is drawn where imagery is transparent; ``normals`` that
    texels are normals.
    """
    return {
        "MAX_LEVELS": MAX_LEVELS,
        "SIDE": options.grid + 1,
        "IMAGERY": int(texture_levels > 0),
        "NORMALS": int(normals),
        "NORMAL_ZERO": float(NORMAL_ZERO),
        "BARE_GROUND": int(bare_ground or not texture_levels),
        "TEXTURE_LEVELS": max(1, texture_levels),
        "TEXTURE_SIDE": float(options.texture_window),
        "BLEND_PX": BLEND_PX,
    }


def sun_vector(sun_deg: tuple[float, float]) -> tuple[float, float, float]:
    """Return the unit vector (east, north, up) to a sun at azimuth and elevation."""
    azimuth, elevation = (math.radians(angle) for angle in sun_deg)
    return math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)


class _Mesh:
    """A mesh on the GPU with room for the instances of a frame."""

    def __init__(self, context: moderngl.Context, program: moderngl.Program, vertices: bytes, triangles: bytes, most: int) -> None:
        self._context = context
        self._program = program
        self._vertices = context.buffer(vertices)
        self._triangles = context.buffer(triangles)
        self._instances = context.buffer(reserve=12 * most, dynamic=True)
        content = [(self._vertices, "2i", "in_vertex"), (self._instances, "3i/i", "in_patch")]
        self._array = context.vertex_array(program, content, self._triangles)
        self.triangles = len(triangles) // 12

    def draw(self, instances: bytes) -> int:
        """Draw the instances, (x, y, level) int32 each, and return the number of triangles."""
        count = len(instances) // 12
        self._instances.write(instances)
        self._array.render(moderngl.TRIANGLES, instances=count)
        return count * self.triangles


class TerrainRenderer:
    """Draws frames of a scene into whatever framebuffer is in use; ``heights`` and ``imagery`` take the windows' samples."""

    def __init__(self, context: moderngl.Context, scene: Scene, options: ViewOptions) -> None:
        self._context = context
        self._options = options
        self._scene = scene
        texture_levels = 0 if scene.imagery is None else scene.imagery.pyramid.levels
        self.heights = TextureStack(context, options.grid + 1, scene.heights.levels, HEIGHT_PLANES)
        self.imagery: TextureStack | None = None
        normals = scene.imagery is not None and scene.imagery.layer.normals is not None
        defines = terrain_defines(options, texture_levels, bare_ground=scene.has_heights or normals, normals=normals)
        fragment = ["levels.glsl", "surface.glsl", "morph.glsl", "terrain.frag"]
        if texture_levels:
            self.imagery = TextureStack(context, options.texture_window, texture_levels, IMAGE_PLANES)
            fragment.insert(3, "texlod.glsl")
        self._program = context.program(
            vertex_shader=shader_source("levels.glsl", "surface.glsl", "morph.glsl", "terrain.vert", defines=defines),
            fragment_shader=shader_source(*fragment, defines=defines),
        )
        self._level_buffer = context.buffer(reserve=MAX_LEVELS * GEOMETRY_LEVEL.itemsize, dynamic=True)
        self._texture_buffer = context.buffer(reserve=MAX_LEVELS * TEXTURE_LEVEL.itemsize, dynamic=True)
        bind_block(self._program, "GeometryLevels", _GEOMETRY_BINDING)
        if texture_levels:
            bind_block(self._program, "TextureLevels", _TEXTURE_BINDING)
        most = 16 * scene.heights.levels
        self._meshes: Mapping[Shape, _Mesh] = {
            shape: _Mesh(context, self._program, mesh.vertices.tobytes(), mesh.triangles.tobytes(), most)
            for shape, mesh in meshes(options.grid).items()
        }
        self._sky = context.program(
            vertex_shader=shader_source("sky.vert", defines={}), fragment_shader=shader_source("sky.frag", defines={})
        )
        self._sky_array = context.vertex_array(self._sky, [])
        set_uniforms(self._program, self._constants())

    def _constants(self) -> dict[str, UniformValue]:
        options, scene = self._options, self._scene
        constants: dict[str, UniformValue] = {
            "u_surface": _SURFACE_UNIT,
            "u_slopes": _SLOPES_UNIT,
            "u_imagery": _IMAGERY_UNIT,
            "u_to_metres": _column_major(scene.frame.to_local.linear),
            "u_exaggeration": options.exaggeration,
            "u_sun": sun_vector(options.sun_deg or (0.0, 90.0)),
            "u_ambient": 1.0 if options.sun_deg is None else AMBIENT,
            "u_height_range": scene.z_range_m,
        }
        if scene.imagery is not None:
            constants["u_to_texels"] = _column_major(scene.imagery.to_texels.linear)
            if scene.imagery.layer.normals is not None:
                constants["u_facing"] = _column_major(scene.imagery.facing(scene.frame))
        return constants

    def draw(self, frame: Frame, *, wireframe: bool = False, tint: bool = False, sky: bool = True) -> int:
        """Draw a frame and return the number of triangles; colour and depth must have been cleared."""
        context = self._context
        if sky:
            self._draw_sky(frame)
        context.enable_only(moderngl.DEPTH_TEST)
        context.wireframe = wireframe
        self._bind(frame)
        set_uniforms(
            self._program,
            {
                "u_view_projection": _column_major(frame.view_projection),
                "u_fraction": frame.geometry.fraction,
                "u_origin": frame.origin_m,
                "u_ground_edge": frame.ground_edge,
                "u_image_edge": frame.image_edge,
                "u_level_tint": float(tint),
                "u_haze": frame.effects.extinction_per_m,
                "u_sag": frame.effects.sag_per_m,
            },
        )
        triangles = sum(self._meshes[shape].draw(instances.tobytes()) for shape, instances in frame.geometry.instances.items())
        context.wireframe = False
        return triangles

    def _bind(self, frame: Frame) -> None:
        self._level_buffer.write(frame.geometry.levels.tobytes())
        self._level_buffer.bind_to_uniform_block(_GEOMETRY_BINDING)
        surface, slopes = self.heights.textures
        surface.use(_SURFACE_UNIT)
        slopes.use(_SLOPES_UNIT)
        if self.imagery is not None and frame.textures is not None:
            self._texture_buffer.write(frame.textures.tobytes())
            self._texture_buffer.bind_to_uniform_block(_TEXTURE_BINDING)
            self.imagery.textures[0].use(_IMAGERY_UNIT)

    def _draw_sky(self, frame: Frame) -> None:
        width, height = frame.size
        up = math.tan(math.radians(frame.camera.fov_deg) / 2)
        rays = frame.camera.rotation.T @ np.diag([up * width / height, up, -1.0])
        set_uniforms(self._sky, {"u_rays": _column_major(rays)})
        self._context.disable(moderngl.DEPTH_TEST)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)


def _column_major(matrix: np.typing.NDArray[np.float64]) -> bytes:
    return matrix.T.astype("<f4").tobytes()
