"""One OpenGL context for all viewer tests; they are skipped where none can be made."""

from collections.abc import Iterator

import moderngl
import pytest

from schemas.errors import ClipmapError


@pytest.fixture(scope="session")
def _context() -> Iterator[moderngl.Context]:
    from viewer.gl.context import headless_context

    try:
        context = headless_context()
    except ClipmapError as error:
        pytest.skip(f"no OpenGL: {error}")
    yield context
    context.release()


@pytest.fixture
def context(_context: moderngl.Context) -> Iterator[moderngl.Context]:
    """The context, without an error before the test and after it: moderngl raises few of them itself."""
    assert _context.error == "GL_NO_ERROR"
    yield _context
    assert _context.error == "GL_NO_ERROR"
