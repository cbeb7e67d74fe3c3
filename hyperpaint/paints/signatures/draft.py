"""One signature in the making, band by band."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.schema import BAND, Quality
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.uncertainty.propagation import NONE_KNOWN, UNCERTAINTIES
from hyperpaint.regions.placement import Pixels

from .independence import effective_pixels
from .reduction import QUANTILES, chosen_members, summarise
from .sources import Source
from .viewing import mean_view, relative_azimuth

__all__ = ["Draft"]


_CORRELATED_BANDS = 8
"""Good bands, spread over all, that the correlation of pixels is looked at in."""

_NAT = np.datetime64("NaT", "ns")


class Draft:
    """What is known so far of the signature of one region.

    Parameters
    ----------
    source
        The flight line.
    place
        Positions of the region's pixels along and across the track.

    Attributes
    ----------
    n, excluded
        Pixels that are used, and that are left out.
    flags
        Of the pixels that are used.
    share : (flag,), float64
        How many of all pixels have each flag [1].
    spectra
        ``reflectance``, ``reflectance_sd``, and uncertainties (band,), ``reflectance_quantiles`` (quantile,
        band), ``member_reflectance`` (member, band), float64; NaN where not known.
    member_place
        Positions of the members along and across the track.
    at
        ``time``, ``sun_zenith``, ``sun_azimuth``, ``irradiance_age``, ``view_zenith``, ``view_azimuth``,
        ``relative_azimuth``.
    """

    def __init__(self, source: Source, place: Pixels) -> None:
        bands = source.cubes["reflectance"].sizes[BAND]
        self.along, self.across = place
        self.n = 0
        self.excluded = 0
        self.flags = 0
        self.share = np.zeros(len(Quality))
        self.member_place: Pixels = (self.along[:0], self.across[:0])
        self.at: dict[str, Any] = {}
        self.spectra = {
            name: np.full(bands, np.nan) for name in ("reflectance", "reflectance_sd", *UNCERTAINTIES)
        }
        self.spectra["reflectance_quantiles"] = np.full((len(QUANTILES), bands), np.nan)
        self._source = source
        self._used = np.zeros(self.along.size, bool)
        self._values = np.zeros(bands, np.intp)
        self._chosen = np.zeros(0, np.intp)
        good = np.flatnonzero(source.good)
        spread = np.linspace(0, good.size - 1, min(good.size, _CORRELATED_BANDS)).astype(np.intp)
        self._correlated = good[spread] if good.size else good
        self._columns: list[Array] = []

    @property
    def n_eff(self) -> float:
        """Independent pixels among those used."""
        columns = np.concatenate([np.zeros((self.n, 0), np.float32), *self._columns], axis=1)
        return effective_pixels(columns, self.along[self._used], self.across[self._used])

    def choose(
        self,
        present: Array,
        planes: Mapping[str, Array],
        lines: Mapping[str, Array],
        exclude: int,
        most: int,
        seed: int,
    ) -> None:
        """Choose the pixels that are used, and those that stand for them.

        Parameters
        ----------
        present : (pixel,)
            Whether a pixel of the region has a value, without which it is left out.
        planes
            Variables of pixels (pixel,): ``quality``, its flags, none where it is not there; and what its
            direction of view is made of.
        lines
            Variables of the line (along_track,).
        exclude
            Flags of the pixels that are left out.
        most, seed
            See `chosen_members`.
        """
        quality = planes.get("quality", np.zeros(self.along.size, np.uint16))
        self._used = (quality & np.uint16(exclude) == 0) & present
        self.n = int(self._used.sum())
        self.excluded = self.along.size - self.n
        self.flags = int(np.bitwise_or.reduce(quality[self._used], initial=0))
        self.share = np.array([(quality & np.uint16(flag) != 0).mean() for flag in Quality])
        along, across = self.along[self._used], self.across[self._used]
        self._chosen = chosen_members(along, across, most, seed)
        self.member_place = along[self._chosen], across[self._chosen]
        bands = self._source.cubes["reflectance"].sizes[BAND]
        self.spectra["member_reflectance"] = np.full((self._chosen.size, bands), np.nan)
        of_lines = {name: values[along] for name, values in lines.items()}
        self.at = _geometry(of_lines)
        of_pixels = {name: values[self._used] for name, values in planes.items()}
        zenith, azimuth = mean_view(self._source.viewing, of_pixels, of_lines, across)
        self.at |= {
            "view_zenith": zenith,
            "view_azimuth": azimuth,
            "relative_azimuth": relative_azimuth(azimuth, self.at["sun_azimuth"]),
        }

    def take_bands(self, cubes: Mapping[str, Array], bands: slice, centre: str) -> None:
        """Reduce some bands of the region's pixels.

        Parameters
        ----------
        cubes
            Reflectance and its uncertainties (pixel, band), by name.
        bands
            Which bands they are.
        centre
            See `summarise`.
        """
        values = cubes["reflectance"][self._used]
        found = summarise(values, centre)
        there = np.isfinite(values)
        self._values[bands] = there.sum(axis=0)
        self.spectra["reflectance"][bands] = found.centre
        self.spectra["reflectance_sd"][bands] = found.sd
        self.spectra["reflectance_quantiles"][:, bands] = found.quantiles
        self.spectra["member_reflectance"][:, bands] = values[self._chosen]
        own = (self._correlated >= bands.start) & (self._correlated < bands.stop)
        self._columns.append(values[:, self._correlated[own] - bands.start])
        for name in UNCERTAINTIES:
            if name in cubes and self._source.components[name] != NONE_KNOWN:
                # the mean square of what is random, until the number of independent pixels is known
                power = 2.0 if name == "reflectance_u_random" else 1.0
                self.spectra[name][bands] = _mean(cubes[name][self._used], there, power)

    def finish(self) -> float:
        """Turn means into uncertainties of the mean; return the number of independent pixels."""
        n_eff = self.n_eff
        # a band has as many fewer independent pixels as it has fewer values
        of_band = np.maximum(1.0, n_eff * self._values / max(self.n, 1))
        square = self.spectra["reflectance_u_random"]
        self.spectra["reflectance_u_random"] = np.sqrt(square / of_band)
        self._columns = []
        return n_eff


def _mean(values: Array, there: Array, power: float) -> Array:
    """Return the mean of a power over pixels that have a reflectance (band,); NaN where none has."""
    made = np.full(values.shape[1], np.nan)
    # one band after the other: the order of the sum is then that of the pixels, however many bands there are
    for band, column in enumerate(values.T):
        known = column[there[:, band] & np.isfinite(column)].astype(np.float64)
        if known.size:
            made[band] = (known**power).mean()
    return made


def _geometry(lines: Mapping[str, Array]) -> dict[str, Any]:
    """Return time, sun and age of the irradiance, from those of every pixel's line."""
    time = lines.get("time", np.full(0, _NAT)).astype("datetime64[ns]")
    time = time[~np.isnat(time)]
    middle = _NAT
    if time.size:
        middle = time[0] + np.timedelta64(round(float((time - time[0]).astype(np.int64).mean())), "ns")
    place = [lines.get(name, np.full(0, np.nan)) for name in ("latitude", "longitude")]
    place = [values[np.isfinite(values)] for values in place]
    zenith = azimuth = np.nan
    if time.size and all(values.size for values in place):
        zenith, azimuth = map(float, solar_position(middle, *(float(values.mean()) for values in place)))
    age = lines.get("irradiance_age", np.full(0, np.nan))
    age = age[np.isfinite(age)]
    return {
        "time": middle,
        "sun_zenith": zenith,
        "sun_azimuth": azimuth,
        "irradiance_age": float(age.max()) if age.size else np.nan,
    }
