"""Data that look like a camera's, and a fair way of timing.

Codecs and caches are judged on what they are given, so the counts are those of a 12-bit imager: a textured
scene with cars, shot and read noise, a fixed pattern, glint that saturates. Zeros or uniform noise would
flatter or slander every codec. Everything follows from a seed.
"""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

# ruff: noqa: F401
# asv forks its benchmarks from a process that has read this file, so none of them pays for these imports
import dask.array
import numba
import numpy as np
import scipy.interpolate
import xarray
import zarr

import hyperpaint
import hyperpaint.accessor

SMOKE = bool(os.environ.get("HYPERPAINT_SMOKE"))  # as in CI: the smallest sizes, a sixteenth of the samples
BANDS, COLUMNS = (68, 160) if SMOKE else (272, 640)
BLOCK_LINES = 256  # lines that differ; longer cubes repeat them
THREADS = 2
ELECTRONS_PER_COUNT, READ_NOISE, FULL_SCALE = 20.0, 0.5, 4095
EXPOSURE, FRAME_PERIOD = 5e-3, 7e-3  # [s]
SMILE = 1.5  # wavelength shift at the edge of the swath [nm]


def cases(*sizes: Any) -> list[Any]:
    """Return the sizes of a benchmark; in a round as CI's, the first alone."""
    return list(sizes[: 1 if SMOKE else None])


