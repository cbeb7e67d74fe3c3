"""Flight lines with known truth, hypothesis strategies, and what tests of radiometry ask of a line.

Flights are plain numpy, float64, one line an equation: nothing of the package makes them but its table of
attributes, so that a fault there cannot hide here.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from hypothesis import strategies as st

from hyperpaint.base import schema
from hyperpaint.radiometry.counts_to_reflectance import reflectance

START = np.datetime64("2020-06-21T17:00:00", "ns")
LINE_PERIOD = np.timedelta64(7_000_000, "ns")
SHIFT = np.linspace(-1.4, 1.2, 6) ** 2
"""Smile of the six columns of a `flight` [nm]."""


@dataclass
class Flight:
    # A flight line and what it was made from
    line: xr.Dataset
    reflectance: np.ndarray  # (along_track, band, cross_track), float64
    radiance: np.ndarray
    irradiance: np.ndarray  # of every line, flat over wavelength


def labelled(variables: dict[str, Any], attrs: dict[str, Any] | None = None) -> xr.Dataset:
    # Return (dims, values) by name as a Dataset with the attributes of the table
    made = {name: xr.Variable(*value, schema.VARIABLES[name].attrs) for name, value in variables.items()}
    coords = {name: made.pop(name) for name in list(made) if schema.VARIABLES[name].coordinate}
    return xr.Dataset(made, coords, attrs or {})


def flight(
    lines: int = 24,
    bands: int = 12,
    columns: int = 6,
    *,
    seed: int = 0,
    dtype: Any = np.float32,
    exposure: float = 5e-3,
    dark: float | np.ndarray | None = None,
    level: float = 1.2,
    drift: float = 1e-3,
    smile: np.ndarray | None = None,
    position: bool = False,
    flat: bool = False,
) -> Flight:
    # Return a flight under light that is flat over wavelength and linear in time
    # Such light reaches every band unchanged, so that reflectance follows from counts without any spectral
    # matching. ``drift`` is its change [W m-2 nm-1 s-1].
    rng = np.random.default_rng(seed)
    rho = np.full((lines, bands, columns), 0.4) if flat else rng.uniform(0.03, 0.9, (lines, bands, columns))
    seconds = 10.0 + 0.007 * np.arange(lines)
    light = level + drift * seconds
    gain = (0.35 * exposure / 3000.0 * rng.uniform(0.9, 1.4, (bands, columns))).astype(np.float32)
    offset = (
        rng.uniform(80, 120, (bands, columns)) if dark is None else np.broadcast_to(dark, (bands, columns))
    )
    offset = offset.astype(np.float32)
    radiance = rho * light[:, None, None] / np.pi
    counts = radiance * exposure / gain.astype(np.float64) + offset
    whole = np.issubdtype(np.dtype(dtype), np.integer)
    samples = 2.0 * np.arange(12)
    series = (level + drift * samples)[:, None] * np.ones(401)
    place = {"along_track": lines, "band": bands, "cross_track": columns}
    variables: dict[str, Any] = {
        "counts": (tuple(place), (np.rint(counts) if whole else counts).astype(dtype)),
        "dark_counts": (("band", "cross_track"), offset),
        "radiance_gain": (("band", "cross_track"), gain),
        "exposure_time": ((), exposure),
        # counts that are no whole numbers are judged as means: far from the end of the converter
        "saturation_count": ((), np.float32(4095 if whole else 40950)),
        "read_noise": ((), np.float32(2)),
        "irradiance": (("irradiance_time", "irradiance_wavelength"), series.astype(np.float32)),
        "irradiance_fwhm": ((), 3.0),
        "irradiance_max_gap": ((), 5.0),
        "time": (("along_track",), START + (seconds * 1e9).round().astype("timedelta64[ns]")),
        "frame": (("along_track",), np.arange(lines)),
        "wavelength": (("band",), np.linspace(500.0, 700.0, bands)),
        "fwhm": (("band",), np.full(bands, 6.0)),
        "good": (("band",), np.ones(bands, bool)),
        "irradiance_time": (("irradiance_time",), START + samples.astype("timedelta64[s]")),
        "irradiance_wavelength": (("irradiance_wavelength",), np.arange(400.0, 801.0)),
    }
    if smile is not None:
        variables["wavelength_shift"] = (("band", "cross_track")[2 - smile.ndim :], smile)
    if position:
        variables["latitude"] = (("along_track",), np.full(lines, 43.08))
        variables["longitude"] = (("along_track",), np.full(lines, -77.67))
        variables["altitude"] = (("along_track",), np.full(lines, 180.0))
    attrs = {"srf_shape": "gaussian", "irradiance_srf_shape": "gaussian", "name": "raw_0"}
    return Flight(labelled(variables, attrs), rho, radiance, light)


def stored(line: xr.Dataset, path: Any, chunk: int = 8) -> xr.Dataset:
    # Write a flight line to a plain Zarr store, and open it as any user would: everything is lazy
    cubes = [name for name in ("counts", "radiance") if name in line]
    whole = line.chunk(dict.fromkeys(line.dims, -1))
    whole.assign({name: line[name].variable.chunk({"along_track": chunk}) for name in cubes}).to_zarr(
        path, zarr_format=2
    )
    return xr.open_zarr(path)


def values(line: xr.Dataset, **options: Any) -> np.ndarray:
    # Return the computed reflectance of a line
    return reflectance(line, **options)["reflectance"].values


def assert_same(first: xr.Dataset, second: xr.Dataset) -> None:
    # Assert that two calibrated lines have the same bits
    for name in ("reflectance", "quality", "irradiance_age"):
        assert first[name].values.tobytes() == second[name].values.tobytes(), name


@st.composite
def chunkings(draw: st.DrawFn, size: int) -> tuple[int, ...]:
    # Return chunk sizes that add up to ``size``
    cuts = draw(st.sets(st.integers(1, max(size - 1, 1)), max_size=min(size - 1, 4))) if size > 1 else set()
    edges = [0, *sorted(cuts), size]
    return tuple(b - a for a, b in pairwise(edges))


def with_noise(line: xr.Dataset, k: float = 20.0, **known: Any) -> xr.Dataset:
    # Return a line whose noise is known, and what else is given by name
    made = line.copy()
    made["electrons_per_count"] = ((), np.float32(k), {"units": "electron count-1"})
    units = {"wavelength_u": "nm", "dark_counts_u_systematic": "count", "dark_counts_u_random": "count"}
    for name, value in known.items():
        dims = {0: (), 1: ("band",), 2: ("band", "cross_track")}[np.ndim(value)]
        made[name] = (dims, value, {"units": units.get(name, "1")})
    return made
