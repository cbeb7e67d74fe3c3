"""Light of the sky, with spectral structure finer than any instrument here, clouds, and haze.

The light is a sum of two spectra, direct and diffuse, each with its own factor in time. Their level is that
of the tables of `hyperpaint.light.clear_sky`, read here by other interpolation; here are lines far narrower
than the instruments, as in nature, so that a mismatch cannot hide behind shared interpolation. The oxygen A
and B bands follow from the rotational constants of O2 (Herzberg 1950), with the sharp band head at its place;
water lines and weak solar lines have random, fixed positions; strong Fraunhofer lines have their true ones.
Every cell of 1 nm is scaled to the mean of the tables: to its sunlight, and to the transmittance of direct
and of diffuse light at the sun's zenith angle.

Clouds over a clear sky, and the air before the camera:

*Broken clouds* over a scene: their shadows move over the ground, so that light varies over swath and time.
The ground is in shadow where a Gaussian random field, which moves with the wind, exceeds a threshold. The
field is a sum of plane waves with random directions and phases (M. Shinozuka, J. Sound Vib. 25, 111, 1972):
it is defined at every position and time without a grid, and does not depend on the order of evaluation.

*Amount*: Kasten & Czeplak (Solar Energy 24, 1980) found in ten years at Hamburg that N oktas of cloud leave
``1 - 0.75 (N/8)^3.4`` of the clear sky's global irradiance. The direct beam is taken to be hidden for N/8 of
the time; the rest of the remaining light is diffuse.

*Colour*: Bartlett, Ciotti, Davis & Cullen (J. Geophys. Res. 103, 31017, 1998) fitted the ratio of cloudy to
clear irradiance over 412-700 nm with ``CF (a(CF) + b(CF) (lambda/490)^-4)``, where the cloud factor CF is the
ratio at 490 nm: overcast light is slightly bluer. Their coefficients are known here from a secondary source
only (a = 0.76 + 0.24 CF, b = 0.24 (1 - CF)), so that they are an argument. Limits: CF is the broadband factor
of Kasten & Czeplak; beyond 700 nm the form is extrapolated; the deeper bands of water and oxygen, from longer
paths in clouds, are neglected; the same authors measured skies (Bering Sea) that differ from it.

*Direction*: the clear sky is `hyperpaint.light.sky_functions`; between clear and overcast both are weighted
by the part of the sky without and with clouds. The CIE overcast sky (Moon & Spencer 1942), L = L_zenith (1 +
2 cos theta) / 3, is a sum of a uniform sky and one whose radiance goes with cos theta. On a level surface the
first gives pi L_z / 3 and the second 4 pi L_z / 9: shares of 3/7 and 4/7 of the diffuse irradiance.

*Air*: extinction and path radiance of the air between a surface and the camera, per metre. Extinction is the
sum of air molecules and haze; at the visibility V a black object has 2 % of its contrast: ``k(550 nm) = 3.912
/ V`` (Koschmieder 1924). Light scattered into a short vertical path comes from the sun, from the sky and from
the ground; per metre it is ``k_s`` times the source function

    J = E_sun P(Theta) / (4 pi) + beta E_sky / pi + (1 - beta) r E / pi

with the scattering angle ``Theta = 180 deg - sun zenith`` of a camera that looks straight down, the phase
function ``P`` (Rayleigh's; Henyey & Greenstein 1941 for haze), the share ``beta`` of light that is scattered
into the back hemisphere, and the reflectance ``r`` of the surroundings. Over a white ground without a sun and
without absorption, J is the radiance of the sky, and a path changes nothing.

*Four curves*: the light on a scene, and the air before the camera, are four spectra. They are those of
DIRSIG5's FourCurveAtmosphere: sunlight and skylight at the ground, extinction and path radiance per metre.
Their sources are the sky of the simulator, SPECTRL2, a spectrometer, or tables of MODTRAN or libRadtran.
"""

import functools
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline, RectBivariateSpline, RegularGridInterpolator, interp1d

from hyperpaint.base import (
    ArrayLike,
    Fact,
    Floats,
    Problems,
    SchemaError,
    check_fields,
    check_values,
    convert,
    declared,
    fact,
    one_of,
    require,
    warn_if,
    warn_user,
)
from hyperpaint.light.sky_functions import FUNCTIONS, clear_sky_shares, fit_sky
from hyperpaint.simulation.settings import moment_of

