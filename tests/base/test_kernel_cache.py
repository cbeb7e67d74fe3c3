"""Compiled kernels are cached on disk; a kernel works without the cache."""

import errno
import importlib.util
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core.caching import IndexDataCacheFile, _CacheLocator
from support.refusals import expect_error

from hyperpaint.base import jit
from hyperpaint.base.errors import PaintWarning

SOURCE = """
from hyperpaint.base.jit import kernel

@kernel
def doubled(value):
    return 2 * value
"""

PARTS = """
from hyperpaint.base.jit import kernel

@kernel
def times(value, factor):
    return value * factor

@kernel
def whole(value):
    return times(value, 2) + times(value, 3) + times(value, times(value, 4))
"""

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


@pytest.fixture
def doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Any]]:
    # Return a function that imports the same kernel again, as another process would
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(jit._Kernel, "_warned", False)
    source = tmp_path / "doubling.py"
    source.write_text(SOURCE)

    def imported() -> Any:
        spec = importlib.util.spec_from_file_location("doubling", source)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.doubled

    yield imported
    sys.modules.pop("doubling", None)


def _files(folder: Path, ending: str) -> list[Path]:
    return sorted(folder.rglob(f"*.{ending}"))


def test_the_second_process_compiles_nothing(doubled: Callable[[], Any], tmp_path: Path) -> None:
    assert (doubled()(3), len(_files(tmp_path, "nbc"))) == (6, 1)
    again = doubled()
    assert (again(4), list(again.stats.cache_hits.values())) == (8, [1])


@pytest.mark.parametrize("owner", [IndexDataCacheFile, _CacheLocator])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_kernel_works_with_a_warning_where_the_cache_is_full_or_read_only(
    number: int, owner: type, doubled: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(owner, "_save_data" if owner is IndexDataCacheFile else "ensure_cache_path", refuse)
    kernel = doubled()
    with pytest.warns(PaintWarning, match="kernel-cache-unwritable"):
        assert kernel(3) == 6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kernel(0.5) == 1.0
    assert not _files(tmp_path, "nbc")


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"torn", None])
def test_a_damaged_cache_is_replaced(
    ending: str, content: bytes | None, doubled: Callable[[], Any], tmp_path: Path
) -> None:
    assert doubled()(3) == 6
    (file,) = _files(tmp_path, ending)
    file.write_bytes(file.read_bytes()[:-9] if content is None else content)
    with pytest.warns(PaintWarning, match="kernel-cache-unwritable"):
        assert doubled()(4) == 8
    assert doubled()(5) == 10
    again = doubled()
    assert (again(6), list(again.stats.cache_hits.values())) == (12, [1])


def test_wrong_arguments_are_an_error_without_a_warning(doubled: Callable[[], Any]) -> None:
    kernel = doubled()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expect_error(numba.TypingError, None, lambda: kernel({}))


def test_a_part_is_compiled_once_and_kept_in_the_whole_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    source = tmp_path / "parts.py"
    source.write_text(PARTS)
    spec = importlib.util.spec_from_file_location("parts", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (module.whole(5), len(_files(tmp_path, "nbc"))) == (5 * (2 + 3) + 5 * 5 * 4, 1)
    # a constant argument does not make a type of its own
    assert len(module.times._inner.overloads) == 1
    # what is part of a whole is a kernel of its own for Python
    assert (module.times(7, 6), len(_files(tmp_path, "nbc"))) == (42, 2)


LOADED = """
import sys
from parts import times, whole
print(whole(5), "numba.np.arraymath" in sys.modules, times(7, 6), "numba.np.arraymath" in sys.modules)
"""


def test_a_kernel_is_loaded_without_what_compiling_needs(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS)
    folders = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {
        **os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(folders),
    }  # fmt: skip

    def printed(code: str) -> str:
        run = [sys.executable, "-c", code]
        return subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout

    assert printed("from parts import whole; print(whole(5))").split() == ["125"]
    # what is compiled after it, in the same process, works
    assert printed(LOADED).split() == ["125", "False", "42", "True"]
