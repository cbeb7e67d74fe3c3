"""How bright daylight can be: what tells a series in the wrong units."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import UnitsError

__all__ = ["check_magnitude"]


# Above the atmosphere the sun gives 2.2 W m-2 nm-1 at most and 1.5 in the median of 400-1000 nm, and light
# off clouds hardly adds more than the air takes; 3e-4 is deep twilight, yet more than full sun mistaken for
# W cm-2 nm-1.
_HIGHEST_MEDIAN = 3.0
_LOWEST_MEDIAN = 3e-4
_JUDGED_NM = (400.0, 1000.0)


def check_magnitude(wavelength: Floats, values: Floats) -> None:
    """Refuse a series whose scale no daylight has: its units are others than those given.

    Parameters
    ----------
    wavelength : (irradiance_wavelength,)
        [nm]
    values : (irradiance_time, irradiance_wavelength)
        [W m-2 nm-1]

    Raises
    ------
    UnitsError
        The brightest sample's median over 400-1000 nm is not that of daylight.
    """
    judged = values[:, (wavelength >= _JUDGED_NM[0]) & (wavelength <= _JUDGED_NM[1])]
    judged = judged[np.isfinite(judged).any(axis=1)] if judged.shape[1] else judged[:0]
    if not len(judged):
        return
    medians = np.nanmedian(judged, axis=1)
    brightest = float(medians.max())
    if _LOWEST_MEDIAN <= brightest <= _HIGHEST_MEDIAN:
        return
    direction = (
        f"brighter than the sun above the atmosphere (at most {_HIGHEST_MEDIAN:g} is believed)"
        if brightest > _HIGHEST_MEDIAN
        else f"darker than deep twilight (at least {_LOWEST_MEDIAN:g} is believed)"
    )
    raise UnitsError(
        f"the median irradiance of 400-1000 nm is {brightest:.3g} W m-2 nm-1, {direction}; are the values in "
        "other units (uW labelled as W?) or another quantity, such as counts? Pass units=, or convert them"
    )
