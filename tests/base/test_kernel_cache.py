"""Compiled kernels are cached on disk; a kernel works without the cache."""

import errno
import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

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


def imported(folder: Path, name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    # Import a module anew, as another process would, with its cache in the same folder
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, name, raising=False)
    (folder / f"{name}.py").write_text(source)
    jit.name_by_content.cache_clear()
    return importlib.import_module(name)


@pytest.fixture
def doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    # Return a function that imports the same kernel again
    monkeypatch.setattr(jit.Kernel, "_warned", False)
    return lambda: imported(tmp_path, "doubling", SOURCE, monkeypatch).doubled


def _files(folder: Path, ending: str) -> list[Path]:
    return sorted(folder.rglob(f"*.{ending}"))


def test_the_same_sources_are_compiled_once_wherever_they_lie(
    doubled: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (doubled()(3), len(_files(tmp_path, "nbc"))) == (6, 1)
    again = doubled()
    assert (again(4), list(again.stats.cache_hits.values())) == (8, [1])
    clone = tmp_path / "clone" / tmp_path.name  # later and elsewhere
    clone.mkdir(parents=True)
    for change, hits in (("", [1]), ("# a module that the kernel may import", [])):
        module = imported(clone, "doubling", SOURCE, monkeypatch)
        if change:
            (clone / "other.py").write_text(change)
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
        assert (module.doubled(5), list(module.doubled.stats.cache_hits.values())) == (10, hits)


@pytest.mark.parametrize("owner", [IndexDataCacheFile, _CacheLocator])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_kernel_works_with_a_warning_where_the_cache_is_full_or_read_only(
    number: int, owner: type, doubled: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = mock.Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr(owner, "_save_data" if owner is IndexDataCacheFile else "ensure_cache_path", refuse)
    kernel = doubled()
    with pytest.warns(PaintWarning, match="kernel-cache-unwritable"):
        assert kernel(3) == 6
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
    expect_error(numba.TypingError, None, lambda: kernel({}))


LOADED = """
import sys
from parts import times, whole
print(whole(5), "numba.np.arraymath" in sys.modules, times(7, 6), "numba.np.arraymath" in sys.modules)
"""


def test_a_part_is_compiled_once_and_kept_in_the_whole_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = imported(tmp_path, "parts", PARTS, monkeypatch)
    assert (module.whole(5), len(_files(tmp_path, "nbc"))) == (5 * (2 + 3) + 5 * 5 * 4, 1)
    # a constant argument does not make a type of its own
    assert len(module.times._inner.overloads) == 1
    # another process loads the kernel without the modules that compiling needs; it can compile after that
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    loaded = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True).stdout
    assert loaded.split() == ["125", "False", "42", "True"]
    # a part of a whole is a kernel of its own for Python
    assert (module.times(7, 6), len(_files(tmp_path, "nbc"))) == (42, 2)
