"""The kernel tests once more, as plain Python."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

HERE = Path(__file__).resolve().parent


@pytest.mark.slow
def test_kernels_run_without_compilation() -> None:
    subjects = ("radiometry", "uncertainty", "gathering", "line_fits", "rays")
    names = [HERE / f"test_kernels_{subject}.py" for subject in subjects]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, names)]
    found = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "HYPERPAINT_REQUIRE_REAL_DATA": ""},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-1000:]
