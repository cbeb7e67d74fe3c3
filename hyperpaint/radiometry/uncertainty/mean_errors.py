"""Propagate the errors of a line to the mean over a region, and their correlation between bands.

Random errors average out over samples that do not share them; shared errors stay. Sums are stored by column
and by line, so that memory does not depend on the number of pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import sparse

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.schema import LIBRARY_VARIABLES
from hyperpaint.radiometry.spectral_axis import NominalAxis

from .error_sources import COMPONENTS, FORMS, LineErrors, rounding_variance
from .propagation import NONE_KNOWN, band_steps

#: Smallest correlation of two bands that is stored [1].
MIN_CORRELATION = 0.01
#: Largest distance of two bands whose correlation is stored [band].
MAX_LAGS = 48


class MeanErrors(NamedTuple):
    """Errors of a mean spectrum."""

    sources: tuple[str, ...]  #: Known sources of `FORMS`
    #: (source, band) float64: standard uncertainty by source; signed where all bands share the error
    sizes: Floats
    u_random: Floats  #: (band,) float64: uncertainty by errors that bands do not share
    #: (lag, band) float32: correlation of the random error with the band `lag` bands later; NaN beyond the
    #: last
    correlation: Array

    @property
    def components(self) -> tuple[str, str]:
        """Names of the variables of the random and of the systematic uncertainty."""
        names: list[list[str]] = [[], []]
        for source, is_shared in zip(self.sources, self.systematic, strict=True):
            names[int(is_shared)] += COMPONENTS[source]
        return ", ".join(names[0]) or NONE_KNOWN, ", ".join(names[1]) or NONE_KNOWN

    @property
    def systematic(self) -> Array:
        """Whether all bands share the error of a source (source,)."""
        return np.array([FORMS[name].band == "systematic" for name in self.sources], bool)

    @property
    def u_systematic(self) -> Floats:
        """Uncertainty by errors that all bands share (band,); NaN without known errors."""
        if not self.systematic.any():
            return np.full(self.sizes.shape[1], np.nan)
        return np.asarray(np.sqrt((self.sizes[self.systematic] ** 2).sum(axis=0)))


def error_variables(errors: Sequence[MeanErrors | None]) -> dict[str, xr.DataArray]:
    """Return the errors of several means of the same bands as library variables; {} without errors."""
    available = [mean for mean in errors if mean is not None]
    if not available:
        return {}
    sources = [name for name in FORMS if any(name in mean.sources for mean in available)]
    bands = available[0].sizes.shape[1]
    sizes = np.full((len(errors), len(sources), bands), np.nan)
    lags = np.zeros((len(errors), max(len(mean.correlation) for mean in available), bands), np.float32)
    for number, mean in enumerate(errors):
        if mean is None:
            lags[number] = np.nan
            continue
        sizes[number] = 0.0
        sizes[number, [sources.index(name) for name in mean.sources]] = mean.sizes
        lags[number, : len(mean.correlation)] = mean.correlation
    values = {
        "error_source": np.array(sources, object),
        "error_form": np.array([str(FORMS[name]) for name in sources], object),
        "reflectance_errors": sizes.astype(np.float32),
        "error_correlation": lags,
        "lag": np.arange(lags.shape[1]),
    }
    specs = {name: LIBRARY_VARIABLES[name] for name in values}
    variables = {
        name: xr.DataArray(values[name], dims=spec.dims, attrs=spec.attrs) for name, spec in specs.items()
    }
    variables["error_correlation"].attrs["bands"] = bands
    return variables


class RegionSums:
    """Sums over a region's pixels, from which the errors of its mean follow."""

    def __init__(self, line: LineErrors, along: Array, across: Array) -> None:
        """Start empty; ``along`` and ``across`` (pixel,) are the pixels' lines and columns."""
        self._line = line
        self._rows, self._row_of_pixel = np.unique(along, return_inverse=True)
        self._columns, self._column_of_pixel = np.unique(across, return_inverse=True)
        bands, darks = line.dark.shape[0], line.dark_weights.shape[1]
        shape = (bands, self._columns.size)
        self._counts_of_pixels, self._variance_sums, self._value_sums = (
            np.zeros(shape),
            np.zeros(shape),
            np.zeros(shape),
        )
        self._per_count_sums = np.zeros((darks, *shape))
        self._pedestal_sums = np.zeros(bands)
        self._sample_of_line: Array = np.zeros((2, 0), np.int64)
        if line.light is not None and line.light.covariance.any():
            neighbours = np.stack([line.light.before[self._rows], line.light.after[self._rows]])
            self._sample_of_line = np.unique(neighbours, return_inverse=True)[1].reshape(neighbours.shape)
        self._light_sums = np.zeros((int(self._sample_of_line.max(initial=-1)) + 1, bands))

    def add(self, band: int, reflectance: Array, u_random: Array) -> None:
        """Add a band of all pixels (pixel,): measured reflectance, and its noise."""
        line, column = self._line, self._column_of_pixel
        is_valid = np.isfinite(reflectance) & np.isfinite(u_random)
        value = np.where(is_valid, reflectance, 0.0).astype(np.float64)
        variance = np.where(is_valid, u_random, 0.0).astype(np.float64) ** 2
        per_electron, noise_floor = (
            table[band, self._columns][column] for table in (line.per_electron, line.noise_floor)
        )
        # variance = m^2 (value / (m k) + floor), solved for m, reflectance per count, without cancellation
        shot = np.maximum(value, 0.0) * per_electron
        root = shot + np.sqrt(shot**2 + 4.0 * noise_floor * variance)
        per_count = np.divide(2.0 * variance, root, out=np.zeros_like(root), where=root > 0)

        def of_columns(values: Floats) -> Floats:
            return np.asarray(np.bincount(column, values, self._columns.size), np.float64)

        self._counts_of_pixels[band] = of_columns(is_valid.astype(np.float64))
        self._variance_sums[band] = of_columns(variance)
        self._value_sums[band] = of_columns(value)
        for dark, share in enumerate(line.dark_weights[self._rows].T):
            self._per_count_sums[dark, band] = of_columns(per_count * share[self._row_of_pixel])
        if line.pedestal_variance:
            self._pedestal_sums[band] = (np.bincount(self._row_of_pixel, per_count) ** 2).sum()
        if len(self._light_sums) and line.light is not None:
            sums = np.bincount(self._row_of_pixel, value, self._rows.size)
            weight = line.light.weight[self._rows]
            for sample_numbers, share in zip(self._sample_of_line, (1.0 - weight, weight), strict=True):
                np.add.at(self._light_sums[:, band], sample_numbers, share * sums)

    def errors(self, axis: NominalAxis | None = None, smoothing: Array | None = None) -> MeanErrors:
        """Return the errors of the mean, interpolated to nominal wavelengths and smoothed like its pixels.

        ``smoothing`` (band, band): matrix that spectra are multiplied by; NaN for bands without a value.
        """
        line, columns = self._line, self._columns
        averaging = _averaging_matrix(len(self._counts_of_pixels), columns, axis)
        count = averaging @ self._counts_of_pixels.ravel()
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(count > 0.5, 1.0 / count, np.nan)

        def mean(table: Floats) -> Floats:
            return np.asarray(averaging @ np.nan_to_num(table).ravel()) * share

        def independent(table: Floats) -> Floats:
            square = averaging.multiply(np.nan_to_num(table).ravel()) @ averaging.T
            return np.asarray(square.toarray() * share * share[:, None])

        level, per_count = mean(self._value_sums), self._per_count_sums.sum(axis=0)
        dark = line.dark[:, columns]
        covariances = {"noise": independent(self._variance_sums)}
        dark_variance = (self._per_count_sums**2).sum(axis=0) * dark**2
        if line.is_integer:
            # rounding, in sums over the lines of a column
            read = line.read_noise[:, columns] ** 2
            with np.errstate(invalid="ignore", divide="ignore"):
                counts = np.nan_to_num(np.maximum(self._value_sums, 0.0) / per_count)
            with_shot = rounding_variance(read + counts * line.per_electron[:, columns])
            dark_variance += per_count**2 * (rounding_variance(read) * (dark > 0) + with_shot)
        if dark_variance.any():
            covariances["mean dark"] = independent(dark_variance)
        if line.gain_of_elements.any():
            covariances["gain of elements"] = independent(
                (self._value_sums * line.gain_of_elements[:, columns]) ** 2
            )
        if len(self._light_sums) and line.light is not None:
            with np.errstate(
                invalid="ignore", divide="ignore"
            ):  # part of the mean by every irradiance sample
                samples = np.nan_to_num(self._light_sums / self._value_sums.sum(axis=1) * level)
            covariances["irradiance noise"] = (samples.T @ samples) * line.light.covariance
        shared_errors = {
            name: mean(self._value_sums * relative[:, columns]) for name, relative in line.common.items()
        }
        if line.pedestal_variance:
            shared_errors["pedestal"] = np.sqrt(
                self._pedestal_sums * line.pedestal_variance
            ) / self._counts_of_pixels.sum(axis=1)
        if line.dark_offset.any():
            shared_errors["dark"] = mean(per_count * line.dark_offset[:, columns])
        if line.wavelength_u.any() and line.light is not None:
            shared_errors["wavelength"] = _change_by_wavelength(line, level)
        if line.stray_light is not None:
            counts = np.divide(self._value_sums, per_count, out=np.zeros_like(per_count), where=per_count > 0)
            shared_errors["stray light"] = mean(per_count * (line.stray_light @ counts))
        if smoothing is not None:
            smoothing_matrix = np.nan_to_num(smoothing)
            covariances = {
                name: smoothing_matrix @ np.nan_to_num(square) @ smoothing_matrix.T
                for name, square in covariances.items()
            }
            shared_errors = {
                name: smoothing_matrix @ np.nan_to_num(size) for name, size in shared_errors.items()
            }
        sizes = {name: np.sqrt(np.diagonal(square)) for name, square in covariances.items()} | shared_errors
        names = tuple(name for name in FORMS if name in sizes)
        total = np.sum(list(covariances.values()), axis=0)
        return MeanErrors(names, np.array([sizes[name] for name in names]), *_sd_and_correlation(total))


