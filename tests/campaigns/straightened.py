"""Corners of a checkerboard, through files, from a wobbling flight to a map: by how many pixels they miss.

    python tests/campaigns/straightened.py                      calm and rough, nearest and bilinear; a minute
    python tests/campaigns/straightened.py --lines 600          shorter

A flight of 640 columns of 8 mm from 13 m over squares of 16 cm that are turned by 27 degrees; 5 ms of
exposure, shot and read noise, navigation of 100 Hz whose headings cross north, a camera turned by 0.4, -0.6
and 0.8 degrees and 13 cm off the navigation's reference point. Simulated into the instruments' files,
processed into a store, located and orthorectified as any user would; corners are fitted in the map and
compared with where they are.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(ROOT))

COLUMNS, GSD, SQUARE, TURN = 640, 0.008, 0.16, 27.0
BAND = 1  # of four, the outer of which have no neighbours to take the smile out with
MOUNTING = {"boresight": (0.4, -0.6, 0.8), "lever_arm": (0.05, -0.02, 0.12)}
HEADER = (
    f"{'wobble':<8} {'grid':<7} {'method':<9} {'corners':>7} {'rms':>7} {'p95':>7} {'right':>8} {'down':>8}"
)


def fly(folder: Path, wobble: str, *, lines: int = 1500, columns: int = COLUMNS, **effects: Any) -> Any:
    # Return a processed line, and the truth, of a flight over a checkerboard
    import xarray as xr

    from hyperpaint.simulation import simulate_collect
    from hyperpaint.workflows.pipeline import process

    collect = simulate_collect(
        folder / wobble, lines=lines, columns=columns, bands=4, scene="checkerboard", swath=columns * GSD,
        square=SQUARE, board_turn=TURN, wobble=wobble, **{**MOUNTING, **effects},
    )  # fmt: skip
    store = folder / f"{wobble}.zarr"
    process(collect, store)
    return xr.open_zarr(store, group="flightlines/raw_0"), xr.open_zarr(folder / wobble / "truth.zarr")


def located(line: Any, truth: Any) -> Any:
    # Return the line with the place of every pixel, on the map of the truth
    names = ("ground", "boresight", "lever_arm", "crs")
    return line.paint.locate(**{name: truth.attrs[name] for name in names})


def pixel_errors(placed: Any, truth: Any) -> np.ndarray[Any, Any]:
    # Return by how much the places of pixels miss the truth, (along_track, cross_track) [pixel]
    return np.asarray(np.hypot(placed.east - truth.east, placed.north - truth.north) / GSD)


def corner_errors(placed: Any, truth: Any, *, method: str, grid: str) -> np.ndarray[Any, Any]:
    # Return by how much corners miss their places in a map, right and down (corner, 2) [pixel]
    import hyperpaint as hp
    from campaigns.saddle_points import misplacement

    made = hp.geometry.orthorectify(placed, GSD, method=method, grid=grid, variables=["reflectance"])
    picture = made["reflectance"].isel(band=BAND).values
    transform = tuple(map(float, made["spatial_ref"].attrs["GeoTransform"].split()))
    corners = truth["corner_east"].values, truth["corner_north"].values
    return misplacement(picture, transform, *corners, TURN, SQUARE)


def main() -> None:
    # Print the figures
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lines", type=int, default=1500)
    parser.add_argument("--grids", nargs="+", default=["flight", "north"])
    options = parser.parse_args()
    print(HEADER)
    for wobble in ("calm", "rough"):
        with tempfile.TemporaryDirectory() as folder:
            line, truth = fly(Path(folder), wobble, lines=options.lines)
            placed = located(line, truth)
            error = pixel_errors(placed, truth)
            rms = np.sqrt((error**2).mean())
            print(f"{wobble:<8} pixel positions: rms {rms:.4f}, maximum {error.max():.4f}")
            for grid in options.grids:
                for method in ("bilinear", "nearest"):
                    miss = corner_errors(placed, truth, method=method, grid=grid)
                    far = np.hypot(*miss.T)
                    rms, p95 = np.sqrt((far**2).mean()), np.percentile(far, 95)
                    right, down = miss.mean(axis=0)
                    print(
                        f"{wobble:<8} {grid:<7} {method:<9} {len(miss):>7} {rms:>7.3f} {p95:>7.3f} "
                        f"{right:>8.4f} {down:>8.4f}"
                    )


if __name__ == "__main__":
    main()