from .settings import MAX_SEED

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

    Examples
    --------
    >>> wavelength = spectral_grid(500.0, 600.0)
    >>> direct, diffuse = Sky().irradiance(wavelength)
    >>> round(float((direct + diffuse)[1000]), 2)
    1.54
    """

    sun_zenith: float = 25.0
    aerosol: float = 0.10
    ozone: float = 0.31
    water: float = 1.0

    def irradiance(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # direct and diffuse irradiance of a level surface [W m-2 nm-1]
        table, data = _sunlight(), _data()
        # the tails of wide responses reach beyond the table, whose ends stand for what lies there
        wavelength = wavelength.clip(*table["wavelength_nm"][[0, -1]])
        mass, cosine = relative_air_mass(self.sun_zenith), np.cos(np.radians(self.sun_zenith))
        # scattering, smooth in wavelength; outside 330 to 1150 nm the quotients of the tables are held
        nm = np.concatenate([np.arange(300.0, 1200.0, 5.0), np.arange(1200.0, 2501.0, 50.0)])
        log_air = CubicSpline(np.log(data["path_wavelength"]), np.log(data["rayleigh"]))(np.log(nm))
        air, particles = np.exp(log_air), self.aerosol * (nm / 500.0) ** -_ANGSTROM
        held_air = -log_air.clip(*np.log(data["rayleigh"])[[-1, 0]])
        held_particles = np.sqrt(particles.clip(0.0, data["aerosol"][-1]))
        diffuse_spline, albedo_spline = _splines()
        sun = np.full(nm.shape, min(self.sun_zenith, data["sun"][-1]))
        quotient = np.exp(diffuse_spline(np.stack([held_air, held_particles, sun], axis=-1)))
        direct = np.exp(-(air + particles) * mass)
        diffuse = -quotient * np.expm1(-mass * (0.5 * air + 0.7 * particles))
        returned = _GROUND * albedo_spline(held_air, held_particles, grid=False)
        diffuse += (direct + diffuse) * returned / (1.0 - returned)
        # gases: smooth ones at 1 nm, oxygen and water by lines
        light = solar_irradiance(wavelength) * cosine
        depths = self._gas_depths(mass)
        parts = [
            light * CubicSpline(nm, scattered)(wavelength) * np.exp(-_resolved(wavelength, *depth))
            for scattered, depth in zip((direct, diffuse), depths, strict=True)
        ]
        return parts[0], parts[1]

    def _gas_depths(self, mass: float) -> tuple[tuple[Floats, Floats, Floats], ...]:
        # slant depths of smooth gases, oxygen and water in the cells of the table of sunlight, of both lights
        table, data = _sunlight(), _data()
        cells = table["wavelength_nm"]
        logs = [np.log(data[name]) for name in ("mass", "water")]
        inside = (cells >= data["line"][0]) & (cells <= data["line"][-1])
        in_cells = {
            name: interp1d(data["line"], data[name], axis=0, bounds_error=False, fill_value=0.0)(cells)
            for name in ("oxygen_depth", "water_depth", "ozone", "continuum")
        }

        def slant(name: str, mass: Floats) -> Floats:
            # linear in the logarithms of depth, air mass and water; in proportion outside the tables
            depth = np.log(np.maximum(in_cells[name], 1e-9))
            if name == "water_depth":
                log_water = np.log(max(self.water, 1e-3) * _USUAL_WATER)
                depth = interp1d(logs[1], depth, axis=2)(np.clip(log_water, *logs[1][[0, -1]]))
                depth += min(0.0, log_water - logs[1][0])
            at_mass = np.log(mass.clip(1.0, data["mass"][-1]))
            rows = [np.interp(at, logs[0], row) for at, row in zip(at_mass, depth, strict=True)]
            beyond = table["water"] * self.water if name == "water_depth" else table["mixed"]
            return np.where(inside, np.exp(rows) * np.minimum(mass, 1.0), beyond * mass)

        particles = self.aerosol * (cells / 500.0) ** -_ANGSTROM
        axes = (
            np.log(data["path_depth"]),
            np.log(data["path_wavelength"]),
            np.sqrt(data["path_aerosol"]),
            data["path_sun"],
        )

        def diffuse_mass(gas: int, vertical: Floats) -> Floats:
            # air mass of the diffuse light for a gas of a vertical depth
            depth = np.log((0.5 * np.maximum(vertical, 1e-6) ** 0.65).clip(0.05, 1.0))
            place = np.broadcast_arrays(depth, np.log(cells), np.sqrt(particles), self.sun_zenith)
            held = [at.clip(axis[0], axis[-1]) for at, axis in zip(place, axes, strict=True)]
            return np.asarray(
                RegularGridInterpolator(axes, data["diffuse_air_mass"][gas])(np.stack(held, axis=-1))
            )

        ozone = np.where(inside, in_cells["ozone"], table["ozone"]) * self.ozone
        ones, none = np.ones(cells.shape), np.zeros(cells.shape)
        height = 22.0 / 6370.0
        ozone_path = (1.0 + height) / np.sqrt(np.cos(np.radians(self.sun_zenith)) ** 2 + 2.0 * height)
        direct = (
            ozone * ozone_path + in_cells["continuum"] * mass,
            slant("oxygen_depth", mass * ones),
            slant("water_depth", mass * ones),
        )
        diffuse = (
            ozone * diffuse_mass(2, none) + in_cells["continuum"] * diffuse_mass(0, none),
            slant("oxygen_depth", diffuse_mass(0, slant("oxygen_depth", ones))),
            slant("water_depth", diffuse_mass(1, slant("water_depth", ones))),
        )
        return direct, diffuse


#: Exponent of the aerosol, reflectance of the surroundings, and water of ASTM G173 [cm].
_ANGSTROM, _GROUND, _USUAL_WATER = 1.14, 0.2, 1.416


@functools.cache
def _data() -> dict[str, Floats]:
    # tables of DISORT and of gases, see `hyperpaint.light.clear_sky`; read here by splines of scipy, so that
    # an error of the chain's interpolation shows
    with resources.files("hyperpaint.light").joinpath("clear_sky.npz").open("rb") as file:
        arrays = np.load(file)
        return {name: arrays[name].astype(np.float64) for name in arrays.files}


@functools.cache
def _sunlight() -> dict[str, Floats]:
    # the columns of the table by their names, see `hyperpaint.light.clear_sky.SunlightTable`
    with resources.files("hyperpaint.light").joinpath("sunlight_1nm.csv").open(encoding="utf-8") as file:
        header, *rows = (line for line in file if not line.startswith("#"))
    return dict(zip(header.rstrip().split(","), np.loadtxt(rows, delimiter=",", unpack=True), strict=True))


@functools.cache
def _splines() -> tuple[RegularGridInterpolator, RectBivariateSpline]:
    # splines of the quotient of diffuse light, and of spherical albedo
    data = _data()
    axes = -np.log(data["rayleigh"]), np.sqrt(data["aerosol"]), data["sun"]
    return (
        RegularGridInterpolator(axes, data["diffuse_rural"], "cubic"),
        RectBivariateSpline(*axes[:2], data["spherical_albedo_rural"]),
    )


def solar_irradiance(wavelength: Floats) -> Floats:
    # Sun's irradiance above the atmosphere, with its lines [W m-2 nm-1].
    table, fine = _sunlight(), _fine_structure()
    lines = np.interp(wavelength, fine.wavelength, fine.lines)
    return np.asarray(np.interp(wavelength, table["wavelength_nm"], table["extraterrestrial"]) * lines)


# Spectral structure below 1 nm.
class _FineStructure(NamedTuple):
    wavelength: Floats  # (wavelength,): steps of `GRID_STEP` where there are lines
    lines: Floats  # (wavelength,) of the sun: a factor whose mean over 1 nm is 1
    oxygen: Floats  # (cell, point): how the depth of a cell is spread, mean 1
    water: Floats  # (cell, point)


_LINED = (300.0, 1100.0)  # nm


@functools.cache
def _fine_structure() -> _FineStructure:
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

    def spread(lines: Floats) -> Floats:
        # a tenth of the mean is a continuum, so that there is an answer where a cell has no line
        cells = lines.reshape(-1, per_cell)
        shape = cells + 0.1 * cells.mean(axis=1, keepdims=True) + 1e-6
        return np.asarray(shape / shape.mean(axis=1, keepdims=True))

    rng = np.random.default_rng([_NATURE, 1])
    water = np.zeros_like(nm)
    for centre, width, number, depth in _WATER:
        centres = rng.normal(centre, width, number)
        water += _sum_of_lines(nm, centres, rng.exponential(depth, number), _LINE_WIDTH)
    # Lines of oxygen stand at nu0 + (B' + B'') m + (B' - B'') m^2, with m = J + 1 in the R branch, which
    # turns back into the band head, and m = -J in the P branch; J odd; each a doublet 2 cm-1 apart. Strengths
    # follow the Boltzmann factor of the lower level at 270 K.
    odd = np.arange(1, 42, 2)
    population = (2 * odd + 1) * np.exp(-_SECOND_RADIATION / 270.0 * _OXYGEN_GROUND * odd * (odd + 1))
    population /= population.max()
    oxygen = np.zeros_like(nm)
    for origin, upper, strength in _OXYGEN:
        for m in (odd + 1.0, -1.0 * odd):
            wavenumber = origin + (upper + _OXYGEN_GROUND) * m + (upper - _OXYGEN_GROUND) * m**2
            for split in (0.0, -2.0):
                centres = 1e7 / (wavenumber + split) / 1.000275  # in air
                oxygen += _sum_of_lines(nm, centres, 0.5 * strength * population, _LINE_WIDTH)
    return _FineStructure(nm, solar / means[half:-half], spread(oxygen), spread(water))


def _resolved(wavelength: Floats, smooth: Floats, oxygen: Floats, water: Floats) -> Floats:
    # Return the optical depth of all gases, with their lines.
    #
    # Depths are those of the cells of the table of sunlight. Lines are scaled so that the mean transmittance
    # of a cell of 1 nm is that of its depth; outside their range the table stands for them.
    table, fine = _sunlight(), _fine_structure()
    centres = np.arange(_LINED[0], _LINED[1] + 1.0)
    total = np.interp(wavelength, table["wavelength_nm"], smooth)
    is_lined = (wavelength >= fine.wavelength[0]) & (wavelength <= fine.wavelength[-1])
    for shape, depth in ((fine.oxygen, oxygen), (fine.water, water)):
        cells = np.interp(centres, table["wavelength_nm"], depth)
        low, high = cells.copy(), np.full(cells.shape, 1e9)  # the mean depth is at least that of the mean
        for _ in range(80):
            middle = np.where(high < 1e8, 0.5 * (low + high), 4.0 * low)
            is_shallow = np.exp(-middle[:, None] * shape).mean(axis=1) > np.exp(-cells)
            low, high = np.where(is_shallow, middle, low), np.where(is_shallow, high, middle)
        lines = np.interp(wavelength, fine.wavelength, (low[:, None] * shape).ravel())
        total += np.where(is_lined, lines, np.interp(wavelength, table["wavelength_nm"], depth))
    return total


def _sum_of_lines(wavelength: Floats, centres: Floats, depths: Floats, width: float) -> Floats:
    # Gaussian absorption lines; each affects only its neighbourhood.
    total = np.zeros_like(wavelength)
    starts = np.searchsorted(wavelength, centres - 4 * width)
    for centre, depth, start, stop in zip(
        centres, depths, starts, np.searchsorted(wavelength, centres + 4 * width), strict=True
    ):
        total[start:stop] += depth * np.exp(-4 * np.log(2) * ((wavelength[start:stop] - centre) / width) ** 2)
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


# --- clouds, haze and the shares of skylight ----------------------------------------------------------------


#: Facts of numbers that describe a sky; ``key`` is the spelling in ``[[atmospheres]]`` of a ``scene.toml``.
SKY = {
    entry.name: entry
    for entry in (
        Fact(
            name="direct_fraction", kind="number", least=0.0, most=1.0,
            doc="share of direct light in the irradiance; for irradiance that a spectrometer measured",
        ),
        Fact(
            name="sun_zenith", key="sun_zenith_deg", kind="number", unit="degree", scale=1.0, least=0.0,
            most=89.0, doc="angle between the sun and the vertical",
        ),
        Fact(
            name="sun_azimuth", key="sun_azimuth_deg", kind="number", unit="degree", scale=1.0, least=-360.0,
            most=360.0, doc="direction of the sun, clockwise from north",
        ),
        Fact(
            name="aerosol", kind="number", least=0.0, most=10.0,
            doc="aerosol optical depth of a clear sky at 500 nm",
        ),
        Fact(
            name="water", kind="number", least=0.0, most=100.0,
            doc="precipitable water vapour of a clear sky, divided by the value of a usual summer day",
        ),
        Fact(
            name="oktas", kind="number", scale=1.0, least=0.0, most=8.0,
            doc="cloud cover in eighths of the sky",
        ),
        Fact(
            name="overcast_share", kind="number", least=0.0, most=1.0,
            doc="share of skylight whose radiance goes with the cosine of the zenith angle",
        ),
    )
}  # fmt: skip


def check_wavelengths(wavelength: Floats) -> None:
    # Raise unless wavelengths are a positive, increasing grid.
    #
    # Raises `SchemaError`: The grid has not one dim and two samples, or they are not positive, finite and
    # increasing.
    SchemaError.raise_if(
        wavelength.ndim != 1 or wavelength.size < 2,
        f"wavelength has shape {wavelength.shape}",
        expected="one dim and at least 2 samples",
        code="dims-wrong",
    )
    SchemaError.raise_if(
        not (np.isfinite(wavelength).all() and wavelength[0] > 0.0 and (np.diff(wavelength) > 0.0).all()),
        "wavelength is not positive, finite and increasing",
        mend="sort it and drop duplicates",
        code="wavelength-unordered",
    )


def built_in_sky(
    wavelength: Floats, sun_zenith: float, *, aerosol: float = 0.10, ozone: float = 0.31, water: float = 1.0
) -> tuple[Floats, Floats]:
    # Return direct normal and diffuse level irradiance of the simulator's own sky [W m-2 nm-1].
    #
    # The model of `Sky` at increasing wavelengths [nm]; all else as there.
    #
    # Raises `SchemaError`: A number is outside its range in `SKY`, or the wavelengths are no grid.
    check_wavelengths(wavelength)
    with Problems("the light of the sky cannot be computed", SchemaError) as problems:
        check_values(SKY, {"sun_zenith": sun_zenith, "aerosol": aerosol, "water": water}, problems)
    direct, diffuse = Sky(sun_zenith=sun_zenith, aerosol=aerosol, ozone=ozone, water=water).irradiance(
        wavelength
    )
    # Sky gives the direct light of a level surface
    return direct / np.cos(np.radians(sun_zenith)), diffuse


def relative_air_mass(sun_zenith: float) -> float:
    """Return the relative optical air mass of Kasten & Young (Applied Optics 28, 4735, 1989).

    Parameters
    ----------
    sun_zenith
        Apparent zenith angle, 0 to 90 [degree].

    Examples
    --------
    >>> round(relative_air_mass(85.0), 2), round(float(1.0 / np.cos(np.radians(85.0))), 2)
    (10.31, 11.47)
    """
    return float(1.0 / (np.cos(np.radians(sun_zenith)) + 0.50572 * (96.07995 - sun_zenith) ** -1.6364))


def clear_spread(
    wavelength: Floats, sun: Floats, sun_zenith: float, overcast_share: float = 0.0, aerosol: float = 0.1
) -> dict[str, Any]:
    # shares of the clear-sky functions in the diffuse irradiance by name, see `Atmosphere`.
    # Without direct light (``sun`` [W m-2 nm-1]) they are 0; an ``overcast_share`` reduces them.
    clear = max(0.0, 1.0 - overcast_share / CIE_OVERCAST_SHARE) if np.any(sun) else 0.0
    return {"clear_shares": clear * clear_sky_shares(wavelength, sun_zenith, aerosol)[1:]}


#: Share of the cosine part in the diffuse irradiance of a CIE overcast sky.
CIE_OVERCAST_SHARE = 4.0 / 7.0

_CLOUD_REFERENCE_NM = 490.0


def cloud_factor(oktas: float) -> float:
    """Return the part of a clear sky's global irradiance that remains under ``oktas`` eighths of cloud.

    Parameters
    ----------
    oktas
        Cloud amount, 0 to 8.

    Examples
    --------
    >>> cloud_factor(8)
    0.25
    """
    return float(1.0 - 0.75 * (oktas / 8.0) ** 3.4)


_COLOUR = Fact(name="colour", kind="number", least=0.0, most=1.0, doc="strength of the blue tint")


def cloud_transmittance(wavelength: Floats, oktas: float, *, colour: float = 0.24) -> Floats:
    """Return global irradiance under clouds over that of the clear sky.

    Parameters
    ----------
    wavelength
        Any shape [nm].
    oktas
        Cloud amount, 0 to 8.
    colour
        Strength of the blue tint, 0 to 1: b = colour (1 - CF) and a = 1 - b; 0 for grey clouds.

    Returns
    -------
    numpy.ndarray
        Shape of ``wavelength`` [1].

    Raises
    ------
    SchemaError
        ``oktas`` or ``colour`` is outside its range; both are listed.

    Examples
    --------
    >>> cloud_transmittance(np.array([400.0, 490.0, 700.0, 1000.0]), 8).round(3)
    array([0.306, 0.25 , 0.216, 0.208])
    """
    with Problems("clouds cannot be made", SchemaError) as problems:
        check_values(SKY | {"colour": _COLOUR}, {"oktas": oktas, "colour": colour}, problems)
    factor = cloud_factor(oktas)
    tint = colour * (1.0 - factor)
    return np.asarray(factor * (1.0 - tint + tint * (wavelength / _CLOUD_REFERENCE_NM) ** -4.0))


_CONTRAST = 3.912  # -ln 0.02
_HAZE_REFERENCE_NM = 550.0
_MOLECULES = 1.162e-5  # m-1, scattering of air at 550 nm, 1013 hPa and 15 degC (Bucholtz 1995)
_MOLECULES_EXPONENT = -4.08


@declared
@dataclass(frozen=True)
class Haze:
    """Air near the ground.

    Raises
    ------
    SchemaError
        An attribute is outside its range; all are listed.

    Examples
    --------
    >>> extinction = Haze().extinction(np.array([450.0, 550.0, 850.0]))
    >>> (1e4 * extinction).round(2)  # per 10 km
    array([2.32, 1.7 , 0.92])
    """

    visibility: float = fact(
        23_000.0,
        "distance at which 2 % of a contrast are left at 550 nm, at most that of pure air",
        unit="m",
        least=0.0,
        above=True,
        most=_CONTRAST / _MOLECULES,
    )
    angstrom: float = fact(
        1.3, "exponent of the wavelength in the extinction of the haze", least=0.0, most=4.0
    )
    asymmetry: float = fact(
        0.65, "mean cosine of the scattering angle", least=-1.0, above=True, most=1.0, below=True
    )
    scattering_albedo: float = fact(0.95, "share of the extinction that is scattering", least=0.0, most=1.0)
    ground: float = fact(0.15, "reflectance of the surroundings at all wavelengths", least=0.0, most=1.0)

    def __post_init__(self) -> None:
        with Problems("haze cannot be made", SchemaError) as problems:
            check_fields(self, problems)

    def _coefficients(self, wavelength: Floats) -> tuple[Floats, Floats]:
        relative = wavelength / _HAZE_REFERENCE_NM
        molecules = _MOLECULES * relative**_MOLECULES_EXPONENT
        return molecules, (_CONTRAST / self.visibility - _MOLECULES) * relative**-self.angstrom

    def extinction(self, wavelength: Floats) -> Floats:
        # Return the extinction coefficient at ``wavelength`` [nm], same shape [m-1].
        return np.add(*self._coefficients(wavelength))

    def path_radiance(self, wavelength: Floats, sun: Floats, sky: Floats, sun_zenith: float) -> Floats:
        # Return the radiance that a short vertical path adds, per metre [W m-2 sr-1 nm-1 m-1].
        #
        # ``wavelength``: Shape (wavelength,) [nm]. ``sun``, ``sky``: Direct normal and diffuse horizontal
        # irradiance, shape (wavelength,) [W m-2 nm-1]. ``sun_zenith``: Angle between the sun and the vertical
        # [degree].
        cosine = np.cos(np.radians(sun_zenith))
        reflected = self.ground * (sun * cosine + sky)
        molecules, particles = self._coefficients(wavelength)

        def source(phase: float, backward: float) -> Floats:
            diffuse = (backward * sky + (1.0 - backward) * reflected) / np.pi
            return np.asarray(sun * phase / (4.0 * np.pi) + diffuse)

        # share of Henyey-Greenstein scattering beyond 90 degrees; the formula is 0/0 for g = 0
        g = self.asymmetry
        backward_share = (
            (1.0 - g) / (2.0 * g) * ((1.0 + g) / float(np.sqrt(1.0 + g**2)) - 1.0) if abs(g) >= 1e-6 else 0.5
        )
        # the sun's light comes down and leaves upwards: the cosine of the scattering angle is -cos(zenith)
        rayleigh = 0.75 * (1.0 + cosine**2)
        henyey_greenstein = float((1.0 - g**2) / (1.0 + g**2 + 2.0 * g * cosine) ** 1.5)
        scattered = self.scattering_albedo * particles * source(henyey_greenstein, backward_share)
        return np.asarray(molecules * source(rayleigh, 0.5) + scattered)


#: Usual clear air: a visibility of 23 km.
HAZE = Haze()


_WAVES = 64
#: Share of the direct light blocked by clouds that becomes diffuse light everywhere.
_SCATTERED_SHARE = 1.0 / 3.0


@declared
@dataclass(frozen=True)
class BrokenClouds:
    """Shadows of broken clouds.

    Raises
    ------
    SchemaError
        Attributes are out of range; all are listed.

    Examples
    --------
    >>> clouds = BrokenClouds(cover=0.4, size=30.0)
    >>> direct, diffuse = clouds.factors(np.array([0.0, 40.0, 80.0]), 0.0, 0.0)
    >>> bool((direct >= 1.0 - clouds.opacity).all()), bool((direct <= 1.0).all())
    (True, True)
    """

    cover: float = fact(0.4, "share of the ground in shadow", least=0.0, most=1.0)
    size: float = fact(
        200.0,
        "distance over which the random field of the clouds loses its correlation",
        unit="m",
        least=0.0,
        above=True,
        most=1e6,
    )
    speed: float = fact(8.0, "speed of the shadows", unit="m s-1", least=0.0, most=1e3)
    heading: float = fact(90.0, "direction of the shadows, clockwise from north", unit="degree")
    opacity: float = fact(0.8, "share of the direct light that a cloud takes", least=0.0, most=1.0)
    edge: float = fact(
        0.05, "width of the edge of a shadow relative to ``size``", least=0.0, above=True, most=10.0
    )
    station: tuple[float, float] = fact(
        (0.0, 0.0), "east and north of the spectrometer that records the irradiance", unit="m", length=2
    )
    seed: int = fact(0, "chooses the clouds", least=0, most=MAX_SEED)

    def __post_init__(self) -> None:
        with Problems("the clouds cannot be used", SchemaError) as problems:
            check_fields(self, problems)

    def factors(self, east: ArrayLike, north: ArrayLike, seconds: ArrayLike) -> Floats:
        """Return factors of direct and of diffuse light, (2, ...); 1 at NaN places.

        Parameters
        ----------
        east, north
            Positions on the ground, of shapes that broadcast [m].
        seconds
            Times, of a shape that broadcasts [s].
        """
        from scipy.special import ndtri

        x, y, t = np.broadcast_arrays(*(np.asarray(values, np.float64) for values in (east, north, seconds)))
        towards = np.radians(self.heading)
        x = x - self.speed * np.sin(towards) * t
        y = y - self.speed * np.cos(towards) * t
        rng = np.random.default_rng([self.seed, 7])
        # waves of a field with the correlation exp(-d^2 / size^2)
        waves = rng.standard_normal((_WAVES, 2)) * np.sqrt(2.0) / self.size
        phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        parts = (np.cos(kx * x + ky * y + start) for (kx, ky), start in zip(waves, phase, strict=True))
        field = sum(parts, np.zeros(x.shape)) * np.sqrt(2.0 / _WAVES)
        direct = 1.0 - self.opacity * np.clip(0.5 + (field - ndtri(1.0 - self.cover)) / self.edge, 0.0, 1.0)
        diffuse = np.full(x.shape, 1.0 + _SCATTERED_SHARE * self.opacity * self.cover)
        is_finite = np.isfinite(x + y)
        return np.stack([np.where(is_finite, direct, 1.0), np.where(is_finite, diffuse, 1.0)])


#: Variables of a table of light, in this order, and their units.
_TABLE_UNITS = {
    "wavelength": "nm",
    "direct_normal": "W m-2 nm-1",
    "diffuse": "W m-2 nm-1",
    "extinction": "m-1",
    "path_radiance": "W m-2 sr-1 nm-1 m-1",
}
_CURVES = {
    "sun": ("W m-2 nm-1", "Direct solar irradiance at the ground, normal to the beam"),
    "sky": ("W m-2 nm-1", "Diffuse sky irradiance of a level surface"),
    "extinction": ("m-1", "Extinction coefficient of the air near the ground"),
    "path_radiance": ("W m-2 sr-1 nm-1 m-1", "Radiance that a metre of path adds"),
}
_NUMBERS = {
    name: (SKY[name].unit or "1", SKY[name].doc.capitalize())
    for name in ("sun_zenith", "sun_azimuth", "overcast_share")
}
_RECORD_FIT = SimpleNamespace(
    range_nm=(340.0, 1100.0),  # wavelengths of the built-in sky
    max_residual=0.25,  # relative root mean square, reached by aerosol or thin cloud
)
_NOISE = 0.01  # maximum negative noise relative to the maximum irradiance


@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Light at the ground and the air before the camera.

    Attributes
    ----------
    wavelength
        Increasing wavelengths, with steps much finer than the narrowest band, shape (wavelength,) [nm].
    sun
        Direct irradiance at the ground on a surface normal to the beam, shape (wavelength,) [W m-2 nm-1].
    sky
        Diffuse irradiance of a level surface, shape (wavelength,) [W m-2 nm-1].
    extinction
        Extinction of the air near the ground, shape (wavelength,) [m-1].
    path_radiance
        Radiance added by a metre of air, shape (wavelength,) [W m-2 sr-1 nm-1 m-1].
    sun_zenith, sun_azimuth
        Zenith angle and azimuth of the sun, clockwise from north [degree].
    overcast_share
        Share of the diffuse irradiance whose radiance is proportional to the cosine of the zenith angle: 0 to
        1, 4/7 for a CIE overcast sky (see `hyperpaint.simulation.atmosphere`).
    name
        Name of the atmosphere.
    haze
        Source of extinction and path radiance; None if these were passed.
    clear_shares
        Shares of the diffuse irradiance that are distributed like the functions of a clear sky
        (`hyperpaint.light.sky_functions`), shape (function, wavelength) [1]; None for 0. The rest is uniform.

    Raises
    ------
    SchemaError
        Shapes differ, wavelengths do not increase, values are not finite or negative, the sun is not above
        the horizon; all are listed.

    Examples
    --------
    >>> noon = Atmosphere.clear(25.0)
    >>> round(float(np.interp(550.0, noon.wavelength, noon.irradiance)), 1)
    1.5
    """

    wavelength: Floats
    sun: Floats
    sky: Floats
    extinction: Floats
    path_radiance: Floats
    sun_zenith: float
    sun_azimuth: float
    overcast_share: float = 0.0
    name: str = ""
    haze: Haze | None = None
    clear_shares: Floats = None  # type: ignore[assignment]  # None becomes zeros

    def __post_init__(self) -> None:
        if np.ndim(self.clear_shares) == 0:
            no_shares = np.zeros((len(FUNCTIONS) - 1, *np.shape(self.wavelength)))
            object.__setattr__(self, "clear_shares", no_shares)
        for name in ("wavelength", *_CURVES, "clear_shares"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)  # presets are shared objects
            object.__setattr__(self, name, array)
        with Problems(f"atmosphere {self.name!r} cannot be used", SchemaError) as problems:
            # curves that cannot be light over ``wavelength``: other shapes, values not finite or below 0
            grid = self.wavelength
            try:
                check_wavelengths(grid)
            except SchemaError as error:
                problems.extend([error.problem])
            for name in ("wavelength", *_CURVES):
                curve = getattr(self, name)
                if curve.shape != grid.shape:
                    problems.add(
                        f"{name} has shape {curve.shape}",
                        expected=f"{grid.shape}, as wavelength",
                        code="grid-mismatch",
                    )
                elif not np.isfinite(curve).all():
                    problems.add(
                        f"{name} has {int((~np.isfinite(curve)).sum())} values that are not finite",
                        code="not-finite",
                    )
                elif (curve < 0.0).any():
                    problems.add(
                        f"{name} falls to {curve.min():.4g}",
                        expected="nothing below 0",
                        code="value-out-of-range",
                    )
            check_values(SKY, {name: getattr(self, name) for name in _NUMBERS}, problems)
            shares, expected = self.clear_shares, (len(FUNCTIONS) - 1, *np.shape(self.wavelength))
            problems.add_if(
                shares.shape != expected or not np.isfinite(shares).all(),
                f"clear_shares has shape {shares.shape}, "
                f"{int((~np.isfinite(shares)).sum())} values not finite",
                expected=f"finite values of shape {expected}",
                code="length-mismatch",
            )

    @property
    def uniform(self) -> Floats:
        # Share of the diffuse irradiance that is uniform, shape (wavelength,) [1].
        return np.asarray(1.0 - self.overcast_share - self.clear_shares.sum(axis=0))

    @property
    def sun_cosine(self) -> float:
        # Cosine of the sun's zenith angle.
        return float(np.cos(np.radians(self.sun_zenith)))

    @property
    def irradiance(self) -> Floats:
        # Total irradiance of a level surface, shape (wavelength,) [W m-2 nm-1].
        return np.asarray(self.sun * self.sun_cosine + self.sky)

    @classmethod
    def clear(
        cls,
        sun_zenith: float = 25.0,
        sun_azimuth: float = 180.0,
        *,
        aerosol: float = 0.10,
        ozone: float = 0.31,
        water: float = 1.0,
        haze: Haze | None = HAZE,
        wavelength: ArrayLike | None = None,
        name: str = "clear",
    ) -> "Atmosphere":
        # Return the clear sky of the simulator, which resolves the absorption lines of oxygen.
        #
        # ``sun_zenith``, ``sun_azimuth``, ``name``: See `Atmosphere`. ``aerosol``: Aerosol optical depth of
        # the whole atmosphere at 500 nm. ``ozone``: Ozone column [atm cm]. ``water``: Precipitable water
        # relative to a typical summer day. ``haze``: The air before the camera; None for no air.
        # ``wavelength``: Grid, shape (wavelength,) [nm]; by default 340 to 1100 nm in steps of 0.05 nm. The
        # sky has no absorption bands beyond 1000 nm.
        #
        # Raises `SchemaError`: The sun is not above the horizon, or the grid is invalid.
        grid = (
            spectral_grid(*_RECORD_FIT.range_nm)
            if wavelength is None
            else np.asarray(wavelength, dtype=np.float64)
        )
        sun, sky = built_in_sky(grid, sun_zenith, aerosol=aerosol, ozone=ozone, water=water)
        return cls._with_haze(
            grid, sun, sky, haze, aerosol=aerosol, sun_zenith=sun_zenith, sun_azimuth=sun_azimuth, name=name
        )

    @classmethod
    def _with_haze(
        cls,
        grid: Floats,
        sun: Floats,
        sky: Floats,
        haze: Haze | None,
        *,
        spread: Mapping[str, Any] | None = None,
        aerosol: float = 0.10,
        **options: Any,
    ) -> "Atmosphere":
        # atmosphere whose extinction and path radiance are computed from haze, sun and sky, and shares of a
        # clear sky, unless passed, from the sun
        extinction = path = np.zeros_like(grid)
        zenith, overcast_share = options["sun_zenith"], options.get("overcast_share", 0.0)
        if haze is not None:
            extinction, path = haze.extinction(grid), haze.path_radiance(grid, sun, sky, zenith)
        shares = spread or clear_spread(grid, sun, zenith, overcast_share, aerosol)
        return cls(grid, sun, sky, extinction, path, haze=haze, **shares, **options)

    @classmethod
    def from_irradiance(
        cls,
        series: xr.Dataset,
        *,
        sun_zenith: float,
        sun_azimuth: float = 180.0,
        time: Any = None,
        direct_fraction: ArrayLike | None = None,
        overcast_share: float = 0.0,
        haze: Haze | None = HAZE,
        name: str = "measured",
    ) -> "Atmosphere":
        # Return the atmosphere of a measured irradiance series at one time.
        #
        # ``series``: Dataset with ``irradiance`` (irradiance_time, irradiance_wavelength), total on a level
        # surface. ``sun_zenith``, ``sun_azimuth``, ``overcast_share``, ``name``: See `Atmosphere`. ``time``:
        # Time, UTC, at which irradiance is interpolated; None for a series of one sample.
        # ``direct_fraction``: Direct over total irradiance, one number or shape (wavelength,): 0 under an
        # overcast sky. By default the fraction of the built-in clear sky with this sun. ``haze``: The air
        # before the camera; None for none.
        #
        # Raises `SchemaError`: ``irradiance`` is missing, has other dims or units, or is not finite or
        # negative; the time is outside the series, or missing with more than one sample; ``direct_fraction``
        # is not from 0 to 1.
        #
        # Warns `PaintWarning`: Noise around zero, down to -1 % of the largest value, is set to 0.
        # Wavelengths [nm] and irradiance [W m-2 nm-1] of a series at one time
        arrays = require(
            series, ["irradiance", "irradiance_wavelength"], "the atmosphere of an irradiance series"
        )
        values = np.asarray(arrays["irradiance"].values, dtype=np.float64)
        grid = np.asarray(arrays["irradiance_wavelength"].values, dtype=np.float64)
        check_wavelengths(grid)
        first = last = 0  # samples before and after the time
        weight = 0.0
        SchemaError.raise_if(
            time is None and len(values) != 1,
            f"the irradiance series has {len(values)} samples",
            expected="1 without time",
            mend="pass time= in UTC",
            code="argument-missing",
        )
        if time is not None:
            times = require(series, ["irradiance_time"], "the irradiance at one time")[
                "irradiance_time"
            ].values
            stamps = times.astype("datetime64[ns]").astype(np.int64)
            moment = moment_of(time)
            SchemaError.raise_if(
                np.isnat(moment),
                f"time is {time!r}",
                expected="UTC such as '2020-06-21T17:00:15'",
                code="time-unreadable",
            )
            time_ns = moment.astype(np.int64)
            SchemaError.raise_if(
                not len(stamps) or not stamps[0] <= time_ns <= stamps[-1],
                f"time {moment} is outside the irradiance series",
                expected=f"from {times[0]} to {times[-1]}" if len(stamps) else "a series with samples",
                code="irradiance-coverage",
            )
            if len(stamps) > 1:
                last = min(max(int(np.searchsorted(stamps, time_ns)), 1), len(stamps) - 1)
                first = last - 1
                weight = (time_ns - stamps[first]) / (stamps[last] - stamps[first])
        total = values[first] + weight * (values[last] - values[first])
        # set small negative noise to 0; larger negative values are kept and refused later
        if -_NOISE * total.max() <= total.min() < 0.0:
            warn_user(
                f"{int((total < 0.0).sum())} of {total.size} irradiances below zero, down to "
                f"{total.min():.3g}, were set to 0",
                "irradiance-negative",
            )
            total = np.maximum(total, 0.0)
        if direct_fraction is None:
            sun, sky = built_in_sky(grid, sun_zenith)
            level = sun * np.cos(np.radians(sun_zenith))
            direct_fraction = level / (level + sky)
        fraction = np.asarray(direct_fraction, dtype=np.float64)
        share = SKY["direct_fraction"]
        SchemaError.raise_if(
            fraction.shape not in ((), grid.shape) or any(map(share.fault, fraction.ravel().tolist())),
            f"direct_fraction of shape {fraction.shape}",
            expected=f"{share.expected}, or an array of such numbers of shape {grid.shape}",
            code="value-out-of-range",
        )
        sun = total * fraction / np.cos(np.radians(sun_zenith))
        sky = total * (1.0 - fraction)
        return cls._with_haze(
            grid,
            sun,
            sky,
            haze,
            sun_zenith=sun_zenith,
            sun_azimuth=sun_azimuth,
            overcast_share=overcast_share,
            name=name,
        )

    @classmethod
    def from_table(
        cls,
        table: xr.Dataset,
        *,
        sun_zenith: float,
        sun_azimuth: float = 180.0,
        overcast_share: float = 0.0,
        haze: Haze | None = None,
        name: str | None = None,
    ) -> "Atmosphere":
        # Return the atmosphere of a table, for example with results of MODTRAN or libRadtran.
        #
        # ``table``: From a reader of skies, such as `hyperpaint.io.read_sky_csv`; ``sky_radiance`` is fitted
        # (`hyperpaint.light.fit_sky`). ``sun_zenith``, ``sun_azimuth``, ``overcast_share``: See
        # `Atmosphere`. ``haze``: The air before the camera, if the table does not have it; None for no air.
        # ``name``: Name of the atmosphere; by default the name of the table's file.
        #
        # Raises `SchemaError`: The sun is not above the horizon.
        curves = {
            name: np.asarray(convert(table[name].reset_coords(drop=True), units).values, np.float64)
            for name, units in _TABLE_UNITS.items()
            if name in table.variables
        }
        fitted = None
        source = str(table.attrs.get("source", "the table"))
        if "sky_radiance" in table:
            fit = fit_sky(table, sun_zenith)
            fitted = {"clear_shares": fit["share"].transpose("function", ...).values[1:]}
            warn_if(
                (residual := float(fit["misfit"].max())) > _RECORD_FIT.max_residual,
                f"clear-sky functions fit the radiance of {source} with a residual of {residual:.0%}",
                "sky-fit-poor",
            )
        grid, sun, sky, *air = curves.values()
        atmosphere = cls._with_haze(
            grid,
            sun,
            sky,
            None if air else haze,
            spread=fitted,
            sun_zenith=sun_zenith,
            sun_azimuth=sun_azimuth,
            overcast_share=overcast_share,
            name=Path(source).stem if name is None else name,
        )
        return replace(atmosphere, extinction=air[0], path_radiance=air[1]) if air else atmosphere

    def clouded(self, oktas: float, *, colour: float = 0.24) -> "Atmosphere":
        """Return this clear atmosphere under clouds; `hyperpaint.simulation.atmosphere` has the model.

        Parameters
        ----------
        oktas
            Cloud amount, 0 to 8.
        colour
            Strength of the blue tint, 0 to 1.

        Raises
        ------
        SchemaError
            ``oktas`` or ``colour`` is outside its range.

        Examples
        --------
        >>> overcast = Atmosphere.clear(40.0).clouded(8)
        >>> bool((overcast.sun == 0.0).all()), round(overcast.overcast_share, 3)
        (True, 0.571)
        """
        cover = oktas / 8.0
        transmittance = cloud_transmittance(self.wavelength, oktas, colour=colour)
        sun = self.sun * (1.0 - cover)
        sky = self.irradiance * transmittance - sun * self.sun_cosine
        # without haze the phase function is unknown: path radiance in proportion to the light in the air
        before, after = self.sun + 2.0 * self.sky, sun + 2.0 * sky
        path = (
            self.path_radiance * np.divide(after, before, out=np.zeros_like(after), where=before > 0)
            if self.haze is None
            else self.haze.path_radiance(self.wavelength, sun, sky, self.sun_zenith)
        )
        return replace(
            self,
            sun=sun,
            sky=sky,
            path_radiance=path,
            overcast_share=(1.0 - cover) * self.overcast_share + cover * CIE_OVERCAST_SHARE,
            clear_shares=(1.0 - cover) * self.clear_shares,
            name=f"{self.name}, {oktas:g} oktas" if self.name else f"{oktas:g} oktas",
        )

    def to_dataset(self) -> xr.Dataset:
        # Return the curves as labelled variables on ``wavelength``, with CF units.
        variables: dict[str, Any] = {
            name: (
                () if name in _NUMBERS else "wavelength",
                np.asarray(getattr(self, name), np.float64),
                {"units": units, "long_name": text},
            )
            for name, (units, text) in (_CURVES | _NUMBERS).items()
        }
        variables["clear_shares"] = (
            ("function", "wavelength"),
            self.clear_shares,
            {"units": "1", "long_name": "Shares of skylight with the functions of a clear sky"},
        )
        grid = ("wavelength", self.wavelength, {"units": "nm", "long_name": "Wavelength"})
        haze = "" if self.haze is None else json.dumps(asdict(self.haze))
        coords = {"wavelength": grid, "function": list(FUNCTIONS[1:])}
        return xr.Dataset(variables, coords, {"name": self.name, "haze": haze})

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> "Atmosphere":
        # Return the atmosphere that `to_dataset` wrote.
        #
        # Raises `SchemaError`: Variables are missing, or their values cannot be used; all are listed. Raises
        # `UnitsError`: A variable has no units, or units of another quantity.
        with Problems("an atmosphere cannot be read", SchemaError) as problems:
            for name in ("wavelength", *_CURVES, *_NUMBERS):
                problems.add_if(
                    name not in dataset.variables, f"{name!r} is missing", code="variable-missing"
                )
            has_shares = "clear_shares" in dataset.variables
            problems.add_if(
                "aureole" in dataset.variables
                or (has_shares and dataset["function"].values.tolist() != list(FUNCTIONS[1:])),
                "its clear sky is that of another version",
                expected=f"functions {', '.join(FUNCTIONS[1:])}",
                mend="make the atmosphere anew",
                code="trace-outdated",
            )
        sun, sky, extinction, path = (
            convert(dataset[name], units).values for name, (units, _) in _CURVES.items()
        )
        # older datasets without shares have a uniform sky
        shares: Any = convert(dataset["clear_shares"], "1").values if has_shares else None
        zenith, azimuth, share = (
            float(convert(dataset[name], units)) for name, (units, _) in _NUMBERS.items()
        )
        grid = convert(dataset["wavelength"].reset_coords(drop=True), "nm").values
        text = dataset.attrs.get("haze", "")
        with SchemaError.instead_of(
            (ValueError, TypeError),
            f"attribute 'haze' is {text!r}",
            expected="the JSON text that to_dataset writes",
            code="metadata-damaged",
        ):
            haze = Haze(**json.loads(text)) if text else None
        name = str(dataset.attrs.get("name", ""))
        return cls(grid, sun, sky, extinction, path, zenith, azimuth, share, name, haze, shares)


#: Zenith angle and azimuth of the sun in the three atmospheres of the paper [degree].
PRESETS = {"noon": (25.0, 180.0), "near_sunset": (82.0, 265.0), "cloudy": (25.0, 180.0)}


@functools.cache
def preset_atmosphere(name: str) -> Atmosphere:
    """Return one of the paper's three atmospheres.

    "noon" is clear with the sun 25 degrees from the zenith in the south; "near_sunset" is clear with the sun
    82 degrees from the zenith in the west; "cloudy" is noon under 8 oktas, a completely overcast sky.

    Parameters
    ----------
    name
        One of `PRESETS`.

    Returns
    -------
    Atmosphere
        The same object at every call.

    Raises
    ------
    SchemaError
        The preset is unknown.

    Examples
    --------
    >>> preset_atmosphere("near_sunset").sun_zenith
    82.0
    """
    one_of(name, PRESETS, "preset")
    clear = Atmosphere.clear(*PRESETS[name], name=name)
    return replace(clear.clouded(8.0), name=name) if name == "cloudy" else clear
