"""A flight line to a map: how long it takes, how far off it is, and how others do the same.

    python benchmarks/orthorectified_lines.py                    2000 lines of 640 columns and 272 bands
    python benchmarks/orthorectified_lines.py --lines 500        a first look
    python benchmarks/orthorectified_lines.py --cube             all bands beside pyresample and GDAL
    python benchmarks/orthorectified_lines.py --memory           peak memory against the length of the line

The job of everyone is the same: where on the line does every cell of a map with north up lie. What is
resampled to judge it is the line's own east and north, so that the distance of what a cell got from where the
cell lies is the error, in pixels. Others are given the places of the pixels for nothing; rays are timed on
their own.

``scipy`` is a k-d tree over all pixels, asked for the nearest within 2 pixels of every cell, on two threads;
``pyresample`` is the same as others use it, on one; ``gdal`` is GDAL's warp by geolocation arrays, through
rasterio, given the corners of the pixels, which it takes places for. Packages that are not installed are left
out.
"""

from __future__ import annotations

import argparse
import gc
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
if __package__ in (None, ""):  # run as a script: `benchmarks` is then not importable yet
    sys.path.insert(0, str(ROOT))

from benchmarks.common import FRAME_PERIOD, THREADS, counts_block  # noqa: E402

HEIGHT, GSD = 15.24, 0.008
LATITUDE, LONGITUDE, HEADING = 34.0, -81.0, 37.0
RADIUS = 6.371e6
CRS = "EPSG:32617"
REACH = 2.0  # pixels within which a nearest neighbour is looked for


def posed_line(lines: int, columns: int, *, rough: bool = False, heading: float = HEADING) -> Any:
    """Return a line with times and poses of a drone that wobbles 15 m above level ground."""
    import xarray as xr

    rng = np.random.default_rng(5)
    seconds = np.arange(lines) * FRAME_PERIOD
    spread = (0.42, 0.42, 3.1) if rough else (0.15, 0.15, 1.1)
    swings = [np.zeros(lines) for _ in spread]
    for made, size in zip(swings, spread, strict=True):
        for frequency in (0.4, 1.1, 2.2):
            made += size * 0.8 * rng.normal() * np.sin(2 * np.pi * (frequency * seconds + rng.random()))
    roll, pitch, yaw = swings
    way = np.degrees(GSD * np.arange(lines) / RADIUS)
    along = np.radians(heading)
    pose = {
        "latitude": LATITUDE + way * np.cos(along),
        "longitude": LONGITUDE + way * np.sin(along) / np.cos(np.radians(LATITUDE)),
        "altitude": np.full(lines, HEIGHT),
        "roll": roll,
        "pitch": pitch,
        "heading": (heading + yaw) % 360.0,
    }
    start = np.datetime64("2021-07-20T17:10:00", "ns")
    units = {name: {"units": "m" if name == "altitude" else "degree"} for name in pose}
    coords: dict[str, Any] = {name: ("along_track", values, units[name]) for name, values in pose.items()}
    coords["time"] = ("along_track", start + (seconds * 1e9).astype("timedelta64[ns]"))
    coords["cross_track"] = np.arange(columns)
    return (
        xr.Dataset(coords=coords)
        .drop_vars("cross_track")
        .assign(quality=(("along_track", "cross_track"), np.zeros((lines, columns), np.uint16)))
    )


def located_line(line: Any, **options: Any) -> Any:
    import hyperpaint as hp

    columns = line.sizes["cross_track"]
    camera = hp.geometry.PinholeCamera(columns, pixel_pitch=GSD, focal_length=HEIGHT)
    convention = hp.Convention(column_order="left_to_right", stamp_reference="mid")
    return hp.geometry.locate(line, ground=0.0, crs=CRS, camera=camera, convention=convention, **options)


def with_counts(line: Any, bands: int) -> Any:
    """Return the line with counts in memory."""
    lines, columns = line.sizes["along_track"], line.sizes["cross_track"]
    block = counts_block(min(lines, 64), bands, columns)
    counts = np.empty((lines, bands, columns), np.uint16)
    for start in range(0, lines, len(block)):
        counts[start : start + len(block)] = block[: lines - start]
    return line.assign(counts=(("along_track", "band", "cross_track"), counts))


def best(function: Any, rounds: int = 3) -> tuple[float, Any]:
    """Return the least wall time [s] and what came out; the first run does not count."""
    function()
    least, made = np.inf, None
    for _ in range(rounds):
        del made
        gc.collect()
        start = time.perf_counter()
        made = function()
        least = min(least, time.perf_counter() - start)
    return least, made


