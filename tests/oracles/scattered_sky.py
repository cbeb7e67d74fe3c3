"""Radiance of a clear sky by plain Monte Carlo: molecules and aerosol in plane-parallel layers over ground.

Backward paths from the ground with the sun's contribution at every collision; no polarisation, no gases, no
code of the package. A mixture of layers: molecules with a scale height of 8 km, aerosol with 2 km, whose
phase function is that of Henyey & Greenstein.
"""

from __future__ import annotations

import math
import random
from typing import NamedTuple

import numba
import numpy as np

LAYERS = 40
TOP_KM, MOLECULES_KM, AEROSOL_KM = 40.0, 8.0, 2.0


class Air(NamedTuple):
    # State of the air
    aerosol: float = 0.1  # optical depth at 500 nm
    angstrom: float = 1.14
    asymmetry: float = 0.65
    albedo: float = 0.94
    ground: float = 0.15


def rayleigh_depth(nm: float) -> float:
    um = nm / 1000.0
    return 1.0 / (um**4 * (115.6406 - 1.335 / um**2))


def _layers(nm: float, air: Air) -> tuple[np.ndarray, np.ndarray]:
    # Return optical depths of molecules and aerosol of the layers, from above
    edges = TOP_KM * (1.0 - np.arange(LAYERS + 1) / LAYERS) ** 2

    def share(height: float) -> np.ndarray:
        below = np.exp(-edges / height)
        return np.diff(below) / (below[-1] - below[0])

    aerosol = air.aerosol * (nm / 500.0) ** -air.angstrom
    return rayleigh_depth(nm) * share(MOLECULES_KM), aerosol * share(AEROSOL_KM)


@numba.njit(cache=True)
def _turned(u, v, w, cosine, angle):
    # Return a direction turned by a polar angle's cosine and an azimuth
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    ca, sa = math.cos(angle), math.sin(angle)
    if abs(w) > 0.99999:
        return sine * ca, sine * sa, cosine if w > 0 else -cosine
    s = math.sqrt(1.0 - w * w)
    return (
        sine * (u * w * ca - v * sa) / s + u * cosine,
        sine * (v * w * ca + u * sa) / s + v * cosine,
        -sine * ca * s + w * cosine,
    )


@numba.njit(cache=True)
def _radiance(depths, aerosol_share, g, albedo, ground, sun, view, photons, seed):
    # Return the radiance of one direction for a sun of unit normal irradiance above the air
    random.seed(seed)
    total_depth = depths[-1]
    sx, sz = math.sin(sun), math.cos(sun)
    total = 0.0
    for _path in range(photons):
        u, v, w = view[0], view[1], view[2]
        depth, weight, first = total_depth, 1.0, True
        for _step in range(200):
            # optical depth to the end of the air on this way
            way = depth / w if w > 0.0 else (total_depth - depth) / -w
            if first:
                out = math.exp(-way)
                weight *= 1.0 - out
                free = -math.log(1.0 - random.random() * (1.0 - out))
                first = False
            else:
                free = -math.log(1.0 - random.random())
                if free >= way:
                    if w > 0.0:
                        break
                    weight *= ground
                    depth = total_depth
                    total += weight / math.pi * sz * math.exp(-total_depth / sz)
                    cosine = math.sqrt(random.random())
                    angle = 2.0 * math.pi * random.random()
                    sine = math.sqrt(1.0 - cosine * cosine)
                    u, v, w = sine * math.cos(angle), sine * math.sin(angle), cosine
                    continue
            depth -= free * w
            layer = 0
            while layer < aerosol_share.size - 1 and depths[layer + 1] < depth:
                layer += 1
            by_aerosol = random.random() < aerosol_share[layer]
            # light comes from the sun and goes against the path: the angle between path and sun
            turn = u * sx + w * sz
            if by_aerosol:
                weight *= albedo
                phase = (1.0 - g * g) / (1.0 + g * g - 2.0 * g * turn) ** 1.5
            else:
                phase = 0.75 * (1.0 + turn * turn)
            total += weight * phase / (4.0 * math.pi) * math.exp(-depth / sz)
            if by_aerosol:
                x = (1.0 - g * g) / (1.0 - g + 2.0 * g * random.random())
                cosine = (1.0 + g * g - x * x) / (2.0 * g)
            else:
                q = 4.0 * random.random() - 2.0
                root = (q + math.sqrt(q * q + 1.0)) ** (1.0 / 3.0)
                cosine = root - 1.0 / root
            u, v, w = _turned(u, v, w, cosine, 2.0 * math.pi * random.random())
            if abs(w) < 1e-9:
                w = 1e-9
            if weight < 1e-4:
                break
    return total / photons


class SkyRadiance(NamedTuple):
    # A sky over that of a uniform one of the same level irradiance
    cosine: np.ndarray  # (zenith,) of the zenith angle
    cosine_weight: np.ndarray  # of Gauss's rule, 0 to 1
    azimuth: np.ndarray  # (azimuth,) from the sun, 0 to 180 degrees [rad], evenly
    relative: np.ndarray  # (zenith, azimuth)
    zenith: float  # straight above
    diffuse: float  # level irradiance over the sun's above the air

    def mean(self, values: np.ndarray) -> float:
        # Return the mean of something over the sky, weighted as by level ground
        return float(2.0 * (self.cosine * self.cosine_weight) @ values.mean(axis=1))


def sky_radiance(
    nm: float,
    sun_zenith: float,
    air: Air | None = None,
    *,
    photons: int = 4000,
    zeniths: int = 12,
    azimuths: int = 12,
) -> SkyRadiance:
    # Return the sky at one wavelength [nm] for a sun at a zenith angle [degree]
    air = Air() if air is None else air
    molecules, aerosol = _layers(nm, air)
    depths = np.concatenate([[0.0], np.cumsum(molecules + aerosol)])
    share = aerosol / (molecules + aerosol)
    nodes, weights = np.polynomial.legendre.leggauss(zeniths)
    cosine, weight = 0.5 * (nodes + 1.0), 0.5 * weights
    azimuth = (np.arange(azimuths) + 0.5) / azimuths * np.pi
    fixed = (depths, share, air.asymmetry, air.albedo, air.ground, math.radians(sun_zenith))
    radiance = np.empty((zeniths, azimuths))
    for i, mu in enumerate(cosine):
        sine = math.sqrt(1.0 - mu * mu)
        for j, angle in enumerate(azimuth):
            view = np.array([sine * math.cos(angle), sine * math.sin(angle), mu])
            radiance[i, j] = _radiance(*fixed, view, photons, 1 + i * azimuths + j)
    zenith = _radiance(*fixed, np.array([0.0, 0.0, 1.0]), 20 * photons, 0)
    diffuse = float(2.0 * np.pi * (cosine * weight) @ radiance.mean(axis=1))
    scale = np.pi / diffuse
    return SkyRadiance(cosine, weight, azimuth, radiance * scale, zenith * scale, diffuse)
