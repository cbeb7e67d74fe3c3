"""CPU time and peak memory of whole commands at n, 2n and 4n.

    python benchmarks/growth.py                        all commands, some minutes
    python benchmarks/growth.py process verify         only these

What grows is the number of scan lines, of flight lines of a collect, of groups of a store, or of cars. Every
command runs as users call it, in a process of its own. The exponent is that of the part that grows,
log2((t(4n) - t(2n)) / (t(2n) - t(n))): 1 is linear, 2 quadratic; a command whose fixed cost hides the rest
has none. The exit status is 1 where an exponent is above 1.3 and the part above 2 s, or the memory at 4n is
more than 500 MB above that of the imports.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `benchmarks` is then not importable yet
    sys.path.insert(0, str(ROOT))

from benchmarks import flat_memory  # noqa: E402

MOST_EXPONENT, LEAST_PART_S, MOST_ABOVE_IMPORTS_MB = 1.3, 2.0, 500.0


def collect_of(folder: Path, lines: int, cubes: int) -> Path:
    """Return a simulated collect of cubes of 64 scan lines, or of one cube of more."""
    import hyperpaint as hp

    return hp.simulate_collect(folder / "day", scene="plan", lines=lines, bands=32, columns=160, cubes=cubes)


def stored(folder: Path, groups: int) -> Path:
    """Return a store with copies of a flight line as groups."""
    import hyperpaint as hp

    store = hp.process(collect_of(folder, 64, 1), folder / "one.zarr")
    line = hp.open_store(store, "flightlines/raw_0")
    for number in range(groups):
        hp.to_store(line, folder / "lot.zarr", f"flightlines/raw_{number}")
    return folder / "lot.zarr"


def cars(folder: Path, number: int) -> Path:
    """Return a store of a line of some simulated cars, again and again along the track."""
    import numpy as np
    import xarray as xr

    import hyperpaint as hp

    flight = folder / "day"
    hp.simulate_collect(flight, scene="rendered", lines=256, bands=48, columns=160, samples=8)
    line = hp.open_store(hp.process(flight / "collect.toml", folder / "one.zarr"), "flightlines/raw_0").load()
    light = line.drop_dims("along_track")
    pieces = [
        line.drop_dims([d for d in line.dims if d not in ("along_track", "band", "cross_track")])
    ] * number
    joined = xr.concat(pieces, "along_track", data_vars="minimal", coords="minimal", compat="override")
    period = np.timedelta64(np.diff(line["time"].values)[0], "ns")
    time = line["time"].values[0] + period * np.arange(joined.sizes["along_track"])
    joined = joined.assign_coords(
        time=("along_track", time), along_track=np.arange(joined.sizes["along_track"])
    )
    joined = joined.merge(light, compat="override").assign_attrs(line.attrs)
    hp.to_store(joined.chunk(along_track=32), folder / "lot.zarr", "flightlines/raw_0")
    return folder / "lot.zarr"


#: By command and what grows: n, and what makes the inputs and returns the words of the command line.
CASES: dict[tuple[str, str], tuple[int, Callable[[Path, int], list[Any]]]] = {
    ("process", "scan lines"): (1000, lambda f, n: ["process", collect_of(f, n, 1), "--out", f / "lot.zarr"]),
    ("process", "flight lines"): (
        8, lambda f, n: ["process", collect_of(f, 64 * n, n), "--out", f / "lot.zarr"],
    ),
    ("run", "flight lines"): (2, lambda f, n: ["run", collect_of(f, 64 * n, n), "--out", f / "out"]),
    ("info", "flight lines"): (8, lambda f, n: ["info", collect_of(f, 64 * n, n)]),
    ("check", "flight lines"): (8, lambda f, n: ["check", collect_of(f, 64 * n, n)]),
    ("verify", "groups"): (16, lambda f, n: ["verify", stored(f, n)]),
    ("info", "groups"): (16, lambda f, n: ["info", stored(f, n)]),
    ("report", "groups"): (4, lambda f, n: ["report", stored(f, n), "--out", f / "report.html"]),
    ("mosaic", "groups"): (4, lambda f, n: ["mosaic", stored(f, n), "--out", f / "mosaic.zarr"]),
    ("signatures", "cars"): (2, lambda f, n: ["signatures", cars(f, n), "--out", f / "paints.zarr"]),
    **{
        (name, "scan lines of 640 x 272"): (500, lambda _, n, name=name: [name, n])
        for name in ("signatures", "report", "survey", "orthorectify", "geotiff", "mosaic", "render")
    },
}  # fmt: skip


def taken(words: list[Any], folder: Path, grows: str, n: int) -> dict[str, float]:
    """Return seconds and peak memory of a command in a process of its own."""
    if "640" in grows:
        return flat_memory.measured(str(words[0]), n, None)
    return flat_memory.child("command", folder, *map(str, words))


def measured(name: str, grows: str, part: int = 1) -> Iterator[dict[str, float]]:
    """Yield what a case takes at n, 2n and 4n; ``part``: by what its n is divided."""
    n, words = CASES[name, grows]
    for number in (max(n * factor // part, factor) for factor in (1, 2, 4)):
        with tempfile.TemporaryDirectory(prefix="hyperpaint-growth-") as scratch:
            yield taken(words(Path(scratch), number), Path(scratch), grows, number)


def main(arguments: list[str] | None = None) -> int:
    """Print a row for every command; return 1 where one grows faster than its input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="COMMAND")
    names = parser.parse_args(arguments).names
    floor, failed = flat_memory.child("imports", Path())["peak"], False
    print(f"CPU time [s] at n, 2n, 4n; exponent; peak at 4n [MB], imports {floor:.0f}")
    for name, grows in CASES:
        if names and name not in names:
            continue
        costs = list(measured(name, grows))
        seconds = [each["cpu"] for each in costs]
        first, second = seconds[1] - seconds[0], seconds[2] - seconds[1]
        exponent = math.log2(second / first) if first > 0 and second > 0 else math.nan
        is_wrong = second > LEAST_PART_S and exponent > MOST_EXPONENT
        is_wrong |= costs[-1]["peak"] > floor + MOST_ABOVE_IMPORTS_MB
        failed |= is_wrong
        texts = "".join(f"{value:>8.1f}" for value in seconds)
        print(
            f"{name:<13}{str(CASES[name, grows][0]) + ' ' + grows:<30}{texts}{exponent:>7.2f}"
            f"{costs[-1]['peak']:>7.0f}"
            f"{'  MISSED' if is_wrong else ''}",
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
