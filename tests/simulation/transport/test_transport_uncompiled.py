"""The tests of light transport once more, small, as plain Python."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

HERE = Path(__file__).resolve().parent


@pytest.mark.slow
def test_transport_runs_without_compilation() -> None:
    subjects = ("hierarchy", "surfaces", "paths", "mixing")
    names = [HERE / f"test_transport_{subject}.py" for subject in subjects]
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, names)],
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "HYPERPAINT_REQUIRE_REAL_DATA": ""},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-1000:]
