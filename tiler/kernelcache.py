"""Where compiled kernels are kept between runs: one file per kernel, argument types, processor and versions, checked by its digest.

numba's own cache ends a program by an error if it finds no folder to write to or a file that is cut off, reads no folder that
it cannot write to, and two processes that fill it at once can mix up index and data. Here a name says all that the code depends on,
files are renamed into place and never changed, and whatever cannot be read or written only costs the time to compile again.
"""

import hashlib
import os
import pickle
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from secrets import token_hex
from types import FunctionType
from typing import Any, Final, cast

import llvmlite
import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.types import Dispatcher
from numba.extending import typeof_impl

from tiler.compiled import Kernel

_DIGEST_BYTES: Final = 16
_CONSTANTS: Final = (bool, int, float, str, tuple)
"""Types of globals that numba puts into the code as they are."""


def make_dispatcher(kernel: Kernel[..., Any]) -> Any:  # noqa: ANN401 - numba has no types
    """Return what numba calls a dispatcher: compiles ``kernel`` for the types it is called with, or finds that on disk."""
    dispatcher = numba.njit(nogil=True)(kernel.py_func)
    dispatcher._cache = KernelCache(kernel)
    return dispatcher


@typeof_impl.register(Kernel)
def _typeof_kernel(kernel: Kernel[..., Any], context: object) -> Any:  # noqa: ANN401 - numba's protocol
    """Let kernels call kernels: to numba each is its dispatcher."""
    return Dispatcher(kernel.dispatcher())


class KernelCache(NullCache):  # type: ignore[misc]  # numba has no types
    """The machine code of one kernel, on disk, in numba's interface for it; nothing is looked for before the kernel is called."""

    def __init__(self, kernel: Kernel[..., Any]) -> None:
        self._function = cast("FunctionType", kernel.py_func)

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """Return the code for arguments of the types ``sig``; None if there is none on disk that is of use."""
        # Memory for kernels that allocate. What else numba loads here is for compiling, which sees to it: 130 ms.
        rtsys.initialize(target_context)
        name = self._name(sig, target_context.codegen())
        for folder in self._folders:
            # A file can be unreadable in more ways than can be listed, and every one of them has the same cure.
            with suppress(Exception):
                found = CompileResult._rebuild(target_context, *pickle.loads(_checked((folder / name).read_bytes())))
                if tuple(found.signature.args) == tuple(sig):
                    return found
        return None

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        """Keep the code ``data`` where the first folder can be written to; nowhere if none can."""
        if data.library.has_dynamic_globals or data.lifted:  # addresses of this process
            return
        # A numba to come may have other insides: then kernels are compiled every time, as where nothing can be written.
        with suppress(AttributeError, TypeError, pickle.PicklingError):
            self._keep(self._name(sig, data.codegen), dumps(data._reduce()))

    def _keep(self, name: str, content: bytes) -> None:
        for folder in self._folders:
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                _write(folder / name, hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest() + content)
                self._sweep(folder, name)
                return

    @cached_property
    def _folders(self) -> list[Path]:
        return list(cache_folders(Path(self._function.__code__.co_filename)))

    @cached_property
    def _stem(self) -> str:
        """What the files of this kernel begin with: module, function, interpreter, and a digest of what the function says."""
        function = self._function
        says = hashlib.blake2b(repr(_meaning(function)).encode(), digest_size=8).hexdigest()
        return f"{function.__module__}.{function.__qualname__}.{sys.implementation.cache_tag}-{says}-"

    def _name(self, sig: Any, codegen: Any) -> str:  # noqa: ANN401
        """Return the file for argument types: the processor's name and features count, as do versions."""
        depends = (str(sig), codegen.magic_tuple(), numba.__version__, llvmlite.__version__)
        return f"{self._stem}{hashlib.blake2b(repr(depends).encode(), digest_size=12).hexdigest()}.kernel"

    def _sweep(self, folder: Path, name: str) -> None:
        """Delete what this kernel was before its source changed."""
        before = self._stem.rsplit("-", 2)[0] + "-"
        for path in folder.glob("*.kernel"):
            if path.name.startswith(before) and not path.name.startswith(self._stem) and path.name != name:
                path.unlink(missing_ok=True)


def cache_folders(source: Path) -> Iterator[Path]:
    """Yield where kernels of the module ``source`` may be kept, the best place first.

    NUMBA_CACHE_DIR, if it is set; beside the module, so that an installation which was run once by its owner serves all users; the
    user's folder for caches; a private one for temporary files, so that a user without a home compiles once and not with every run.
    """
    source = source.absolute()
    own = f"{source.parent.name}-{hashlib.blake2b(str(source.parent).encode(), digest_size=8).hexdigest()}"
    if numba.config.CACHE_DIR:
        yield Path(numba.config.CACHE_DIR) / own
    yield source.parent / "__pycache__"
    with suppress(RuntimeError):  # no home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clipmap" / "kernels" / own
    with suppress(OSError):
        private = Path(tempfile.gettempdir()) / f"clipmap-kernels-{os.geteuid()}"
        private.mkdir(mode=0o700, exist_ok=True)
        # Anybody can make a folder of this name first, and what is read from it is run.
        found = private.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022:
            yield private / own


def _meaning(function: FunctionType) -> tuple[object, ...]:
    """Return what the code of ``function`` is made from: the text of its module and of those it calls kernels of, and constants."""
    files: dict[str, str] = {}
    constants: dict[str, str] = {}
    seen = {function}
    left = [function]
    while left:
        each = left.pop()
        path = Path(each.__code__.co_filename)
        files[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        for name in each.__code__.co_names:
            value = each.__globals__.get(name)
            callee = getattr(value, "py_func", None)
            if isinstance(value, _CONSTANTS):
                constants[f"{each.__module__}.{name}"] = repr(value)
            elif isinstance(callee, FunctionType) and callee not in seen:
                seen.add(callee)
                left.append(callee)
    return sorted(files.items()), sorted(constants.items())


def _checked(content: bytes) -> bytes:
    """Return the content of a file without its digest; raises ValueError if they do not match: machine code is run unseen."""
    digest, content = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest() != digest:
        raise ValueError("damaged")
    return content


def _write(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it."""
    unfinished = path.with_name(f".{token_hex(8)}.part")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    except OSError:
        with suppress(OSError):
            unfinished.unlink()
        raise
