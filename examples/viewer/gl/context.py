"""Making OpenGL contexts and programs, with errors that say what is missing."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module, resources
from types import ModuleType
from typing import Final

import moderngl

from schemas.errors import MissingExtraError, StorageError, UsageError

GL_VERSION: Final = 330
_EGL_NAMES: Final[tuple[dict[str, str], ...]] = ({}, {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"})
"""As the system's linker names them, then as Debian's runtime packages do: they lack the unversioned links."""

UniformValue = float | int | tuple[float, ...] | bytes


def headless_context() -> moderngl.Context:
    """Return a context without a window, by way of EGL; raises UsageError if this machine cannot make one."""
    reason: Exception | None = None
    create: Callable[..., moderngl.Context] = moderngl.create_context
    for names in _EGL_NAMES:
        try:
            return create(require=GL_VERSION, standalone=True, backend="egl", **names)
        except Exception as error:
            reason = error
    raise UsageError(
        f"no OpenGL 3.3 without a window on this machine ({reason}); on Debian and Ubuntu install libegl1 and libgl1-mesa-dri"
    ) from reason


def import_window_library() -> ModuleType:
    """Return moderngl_window; raises MissingExtraError."""
    try:
        return import_module("moderngl_window")
    except ImportError as error:
        raise MissingExtraError("a window needs moderngl-window: pip install 'clipmap[view]'; --headless does without") from error


def renderer_name(context: moderngl.Context) -> str:
    """Return what OpenGL calls the machine that draws."""
    return str(context.info["GL_RENDERER"])


def check_errors(context: moderngl.Context, doing: str) -> None:
    """Raise StorageError if OpenGL has noted an error: moderngl itself lets most of them pass in silence."""
    error = context.error
    if error != "GL_NO_ERROR":
        raise StorageError(f"OpenGL reports {error} while {doing}; try a smaller --grid, --texture-window, --samples or --size")


def shader_source(*names: str, defines: Mapping[str, str | int | float]) -> str:
    """Return the shaders of the package called ``names``, one after the other, below a version and ``defines``."""
    folder = resources.files("viewer.gl") / "shaders"
    head = "".join(f"#define {name} {value}\n" for name, value in defines.items())
    return f"#version {GL_VERSION}\n{head}" + "\n".join((folder / name).read_text("utf-8") for name in names)


def set_uniforms(program: moderngl.Program, values: Mapping[str, UniformValue]) -> None:
    """Set uniforms; bytes are written as they are. Names the compiler has dropped as unused are skipped."""
    for name, value in values.items():
        with suppress(KeyError):
            member = program[name]
            if not isinstance(member, moderngl.Uniform):
                raise TypeError(name)
            if isinstance(value, bytes):
                member.write(value)
            else:
                member.value = value


def bind_block(program: moderngl.Program, name: str, binding: int) -> None:
    """Connect a uniform block of ``program`` with a binding point."""
    block = program[name]
    if not isinstance(block, moderngl.UniformBlock):
        raise TypeError(name)
    block.binding = binding
