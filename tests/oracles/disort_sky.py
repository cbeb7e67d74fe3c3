"""Radiance of a clear sky from the package's tables, by cubic splines of scipy.

Only the file is shared with the package. Splines are global, through all nodes; single scattering and the
mean of the sky are written out anew.
"""

import functools
from importlib import resources
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline

ALBEDO, ASYMMETRY = 0.93, 0.65


@functools.cache
def tables() -> dict[str, np.ndarray]:
    with resources.files("hyperpaint.light").joinpath("clear_sky.npz").open("rb") as file:
        arrays = np.load(file)
        return {name: arrays[name].astype(np.float64) for name in arrays.files}


def air_mass(sun: float) -> float:
    return 1.0 / (np.cos(np.radians(sun)) + 0.50572 * (96.07995 - sun) ** -1.6364)


@functools.lru_cache(maxsize=16)
def under(name: str, sun: float) -> CubicSpline:
    # Return a table (rayleigh, aerosol[, sun, ...]) under a sun, as a spline of aerosol
    data = tables()
    values = data[name]
    if name in ("diffuse_rural", "radiance_rural"):
        values = CubicSpline(data["sun"], values, axis=2)(sun)
    return CubicSpline(np.sqrt(data["aerosol"]), values, axis=1)


def at(name: str, air: float, aerosol: float, sun: float) -> np.ndarray:
    # Return a table at optical depths under a sun
    values = under(name, sun)(np.sqrt(aerosol))
    return np.asarray(CubicSpline(-np.log(tables()["rayleigh"]), values, axis=0)(-np.log(air)))


@functools.lru_cache(maxsize=64)
def scattered(nm: float, sun: float, aerosol: float) -> tuple[Any, ...]:
    # Return depths of air and aerosol, irradiances, the spline of scattering, albedo and glow of the ground
    data = tables()
    air = float(np.exp(CubicSpline(np.log(data["path_wavelength"]), np.log(data["rayleigh"]))(np.log(nm))))
    particles = aerosol * (nm / 500.0) ** -1.14
    m = air_mass(sun)
    direct = np.exp(-(air + particles) * m)
    diffuse = np.exp(at("diffuse_rural", air, particles, sun)) * -np.expm1(-m * (air / 2 + 0.7 * particles))
    spline = RectBivariateSpline(
        data["zenith"], data["azimuth"], at("radiance_rural", air, particles, sun) / 5000.0
    )
    albedo = float(at("spherical_albedo_rural", air, particles, sun))
    glow = CubicSpline(data["zenith"], at("ground_to_sky", air, particles, sun))
    return air, particles, direct, diffuse, spline, albedo, glow


def relative_sky(
    nm: float, sun: float, cosine: np.ndarray, azimuth: np.ndarray, aerosol: float = 0.1, ground: float = 0.2
) -> np.ndarray:
    """Return the sky over a uniform one of the same irradiance; azimuths are from the sun [rad]."""
    air, particles, direct, diffuse, spline, albedo, glow = scattered(float(nm), float(sun), float(aerosol))
    m, level, depth = air_mass(sun), np.cos(np.radians(sun)), air + particles
    # once scattered, with the phase functions of Rayleigh (depolarisation 0.0279) and Henyey-Greenstein
    cosine, azimuth = np.broadcast_arrays(cosine, azimuth)
    t = cosine * level + np.sqrt(1.0 - cosine**2) * np.sqrt(1.0 - level**2) * np.cos(azimuth)
    rayleigh = 3.0 / (4.0 + 2.0 * 0.0279) * (1.0279 + 0.9721 * t**2)
    around = (1.0 - ASYMMETRY**2) / (1.0 + ASYMMETRY**2 - 2.0 * ASYMMETRY * t) ** 1.5
    once = (air * rayleigh + ALBEDO * particles * around) / (4.0 * np.pi) / cosine
    path = depth * (1.0 / cosine - m)
    once = (
        once * np.exp(-depth * m) * np.where(path == 0.0, 1.0, -np.expm1(-path) / np.where(path, path, 1.0))
    )
    zenith = np.degrees(np.arccos(cosine)).clip(0.0, 89.0)
    turned = np.degrees(np.arccos(np.cos(azimuth)))
    radiance = np.exp(spline(zenith, turned, grid=False)) * (once + level * diffuse / np.pi)
    radiance = radiance + ground * level * (direct + diffuse) / (1.0 - ground * albedo) * glow(zenith)
    whole = diffuse + (direct + diffuse) * ground * albedo / (1.0 - ground * albedo)
    return np.asarray(radiance * np.pi / (level * whole))
