r"""Light of a clear sky: its radiance over directions, and the spectra of sun and sky.

Three functions for each sun position, of unit level irradiance each: uniform; molecular (brighter towards the
horizon and along the sun's direction, as Rayleigh's phase function); aureole (around the sun and towards the
horizon, as aerosol scatters). A clear sky is their sum with shares that are not negative and depend on
wavelength, so that light paths traced once serve every state of the air. With the cosine :math:`\mu` of the
zenith angle, the angle :math:`\Theta` from the sun, :math:`u = \ln(\mu + 0.05)`, relative to a uniform sky,

.. math:: f = \exp(c_0 + c_1 u + c_2 u^2 + c_3 u^3 + c_4 \Theta + c_5 \Theta^2 + c_6 \Theta^3 + c_7 u \Theta)

Coefficients and shares are fits to a plane-parallel Monte Carlo of molecules and aerosol (Henyey-Greenstein,
asymmetry 0.65, exponent 1.14, single-scattering albedo 0.94) over ground of 0.15, at ten suns, four aerosols
and six wavelengths (``tests/campaigns/sky_table.py``); linear between them, constant beyond. No clouds.

Spectral irradiance of a clear sky, direct and diffuse, at 1 nm.

In comes the state of the air and the sun's zenith angle; out go spectra. The chain and the simulator share
this module and `sun`, so neither tests them for the other: the tests compare with tables of ASTM G173 and
SPECTRL2 by pvlib.

Above the air: the extraterrestrial spectrum of ASTM G173 at 1 nm. Rayleigh, Angstrom aerosol, ozone and the
coupling of ground and air: SPECTRL2 (Bird & Riordan, J. Climate Appl. Meteor. 25, 87, 1986). Oxygen, carbon
dioxide and water: the rest of G173's direct beam after these, as optical depths of 1 nm cells.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import convert, takes_quantities
from hyperpaint.base.schema import ArrayLike, Floats

from .sun import Scatterers, air_mass, scattered_light

#: Added to the cosine of the zenith angle in u [1].
HORIZON_SHIFT = 0.05


class _Tables(NamedTuple):
    suns: Floats  # (sun,) [degree]
    shapes: Floats  # (sun, function, coefficient)
    aerosols: Floats  # (aerosol,) optical depth at 500 nm
    wavelengths: Floats  # (wavelength,) [nm]
    shares: Floats  # (sun, aerosol, wavelength, function)


def table_rows(name: str) -> Floats:
    # Return the rows of a table of numbers beside this file, below its headings.
    text = Path(__file__).with_name(name).read_text(encoding="utf-8").splitlines()
    return np.array([line.split(",") for line in text if not line.startswith("#")][1:], np.float64)


@functools.cache
def _tables() -> _Tables:
    shapes, weights = table_rows("sky_shapes.csv"), table_rows("sky_weights.csv")
    suns, aerosols, wavelengths = (np.unique(weights[:, column]) for column in range(3))
    sizes = suns.size, aerosols.size, wavelengths.size, 3
    return _Tables(
        suns, shapes[:, 2:].reshape(suns.size, 2, -1), aerosols, wavelengths, weights[:, 3:].reshape(sizes)
    )


def _between(nodes: Floats, values: Floats, x: float) -> Floats:
    # Interpolate values (node, ...) at x: linear between nodes, constant beyond.
    position = float(np.interp(x, nodes, np.arange(nodes.size)))
    low = min(int(position), nodes.size - 2)
    weight = position - low
    return np.asarray((1.0 - weight) * values[low] + weight * values[low + 1])


def scattering_cosine(cosine: Floats, azimuth: Floats, sun_zenith: float) -> Floats:
    # Return the cosine of the angle from the sun.
    #
    # Takes the ``cosine`` of the zenith angle and the ``azimuth`` from the sun [rad], any shape, and the
    # sun's zenith angle [degree].
    sun = np.radians(sun_zenith)
    across = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
    return np.asarray(cosine * np.cos(sun) + across * np.sin(sun) * np.cos(azimuth))


def relative_radiance(shape: Floats, cosine: Floats, from_sun: Floats) -> Floats:
    # Return a sky function relative to a uniform sky of the same level irradiance [1].
    #
    # Takes one of `function_shapes` (8,), and the cosines of the zenith angle, above 0, and of the angle from
    # the sun, any shape.
    u, t = np.log(cosine + HORIZON_SHIFT), np.arccos(np.clip(from_sun, -1.0, 1.0))
    c = shape
    power = c[0] * u + c[1] * u**2 + c[2] * u**3 + c[3] * t + c[4] * t**2 + c[5] * t**3 + c[6] * u * t + c[7]
    return np.asarray(np.exp(power))


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
def function_shapes(sun_zenith: float) -> Floats:
    """Return the coefficients of the molecular function and of the aureole (2, 8) for a sun [degree].

    In the order of the exponent's terms, the constant :math:`c_0` last, normalised to the level irradiance of
    a uniform sky.

    Raises
    ------
    SchemaError
        The sun is not above the horizon.

    Examples
    --------
    >>> above, molecular = np.array(1.0), function_shapes(60.0)[0]
    >>> print(relative_radiance(molecular, above, np.cos(np.radians(60.0))).round(1))
    0.5
    """
    SchemaError.raise_if(
        not 0.0 <= sun_zenith < 90.0,
        f"sun_zenith is {sun_zenith!r}",
        expected="0 to below 90 degrees",
        code="value-out-of-range",
    )
    tables, sky = _tables(), dome()
    rows = _between(tables.suns, tables.shapes, sun_zenith)
    from_sun = scattering_cosine(sky.cosine, sky.azimuth, sun_zenith)
    shapes = np.concatenate([rows, np.zeros((2, 1))], axis=1)
    for shape in shapes:
        shape[7] = -np.log((sky.level * relative_radiance(shape, sky.cosine, from_sun)).sum())
    shapes.setflags(write=False)  # shared
    return shapes


def clear_sky_shares(wavelength: ArrayLike, sun_zenith: float, aerosol: float = 0.1) -> Floats:
    """Return the shares of uniform, molecular and aureole function in a clear sky's level irradiance [1].

    Parameters
    ----------
    wavelength : (band,)
        [nm]
    sun_zenith
        [degree]
    aerosol
        Optical depth at 500 nm [1].

    Returns
    -------
    numpy.ndarray
        (3, band), not negative, of sum 1.

    Examples
    --------
    >>> print(clear_sky_shares([450.0, 850.0], 60.0).sum(axis=0))
    [1. 1.]
    """
    tables, wavelengths = _tables(), np.asarray(wavelength, np.float64)
    rows = _between(tables.aerosols, _between(tables.suns, tables.shares, sun_zenith), aerosol)
    shares = np.array([np.interp(wavelengths, tables.wavelengths, row) for row in rows.T])
    return np.asarray(shares / shares.sum(axis=0))


def zenith_radiance(wavelength: ArrayLike, sun_zenith: float, aerosol: float = 0.1) -> Floats:
    """Return the zenith radiance of a clear sky relative to a uniform sky (band,) [1].

    Arguments as for `clear_sky_shares`.

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

    ``angle`` from the zenith, positive towards the sun [degree]; other arguments as for `clear_sky_shares`.

    Examples
    --------
    >>> nm = [450.0]
    >>> radiance_towards_sun(nm, 60.0, 4.0) > radiance_towards_sun(nm, 60.0, -4.0)
    array([ True])
    """
    from_sun = np.cos(np.radians(sun_zenith - angle))
    cosine = np.cos(np.radians(angle))
    parts = [relative_radiance(shape, cosine, from_sun) for shape in function_shapes(float(sun_zenith))]
    return np.asarray(np.array([1.0, *parts]) @ clear_sky_shares(wavelength, sun_zenith, aerosol))


def sunward_gain(wavelength: ArrayLike, sun_zenith: float, aerosol: float = 0.1) -> Floats:
    r"""Return the relative gain of clear-sky light on a surface tilted towards the sun (band,) [1].

    Relative change of diffuse light for a unit change of :math:`c = \cos i / \cos \theta_s`, direct light,
    by a small tilt; arguments as for `clear_sky_shares`.

    Notes
    -----
    A tilt :math:`\beta` towards the sun gives :math:`c - 1 = \beta \tan \theta_s` and, to first order, a gain
    of :math:`\beta \int L \omega_x d\Omega / \int L \omega_z d\Omega` with :math:`\omega_x` level towards the
    sun.
    """
    sky = dome()
    # with the sun at the zenith numerator and denominator vanish, their quotient does not
    zenith = max(float(sun_zenith), 5.0)
    from_sun = scattering_cosine(sky.cosine, sky.azimuth, zenith)
    sunward = np.sqrt(1.0 - sky.cosine**2) / sky.cosine * np.cos(sky.azimuth)
    sums = [
        (sky.level * sunward * relative_radiance(shape, sky.cosine, from_sun)).sum()
        for shape in function_shapes(zenith)
    ]
    return np.asarray(
        np.array([0.0, *sums]) / np.tan(np.radians(zenith)) @ clear_sky_shares(wavelength, zenith, aerosol)
    )


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
    [1.3 1.8] [1.]
    """
    sky = dome()
    azimuth = np.concatenate([sky.azimuth, -sky.azimuth], axis=1)
    cosine, level = np.tile(sky.cosine, 2), np.tile(sky.level, 2)
    slope, from_normal = np.radians(angle), azimuth - np.radians(from_sun)
    facing = np.cos(slope) + np.sin(slope) * np.sqrt(1.0 - cosine**2) / cosine * np.cos(from_normal)
    weight = level * np.maximum(facing, 0.0)
    weight /= weight.sum()
    to_sun = scattering_cosine(cosine, azimuth, sun_zenith)
    shapes = function_shapes(float(sun_zenith))
    gains = np.array([1.0, *((weight * relative_radiance(shape, cosine, to_sun)).sum() for shape in shapes)])
    # written as a departure from 1, so that a level surface gives 1 to the last bit
    return np.asarray(1.0 + (gains - 1.0) @ clear_sky_shares(wavelength, sun_zenith))


