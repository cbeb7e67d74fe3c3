"""The six equations of the paper on which this package is based, corrected and as printed.

Mulhollan et al. (2020), section 3 [1]_, calibrate a pushbroom camera with a monochromator and a power meter.
As printed, three of their equations lose the scale: eq. 4 inverts the ratio of exposures and uses an area on
the ground instead of the area of the pupil, eq. 5 divides by pi twice, and eq. 6 multiplies radiance by
irradiance instead of dividing. Each equation is a function with a ``variant``, "corrected" (the default) or
"as_printed". The rest of the package uses the corrected chain.

Arguments are numbers or arrays in the stated units, or Quantities of `hyperpaint.base.facts.registry`. If any
argument is a Quantity, the result is one. Units are propagated, and pi is a solid angle [sr]. Where the
dimensions of an equation disagree, pint raises ``DimensionalityError``.

References
----------
.. [1] Z. Mulhollan, A. Rangnekar, T. Bauch, M. J. Hoffman, A. Vodacek, "Calibrated Vehicle Paint
   Signatures for Simulating Hyperspectral Imagery", CVPR Workshops (2020).

Examples
--------
A surface of reflectance 0.4, in both variants:

>>> setup = Setup()
>>> truth = lambertian_radiance(1.30, 0.40)
>>> counts = setup.counts(truth)
>>> print(f"{counts:.2f} {setup.line_amplitude:.2f} {setup.line_area:.2f}")
1966.09 2846.05 8654.12
>>> L = radiance(counts, 0.0, radiance_per_count(setup))
>>> print(f"{L:.6f} {reflectance(L, 1.30):.6f}")
0.165521 0.400000
>>> as_printed = radiance_per_count(setup, variant="as_printed")
>>> print(f"{radiance(counts, 0.0, as_printed, variant='as_printed') / truth:.4f}")
0.0678
>>> reflectance(L, 1.30, variant="as_printed")
Traceback (most recent call last):
pint.errors.DimensionalityError: Cannot convert from 'watt ** 2 / ...' (...) to 'dimensionless' ...
"""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from .base import registry

__all__ = [
    "Setup",
    "electrons",
    "lambertian_radiance",
    "radiance",
    "radiance_per_count",
    "reflectance",
    "spectral_responsivity",
]

Amount: TypeAlias = Any
"""A number or array in the unit stated, or a Quantity."""

Variant = Literal["corrected", "as_printed"]

_RADIANCE = "W m-2 sr-1 nm-1"
_IRRADIANCE = "W m-2 nm-1"
_GAUSSIAN_AREA = float(np.sqrt(np.pi / (4.0 * np.log(2.0))))  # area of a Gaussian of height and FWHM 1
_PLANCK, _LIGHT = 6.62607015e-34, 2.99792458e8  # J s, m s-1


def _is_quantity(value: Amount) -> bool:
    return isinstance(value, registry().Quantity)


def _amount(value: Amount, unit: str) -> Any:
    return value.to(unit) if _is_quantity(value) else registry().Quantity(value, unit)


def _result(amount: Any, unit: str, *arguments: Amount) -> Any:
    # Return ``amount`` in ``unit``: a Quantity if an argument is one, else a number.
    amount = amount.to(unit)
    return amount if any(map(_is_quantity, arguments)) else amount.magnitude


def _is_corrected(variant: str) -> bool:
    if variant not in ("corrected", "as_printed"):
        raise ValueError(f"variant={variant!r}, expected 'corrected' or 'as_printed'")
    return variant == "corrected"


def lambertian_radiance(
    irradiance: Amount, reflectance: Amount, incidence: Amount = 0.0, *, variant: Variant = "corrected"
) -> Any:
    """Return the radiance of a Lambertian surface, eq. 1.

    Parameters
    ----------
    irradiance
        E [W m-2 nm-1]. Corrected: on the surface, as measured by a level cosine-corrected receiver. As
        printed: on a plane that faces the light.
    reflectance
        rho [1]
    incidence
        theta, angle between the light and the surface's normal [rad]; used as printed only.
    variant
        Corrected, ``L = rho E / (pi sr)``; as printed, ``L = E rho cos(theta) / pi``, which applies the
        cosine twice if a level receiver measures E.

    Returns
    -------
    L [W m-2 sr-1 nm-1].

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> round(lambertian_radiance(1.30, 0.40), 6)
    0.165521
    """
    exitance = _amount(irradiance, _IRRADIANCE) * _amount(reflectance, "1")
    if not _is_corrected(variant):
        exitance = exitance * np.cos(_amount(incidence, "rad").magnitude)
    return _result(exitance / _amount(np.pi, "sr"), _RADIANCE, irradiance, reflectance, incidence)


