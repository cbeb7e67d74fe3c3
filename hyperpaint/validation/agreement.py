"""Statistics of agreement of two spectra, and the resampling that brings both onto common bands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.light.responses import Responses, matching_operator

from .measured_spectra import Measured
from .validation_result import STATISTICS

_MIN_SHAPE_BANDS = 3  # of one band, angle and scale-free error are always 0


def statistics_of(signature: Floats, reference: Floats) -> dict[str, Floats]:
    r"""Return the statistics of agreement over the last axis.

    Takes ``signature``, ``reference`` (..., band): reflectance [1], no value missing. By the names in
    `STATISTICS`, [1], of the angle [degree]; NaN without bands, the last three where a spectrum is zero, and
    angle and scale-free error of fewer than three bands, which have no shape.

    Notes
    -----
    With :math:`d = s - r` over n bands,

    .. math:: bias = \bar d, \quad RMSE = \sqrt{\overline{d^2}}, \quad MAE = \overline{|d|}, \quad
              \theta = \angle(s, r), \quad k = \frac{s \cdot r}{r \cdot r}, \quad
              e = \sqrt{\overline{(s / k - r)^2}} .

    k is the factor that brings the reference nearest to the signature, e the difference that remains after
    dividing the signature by it: relative to the RMS of the reference, :math:`\tan\theta`. The angle is
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
    shaped = shape[-1] >= _MIN_SHAPE_BANDS
    return {
        "bias": difference.mean(axis=-1),
        "rmse": np.sqrt((difference**2).mean(axis=-1)),
        "mae": np.abs(difference).mean(axis=-1),
        "spectral_angle": np.where(shaped & ((length * other)[..., 0] > 0.0), np.degrees(angle), np.nan),
        "scale": scale[..., 0],
        "scale_free_error": np.where(shaped, np.sqrt((left**2).mean(axis=-1)), np.nan),
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

    About the value itself rather than the mean of the draws: noise only increases RMSE, MAE and angle, which
    cannot be negative, so that the spread about the mean would be too small for equal spectra.
    """
    exact = statistics_of(signature, reference)
    drawn = statistics_of(signature + signature_errors, reference + reference_errors)
    return {name: np.asarray(np.sqrt(((drawn[name] - exact[name]) ** 2).mean())) for name in STATISTICS}


_SAME_WAVELENGTH_NM = 1e-3
_MAX_NOISE_GAIN = 3.0  # channels much wider than a band would multiply their noise by more
_SAME_WIDTH_RATIO = 1.02


@dataclass(frozen=True, eq=False)
class Operator:
    """Linear operator that brings one spectrum onto bands."""

    # (band, channel): weights on the channels, rows sum to 1; None where the channels are the bands
    weights: Floats | None
    # (band,), bool: bands compared; the others are not covered completely, or too narrow for the channels
    seen: npt.NDArray[np.bool_]
    # (band,): part of a band's response covered by the channels [1]; 0 where channels within are missing
    coverage: Floats
    # misfit, noise_gain (band,): see `hyperpaint.light.responses.Matching`
    misfit: Floats
    noise_gain: Floats

    def __call__(self, values: Floats) -> Floats:
        """Return values (..., channel) on the bands (..., band); NaN where a band is left out."""
        on_bands = np.full((*values.shape[:-1], self.seen.size), np.nan)
        if self.weights is None:
            on_bands[..., self.seen] = values[..., self.seen]
            return on_bands
        # channels without weight may be missing
        used = np.flatnonzero(self.weights[self.seen].any(axis=0))
        on_bands[..., self.seen] = values[..., used] @ self.weights[np.ix_(self.seen, used)].T
        return on_bands


def bands_of(signature: Measured, references: list[Measured]) -> Measured:
    """Return the spectrum whose channels are the common bands: the coarser one.

    The signature, unless every reference is coarser in the common range.
    """
    first, last = signature.wavelength[[0, -1]]
    widths = []
    for each in references:
        shared = (each.wavelength >= first) & (each.wavelength <= last)
        widths.append(np.median(each.fwhm[shared]) if shared.any() else 0.0)
    return references[0] if min(widths) > _SAME_WIDTH_RATIO * np.median(signature.fwhm) else signature


def operator_onto(bands: Measured, spectrum: Measured) -> Operator:
    """Return the operator that brings a spectrum onto the bands of another.

    Equal channels need no weights. Missing samples count as not covered; gaps in the bands' own spectrum do
    not matter here.
    """
    is_finite = np.isfinite(spectrum.values)
    if (
        bands.wavelength.shape == spectrum.wavelength.shape
        and (np.abs(bands.wavelength - spectrum.wavelength) <= _SAME_WAVELENGTH_NM).all()
        and np.allclose(bands.fwhm, spectrum.fwhm, rtol=_SAME_WIDTH_RATIO - 1.0)
    ):
        zero = np.where(is_finite, 0.0, np.nan)
        return Operator(None, is_finite, is_finite.astype(np.float64), zero, zero + 1.0)
    size = bands.wavelength.size
    reach = 3.0 * (bands.fwhm.max() + spectrum.fwhm.max())
    near = spectrum.wavelength >= bands.wavelength.min() - reach
    used = np.flatnonzero(is_finite & near & (spectrum.wavelength <= bands.wavelength.max() + reach))
    weights = np.zeros((size, spectrum.wavelength.size))
    if used.size < 2:
        none, unknown = np.zeros(size), np.full(size, np.nan)
        return Operator(weights, none.astype(bool), none, unknown, unknown)
    matching = matching_operator(
        Responses(spectrum.wavelength[used], spectrum.fwhm[used]), Responses(bands.wavelength, bands.fwhm)
    )
    # bands over missing channels, wider than two widths of their neighbours
    at, width = spectrum.wavelength[used], spectrum.fwhm[used]
    open_ = np.diff(at) > 2.0 * np.maximum(width[1:], width[:-1])
    has_gap = np.zeros(size, bool)
    for left, right in zip(at[:-1][open_], at[1:][open_], strict=True):
        has_gap |= (bands.wavelength + bands.fwhm > left) & (bands.wavelength - bands.fwhm < right)
    # a band of NaN noise gain, which is unknown, is left out too
    is_covered = ~has_gap & (matching.noise_gain[0] <= _MAX_NOISE_GAIN)
    weights[np.ix_(is_covered, used)] = matching.weights[0][is_covered]
    return Operator(
        weights,
        is_covered,
        np.where(has_gap, 0.0, matching.coverage[0]),
        matching.misfit[0],
        matching.noise_gain[0],
    )