FUNCTIONS = ("uniform", "molecular", "aureole")
MIN_DIRECTIONS = 6


@takes_quantities(sun_zenith="degree")
def fit_sky(table: xr.Dataset, sun_zenith: float) -> xr.Dataset:
    r"""Return the shares of the sky functions that fit a table of sky radiance best.

    Parameters
    ----------
    table
        Has ``sky_radiance`` (wavelength, sky_zenith, sky_azimuth) [W m-2 sr-1 nm-1], azimuth from the sun
        [degree], as the readers of `hyperpaint.io.skies` return it; directions below the horizon are ignored.
    sun_zenith
        [degree]

    Returns
    -------
    Dataset
        ``share`` (wavelength, function) of the level irradiance, not negative, of sum 1; ``misfit``
        (wavelength), the relative residual, root mean square over directions as level ground weights them.

    Raises
    ------
    SchemaError
        There is no radiance, or fewer than 6 directions above the horizon.

    Notes
    -----
    :math:`\min_{s \ge 0} \sum_j w_j (\sum_k s_k f_k(j) / L_j - 1)^2` with :math:`w_j = \cos \theta_j
    \Delta \Omega_j` (C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, 1974).

    Examples
    --------
    >>> import xarray as xr
    >>> dims, degree = ("wavelength", "sky_zenith", "sky_azimuth"), {"units": "degree"}
    >>> even = np.full((1, 4, 4), 0.1)
    >>> table = xr.Dataset(
    ...     {"sky_radiance": (dims, even, {"units": "W m-2 sr-1 nm-1"})},
    ...     {"wavelength": ("wavelength", [550.0], {"units": "nm"}),
    ...      "sky_zenith": ("sky_zenith", [10.0, 30.0, 50.0, 70.0], degree),
    ...      "sky_azimuth": ("sky_azimuth", [0.0, 60.0, 120.0, 180.0], degree)},
    ... )
    >>> fit_sky(table, 40.0).share.values.round(6)
    array([[1., 0., 0.]])
    """
    from scipy.optimize import nnls

    SchemaError.raise_if(
        "sky_radiance" not in table.variables,
        "the table of the sky has no sky_radiance (wavelength, sky_zenith, sky_azimuth)",
        code="variable-missing",
    )
    sky = convert(table["sky_radiance"], "W m-2 sr-1 nm-1").transpose(
        "wavelength", "sky_zenith", "sky_azimuth"
    )
    angles = [
        np.radians(convert(table[name].reset_coords(drop=True), "degree").values) for name in sky.dims[1:]
    ]
    zenith, azimuth = np.meshgrid(*angles, indexing="ij")
    cosine = np.cos(zenith)
    is_above_horizon = (cosine > 1e-3) & (sky.values > 0.0).all(axis=0)
    SchemaError.raise_if(
        is_above_horizon.sum() < MIN_DIRECTIONS,
        f"sky_radiance has {int(is_above_horizon.sum())} directions above the horizon",
        expected=f"{MIN_DIRECTIONS} or more",
        code="sky-directions-few",
    )
    zenith_step = np.abs(np.gradient(angles[0]))[:, None] if angles[0].size > 1 else np.ones((1, 1))
    weight = (cosine * np.maximum(np.sin(zenith), 1e-3) * zenith_step)[is_above_horizon]
    from_sun = scattering_cosine(cosine[is_above_horizon], azimuth[is_above_horizon], sun_zenith)
    parts = [
        relative_radiance(shape, cosine[is_above_horizon], from_sun)
        for shape in function_shapes(float(sun_zenith))
    ]
    functions = np.stack([np.ones_like(from_sun), *parts], axis=1)
    scale = np.sqrt(weight / weight.sum())
    shares, misfit = [], []
    for radiance in sky.values[:, is_above_horizon]:
        sums, residual = nnls(functions * (scale / radiance)[:, None], scale)
        shares.append(sums / sums.sum())
        misfit.append(residual)
    return xr.Dataset(
        {
            "share": (("wavelength", "function"), np.array(shares), {"units": "1"}),
            "misfit": ("wavelength", np.array(misfit), {"units": "1"}),
        },
        {"wavelength": table["wavelength"].variable, "function": list(FUNCTIONS)},
    )