@functools.cache
def scratch() -> Path:
    """Folder for stores and cubes, gone when the process ends; ``TMPDIR`` says on which disk."""
    folder = Path(tempfile.mkdtemp(prefix="hyperpaint-bench-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def best_of(
    variants: Mapping[str, Callable[[], Any]], rounds: int, after: Callable[[], Any] = lambda: None
) -> dict[str, float]:
    """Return the least wall time of each variant [s].

    Rounds are interleaved, so that a busy moment of the machine hits every variant; the first does not count.
    ``after`` clears up behind each run, off the clock.
    """
    best = dict.fromkeys(variants, np.inf)
    for turn in range(rounds + 1):
        for name, run in variants.items():
            start = time.perf_counter()
            run()
            elapsed = time.perf_counter() - start
            after()
            if turn:
                best[name] = min(best[name], elapsed)
    return best


def wavelengths(bands: int = BANDS) -> np.ndarray:
    return np.linspace(399.4, 1001.4, bands)


def sky(wavelength: np.ndarray) -> np.ndarray:
    """Return a clear sky's irradiance [W m-2 nm-1], oxygen and water bands included."""
    nm = np.asarray(wavelength, np.float64)
    smooth = 1.5 * np.exp(-0.5 * ((nm - 520.0) / 280.0) ** 2)
    for centre, width, depth in (
        (762.0, 2.0, 0.7),
        (687.0, 1.5, 0.3),
        (940.0, 18.0, 0.5),
        (1400.0, 40.0, 0.9),
    ):
        smooth = smooth * (1.0 - depth * np.exp(-0.5 * ((nm - centre) / width) ** 2))
    return smooth


def _surfaces(nm: np.ndarray) -> np.ndarray:
    """Return reflectance (surface, band): asphalt, grass, and cars in black, white, red and blue."""
    edge = 1.0 / (1.0 + np.exp(-(nm - 715.0) / 12.0))
    red, blue = 1.0 / (1.0 + np.exp(-(nm - 605.0) / 9.0)), np.exp(-0.5 * ((nm - 460.0) / 45.0) ** 2)
    grass = 0.04 + 0.05 * np.exp(-0.5 * ((nm - 550.0) / 30.0) ** 2) + 0.42 * edge
    flat = np.ones_like(nm)
    return np.stack(
        [0.10 + 1e-4 * (nm - 400) / 2, grass, 0.05 * flat, 0.78 * flat, 0.06 + 0.5 * red, 0.06 + 0.3 * blue]
    )


def _scene(lines: int, columns: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface and the brightness of every pixel, (line, column)."""
    surface = np.zeros((lines, columns), np.int64)
    surface[:, : columns // 12] = 1
    for top in range(4, lines, 60):
        for left in (columns // 8, columns * 5 // 8):
            surface[top : top + 44, left : left + columns // 4] = rng.integers(2, 6)
    brightness = rng.normal(1.0, 0.04, surface.shape).clip(0.5, 1.5)
    glint = (surface > 1) & (rng.random(surface.shape) < 0.004)
    return surface, np.where(glint, 30.0, brightness).astype(np.float32)


@functools.cache
def instrument(bands: int = BANDS, columns: int = COLUMNS) -> dict[str, np.ndarray]:
    """Return ``dark`` [count], ``signal`` of a white surface [count] and ``gain``, all (band, column)."""
    rng = np.random.default_rng(7)
    nm = wavelengths(bands)
    response = 3600.0 * np.exp(-0.5 * ((nm - 600.0) / 190.0) ** 2) * sky(nm) / sky(nm).max()
    signal = response[:, None] * rng.normal(1.0, 0.02, (bands, columns))
    gain = EXPOSURE * sky(nm)[:, None] / (np.pi * signal)
    dark = rng.normal(110.0, 3.0, (bands, columns))
    return {name: a.astype(np.float32) for name, a in (("dark", dark), ("signal", signal), ("gain", gain))}


@functools.cache
def counts_block(
    lines: int = BLOCK_LINES, bands: int = BANDS, columns: int = COLUMNS, seed: int = 0
) -> np.ndarray:
    """Return raw counts (line, band, column), uint16, of lines that all differ."""
    rng = np.random.default_rng(seed)
    surface, brightness = _scene(lines, columns, rng)
    spectra = _surfaces(wavelengths(bands)).astype(np.float32)
    parts = instrument(bands, columns)
    counts = np.empty((lines, bands, columns), np.uint16)
    for line in range(lines):
        level = spectra[surface[line]].T * brightness[line] * parts["signal"]
        spread = np.sqrt(level / ELECTRONS_PER_COUNT + READ_NOISE**2)
        level += parts["dark"] + spread * rng.standard_normal(level.shape, np.float32)
        counts[line] = np.rint(level).clip(0, FULL_SCALE)
    return counts


def flight_line(
    lines: int, *, smile: bool = False, bands: int = BANDS, columns: int = COLUMNS, counts: Any = None
) -> Any:
    """Return a flight line Dataset whose lazy counts repeat `counts_block`."""
    import xarray as xr

    from hyperpaint.base.schema import CUBE, VARIABLES

    parts = instrument(bands, columns)
    start = np.datetime64("2021-07-20T17:10:00", "ns")
    ticks = (np.arange(lines) * FRAME_PERIOD * 1e9).astype("timedelta64[ns]")
    samples = np.arange(0.0, lines * FRAME_PERIOD + 8.0, 2.0) - 4.0
    nm = np.arange(350.0, 2501.0)
    drift = 1.0 + 0.01 * np.sin(samples / 40.0)
    values: dict[str, Any] = {
        "dark_counts": (CUBE[1:], parts["dark"]),
        "radiance_gain": (CUBE[1:], parts["gain"]),
        "exposure_time": ((), EXPOSURE),
        "saturation_count": ((), np.float32(FULL_SCALE)),
        "read_noise": ((), READ_NOISE),
        "irradiance": (
            ("irradiance_time", "irradiance_wavelength"),
            (drift[:, None] * sky(nm)).astype(np.float32),
        ),
        "irradiance_fwhm": ((), 3.0),
        "time": (CUBE[:1], start + ticks),
        "wavelength": (CUBE[1:2], wavelengths(bands)),
        "fwhm": (CUBE[1:2], np.full(bands, 6.0)),
        "good": (CUBE[1:2], np.ones(bands, bool)),
        "irradiance_time": (("irradiance_time",), start + (samples * 1e9).astype("timedelta64[ns]")),
        "irradiance_wavelength": (("irradiance_wavelength",), nm),
    }
    if smile:
        values["wavelength_shift"] = (CUBE[2:], SMILE * np.linspace(-1.0, 1.0, columns) ** 2)
    variables = {name: xr.Variable(*value, VARIABLES[name].attrs) for name, value in values.items()}
    coords = {name: variables.pop(name) for name in list(variables) if VARIABLES[name].coordinate}
    cube = _repeated(lines, bands, columns) if counts is None else counts
    variables["counts"] = xr.Variable(CUBE, cube, VARIABLES["counts"].attrs)
    return xr.Dataset(variables, coords, {"srf_shape": "gaussian", "irradiance_srf_shape": "gaussian"})


def _repeated(lines: int, bands: int, columns: int) -> Any:
    import dask
    import dask.array as da

    from hyperpaint.base.schema import CHUNK_LINES

    block = counts_block(min(lines, BLOCK_LINES), bands, columns)
    starts = range(0, lines, CHUNK_LINES)
    chunks = (tuple(min(CHUNK_LINES, lines - start) for start in starts), (bands,), (columns,))
    return da.map_blocks(
        _piece,
        dask.delayed(block, pure=False, traverse=False),
        chunks=chunks,
        dtype=np.uint16,
        meta=np.empty((0, 0, 0), np.uint16),
        lines=chunks[0],
    )


def _piece(block: np.ndarray, *, lines: tuple[int, ...], block_id: tuple[int, ...] = ()) -> np.ndarray:
    start = sum(lines[: block_id[0]]) % block.shape[0]
    return block[start : start + lines[block_id[0]]]


@functools.cache
def counts_store(lines: int, *, smile: bool = False, layout: str = "cube", coarse: bool = False) -> Path:
    """Write a flight line as `hyperpaint.to_store` lays it out, with its ``coarse`` means; return it."""
    import hyperpaint as hp

    path = scratch() / f"counts-{lines}-{layout}{'-smile' if smile else ''}{'-coarse' if coarse else ''}.zarr"
    line = flight_line(lines, smile=smile)
    if coarse:
        from hyperpaint.radiometry.pixel_reading import coarse_reflectance

        product = line.paint.reflectance()
        line = product.assign(coarse_reflectance=coarse_reflectance(product)).drop_vars("reflectance")
    hp.to_store(line, path, source_token=f"{lines} {smile}", layout=layout)
    return path


def plan_of(line: Any) -> Any:
    """Return what the tasks of a flight line share (`radiometry.slabs.Plan`), its values loaded."""
    from hyperpaint.radiometry.planning import make_plan

    light = ("irradiance", "irradiance_fwhm", "irradiance_time", "irradiance_wavelength")
    cube = ("dark_counts", "radiance_gain", "exposure_time", "saturation_count", "read_noise", "time")
    cube += ("wavelength", "fwhm", *(["wavelength_shift"] if "wavelength_shift" in line.variables else []))
    return make_plan(
        line["counts"].shape,
        line["counts"].dtype.str,
        np.arange(0, line.sizes["along_track"], 32),
        cube={name: line[name].values for name in cube},
        light={**{name: line[name].values for name in light}, **line.attrs},
    )


def error_terms_of_plan() -> Any:
    """Return what uncertainties follow from, every component being known."""
    from hyperpaint.radiometry.uncertainty import error_terms

    gain = instrument()["gain"]
    known = {
        "electrons_per_count": ELECTRONS_PER_COUNT,
        "read_noise": READ_NOISE,
        "radiance_gain_u_random": np.full(gain.shape, 0.003),
        "radiance_gain_u_systematic": 0.02,
        "irradiance_u_systematic": 0.02,
        "wavelength_u": 0.1,
        "dark_counts_u_systematic": 0.2,
    }
    return error_terms(known, {"wavelength": wavelengths()}, None, "uint16", ~np.isfinite(gain))


def chunk_files(store: Path, name: str = "counts") -> list[Path]:
    """Return the chunk files of a cube along the flight."""
    folder = store / name / "c"
    return [folder / number / "0" / "0" for number in sorted((p.name for p in folder.iterdir()), key=int)]
