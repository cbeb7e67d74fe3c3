"""Spectral irradiance of a clear sky, direct and diffuse, at 1 nm.

In comes the state of the air and the sun's zenith angle; out go spectra. The chain and the simulator share
this module, `sun` and `sky_functions`, so neither tests them for the other: the tests compare with tables of
ASTM G173 and SPECTRL2 by pvlib. `sky_functions` distributes diffuse light over directions.

Above the air: the extraterrestrial spectrum of ASTM G173 at 1 nm. Rayleigh, Angstrom aerosol, ozone and the
coupling of ground and air: SPECTRL2 (Bird & Riordan, J. Climate Appl. Meteor. 25, 87, 1986). Oxygen, carbon
dioxide and water: the rest of G173's direct beam after these, as optical depths of 1 nm cells.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Floats

from .sky_functions import table_rows
from .sun import Scatterers, air_mass, scattered_light

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
