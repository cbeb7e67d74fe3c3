"""How the light of a line divides, as it was measured, modelled or is said, and what sky that is.

The one place that decides where a diffuse fraction is from: `survey`, the corrections and signatures ask it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

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

if TYPE_CHECKING:
    import xarray as xr

CLEAR_SKY_TAKEN = (
    "no record of irradiance says what the sky was, a clear one is taken; give diffuse='model' where it was, "
    "or a measured spectrum"
)
"""What is warned of where nothing but the sun's place is known."""

CONTRADICTION = (
    "the record of irradiance contradicts every sky with the sun at {zenith:.1f} degrees from the zenith: "
    "check the clocks (utc_offset_h) and the receiver's calibration, give sun_zenith= where the clock is "
    "wrong, or diffuse= where the split was measured; until then the split is uncertain"
)
"""What is warned of where most lines are of no sky that there may be."""

MAX_CLOCK_DEG = 2.0
"""Distance of a sun that is said from that of the clock, beyond which the split is made anew [degree]."""

RECORDED = "as recorded"
"""Sky of a line whose ``sky_state`` says which it is."""

CONTRADICTORY = SKY_STATES.index("contradictory")

UNSAID = -1
"""In place of a number of `SKY_STATES` where nothing says what the sky was, as of a measured split."""

MIN_STATE_SHARE = 0.1
"""Share of the lines that have a word, from which on it counts among those of a mean [1]."""

MODEL_U = 0.2
"""Standard uncertainty of a modelled clear sky's fraction, relative to f (1 - f): aerosol of 0.05 to 0.25."""


