"""Reflectance factor of white panels by the directions of light and view, over their certificate.

Angles and wavelengths come in, factors and their uncertainties go out. For panels of a scene, white tiles and
the panels of field spectrometers.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import (
    PANEL_SURFACES,
    ArrayLike,
    Floats,
    Problems,
    SchemaError,
    convert,
    takes_quantities,
)
from hyperpaint.io.spectrometers.spectrum_csv import PANEL_DIRECTIONS, read_panel_table

LAMBERTIAN, SINTERED_PTFE = PANEL_SURFACES

#: Terms of sintered PTFE: coefficient, order in the azimuth, powers of 1 - cos of both zenith angles.
_TERMS = (
    (1.0717, 0, 0, 0), (-0.4129, 0, 0, 1), (0.1772, 0, 0, 2), (-0.5248, 0, 0, 4),
    (0.5600, 0, 1, 1), (-0.2996, 1, 0, 1), (0.0664, 2, 0, 0),
)  # fmt: skip
#: Largest zenith angles of the terms [degree].
_LIMITS = {"sun_zenith": 75.0, "view_zenith": 45.0}
#: Relative standard uncertainty of a plate, and its part of the distance of the factor from 1 [1]: two plates
#: of different makers and laboratories differ by up to twice this.
_LEAST_U, _SPREAD_U = 0.01, 0.3
#: Smallest certified reflectance of white sintered PTFE [1]; darker plates have other factors.
_LEAST_WHITE = 0.9


class PanelFactor(NamedTuple):
    """Reflectance factor of a panel over its certificate.

    Attributes
    ----------
    factor
        Factor (wavelength,) [1].
    u
        Its relative standard uncertainty (wavelength,) [1], without that of the certificate.
    """

    factor: Floats
    u: Floats


def is_lambertian(surface: Any) -> bool:
    # Whether a panel reflects its certificate in all directions.
    return isinstance(surface, str) and surface == LAMBERTIAN


def check_surface(surface: Any, reflectance: Any = 1.0) -> None:
    # Raise `SchemaError` for a surface that is unknown, or is not that of a panel of ``reflectance`` [1].
    is_table = hasattr(surface, "coords") or (
        isinstance(surface, str | os.PathLike) and Path(surface).is_file()
    )
    SchemaError.raise_if(
        not is_table and surface not in PANEL_SURFACES,
        f"surface={surface!r:.80}",
        expected=f"{', '.join(PANEL_SURFACES)}, or a table of factors, or its file",
        mend="see hyperpaint.io.read_panel_table",
        code="panel-surface-unknown",
    )
    level = float(np.nanmedian(reflectance))
    SchemaError.raise_if(
        not is_table and surface == SINTERED_PTFE and level < _LEAST_WHITE,
        f"a panel of reflectance {level:g} with the surface of white sintered PTFE",
        expected=f"{_LEAST_WHITE:g} and more",
        mend="pass a table of the factors of this grey panel, see hyperpaint.io.read_panel_table",
        code="panel-surface-grey",
    )


@takes_quantities(wavelength="nm", sun_zenith="degree", view_zenith="degree", relative_azimuth="degree")
def panel_factor(
    wavelength: ArrayLike,
    sun_zenith: float,
    view_zenith: float = 0.0,
    relative_azimuth: float = 90.0,
    *,
    surface: Any = SINTERED_PTFE,
    direct_share: ArrayLike = 1.0,
) -> PanelFactor:
    r"""Return the reflectance factor of a level white panel under sun and sky, over its certificate.

    The certificate of a panel holds for light from 8 degrees and the whole hemisphere of views. Seen from one
    direction, a panel reflects more than this under a high sun, and less under a low sun.

    Parameters
    ----------
    wavelength : (wavelength,)
        [nm]
    sun_zenith, view_zenith
        Angles of light and view from the normal [degree].
    relative_azimuth
        Azimuth of the light minus that of the camera, seen from the panel [degree]: 0 with the sun behind the
        camera.
    surface
        ``sintered-ptfe`` (such as Spectralon), white, for light up to 75 degrees and views up to 45 degrees;
        ``lambertian``; or the table of a panel's own factors, or its file, see
        `hyperpaint.io.read_panel_table`.
    direct_share : (wavelength,)
        Direct light over all light on the panel [1]; 1 for a lamp.

    Returns
    -------
    PanelFactor
        ``factor`` and its relative standard uncertainty ``u`` (wavelength,) [1]; NaN outside the wavelengths
        of a table. The uncertainty of a table is part of the panel's own.

    Raises
    ------
    SchemaError
        The surface is unknown, or a direction is outside its range; all are listed.
    FormatError
        The file of a table cannot be read.

    Notes
    -----
    With the share f of direct light

    .. math:: R = f R_{dir}(\theta_s, \theta_v, \phi) + (1 - f)

    By reciprocity, a panel under a uniform sky is seen with its directional-hemispherical reflectance for
    light from the direction of the camera: the certificate. Of sintered PTFE this differs by less than 0.2 %
    up to 45 degrees [1]_. Its :math:`R_{dir}` is a reciprocal polynomial of :math:`u = 1 - \cos\theta` and
    the azimuth with seven terms, normalised to the certificate. It is fitted to the measured expansion of
    [1]_ (one plate, mean of 532, 633 and 1064 nm), and reproduces it with a standard deviation of 0.2 % up to
    75 degrees of light and 30 degrees of view; its 351 nm differ from the mean by 0.5 % (standard deviation).
    Other plates differ more: the model of [2]_ by 2 % at 30, 0.6 % at 45, and 2.4 % at 60 degrees of light,
    seen from the nadir. That is less than twice the uncertainty,

    .. math:: u = f \sqrt{0.01^2 + 0.3^2 (R_{dir} - 1)^2}

    The aureole of a clear sky, which lights the panel as the sun does, counts as part of the uniform sky: R
    changes by some 0.3 %.

    References
    ----------
    .. [1] T. A. Germer, "Full four-dimensional and reciprocal Mueller matrix bidirectional reflectance
       distribution function of sintered polytetrafluoroethylene", Appl. Opt. 56, 9333-9340 (2017).
    .. [2] "A Comprehensive BRF Model for Spectralon and Application to Hyperspectral Field Imagery", IEEE
       Trans. Geosci. Remote Sens. (2024), doi:10.1109/TGRS.2024.3361392, with the correction of 2026 to its
       published code.

    Examples
    --------
    >>> [round(panel_factor([550.0], zenith).factor.item(), 3) for zenith in (30.0, 45.0, 60.0, 75.0)]
    [1.046, 1.017, 0.974, 0.888]
    >>> factor, u = panel_factor([450.0, 850.0], 30.0, direct_share=[0.75, 0.93])
    >>> print(factor.round(3), u.round(3))
    [1.034 1.042] [0.013 0.016]
    """
    check_surface(surface)
    nm = np.atleast_1d(np.asarray(wavelength, np.float64))
    share = np.broadcast_to(np.asarray(direct_share, np.float64), nm.shape)
    if is_lambertian(surface):
        return PanelFactor(np.ones(nm.shape), np.zeros(nm.shape))
    table = None
    if hasattr(surface, "coords"):
        table = surface
    elif surface != SINTERED_PTFE:
        table = read_panel_table(surface)
    # directions inside the range of the surface
    azimuth = abs((relative_azimuth + 180.0) % 360.0 - 180.0)
    angles = {"sun_zenith": sun_zenith, "view_zenith": view_zenith, "relative_azimuth": azimuth}
    problems = Problems("the factor of a panel is unknown in this direction", SchemaError)
    for name, angle in angles.items():
        low, high = 0.0, _LIMITS.get(name, 180.0)
        if table is not None:
            known = convert(table[name], "degree").values if name in table.dims else np.array([0.0, 180.0])
            low, high = float(known.min()), float(known.max())
        problems.add_if(
            not low <= angle <= high,
            f"{name} of {angle:.1f} degrees",
            expected=f"{low:g} to {high:g} degrees",
            mend="pass a table of factors that covers it, see hyperpaint.io.read_panel_table",
            code="panel-direction-outside",
        )
    problems.raise_if_any()
    if table is not None:
        # a dimension of one value has no neighbours
        point = {name: angles[name] for name in PANEL_DIRECTIONS if table.sizes.get(name, 1) > 1}
        values = table.interp(point).squeeze(drop=True)
        directional = (
            np.full(nm.shape, float(values))
            if not values.dims
            else np.interp(nm, convert(values["wavelength"], "nm").values, values.values, np.nan, np.nan)
        )
        return PanelFactor(1.0 + share * (directional - 1.0), np.zeros(nm.shape))
    light, view = 1.0 - np.cos(np.radians([sun_zenith, view_zenith]))
    across = np.sin(np.radians(sun_zenith)) * np.sin(np.radians(view_zenith))
    departure = -1.0 + sum(
        coefficient
        * across**order
        * np.cos(order * np.radians(azimuth))
        * (light**a * view**b + light**b * view**a)
        / 2.0
        for coefficient, order, a, b in _TERMS
    )
    return PanelFactor(1.0 + share * departure, share * float(np.hypot(_LEAST_U, _SPREAD_U * departure)))
