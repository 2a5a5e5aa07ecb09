"""Functions that numba compiles at their first call.

Importing them does not import numba, so commands that compute nothing start fast. Compiled code is cached on
disk and used by later processes.

Compiling all functions takes some seconds on a new machine. Assign element by element: assigning an array or
a tuple to a slice or a row takes most of a second to compile, for the error that their shapes differ.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Generic, Literal, ParamSpec, TypeVar

from flexroad.catalog.lazy import lazy

numba = lazy("numba")

P = ParamSpec("P")
R = TypeVar("R")


class Compiled(Generic[P, R]):
    """A function in numba's subset of Python, compiled at its first call."""

    def __init__(self, function: Callable[P, R], error_model: str, fused: bool) -> None:
        self.function = function
        self.error_model = error_model
        self.fastmath = {"contract", "reassoc", "nsz"} if fused else False

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the compiled function."""
        result: R = self.dispatcher(*args, **kwargs)
        return result

    @cached_property
    def dispatcher(self) -> Any:
        """The function as numba's dispatcher, for calls from Python."""
        return self._dispatcher(cache=True)

    @cached_property
    def inner(self) -> Any:
        """The function as numba's dispatcher, for calls from compiled functions.

        The code of the caller contains this function, so it needs neither a cache nor a wrapper for Python.
        """
        return self._dispatcher(no_cpython_wrapper=True)

    @property
    def _numba_type_(self) -> Any:
        """The type that numba reads when it compiles a function that calls this function."""
        return self.inner._numba_type_

    def _dispatcher(self, **options: bool) -> Any:
        return numba.njit(
            no_cfunc_wrapper=True, error_model=self.error_model, fastmath=self.fastmath, **options
        )(self.function)


def compiled(
    error_model: Literal["python", "numpy"] = "python", fused: bool = False
) -> Callable[[Callable[P, R]], Compiled[P, R]]:
    """Return a decorator that compiles a function with numba when it is first called.

    - `error_model`: ``python``: dividing by zero raises an error; ``numpy``: it gives inf or NaN, and loops
      are faster.
    - `fused`: whether products and sums may be fused and sums reordered, so that loops use vector
      instructions. The order is fixed when the function is compiled: equal arguments give equal bits in every
      call.
    """
    return lambda function: Compiled(function, error_model, fused)
