"""Peak memory of a mosaic against the number of its lines.

    python benchmarks/mosaic_memory.py                      2, 4 and 6 lines of 640 x 4000 x 64
    python benchmarks/mosaic_memory.py --heading 30         lines that go across rows and columns of tiles
    python benchmarks/mosaic_memory.py --store              written as a Zarr store, as the command does

Lines lie side by side on opposite courses and overlap by 40 %; their radiance is made slab by slab as it is
asked for. Tiles are let go as they are done. Every mosaic has a process of its own; the exit status is 1
where six lines take more than 1.2 times what two do.
"""

from __future__ import annotations

import argparse
import resource
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

from benchmarks.common import THREADS  # noqa: E402
from benchmarks.orthorectified_lines import GSD, located_line, posed_line  # noqa: E402

OVERLAP = 0.4
DEGREES_A_METRE = np.degrees(1.0 / 6.371e6)


def flown_lines(count: int, lines: int, columns: int, bands: int, heading: float) -> dict[str, Any]:
    """Return located lines side by side, with lazy radiance."""
    import dask.array as da

    flown = {}
    for number in range(count):
        line = posed_line(lines, columns, heading=heading + 180.0 * (number % 2))
        across, ahead = (1.0 - OVERLAP) * columns * GSD * number, lines * GSD * (number % 2)
        course = np.radians(heading)
        north = ahead * np.cos(course) - across * np.sin(course)
        east = ahead * np.sin(course) + across * np.cos(course)
        line["latitude"] = line.latitude + DEGREES_A_METRE * north
        line["longitude"] = line.longitude + DEGREES_A_METRE * east / np.cos(np.radians(34.0))
        slabs = ((32,) * (lines // 32), (bands,), (columns,))
        cube = da.map_blocks(slab, chunks=slabs, dtype=np.float32, meta=np.empty((0, 0, 0), np.float32))
        line = located_line(line.chunk(along_track=32))
        units = {"units": "W m-2 sr-1 nm-1"}
        flown[f"raw_{number}"] = line.assign(radiance=(("along_track", "band", "cross_track"), cube, units))
    return flown


def slab(block_info: Any = None) -> Any:
    return np.full(block_info[None]["chunk-shape"], 1.0, np.float32)


def compose(count: int, heading: float, store: bool) -> None:
    """Compose a mosaic, and keep nothing of it."""
    import dask
    import dask.array as da

    import hyperpaint as hp

    lines = flown_lines(count, 4000, 640, 64, heading)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    start = time.perf_counter()
    made = hp.geometry.mosaic(lines, GSD, variables=["radiance", "view_zenith", "quality"])
    built = time.perf_counter() - start

    class Sink:
        def __setitem__(self, where: Any, values: Any) -> None:
            pass

    with dask.config.set(scheduler="threads", num_workers=THREADS):
        if store:
            with tempfile.TemporaryDirectory() as folder:
                hp.to_store(made, Path(folder) / "mosaic.zarr")
        else:
            parts = [made[name].data for name in ("radiance", "flightline", "quality")]
            da.store(parts, [Sink() for _ in parts], lock=False)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    took = time.perf_counter() - start
    gigabytes = made.radiance.nbytes / 1e9
    print(f"{count} lines: {made.sizes['y']} x {made.sizes['x']} cells, {gigabytes:.2f} GB, "
          f"peak {peak:.0f} MB ({before:.0f} before), graph {built:.1f} s, all {took:.1f} s",
          flush=True)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Print a row for every number of lines; return 1 where memory grows with it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--heading", type=float, default=0.0)
    parser.add_argument("--store", action="store_true")
    asked = parser.parse_args(arguments)
    peaks = {}
    for count in (2, 4, 6):
        code = (
            f"from benchmarks.mosaic_memory import compose; compose({count}, {asked.heading}, {asked.store})"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
        )
        print(done.stdout, end="", flush=True)
        peaks[count] = float(done.stdout.partition("peak ")[2].split()[0])
    print(f"6 lines take {peaks[6] / peaks[2]:.2f} times what 2 take, expected 1.2 at most")
    return int(peaks[6] > 1.2 * peaks[2])


if __name__ == "__main__":
    sys.exit(main())
