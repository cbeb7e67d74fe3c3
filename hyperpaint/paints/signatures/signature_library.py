"""One signature, band by band, and the dataset of all signatures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, INCLUDED, OUTSIDE, THROUGH_COAT
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    LIBRARY_VARIABLES,
    Quality,
    flag_names,
    numbers_of,
    quality_attrs,
)
from hyperpaint.light.diffuse_record import sky_state_attrs
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.uncertainty.averages import MeanErrors, RegionSums, error_variables
from hyperpaint.radiometry.uncertainty.propagation import NONE_KNOWN, UNCERTAINTIES
from hyperpaint.regions import Regions
from hyperpaint.regions.pixels_in_regions import Pixels

from .line_sources import RegionPixels, Source, mean_view, relative_azimuth
from .pixel_statistics import QUANTILES, chosen_members, effective_pixels, summarise

#: Number of good bands, spread over the spectrum, in which the correlation of pixels is computed.
_CORRELATED_BANDS = 8

_NAT = np.datetime64("NaT", "ns")

UNKNOWN_SKY = -1  #: Number of an unknown state of the sky; see `SKY_STATES`.


class Draft:
    """The signature of one region while it is computed.

    Attributes
    ----------
    cells
        Positions of its pixels in the opened flight line or map.
    along, across : (pixel,)
        Positions of its pixels in the flight line.
    n, excluded
        Number of pixels that are used, and of excluded pixels.
    flags
        Flags of the pixels that are used.
    share : (flag,)
        Share of all its pixels with every flag [1].
    member_position
        Positions of the members along and across the track; in a flight line by its index coordinates.
    geometry
        Mean time, sun, view and light of the pixels, and the age of the irradiance, by variable.
    spectra
        ``reflectance``, ``reflectance_sd`` and uncertainties (band,), ``reflectance_quantiles`` (quantile,
        band) and ``member_reflectance`` (member, band), float64, NaN where unknown.
    errors
        Sources of error of the mean, after its last band.
    """

    def __init__(self, source: Source, pixels: RegionPixels) -> None:
        bands = source.cubes["reflectance"].sizes[BAND]
        self.cells = pixels.cells
        self._is_in_line = pixels.cells is pixels.pixels  # not in a map
        self.along, self.across = pixels.pixels
        self._lines = pixels.lines
        self.n = 0
        self.excluded = 0
        self.flags = 0
        self.share = np.zeros(len(Quality))
        self.member_position: Pixels = (self.along[:0], self.across[:0])
        self.geometry: dict[str, Any] = {}
        self.spectra = {
            name: np.full(bands, np.nan) for name in ("reflectance", "reflectance_sd", *UNCERTAINTIES)
        }
        self.spectra["reflectance_quantiles"] = np.full((len(QUANTILES), bands), np.nan)
        self._source = source
        self._is_used = np.zeros(self.along.size, bool)
        self._value_counts = np.zeros(bands, np.intp)
        self._members = np.zeros(0, np.intp)
        good = np.flatnonzero(source.good)
        positions = np.linspace(0, good.size - 1, min(good.size, _CORRELATED_BANDS)).astype(np.intp)
        self._correlated_bands = good[positions] if good.size else good
        self._correlated_values: list[Array] = []
        self._sums: RegionSums | None = None
        self.errors: MeanErrors | None = None

    @property
    def n_eff(self) -> float:
        """Number of independent pixels among those used."""
        values = np.concatenate([np.zeros((self.n, 0), np.float32), *self._correlated_values], axis=1)
        along = self.along[self._is_used]
        if self._lines is not None and along.size:
            # pixels of different flight lines are not neighbours: shift the flight lines far from one another
            flightline = np.unique(self._lines[self._is_used], return_inverse=True)[1]
            along = along + flightline * (2 * int(np.ptp(along)) + 2)
        return effective_pixels(values, along, self.across[self._is_used])

    def choose(
        self,
        present: Array,
        planes: Mapping[str, Array],
        lines: Mapping[str, Array],
        exclude: int,
        max_members: int,
        seed: int,
    ) -> None:
        """Choose the pixels that are used and the members, and compute their geometry.

        Takes ``present`` (pixel,): whether a pixel has a value, others are excluded; ``planes``: variables of
        pixels (pixel,), among them ``quality``, 0 where it is absent; ``lines``: variables of the line
        (along_track,); ``exclude``: flags of excluded pixels; ``max_members``, ``seed``: see
        `chosen_members`.
        """
        quality = planes.get("quality", np.zeros(self.along.size, np.uint16))
        self._is_used = (quality & np.uint16(exclude) == 0) & present
        self.n = int(self._is_used.sum())
        self.excluded = self.along.size - self.n
        self.flags = int(np.bitwise_or.reduce(quality[self._is_used], initial=0))
        self.share = np.array([(quality & np.uint16(flag) != 0).mean() for flag in Quality])
        along, across = self.along[self._is_used], self.across[self._is_used]
        if self._source.errors is not None:
            self._sums = RegionSums(self._source.errors, along, across)
        self._members = chosen_members(along, across, max_members, seed)
        self.member_position = along[self._members], across[self._members]
        if self._is_in_line:
            numbers = (numbers_of(self._source.line, dim) for dim in (ALONG_TRACK, CROSS_TRACK))
            rows, columns = (axis.astype(np.int64) for axis in numbers)
            self.member_position = rows[self.member_position[0]], columns[self.member_position[1]]
        bands = self._source.cubes["reflectance"].sizes[BAND]
        self.spectra["member_reflectance"] = np.full((self._members.size, bands), np.nan)
        line_values = {name: values[self.cells[0][self._is_used]] for name, values in lines.items()}
        pixel_values = {name: values[self._is_used] for name, values in planes.items()}
        self.geometry = _sun_geometry({**line_values, **pixel_values})
        light = self._source.light
        unknown = np.full(bands, np.nan)
        self.geometry |= {
            "diffuse_fraction": unknown,
            "diffuse_fraction_u": unknown,
            "sky_state": UNKNOWN_SKY,
        }
        self.geometry |= {} if light is None else light.mean(self.cells[0][self._is_used])
        zenith, azimuth = mean_view(self._source.viewing, pixel_values, line_values, across)
        self.geometry |= {
            "view_zenith": zenith,
            "view_azimuth": azimuth,
            "relative_azimuth": relative_azimuth(azimuth, self.geometry["sun_azimuth"]),
        }

    def take_bands(self, cubes: Mapping[str, Array], bands: slice, centre: str) -> None:
        """Reduce some bands of the region's pixels.

        Takes ``cubes``: reflectance and its uncertainties (pixel, band), by name; ``bands``: slice of these
        bands in the spectrum; ``centre``: see `summarise`.
        """
        values = cubes["reflectance"][self._is_used]
        summary = summarise(values, centre)
        has_value = np.isfinite(values)
        self._value_counts[bands] = has_value.sum(axis=0)
        self.spectra["reflectance"][bands] = summary.centre
        self.spectra["reflectance_sd"][bands] = summary.sd
        self.spectra["reflectance_quantiles"][:, bands] = summary.quantiles
        self.spectra["member_reflectance"][:, bands] = values[self._members]
        in_bands = (self._correlated_bands >= bands.start) & (self._correlated_bands < bands.stop)
        self._correlated_values.append(values[:, self._correlated_bands[in_bands] - bands.start])
        if self._sums is not None:
            measured = cubes.get("measured", cubes["reflectance"])[self._is_used]
            noise = cubes["reflectance_u_random"][self._is_used]
            for column, band in enumerate(range(*bands.indices(self._value_counts.size))):
                self._sums.add(band, measured[:, column], noise[:, column])
            if bands.stop >= self._value_counts.size:
                self.errors = self._sums.errors(self._source.axis, self._source.filtering)
                self._sums = None  # frees the memory of the sums
            return
        for name in UNCERTAINTIES:
            if name in cubes and self._source.components[name] != NONE_KNOWN:
                # random errors: mean square here, divided in `finish` by the number of independent pixels
                power = 2.0 if name == "reflectance_u_random" else 1.0
                self.spectra[name][bands] = _mean_of_power(cubes[name][self._is_used], has_value, power)

    def finish(self) -> float:
        """Compute the uncertainties of the mean; return the number of independent pixels."""
        n_eff = self.n_eff
        self._correlated_values = []
        if self.errors is not None:
            uncertainties = (self.errors.u_random, self.errors.u_systematic)
            missing = self._value_counts == 0
            for name, values in zip(UNCERTAINTIES, uncertainties, strict=True):
                self.spectra[name] = np.where(missing, np.nan, values)
            return n_eff
        # the number of independent pixels in a band is proportional to its number of values
        n_eff_of_band = np.maximum(1.0, n_eff * self._value_counts / max(self.n, 1))
        self.spectra["reflectance_u_random"] = np.sqrt(self.spectra["reflectance_u_random"] / n_eff_of_band)
        return n_eff


def _mean_of_power(values: Array, has_reflectance: Array, power: float) -> Array:
    # Mean of a power (band,) over the pixels with a reflectance; NaN without such pixels
    means = np.full(values.shape[1], np.nan)
    # band by band: then the order of the sum is that of the pixels for any number of bands
    for band, column in enumerate(values.T):
        finite_values = column[has_reflectance[:, band] & np.isfinite(column)].astype(np.float64)
        if finite_values.size:
            means[band] = (finite_values**power).mean()
    return means


def _sun_geometry(variables: Mapping[str, Array]) -> dict[str, Any]:
    # Mean time, position of the sun and maximum age of the irradiance, from values of pixels (pixel,)
    times = variables.get("time", np.full(0, _NAT)).astype("datetime64[ns]")
    times = times[~np.isnat(times)]
    mean_time = _NAT
    if times.size:
        mean_time = times[0] + np.timedelta64(round(float((times - times[0]).astype(np.int64).mean())), "ns")
    position = [variables.get(name, np.full(0, np.nan)) for name in ("latitude", "longitude")]
    position = [values[np.isfinite(values)] for values in position]
    zenith = azimuth = np.nan
    if times.size and all(values.size for values in position):
        means = (float(values.mean()) for values in position)
        zenith, azimuth = map(float, solar_position(mean_time, *means))
    age = variables.get("irradiance_age", np.full(0, np.nan))
    age = age[np.isfinite(age)]
    return {
        "time": mean_time,
        "sun_zenith": zenith,
        "sun_azimuth": azimuth,
        "irradiance_age": float(age.max()) if age.size else np.nan,
    }


#: Maximum number of properties that become coordinates; the coordinate ``region`` holds all properties.
MAX_PROPERTIES = 64


def paint_library(
    regions: Regions,
    drafts: Sequence[Draft],
    flightlines: Sequence[str],
    sources: Mapping[str, Source],
    notes: Mapping[str, Any],
) -> xr.Dataset:
    """Return finished signatures as a dataset.

    Takes ``regions``, ``drafts``, ``flightlines``: regions, their signatures and the names of their flight
    lines, in the same order; ``sources``: the flight lines, by name, with the same bands; ``notes``: settings
    of the extraction, stored as attributes.
    """
    first_source = next(iter(sources.values()))
    max_members = max(draft.member_position[0].size for draft in drafts)
    values: dict[str, Any] = {
        "n_eff": [draft.finish() for draft in drafts],
        "n": [draft.n for draft in drafts],
        "n_excluded": [draft.excluded for draft in drafts],
        "quality": [draft.flags for draft in drafts],
        "quality_share": [draft.share for draft in drafts],
    }
    for name in ("reflectance", "reflectance_sd", "reflectance_quantiles", *UNCERTAINTIES):
        values[name] = [draft.spectra[name] for draft in drafts]
    values["member_reflectance"] = [
        _padded(draft.spectra["member_reflectance"], max_members, np.nan) for draft in drafts
    ]
    for axis, name in enumerate(("member_along_track", "member_cross_track")):
        values[name] = [_padded(draft.member_position[axis], max_members, -1) for draft in drafts]
    for name in drafts[0].geometry:
        values[name] = [draft.geometry[name] for draft in drafts]
    values |= {
        "signature": list(regions.names),
        "quantile": list(QUANTILES),
        "flag": flag_names(),
        "flightline": list(flightlines),
        "region": [json.dumps(region.feature(), ensure_ascii=False) for region in regions],
        "wavelength": first_source.wavelength,
        "fwhm": first_source.fwhm,
        "good": np.all([source.good for source in sources.values()], axis=0),
    }
    library = xr.Dataset()
    components = {}
    for k, name in enumerate(UNCERTAINTIES):
        texts = [draft.errors.components[k] for draft in drafts if draft.errors is not None]
        texts += [
            source.components.get(name, NONE_KNOWN) for source in sources.values() if source.errors is None
        ]
        components[name] = {"components": _joined(texts)}
    for name, row in LIBRARY_VARIABLES.items():
        if name not in values:  # variables of corrections are added later
            continue
        flags = {"quality": quality_attrs, "sky_state": sky_state_attrs}.get(name, dict)()
        attrs = {**flags, **row.attrs, **components.get(name, {})}
        # objects are texts of any length
        array = np.array(values[name], object if row.dtype == "str" else row.dtype)
        library[name] = xr.DataArray(array, dims=row.dims, attrs=attrs)
    library = library.assign(error_variables([draft.errors for draft in drafts]))
    library = library.set_coords(
        [name for name, row in LIBRARY_VARIABLES.items() if row.coordinate and name in library]
    )
    properties = {
        name: ("signature", column, {"long_name": f"Property {name} of the regions"})
        for name, column in _properties(regions).items()
    }
    library = library.assign_coords(properties)
    # attributes of corrections prevent a second correction
    corrections = dict.fromkeys(name for source in sources.values() for name in source.corrections)
    library["reflectance"].attrs |= {
        "centre": notes["centre"],
        **_quantity(sources),
        **{
            name: _joined(source.corrections.get(name, "none") for source in sources.values())
            for name in corrections
        },
        "geometry": "sun and sky on a level surface, camera above: sun_zenith, view_zenith, "
        "relative_azimuth, diffuse_fraction of every paint",
    }
    files = dict.fromkeys(str(source.line.attrs.get("source", "")) for source in sources.values())
    library.attrs = {
        "title": "Paint signatures",
        "source": ", ".join(text for text in files if text),
        "flightlines": list(sources),
        "regions": regions.digest,
        "coordinates_of_regions": regions.coordinates,
        "spectral_axis": "nominal wavelengths",
        "view_geometry": _joined(source.viewing.description for source in sources.values()),
        "smoothing": _joined(source.smoothing for source in sources.values()),
        "corrections": _joined(
            _joined(f"{name}: {text}" for name, text in source.corrections.items()) or "none"
            for source in sources.values()
        ),
        **notes,
    }
    return library


def _joined(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))


def _padded(values: Array, size: int, fill: float) -> Array:
    padded = np.full((size, *values.shape[1:]), fill, values.dtype)
    padded[: len(values)] = values
    return padded


def _quantity(sources: Mapping[str, Source]) -> dict[str, str]:
    # Attributes that define the reflectance; the line with the most light of the coat in it decides
    def quantity_of(source: Source) -> str:
        is_excluded = source.declared.get("mirror_reflection") == EXCLUDED
        if not (is_excluded or "mirrored_sky_removed" in source.corrections):
            return OUTSIDE
        return BODY if "coat_corrected" in source.corrections else THROUGH_COAT

    quantities = {quantity_of(source) for source in sources.values()}
    quantity = next(candidate for candidate in (OUTSIDE, THROUGH_COAT, BODY) if candidate in quantities)
    word = INCLUDED if quantity == OUTSIDE else EXCLUDED
    return {"quantity": quantity, "specular_component": word, "mirror_reflection": word}


def _properties(regions: Regions) -> dict[str, Array]:
    # Columns (signature,) of the properties that can be coordinates: numbers, else text
    names = dict.fromkeys(name for region in regions for name in region.properties)
    reserved = {*LIBRARY_VARIABLES, BAND, "member"}
    usable = [name for name in names if name.isidentifier() and name not in reserved and name[:2] != "__"]
    return {
        name: _column([region.properties.get(name) for region in regions]) for name in usable[:MAX_PROPERTIES]
    }


def _column(values: Sequence[Any]) -> Array:
    present = [value for value in values if value is not None]
    numbers = [value for value in present if isinstance(value, int | float) and not isinstance(value, bool)]
    if present and len(numbers) == len(present) and all(abs(value) < 2**53 for value in numbers):
        if len(present) == len(values) and all(isinstance(value, int) for value in present):
            return np.array(values, np.int64)
        return np.array([np.nan if value is None else value for value in values], np.float64)
    texts = ["" if value is None else value for value in values]
    return np.array(
        [text if isinstance(text, str) else json.dumps(text, ensure_ascii=False) for text in texts], object
    )
