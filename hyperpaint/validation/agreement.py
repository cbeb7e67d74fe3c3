"""How far two spectra on the same bands agree, in numbers, and how sure that is."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats

__all__ = ["STATISTICS", "statistics_of", "uncertainty_of"]


STATISTICS = ("bias", "rmse", "mae", "spectral_angle", "scale", "scale_free_error")
"""Names of the statistics: those of a validation's table, and of tolerances."""

_LEAST_SHAPE = 3  # bands: of one, angle and scale-free error are always 0


def statistics_of(signature: Floats, reference: Floats) -> dict[str, Floats]:
    r"""Return the statistics of agreement over the last axis.

    Parameters
    ----------
    signature, reference : (..., band), float64
        Reflectance [1], no value missing.

    Returns
    -------
    dict of (...,), float64
        By the names in `STATISTICS`, [1], of the angle [rad]; NaN without bands, the last three where a
        spectrum is zero, and angle and scale-free error of fewer than three bands, which have no shape.

    Notes
    -----
    With :math:`d = s - r` over n bands,

    .. math:: bias = \bar d, \quad RMSE = \sqrt{\overline{d^2}}, \quad MAE = \overline{|d|}, \quad
              \theta = \angle(s, r), \quad k = \frac{s \cdot r}{r \cdot r}, \quad
              e = \sqrt{\overline{(s / k - r)^2}} .

    k is the factor that brings the reference nearest to the signature, e what is left when the signature is
    divided by it: relative to the RMS of the reference, :math:`\tan\theta`. The angle is
    :math:`2 \arctan(|\hat s - \hat r| / |\hat s + \hat r|)` of the unit vectors [1]_: the cosine cannot tell
    small angles apart.

    References
    ----------
    .. [1] W. Kahan, "How futile are mindless assessments of roundoff in floating-point computation?" (2006),
       section 12, "Mangled angles".

    Examples
    --------
    >>> found = statistics_of(np.array([0.11, 0.22, 0.33]), np.array([0.1, 0.2, 0.3]))
    >>> round(float(found["scale"]), 6), round(float(found["bias"]), 6)
    (1.1, 0.02)
    """
    shape = np.broadcast_shapes(signature.shape, reference.shape)
    if shape[-1] == 0:
        return {name: np.full(shape[:-1], np.nan) for name in STATISTICS}
    difference = signature - reference
    length, other = (np.sqrt((each**2).sum(axis=-1, keepdims=True)) for each in (signature, reference))
    with np.errstate(invalid="ignore", divide="ignore"):
        one, two = signature * other, reference * length
        angle = 2.0 * np.arctan2(_length(one - two), _length(one + two))
        scale = (signature * reference).sum(axis=-1, keepdims=True) / other**2
        left = signature / np.where(scale > 0.0, scale, np.nan) - reference
    shaped = shape[-1] >= _LEAST_SHAPE
    there = shaped & ((length * other)[..., 0] > 0.0)
    return {
        "bias": difference.mean(axis=-1),
        "rmse": np.sqrt((difference**2).mean(axis=-1)),
        "mae": np.abs(difference).mean(axis=-1),
        "spectral_angle": np.where(there, angle, np.nan),
        "scale": scale[..., 0],
        "scale_free_error": np.where(shaped, np.sqrt((left**2).mean(axis=-1)), np.nan),
    }


def _length(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt((vectors**2).sum(axis=-1)))


def uncertainty_of(
    signature: Floats, reference: Floats, signature_errors: Floats, reference_errors: Floats
) -> dict[str, Floats]:
    r"""Return the standard uncertainty of every statistic of `statistics_of`.

    Parameters
    ----------
    signature, reference : (band,)
        Reflectance [1].
    signature_errors, reference_errors : (draw, band)
        What may be wrong with them, at random [1].

    Returns
    -------
    dict of (), float64
        By the names in `STATISTICS`, in their units.

    Notes
    -----
    By propagation of distributions (JCGM 101:2008): with f the statistic,

    .. math:: u_f = \sqrt{\overline{\big(f(s + \delta s, r + \delta r) - f(s, r)\big)^2}} .

    About the value itself rather than the mean of the draws, since noise makes RMSE, MAE and angle larger,
    and never smaller than nothing: of equal spectra they would otherwise seem too sure.
    """
    exact = statistics_of(signature, reference)
    drawn = statistics_of(signature + signature_errors, reference + reference_errors)
    return {name: np.asarray(np.sqrt(((drawn[name] - exact[name]) ** 2).mean())) for name in STATISTICS}