def electrons(
    flux: Amount,
    exposure: Amount,
    wavelength: Amount,
    efficiency: Amount,
    *,
    variant: Variant = "corrected",
) -> Any:
    """Return the electrons that monochromatic light frees, eq. 2: ``S = phi t lambda / (h c) eta``.

    Parameters
    ----------
    flux
        Radiant flux phi [W].
    exposure
        t [s]
    wavelength
        lambda [nm]
    efficiency
        eta, electrons freed per photon [1].
    variant
        Both are equal: the printed equation is correct.

    Returns
    -------
    S [electron].

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> round(electrons(3e-12, 0.05, 550.0, 0.5))
    207657
    """
    _is_corrected(variant)
    photons = (
        _amount(flux, "W")
        * _amount(exposure, "s")
        * _amount(wavelength, "nm")
        / (_amount(_PLANCK, "J s") * _amount(_LIGHT, "m s-1"))
    )
    amount = photons * _amount(efficiency, "1") * _amount(1.0, "electron")
    return _result(amount, "electron", flux, exposure, wavelength, efficiency)


def spectral_responsivity(
    counts: Amount, dark: Amount, flux: Amount, exposure: Amount, *, variant: Variant = "corrected"
) -> Any:
    """Return the responsivity of the camera, equation 3 of the paper.

    Parameters
    ----------
    counts, dark
        Counts with and without light, at the same exposure [count].
    flux
        phi [W]
    exposure
        t [s]; the equation as printed lacks it.
    variant
        Corrected, ``R = (DC - D) / (phi t)``; as printed, ``R = (DC - D) / phi``, which grows with exposure.

    Returns
    -------
    R [count J-1]; as printed [count W-1].

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> print(f"{spectral_responsivity(2946.05, 100.0, 3e-12, 0.05):.4g}")
    1.897e+16
    """
    arguments = counts, dark, flux, exposure
    per_watt = (_amount(counts, "count") - _amount(dark, "count")) / _amount(flux, "W")
    return (
        _result(per_watt / _amount(exposure, "s"), "count J-1", *arguments)
        if _is_corrected(variant)
        else _result(per_watt, "count W-1", *arguments)
    )


@dataclass(frozen=True)
class Setup:
    """A step of the monochromator, and the flight: all inputs of eq. 4. The defaults are a worked example.

    Attributes
    ----------
    flux
        phi_ref, power into the area of slit width x one pixel [W].
    reference_exposure, flight_exposure
        t_ref and t_obs [s].
    etendue
        Etendue of a pixel, slit width x pixel pitch x pi / (4 N^2) [m2 sr].
    ground_sample
        x_obs, side of a pixel on the ground [m]; used as printed only.
    ifov
        theta_IFOV, angle of a pixel [rad], 8 mm from 50 feet; used as printed only.
    reference_bandwidth, flight_bandwidth
        B_ref and B_obs: full widths at half maximum of monochromator and camera [nm].
    band_spacing
        Distance of neighbouring bands [nm].
    peak_responsivity
        Counts per energy at the centre of a band [count J-1]: the truth, from which counts are computed.

    Examples
    --------
    >>> round(Setup().line_area, 2)
    8654.12
    """

    flux: Amount = 3.0e-12
    reference_exposure: Amount = 50e-3
    flight_exposure: Amount = 5e-3
    etendue: Amount = 1.8598e-11
    ground_sample: Amount = 8e-3
    ifov: Amount = 8e-3 / 15.24
    reference_bandwidth: Amount = 2.0
    flight_bandwidth: Amount = 6.0
    band_spacing: Amount = 600.0 / 271.0
    peak_responsivity: Amount = 2.0e16

    def _values(self) -> tuple[Amount, ...]:
        return tuple(vars(self).values())

    @property
    def _lab_counts(self) -> Any:
        # Counts of a band that receives the complete lamp line.
        energy = _amount(self.flux, "W") * _amount(self.reference_exposure, "s")
        return energy * _amount(self.peak_responsivity, "count J-1")

    @property
    def line_amplitude(self) -> Any:
        # A_ref, height above the dark of the Gaussian fitted to the lamp line [count].
        camera_fwhm = _amount(self.flight_bandwidth, "nm")
        total_fwhm = (camera_fwhm**2 + _amount(self.reference_bandwidth, "nm") ** 2) ** 0.5
        return _result(self._lab_counts * camera_fwhm / total_fwhm, "count", *self._values())

    @property
    def line_area(self) -> Any:
        # SUM_ref, sum of the lamp line over the bands, above the dark; independent of the widths [count].
        width = _GAUSSIAN_AREA * _amount(self.flight_bandwidth, "nm")
        return _result(self._lab_counts * width / _amount(self.band_spacing, "nm"), "count", *self._values())

    def counts(self, radiance: Amount) -> Any:
        # Return the counts above the dark of a radiance [W m-2 sr-1 nm-1] in flight.
        width = _GAUSSIAN_AREA * _amount(self.flight_bandwidth, "nm")
        power = _amount(radiance, _RADIANCE) * _amount(self.etendue, "m2 sr") * width
        amount = power * _amount(self.flight_exposure, "s") * _amount(self.peak_responsivity, "count J-1")
        return _result(amount, "count", radiance, *self._values())


