"""Downwelling irradiance with spectral structure finer than any instrument here.

The light is a sum of two spectra, direct and diffuse, each with its own factor in time. Their level is that
of `hyperpaint.light.clear_sky`, a table at 1 nm; here it gets lines far narrower than the instruments, as in
nature, so that a mismatch cannot hide behind shared interpolation. The oxygen A and B bands follow from the
rotational constants of O2 (Herzberg 1950), with the sharp band head at its place; water lines and weak solar
lines have random, fixed positions; strong Fraunhofer lines have their true ones. Every cell of 1 nm is scaled
to the mean of the table: to its sunlight, and to the transmittance of ASTM G173 at an air mass of 1.5. At
other air masses absorption lines saturate.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.light.clear_sky import TABLE_AIR_MASS, ClearSky, sunlight_table

#: Spacing of the simulator's wavelength grid [nm]: a third of the narrowest line.
GRID_STEP = 0.05

_LINE_WIDTH = 0.12  # nm, full width of an atmospheric line
_NATURE = 19590  # the same lines in every simulation, whatever its seed

#: Centre [nm], full width [nm], depth of the strong solar lines: Ca K, Ca H, G band, H-gamma, H-beta, Mg b
#: (3), Na D (2), H-alpha.
_FRAUNHOFER = (
    (393.37, 1.20, 0.85), (396.85, 1.00, 0.80), (430.78, 0.90, 0.45), (434.05, 0.30, 0.60),
    (486.13, 0.25, 0.75), (516.73, 0.16, 0.70), (517.27, 0.20, 0.80), (518.36, 0.22, 0.80),
    (588.995, 0.14, 0.85), (589.592, 0.14, 0.80), (656.28, 0.25, 0.78),
)  # fmt: skip

#: Band origin [cm-1], upper rotational constant [cm-1], strength of the oxygen A and B bands.
_OXYGEN = ((13120.9, 1.3912, 3.0), (14525.7, 1.3728, 0.5))
_OXYGEN_GROUND = 1.4377  # cm-1
_SECOND_RADIATION = 1.4388  # hc/k [cm K]

#: Centre [nm], spread [nm], number of lines, mean peak optical depth at one air mass of the water bands.
_WATER = ((592.0, 3.0, 40, 0.15), (650.0, 3.0, 30, 0.08), (723.0, 6.0, 130, 0.35), (820.0, 7.0, 150, 0.30),
          (940.0, 17.0, 420, 0.9), (968.0, 8.0, 90, 0.4))  # fmt: skip


def spectral_grid(first: float, last: float, step: float = GRID_STEP) -> Floats:
    # even wavelength grid [nm] that covers ``first`` to ``last``
    return np.arange(np.floor(first / step), np.ceil(last / step) + 1) * step


@dataclass(frozen=True)
class Sky:
    """A clear sky.

    Attributes
    ----------
    sun_zenith
        Angle between the sun and the vertical [degree].
    aerosol
        Aerosol optical depth at 500 nm.
    ozone
        Ozone column [atm cm].
    water
        Precipitable water relative to that of ASTM G173, 1.416 cm.
    airmass
        Relative optical air mass of the direct path; None for that of a plane-parallel atmosphere,
        1 / cos(sun_zenith), which is 5 % too long at 82 degrees and 11 % at 85.

    Examples
    --------
    >>> wavelength = spectral_grid(500.0, 600.0)
    >>> direct, diffuse = Sky().irradiance(wavelength)
    >>> round(float((direct + diffuse)[1000]), 2)
    1.55
    """

    sun_zenith: float = 25.0
    aerosol: float = 0.10
    ozone: float = 0.31
    water: float = 1.0
    airmass: float | None = None

    def irradiance(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # direct and diffuse irradiance of a level surface [W m-2 nm-1]
        mass = 1.0 / np.cos(np.radians(self.sun_zenith)) if self.airmass is None else self.airmass
        # the tails of wide responses reach beyond the table, whose ends stand for what lies there
        wavelength = wavelength.clip(*sunlight_table().wavelength[[0, -1]])
        sky = ClearSky(self.sun_zenith, self.aerosol, ozone=self.ozone, water=self.water, airmass=float(mass))
        fine = _fine_structure()
        # below its cells, and beyond them, the table itself
        mixed, water = (np.interp(wavelength, fine.wavelength, part) for part in (fine.mixed, fine.water))
        return sky.below(wavelength, solar_irradiance(wavelength), mixed + self.water * water)


def solar_irradiance(wavelength: Floats) -> Floats:
    # Sun's irradiance above the atmosphere, with its lines [W m-2 nm-1].
    table, fine = sunlight_table(), _fine_structure()
    lines = np.interp(wavelength, fine.wavelength, fine.lines)
    return np.asarray(np.interp(wavelength, table.wavelength, table.extraterrestrial) * lines)


# Spectral structure below 1 nm; every part has shape (wavelength,).
class _FineStructure(NamedTuple):
    wavelength: Floats  # steps of `GRID_STEP` where there are lines, those of the table elsewhere
    lines: Floats  # of the sun: a factor whose mean over 1 nm is 1
    mixed: Floats  # optical depth of oxygen for one air mass
    water: Floats  # and of the usual water


_LINED = (300.0, 1100.0)  # nm


@functools.cache
def _fine_structure() -> _FineStructure:
    table = sunlight_table()
    per_cell = round(1.0 / GRID_STEP)
    first, last = _LINED
    # cells reach half a step of the table to both sides of its wavelengths
    nm: Floats = first - 0.5 + GRID_STEP * np.arange(round((last - first + 1.0) * per_cell), dtype=np.float64)
    rng = np.random.default_rng([_NATURE, 2])  # weak lines of metals, dense in the blue
    centres = 340.0 + rng.exponential(110.0, 2500)
    solar = np.exp(-_sum_of_lines(nm, centres, rng.exponential(0.06, 2500), 0.12))
    for centre, width, depth in _FRAUNHOFER:
        solar *= 1.0 - depth * np.exp(-4 * np.log(2) * ((nm - centre) / width) ** 2)
    half = per_cell // 2
    means = np.convolve(np.pad(solar, half, mode="edge"), np.full(per_cell, 1.0 / per_cell), "same")
    cells = np.searchsorted(table.wavelength, np.arange(first, last + 1.0))
    beyond = table.wavelength > last + 1.0

    def scaled(lines: Floats, depths: Floats) -> Floats:
        # Optical depths whose mean transmittance in every cell equals that of the table. ``lines`` says how
        # the depth is spread; a tenth of its mean is a continuum, so that there is an answer where a cell has
        # no line. Transmittances are those at the air mass of the table. Bisection.
        lines, depth = lines.reshape(-1, per_cell), depths[cells]
        shape = lines + 0.1 * lines.mean(axis=1, keepdims=True) + 1e-6
        target = np.exp(-TABLE_AIR_MASS * depth)
        low, high = np.zeros(depth.shape), np.full(depth.shape, 1e9)
        for _ in range(100):
            middle = np.where(high < 1e8, 0.5 * (low + high), np.maximum(4.0 * low, 1e-3))
            left = np.exp(-TABLE_AIR_MASS * middle[:, None] * shape).mean(axis=1)
            low, high = np.where(left > target, middle, low), np.where(left > target, high, middle)
        inside = np.where(depth[:, None] > 0.0, low[:, None] * shape, 0.0).ravel()
        return np.append(inside, depths[beyond])

    rng = np.random.default_rng([_NATURE, 1])
    water = np.zeros_like(nm)
    for centre, spread, number, depth in _WATER:
        centres = rng.normal(centre, spread, number)
        water += _sum_of_lines(nm, centres, rng.exponential(depth, number), _LINE_WIDTH)
    return _FineStructure(
        wavelength=np.append(nm, table.wavelength[beyond]),
        lines=np.append(solar / means[half:-half], np.ones(beyond.sum())),
        mixed=scaled(_oxygen(nm), table.mixed),
        water=scaled(water, table.water),
    )


def _sum_of_lines(wavelength: Floats, centres: Floats, depths: Floats, width: float) -> Floats:
    # Gaussian absorption lines; each affects only its neighbourhood.
    total = np.zeros_like(wavelength)
    starts = np.searchsorted(wavelength, centres - 4 * width)
    stops = np.searchsorted(wavelength, centres + 4 * width)
    for centre, depth, start, stop in zip(centres, depths, starts, stops, strict=True):
        total[start:stop] += depth * np.exp(-4 * np.log(2) * ((wavelength[start:stop] - centre) / width) ** 2)
    return total


def _oxygen(wavelength: Floats) -> Floats:
    # Optical depth at one air mass. Lines stand at nu0 + (B' + B'') m + (B' - B'') m^2, with m = J + 1 in the
    # R branch, which turns back into the band head, and m = -J in the P branch; J odd; each a doublet 2 cm-1
    # apart. Strengths follow the Boltzmann factor of the lower level at 270 K.
    odd = np.arange(1, 42, 2)
    population = (2 * odd + 1) * np.exp(-_SECOND_RADIATION / 270.0 * _OXYGEN_GROUND * odd * (odd + 1))
    population /= population.max()
    total = np.zeros_like(wavelength)
    for origin, upper, strength in _OXYGEN:
        for m in (odd + 1.0, -1.0 * odd):
            wavenumber = origin + (upper + _OXYGEN_GROUND) * m + (upper - _OXYGEN_GROUND) * m**2
            for split in (0.0, -2.0):
                centres = 1e7 / (wavenumber + split) / 1.000275  # in air
                total += _sum_of_lines(wavelength, centres, 0.5 * strength * population, _LINE_WIDTH)
    return total


# Change of the direct and the diffuse light during the flight
@dataclass(frozen=True)
class Light:
    # relative change of the direct light in a minute; the diffuse light changes half as much the other way,
    # so that the colour of the light changes too
    drift_per_minute: float = 0.0
    # fraction of the direct light that a cloud takes, time its edge needs to pass [s], and when it starts [s
    # after the first line]; None for a clear sky. A third of what is lost returns as diffuse light.
    cloud: tuple[float, float, float] | None = None

    def factors(self, seconds: Floats) -> Floats:
        # factors of direct and diffuse light ``seconds`` after the first line, shape (2, time)
        minutes = np.asarray(seconds, dtype=np.float64) / 60.0
        direct = 1.0 + self.drift_per_minute * minutes
        diffuse = 1.0 - 0.5 * self.drift_per_minute * minutes
        if self.cloud is not None:
            fraction, duration, start = self.cloud
            passed = np.clip((minutes * 60.0 - start) / duration, 0.0, 1.0)
            diffuse = diffuse + fraction * passed / 3.0
            direct = direct * (1.0 - fraction * passed)
        return np.stack([direct, diffuse])

    def mean_factors(self, start: Floats, stop: Floats, points: int = 32) -> Floats:
        # `factors` averaged from ``start`` to ``stop`` [s], by the midpoint rule
        times = start[:, None] + (stop - start)[:, None] * ((np.arange(points) + 0.5) / points)
        return np.asarray(self.factors(times.ravel()).reshape(2, len(start), points).mean(axis=2))
