"""Statistics of agreement of two spectra, and the resampling that brings both onto common bands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.light.responses import Responses, matching_operator

from .dataset_spectra import Measured
from .validation_result import STATISTICS

#: Minimum number of bands for the shape of a spectrum: with one band, angle and scale-free error are 0.
_MIN_SHAPE_BANDS = 3


def statistics_of(signature: Floats, reference: Floats) -> dict[str, Floats]:
    r"""Return the statistics of agreement over the last axis.

    Takes ``signature``, ``reference`` (..., band): reflectance [1] without missing values. The result has the
    names in `STATISTICS`, in units of 1, the angle in degree. All are NaN without bands; angle, scale and
    scale-free error also where a spectrum is zero, angle and scale-free error also with fewer than three
    bands.

    Notes
    -----
    With :math:`d = s - r` over n bands,

    .. math:: bias = \bar d, \quad RMSE = \sqrt{\overline{d^2}}, \quad MAE = \overline{|d|}, \quad
              \theta = \angle(s, r), \quad k = \frac{s \cdot r}{r \cdot r}, \quad
              e = \sqrt{\overline{(s / k - r)^2}} .

    k is the scale factor of the least-squares fit of the reference to the signature, e the RMS difference
    after the signature is divided by k; e over the RMS of the reference is :math:`\tan\theta`. The angle is
    computed as :math:`2 \arctan(|\hat s - \hat r| / |\hat s + \hat r|)` of the unit vectors [1]_, since the
    cosine is imprecise for small angles.

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
    signature_length, reference_length = (
        np.sqrt((spectrum**2).sum(axis=-1, keepdims=True)) for spectrum in (signature, reference)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        # both scaled to the same length
        s, r = signature * reference_length, reference * signature_length
        angle = 2.0 * np.arctan2(_length(s - r), _length(s + r))
        scale = (signature * reference).sum(axis=-1, keepdims=True) / reference_length**2
        residual = signature / np.where(scale > 0.0, scale, np.nan) - reference
    has_shape = shape[-1] >= _MIN_SHAPE_BANDS
    has_angle = has_shape & ((signature_length * reference_length)[..., 0] > 0.0)
    return {
        "bias": difference.mean(axis=-1),
        "rmse": np.sqrt((difference**2).mean(axis=-1)),
        "mae": np.abs(difference).mean(axis=-1),
        "spectral_angle": np.where(has_angle, np.degrees(angle), np.nan),
        "scale": scale[..., 0],
        "scale_free_error": np.where(has_shape, np.sqrt((residual**2).mean(axis=-1)), np.nan),
    }


def _length(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt((vectors**2).sum(axis=-1)))


def uncertainty_of(
    signature: Floats, reference: Floats, signature_errors: Floats, reference_errors: Floats
) -> dict[str, Floats]:
    r"""Return the standard uncertainty of every statistic of `statistics_of`.

    Takes ``signature``, ``reference`` (band,): reflectance [1]; ``signature_errors``, ``reference_errors``
    (draw, band): random draws of their errors [1].

    Notes
    -----
    By propagation of distributions (JCGM 101:2008): with f the statistic,

    .. math:: u_f = \sqrt{\overline{\big(f(s + \delta s, r + \delta r) - f(s, r)\big)^2}} .

    The deviations are from the statistic of the exact spectra, not from the mean of the draws: noise only
    increases RMSE, MAE and angle, so that the spread about their mean would be too small for equal spectra.
    """
    exact = statistics_of(signature, reference)
    draws = statistics_of(signature + signature_errors, reference + reference_errors)
    return {name: np.asarray(np.sqrt(((draws[name] - exact[name]) ** 2).mean())) for name in STATISTICS}


#: Maximum difference of equal wavelengths [nm].
_MAX_EQUAL_NM = 1e-3
#: Maximum ratio of equal widths [1].
_MAX_EQUAL_WIDTH_RATIO = 1.02
#: Maximum factor by which resampling may multiply noise; channels much wider than a band exceed it.
_MAX_NOISE_GAIN = 3.0


@dataclass(frozen=True, eq=False)
class Operator:
    """Linear resampling of the channels of a spectrum to bands."""

    weights: (
        Floats | None
    )  #: (band, channel): Weights, rows sum to 1; None where channels and bands are equal.
    #: (band,): Whether a band is covered completely, and not too narrow for the channels.
    is_covered: npt.NDArray[np.bool_]
    #: (band,): Part of a band's response covered by the channels [1]; 0 where channels within are missing.
    coverage: Floats
    misfit: Floats  #: (band,): See `hyperpaint.light.responses.Matching`.
    noise_gain: Floats  #: (band,): See `hyperpaint.light.responses.Matching`.

    def __call__(self, values: Floats) -> Floats:
        """Return values (..., channel) on the bands (..., band); NaN in bands that are not covered."""
        on_bands = np.full((*values.shape[:-1], self.is_covered.size), np.nan)
        if self.weights is None:
            on_bands[..., self.is_covered] = values[..., self.is_covered]
            return on_bands
        # channels without weight may be missing
        channels = np.flatnonzero(self.weights[self.is_covered].any(axis=0))
        on_bands[..., self.is_covered] = (
            values[..., channels] @ self.weights[np.ix_(self.is_covered, channels)].T
        )
        return on_bands


def bands_of(signature: Measured, references: list[Measured]) -> Measured:
    """Return the spectrum whose channels are the common bands: the coarser one.

    This is the signature, unless every reference is coarser in the common range.
    """
    low, high = signature.wavelength[[0, -1]]
    widths = []
    for reference in references:
        in_range = (reference.wavelength >= low) & (reference.wavelength <= high)
        widths.append(np.median(reference.fwhm[in_range]) if in_range.any() else 0.0)
    is_coarser = min(widths) > _MAX_EQUAL_WIDTH_RATIO * np.median(signature.fwhm)
    return references[0] if is_coarser else signature


def operator_onto(bands: Measured, spectrum: Measured) -> Operator:
    """Return the operator that resamples a spectrum to the channels of the spectrum ``bands``.

    Equal channels need no weights. Missing samples of ``spectrum`` count as not covered; missing samples of
    ``bands`` are ignored.
    """
    is_finite = np.isfinite(spectrum.values)
    if (
        bands.wavelength.shape == spectrum.wavelength.shape
        and (np.abs(bands.wavelength - spectrum.wavelength) <= _MAX_EQUAL_NM).all()
        and np.allclose(bands.fwhm, spectrum.fwhm, rtol=_MAX_EQUAL_WIDTH_RATIO - 1.0)
    ):
        zero = np.where(is_finite, 0.0, np.nan)
        return Operator(None, is_finite, is_finite.astype(np.float64), zero, zero + 1.0)
    size = bands.wavelength.size
    reach = 3.0 * (bands.fwhm.max() + spectrum.fwhm.max())
    near = spectrum.wavelength >= bands.wavelength.min() - reach
    channels = np.flatnonzero(is_finite & near & (spectrum.wavelength <= bands.wavelength.max() + reach))
    weights = np.zeros((size, spectrum.wavelength.size))
    if channels.size < 2:
        zeros, unknown = np.zeros(size), np.full(size, np.nan)
        return Operator(weights, zeros.astype(bool), zeros, unknown, unknown)
    centre, width = spectrum.wavelength[channels], spectrum.fwhm[channels]
    matching = matching_operator(Responses(centre, width), Responses(bands.wavelength, bands.fwhm))
    # bands over gaps: channels farther from one another than two of their widths
    is_gap = np.diff(centre) > 2.0 * np.maximum(width[1:], width[:-1])
    has_gap = np.zeros(size, bool)
    for start, stop in zip(centre[:-1][is_gap], centre[1:][is_gap], strict=True):
        has_gap |= (bands.wavelength + bands.fwhm > start) & (bands.wavelength - bands.fwhm < stop)
    # False for an unknown noise gain, NaN
    is_covered = ~has_gap & (matching.noise_gain[0] <= _MAX_NOISE_GAIN)
    weights[np.ix_(is_covered, channels)] = matching.weights[0][is_covered]
    return Operator(
        weights,
        is_covered,
        np.where(has_gap, 0.0, matching.coverage[0]),
        matching.misfit[0],
        matching.noise_gain[0],
    )
