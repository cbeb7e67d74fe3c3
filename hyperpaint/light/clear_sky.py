r"""Light of a clear sky: transmittances, absorption by gases, and radiance over directions, from tables.

Scattering is a full solution of radiative transfer: DISORT with 16 streams by uvspec of libRadtran 2.0.2,
pseudospherical, Rayleigh scattering after Bodhaine et al. (1999), aerosol of scale height 2 km with a
Henyey-Greenstein phase function, over optical depths of air and aerosol and zenith angles of the sun.
``tests/campaigns/sky_table.py`` makes the file. Stored, and interpolated with cubics through four nodes in
:math:`\ln \tau_R`, :math:`\sqrt{\tau_a}` and angles, are logarithms of quotients that vary little:
diffuse transmittance over :math:`1 - e^{-m (\tau_R / 2 + 0.7 \tau_a)}`, and radiance over the light scattered
once plus the mean of the sky. Beyond the nodes the quotients are held: the sun beyond 87 degrees, aerosol
beyond 1.6 at the wavelength itself, wavelengths outside 330 to 1150 nm.

Gases absorb by curves of growth at 1 nm, the diffuse light along its own air mass: oxygen A line by line,
water, ozone and the rest by SMARTS 2.9.5. Outside 338 to 1062 nm depths are proportional to air mass and
column, as in ASTM G173.

The tables agree with fresh runs to 0.1 % of the diffuse irradiance and 0.8 % of the radiance (2.3 % in the
last ten degrees). Not modelled: polarisation, which changes radiance in the blue by up to 6 %, clouds, and
the innermost degrees of a real aureole.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hyperpaint.base import ArrayLike, Floats, SchemaError

#: Single-scattering albedo and asymmetry of the aerosols that have tables [1].
AEROSOL_MODELS = {"rural": (0.93, 0.65), "humid": (0.97, 0.72)}

#: Water of ASTM G173 [cm], and standard pressure [Pa].
USUAL_WATER, STANDARD_PRESSURE = 1.416, 101_325.0

#: Step of the stored logarithms of radiance [1].
RADIANCE_STEP = 1.0 / 5_000.0

OZONE_HEIGHT_KM, EARTH_RADIUS_KM = 22.0, 6370.0

#: Numbers of the gases in the table of air masses of diffuse light.
_OXYGEN, _WATER, _OZONE = range(3)


class SunlightTable(NamedTuple):
    """Sunlight above the air and absorption by gases; every field has shape (wavelength,).

    Attributes
    ----------
    wavelength
        300 to 2500, steps of 0.5 up to 400, of 1 up to 1700, of 5 beyond [nm].
    extraterrestrial
        At one astronomical unit [W m-2 nm-1].
    ozone
        Absorption coefficient, base e [cm-1].
    mixed, water
        Optical depth of oxygen and carbon dioxide, and of 1.416 cm of water, for one air mass [1].
    """

    wavelength: Floats
    extraterrestrial: Floats
    ozone: Floats
    mixed: Floats
    water: Floats


@functools.cache
def sunlight_table() -> SunlightTable:
    """Return the table of sunlight and gases of ASTM G173 that comes with the package.

    Examples
    --------
    >>> table = sunlight_table()
    >>> print(np.interp(550.0, table.wavelength, table.extraterrestrial).round(3))
    1.863
    """
    text = Path(__file__).with_name("sunlight_1nm.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in text if not line.startswith("#")][1:]
    values = np.array(rows, np.float64).T
    values.setflags(write=False)  # shared
    return SunlightTable(*values)


@functools.cache
def disort_tables() -> dict[str, Floats]:
    # Return the tables of the file, gases from 300 to 2500 nm.
    with np.load(Path(__file__).with_name("clear_sky.npz")) as file:
        tables = {name: file[name].astype(np.float64) for name in file.files}
    for model in AEROSOL_MODELS:
        tables[f"radiance_{model}"] *= RADIANCE_STEP
    # beyond the cells of the tables, depths in proportion to air mass and water
    sunlight = sunlight_table()
    below, above = np.searchsorted(sunlight.wavelength, tables["line"][[0, -1]] + [-0.5, 0.5])
    in_proportion = {
        "line": sunlight.wavelength,
        "oxygen_depth": np.multiply.outer(sunlight.mixed, tables["mass"]),
        "water_depth": np.multiply.outer(
            sunlight.water, np.multiply.outer(tables["mass"], tables["water"] / USUAL_WATER)
        ),
        "ozone": sunlight.ozone,
        "continuum": np.zeros_like(sunlight.ozone),
    }
    for name, values in in_proportion.items():
        tables[name] = np.concatenate([values[:below], tables[name], values[above:]])
    for name in ("oxygen_depth", "water_depth"):
        tables[name] = np.maximum(tables[name], 1e-9)  # for logarithms
    for values in tables.values():
        values.setflags(write=False)
    return tables


def cubic_weights(nodes: Floats, at: ArrayLike) -> Floats:
    # Return weights (..., node) of a cubic through the four nodes around each place; held beyond the ends.
    places = np.clip(np.asarray(at, np.float64), nodes[0], nodes[-1])
    first = np.clip(np.searchsorted(nodes, places) - 2, 0, nodes.size - 4)
    weights = np.zeros((*places.shape, nodes.size))
    for node in range(4):
        others = [first + other for other in range(4) if other != node]
        weight = np.prod(
            [(places - nodes[other]) / (nodes[first + node] - nodes[other]) for other in others], axis=0
        )
        np.put_along_axis(weights, (first + node)[..., None], weight[..., None], axis=-1)
    return weights


def linear_weights(nodes: Floats, at: ArrayLike) -> Floats:
    # Return weights (..., node) of linear interpolation; held beyond the ends.
    position = np.interp(np.asarray(at, np.float64), nodes, np.arange(nodes.size))
    return np.asarray(np.maximum(1.0 - np.abs(position[..., None] - np.arange(nodes.size)), 0.0))


def air_mass(zenith: ArrayLike) -> Floats:
    """Return the relative optical air mass at a zenith angle [degree] (Kasten & Young 1989).

    F. Kasten and A. T. Young, "Revised optical air mass tables and approximation formula", Appl. Opt. 28,
    4735 (1989). doi:10.1364/AO.28.004735

    Examples
    --------
    >>> print(air_mass([60.0, 85.0]).round(3))
    [ 1.994 10.306]
    """
    zenith = np.asarray(zenith, np.float64)
    below = np.clip(96.07995 - zenith, 1e-3, None)
    return np.asarray(1.0 / (np.cos(np.radians(zenith)) + 0.50572 * below**-1.6364))


def rayleigh_depth(wavelength: ArrayLike, pressure: ArrayLike = STANDARD_PRESSURE) -> Floats:
    """Return the vertical optical depth of air [1].

    Eq. 30 of Bodhaine et al., J. Atmos. Ocean. Tech. 16, 1854 (1999). Takes wavelengths [nm] and the
    pressure at the ground [Pa], of shapes that broadcast.

    Examples
    --------
    >>> print(rayleigh_depth([400.0, 550.0]).round(4))
    [0.3602 0.0971]
    """
    square = (np.asarray(wavelength, np.float64) / 1000.0) ** 2
    return np.asarray(
        0.0021520
        * (1.0455996 - 341.29061 / square - 0.90230850 * square)
        / (1.0 + 0.0027059889 / square - 85.968563 * square)
        * (np.asarray(pressure, np.float64) / STANDARD_PRESSURE)
    )


def scattered_share(rayleigh: Floats, aerosol: Floats, sun_zenith: ArrayLike) -> Floats:
    # Return an estimate of the light that is scattered downwards, by which diffuse transmittance is divided.
    return np.asarray(-np.expm1(-air_mass(sun_zenith) * (0.5 * rayleigh + 0.7 * aerosol)))


def scattered_once(
    rayleigh: Floats,
    aerosol: Floats,
    sun_zenith: ArrayLike,
    cosine: ArrayLike,
    azimuth: ArrayLike,
    albedo: float,
    asymmetry: float,
) -> Floats:
    # Return the light scattered once in an even mixture of air and aerosol [sr-1], shapes that broadcast.
    #
    # Relative to extraterrestrial normal irradiance, for optical depths, the sun's zenith angle [degree],
    # cosines of the directions' zenith angles and azimuths from the sun [rad].
    mass, depth = air_mass(sun_zenith), rayleigh + aerosol
    from_sun = scattering_cosine(cosine, azimuth, sun_zenith)
    depolarisation = 0.0279
    molecules = (3.0 / (4.0 + 2.0 * depolarisation)) * (
        1.0 + depolarisation + (1.0 - depolarisation) * from_sun**2
    )
    particles = (1.0 - asymmetry**2) / (1.0 + asymmetry**2 - 2.0 * asymmetry * from_sun) ** 1.5
    # integral of the way down to the scattering and on to the ground
    path = depth * (1.0 / np.asarray(cosine) - mass)
    is_small = np.abs(path) < 1e-6
    divisor = np.where(is_small, 1.0, path)
    integral = np.where(is_small, 1.0 - 0.5 * path, -np.expm1(-divisor) / divisor)
    scattered = (rayleigh * molecules + albedo * aerosol * particles) / (4.0 * np.pi * np.asarray(cosine))
    return np.asarray(scattered * np.exp(-depth * mass) * integral)


def scattering_cosine(cosine: ArrayLike, azimuth: ArrayLike, sun_zenith: ArrayLike) -> Floats:
    # Return the cosine of the angle from the sun.
    #
    # Takes the ``cosine`` of the zenith angle and the ``azimuth`` from the sun [rad], and the sun's zenith
    # angle [degree], of shapes that broadcast.
    sun, cosine = np.radians(sun_zenith), np.asarray(cosine, np.float64)
    across = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
    return np.asarray(cosine * np.cos(sun) + across * np.sin(sun) * np.cos(azimuth))


def ozone_mass(sun_zenith: float) -> float:
    """Return the relative air mass of a layer of ozone at 22 km (Bird & Riordan 1986, eq. 2-10).

    Examples
    --------
    >>> round(ozone_mass(82.0), 2)
    6.19
    """
    height = OZONE_HEIGHT_KM / EARTH_RADIUS_KM
    return float((1.0 + height) / np.sqrt(np.cos(np.radians(sun_zenith)) ** 2 + 2.0 * height))


@dataclass(frozen=True)
class ClearSky:
    r"""Light of a clear sky.

    Attributes
    ----------
    sun_zenith
        Angle between the sun and the vertical, below 90 [degree].
    aerosol, angstrom
        Aerosol optical depth at 500 nm, and the exponent of its decrease with wavelength [1].
    ozone
        Ozone column [atm cm].
    water
        Precipitable water relative to that of ASTM G173, 1.416 cm [1].
    pressure
        At the ground [Pa].
    ground
        Reflectance of the surroundings, which brightens the sky [1].
    model
        Aerosol: "rural" (single-scattering albedo 0.93, asymmetry 0.65) or "humid" (0.97, 0.72).

    All but the sun and the model may be arrays (air, 1) for several states of the air at once.

    Raises
    ------
    SchemaError
        The sun is not above the horizon, or the model has no table.

    Notes
    -----
    With depths :math:`\tau_R` of air and :math:`\tau_a` of aerosol, air mass m (Kasten & Young), ground
    reflectance A and spherical albedo s of the air, transmittances of level light without gases are

    .. math:: t_{dir} = e^{-(\tau_R + \tau_a) m}, \quad
              t_{dif} = t_0 + (t_{dir} + t_0) \frac{A s}{1 - A s}

    with :math:`t_0` over black ground from the tables, and gases transmit :math:`T`:

    .. math:: E_{dir} = E_0 \cos\theta_s \, t_{dir} T_{dir}, \quad
              E_{dif} = E_0 \cos\theta_s \, t_{dif} T_{dif}

    Examples
    --------
    >>> direct, diffuse = ClearSky(sun_zenith=25.0).irradiance(np.array([450.0, 550.0, 850.0]))
    >>> print(direct.round(2), diffuse.round(2))
    [1.29 1.32 0.76] [0.39 0.22 0.05]
    """

    sun_zenith: float = 25.0
    aerosol: float | Floats = 0.10
    angstrom: float | Floats = 1.14
    ozone: float | Floats = 0.31
    water: float | Floats = 1.0
    pressure: float | Floats = STANDARD_PRESSURE
    ground: float | Floats = 0.2
    model: str = "rural"

    def __post_init__(self) -> None:
        SchemaError.raise_if(
            not 0.0 <= self.sun_zenith < 90.0,
            f"sun_zenith is {self.sun_zenith!r}",
            expected="0 to below 90 degrees",
            code="value-out-of-range",
        )
        SchemaError.raise_if(
            self.model not in AEROSOL_MODELS,
            f"model is {self.model!r}",
            expected=" or ".join(AEROSOL_MODELS),
            code="choice-unknown",
        )

    def _depths(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # optical depths of air and aerosol (..., band)
        aerosol = self.aerosol * (wavelength / 500.0) ** -np.asarray(self.angstrom)
        air = rayleigh_depth(wavelength, self.pressure)
        air, aerosol = np.broadcast_arrays(air, aerosol)
        return air, aerosol

    def _interpolate(self, name: str, depths: tuple[Floats, Floats]) -> Floats:
        # table (rayleigh, aerosol[, sun, ...]) at depths (..., band)
        tables = disort_tables()
        field = tables[name]
        if name.startswith(("diffuse_", "radiance_")):
            field = np.tensordot(cubic_weights(tables["sun"], self.sun_zenith), field, (0, 2))
        # increasing in -ln of the air's depth, as in wavelength
        rows = cubic_weights(-np.log(tables["rayleigh"]), -np.log(depths[0]))
        columns = cubic_weights(np.sqrt(tables["aerosol"]), np.sqrt(depths[1]))
        in_rows = np.tensordot(rows, field, 1)
        # (..., aerosol) as a matrix product over directions
        return np.asarray(
            (columns[..., None, :] @ in_rows.reshape(*columns.shape, -1)).reshape(
                *columns.shape[:-1], *field.shape[2:]
            )
        )

    def _over_black(self, depths: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        # direct and diffuse transmittance of level light over black ground
        logs = self._interpolate(f"diffuse_{self.model}", depths)
        direct = np.exp(-(depths[0] + depths[1]) * air_mass(self.sun_zenith))
        return direct, np.exp(logs) * scattered_share(*depths, self.sun_zenith)

    def transmittances(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # Return direct and diffuse irradiance of level ground relative to that above the air, without gases.
        depths = self._depths(wavelength)
        direct, diffuse = self._over_black(depths)
        returned = self.ground * self._interpolate(f"spherical_albedo_{self.model}", depths)
        return direct, diffuse + (direct + diffuse) * returned / (1.0 - returned)

    def gases(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # Return the transmittances of all gases for direct and for diffuse light (..., band) [1].
        tables, mass = disort_tables(), air_mass(self.sun_zenith)
        pressure = np.asarray(self.pressure) / STANDARD_PRESSURE
        water, _ = np.broadcast_arrays(np.asarray(self.water) * USUAL_WATER, wavelength)
        _, aerosol = self._depths(wavelength)
        oxygen_depth, water_depth, ozone, continuum = (
            _at_wavelengths(tables[name], tables["line"], wavelength)
            for name in ("oxygen_depth", "water_depth", "ozone", "continuum")
        )
        by_water = linear_weights(np.log(tables["water"]), np.log(np.maximum(water, 1e-3)))
        water_depth = np.exp(np.einsum("...w,...mw->...m", by_water, np.log(water_depth)))
        # below the least water of the tables in proportion
        water_depth *= np.minimum(water / tables["water"][0], 1.0)[..., None]

        def slant(depth: Floats, mass: Floats) -> Floats:
            # depth over a relative air mass, linear in the logarithms, in proportion below air mass 1
            weights = linear_weights(np.log(tables["mass"]), np.log(np.maximum(mass, 1.0)))
            logs = np.einsum("...m,...m->...", weights, np.log(np.maximum(depth, 1e-12)))
            return np.asarray(np.exp(logs) * np.minimum(mass, 1.0))

        # air mass of the diffuse light by gas: table (gas, depth, wavelength, aerosol, sun)
        paths = np.tensordot(
            tables["diffuse_air_mass"], linear_weights(tables["path_sun"], self.sun_zenith), 1
        )
        by_wavelength = linear_weights(np.log(tables["path_wavelength"]), np.log(wavelength))
        by_aerosol = linear_weights(np.sqrt(tables["path_aerosol"]), np.sqrt(aerosol))

        def diffuse_mass(gas: int, vertical: ArrayLike) -> Floats:
            absorber = np.clip(0.5 * np.maximum(vertical, 1e-6) ** 0.65, 0.05, 1.0)
            by_depth = linear_weights(np.log(tables["path_depth"]), np.log(absorber))
            at_wavelengths = np.einsum("kna,...n->...ka", paths[gas], by_wavelength)
            return np.asarray(np.einsum("...ka,...k,...a->...", at_wavelengths, by_depth, by_aerosol))

        ozone, continuum = ozone * np.asarray(self.ozone), continuum * pressure
        vertical_water = slant(water_depth, np.ones_like(water))
        vertical_oxygen = slant(oxygen_depth, np.ones_like(water))
        direct = (
            ozone * ozone_mass(self.sun_zenith)
            + continuum * mass
            + slant(water_depth, np.broadcast_to(mass, water.shape))
            + slant(oxygen_depth, np.broadcast_to(mass * pressure, water.shape))
        )
        diffuse = (
            ozone * diffuse_mass(_OZONE, 0.0)
            + continuum * diffuse_mass(_OXYGEN, 0.0)
            + slant(water_depth, diffuse_mass(_WATER, vertical_water))
            + slant(oxygen_depth, diffuse_mass(_OXYGEN, vertical_oxygen) * pressure)
        )
        return np.exp(-direct), np.exp(-diffuse)

    def irradiance(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # Return direct and diffuse irradiance of level ground [W m-2 nm-1], at 1 nm.
        #
        # Takes ``wavelength`` (point,), 300 to 2500 [nm]; `SchemaError` beyond.
        if wavelength.size and not 300.0 <= wavelength.min() <= wavelength.max() <= 2500.0:
            raise SchemaError(
                f"wavelength goes from {wavelength.min():g} to {wavelength.max():g} nm",
                expected="300 to 2500 nm",
                code="value-out-of-range",
            )
        table = sunlight_table()
        above = np.interp(wavelength, table.wavelength, table.extraterrestrial)
        above *= np.cos(np.radians(self.sun_zenith))
        parts = zip(self.transmittances(wavelength), self.gases(wavelength), strict=True)
        direct, diffuse = (above * scattered * gases for scattered, gases in parts)
        return direct, diffuse

    def radiance(self, wavelength: Floats, cosine: ArrayLike, azimuth: ArrayLike) -> Floats:
        """Return the radiance of the sky without gases (band, ...) [sr-1].

        Relative to extraterrestrial normal irradiance. Takes wavelengths (band,) [nm], cosines of zenith
        angles above 0, and azimuths from the sun [rad].

        Examples
        --------
        >>> print(ClearSky(60.0).radiance(np.array([450.0]), [1.0, 0.1], [0.0, np.pi]).round(4))
        [[0.0247 0.0763]]
        """
        tables = disort_tables()
        cosines, azimuths = np.broadcast_arrays(
            np.asarray(cosine, np.float64), np.asarray(azimuth, np.float64)
        )
        shape, cosines, azimuths = cosines.shape, cosines.ravel(), azimuths.ravel()
        zenith = np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0)))
        turned = np.degrees(np.arccos(np.clip(np.cos(azimuths), -1.0, 1.0)))
        by_zenith = cubic_weights(tables["zenith"], zenith)
        weights = by_zenith[:, :, None] * cubic_weights(tables["azimuth"], turned)[:, None, :]
        depths = self._depths(wavelength)
        direct, diffuse = self._over_black(depths)
        logs = self._interpolate(f"radiance_{self.model}", depths)
        quotient = np.exp(logs.reshape(wavelength.size, -1) @ weights.reshape(zenith.size, -1).T)
        level = np.cos(np.radians(self.sun_zenith))
        # at and below the last node the horizon is held
        once = scattered_once(
            depths[0][:, None],
            depths[1][:, None],
            self.sun_zenith,
            np.maximum(cosines, np.cos(np.radians(tables["zenith"][-1]))),
            azimuths,
            *AEROSOL_MODELS[self.model],
        )
        black = quotient * (once + level * diffuse[:, None] / np.pi)
        albedo = self._interpolate(f"spherical_albedo_{self.model}", depths)
        lit = self.ground * level * (direct + diffuse) / (1.0 - self.ground * albedo)
        by_ground = self._interpolate("ground_to_sky", depths) @ by_zenith.T
        return np.asarray((black + lit[:, None] * by_ground).reshape(wavelength.size, *shape))

    def relative_radiance(self, wavelength: Floats, cosine: ArrayLike, azimuth: ArrayLike) -> Floats:
        # Return `radiance` relative to a uniform sky of the same level irradiance (band, ...) [1].
        _, diffuse = self.transmittances(wavelength)
        mean = diffuse * np.cos(np.radians(self.sun_zenith)) / np.pi
        radiance = self.radiance(wavelength, cosine, azimuth)
        return np.asarray(radiance / mean.reshape(-1, *[1] * (radiance.ndim - 1)))


def _at_wavelengths(values: Floats, grid: Floats, wavelength: Floats) -> Floats:
    # Interpolate values (grid, ...) linearly to wavelengths (band, ...).
    position = np.interp(wavelength, grid, np.arange(grid.size))
    low = np.minimum(position.astype(np.intp), grid.size - 2)
    share = (position - low)[(..., *[None] * (values.ndim - 1))]
    return np.asarray((1.0 - share) * values[low] + share * values[low + 1])


# --- means over the sky -------------------------------------------------------------------------------------


class Dome(NamedTuple):
    # Directions of the upper hemisphere for integrals: Gauss's rule in the cosine, even steps in azimuth.
    cosine: Floats  # (zenith, azimuth)
    azimuth: Floats  # (zenith, azimuth), 0 to 180 degrees from the sun [rad]
    level: Floats  # (zenith, azimuth): weights of level irradiance, of sum 1


@functools.cache
def dome() -> Dome:
    # Return the directions at which integrals over the sky are evaluated.
    nodes, weights = np.polynomial.legendre.leggauss(32)
    cosine, azimuth = np.meshgrid(0.5 * (nodes + 1.0), (np.arange(48) + 0.5) / 48 * np.pi, indexing="ij")
    return Dome(cosine, azimuth, cosine * weights[:, None] / 48)


@functools.lru_cache(maxsize=64)
def dome_radiance(sun_zenith: float, aerosol: float = 0.1) -> Floats:
    # Return the sky relative to a uniform one of the same level irradiance (node, zenith, azimuth) [1].
    #
    # In the directions of `dome`, at the wavelengths of the tables.
    sky = dome()
    nodes = disort_tables()["path_wavelength"]
    radiance = ClearSky(sun_zenith, aerosol).radiance(nodes, sky.cosine, sky.azimuth)
    radiance /= (sky.level * radiance).sum(axis=(1, 2))[:, None, None]
    radiance.setflags(write=False)  # shared
    return radiance


def between_nodes(values: Floats, wavelength: ArrayLike) -> Floats:
    # Interpolate values (node, ...) at the wavelengths of the tables to bands (band, ...).
    nodes = disort_tables()["path_wavelength"]
    return np.tensordot(cubic_weights(np.log(nodes), np.log(wavelength)), values, 1)


def zenith_radiance(wavelength: ArrayLike, sun_zenith: float, aerosol: float = 0.1) -> Floats:
    """Return the zenith radiance of a clear sky relative to a uniform sky (band,) [1].

    Parameters
    ----------
    wavelength : (band,)
        [nm]
    sun_zenith
        [degree]
    aerosol
        Optical depth at 500 nm [1].

    Examples
    --------
    >>> print(zenith_radiance([450.0, 850.0], 60.0).round(1))
    [0.5 0.3]
    """
    return radiance_towards_sun(wavelength, sun_zenith, 0.0, aerosol)


def radiance_towards_sun(
    wavelength: ArrayLike, sun_zenith: float, angle: float, aerosol: float = 0.1
) -> Floats:
    """Return the radiance of a clear sky relative to a uniform sky (band,) [1], at an angle from the zenith.

    ``angle`` from the zenith, positive towards the sun [degree]; other arguments as for `zenith_radiance`.

    Examples
    --------
    >>> nm = [450.0]
    >>> radiance_towards_sun(nm, 60.0, 4.0) > radiance_towards_sun(nm, 60.0, -4.0)
    array([ True])
    """
    nm = np.asarray(wavelength, np.float64)
    azimuth = 0.0 if angle >= 0.0 else np.pi
    return ClearSky(float(sun_zenith), aerosol).relative_radiance(nm, np.cos(np.radians(angle)), azimuth)


def sunward_gain(wavelength: ArrayLike, sun_zenith: float, aerosol: float = 0.1) -> Floats:
    r"""Return the relative gain of clear-sky light on a surface tilted towards the sun (band,) [1].

    Relative change of diffuse light for a unit change of :math:`c = \cos i / \cos \theta_s`, direct light,
    by a small tilt; arguments as for `zenith_radiance`.

    Notes
    -----
    A tilt :math:`\beta` towards the sun gives :math:`c - 1 = \beta \tan \theta_s` and, to first order, a gain
    of :math:`\beta \int L \omega_x d\Omega / \int L \omega_z d\Omega` with :math:`\omega_x` level towards the
    sun.
    """
    sky = dome()
    # with the sun at the zenith numerator and denominator vanish, their quotient does not
    zenith = max(float(sun_zenith), 5.0)
    sunward = sky.level * np.sqrt(1.0 - sky.cosine**2) / sky.cosine * np.cos(sky.azimuth)
    gains = np.tensordot(dome_radiance(zenith, aerosol), sunward) / np.tan(np.radians(zenith))
    return between_nodes(gains, wavelength)


def facing_gain(wavelength: ArrayLike, sun_zenith: float, angle: float, from_sun: float) -> Floats:
    r"""Return a clear sky's light on a slope relative to a uniform sky's (band,) [1].

    Both have the same level irradiance. The result depends on the side of the sky that the slope faces; it
    is 1 for a level surface.

    Parameters
    ----------
    wavelength : (band,)
        [nm]
    sun_zenith
        [degree]
    angle
        Angle between the slope's normal and the zenith, 0 to 90 [degree].
    from_sun
        Azimuth of the normal less azimuth of the sun [degree].

    Notes
    -----
    .. math:: G = \frac{\int L (\omega \cdot n)_+ d\Omega}{\bar L \int (\omega \cdot n)_+ d\Omega}

    over the sky, by the same rule for both integrals.

    Examples
    --------
    >>> print(facing_gain([450.0, 850.0], 60.0, 30.0, 0.0).round(1), facing_gain([450.0], 60.0, 0.0, 0.0))
    [1.3 1.9] [1.]
    """
    sky, slope = dome(), np.radians(angle)
    # both sides of the sky, (side, zenith, azimuth)
    azimuth = np.stack([sky.azimuth, -sky.azimuth]) - np.radians(from_sun)
    facing = np.cos(slope) + np.sin(slope) * np.sqrt(1.0 - sky.cosine**2) / sky.cosine * np.cos(azimuth)
    weight = (sky.level * np.maximum(facing, 0.0)).sum(axis=0)
    # a departure from 1, so that a level surface gives 1 to the last bit
    departure = np.tensordot(dome_radiance(float(sun_zenith)) - 1.0, weight / weight.sum())
    return 1.0 + (between_nodes(departure, wavelength) if angle else np.zeros(np.shape(wavelength)))