def radiance_per_count(setup: Setup, *, variant: Variant = "corrected") -> Any:
    """Return the radiance per count of the flight, eq. 4.

    Parameters
    ----------
    setup
        Lab and flight.
    variant
        Corrected, with the area of the lamp line, ``phi_ref t_ref / (t_obs etendue spacing SUM_ref)``:
        independent of widths and shapes of lamp line and band. As printed, ``phi_ref t_obs / t_ref / (x_obs^2
        theta^2 B_ref / B_obs R_norm)``, called irradiance per count, with R_norm the fitted amplitude in
        counts: the radiance per count then grows with exposure, and falls with the height of the flight.

    Returns
    -------
    [W m-2 sr-1 nm-1 count-1]; as printed [W m-2 count-1].

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> print(f"{radiance_per_count(Setup()):.4e}")
    8.4188e-05
    >>> print(f"{radiance_per_count(Setup(), variant='as_printed'):.4e}")
    1.7931e-05
    """
    flux = _amount(setup.flux, "W")
    lab, flight = _amount(setup.reference_exposure, "s"), _amount(setup.flight_exposure, "s")
    arguments = setup._values()
    if _is_corrected(variant):
        per_line = _amount(setup.band_spacing, "nm") * _amount(setup.line_area, "count")
        amount = flux * (lab / flight) / (_amount(setup.etendue, "m2 sr") * per_line)
        return _result(amount, f"{_RADIANCE} count-1", *arguments)
    footprint = _amount(setup.ground_sample, "m") ** 2 * _amount(setup.ifov, "rad") ** 2
    widths = _amount(setup.reference_bandwidth, "nm") / _amount(setup.flight_bandwidth, "nm")
    amount = flux * (flight / lab) / (footprint * widths * _amount(setup.line_amplitude, "count"))
    return _result(amount, "W m-2 count-1", *arguments)


def radiance(counts: Amount, dark: Amount, per_count: Amount, *, variant: Variant = "corrected") -> Any:
    """Return the radiance at the sensor, eq. 5.

    Parameters
    ----------
    counts, dark
        Counts of the flight and its dark, at the same exposure [count].
    per_count
        From `radiance_per_count` with the same ``variant`` [W m-2 sr-1 nm-1 count-1]; as printed
        [W m-2 count-1].
    variant
        Corrected, ``L = (DC - D) x per_count``; as printed, divided by pi, although dividing by the etendue
        already gives a radiance.

    Returns
    -------
    L [W m-2 sr-1 nm-1]; as printed [W m-2 sr-1], integrated over the band.

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> round(radiance(2066.09, 100.0, 8.4188e-05), 5)
    0.16552
    """
    arguments = counts, dark, per_count
    signal = _amount(counts, "count") - _amount(dark, "count")
    if _is_corrected(variant):
        return _result(signal * _amount(per_count, f"{_RADIANCE} count-1"), _RADIANCE, *arguments)
    amount = signal * _amount(per_count, "W m-2 count-1") / _amount(np.pi, "sr")
    return _result(amount, "W m-2 sr-1", *arguments)


def reflectance(radiance: Amount, irradiance: Amount, *, variant: Variant = "corrected") -> Any:
    """Return the reflectance factor of a level surface, eq. 6.

    Parameters
    ----------
    radiance
        L [W m-2 sr-1 nm-1]
    irradiance
        E, downwelling, as measured by a level receiver [W m-2 nm-1].
    variant
        Corrected, ``rho = pi L / E``; as printed, ``rho = L E / pi``, which is not a reflectance.

    Returns
    -------
    rho [1].

    Raises
    ------
    pint.DimensionalityError
        An argument is a Quantity of another dimension; as printed always.
    ValueError
        ``variant`` is neither "corrected" nor "as_printed".

    Examples
    --------
    >>> round(reflectance(0.165521, 1.30), 5)
    0.4
    """
    L, E = _amount(radiance, _RADIANCE), _amount(irradiance, _IRRADIANCE)
    half_space = _amount(np.pi, "sr")
    amount = half_space * L / E if _is_corrected(variant) else L * E / half_space
    return _result(amount, "1", radiance, irradiance)
