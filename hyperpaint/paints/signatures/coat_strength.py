r"""Sky mirrored by a coat relative to its Fresnel reflectance, from the variation of pixels of a body part.

A pixel of a body part that leans towards the sun by :math:`\beta` gets more direct light, and mirrors the sky
:math:`2 \beta` nearer to the sun. To first order its spectrum changes by

.. math:: \beta \left[ \tan\theta_s (f_{dir} + g f_{dif}) (\bar\rho - k F_0 f_{dif} L_z)
          + 2 k F_0 f_{dif} L' \right]

with the zenith radiance :math:`L_z` over the mean of the sky, the slope of radiance towards the sun
:math:`L'`, the gain of diffuse light g, and the coat's strength k: 1 where it mirrors as its index predicts.
The first principal component of a region's pixels is proportional to this change. Amounts of its two terms
are fitted to the component; their quotient is k. Only on a dark body is the mirrored part large enough to be
measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.mirrored_light import EXCLUDED, mirror_reflection
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.light.sky_functions import radiance_towards_sun, sunward_gain
from hyperpaint.surroundings.corrections import NORMAL_REFLECTANCE


@dataclass(frozen=True)
class StrengthRules:
    """Conditions under which the strength of a coat can be measured.

    Attributes
    ----------
    min_members
        Minimum number of member pixels: fewer have no reliable principal component.
    sun_zenith_deg
        Minimum and maximum zenith angle of the sun [degree]: under a high sun leans change the light little,
        under a low sun terms of higher order matter.
    min_share
        Minimum share of the pixels' variance in the first component [1]: below, it is noise.
    max_misfit
        Maximum part of the component that the two amounts do not explain [1].
    max_u
        Maximum standard uncertainty of a reported strength [1].
    slope_deg
        Zenith angles to both sides of the zenith for the slope of the sky [degree]: twice a usual lean.
    first_order
        Relative uncertainty of the strength from terms of higher order [1]: from simulated mirroring body
        parts with leans of 2.5 degrees (tests).
    """

    min_members: int = 40
    sun_zenith_deg: tuple[float, float] = (25.0, 70.0)
    min_share: float = 0.5
    max_misfit: float = 0.05
    max_u: float = 0.3
    slope_deg: float = 4.0
    first_order: float = 0.1


RULES = StrengthRules()


class ClearSkyLight(NamedTuple):
    """The light on a body part under a clear sky (band,)."""

    diffuse: Floats  #: Diffuse fraction f_dif [1].
    above: Floats  #: Zenith radiance L_z over the mean of the sky [1].
    slope: Floats  #: Slope L' of the radiance towards the sun [1/rad].
    gain: Floats  #: Gain g of diffuse light, see `sunward_gain` [1].
    sun_zenith: float  #: Zenith angle of the sun [degree].

    @classmethod
    def clear(cls, wavelength: Floats, diffuse: Floats, sun_zenith: float) -> ClearSkyLight:
        """Return the light of a clear sky at bands [nm] with a diffuse fraction [1]."""
        turn = RULES.slope_deg
        towards, away, above = (
            radiance_towards_sun(wavelength, sun_zenith, angle) for angle in (turn, -turn, 0.0)
        )
        slope = (towards - away) / (2.0 * np.radians(turn))
        return cls(diffuse, above, slope, sunward_gain(wavelength, sun_zenith), sun_zenith)


def strength_of(members: Floats, light: ClearSkyLight) -> tuple[float, float, str]:
    """Return a coat's strength [1], its standard uncertainty, and the reason where it cannot be measured.

    ``members`` (member, band): reflectance of single pixels, the mirrored sky included.
    """
    unknown = (np.nan, np.nan)
    if len(members) < RULES.min_members:
        return *unknown, f"{len(members)} pixels, expected {RULES.min_members}"
    low, high = RULES.sun_zenith_deg
    if not low <= light.sun_zenith <= high:
        return *unknown, f"the sun at {light.sun_zenith:.0f} degrees, expected {low:g} to {high:g}"
    mean = members.mean(axis=0)
    scores, sizes, directions = np.linalg.svd(members - mean, full_matrices=False)
    share = float(sizes[0] ** 2 / (sizes**2).sum())
    if not share >= RULES.min_share:
        return *unknown, (
            f"the first principal component has {share:.0%} of the pixels' variance, expected "
            f"{RULES.min_share:.0%}"
        )
    # noise of the component: residuals without it
    residuals = members - mean - np.outer(scores[:, 0] * sizes[0], directions[0])
    noise = np.sqrt((residuals**2).sum(axis=0) / max(len(members) - 2, 1)) / sizes[0]
    noise = np.maximum(noise, 0.2 * np.median(noise) + 1e-9)
    mirror = NORMAL_REFLECTANCE * light.diffuse
    lit = np.tan(np.radians(light.sun_zenith)) * (1.0 - light.diffuse + light.gain * light.diffuse)
    terms = np.stack([lit * mean, 2.0 * mirror * light.slope - lit * mirror * light.above], axis=1)
    scaled_terms, target = terms / noise[:, None], directions[0] / noise
    covariance = np.linalg.inv(scaled_terms.T @ scaled_terms)
    amounts = covariance @ scaled_terms.T @ target
    misfit = directions[0] - terms @ amounts
    unexplained = float((misfit**2).sum())
    if unexplained > RULES.max_misfit:
        return *unknown, f"{unexplained:.0%} of the differences are neither lean nor mirrored sky"
    strength = float(amounts[1] / amounts[0])
    # misfits are smooth over the bands: some ten values of a spectrum are independent
    excess = max(1.0, float(np.mean((misfit / noise) ** 2))) * max(1.0, target.size / 10.0)
    gradient = np.array([-strength, 1.0]) / amounts[0]
    u = float(np.hypot(np.sqrt(gradient @ covariance @ gradient * excess), RULES.first_order * strength))
    if not u <= RULES.max_u:
        return *unknown, f"the body is too bright: the strength would be uncertain by {u:.1f}"
    return strength, u, ""


def with_coat_strength(library: xr.Dataset, sun_zenith: float | None = None) -> xr.Dataset:
    """Return a library with ``coat_strength``, ``coat_strength_u`` and ``coat_strength_reason`` (signature).

    The library holds ``diffuse_fraction``, ``sky_state`` and ``sun_zenith`` of every paint, without a
    correction of the coat; a subtracted mirrored sky is added again. After a correction of the light the
    strength cannot be measured.
    """
    attrs = library["reflectance"].attrs
    restored = NORMAL_REFLECTANCE if mirror_reflection(library) == EXCLUDED else 0.0
    columns: list[tuple[float, float, str]] = []
    good = library["good"].values.astype(bool)
    nm = library["wavelength"].values
    clear = {SKY_STATES.index("clear"), SKY_STATES.index("hazy")}
    for number in range(library.sizes[SIGNATURE]):
        paint = library.isel({SIGNATURE: number})
        members = paint["member_reflectance"].values.astype(np.float64)
        members = members[np.isfinite(members).any(axis=1)]
        # bands at the ends of the spectrum may have no values
        bands = good & (np.isfinite(members).sum(axis=0) > 0.9 * len(members))
        members = members[:, bands][np.isfinite(members[:, bands]).all(axis=1)]
        diffuse, sun = paint["diffuse_fraction"].values[bands].astype(np.float64), float(paint["sun_zenith"])
        sun = sun if sun_zenith is None else sun_zenith  # the argument takes precedence over the clock
        if changed := [name for name in ("light_corrected", "tilt", "coat_corrected") if name in attrs]:
            columns.append((np.nan, np.nan, f"the light was corrected before ({changed[0]})"))
        elif not (np.isfinite(diffuse).all() and np.isfinite(sun)):
            columns.append((np.nan, np.nan, "the diffuse fraction or the position of the sun is unknown"))
        elif int(paint["sky_state"]) not in clear:
            columns.append((np.nan, np.nan, f"the sky is {SKY_STATES[int(paint['sky_state'])]}, not clear"))
        else:
            light = ClearSkyLight.clear(nm[bands], diffuse, min(sun, 89.0))
            columns.append(strength_of(members + restored * light.diffuse * light.above, light))
    names = ("coat_strength", "coat_strength_u", "coat_strength_reason")
    variables: dict[str, Any] = {
        name: (SIGNATURE, np.array(column, object if name.endswith("reason") else np.float64))
        for name, column in zip(names, zip(*columns, strict=True), strict=True)
    }
    result = library.assign(variables).set_coords("coat_strength_reason")
    for name in names:
        result[name].attrs = LIBRARY_VARIABLES[name].attrs
    return result
