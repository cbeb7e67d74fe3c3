"""The one place for compiler options."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache
from numba.core.cpu import CPUTargetOptions

from hyperpaint.base.errors import PaintWarning

__all__ = ["borrowing_kernel", "inlined_kernel", "kernel"]

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a loop on its first call.

    The lock is released, since dask's threads run kernels side by side; ``parallel=True`` would abort the
    process there. The numpy error model lets the compiler vectorise divisions. No fast-math: the same bits
    must come out whatever the chunking.

    What is compiled is kept on disk, for every later process: in ``NUMBA_CACHE_DIR``, else beside the
    package, else, where that must not be written, in the user's cache folder. Where none can be written
    (a container with a read-only disk, a full disk) every process compiles for itself.
    """
    return _compiled(function, {"nogil": True, "error_model": "numpy"})


def borrowing_kernel(function: Function) -> Function:
    """Compile, as `kernel` does, a function that makes no arrays: neither new ones nor views it returns.

    Its caller owns all arrays, so none of them is counted. Counting costs a short function that is called
    for every ray more than its work, and threads that share the arrays wait for one another's counts.
    """
    return _compiled(function, _borrowing_options())


def inlined_kernel(function: Function) -> Function:
    """Compile, as `borrowing_kernel` does, a row of a loop, into each of its callers.

    Handing arrays on to a row of a few hundred samples costs as much as half of its work.
    """
    return _compiled(function, {**_borrowing_options(), "forceinline": True})


def _borrowing_options() -> dict[str, Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if hasattr(CPUTargetOptions, "_nrt"):  # private to numba: without it all is the same, but slower
        options["_nrt"] = False
    return options


class _OptionalCache(FunctionCache):  # type: ignore[misc]
    """A cache on disk that may be full, read-only or damaged: then a kernel is compiled, and works."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a compiled kernel, or None: numba then compiles it."""
        try:
            return super().load_overload(sig, target_context)
        except OSError:
            return None
        except Exception:  # what a torn pickle raises has no common class
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel where that can be done."""
        try:
            super().save_overload(sig, data)
        except Exception as error:  # of a torn index that could not be removed, too
            reason = getattr(error, "strerror", None) or error
            warnings.warn(
                f"compiled kernels cannot be kept in {self.cache_path} ({reason}), so that "
                "every process compiles them again; set NUMBA_CACHE_DIR to a folder with room",
                PaintWarning,
                stacklevel=2,
            )


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    """Compile, and keep the result on disk where there is a folder for it."""
    compiled: Function = numba.njit(**options)(function)
    if hasattr(compiled, "_cache"):  # not where NUMBA_DISABLE_JIT leaves plain Python
        try:
            compiled._cache = _OptionalCache(function)
        except RuntimeError:  # numba has no folder for it
            return compiled
    return compiled
