"""Light of the sky, with spectral structure finer than any instrument here, clouds, and haze.

The light is a sum of two spectra, direct and diffuse, each with its own factor in time. Their level is that
of `hyperpaint.light.sky_functions`, a table at 1 nm; here are lines far narrower than the instruments, as in
nature, so that a mismatch cannot hide behind shared interpolation. The oxygen A and B bands follow from the
rotational constants of O2 (Herzberg 1950), with the sharp band head at its place; water lines and weak solar
lines have random, fixed positions; strong Fraunhofer lines have their true ones. Every cell of 1 nm is scaled
to the mean of the table: to its sunlight, and to the transmittance of ASTM G173 at an air mass of 1.5. At
other air masses absorption lines saturate.

Clouds over a clear sky, and the air before the camera:

*Broken clouds* over a scene: their shadows move over the ground, so that light varies over swath and time.
The ground is in shadow where a Gaussian random field, which moves with the wind, exceeds a threshold. The
field is a sum of plane waves with random directions and phases (M. Shinozuka, J. Sound Vib. 25, 111, 1972):
it is defined at every position and time without a grid, and does not depend on the order of evaluation.

*Amount*: Kasten & Czeplak (Solar Energy 24, 1980) found in ten years at Hamburg that N oktas of cloud leave
``1 - 0.75 (N/8)^3.4`` of the clear sky's global irradiance. The direct beam is taken to be hidden for N/8 of
the time; the rest of the remaining light is diffuse.

*Colour*: Bartlett, Ciotti, Davis & Cullen (J. Geophys. Res. 103, 31017, 1998) fitted the ratio of cloudy to
clear irradiance over 412-700 nm with ``CF (a(CF) + b(CF) (lambda/490)^-4)``, where the cloud factor CF is
the ratio at 490 nm: overcast light is slightly bluer. Their coefficients are known here from a secondary
source only (a = 0.76 + 0.24 CF, b = 0.24 (1 - CF)), so that they are an argument. Limits: CF is the broadband
factor of Kasten & Czeplak; beyond 700 nm the form is extrapolated; the deeper bands of water and oxygen, from
longer paths in clouds, are neglected; the same authors measured skies (Bering Sea) that differ from it.

*Direction*: the clear sky is `hyperpaint.light.sky_functions`; between clear and overcast both are weighted
by the part of the sky without and with clouds. The CIE overcast sky (Moon & Spencer 1942), L = L_zenith
(1 + 2 cos theta) / 3, is a sum of a uniform sky and one whose radiance goes with cos theta. On a level
surface the first gives pi L_z / 3 and the second 4 pi L_z / 9: shares of 3/7 and 4/7 of the diffuse
irradiance.

*Air*: extinction and path radiance of the air between a surface and the camera, per metre.
Extinction is the sum of air molecules and haze; at the visibility V a black object has 2 % of its contrast:
``k(550 nm) = 3.912 / V`` (Koschmieder 1924). Light scattered into a short vertical path comes from the sun,
from the sky and from the ground; per metre it is ``k_s`` times the source function

    J = E_sun P(Theta) / (4 pi) + beta E_sky / pi + (1 - beta) r E / pi

with the scattering angle ``Theta = 180 deg - sun zenith`` of a camera that looks straight down, the phase
function ``P`` (Rayleigh's; Henyey & Greenstein 1941 for haze), the share ``beta`` of light that is scattered
into the back hemisphere, and the reflectance ``r`` of the surroundings. Over a white ground without a sun and
without absorption, J is the radiance of the sky, and a path changes nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import Fact, check_fields, check_values, declared, fact
from hyperpaint.base.schema import Floats
from hyperpaint.light.sky_functions import TABLE_AIR_MASS, ClearSky, clear_sky_shares, sunlight_table

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
        return np.append(np.where(depth[:, None] > 0.0, low[:, None] * shape, 0.0).ravel(), depths[beyond])

    rng = np.random.default_rng([_NATURE, 1])
    water = np.zeros_like(nm)
    for centre, spread, number, depth in _WATER:
        centres = rng.normal(centre, spread, number)
        water += _sum_of_lines(nm, centres, rng.exponential(depth, number), _LINE_WIDTH)
    # Optical depth at one air mass. Lines stand at nu0 + (B' + B'') m + (B' - B'') m^2, with m = J + 1 in the
    # R branch, which turns back into the band head, and m = -J in the P branch; J odd; each a doublet 2 cm-1
    # apart. Strengths follow the Boltzmann factor of the lower level at 270 K.
    odd = np.arange(1, 42, 2)
    population = (2 * odd + 1) * np.exp(-_SECOND_RADIATION / 270.0 * _OXYGEN_GROUND * odd * (odd + 1))
    population /= population.max()
    total = np.zeros_like(nm)
    for origin, upper, strength in _OXYGEN:
        for m in (odd + 1.0, -1.0 * odd):
            wavenumber = origin + (upper + _OXYGEN_GROUND) * m + (upper - _OXYGEN_GROUND) * m**2
            for split in (0.0, -2.0):
                centres = 1e7 / (wavenumber + split) / 1.000275  # in air
                total += _sum_of_lines(nm, centres, 0.5 * strength * population, _LINE_WIDTH)
    return _FineStructure(
        wavelength=np.append(nm, table.wavelength[beyond]),
        lines=np.append(solar / means[half:-half], np.ones(beyond.sum())),
        mixed=scaled(total, table.mixed),
        water=scaled(water, table.water),
    )


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


def check_sky(**values: float) -> None:
    # raise unless the facts of a sky accept these values; `SchemaError` lists all faults
    problems = Problems("the light of the sky cannot be computed", SchemaError)
    check_values(SKY, values, problems)
    problems.raise_if_any()


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


def check_curves(problems: Problems, curves: Mapping[str, Floats]) -> None:
    # note curves that cannot be light over ``wavelength``: other shapes, values not finite or below 0
    grid = curves["wavelength"]
    try:
        check_wavelengths(grid)
    except SchemaError as error:
        problems.extend([error.problem])
    for name, curve in curves.items():
        if curve.shape != grid.shape:
            problems.add(
                f"{name} has shape {curve.shape}",
                expected=f"{grid.shape}, as wavelength",
                code="grid-mismatch",
            )
        elif not np.isfinite(curve).all():
            problems.add(
                f"{name} has {int((~np.isfinite(curve)).sum())} values that are not finite", code="not-finite"
            )
        elif (curve < 0.0).any():
            problems.add(
                f"{name} falls to {curve.min():.4g}", expected="nothing below 0", code="value-out-of-range"
            )


def built_in_sky(
    wavelength: Floats, sun_zenith: float, *, aerosol: float = 0.10, ozone: float = 0.31, water: float = 1.0
) -> tuple[Floats, Floats]:
    # Return direct normal and diffuse level irradiance of the simulator's own sky [W m-2 nm-1].
    #
    # The model of `hyperpaint.simulation.atmosphere.Sky`, with the air mass of Kasten & Young in place of 1 /
    # cos(zenith), at increasing wavelengths [nm]; all else as for `Sky`.
    #
    # Raises `SchemaError`: A number is outside its range in `SKY`, or the wavelengths are no grid.
    check_wavelengths(wavelength)
    check_sky(sun_zenith=sun_zenith, aerosol=aerosol, water=water)
    direct, diffuse = Sky(
        sun_zenith=sun_zenith,
        aerosol=aerosol,
        ozone=ozone,
        water=water,
        airmass=relative_air_mass(sun_zenith),
    ).irradiance(wavelength)
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
    _, molecular, aureole = clear * clear_sky_shares(wavelength, sun_zenith, aerosol)
    return {"molecular": molecular, "aureole": aureole}


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
    problems = Problems("clouds cannot be made", SchemaError)
    check_values(SKY | {"colour": _COLOUR}, {"oktas": oktas, "colour": colour}, problems)
    problems.raise_if_any()
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
        problems = Problems("haze cannot be made", SchemaError)
        check_fields(self, problems)
        problems.raise_if_any()

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
        problems = Problems("the clouds cannot be used", SchemaError)
        check_fields(self, problems)
        problems.raise_if_any()

    def factors(self, east: npt.ArrayLike, north: npt.ArrayLike, seconds: npt.ArrayLike) -> Floats:
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
        field = np.zeros(x.shape)
        for (kx, ky), start in zip(waves, phase, strict=True):
            field += np.cos(kx * x + ky * y + start)
        field *= np.sqrt(2.0 / _WAVES)
        direct = 1.0 - self.opacity * np.clip(0.5 + (field - ndtri(1.0 - self.cover)) / self.edge, 0.0, 1.0)
        diffuse = np.full(x.shape, 1.0 + _SCATTERED_SHARE * self.opacity * self.cover)
        is_finite = np.isfinite(x + y)
        return np.stack([np.where(is_finite, direct, 1.0), np.where(is_finite, diffuse, 1.0)])
