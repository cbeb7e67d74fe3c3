"""Compilation of kernels: the options of numba and the cache on disk."""

import contextlib
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba import types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    NullCache,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUTargetOptions
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys

from hyperpaint.base.errors import warn_user

Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS = {"nogil": True, "error_model": "numpy"}
# `_nrt` is private to numba; only speed depends on it
_BORROWING = {**_OPTIONS, **({"_nrt": False} if hasattr(CPUTargetOptions, "_nrt") else {})}


def kernel(function: Function) -> Function:
    # Compile a loop on its first call.
    #
    # The lock is released, since dask's threads run kernels side by side; ``parallel=True`` would abort the
    # process there. The numpy error model lets the compiler vectorise divisions. No fast-math: the same bits
    # must result from any chunking.
    #
    # Compiled code is stored on disk for later processes: in ``NUMBA_CACHE_DIR``, else in the user's cache
    # folder, else, where that is read-only, beside the package. Where none can be written (a container with a
    # read-only disk, a full disk) every process compiles its kernels, with a warning.
    return _compiled(function, _OPTIONS)


def borrowing_kernel(function: Function) -> Function:
    # Compile, as `kernel` does, a function that makes no arrays, neither new ones nor returned views.
    #
    # The caller owns all arrays, so references are not counted. In a short function that is called for every
    # ray, counting takes longer than the computation, and threads that share arrays wait for the counter.
    return _compiled(function, _BORROWING)


def inlined_kernel(function: Function) -> Function:
    # Compile a loop over one row as `borrowing_kernel` does, inlined in every caller.
    #
    # For a row of a few hundred samples, passing arrays takes half as long as the computation.
    return _compiled(function, {**_BORROWING, "forceinline": True})


@functools.cache
def name_by_content(py_file: str) -> str:
    # Return the name of the cache folder of a module: every clone, environment and container finds it.
    #
    # numba names it by the path of the package, and does not see that a kernel in another module has changed.
    digest = hashlib.sha256(numba.__version__.encode())
    folder = Path(py_file).resolve().parent
    for path in (Path(__file__), *sorted(folder.glob("*.py"))):
        digest.update(path.read_bytes())
    return f"{folder.name}_{digest.hexdigest()[:24]}"


class _ProvidedFolder(UserProvidedCacheLocator):  # type: ignore[misc]
    get_suitable_cache_subpath = staticmethod(name_by_content)


class _UserFolder(UserWideCacheLocator):  # type: ignore[misc]
    get_suitable_cache_subpath = staticmethod(name_by_content)


class _CacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_ProvidedFolder, _UserFolder, InTreeCacheLocator)


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        # numba would first register everything that it can compile, which takes longer than the load.
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)


# A kernel with an entry point for Python; other kernels that call it include a `_InnerKernel`.
class Kernel(CPUDispatcher):  # type: ignore[misc]
    _warned: ClassVar = False

    @global_compiler_lock  # type: ignore[untyped-decorator]
    def compile(self, sig: Any) -> Any:
        try:
            self._cache = _Cache(self.py_func)  # not on import: most kernels are never called from Python
            return super().compile(sig)
        except NumbaError:
            raise
        except Exception as error:  # the cache is full, read-only or damaged; a torn pickle raises anything
            with contextlib.suppress(OSError):
                self._cache.flush()
            self._cache = NullCache()
            entry_point = super().compile(sig)
            if not Kernel._warned:
                Kernel._warned = True
                warn_user(
                    f"the cache of compiled kernels cannot be used ({error}): every process compiles "
                    "them again; set NUMBA_CACHE_DIR to a writable folder with free space",
                    "kernel-cache-unwritable",
                )
            return entry_point

    @functools.cached_property
    def _inner(self) -> "_InnerKernel":
        return _InnerKernel(
            self.py_func,
            targetoptions={**self.targetoptions, "no_cpython_wrapper": True},
            pipeline_class=_InnerCompiler,
        )

    def get_call_template(self, args: Any, kws: Any) -> Any:
        # without literal types: numba would compile the inner kernel for every constant argument
        return self._inner.get_call_template(
            tuple(map(types.unliteral, args)),
            {name: types.unliteral(kind) for name, kind in dict(kws).items()},
        )

    def get_overload(self, sig: Any) -> Any:
        return self._inner.get_overload(sig)


class _InnerKernel(CPUDispatcher):  # type: ignore[misc]
    # A kernel inside another: without machine code, entry point for Python and place in the cache.
    #
    # By default numba assembles every function on its own and again in all its callers, with the code that
    # unpacks its arguments for Python. Here only the outer kernel, which Python calls, is assembled.
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
    # Code that is assembled in the libraries that link it.
    #
    # It is optimised on its own: callers decide by the optimised size whether to inline it. Without that, the
    # renderer ran a fifth slower. The methods are private to numba: without them kernels compile more slowly.
    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


def _compiled(function: Function, options: dict[str, Any]) -> Function:
    return (
        function
        if numba.config.DISABLE_JIT
        else cast(
            "Function",
            Kernel(function, targetoptions={"nopython": True, "no_cfunc_wrapper": True, **options}),
        )
    )
