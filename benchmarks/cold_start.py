"""What a fresh process costs, with nothing compiled before and with all of it on disk.

    python benchmarks/cold_start.py [--rounds 7] [--cold-rounds 1] [STEP ...]

Every step is a process of its own: wall and processor time, and how many kernels it compiled and kept. Warm
steps share a cache, which a first round fills, and run in interleaved rounds; cold ones begin with an empty
one. ``PYTHONDONTWRITEBYTECODE`` is unset: without bytecode, imports would be what is measured. The
first value is asked for beyond what xarray itself takes to open the store and to read a raw one.
Exit status 1 where a median is beyond what was asked for.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

_OPEN = "import xarray as xr, hyperpaint; line = xr.open_zarr('{lot}/lot.zarr', group='flightlines/raw_0'); "
_CLI = "-m hyperpaint"

SCENE = """
[scene]
kind = "car_park"
length_m = 12.0
[platform]
lines = 24
columns = 24
altitude_m = 15.0
ground_sample_m = 0.4
[camera]
bands = 12
[[atmospheres]]
preset = "noon"
[sampling]
samples = 4
"""


class Step(NamedTuple):
    """What a process runs, and what was asked of it [s]."""

    command: str  # arguments of `python`; behind -c, code
    warm: float | None = None
    cold: float | None = None
    beyond: str = ""  # the step that any program pays for, whose time the warm limit comes on top of


RAW = "open_zarr, raw value"

STEPS = {
    "import xarray": Step("-c import xarray"),
    "import hyperpaint": Step("-c import hyperpaint"),
    "--help": Step(f"{_CLI} --help"),
    "info of a store": Step(f"{_CLI} info {{lot}}/lot.zarr", 0.6),
    "info of an ASD file": Step(f"{_CLI} info {{lot}}/asd/sky00000.asd", 0.6),
    "info of a cube": Step(f"{_CLI} info {{lot}}/flight/raw_0.hdr", 0.6),
    "info of a collect": Step(f"{_CLI} info {{lot}}/collect.toml", 0.6),
    RAW: Step(f"-c {_OPEN}print(line.counts[3, 5, 4].values)"),
    "first pixel": Step(f"-c {_OPEN}print(line.paint.pixels(3, 4).reflectance.values[5])", 0.4, 3.0, RAW),
    "first value": Step(
        f"-c {_OPEN}print(line.paint.reflectance().reflectance[3, 5, 4].values)", 0.4, 3.0, RAW
    ),
    "first render": Step(f"{_CLI} render {{lot}}/scene.toml --out {{new}} --quiet", None, 6.0),
}


class Cost(NamedTuple):
    wall: float  # [s]
    processor: float  # [s]
    compiled: int  # kernels that were written to the cache


def cost_of(command: str, lot: Path, cache: Path) -> Cost:
    """Run a process to its end."""
    text = command.format(lot=lot, new=lot / f"{time.monotonic_ns()}.zarr")
    arguments = ["-c", text[3:]] if text.startswith("-c ") else text.split()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    before = sum(1 for _ in cache.rglob("*.nbc"))
    start, spent = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, check=False, capture_output=True, text=True, cwd=lot
    )
    wall, after = time.perf_counter() - start, os.times()
    if done.returncode:
        raise SystemExit(f"python {' '.join(arguments)}:\n{done.stderr}")
    processor = after.children_user + after.children_system - spent.children_user - spent.children_system
    return Cost(wall, processor, sum(1 for _ in cache.rglob("*.nbc")) - before)


def prepare(lot: Path, cache: Path) -> None:
    """Write a small collect, its store and a scene."""
    options = "--lines 64 --bands 60 --columns 40 --scene plan"
    cost_of(f"{_CLI} simulate {{lot}} {options}", lot, cache)
    cost_of(f"{_CLI} process {{lot}}/collect.toml --out {{lot}}/lot.zarr --quiet", lot, cache)
    (lot / "scene.toml").write_text(SCENE)


def row(name: str, cold: list[Cost], warm: list[Cost], asked: Step, floor: float) -> tuple[str, bool]:
    """Return a line of the table, and whether all that was asked for is met; ``floor`` [s]: see `Step`."""
    cells, met = [name.ljust(22)], True
    beyond = None if asked.warm is None else asked.warm + floor
    for costs, limit in ((cold, asked.cold), (warm, beyond)):
        if not costs:
            cells.append(" " * 34)
            continue
        wall, processor, compiled = (statistics.median(column) for column in zip(*costs, strict=True))
        met &= limit is None or wall <= limit
        goal = "" if limit is None else f"<= {limit:.2f}"
        cells.append(f"{wall:8.2f} {goal:7} {processor:8.2f} {compiled:8.0f} ")
    return "|".join(cells), met


def measure(
    steps: Mapping[str, Step], lot: Path, rounds: int, cold_rounds: int
) -> tuple[dict[str, list[Cost]], dict[str, list[Cost]]]:
    """Return the costs of every step, cold and warm."""
    cold: dict[str, list[Cost]] = {name: [] for name in steps}
    warm: dict[str, list[Cost]] = {name: [] for name in steps}
    with tempfile.TemporaryDirectory(prefix="hyperpaint-kernels-") as folder:
        for turn in range(rounds + 1 if rounds else 0):
            for name, step in steps.items():
                cost = cost_of(step.command, lot, Path(folder))
                if turn:  # the first one compiles, and reads files that are not in memory yet
                    warm[name].append(cost)
    for _ in range(cold_rounds):
        for name, step in steps.items():
            if step.cold is not None:
                with tempfile.TemporaryDirectory(prefix="hyperpaint-kernels-") as folder:
                    cold[name].append(cost_of(step.command, lot, Path(folder)))
    return cold, warm


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("steps", nargs="*", metavar="STEP", help=f"of {', '.join(STEPS)}; default: all")
    parser.add_argument("--rounds", type=int, default=7, help="warm ones, of which the median is printed")
    parser.add_argument("--cold-rounds", type=int, default=1)
    given = parser.parse_args()
    steps = {name: step for name, step in STEPS.items() if not given.steps or name in given.steps}
    with tempfile.TemporaryDirectory(prefix="hyperpaint-cold-") as folder:
        lot = Path(folder) / "lot"
        lot.mkdir()
        with tempfile.TemporaryDirectory(prefix="hyperpaint-kernels-") as cache:
            prepare(lot, Path(cache))
        cold, warm = measure(steps, lot, given.rounds, given.cold_rounds)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; medians")
    columns = f"{'wall s':>8} {'asked':7} {'cpu s':>8} {'compiled':>8} "
    print(f"{'':22}|{'nothing compiled before':34}|all compiled before\n{'':22}|{columns}|{columns}")
    missed = 0
    for name, step in steps.items():
        raw = [cost.wall for cost in warm.get(step.beyond, [])]
        text, met = row(name, cold[name], warm[name], step, statistics.median(raw) if raw else 0.0)
        print(text if met else text + " MISSED")
        missed += not met
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
