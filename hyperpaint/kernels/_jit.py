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
    """
    compiled: Function = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    return compiled
