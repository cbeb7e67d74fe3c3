"""Kernels are compiled before they are needed, and what cannot be kept is said."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numba
import pytest

from hyperpaint.base.errors import PaintWarning, StoreError
from hyperpaint.kernels.radiometry import calibrate_slab
from hyperpaint.workflows import kernel_warming
from hyperpaint.workflows.kernel_warming import warm_kernels

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")

FIRST_VALUE = """
from hyperpaint.simulation.collect import simulate_line
line = simulate_line(lines=3, bands=13, columns=7, smile_nm=0.5)
line.paint.reflectance(uncertainty=True).compute()
line.paint.reflectance().paint.smooth().compute()
"""


def test_jobs_are_reported_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []
    places: list[Path] = []
    monkeypatch.setattr(kernel_warming, "_JOBS", (places.append, places.append))
    warmth = warm_kernels(lambda done, total: seen.append((done, total)))
    assert seen == [(0, 2), (1, 2), (2, 2)]
    assert warmth.kernels == 0
    assert warmth.processor
    assert places[0] == places[1]
    assert not places[0].exists()


def test_kernels_that_cannot_be_kept_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Path) -> None:
        warnings.warn("the sun is low", PaintWarning, stacklevel=1)  # of the scene: not said
        warnings.warn("compiled kernels cannot be kept in /full", PaintWarning, stacklevel=1)

    monkeypatch.setattr(kernel_warming, "_JOBS", (full,))
    with pytest.raises(StoreError, match="cache-folder-refused"):
        warm_kernels()
    monkeypatch.delattr(calibrate_slab, "_cache")
    with pytest.raises(StoreError, match="cache-folder-missing"):
        warm_kernels()


@pytest.mark.slow
def test_what_follows_compiles_nothing(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def printed(*arguments: str) -> str:
        run = [sys.executable, *arguments]
        return subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout

    assert printed("-m", "hyperpaint", "warm").startswith("compiled ")
    kernels = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert len(kernels) > 30
    printed("-c", FIRST_VALUE)
    assert printed("-m", "hyperpaint", "warm").startswith("all kernels were there already")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")} == kernels
