"""Follow a flight while it is written: how far behind it is, and whether it ends as the batch.

    python benchmarks/followed_flight.py COLLECT_FOLDER [--alignment never]

The folder is a finished collect (`hyperpaint simulate`), whose flight another process writes anew at its own
frame rate. Exit status 1 where processing was more than 2 s behind or the store is another than `process`'s.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import xarray as xr

from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.store import verify
from hyperpaint.workflows.following import FlightState, follow
from hyperpaint.workflows.pipeline import run

ROOT = Path(__file__).resolve().parents[1]
LONGEST_LAG_S = 2.0


def differences(one: Path, other: Path) -> list[str]:
    """Return the arrays in which two stores differ."""
    trees = [xr.open_datatree(path, engine="zarr", chunks={}) for path in (one, other)]
    names = {node.path for tree in trees for node in tree.subtree}
    different = []
    for name in sorted(names):
        first, second = (tree[name].to_dataset() for tree in trees)
        different += [f"{name}/{key}" for key in set(first.variables) ^ set(second.variables)]
        different += [
            f"{name}/{key}"
            for key in first.variables
            if key in second.variables and not first[key].equals(second[key])
        ]
    return different


def main() -> int:
    """Follow a flight."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--alignment")
    parser.add_argument("--folder", help="where to work; by default a temporary folder")
    parsed = parser.parse_args()
    warnings.simplefilter("ignore", PaintWarning)
    options = {"alignment": parsed.alignment} if parsed.alignment else {}
    states: list[FlightState] = []
    with tempfile.TemporaryDirectory(dir=parsed.folder) as folder:
        copy = Path(folder) / "copy"
        writer = subprocess.Popen(
            [sys.executable, ROOT / "tests" / "support" / "flown_writers.py", parsed.source, copy],
            cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        writer.stdout.readline()
        moments: list[float] = []

        def watch(state: FlightState) -> None:
            if not states:
                states.append(state)
            moments.append(time.perf_counter())

        follow(copy / "flight", Path(folder) / "followed.zarr", watch=watch, **options)
        sealing = time.perf_counter() - moments[-1]
        state = states[0]
        writer.wait()
        begun = time.perf_counter()
        run(copy / "collect.toml", Path(folder) / "batch.zarr", **options)
        batch = time.perf_counter() - begun
        wrong = differences(Path(folder) / "followed.zarr", Path(folder) / "batch.zarr")
        verify(Path(folder) / "followed.zarr")
        size = state.lines
    print(
        f"{size} lines: at most {state.longest_lag_s:.2f} s behind, {state.done / state.busy_s:.0f} lines a "
        f"second of work, finished {sealing:.1f} s after the last look (batch {batch:.1f} s); "
        f"{'the same bits' if not wrong else 'other: ' + ', '.join(wrong)}"
    )
    return int(bool(wrong) or state.longest_lag_s > LONGEST_LAG_S)


if __name__ == "__main__":
    raise SystemExit(main())
