"""Small scenes to trace, light that is easy to compute with, and a slow oracle of relighting."""

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet, line_shape
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material, measured_factor
from hyperpaint.simulation.rendering.platforms import Platform, pushbroom
from hyperpaint.simulation.rendering.scene import Instance, Scene, SceneRecord, box, plane
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

SUN = (40.0, 150.0)
LOW_SUN = (75.0, 260.0)
FEW_BANDS = BandSet(np.array([420.0, 550.0, 687.0, 762.0, 940.0]), np.array(6.0))


def two_cars(left: str = "red", right: str = "blue") -> Scene:
    # Return two painted blocks on asphalt beside a brick wall: coats, flakes, shadows, neighbours
    paints = [
        Material(f"paint of car_{number}", name, "paint", Coat(), flakes)
        for number, name, flakes in ((0, left, None), (1, right, Flakes(0.2)))
    ]
    cars = [
        box(
            (1.5, 3.0, 1.2),
            paint,
            centre=(east, 0.0, 0.0),
            instance=Instance(f"car_{number}", "car", paint.spectrum),
        )
        for number, (paint, east) in enumerate(zip(paints, (-1.5, 1.5), strict=True))
    ]
    wall = box(
        (0.3, 8.0, 2.0),
        Material("bricks", "brick", "wall"),
        centre=(3.4, 0, 0),
        instance=Instance("wall", "wall"),
    )
    return Scene.join([plane(30.0), *cars, wall], "two cars")


def flight(lines: int = 24, columns: int = 16, **more: Any) -> Platform:
    # Return a flight whose swath holds both cars
    return pushbroom(lines, columns, altitude=12.0, ground_sample=0.45, line_spacing=0.3, **more)


def flat_light(
    sun: float = 1.2, sky: float = 0.3, direction: tuple[float, float] = SUN, **more: Any
) -> Atmosphere:
    # Return light that is the same at all wavelengths, without air
    grid = np.array([300.0, 500.0, 1100.0])
    zero = np.zeros(3)
    return Atmosphere(grid, zero + sun, zero + sky, zero, zero, *direction, name="flat", **more)


def line_light(direction: tuple[float, float] = SUN, **more: Any) -> Atmosphere:
    # Return the simulator's sky with all its lines, without air
    return Atmosphere.clear(*direction, haze=None, **more)


def factors_of(record: SceneRecord, grid: np.ndarray) -> np.ndarray:
    # Return all factors of a scene on a grid, by their definition
    made = []
    for factor in record.factors:
        material = record.materials[factor.material]
        flakes = material.flakes
        name = material.spectrum
        if flakes is not None and factor.flakes:
            name = flakes.turned if factor.turned else flakes.spectrum
        index = None if material.coat is None or factor.flakes else material.coat.index
        made.append(measured_factor(spectrum_of(name)(grid), index))
    return np.stack(made)


def radiance_by_hand(
    traced: xr.Dataset, line: int, column: int, light: Atmosphere, bands: BandSet, factors: Any = None
) -> np.ndarray:
    # Return the radiance of a pixel by a sum over its paths on a grid of 0.05 nm, before any air
    record, settings = SceneRecord.from_attrs(traced.attrs)
    grid = np.arange(350.0, 1050.0, 0.05)
    spectra = factors_of(record, grid) if factors is None else factors(grid)
    sun = np.interp(grid, light.wavelength, light.sun)
    sky = np.interp(grid, light.wavelength, light.sky)
    bits = max(len(record.factors), 1).bit_length()
    total = np.zeros_like(grid)
    weights = traced.transport_weight.values[line, :, column]
    for weight, code in zip(weights, traced.transport_path.values[line, :, column].tolist(), strict=True):
        if code < 0:
            continue
        share = light.overcast_share
        clear = [np.interp(grid, light.wavelength, part) for part in light.clear_shares]
        shares = {0: 1 - share - sum(clear), 1: share} | dict(enumerate(clear, start=8))
        source = code % 32
        if source not in (*shares, 2):
            continue  # another sun
        term = (sun if source == 2 else sky * shares[source]) / np.pi
        digits = code >> 7
        for _ in range(settings.depth):
            digit = digits % 2**bits
            term = term * (spectra[digit - 1] if digit else 1.0)
            digits >>= bits
        total += float(weight) * term
    shift = 0.0 if bands.wavelength_shift is None else bands.wavelength_shift[column]
    return seen_by(bands, grid, total, float(shift))


def seen_by(bands: BandSet, grid: np.ndarray, spectrum: np.ndarray, shift: float = 0.0) -> np.ndarray:
    # Return what bands see of a spectrum: a plain sum over the whole grid for each band
    made = []
    for centre, fwhm, spacing in zip(bands.wavelength, bands.fwhm, bands.spacing, strict=True):
        response = line_shape(
            grid - centre - shift, float(fwhm), float(spacing), bands.shape, grid[1] - grid[0]
        )
        if bands.responsivity is not None:
            response = response * bands.responsivity(grid)
        made.append((response * spectrum).sum() / response.sum())
    return np.array(made)


SERIES_NM = np.arange(400.0, 1001.0, 5.0)


def irradiance_series(samples: int = 3, units: str = "W m-2 nm-1") -> xr.Dataset:
    # Return an irradiance series every 10 s, of levels 1, 2, ..
    level = (1.0 + np.arange(samples))[:, None] * np.ones(SERIES_NM.size)
    times = np.datetime64("2020-06-21T17:00:00", "ns") + 10_000_000_000 * np.arange(samples)
    return xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), level.astype("f4"), {"units": units})},
        {
            "irradiance_time": times,
            "irradiance_wavelength": ("irradiance_wavelength", SERIES_NM, {"units": "nm"}),
        },
    )
