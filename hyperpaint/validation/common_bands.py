"""Two spectra on common bands: the finer one is seen as the coarser one's channels would see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.light.responses import Responses, matching_operator

from .spectra import Measured

__all__ = ["Operator", "bands_of", "operator_onto"]


_SAME_WAVELENGTH = 1e-3  # nm
_NOISE_GAIN = 3.0
"""Above it, channels are so much wider than a band that what they tell of it is mostly noise."""
_SAME_WIDTH = 1.02


@dataclass(frozen=True, eq=False)
class Operator:
    """How one spectrum is brought onto bands.

    Attributes
    ----------
    weights : (band, channel) or None
        On the channels of the spectrum; rows sum to 1. None where the channels are the bands.
    seen : (band,), bool
        Bands that are compared; the others are left out: not seen whole, or sharper than the channels can
        tell.
    coverage : (band,)
        Part of a band's response that the channels see [1]; 0 where channels are missing in its midst.
    misfit, noise_gain : (band,)
        As of `hyperpaint.light.responses.Matching`.
    """

    weights: Floats | None
    seen: npt.NDArray[np.bool_]
    coverage: Floats
    misfit: Floats
    noise_gain: Floats

    def __call__(self, values: Floats) -> Floats:
        """Return values (..., channel) on the bands (..., band); NaN where a band is left out."""
        on_bands = np.full((*values.shape[:-1], self.seen.size), np.nan)
        if self.weights is None:
            on_bands[..., self.seen] = values[..., self.seen]
            return on_bands
        # what no band weighs may be missing
        used = np.flatnonzero(self.weights[self.seen].any(axis=0))
        on_bands[..., self.seen] = values[..., used] @ self.weights[np.ix_(self.seen, used)].T
        return on_bands


def bands_of(signature: Measured, references: list[Measured]) -> Measured:
    """Return the spectrum whose channels are the common bands: the coarser one.

    The signature, unless every reference is coarser where both see.
    """
    first, last = signature.wavelength[[0, -1]]
    widths = []
    for each in references:
        shared = (each.wavelength >= first) & (each.wavelength <= last)
        widths.append(np.median(each.fwhm[shared]) if shared.any() else 0.0)
    if min(widths) > _SAME_WIDTH * np.median(signature.fwhm):
        return references[0]
    return signature


def operator_onto(bands: Measured, spectrum: Measured) -> Operator:
    """Return how a spectrum is brought onto the bands of another.

    The same channels are left as they are. Missing samples count as not seen; those of the bands' own
    spectrum do not matter here.
    """
    is_finite = np.isfinite(spectrum.values)
    if _same_channels(bands, spectrum):
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
    torn = _over_a_hole(bands, spectrum, used)
    # comparing with NaN is false: of such a band nothing is known
    seen = ~torn & (matching.noise_gain[0] <= _NOISE_GAIN)
    weights[np.ix_(seen, used)] = matching.weights[0][seen]
    return Operator(
        weights, seen, np.where(torn, 0.0, matching.coverage[0]), matching.misfit[0], matching.noise_gain[0]
    )


def _same_channels(one: Measured, other: Measured) -> bool:
    return one.wavelength.shape == other.wavelength.shape and bool(
        (np.abs(one.wavelength - other.wavelength) <= _SAME_WAVELENGTH).all()
        and np.allclose(one.fwhm, other.fwhm, rtol=_SAME_WIDTH - 1.0)
    )


def _over_a_hole(bands: Measured, spectrum: Measured, used: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """Tell which bands lie over channels that are missing, wider than two widths of their neighbours."""
    at, width = spectrum.wavelength[used], spectrum.fwhm[used]
    open_ = np.diff(at) > 2.0 * np.maximum(width[1:], width[:-1])
    over_hole = np.zeros(bands.wavelength.size, bool)
    for left, right in zip(at[:-1][open_], at[1:][open_], strict=True):
        over_hole |= (bands.wavelength + bands.fwhm > left) & (bands.wavelength - bands.fwhm < right)
    return over_hole