# --- how others find the places ----------------------------------------------------------------------------


def by_tree(east: Any, north: Any, where: tuple[Any, Any]) -> Any:
    from scipy.spatial import cKDTree

    tree = cKDTree(np.stack([east.ravel(), north.ravel()], axis=-1))
    places = np.stack([part.ravel() for part in where], axis=-1)
    _, found = tree.query(places, distance_upper_bound=REACH * GSD, workers=THREADS)
    return np.where(found == east.size, -1, found)


def by_pyresample(longitude: Any, latitude: Any, area: Any) -> Any:
    from pyresample import geometry, kd_tree

    swath = geometry.SwathDefinition(lons=longitude, lats=latitude)
    known, _, found, _ = kd_tree.get_neighbour_info(swath, area, REACH * GSD, neighbours=1, nprocs=1)
    positions = np.append(np.flatnonzero(known), -1)
    return positions[np.minimum(found, positions.size - 1)]


def by_gdal(east: Any, north: Any, transform: Any, shape: tuple[int, int], offset: Any) -> Any:
    """Warp the line's own places through GDAL's geolocation arrays; return what cells got (2, row, col)."""
    values = np.stack([east - offset[0], north - offset[1]])
    out = np.full((2, *shape), np.nan)
    warp(values, out, corners(east, north), transform, np.nan)
    return out


def warp(values: Any, out: Any, places: Any, transform: Any, empty: Any) -> None:
    """Warp bands (band, line, column) by the corners of their pixels to a map (band, row, col)."""
    from rasterio.crs import CRS as RASTERIO_CRS
    from rasterio.warp import Resampling, reproject

    crs = RASTERIO_CRS.from_string(CRS)
    reproject(
        values, out, src_geoloc_array=np.stack(places), src_crs=crs, dst_transform=transform, dst_crs=crs,
        resampling=Resampling.nearest, src_nodata=empty, dst_nodata=empty, num_threads=THREADS,
    )  # fmt: skip


def corners(east: Any, north: Any) -> tuple[Any, Any]:
    """Return the upper left corners of the pixels: the middle of four neighbours."""
    made = []
    for part in (east, north):
        wide = np.pad(part, ((1, 0), (1, 0)), mode="reflect", reflect_type="odd")
        made.append((wide[1:, 1:] + wide[1:, :-1] + wide[:-1, 1:] + wide[:-1, :-1]) / 4)
    return made[0], made[1]


# --- the table ---------------------------------------------------------------------------------------------


def compare(lines: int, columns: int, rough: bool, rounds: int) -> dict[str, float]:
    """Print who takes how long for the index of one line, and how far off they are; return seconds."""
    import dask
    import xarray as xr

    import hyperpaint as hp

    located = located_line(posed_line(lines, columns, rough=rough)).chunk(along_track=32)
    dims = ("along_track", "cross_track")
    rays, (east, north) = best(lambda: dask.compute(located["east"].data, located["north"].data), rounds)
    told = located["east"].attrs
    known = xr.Dataset({"quality": located["quality"] * 0}, {"spatial_ref": located["spatial_ref"]})
    known = known.assign_coords(east=(dims, east, told), north=(dims, north, told)).chunk(along_track=32)
    known = known.assign_attrs(located.attrs)  # level ground: nothing is hidden
    made: Any = None

    def index() -> Any:
        nonlocal made
        made = hp.geometry.orthorectify(known, GSD, grid="north", variables=[])
        return dask.compute(made["nearest_line"].data, made["nearest_sample"].data)

    seconds = {"rays": rays}
    seconds["hyperpaint"], (line, sample) = best(index, rounds)
    numbers = [float(number) for number in made["spatial_ref"].attrs["GeoTransform"].split()]
    where = np.meshgrid(made["x"].values, made["y"].values)
    inside = line >= 0
    found = {"hyperpaint": np.full(line.shape, -1)}
    found["hyperpaint"][inside] = line[inside] * columns + sample[inside]
    seconds["scipy"], tree = best(lambda: by_tree(east, north, tuple(where)), 1)
    found["scipy"] = tree.reshape(line.shape)
    off = {name: _distance(east, north, part, where) for name, part in found.items()}
    _others(seconds, off, (east, north), numbers, where)
    truth = off["scipy"][inside & np.isfinite(off["scipy"])]
    exact = float(np.sqrt((truth**2).mean()))
    kind = "rough" if rough else "calm"
    print(f"\n{lines} lines x {columns} columns, {kind}, map of {line.shape[0]} x {line.shape[1]} cells, "
          f"{inside.mean():.0%} covered; rays {1e3 * rays:.0f} ms")  # fmt: skip
    heads = f"{'ratio':>7} {'rms px':>8} {'/ exact':>8} {'max px':>7} {'empty in':>9} {'filled out':>10}"
    print(f"{'':12} {'s':>8} {heads}")
    for name, error in off.items():
        both = inside & np.isfinite(error)
        rms = float(np.sqrt((error[both] ** 2).mean()))
        print(
            f"{name:12} {seconds[name]:8.3f} {seconds[name] / seconds['hyperpaint']:7.1f} {rms:8.3f} "
            f"{rms / exact:8.3f} {error[both].max():7.2f} {int((inside & np.isnan(error)).sum()):9} "
            f"{int((~inside & np.isfinite(error)).sum()):10}",
            flush=True,
        )  # fmt: skip
    return seconds