@dataclass(frozen=True)
class LightSplit:
    """The diffuse part of the light, and where in the sky it comes from.

    ``fraction`` and ``u``, its standard uncertainty, have dims (band,), or (along_track, band) or (signature,
    band) where they differ; ``cloud``, without ``band``, is the weight of an overcast sky in a clear one [1].
    Lazy where the line is. ``zenith`` of the sun is NaN where it is not known nor needed [degree].
    """

    wavelength: Floats  #: (band,) [nm]
    fraction: xr.DataArray
    u: xr.DataArray
    cloud: Any
    source: str  #: Where the fraction is from, as attributes say it.
    sky: str  #: One of `SKIES`, or `RECORDED`.
    zenith: float
    state: Any = UNSAID  #: Number of the sky's word, or of each line's; `UNSAID` where nothing says it.
    states: tuple[str, ...] = ()  #: Words of ``sky_state`` that occur; of a mean only.

    def mean(self) -> LightSplit:
        """Return the mean over lines; eager."""
        over = [dim for dim in self.fraction.dims if dim != BAND]
        if not over:
            return self
        import dask

        fraction, u, cloud, state = dask.compute(self.fraction, self.u, self.cloud, self.state)
        warn_of_contradiction(state, self.zenith)
        numbers, counts = np.unique(state, return_counts=True)
        frequent = numbers[(counts > MIN_STATE_SHARE * counts.sum()) & (numbers != UNSAID)]
        words = tuple(SKY_STATES[number] for number in frequent)
        # the sky's doubt is common to its lines
        spread = np.sqrt((u**2).mean(over) + fraction.var(over))
        weight = cloud.mean() if hasattr(cloud, "mean") else cloud
        whole = fraction.mean(over)
        known = np.isfinite(whole.values)
        if not known.any():
            raise SchemaError(
                "the line has 'diffuse_fraction', or a record that it follows from, without any value",
                mend="give diffuse= with a measured spectrum, or 'model' where the sky was clear",
                option="give --set diffuse=",
            )
        if not known.all():  # bands without irradiance, which others around them stand for
            nm = self.wavelength
            whole, spread = (
                each.copy(data=np.interp(nm, nm[known], each.values[known])) for each in (whole, spread)
            )
        return LightSplit(
            self.wavelength, whole, spread, float(weight), self.source, self.sky, self.zenith,
            state=int(numbers[np.argmax(counts)]), states=words,
        )  # fmt: skip

    def mirrored(self) -> tuple[Floats, Floats]:
        """Return `mirrored_radiances` of a mean (band,) [1]."""
        if not np.isfinite(self.zenith) and self.sky not in ("uniform", "overcast"):
            raise SchemaError(
                "the sun's place is not known, which the mirrored sky depends on",
                mend="give sun_zenith= [degree]",
                option="give --sun-zenith",
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
    """Return how the light of a line, or of a paint library, divides.

    Parameters
    ----------
    line
        With ``wavelength``.
    diffuse
        None for what the line holds itself: ``diffuse_fraction`` and ``sky_state``, else what follows from
        its record of ``irradiance``; a clear sky, with a warning, where it has neither. "model" or "pvlib"
        for a clear sky; or a measured spectrum.
    sun_zenith
        [degree]; from time and place unless given.
    sky
        One of `SKIES`; by default what the record says, clear with a model, uniform with a measured spectrum.

    Raises
    ------
    SchemaError
        ``diffuse`` or ``sky`` is none of these, or the sun's place is needed and not known.

    Warns
    -----
    PaintWarning
        `CLEAR_SKY_TAKEN`.
    """
    import xarray as xr

    if sky is not None and sky not in SKIES:
        raise SchemaError(f"sky={sky!r}, expected one of {', '.join(SKIES)}")
    wavelength = line["wavelength"].values.astype(np.float64)
    if not isinstance(diffuse, str) and diffuse is not None:
        fraction = xr.DataArray(measured_fraction(diffuse, wavelength), dims=BAND)
        name = sky or "uniform"
        has_sun = sun_zenith is not None or set(SUN_FROM) <= set(line.variables)
        zenith = sun_zenith_of(line, sun_zenith) if has_sun or name == "clear" else float("nan")
        cloud = float(name == "overcast")
        return LightSplit(wavelength, fraction, 0.0 * fraction, cloud, "measured", name, zenith)
    own = _own(line, sun_zenith) if diffuse is None else None
    if own is not None:
        return _recorded(line, own, wavelength, sun_zenith, sky)
    if diffuse is not None and diffuse not in SOURCES:
        raise SchemaError(
            f"diffuse={diffuse!r}, expected {', '.join(map(repr, SOURCES))} or a measured spectrum"
        )
    zenith = sun_zenith_of(line, sun_zenith)
    if diffuse is None:
        warnings.warn(CLEAR_SKY_TAKEN, PaintWarning, stacklevel=3)
    values = diffuse_from_clear_sky(diffuse or "model", wavelength, zenith)
    fraction = xr.DataArray(values, dims=BAND)
    source = f"{diffuse or 'model'}, sun zenith {zenith:.4g} degree"
    name = sky or "clear"
    spread = MODEL_U * fraction * (1.0 - fraction)
    cloud, state = float(name == "overcast"), SKY_STATES.index("overcast" if name == "overcast" else "clear")
    return LightSplit(wavelength, fraction, spread, cloud, source, name, zenith, state)


def says_its_split(line: xr.Dataset) -> bool:
    """Return whether a line says itself how its light divides, or has a record that it follows from."""
    return _own(line, None) is not None


def warn_of_contradiction(states: Any, zenith: float) -> None:
    """Warn where most of the lines' words, numbers of `SKY_STATES`, are that of no sky."""
    if np.mean(np.asarray(states) == CONTRADICTORY) > 0.5:
        warnings.warn(CONTRADICTION.format(zenith=zenith), PaintWarning, stacklevel=3)


def _own(line: xr.Dataset, sun_zenith: float | None) -> xr.Dataset | None:
    """Return what a line says of its light itself, or what its record says; None without either."""
    if SIGNATURE in line.dims or ALONG_TRACK not in line.dims:
        # of paints it is small; one that is not known leaves nothing to go by
        held = line["diffuse_fraction"] if "diffuse_fraction" in line.variables else None
        return _held(line) if held is not None and BAND in held.dims and np.isfinite(held).any() else None
    if sun_zenith is not None and set(SUN_FROM) <= set(line.variables):
        clock = sun_zenith_of(line, None)
        if abs(clock - sun_zenith) > MAX_CLOCK_DEG:
            anew = split_of_lines(line, sun_zenith=float(sun_zenith))
            if anew is not None:
                return anew
    if "diffuse_fraction" in line.variables and BAND in line["diffuse_fraction"].dims:
        return _held(line)
    return split_of_lines(line)


def _held(line: xr.Dataset) -> xr.Dataset:
    """Return the split that a line or a library holds, refused where it is of samples of the record."""
    dims = line["diffuse_fraction"].dims
    if not set(dims) <= {ALONG_TRACK, SIGNATURE, BAND}:
        raise SchemaError(
            f"'diffuse_fraction' has dims {dims}, expected ({ALONG_TRACK!r}, {BAND!r}) or ({BAND!r},); drop "
            "it where the line has its record: it follows from that"
        )
    return line[[name for name in SPLIT if name in line.variables]].reset_coords(drop=True)


def _recorded(
    line: xr.Dataset, own: xr.Dataset, wavelength: Floats, sun_zenith: float | None, sky: str | None
) -> LightSplit:
    import xarray as xr

    fraction = own["diffuse_fraction"].astype(np.float64)
    if ALONG_TRACK in fraction.dims and ALONG_TRACK in line.coords:
        fraction = fraction.assign_coords({ALONG_TRACK: line[ALONG_TRACK]})
    u = own["diffuse_fraction_u"].astype(np.float64) if "diffuse_fraction_u" in own else 0.0 * fraction
    try:
        zenith = sun_zenith_of(line, sun_zenith)
    except SchemaError:  # refused where it is needed
        if sun_zenith is not None:
            raise
        zenith = float("nan")
    cloud: Any = float(sky == "overcast")
    state: Any = UNSAID
    if "sky_state" in own:
        state = own["sky_state"].reset_coords(drop=True)
    if sky is None:
        middle = int(np.nanargmin(np.abs(wavelength - 550.0)))
        clear = float(diffuse_fraction(wavelength[[middle]], zenith if np.isfinite(zenith) else 45.0)[0])
        share = ((fraction.isel({BAND: middle}) - clear) / (1.0 - clear)).clip(0.0, 1.0)
        share = share.reset_coords(drop=True) if hasattr(share, "reset_coords") else share
        # where nothing says a word, as where clouds are broken: by the fraction
        clear_words = [SKY_STATES.index(word) for word in ("clear", "hazy")]
        overcast = SKY_STATES.index("overcast")
        said = state if hasattr(state, "isin") else xr.full_like(share, state)
        cloud = share.where(~said.isin(clear_words), 0.0).where(said != overcast, 1.0)
    source = "of the lines' own record"
    return LightSplit(wavelength, fraction, u, cloud, source, sky or RECORDED, zenith, state)
