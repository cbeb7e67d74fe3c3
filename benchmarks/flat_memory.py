"""Peak memory of whole commands against the length of the flight line.

    python benchmarks/flat_memory.py                                 all at 500, 4,000 and 12,000 lines
    python benchmarks/flat_memory.py survey report --lines 500 4000  only these
    python benchmarks/flat_memory.py --memory-limit "700 MB"         the plan of a small machine

Every command runs as users call it, in a process of its own, on lines of 640 columns and 272 bands (64 for
maps, 16 for renders). Cubes repeat 256 lines, so that stores are written quickly; the largest takes some
3 GB under TMPDIR, and goes before the next. The exit status is 1 where a command takes more than 500 MB
above the imports, or the longest line more than 1.2 times what the shortest does.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `benchmarks` is then not importable yet
    sys.path.insert(0, str(ROOT))

COLUMNS = 640
BANDS = {"signatures": 272, "report": 272, "survey": 272, "orthorectify": 64, "geotiff": 64, "mosaic": 64}
MOST_ABOVE_IMPORTS_MB, MOST_GROWTH = 500.0, 1.2
CASES = (*BANDS, "render")


def posed(lines: int, bands: int, *, back: bool = False) -> Any:
    """Return a flight line with the poses of a drone; a second one flies ``back`` beside it."""
    from benchmarks.common import flight_line
    from benchmarks.mosaic_memory import DEGREES_A_METRE, OVERLAP
    from benchmarks.orthorectified_lines import GSD, posed_line
    from hyperpaint import Convention

    line = flight_line(lines, bands=bands, columns=COLUMNS)
    poses = posed_line(lines, COLUMNS, heading=180.0 * back)
    if back:
        poses["latitude"] = poses.latitude + DEGREES_A_METRE * lines * GSD
        across = (1.0 - OVERLAP) * COLUMNS * GSD
        poses["longitude"] = poses.longitude + DEGREES_A_METRE * across / np.cos(np.radians(34.0))
    names = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
    line = line.assign_coords({name: poses[name] for name in names})
    convention = Convention(column_order="left_to_right", stamp_reference="mid")
    return line.assign_attrs(convention.to_attrs())


def write_line(folder: Path, lines: int, case: str) -> None:
    import hyperpaint as hp

    for number in range(1 + (case == "mosaic")):
        line = posed(lines, BANDS[case], back=number > 0)
        hp.to_store(line, folder / "lot.zarr", group=f"flightlines/raw_{number}")
    if case == "signatures":
        regions = [
            {
                "type": "Feature",
                "properties": {"name": f"car {top}", "flightline": "raw_0"},
                "geometry": {"type": "Polygon", "coordinates": [_square(90, top + 10)]},
            }
            for top in range(0, lines - 60, max(64, lines // 60))
        ]
        text = json.dumps({"type": "FeatureCollection", "features": regions})
        (folder / "regions.geojson").write_text(text)


def _square(left: int, top: int) -> list[list[int]]:
    right, bottom = left + 40, top + 30
    return [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]


_SCENE = """
[scene]
kind = "car_park"
[platform]
lines = {lines}
columns = {columns}
ground_sample_m = 0.03
altitude_m = 40.0
[camera]
bands = 16
[[atmospheres]]
preset = "noon"
[sampling]
samples = 1
depth = 1
[output]
product = "radiance"
"""


def command(case: str, folder: Path, limit: str | None) -> list[str]:
    """Return the arguments of the command line."""
    store, given = str(folder / "lot.zarr"), [] if limit is None else ["--memory-limit", limit]
    camera = ["--set", "focal_length_mm=15.24", "--set", "pixel_pitch_um=8"]
    place = ["--ground", "0", *camera, "--gsd", "0.008", *given]
    out = str(folder / "out")
    return {
        "signatures": ["signatures", store, "--regions", str(folder / "regions.geojson"), "--drop-small",
                       "--out", f"{out}.zarr", "--sun-zenith", "30", "--set", "diffuse=model", *given],
        "report": ["report", store, "--out", f"{out}.html", "--sun-zenith", "30", *given],
        "orthorectify": ["orthorectify", store, "--out", f"{out}.zarr", *place],
        "geotiff": ["orthorectify", store, "--out", f"{out}.tif", *place],
        "mosaic": ["mosaic", store, "--out", f"{out}.zarr", *place],
        "render": ["render", str(folder / "scene.toml"), "--out", f"{out}.zarr", *given],
    }[case]  # fmt: skip


def survey_and_flag(folder: Path) -> None:
    """Do what users of Python do with a long line: survey it, and store its flags."""
    import hyperpaint as hp

    line = hp.open_store(folder / "lot.zarr", "flightlines/raw_0").paint.reflectance()
    model = line.paint.survey(sun_zenith=30.0, diffuse="model")
    hp.to_store(line.paint.flag(model)[["quality", "glint_fraction"]], folder / "flags.zarr")


def run_here(case: str, folder: Path, limit: str | None, *words: str) -> None:
    """Run a command in this process, and print its peak memory, wall time and CPU time."""
    import resource

    start = time.perf_counter()
    if case == "imports":
        imports()
    elif case == "survey":
        survey_and_flag(folder)
    elif case == "write":
        write_line(folder, int(limit or 0), folder.name)
    else:
        from hyperpaint.cli.program import main as hyperpaint

        try:
            own = [str(limit), *words] if case == "command" else command(case, folder, limit)
            status = hyperpaint([*own, "--quiet"])
        except SystemExit as end:
            status = end.code
        if status:
            sys.exit(status)
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(
        json.dumps(
            {"peak": peak_mb(), "s": time.perf_counter() - start, "cpu": used.ru_utime + used.ru_stime}
        )
    )


def imports() -> None:
    import importlib

    modules = ("dask.array", "numba", "numcodecs.blosc", "pint", "scipy.interpolate", "xarray", "zarr")
    for module in (
        *modules,
        "hyperpaint.kernels.radiometry",
        "hyperpaint.io.store",
        "hyperpaint.cli.program",
    ):
        importlib.import_module(module)


def peak_mb() -> float:
    """Return the peak memory of this process [MB]."""
    try:
        # not ru_maxrss, which Linux hands down from the process that started this one
        return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1e3
    except (OSError, IndexError):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def child(case: str, folder: Path, *words: str | None) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, __file__, "--here", case, str(folder), "--", *filter(None, words)],
        check=True, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return dict(json.loads(done.stdout.splitlines()[-1]))


def measured(case: str, lines: int, limit: str | None) -> dict[str, float]:
    """Return what a command takes of a line so long, which is written for it."""
    with tempfile.TemporaryDirectory(prefix="hyperpaint-flat-") as name:
        folder = Path(name) / case
        folder.mkdir()
        if case == "render":
            (folder / "scene.toml").write_text(_SCENE.format(lines=lines, columns=COLUMNS))
        else:
            child("write", folder, str(lines))
        taken = child(case, folder, limit)
        shutil.rmtree(folder)
    return taken


def main(arguments: list[str] | None = None) -> int:
    """Print a row for every command; return 1 where one takes too much, or more for a longer line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"some of {', '.join(CASES)}")
    parser.add_argument("--lines", nargs="+", type=int, default=[500, 4000, 12000])
    parser.add_argument("--memory-limit", metavar="SIZE")
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.here:
        case, folder, *words = [*asked.here, *asked.cases]
        run_here(case, Path(folder), *(words or [None]))
        return 0
    floor = child("imports", Path())["peak"]
    print(f"imports {floor:.0f} MB; peak memory [MB], then wall and CPU time [s]")
    print(f"{'lines':<14}" + "".join(f"{lines:>20}" for lines in asked.lines) + f"{'growth':>9}")
    failed = False
    for case in asked.cases or CASES:
        print(f"{case:<14}", end="", flush=True)
        peaks = []
        for lines in asked.lines:
            taken = measured(case, lines, asked.memory_limit)
            peaks.append(taken["peak"])
            print(f"{taken['peak']:>8.0f} {taken['s']:>5.0f} {taken['cpu']:>5.0f}", end="", flush=True)
        growth = peaks[-1] / peaks[0]
        met = max(peaks) <= floor + MOST_ABOVE_IMPORTS_MB and growth <= MOST_GROWTH
        failed |= not met
        print(f"{growth:>8.2f}x  {'met' if met else 'MISSED'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
