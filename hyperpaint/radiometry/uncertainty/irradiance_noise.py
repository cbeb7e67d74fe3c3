"""Noise of the irradiance spectrometer, and its effect on the bands of a camera."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.light.illumination import imager_of, matched_series

#: Variance of irradiance interpolated between two samples over that of a sample: mean of (1 - w)^2 + w^2.
INTERPOLATED = 2.0 / 3.0

#: A channel is common if it is present in this share of the samples; samples without it are left out.
COMMON_SHARE = 0.9
#: Minimum and maximum number of triples of successive samples for an estimate of noise.
MIN_TRIPLES, MAX_TRIPLES = 4, 256
#: Number of spectra whose mean gives the level of a record.
MAX_MEAN_SPECTRA = 64
_WINDOW_CHANNELS = 21
#: Longest interval between neighbouring samples [median intervals].
MAX_INTERVALS = 2.5
#: Standard deviation over median absolute deviation of a normal distribution [1].
SD_PER_MEDIAN_DEVIATION = 1.4826


def matched_noise(arrays: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the irradiance of the bands and the noise of one sample of it, from a line's small variables.

    The first is the mean of the record (band,) [W m-2 nm-1], the second a covariance (band, band) relative to
    it [1]. Zero without ``irradiance_u_random``.
    """
    record = arrays["irradiance"]
    sample_numbers = np.linspace(0, len(record) - 1, min(len(record), MAX_MEAN_SPECTRA)).astype(np.intp)
    spectra = np.asarray(record[sample_numbers], np.float64)
    is_finite = np.isfinite(spectra)
    mean = np.where(is_finite, spectra, 0.0).sum(axis=0) / np.maximum(is_finite.sum(axis=0), 1)
    imager = imager_of(arrays, arrays["srf_shape"])
    # matching is linear: match the mean, and the noise of one channel at a time
    noise = mean * np.broadcast_to(np.asarray(arrays.get("irradiance_u_random", 0.0), np.float64), mean.shape)
    channels = np.asarray(arrays["irradiance_wavelength"], np.float64)
    with warnings.catch_warnings():  # the plan warns
        warnings.simplefilter("ignore")
        matched, _ = matched_series(
            np.concatenate([mean[None], np.diag(noise)]),
            channels,
            arrays["irradiance_fwhm"],
            arrays["irradiance_srf_shape"],
            imager,
            np.zeros(1),
        )
    level = matched[0, 0]
    relative = np.nan_to_num(matched[1:, 0] / np.where(level > 0, level, np.nan))
    return level, relative.T @ relative


def at_bands(values: Any, channels: Any, wavelength: Any) -> Floats:
    """Return values of channels, interpolated to the wavelengths of bands (band,)."""
    channels = np.asarray(channels, np.float64)
    order = np.argsort(channels, kind="stable")
    channel_values = np.broadcast_to(np.asarray(values, np.float64), channels.shape)
    return np.asarray(np.interp(np.asarray(wavelength, np.float64), channels[order], channel_values[order]))


def noise_of_record(spectra: Array, times: Array, *, fewest: int = MIN_TRIPLES) -> Floats | None:
    """Return the relative noise of single irradiance samples (channel,) [1]; None for too few samples.

    ``spectra`` (sample, channel), any scale; ``times`` (sample,) datetime64. The noise is the departure of a
    sample from the straight line between its neighbours in time, minus the departure of neighbouring
    channels, since light changes smoothly over wavelength; median over samples and 21 channels. Noise common
    to channels is not measured; samples without light or values are left out. ``fewest``: minimum number of
    triples of successive samples.
    """
    from scipy import ndimage

    seconds = np.asarray(times).astype("datetime64[ns]").astype(np.int64) / 1e9
    steps = np.diff(seconds)
    is_near = steps <= MAX_INTERVALS * np.median(steps) if steps.size else np.zeros(0, bool)
    middle_samples = np.flatnonzero(is_near[:-1] & is_near[1:]) + 1
    if middle_samples.size < fewest:
        return None
    middle_samples = middle_samples[
        np.linspace(0, middle_samples.size - 1, min(middle_samples.size, MAX_TRIPLES)).astype(np.intp)
    ]
    # triples of complete samples, and channels that all triples have
    triples = np.stack([spectra[middle_samples + step] for step in (-1, 0, 1)]).astype(np.float64)
    is_valid = np.isfinite(triples) & (triples > 0)
    is_complete = (is_valid.sum(axis=2) > COMMON_SHARE * is_valid.any(axis=(0, 1)).sum()).all(axis=0)
    if is_complete.sum() < fewest:
        return None
    triples, middle_samples, is_usable = (
        triples[:, is_complete],
        middle_samples[is_complete],
        is_valid[:, is_complete].all(axis=(0, 1)),
    )
    if is_usable.sum() < _WINDOW_CHANNELS:
        return None
    # departure from the straight line in time, scaled to one sample, minus departure of neighbouring channels
    before, centre, after = np.log(triples[:, :, is_usable])
    weight = (
        (seconds[middle_samples] - seconds[middle_samples - 1])
        / (seconds[middle_samples + 1] - seconds[middle_samples - 1])
    )[:, None]
    departure = centre - (before + weight * (after - before))
    departure /= np.sqrt(1.0 + weight**2 + (1.0 - weight) ** 2)
    is_neighbour = np.ones((1, _WINDOW_CHANNELS), bool)
    is_neighbour[0, _WINDOW_CHANNELS // 2] = False
    departure -= ndimage.median_filter(departure, footprint=is_neighbour)
    spread = SD_PER_MEDIAN_DEVIATION * np.median(np.abs(departure), axis=0)
    # the median of n neighbours has pi / (2 n) of the variance of a single one
    spread = ndimage.median_filter(spread, _WINDOW_CHANNELS) / np.sqrt(
        1.0 + np.pi / (2.0 * is_neighbour.sum())
    )
    channels = np.arange(is_usable.size)
    return np.asarray(np.interp(channels, channels[is_usable], spread))
