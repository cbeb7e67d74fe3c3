"""The responsivity of a camera from its gains, and its slope, which weighs the light within one band."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .constants import finite_mean
from .schema import ArrayLike, Floats


def responsivity_slope(arrays: Mapping[str, Any]) -> Floats | None:
    # Return d ln R / d wavelength of every band [nm-1] from a line's small variables; None where unknown.
    #
    # The slope of the whole camera, where it is stored: bands and columns may have been selected since.
    if "responsivity_slope" in arrays or "radiance_gain" not in arrays:
        stored = arrays.get("responsivity_slope")
        return None if stored is None else np.asarray(stored, np.float64)
    wavelength = np.asarray(arrays["wavelength"], np.float64)
    width = 2.0 * np.broadcast_to(np.asarray(arrays["fwhm"], np.float64), wavelength.shape)
    return log_slope(wavelength, mean_responsivity(arrays["radiance_gain"]), width)


def mean_responsivity(gain: ArrayLike) -> Floats:
    # Return the mean responsivity of every band, any scale, from gains (band, column).
    #
    # Gains that are not positive and finite are left out; NaN for a band without a usable gain.
    gain = np.asarray(gain, np.float64)
    usable = np.isfinite(gain) & (gain > 0)
    return finite_mean(np.where(usable, 1.0 / np.where(usable, gain, 1.0), np.nan), axis=1)


def log_slope(wavelength: Floats, responsivity: Floats, width: Floats) -> Floats:
    # Return d ln R / d wavelength at every band [nm-1].
    #
    # It is the slope of a parabola through the neighbours of a band. At the ends of the array, where they lie
    # on one side, the slope of a straight line would include curvature.
    #
    # ``responsivity`` (band,) is of any scale; values that are not positive and finite are left out.
    # ``width`` (band,) is the half width of the window of the fit [nm].
    usable = np.isfinite(responsivity) & (responsivity > 0)
    log = np.log(np.where(usable, responsivity, 1.0))
    distance = (wavelength - wavelength[:, None]) / width[:, None]
    is_near = usable & (np.abs(distance) <= 1.0)
    terms = [np.zeros(is_near.shape) for _ in range(5)]
    for power, term in enumerate(terms):
        term[is_near] = (
            distance[is_near] ** power
        )  # near bands only: powers of all take longer than the matching
    sums = [term.sum(axis=1) for term in terms]
    matrix = np.stack([np.stack(sums[row : row + 3], axis=-1) for row in range(3)], axis=-2)
    right = np.stack([term @ log for term in terms[:3]], axis=-1)
    is_determined = np.linalg.det(matrix) > 1e-9  # a parabola needs three different positions
    slopes = np.zeros(wavelength.shape)
    slopes[is_determined] = (
        np.linalg.solve(matrix[is_determined], right[is_determined, :, None])[:, 1, 0] / width[is_determined]
    )
    return slopes