def _averaging_matrix(bands: int, columns: Array, axis: NominalAxis | None) -> sparse.csr_array:
    # Return the matrix from flattened spectra of columns (band, column) to nominal wavelengths (band,).
    flat_index = np.arange(bands * columns.size).reshape(bands, columns.size)
    band = np.broadcast_to(np.arange(bands)[:, None], flat_index.shape)
    if axis is None:
        return sparse.csr_array(
            (np.ones(flat_index.size), (band.ravel(), flat_index.ravel())), (bands, flat_index.size)
        )
    weights = np.nan_to_num(axis.weights[:, columns].astype(np.float64))
    tap_bands = axis.first[:, columns, None] + np.arange(weights.shape[2])
    source = flat_index[tap_bands, np.arange(columns.size)[None, :, None]]
    rows = np.broadcast_to(band[..., None], weights.shape)
    return sparse.csr_array((weights.ravel(), (rows.ravel(), source.ravel())), (bands, flat_index.size))


def _sd_and_correlation(covariance: Floats) -> tuple[Floats, Array]:
    # Return standard deviations (band,) and correlations (lag, band) up to the last significant lag.
    sd = np.sqrt(np.diagonal(covariance))
    bands = sd.size
    lags = np.full((min(MAX_LAGS, bands), bands), np.nan, np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        for lag in range(len(lags)):
            lags[lag, : bands - lag] = np.diagonal(covariance, lag) / (sd[: bands - lag] * sd[lag:])
    significant = np.flatnonzero((np.nan_to_num(np.abs(lags)) > MIN_CORRELATION).any(axis=1))
    return sd, lags[: significant.max(initial=0) + 1]


def _change_by_wavelength(line: LineErrors, level: Floats) -> Floats:
    # Return the change of a mean by an error of the wavelength scale (band,).
    assert line.light is not None
    light = line.light.level
    steps = band_steps(line.wavelength)
    with np.errstate(invalid="ignore", divide="ignore"):
        radiance = level * light
        rise = np.append(np.diff(radiance), np.nan) / light
        fall = np.insert(np.diff(radiance), 0, np.nan) / light
    to_above = np.where(np.isfinite(fall), steps[:, 0], steps[:, 1])
    to_below = np.where(np.isfinite(rise), steps[:, 2], steps[:, 3])
    return np.asarray((np.nan_to_num(rise) * to_above + np.nan_to_num(fall) * to_below) * line.wavelength_u)
