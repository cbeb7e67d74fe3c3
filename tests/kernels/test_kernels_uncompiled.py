"""The tests of kernels and of light transport, small, once more as plain Python."""

import os
import subprocess
import sys

import pytest
from support import ROOT

TRANSPORT = "simulation/transport/test_transport"
FILES = (
    *(f"kernels/test_kernels_{name}.py" for name in ("radiometry", "uncertainty", "rays")),
    *(f"{TRANSPORT}_{name}.py" for name in ("hierarchy", "surfaces", "paths", "mixing")),
)


@pytest.mark.slow
def test_kernels_run_without_compilation() -> None:
    names = [str(ROOT / "tests" / name) for name in FILES]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *names]
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
