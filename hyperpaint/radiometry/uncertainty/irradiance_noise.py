"""What the bands of a camera see of a spectrometer's noise, and of what is said channel by channel."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.light.illumination import matched_series
from hyperpaint.light.responses import mean_responsivity

__all__ = ["INTERPOLATED", "USUAL_SHARE", "MatchedNoise", "at_bands", "matched_noise"]


INTERPOLATED = 2.0 / 3.0
"""Variance between two samples of irradiance over that of one: mean of (1 - w)^2 + w^2 over w."""

USUAL_SHARE = 0.9
"""Share of the samples that must have a channel for a sample without it to be left out."""


class MatchedNoise(NamedTuple):
    """A record's mean spectrum and the noise of one of its samples, as bands see them."""

    level: Floats  #: (band,) float64 [W m-2 nm-1]
    covariance: Floats  #: (band, band) float64: relative to the level [1]


def matched_noise(arrays: Mapping[str, Any]) -> MatchedNoise:
    """Return what bands see of the noise of one irradiance sample, from a line's small variables by name.

    Without ``irradiance_u_random`` there is none.
    """
    spectra = np.asarray(arrays["irradiance"], np.float64)
    known = np.isfinite(spectra)
    mean = np.where(known, spectra, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    gain = arrays.get("radiance_gain")
    imager = {
        "wavelength": np.asarray(arrays["wavelength"], np.float64),
        "fwhm": np.asarray(arrays["fwhm"], np.float64),
        "spacing": arrays.get("band_spacing"),
        "srf_shape": arrays["srf_shape"],
        "srf_offset": arrays.get("srf_offset"),
        "srf": arrays.get("srf"),
        "responsivity": None if gain is None else mean_responsivity(gain),
    }
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
