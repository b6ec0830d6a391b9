"""Compiled loops: a function that numba makes machine code of when it is first called, outside the GIL, and keeps on disk.

numba takes 0.25 s to get ready and is not imported before that call: so a build has found, opened and understood its source
by then, and what only reads or checks need not wait for it at all.
"""

import threading
from collections.abc import Callable
from functools import update_wrapper
from importlib import import_module
from typing import Any, Final, Generic, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_CHOOSING: Final = threading.Lock()


class Kernel(Generic[P, R]):
    """A function in the part of Python that numba compiles; called like any other, and by other kernels."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.py_func = function
        self._dispatcher: Callable[P, R] | None = None
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the machine code; the first call with arguments of their types loads it, or compiles it, which takes seconds."""
        return (self._dispatcher or self.dispatcher())(*args, **kwargs)

    def dispatcher(self) -> Any:  # noqa: ANN401 - numba has no types
        """Return what numba made of the function."""
        if self._dispatcher is None:
            # Brings numba. Of several threads that are the first to call, all make one, and all use the same.
            made = import_module("tiler.kernelcache").make_dispatcher(self)
            with _CHOOSING:
                self._dispatcher = self._dispatcher or made
        return self._dispatcher


def compiled(function: Callable[P, R]) -> Kernel[P, R]:
    """Make a function a kernel: a decorator in place of numba's own, whose cache fails where it cannot write.

    It takes no options: fast mathematics would lose NaN, and threads of numba's own the order of sums.
    """
    return Kernel(function)
