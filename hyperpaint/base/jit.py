"""Compilation of kernels: the options of numba and the cache on disk."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import warnings
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba import types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    NullCache,
    UserProvidedCacheLocator,
    _CacheLocator,
)
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUTargetOptions
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys

from hyperpaint.base.errors import PaintWarning

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a loop on its first call.

    The lock is released, since dask's threads run kernels side by side; ``parallel=True`` would abort the
    process there. The numpy error model lets the compiler vectorise divisions. No fast-math: the same bits
    must result from any chunking.

    Compiled code is stored on disk for later processes: in ``NUMBA_CACHE_DIR``, else beside the package,
    or, where that is read-only, in the user's cache folder. Where no folder is writable (a container with a
    read-only disk, a full disk) every process compiles the kernels that the folders lack (see ``hyperpaint
    warm``).
    """
    return _compiled(function, {"nogil": True, "error_model": "numpy"})


def borrowing_kernel(function: Function) -> Function:
    """Compile, as `kernel` does, a function that makes no arrays, neither new ones nor returned views.

    The caller owns all arrays, so references are not counted. In a short function that is called for every
    ray, counting takes longer than the computation, and threads that share arrays wait for the counter.
    """
    return _compiled(function, _borrowing_options())


def inlined_kernel(function: Function) -> Function:
    """Compile a loop over one row as `borrowing_kernel` does, inlined in every caller.

    For a row of a few hundred samples, passing arrays takes half as long as the computation.
    """
    return _compiled(function, {**_borrowing_options(), "forceinline": True})


def _borrowing_options() -> dict[str, Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if hasattr(CPUTargetOptions, "_nrt"):  # private to numba; only speed depends on it
        options["_nrt"] = False
    return options


# Cache that may be full, read-only or damaged; the kernel is then compiled.
class _OptionalCache(FunctionCache):  # type: ignore[misc]
    def load_overload(self, sig: Any, target_context: Any) -> Any:
        # None lets numba compile. numba's own method first registers all supported functions, which takes
        # longer than loading the kernel; the compiler registers them when it runs.
        rtsys.initialize(target_context)
        try:
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
        except OSError:
            return None
        except Exception:  # a truncated pickle raises any class of error
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as error:  # also from a truncated index that cannot be removed
            reason = getattr(error, "strerror", None) or error
            warnings.warn(
                PaintWarning(
                    f"compiled kernels cannot be kept in {self.cache_path} ({reason}), so that every process "
                    "compiles them again; set NUMBA_CACHE_DIR to a folder with room",
                    code="kernel-cache-unwritable",
                ),
                stacklevel=2,
            )


# Locator of a cache folder that may be read-only.
class _ReadableLocator(_CacheLocator):  # type: ignore[misc]
    def ensure_cache_path(self) -> None:
        # numba's own check refuses a read-only folder
        os.listdir(self.get_cache_path())


class _EnvironmentLocator(_ReadableLocator, UserProvidedCacheLocator):  # type: ignore[misc]
    """``NUMBA_CACHE_DIR``."""


class _PackageLocator(_ReadableLocator, InTreeCacheLocator):  # type: ignore[misc]
    """The folder beside the module."""


class _ReadableImplementation(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: ClassVar = [_EnvironmentLocator, _PackageLocator]


# Kernels that `hyperpaint warm` stored in a folder that may be read-only, as in a container image.
class _ReadableCache(_OptionalCache):
    _impl_class = _ReadableImplementation


# Caches are located when Python first calls a kernel; most kernels are only called by other kernels.
class _KernelCaches(NullCache):  # type: ignore[misc]
    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @functools.cached_property
    def _caches(self) -> list[_OptionalCache]:
        # the folder that numba writes to, then the folder that may be read-only
        caches: list[_OptionalCache] = []
        for kind in (_OptionalCache, _ReadableCache):
            with contextlib.suppress(RuntimeError):  # no folder exists
                caches.append(kind(self._function))
        return caches[:1] if len({cache.cache_path for cache in caches}) == 1 else caches

    @property
    def cache_path(self) -> str | None:
        writable = [cache for cache in self._caches if not isinstance(cache, _ReadableCache)]
        return writable[0].cache_path if writable else None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        loads = (cache.load_overload(sig, target_context) for cache in self._caches)
        return next((kernel for kernel in loads if kernel is not None), None)

    def save_overload(self, sig: Any, data: Any) -> None:
        for cache in self._caches:
            if not isinstance(cache, _ReadableCache):
                cache.save_overload(sig, data)


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    # The compiler makes millions of objects that stay in use: garbage collection would only cost time.
    with global_compiler_lock:  # one thread at a time switches collection off
        was_enabled = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if was_enabled:
                gc.enable()


# A kernel with an entry point for Python; other kernels that call it include a `_InnerKernel`.
class _Kernel(CPUDispatcher):  # type: ignore[misc]
    def compile(self, sig: Any) -> Any:
        with _uncollected():
            return super().compile(sig)

    @functools.cached_property
    def _inner(self) -> _InnerKernel:
        options = {**self.targetoptions, "no_cpython_wrapper": True}
        return _InnerKernel(self.py_func, targetoptions=options, pipeline_class=_InnerCompiler)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        # without literal types: numba would compile the inner kernel for every constant argument
        kinds = {name: types.unliteral(kind) for name, kind in dict(kws).items()}
        return self._inner.get_call_template(tuple(map(types.unliteral, args)), kinds)

    def get_overload(self, sig: Any) -> Any:
        return self._inner.get_overload(sig)


class _InnerKernel(CPUDispatcher):  # type: ignore[misc]
    """A kernel inside another: without machine code, entry point for Python and place in the cache.

    By default numba assembles every function on its own and again in all its callers, with the code that
    unpacks its arguments for Python. Here only the outer kernel, which Python calls, is assembled.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._compiler._customize_flags = _without_machine_code

    def add_overload(self, cres: Any) -> None:
        # the name must be unique
        name = object()
        self.targetctx.insert_user_function(name, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=name)


def _without_machine_code(flags: Any) -> Any:
    flags.no_compile = True
    return flags


class _InnerCompiler(Compiler):  # type: ignore[misc]
    def __init__(self, typing: Any, target: Any, _library: Any, *args: Any) -> None:
        super().__init__(typing, target, _InnerLibrary(target.codegen(), "inner"), *args)


class _InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code that is assembled in the libraries that link it.

    It is optimised on its own: callers decide by the optimised size whether to inline it. Without that, the
    renderer ran a fifth slower. The methods are private to numba: without them kernels compile more slowly.
    """

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    if numba.config.DISABLE_JIT:
        return function
    compiled = _Kernel(function, targetoptions={"nopython": True, "no_cfunc_wrapper": True, **options})
    compiled._cache = _KernelCaches(function)
    return cast("Function", compiled)
