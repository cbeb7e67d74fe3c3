"""Division of the light of a line into direct and diffuse, measured, modelled or declared, and its sky.

The only place that chooses the source of a diffuse fraction; `survey`, the corrections and signatures use it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, SIGNATURE
from hyperpaint.light.diffuse_record import SKY_STATES, SPLIT, split_of_lines
from hyperpaint.light.sun import diffuse_fraction

from .sun_and_sky import (
    SKIES,
    SOURCES,
    SUN_FROM,
    diffuse_from_clear_sky,
    measured_fraction,
    mirrored_radiances,
    sun_zenith_of,
)

#: Warning where only the position of the sun is known.
CLEAR_SKY_ASSUMED = (
    "no irradiance record tells the state of the sky, a clear sky is assumed; pass diffuse='model' where "
    "it was clear, or a measured spectrum"
)

#: Warning where most lines match no possible sky.
CONTRADICTION = (
    "the irradiance record contradicts every sky with the sun at {zenith:.1f} degrees from the zenith: check "
    "the clocks (utc_offset_h) and the receiver's calibration, pass sun_zenith= where the clock is wrong, or "
    "diffuse= where the split was measured; until then the split is uncertain"
)

#: Difference of ``sun_zenith`` from the clock's, beyond which the split is computed anew [degree].
MAX_CLOCK_DEG = 2.0

#: Sky of a line with ``sky_state``.
RECORDED = "as recorded"

CONTRADICTORY = SKY_STATES.index("contradictory")

#: Replaces the number of `SKY_STATES` where the state of the sky is unknown, as for a measured split.
UNKNOWN_STATE = -1

#: Minimum share of the lines with a state that is listed for a mean [1].
MIN_STATE_SHARE = 0.1

#: Standard uncertainty of a modelled clear sky's fraction, relative to f (1 - f): aerosol of 0.05 to 0.25.
MODEL_U = 0.2


@dataclass(frozen=True)
class LightSplit:
    """The diffuse part of the light, and its origin in the sky.

    ``fraction`` and ``u``, its standard uncertainty, have dims (band,), or (along_track, band) or (signature,
    band) where they differ; ``cloud``, without ``band``, is the weight of an overcast sky in a clear one [1].
    Lazy where the line is. ``zenith`` of the sun is NaN where it is unknown and not needed [degree].
    """

    wavelength: Floats  #: (band,) [nm]
    fraction: xr.DataArray
    u: xr.DataArray
    cloud: Any
    source: str  #: Source of the fraction, as in attributes.
    sky: str  #: One of `SKIES`, or `RECORDED`.
    zenith: float
    state: Any = UNKNOWN_STATE  #: Number in `SKY_STATES`, or of each line's; or `UNKNOWN_STATE`.
    states: tuple[str, ...] = ()  #: States of the sky that occur; of a mean only.

    def mean(self) -> LightSplit:
        """Return the mean over lines; eager."""
        over = [dim for dim in self.fraction.dims if dim != BAND]
        if not over:
            return self
        import dask

        fraction, u, cloud, state = dask.compute(self.fraction, self.u, self.cloud, self.state)
        warn_of_contradiction(state, self.zenith)
        numbers, counts = np.unique(state, return_counts=True)
        frequent = numbers[(counts > MIN_STATE_SHARE * counts.sum()) & (numbers != UNKNOWN_STATE)]
        words = tuple(SKY_STATES[number] for number in frequent)
        # the uncertainty of the sky is common to its lines
        spread = np.sqrt((u**2).mean(over) + fraction.var(over))
        weight = cloud.mean() if hasattr(cloud, "mean") else cloud
        whole = fraction.mean(over)
        has_value = np.isfinite(whole.values)
        if not has_value.any():
            raise SchemaError(
                "'diffuse_fraction' of the line, or of its irradiance record, has no value",
                mend="pass diffuse= with a measured spectrum, or 'model' where the sky was clear",
                option="give --set diffuse=",
                code="diffuse-fraction-empty",
            )
        if not has_value.all():  # bands without irradiance are interpolated
            nm = self.wavelength
            whole, spread = (
                array.copy(data=np.interp(nm, nm[has_value], array.values[has_value]))
                for array in (whole, spread)
            )
        return LightSplit(
            self.wavelength,
            whole,
            spread,
            float(weight),
            self.source,
            self.sky,
            self.zenith,
            state=int(numbers[np.argmax(counts)]),
            states=words,
        )

    def mirrored(self) -> tuple[Floats, Floats]:
        """Return `mirrored_radiances` of a mean (band,) [1]."""
        if not np.isfinite(self.zenith) and self.sky not in ("uniform", "overcast"):
            raise SchemaError(
                "the position of the sun, which the mirrored sky depends on, is unknown",
                mend="pass sun_zenith= [degree]",
                option="give --sun-zenith",
                code="sun-unknown",
            )
        if self.sky in SKIES:
            return mirrored_radiances(self.sky, self.wavelength, self.zenith)
        clear = mirrored_radiances("clear", self.wavelength, self.zenith)
        overcast = mirrored_radiances("overcast", self.wavelength, self.zenith)
        above, sunward = (
            (1.0 - self.cloud) * blue + self.cloud * grey for blue, grey in zip(clear, overcast, strict=True)
        )
        return above, sunward


def split_of(line: xr.Dataset, diffuse: Any, sun_zenith: float | None, sky: str | None = None) -> LightSplit:
    """Return the division of the light of a line, or of a paint library.

    Parameters
    ----------
    line
        With ``wavelength``.
    diffuse
        None for the line's own ``diffuse_fraction`` and ``sky_state``, else the split that follows from its
        record of ``irradiance``; a clear sky, with a warning, without either. "model" or "pvlib" for a clear
        sky; or a measured spectrum.
    sun_zenith
        [degree]; by default from time and place.
    sky
        One of `SKIES`; by default from the record, clear with a model, uniform with a measured spectrum.

    Raises
    ------
    SchemaError
        ``diffuse`` or ``sky`` has another value, or the position of the sun is needed and unknown.

    Warns
    -----
    PaintWarning
        `CLEAR_SKY_ASSUMED`.
    """
    if sky is not None and sky not in SKIES:
        raise SchemaError(f"sky={sky!r}", expected=f"one of {', '.join(SKIES)}", code="choice-unknown")
    wavelength = line["wavelength"].values.astype(np.float64)
    if not isinstance(diffuse, str) and diffuse is not None:
        fraction = xr.DataArray(measured_fraction(diffuse, wavelength), dims=BAND)
        name = sky or "uniform"
        has_sun = sun_zenith is not None or set(SUN_FROM) <= set(line.variables)
        zenith = sun_zenith_of(line, sun_zenith) if has_sun or name == "clear" else float("nan")
        cloud = float(name == "overcast")
        return LightSplit(wavelength, fraction, 0.0 * fraction, cloud, "measured", name, zenith)
    declared = _own(line, sun_zenith) if diffuse is None else None
    if declared is not None:
        return _recorded(line, declared, wavelength, sun_zenith, sky)
    if diffuse is not None and diffuse not in SOURCES:
        raise SchemaError(
            f"diffuse={diffuse!r}",
            expected=f"{', '.join(map(repr, SOURCES))} or a measured spectrum",
            code="choice-unknown",
        )
    zenith = sun_zenith_of(line, sun_zenith)
    if diffuse is None:
        warnings.warn(PaintWarning(CLEAR_SKY_ASSUMED, code="clear-sky-assumed"), stacklevel=3)
    fraction = xr.DataArray(diffuse_from_clear_sky(diffuse or "model", wavelength, zenith), dims=BAND)
    source = f"{diffuse or 'model'}, sun zenith {zenith:.4g} degree"
    name = sky or "clear"
    spread = MODEL_U * fraction * (1.0 - fraction)
    cloud, state = float(name == "overcast"), SKY_STATES.index("overcast" if name == "overcast" else "clear")
    return LightSplit(wavelength, fraction, spread, cloud, source, name, zenith, state)


def says_its_split(line: xr.Dataset) -> bool:
    """Return whether a line declares the division of its light, or has a record that it follows from."""
    return _own(line, None) is not None


def warn_of_contradiction(states: Any, zenith: float) -> None:
    """Warn where most of the lines' states, numbers of `SKY_STATES`, are "contradictory"."""
    if np.mean(np.asarray(states) == CONTRADICTORY) > 0.5:
        warnings.warn(
            PaintWarning(CONTRADICTION.format(zenith=zenith), code="sky-contradictory"), stacklevel=3
        )


