"""Compiled kernels are kept on disk where that can be done; a kernel works wherever it cannot."""

from __future__ import annotations

import errno
import gc
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
from numba.core.caching import (
    IndexDataCacheFile,
    InTreeCacheLocator,
    UserWideCacheLocator,
    _CacheLocator,
)

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
    """Return what imports the same kernel anew, as another process would."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
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


def _refuse(*_: Any) -> None:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def _files(folder: Path, ending: str) -> list[Path]:
    return sorted(folder.rglob(f"*.{ending}"))


def test_the_second_process_compiles_nothing(doubled: Callable[[], Any], tmp_path: Path) -> None:
    assert doubled()(3) == 6
    assert len(_files(tmp_path, "nbc")) == 1
    again = doubled()
    assert again(4) == 8
    assert list(again.stats.cache_hits.values()) == [1]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_full_or_read_only_cache_is_said_and_the_kernel_works(
    number: int, doubled: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", refuse)
    with pytest.warns(PaintWarning, match=rf"{os.strerror(number)}.*kernel-cache-unwritable"):
        assert doubled()(3) == 6


def test_no_folder_for_a_cache_is_no_error(
    doubled: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_CacheLocator, "ensure_cache_path", _refuse)
    assert doubled()(3) == 6
    assert not _files(tmp_path, "nb[ci]")


def test_a_read_only_folder_is_read(
    doubled: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    user = tmp_path / "user"
    monkeypatch.setattr(UserWideCacheLocator, "get_cache_path", lambda _: str(user))
    assert doubled()(3) == 6
    # what is to be written goes to the user's folder; with none, it is compiled
    for locators in ((InTreeCacheLocator,), (InTreeCacheLocator, UserWideCacheLocator)):
        for locator in locators:
            monkeypatch.setattr(locator, "ensure_cache_path", _refuse)
        again = doubled()
        assert again(4) == 8
        assert list(again.stats.cache_hits.values()) == [1]
        assert again(0.5) == 1.0
        assert len(_files(tmp_path, "nbc")) == 2
    assert len(_files(user, "nbc")) == 1


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"torn", None])
def test_a_damaged_cache_is_made_anew(
    ending: str, content: bytes | None, doubled: Callable[[], Any], tmp_path: Path
) -> None:
    assert doubled()(3) == 6
    (file,) = _files(tmp_path, ending)
    file.write_bytes(file.read_bytes()[:-9] if content is None else content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert doubled()(4) == 8
    again = doubled()
    assert again(5) == 10
    assert list(again.stats.cache_hits.values()) == [1]


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
    assert module.whole(5) == 5 * (2 + 3) + 5 * 5 * 4
    assert len(_files(tmp_path, "nbc")) == 1
    # a constant argument does not make a type of its own
    assert len(module.times._inner.overloads) == 1
    # what is part of a whole is a kernel of its own for Python
    assert module.times(7, 6) == 42
    assert len(_files(tmp_path, "nbc")) == 2


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


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_again_after_a_kernel_is_compiled_or_cannot_be(
    doubled: Callable[[], Any], enabled: bool
) -> None:
    before = gc.isenabled()
    try:
        gc.enable() if enabled else gc.disable()
        kernel = doubled()
        assert kernel(2) == 4
        assert gc.isenabled() is enabled
        with pytest.raises(numba.TypingError):
            kernel({})
        assert gc.isenabled() is enabled
    finally:
        gc.enable() if before else gc.disable()
