"""At which angle to the mirror image of the sun a panel was seen, and what changes over that angle.

A metallic paint has no one reflectance: flakes lie nearly level, and mirror most around the direction in
which the panel mirrors the sun. Its signature holds at a geometry, which is stated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE

#: Share of the pixels at the bright, and at the dark end of a panel, whose means are compared [1].
FLOP_SHARE = 0.2

#: Pixels from which on both ends of a panel are told.
MIN_FLOP_MEMBERS = 20

#: Share of a panel's pixels that have a value in a band, from which on it counts [1].
MIN_BAND_SHARE = 0.9

#: Lean of a panel up to which its change of brightness is taken for one [degree].
MAX_LEAN_DEG = 15.0


def aspecular_angle(
    sun_zenith: npt.ArrayLike, view_zenith: npt.ArrayLike, relative_azimuth: npt.ArrayLike
) -> Floats:
    r"""Return the angle between the view and the direction in which a level panel mirrors the sun [degree].

    NaN where one of the angles is not known.

    Parameters
    ----------
    sun_zenith, view_zenith
        Angles from the vertical [degree].
    relative_azimuth
        Between the azimuths of sun and camera [degree], 0 where the sun is behind the camera.

    Notes
    -----
    .. math:: \cos \alpha = \cos \theta_s \cos \theta_v - \sin \theta_s \sin \theta_v \cos \varphi

    since the mirror direction has the sun's zenith angle and the opposite azimuth. Where the panel leans by
    :math:`\beta`, that direction turns by up to :math:`2 \beta`. ASTM E2194 has the angles that paint shops
    measure metallic paints at: 15, 45 and 110 degrees.

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


class PanelFlop(NamedTuple):
    """What changes from the dark to the bright end of a panel."""

    spectrum: Floats  #: (band,): Bright end less dark end, over their mean [1]; NaN where not known.
    contrast: float  #: The same of the mean over all bands [1].


def panel_flop(members: Array, good: Array) -> PanelFlop:
    r"""Return the change of reflectance from the dark to the bright end of a panel.

    Parameters
    ----------
    members : (member, band)
        Reflectance of pixels of the panel [1]; NaN beyond the last.
    good : (band,)
        Bands by which pixels are put in order.

    Notes
    -----
    Pixels are put in order by their mean over bands relative to the panel's; the ends are the means of the
    first and the last fifth, :math:`\rho_1` and :math:`\rho_5`:

    .. math:: \frac{2 (\rho_5 - \rho_1)}{\rho_5 + \rho_1}

    Of solid paint that is :math:`f_{dir} \Delta c / c`, what lean alone changes, without features of the
    paint; flakes and pearl show their own spectrum in it. Noise of single pixels, which the order would make
    a change of, is divided by the root of the number of bands.
    """
    there = np.isfinite(members[:, good]).all(axis=1)
    values = members[there].astype(np.float64)
    if len(values) < MIN_FLOP_MEMBERS or not good.any():
        return PanelFlop(np.full(members.shape[1], np.nan), np.nan)
    middle = np.median(values[:, good], axis=0)
    order = np.argsort((values[:, good] / np.maximum(middle, 1e-6)).mean(axis=1), kind="stable")
    count = max(1, round(FLOP_SHARE * len(values)))
    dark, bright = values[order[:count]].mean(axis=0), values[order[-count:]].mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        spectrum = np.where(dark + bright > 0.0, 2.0 * (bright - dark) / (bright + dark), np.nan)
    whole = bright[good].mean() + dark[good].mean()
    contrast = 2.0 * float(bright[good].mean() - dark[good].mean()) / whole if whole > 0.0 else np.nan
    return PanelFlop(spectrum, contrast)


def lean_range(contrast: npt.ArrayLike, sun_zenith: npt.ArrayLike, direct: npt.ArrayLike) -> Floats:
    r"""Return by how much the ends of a panel may lean from one another, at the most [degree].

    As much as turns its light by the contrast that is seen, :math:`f_{dir} \tan \theta_s \, \Delta \beta`,
    were it solid; flakes change faster, so that their panel leans less. At most `MAX_LEAN_DEG`, which is also
    what is said where the light tells nothing of the lean; NaN where no contrast is known.

    Takes the ``contrast`` of `panel_flop`, the zenith angle of the sun [degree] and the ``direct`` part of
    the irradiance [1].

    Examples
    --------
    >>> lean_range([0.1, 0.1], [45.0, 0.0], 0.8).round(1)
    array([ 7.1, 15. ])
    """
    slope = np.asarray(direct, np.float64) * np.tan(np.radians(np.asarray(sun_zenith, np.float64)))
    lean = np.degrees(np.arctan(np.abs(np.asarray(contrast, np.float64)) / np.maximum(slope, 1e-9)))
    return np.asarray(np.minimum(lean, MAX_LEAN_DEG))


def with_panel_geometry(library: xr.Dataset) -> xr.Dataset:
    """Return a library that says at which angle to the sun's mirror image its panels were seen.

    Adds ``aspecular_angle`` (signature), of a level panel, ``aspecular_range`` (signature), by how much it
    may differ between the ends of the panel: twice `lean_range` [degree], and ``flop`` (signature, band),
    `panel_flop` of the members [1]; NaN where members, sun or view are not known.
    """
    good = library["good"].values.astype(bool)
    members = library["member_reflectance"].transpose(SIGNATURE, ..., BAND).values
    # a band that pixels lack, as one without irradiance, leaves none of them out
    there = np.isfinite(members)
    held = there.sum(axis=1) > MIN_BAND_SHARE * there.any(axis=2).sum(axis=1)[:, None]
    flops = [panel_flop(of_paint, good & bands) for of_paint, bands in zip(members, held, strict=True)]
    contrast = np.array([flop.contrast for flop in flops])
    # where no split is known, all of the light turns with the panel: the least lean that explains a change
    direct = np.ones(len(flops))
    if "diffuse_fraction" in library.variables:
        split = library["diffuse_fraction"].transpose(SIGNATURE, BAND).values
        direct = 1.0 - np.array(
            [np.nanmean(row[good]) if np.isfinite(row[good]).any() else 0.0 for row in split]
        )
    zenith, view, turn = (library[name].values for name in ("sun_zenith", "view_zenith", "relative_azimuth"))
    found = {
        "aspecular_angle": (SIGNATURE, aspecular_angle(zenith, view, turn)),
        "aspecular_range": (SIGNATURE, 2.0 * lean_range(contrast, zenith, direct)),
        "flop": ((SIGNATURE, BAND), np.array([flop.spectrum for flop in flops], np.float32)),
    }
    return library.assign(
        {
            name: xr.DataArray(values, dims=dims, attrs=LIBRARY_VARIABLES[name].attrs)
            for name, (dims, values) in found.items()
        }
    )
