"""What the bands of a camera see of a spectrometer's noise, and of what is said channel by channel."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.light.illumination import imager_of, matched_series

#: Variance between two samples of irradiance over that of one: mean of (1 - w)^2 + w^2 over w.
INTERPOLATED = 2.0 / 3.0

#: Share of the samples that must have a channel for a sample without it to be left out.
USUAL_SHARE = 0.9


#: Samples between two others from which the noise of a record is estimated.
FEWEST_TRIPLES = 4
_MOST_TRIPLES = 256
_MOST_SPECTRA = 64
_WINDOW_CHANNELS = 21
_LONGEST_INTERVALS = 2.5
_SIGMA_OF_DEVIATION = 1.4826


class MatchedNoise(NamedTuple):
    """A record's mean spectrum and the noise of one of its samples, as bands see them."""

    level: Floats  #: (band,) float64 [W m-2 nm-1]
    covariance: Floats  #: (band, band) float64: relative to the level [1]


def matched_noise(arrays: Mapping[str, Any]) -> MatchedNoise:
    """Return what bands see of the noise of one irradiance sample, from a line's small variables by name.

    Without ``irradiance_u_random`` there is none.
    """
    record = arrays["irradiance"]
    some = np.linspace(0, len(record) - 1, min(len(record), _MOST_SPECTRA)).astype(np.intp)
    spectra = np.asarray(record[some], np.float64)
    known = np.isfinite(spectra)
    mean = np.where(known, spectra, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    imager = imager_of(arrays, arrays["srf_shape"])
    # matching is linear: spectra of one noisy channel each say what the bands see of its noise
    noise = mean * np.broadcast_to(np.asarray(arrays.get("irradiance_u_random", 0.0), np.float64), mean.shape)
    channels = np.asarray(arrays["irradiance_wavelength"], np.float64)
    with warnings.catch_warnings():  # which the plan gives
        warnings.simplefilter("ignore")
        matched, _ = matched_series(
            np.concatenate([mean[None], np.diag(noise)]), channels, arrays["irradiance_fwhm"],
            arrays["irradiance_srf_shape"], imager, np.zeros(1),
        )  # fmt: skip
    level = matched[0, 0]
    relative = np.nan_to_num(matched[1:, 0] / np.where(level > 0, level, np.nan))
    return MatchedNoise(level, relative.T @ relative)


def at_bands(values: Any, channels: Any, wavelength: Any) -> Floats:
    """Return what is said of every channel at the wavelengths of bands (band,)."""
    channels = np.asarray(channels, np.float64)
    order = np.argsort(channels, kind="stable")
    known = np.broadcast_to(np.asarray(values, np.float64), channels.shape)
    return np.asarray(np.interp(np.asarray(wavelength, np.float64), channels[order], known[order]))


def noise_of_record(spectra: Array, times: Array, *, fewest: int = FEWEST_TRIPLES) -> Floats | None:
    """Return the relative noise of single irradiance samples (channel,) [1]; None of too few samples.

    ``spectra`` (sample, channel), any scale; ``times`` (sample,) datetime64. What a sample departs from the
    line between its neighbours in time, less what neighbouring channels depart, since light changes smoothly
    over wavelength; median over samples and 21 channels. Noise that channels share is not seen; samples
    without light or values are left out. ``fewest``: samples between two others that it takes.
    """
    from scipy import ndimage

    seconds = np.asarray(times).astype("datetime64[ns]").astype(np.int64) / 1e9
    steps = np.diff(seconds)
    near = steps <= _LONGEST_INTERVALS * np.median(steps) if steps.size else np.zeros(0, bool)
    middle = np.flatnonzero(near[:-1] & near[1:]) + 1
    if middle.size < fewest:
        return None
    middle = middle[np.linspace(0, middle.size - 1, min(middle.size, _MOST_TRIPLES)).astype(np.intp)]
    three = np.stack([spectra[middle + step] for step in (-1, 0, 1)]).astype(np.float64)
    there = np.isfinite(three) & (three > 0)
    whole = (there.sum(axis=2) > USUAL_SHARE * there.any(axis=(0, 1)).sum()).all(axis=0)
    if whole.sum() < fewest:
        return None
    three, middle, usable = three[:, whole], middle[whole], there[:, whole].all(axis=(0, 1))
    if usable.sum() < _WINDOW_CHANNELS:
        return None
    before, here, after = np.log(three[:, :, usable])
    weight = ((seconds[middle] - seconds[middle - 1]) / (seconds[middle + 1] - seconds[middle - 1]))[:, None]
    away = here - (before + weight * (after - before))
    away /= np.sqrt(1.0 + weight**2 + (1.0 - weight) ** 2)
    others = np.ones((1, _WINDOW_CHANNELS), bool)
    others[0, _WINDOW_CHANNELS // 2] = False
    away -= ndimage.median_filter(away, footprint=others)
    spread = _SIGMA_OF_DEVIATION * np.median(np.abs(away), axis=0)
    # the median of n neighbours has pi / (2 n) of the variance of one
    spread = ndimage.median_filter(spread, _WINDOW_CHANNELS) / np.sqrt(1.0 + np.pi / (2.0 * others.sum()))
    channels = np.arange(usable.size)
    return np.asarray(np.interp(channels, channels[usable], spread))