# --- clear skies -------------------------------------------------------------------------------------------

#: Relative air mass at which the table's cells of 1 nm have their depths [1].
TABLE_AIR_MASS = 1.5

OZONE_HEIGHT_KM, EARTH_RADIUS_KM = 22.0, 6370.0


class SunlightTable(NamedTuple):
    """Sunlight above the air and absorption by gases; every field has shape (wavelength,).

    Attributes
    ----------
    wavelength
        300 to 2500, steps of 1 up to 1700, of 5 beyond [nm].
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
    """Return the table that comes with the package.

    Examples
    --------
    >>> table = sunlight_table()
    >>> print(np.interp(550.0, table.wavelength, table.extraterrestrial).round(3))
    1.863
    """
    values = table_rows("sunlight_1nm.csv").T
    values.setflags(write=False)  # shared
    return SunlightTable(*values)


def ozone_mass(sun_zenith: float) -> float:
    """Return the relative air mass of a layer of ozone at 22 km (SPECTRL2, eq. 2-10).

    Examples
    --------
    >>> round(ozone_mass(82.0), 2)
    6.19
    """
    height = OZONE_HEIGHT_KM / EARTH_RADIUS_KM
    cosine = np.cos(np.radians(sun_zenith))
    return float((1.0 + height) / np.sqrt(cosine**2 + 2.0 * height))


@dataclass(frozen=True)
class ClearSky:
    r"""The irradiance of level ground under a clear sky.

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
    airmass
        Relative optical air mass of the direct path [1]; None for `hyperpaint.light.sun.air_mass`.

    Raises
    ------
    SchemaError
        The sun is not above the horizon.

    Notes
    -----
    Transmittances :math:`t_{dir}, t_{dif}` by scattering are those of SPECTRL2
    (`hyperpaint.light.sun.scattered_light`). Gases transmit :math:`T_{gas}`:

    .. math:: E_{dir} = E_0 t_{dir} T_{gas}, \quad E_{dif} = E_0 t_{dif} T_{gas}, \quad
              T_{gas} = e^{-k_{O_3} c_{O_3} m_{O_3} - (\tau_{mix} + w \tau_{H_2O}) m}

    with the absorption :math:`k_{O_3}`, column :math:`c_{O_3}` and air mass :math:`m_{O_3}` of ozone, the
    optical depths :math:`\tau` of mixed gases and of the water of ASTM G173 at air mass 1, ``water`` w, and
    the air mass m.

    ASTM G173-03; R. E. Bird and C. Riordan, J. Climate Appl. Meteor. 25, 87 (1986),
    doi:10.1175/1520-0450(1986)025<0087:SSSMFD>2.0.CO;2.

    Examples
    --------
    >>> direct, diffuse = ClearSky(sun_zenith=25.0).irradiance(np.array([450.0, 550.0, 850.0]))
    >>> print(direct.round(2), diffuse.round(2))
    [1.29 1.33 0.76] [0.38 0.22 0.05]
    """

    sun_zenith: float = 25.0
    aerosol: float | Floats = 0.10
    angstrom: float | Floats = 1.14
    ozone: float | Floats = 0.31
    water: float | Floats = 1.0
    pressure: float | Floats = 101_325.0
    ground: float | Floats = 0.2
    airmass: float | None = None

    def __post_init__(self) -> None:
        SchemaError.raise_if(
            not 0.0 <= self.sun_zenith < 90.0,
            f"sun_zenith is {self.sun_zenith!r}",
            expected="0 to below 90 degrees",
            code="value-out-of-range",
        )

    @property
    def mass(self) -> float:
        # Relative optical air mass of the direct path [1].
        return float(air_mass(self.sun_zenith)) if self.airmass is None else self.airmass

    def irradiance(self, wavelength: Floats) -> tuple[Floats, Floats]:
        # Return direct and diffuse irradiance of level ground [W m-2 nm-1], at the resolution of the table.
        #
        # Takes ``wavelength`` (point,), 300 to 2500 [nm]; `SchemaError` beyond.
        if wavelength.size and not 300.0 <= wavelength.min() <= wavelength.max() <= 2500.0:
            raise SchemaError(
                f"wavelength goes from {wavelength.min():g} to {wavelength.max():g} nm",
                expected="300 to 2500 nm",
                code="value-out-of-range",
            )
        table = sunlight_table()
        above, mixed, water = (
            np.interp(wavelength, table.wavelength, part)
            for part in (table.extraterrestrial, table.mixed, table.water)
        )
        return self.below(wavelength, above, mixed + self.water * water)

    def below(self, wavelength: Floats, above: Floats, depth: Floats) -> tuple[Floats, Floats]:
        # Return direct and diffuse irradiance of level ground for other sunlight and other bands of gases.
        #
        # Takes ``above``, sunlight above the air [W m-2 nm-1], and ``depth``, the optical depth of mixed
        # gases and water for one air mass [1], both (point,) at ``wavelength`` [nm].
        table = sunlight_table()
        ozone = self.ozone * np.interp(wavelength, table.wavelength, table.ozone)
        gases = above * np.exp(-ozone * ozone_mass(self.sun_zenith) - depth * self.mass)
        air = Scatterers(self.aerosol, self.angstrom, self.pressure, self.ground)
        direct, diffuse = scattered_light(wavelength, self.sun_zenith, air, self.mass)
        return gases * direct, gases * diffuse
