"""The one place for compiler options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core.cpu import CPUTargetOptions

__all__ = ["borrowing_kernel", "kernel"]

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a loop on its first call.

    The lock is released, since dask's threads run kernels side by side; ``parallel=True`` would abort the
    process there. The numpy error model lets the compiler vectorise divisions. No fast-math: the same bits
    must come out whatever the chunking.

    What is compiled is kept on disk, for every later process: in ``NUMBA_CACHE_DIR``, else beside the
    package, else, where that must not be written, in the user's cache folder. Where none can be written
    (a container with a read-only disk) every process compiles for itself.
    """
    return _compiled(function, {"nogil": True, "error_model": "numpy"})


def borrowing_kernel(function: Function) -> Function:
    """Compile, as `kernel` does, a function that makes no arrays: neither new ones nor views it returns.

    Its caller owns all arrays, so none of them is counted. Counting costs a short function that is called
    for every ray more than its work, and threads that share the arrays wait for one another's counts.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if hasattr(CPUTargetOptions, "_nrt"):  # private to numba: without it all is the same, but slower
        options["_nrt"] = False
    return _compiled(function, options)


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    """Compile, and keep the result on disk where there is a folder for it."""
    try:
        compiled: Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba has found no folder for it
        compiled = numba.njit(**options)(function)
    return compiled
