"""What the air between a surface and the camera takes away and adds, per metre.

Extinction is that of air molecules plus haze, such that a black thing vanishes at the visibility V, where 2 %
of its contrast is left: ``k(550 nm) = 3.912 / V`` (Koschmieder 1924). Light scattered into a short vertical
path comes from the sun, from the sky and from the ground; per metre it is ``k_s`` times the source function

    J = E_sun P(Theta) / (4 pi) + beta E_sky / pi + (1 - beta) r E / pi

with the scattering angle ``Theta = 180 deg - sun zenith`` of a camera that looks straight down, the phase
function ``P`` (Rayleigh's; Henyey & Greenstein 1941 for haze), the share ``beta`` of light that is scattered
into the back hemisphere, and the reflectance ``r`` of the surroundings. Over a white ground without a sun,
and where nothing is absorbed, J is the radiance of the sky: then a path changes nothing, as it must.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError

__all__ = ["HAZE", "Haze"]


_CONTRAST = 3.912  # -ln 0.02
_REFERENCE = 550.0  # nm
_MOLECULES = 1.162e-5  # m-1, scattering of air at 550 nm, 1013 hPa and 15 degC (Bucholtz 1995)
_MOLECULES_EXPONENT = -4.08


@dataclass(frozen=True)
class Haze:
    """Air near the ground.

    Attributes
    ----------
    visibility
        Distance at which 2 % of a contrast are left at 550 nm [m]; up to 336 km, that of pure air.
    angstrom
        Exponent of the wavelength in the haze's extinction, positive.
    asymmetry
        Mean cosine of its scattering angle, from above -1 to below 1.
    scattering_albedo
        Share of its extinction that is scattering.
    ground
        Reflectance of the surroundings at all wavelengths.

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

    visibility: float = 23_000.0
    angstrom: float = 1.3
    asymmetry: float = 0.65
    scattering_albedo: float = 0.95
    ground: float = 0.15

    def __post_init__(self) -> None:
        problems = Problems("haze cannot be made", SchemaError)
        longest = _CONTRAST / _MOLECULES
        if not 0.0 < self.visibility <= longest:
            problems.add(f"visibility is {self.visibility!r} m, expected above 0 and up to {longest:.0f} m")
        if not 0.0 <= self.angstrom <= 4.0:
            problems.add(f"angstrom is {self.angstrom!r}, expected 0 to 4")
        if not -1.0 < self.asymmetry < 1.0:
            problems.add(f"asymmetry is {self.asymmetry!r}, expected between -1 and 1")
        for name in ("scattering_albedo", "ground"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                problems.add(f"{name} is {getattr(self, name)!r}, expected 0 to 1")
        problems.raise_if_any()

    def _coefficients(self, wavelength: Floats) -> tuple[Floats, Floats]:
        """Return the extinction of molecules and of haze [m-1]."""
        relative = wavelength / _REFERENCE
        molecules = _MOLECULES * relative**_MOLECULES_EXPONENT
        particles = (_CONTRAST / self.visibility - _MOLECULES) * relative**-self.angstrom
        return molecules, particles

    def extinction(self, wavelength: Floats) -> Floats:
        """Return the extinction coefficient at ``wavelength`` [nm], same shape [m-1]."""
        molecules, particles = self._coefficients(wavelength)
        return np.asarray(molecules + particles)

    def path_radiance(self, wavelength: Floats, sun: Floats, sky: Floats, sun_zenith: float) -> Floats:
        """Return the radiance that a short vertical path adds, per metre [W m-2 sr-1 nm-1 m-1].

        Parameters
        ----------
        wavelength
            Shape (wavelength,) [nm].
        sun, sky
            Direct normal and diffuse horizontal irradiance, shape (wavelength,) [W m-2 nm-1].
        sun_zenith
            Angle between the sun and the vertical [degree].
        """
        cosine = np.cos(np.radians(sun_zenith))
        reflected = self.ground * (sun * cosine + sky)
        molecules, particles = self._coefficients(wavelength)

        def source(phase: float, backward: float) -> Floats:
            diffuse = (backward * sky + (1.0 - backward) * reflected) / np.pi
            return np.asarray(sun * phase / (4.0 * np.pi) + diffuse)

        g = self.asymmetry
        # the sun's light comes down and leaves upwards: the cosine of the scattering angle is -cos(zenith)
        rayleigh = 0.75 * (1.0 + cosine**2)
        henyey_greenstein = float((1.0 - g**2) / (1.0 + g**2 + 2.0 * g * cosine) ** 1.5)
        scattered = self.scattering_albedo * particles * source(henyey_greenstein, _backward_share(g))
        return np.asarray(molecules * source(rayleigh, 0.5) + scattered)


def _backward_share(g: float) -> float:
    """Return the share of Henyey-Greenstein scattering at more than 90 degrees."""
    if abs(g) < 1e-6:
        return 0.5  # the formula is 0/0 there; its slope is -3/4
    return (1.0 - g) / (2.0 * g) * ((1.0 + g) / float(np.sqrt(1.0 + g**2)) - 1.0)


HAZE = Haze()
"""Usual clear air: a visibility of 23 km."""