def _own(line: xr.Dataset, sun_zenith: float | None) -> xr.Dataset | None:
    # Declared split of a line, or the split from its record; None without either
    if SIGNATURE in line.dims or ALONG_TRACK not in line.dims:
        # small for paints; without any finite value there is no split
        declared = line["diffuse_fraction"] if "diffuse_fraction" in line.variables else None
        return (
            _held(line)
            if declared is not None and BAND in declared.dims and np.isfinite(declared).any()
            else None
        )
    if (
        sun_zenith is not None
        and set(SUN_FROM) <= set(line.variables)
        and abs(sun_zenith_of(line, None) - sun_zenith) > MAX_CLOCK_DEG
        and (anew := split_of_lines(line, sun_zenith=float(sun_zenith))) is not None
    ):
        return anew
    if "diffuse_fraction" in line.variables and BAND in line["diffuse_fraction"].dims:
        return _held(line)
    return split_of_lines(line)


def _held(line: xr.Dataset) -> xr.Dataset:
    # Split declared by a line or a library; raise where it belongs to samples of the record
    dims = line["diffuse_fraction"].dims
    if not set(dims) <= {ALONG_TRACK, SIGNATURE, BAND}:
        raise SchemaError(
            f"'diffuse_fraction' has dims {dims}",
            expected=f"({ALONG_TRACK!r}, {BAND!r}) or ({BAND!r},)",
            mend="drop it where the line has its irradiance record, from which it follows",
            code="dims-wrong",
        )
    return line[[name for name in SPLIT if name in line.variables]].reset_coords(drop=True)