def _others(seconds: Any, off: Any, places: Any, numbers: list[float], where: Any) -> None:
    """Add what pyresample and GDAL make of it, where they are installed."""
    east, north = places
    shape = where[0].shape
    try:
        from pyproj import Transformer
        from pyresample import geometry

        longitude, latitude = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(east, north)
        extent = (
            numbers[0],
            numbers[3] + shape[0] * numbers[5],
            numbers[0] + shape[1] * numbers[1],
            numbers[3],
        )
        area = geometry.AreaDefinition("map", "map", "map", CRS, shape[1], shape[0], extent)
        seconds["pyresample"], found = best(lambda: by_pyresample(longitude, latitude, area), 1)
        off["pyresample"] = _distance(east, north, found.reshape(shape), where)
    except ImportError as error:
        print(f"pyresample left out: {error}")
    try:
        from affine import Affine

        offset = east.mean(), north.mean()
        to_map = Affine.from_gdal(*numbers)
        seconds["gdal"], got = best(lambda: by_gdal(east, north, to_map, shape, offset), 1)
        off["gdal"] = np.hypot(got[0] + offset[0] - where[0], got[1] + offset[1] - where[1]) / GSD
    except ImportError as error:
        print(f"gdal left out: {error}")


def _distance(east: Any, north: Any, found: Any, where: Any) -> Any:
    """Return how far what cells got lies from them [pixel]; NaN where they got nothing."""
    at = np.maximum(found, 0)
    away = np.hypot(east.ravel()[at] - where[0], north.ravel()[at] - where[1]) / GSD
    return np.where(found < 0, np.nan, away)


def whole_job(lines: int, columns: int, bands: int, grid: str, rounds: int) -> float:
    """Print and return how long poses to map take, counts being in memory [s]."""
    import dask.array as da

    import hyperpaint as hp

    line = with_counts(posed_line(lines, columns), bands)

    def run() -> None:
        made = hp.geometry.orthorectify(located_line(line), grid=grid, variables=["counts"])["counts"]
        da.store(made.data, out, lock=False)

    # memory that has been touched: what a machine takes to hand out fresh pages is not what is asked for here
    shape = hp.geometry.orthorectify(located_line(line), grid=grid, variables=["counts"])["counts"].shape
    out = np.zeros(shape, np.uint16)
    out.fill(1)
    seconds, _ = best(run, rounds)
    print(
        f"rays, inverse map, nearest: {lines} x {columns} x {bands} to {grid} {shape}, "
        f"{out.nbytes / 1e9:.1f} GB: {seconds:.2f} s"
    )
    return seconds


