"""The one place for compiler options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

__all__ = ["kernel"]

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
    options = {"nogil": True, "error_model": "numpy"}
    try:
        compiled: Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba has found no folder for it
        compiled = numba.njit(**options)(function)
    return compiled