def _recorded(
    line: xr.Dataset, declared: xr.Dataset, wavelength: Floats, sun_zenith: float | None, sky: str | None
) -> LightSplit:
    fraction = declared["diffuse_fraction"].astype(np.float64)
    if ALONG_TRACK in fraction.dims and ALONG_TRACK in line.coords:
        fraction = fraction.assign_coords({ALONG_TRACK: line[ALONG_TRACK]})
    u = (
        declared["diffuse_fraction_u"].astype(np.float64)
        if "diffuse_fraction_u" in declared
        else 0.0 * fraction
    )
    try:
        zenith = sun_zenith_of(line, sun_zenith)
    except SchemaError:  # raised later where it is needed
        if sun_zenith is not None:
            raise
        zenith = float("nan")
    cloud: Any = float(sky == "overcast")
    state: Any = UNKNOWN_STATE
    if "sky_state" in declared:
        state = declared["sky_state"].reset_coords(drop=True)
    if sky is None:
        middle = int(np.nanargmin(np.abs(wavelength - 550.0)))
        clear = float(diffuse_fraction(wavelength[[middle]], zenith if np.isfinite(zenith) else 45.0)[0])
        share = ((fraction.isel({BAND: middle}) - clear) / (1.0 - clear)).clip(0.0, 1.0)
        share = share.reset_coords(drop=True) if hasattr(share, "reset_coords") else share
        # for unknown and broken skies the weight of overcast follows from the fraction
        clear_words = [SKY_STATES.index(word) for word in ("clear", "hazy")]
        overcast = SKY_STATES.index("overcast")
        known_state = state if hasattr(state, "isin") else xr.full_like(share, state)
        cloud = share.where(~known_state.isin(clear_words), 0.0).where(known_state != overcast, 1.0)
    source = "of the lines' own record"
    return LightSplit(wavelength, fraction, u, cloud, source, sky or RECORDED, zenith, state)