def whole_cubes(lines: int, columns: int, bands: int, rounds: int) -> dict[str, float]:
    """Print and return who takes how long for nearest pixels of all bands, places being given [s].

    Everyone has the cube in memory, in the order that suits it, and makes a map in fresh memory.
    """
    import dask
    import dask.array as da
    from affine import Affine
    from pyproj import Transformer
    from pyresample import geometry, kd_tree

    import hyperpaint as hp

    located = located_line(posed_line(lines, columns)).chunk(along_track=32)
    east, north = dask.compute(located["east"].data, located["north"].data)
    dims, told = ("along_track", "cross_track"), located["east"].attrs
    line = with_counts(located.drop_vars(["east", "north"]), bands)
    line = line.assign_coords(east=(dims, east, told), north=(dims, north, told)).assign_attrs(located.attrs)
    made = hp.geometry.orthorectify(line, GSD, variables=["counts"])
    rows, cols = made.sizes["y"], made.sizes["x"]
    numbers = [float(number) for number in made["spatial_ref"].attrs["GeoTransform"].split()]
    longitude, latitude = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(east, north)
    extent = numbers[0], numbers[3] + rows * numbers[5], numbers[0] + cols * numbers[1], numbers[3]
    area = geometry.AreaDefinition("map", "map", "map", CRS, cols, rows, extent)
    swath = geometry.SwathDefinition(lons=longitude, lats=latitude)
    counts = line["counts"].values
    by_pixel = np.ascontiguousarray(np.moveaxis(counts, 1, -1))
    by_band = np.ascontiguousarray(np.moveaxis(counts, 1, 0))
    places, transform = corners(east, north), Affine.from_gdal(*numbers)

    def ours() -> None:
        out = np.empty((rows, cols, bands), np.uint16)
        made = hp.geometry.orthorectify(line, GSD, variables=["counts"])["counts"]
        da.store(made.data, out, lock=False)

    def gdal() -> None:
        warp(by_band, np.empty((bands, rows, cols), np.uint16), places, transform, 65535)

    def tree() -> None:
        kd_tree.resample_nearest(swath, by_pixel, area, REACH * GSD, fill_value=65535, nprocs=1)

    least = dict.fromkeys(("hyperpaint", "pyresample", "gdal"), np.inf)
    for turn in range(rounds + 1):
        for name, run in zip(least, (ours, tree, gdal), strict=True):
            start = time.perf_counter()
            run()
            if turn:
                least[name] = min(least[name], time.perf_counter() - start)
            gc.collect()
    print(f"nearest pixels of {lines} x {columns} x {bands} on {rows} x {cols} cells, places given")
    for name, seconds in least.items():
        print(f"{name:12} {seconds:8.2f} s {seconds / least['hyperpaint']:7.1f}x", flush=True)
    return least


def memory(columns: int, bands: int) -> None:
    """Print the peak memory of maps that are made and let go tile by tile, each in a process of its own."""
    for lines in (1000, 4000, 16000):
        code = f"from benchmarks.orthorectified_lines import stream; stream({lines}, {columns}, {bands})"
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def stream(lines: int, columns: int, bands: int) -> None:
    """Make a map of lazy radiance, and keep nothing of it."""
    import dask.array as da

    import hyperpaint as hp

    line = located_line(posed_line(lines, columns, heading=0.0).chunk(along_track=32))
    cube = da.zeros((lines, bands, columns), chunks=(32, bands, columns), dtype=np.float32) + np.float32(1.0)
    line = line.assign(radiance=(("along_track", "band", "cross_track"), cube, {"units": "W m-2 sr-1 nm-1"}))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    start = time.perf_counter()
    made = hp.geometry.orthorectify(line, variables=["radiance"])["radiance"]
    built = time.perf_counter() - start

    class Sink:
        def __setitem__(self, where: Any, values: Any) -> None:
            pass

    da.store(made.data, Sink(), lock=False, num_workers=THREADS)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    took = time.perf_counter() - start
    print(f"{lines:>7} lines: map of {made.nbytes / 1e9:6.2f} GB, peak {peak:6.0f} MB ({before:.0f} before), "
          f"graph {built:.1f} s, all {took:.1f} s", flush=True)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; return 1 where the index is not ten times a k-d tree's, or the job is slow."""
    import dask

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lines", type=int, default=2000)
    parser.add_argument("--columns", type=int, default=640)
    parser.add_argument("--bands", type=int, default=272)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", action="store_true", help="peak memory by length, nothing else")
    parser.add_argument("--cube", action="store_true", help="nearest pixels of all bands, nothing else")
    asked = parser.parse_args(arguments)
    if asked.cube:
        with dask.config.set(scheduler="threads", num_workers=THREADS):
            took = whole_cubes(asked.lines, asked.columns, asked.bands, asked.rounds)
        ours = took["hyperpaint"]
        return int(took["pyresample"] < 12.0 * ours or took["gdal"] < 20.0 * ours)
    if asked.memory:
        memory(asked.columns, asked.bands)
        return 0
    failed = False
    with dask.config.set(scheduler="threads", num_workers=THREADS):
        for rough in (False, True):
            seconds = compare(asked.lines, asked.columns, rough, asked.rounds)
            failed |= seconds.get("pyresample", 2 * seconds["scipy"]) < 10.0 * seconds["hyperpaint"]
        print()
        for grid in ("flight", "north"):
            took = whole_job(asked.lines, asked.columns, asked.bands, grid, asked.rounds)
            failed |= grid == "flight" and took > 2.0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
