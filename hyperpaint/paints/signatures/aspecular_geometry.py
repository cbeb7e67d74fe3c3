"""Angle between view and mirrored sun on a body part, and the change of reflectance over that angle.

A metallic paint has no single reflectance: flakes lie nearly level, and reflect most around the direction in
which the body part mirrors the sun. Its signature holds at one geometry, which is stated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE

#: Share of the pixels at the bright, and at the dark end of a body part, whose means are compared [1].
FLOP_SHARE = 0.2

#: Minimum number of pixels for a flop.
MIN_FLOP_MEMBERS = 20

#: Minimum share of a body part's pixels with a value in a band that is used [1].
MIN_BAND_SHARE = 0.9

#: Largest lean inferred from a change of brightness [degree].
MAX_LEAN_DEG = 15.0


def aspecular_angle(
    sun_zenith: npt.ArrayLike, view_zenith: npt.ArrayLike, relative_azimuth: npt.ArrayLike
) -> Floats:
    r"""Return the angle between the view and the mirrored sun of a level body part [degree].

    NaN where one of the angles is NaN.

    Parameters
    ----------
    sun_zenith, view_zenith
        Angles from the vertical [degree].
    relative_azimuth
        Between the azimuths of sun and camera [degree], 0 where the sun is behind the camera.

    Notes
    -----
    .. math:: \cos \alpha = \cos \theta_s \cos \theta_v - \sin \theta_s \sin \theta_v \cos \varphi

    since the mirror direction has the sun's zenith angle and the opposite azimuth. Where the body part leans
    by :math:`\beta`, this direction turns by up to :math:`2 \beta`. ASTM E2194 defines the angles at which
    paint shops measure metallic paints: 15, 45 and 110 degrees.

    Examples
    --------
    >>> aspecular_angle([45.0, 45.0, 45.0], [0.0, 45.0, 45.0], [0.0, 180.0, 0.0]).round(6)
    array([45.,  0., 90.])
    """
    sun, view, turn = (
        np.radians(np.asarray(angle, np.float64)) for angle in (sun_zenith, view_zenith, relative_azimuth)
    )
    cosine = np.cos(sun) * np.cos(view) - np.sin(sun) * np.sin(view) * np.cos(turn)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


class Flop(NamedTuple):
    """Change of reflectance from the dark to the bright end of a body part."""

    spectrum: Floats  #: (band,): Bright end less dark end, over their mean [1]; NaN where not known.
    contrast: float  #: The same of the mean over all bands [1].


def flop_of(members: Array, good: Array) -> Flop:
    r"""Return the change of reflectance from the dark to the bright end of a body part.

    Parameters
    ----------
    members : (member, band)
        Reflectance of pixels of the body part [1]; NaN beyond the last.
    good : (band,)
        Bands by which pixels are sorted.

    Notes ----- Pixels are sorted by their mean over bands relative to the body part's; the ends are the means
    of the first and the last fifth, :math:`\rho_1` and :math:`\rho_5`:

    .. math:: \frac{2 (\rho_5 - \rho_1)}{\rho_5 + \rho_1}

    For solid paint this is :math:`f_{dir} \Delta c / c`, the change by lean alone, without features of the
    paint; flakes and pearl show their own spectrum in it. Noise of single pixels, which sorting would turn
    into a change, is divided by the root of the number of bands.
    """
    values = members[np.isfinite(members[:, good]).all(axis=1)].astype(np.float64)
    if len(values) < MIN_FLOP_MEMBERS or not good.any():
        return Flop(np.full(members.shape[1], np.nan), np.nan)
    middle = np.median(values[:, good], axis=0)
    order = np.argsort((values[:, good] / np.maximum(middle, 1e-6)).mean(axis=1), kind="stable")
    count = max(1, round(FLOP_SHARE * len(values)))
    dark, bright = values[order[:count]].mean(axis=0), values[order[-count:]].mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        spectrum = np.where(dark + bright > 0.0, 2.0 * (bright - dark) / (bright + dark), np.nan)
    whole = bright[good].mean() + dark[good].mean()
    contrast = 2.0 * float(bright[good].mean() - dark[good].mean()) / whole if whole > 0.0 else np.nan
    return Flop(spectrum, contrast)


def lean_range(contrast: npt.ArrayLike, sun_zenith: npt.ArrayLike, direct: npt.ArrayLike) -> Floats:
    r"""Return the largest possible lean between the two ends of a body part [degree].

    The lean that changes its light by the observed contrast, :math:`f_{dir} \tan \theta_s \, \Delta \beta`,
    if the paint is solid; flakes change faster, so that their body part leans less. At most `MAX_LEAN_DEG`,
    which is also returned where the light does not depend on the lean; NaN for a contrast of NaN.

    Takes the ``contrast`` of `flop_of`, the zenith angle of the sun [degree] and the ``direct`` part of
    the irradiance [1].

    Examples
    --------
    >>> lean_range([0.1, 0.1], [45.0, 0.0], 0.8).round(1)
    array([ 7.1, 15. ])
    """
    slope = np.asarray(direct, np.float64) * np.tan(np.radians(np.asarray(sun_zenith, np.float64)))
    lean = np.degrees(np.arctan(np.abs(np.asarray(contrast, np.float64)) / np.maximum(slope, 1e-9)))
    return np.asarray(np.minimum(lean, MAX_LEAN_DEG))


def with_aspecular_geometry(library: xr.Dataset) -> xr.Dataset:
    """Return a library with the angles between view and mirrored sun of its body parts, and their flop.

    Adds ``aspecular_angle`` (signature) of a level body part; ``aspecular_range`` (signature), twice
    `lean_range`, its possible variation between the ends of the body part [degree]; and ``flop`` (signature,
    band), `flop_of` of the members [1]; NaN where members, sun or view are unknown.
    """
    good = library["good"].values.astype(bool)
    members = library["member_reflectance"].transpose(SIGNATURE, ..., BAND).values
    # bands that many pixels lack, such as bands without irradiance, are left out, not the pixels
    has_value = np.isfinite(members)
    band_is_used = has_value.sum(axis=1) > MIN_BAND_SHARE * has_value.any(axis=2).sum(axis=1)[:, None]
    flops = [flop_of(of_paint, good & bands) for of_paint, bands in zip(members, band_is_used, strict=True)]
    contrast = np.array([flop.contrast for flop in flops])
    # without a split all light is direct: the smallest lean that explains a change
    direct = np.ones(len(flops))
    if "diffuse_fraction" in library.variables:
        split = library["diffuse_fraction"].transpose(SIGNATURE, BAND).values
        direct = 1.0 - np.array(
            [np.nanmean(row[good]) if np.isfinite(row[good]).any() else 0.0 for row in split]
        )
    zenith, view, turn = (library[name].values for name in ("sun_zenith", "view_zenith", "relative_azimuth"))
    variables = {
        "aspecular_angle": (SIGNATURE, aspecular_angle(zenith, view, turn)),
        "aspecular_range": (SIGNATURE, 2.0 * lean_range(contrast, zenith, direct)),
        "flop": ((SIGNATURE, BAND), np.array([flop.spectrum for flop in flops], np.float32)),
    }
    return library.assign(
        {
            name: xr.DataArray(values, dims=dims, attrs=LIBRARY_VARIABLES[name].attrs)
            for name, (dims, values) in variables.items()
        }
    )
