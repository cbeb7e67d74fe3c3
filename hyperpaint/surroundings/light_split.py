"""Division of the light of a line into direct and diffuse light; position of the sun and radiance of the sky.

Only this module chooses the source of a diffuse fraction: measured, modelled or declared. `survey`, the
corrections and signatures use it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import SchemaError, needs_extra, warn_user
from hyperpaint.base.facts import one_of
from hyperpaint.base.schema import ALONG_TRACK, BAND, SIGNATURE, Floats
from hyperpaint.light.diffuse_record import SKY_STATES, SPLIT, split_of_lines
from hyperpaint.light.sky_functions import (
    clear_sky_shares,
    function_shapes,
    relative_radiance,
    scattering_cosine,
    zenith_radiance,
)
from hyperpaint.light.sun import air_mass, diffuse_fraction, solar_position

from .detection_rules import MIRROR

#: Sources of the diffuse fraction other than a measured spectrum.
SOURCES = ("model", "pvlib", "shadow")

#: Variables of a line that determine the position of the sun.
SUN_FROM = ("time", "latitude", "longitude")

#: Distributions of sky radiance: clear (`hyperpaint.light.sky_functions`), uniform, and CIE's overcast sky.
SKIES = ("clear", "uniform", "overcast")

#: Zenith radiance of a CIE overcast sky over the radiance of a uniform sky with the same irradiance [1].
OVERCAST_ZENITH = 9.0 / 7.0

#: Maximum zenith angle of the sun in sky functions; a lower sun is set to this angle [degree].
MAX_SUN_ZENITH_DEG = 89.0


#: Warning for a line without an irradiance record.
CLEAR_SKY_ASSUMED = (
    "no irradiance record shows the state of the sky, a clear sky is assumed; pass diffuse='model' where "
    "it was clear, or a measured spectrum"
)

#: Warning for a line whose record mostly fits no possible sky.
CONTRADICTION = (
    "the irradiance record contradicts every sky with the sun at {zenith:.1f} degrees from the zenith: check "
    "the clocks (utc_offset_h) and the receiver's calibration, pass sun_zenith= where the clock is wrong, or "
    "diffuse= where the split was measured; until then the split is uncertain"
)

#: Maximum difference between ``sun_zenith`` and the angle from the clock; beyond, the split is computed again
#: [degree].
MAX_CLOCK_DEG = 2.0

#: Value of ``LightSplit.sky`` where the record determines the sky.
RECORDED = "as recorded"

CONTRADICTORY = SKY_STATES.index("contradictory")

#: Number of an unknown state of the sky, as for a measured split; see `SKY_STATES`.
UNKNOWN_STATE = -1

#: Minimum share of the lines for a state that `LightSplit.states` lists [1].
MIN_STATE_SHARE = 0.1

#: Standard uncertainty of a modelled clear sky's diffuse fraction f, relative to f (1 - f): it covers aerosol
#: optical depths of 0.05 to 0.25 [1].
MODEL_U = 0.2


@dataclass(frozen=True)
class LightSplit:
    # The diffuse fraction of the light, with the sky that it comes from.
    #
    # Arrays have dims (band,); (along_track, band) where they differ from line to line; (signature, band)
    # where they differ from paint to paint. They are lazy where the line is lazy.
    wavelength: Floats  #: (band,) [nm]
    fraction: xr.DataArray  #: Diffuse fraction [1].
    u: xr.DataArray  #: Its standard uncertainty [1].
    cloud: Any  #: Weight of an overcast sky in a mixture with a clear sky, without ``band`` [1].
    source: str  #: Source of the fraction, in words for attributes.
    sky: str  #: One of `SKIES`, or `RECORDED`.
    zenith: float  #: Zenith angle of the sun [degree]; NaN where it is unknown and not needed.
    state: Any = UNKNOWN_STATE  #: Number in `SKY_STATES`, also as an array over lines; or `UNKNOWN_STATE`.
    states: tuple[str, ...] = ()  #: Frequent states of the sky; only of a mean over lines.

    def mean(self) -> LightSplit:
        # Return the mean over lines; eager.
        line_dims = [dim for dim in self.fraction.dims if dim != BAND]
        if not line_dims:
            return self
        import dask

        fraction, u, cloud, state = dask.compute(self.fraction, self.u, self.cloud, self.state)
        warn_of_contradiction(state, self.zenith)
        numbers, counts = np.unique(state, return_counts=True)
        frequent = numbers[(counts > MIN_STATE_SHARE * counts.sum()) & (numbers != UNKNOWN_STATE)]
        # errors of the sky are common to all lines: their variance does not fall with the number of lines
        mean_u = np.sqrt((u**2).mean(line_dims) + fraction.var(line_dims))
        mean = fraction.mean(line_dims)
        has_value = np.isfinite(mean.values)
        SchemaError.raise_if(
            not has_value.any(),
            "'diffuse_fraction' of the line, or of its irradiance record, has no finite value",
            mend="pass diffuse= with a measured spectrum, or 'model' where the sky was clear",
            option="give --set diffuse=",
            code="diffuse-fraction-empty",
        )
        if not has_value.all():  # bands without irradiance are interpolated
            nm = self.wavelength
            mean, mean_u = (
                array.copy(data=np.interp(nm, nm[has_value], array.values[has_value]))
                for array in (mean, mean_u)
            )
        return replace(
            self,
            fraction=mean,
            u=mean_u,
            cloud=float(cloud.mean() if hasattr(cloud, "mean") else cloud),
            state=int(numbers[np.argmax(counts)]),
            states=tuple(SKY_STATES[number] for number in frequent),
        )

    def mirrored(self) -> tuple[Floats, Floats]:
        # Return `mirrored_radiances` of a mean (band,) [1].
        SchemaError.raise_if(
            not np.isfinite(self.zenith) and self.sky not in ("uniform", "overcast"),
            "the mirrored sky depends on the position of the sun, which is unknown",
            mend="pass sun_zenith= [degree]",
            option="give --sun-zenith",
            code="sun-unknown",
        )
        if self.sky in SKIES:
            return mirrored_radiances(self.sky, self.wavelength, self.zenith)
        skies = (mirrored_radiances(sky, self.wavelength, self.zenith) for sky in ("clear", "overcast"))
        above, sunward = (
            (1.0 - self.cloud) * blue + self.cloud * grey for blue, grey in zip(*skies, strict=True)
        )
        return above, sunward


def split_of(
    line: xr.Dataset,
    diffuse: Any,
    sun_zenith: float | None,
    sky: str | None = None,
    *,
    from_shadow: bool = False,
) -> LightSplit:
    # Return the division of the light of a line, or of a paint library.
    #
    # ``line``: With ``wavelength``. ``diffuse``: "model" or "pvlib" for a clear sky; or a measured spectrum.
    # None uses ``diffuse_fraction`` and ``sky_state`` of the line, or the split from its ``irradiance``
    # record, or, without either, a clear sky with a warning. ``sun_zenith``: [degree]; by default from time
    # and place. ``sky``: One of `SKIES`; by default from the record, clear with a model, uniform with a
    # measured spectrum. ``from_shadow``: Whether ``diffuse`` may be "shadow", from which a survey starts as
    # from "model".
    #
    # Raises `SchemaError`: ``diffuse`` or ``sky`` has another value, or the position of the sun is needed and
    # unknown.
    #
    # Warns `PaintWarning`: `CLEAR_SKY_ASSUMED`.
    if sky is not None:
        one_of(sky, SKIES, "sky")
    wavelength = line["wavelength"].values.astype(np.float64)
    if not isinstance(diffuse, str) and diffuse is not None:
        fraction = xr.DataArray(measured_fraction(diffuse, wavelength), dims=BAND)
        name = sky or "uniform"
        has_sun = sun_zenith is not None or set(SUN_FROM) <= set(line.variables)
        zenith = sun_zenith_of(line, sun_zenith) if has_sun or name == "clear" else float("nan")
        return LightSplit(
            wavelength, fraction, 0.0 * fraction, float(name == "overcast"), "measured", name, zenith
        )
    if diffuse is None and (declared := _line_split(line, sun_zenith)) is not None:
        # The split of a line, with the weight of an overcast sky from its states and its diffuse fraction
        fraction = declared["diffuse_fraction"].astype(np.float64)
        if ALONG_TRACK in fraction.dims and ALONG_TRACK in line.coords:
            fraction = fraction.assign_coords({ALONG_TRACK: line[ALONG_TRACK]})
        u = declared.get("diffuse_fraction_u", 0.0 * fraction).astype(np.float64)
        try:
            zenith = sun_zenith_of(line, sun_zenith)
        except SchemaError:  # raised later if the angle is needed
            if sun_zenith is not None:
                raise
            zenith = float("nan")
        cloud: Any = float(sky == "overcast")
        state = declared["sky_state"].reset_coords(drop=True) if "sky_state" in declared else UNKNOWN_STATE
        if sky is None:
            # excess of the fraction at 550 nm over a clear sky: the weight for unknown and broken skies
            green = int(np.nanargmin(np.abs(wavelength - 550.0)))
            clear = float(diffuse_fraction(wavelength[[green]], zenith if np.isfinite(zenith) else 45.0)[0])
            excess = ((fraction.isel({BAND: green}) - clear) / (1.0 - clear)).clip(0.0, 1.0)
            excess = excess.reset_coords(drop=True)
            clear_states = [SKY_STATES.index(word) for word in ("clear", "hazy")]
            states = state if hasattr(state, "isin") else xr.full_like(excess, state)
            cloud = excess.where(~states.isin(clear_states), 0.0)
            cloud = cloud.where(states != SKY_STATES.index("overcast"), 1.0)
        return LightSplit(
            wavelength, fraction, u, cloud, "of the lines' own record", sky or RECORDED, zenith, state
        )
    sources = SOURCES if from_shadow else SOURCES[:2]
    SchemaError.raise_if(
        diffuse is not None and diffuse not in sources,
        f"diffuse={diffuse!r}",
        expected=f"{', '.join(map(repr, sources))} or a measured spectrum",
        code="choice-unknown",
    )
    zenith = sun_zenith_of(line, sun_zenith)
    if diffuse is None:
        warn_user(CLEAR_SKY_ASSUMED, "clear-sky-assumed")
    fraction = xr.DataArray(diffuse_from_clear_sky(diffuse or "model", wavelength, zenith), dims=BAND)
    source = f"{diffuse or 'model'}, sun zenith {zenith:.4g} degree"
    u = MODEL_U * fraction * (1.0 - fraction)
    state = SKY_STATES.index("overcast" if sky == "overcast" else "clear")
    return LightSplit(
        wavelength, fraction, u, float(sky == "overcast"), source, sky or "clear", zenith, state
    )


def has_split(line: xr.Dataset) -> bool:
    # Return whether a line declares its diffuse fraction, or has a record from which it follows.
    return _line_split(line, None) is not None


def warn_of_contradiction(states: Any, zenith: float) -> None:
    # Warn where most of the lines' states, numbers in `SKY_STATES`, are "contradictory".
    if np.mean(np.asarray(states) == CONTRADICTORY) > 0.5:
        warn_user(CONTRADICTION.format(zenith=zenith), "sky-contradictory")


def _line_split(line: xr.Dataset, sun_zenith: float | None) -> xr.Dataset | None:
    # Declared split of a line, or the split from its record; None without either
    is_declared = "diffuse_fraction" in line.variables and BAND in line["diffuse_fraction"].dims
    if SIGNATURE in line.dims or ALONG_TRACK not in line.dims:
        # a paint library is small: its values are read
        has_value = is_declared and np.isfinite(line["diffuse_fraction"]).any()
        return _declared_split(line) if has_value else None
    if (
        sun_zenith is not None
        and set(SUN_FROM) <= set(line.variables)
        and abs(sun_zenith_of(line, None) - sun_zenith) > MAX_CLOCK_DEG
        and (recomputed := split_of_lines(line, sun_zenith=float(sun_zenith))) is not None
    ):
        return recomputed
    return _declared_split(line) if is_declared else split_of_lines(line)


def _declared_split(line: xr.Dataset) -> xr.Dataset:
    # Split declared by a line or a library; raise for one on the samples of the irradiance record
    dims = line["diffuse_fraction"].dims
    SchemaError.raise_if(
        not set(dims) <= {ALONG_TRACK, SIGNATURE, BAND},
        f"'diffuse_fraction' has dims {dims}",
        expected=f"({ALONG_TRACK!r}, {BAND!r}) or ({BAND!r},)",
        mend="drop it where the line has its irradiance record, from which it follows",
        code="dims-wrong",
    )
    return line[[name for name in SPLIT if name in line.variables]].reset_coords(drop=True)


# --- position of the sun, fractions of models and measurements, radiances of skies ------------------------


def sun_zenith_of(line: xr.Dataset, sun_zenith: float | None) -> float:
    # Return the zenith angle of the sun [degree]: the argument, or from time and place of the line.
    if sun_zenith is not None:
        SchemaError.raise_if(
            not 0.0 <= sun_zenith <= 90.0,
            f"sun_zenith={sun_zenith!r}",
            expected="0 to 90 degrees",
            code="value-out-of-range",
        )
        return float(sun_zenith)
    SchemaError.raise_if(
        not set(SUN_FROM) <= set(line.variables),
        "the position of the sun is unknown: the line has no time, latitude and longitude",
        mend="pass sun_zenith= [degree], or diffuse= with a measured spectrum",
        option="give --sun-zenith",
        code="sun-unknown",
    )
    zenith, _ = solar_position(*(line[name].values for name in SUN_FROM))
    SchemaError.raise_if(
        not np.isfinite(zenith).any(),
        "time, latitude or longitude is missing on every line",
        mend="pass sun_zenith= [degree]",
        option="give --sun-zenith",
        code="sun-unknown",
    )
    return float(np.mean(zenith[np.isfinite(zenith)]))


def shadow_side_of(line: xr.Dataset, sun_azimuth: float | None, heading: float | None) -> Floats | None:
    # Return the direction (along, across) in the image in which shadows fall; None where it is unknown.
    #
    # The right-hand column is to the right of the flight.
    if heading is None and "heading" in line.variables:
        heading = _mean_angle(line["heading"].values)
    if sun_azimuth is None and set(SUN_FROM) <= set(line.variables):
        _, azimuth = solar_position(*(line[name].values for name in SUN_FROM))
        sun_azimuth = _mean_angle(azimuth)
    if heading is None or sun_azimuth is None:
        return None
    away = np.radians(sun_azimuth + 180.0 - heading)
    return np.array([np.cos(away), np.sin(away)])


def _mean_angle(degrees: Any) -> float | None:
    # Mean direction [degree]; None without finite values
    angles = np.radians(np.asarray(degrees, np.float64)[np.isfinite(degrees)])
    if not angles.size:
        return None
    return float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))


def diffuse_from_clear_sky(source: str, wavelength: Floats, zenith: float) -> Floats:
    # Return the diffuse fraction (band,) [1] of a clear sky, by `hyperpaint.light.sun` or by pvlib.
    #
    # ``source`` "pvlib" runs SPECTRL2 (Bird & Riordan, J. Climate Appl. Meteor. 25, 87, 1986) for sea level,
    # 1.5 cm of water vapour, 0.31 atm-cm of ozone and a turbidity of 0.1 at 500 nm.
    if source != "pvlib":
        return diffuse_fraction(wavelength, zenith)
    with needs_extra("pvlib", "sim", "the direct/diffuse split of SPECTRL2"):
        from pvlib.spectrum import spectrl2
    spectra: Any = spectrl2(
        apparent_zenith=zenith,
        aoi=zenith,
        surface_tilt=0,
        ground_albedo=0.2,
        surface_pressure=101_325.0,
        relative_airmass=float(air_mass(zenith)),
        precipitable_water=1.5,
        ozone=0.31,
        aerosol_turbidity_500nm=0.1,
        dayofyear=172,
    )
    direct = spectra["poa_global"] - spectra["poa_sky_diffuse"] - spectra["poa_ground_diffuse"]
    return np.interp(
        wavelength, np.ravel(spectra["wavelength"]), 1.0 - np.ravel(direct) / np.ravel(spectra["poa_global"])
    )


def measured_fraction(fraction: Any, wavelength: Floats) -> Floats:
    # Return a measured diffuse fraction at the wavelengths of the bands.
    #
    # Takes ``fraction``, an array (band,) or a DataArray with a coordinate ``wavelength``: reading in the
    # shade of a small disc over the reading in full light [1]; ``wavelength`` (band,) [nm]. Raises
    # `SchemaError`: it does not cover the bands, or values are missing or outside 0 to 1.
    if hasattr(fraction, "coords") and "wavelength" in fraction.coords:
        nm = np.asarray(fraction["wavelength"].values, np.float64)
        order = np.argsort(nm, kind="stable")
        values = np.interp(
            wavelength, nm[order], np.asarray(fraction.values, np.float64)[order], np.nan, np.nan
        )
    else:
        values = np.asarray(fraction, np.float64)
    SchemaError.raise_if(
        values.shape != wavelength.shape,
        f"diffuse= has shape {values.shape}",
        expected=f"one value for each of the {wavelength.size} bands, or a DataArray with a coordinate "
        "'wavelength' [nm]",
        code="length-mismatch",
    )
    SchemaError.raise_if(
        not ((values >= 0) & (values <= 1)).all(),
        "diffuse= has missing values or values outside 0 to 1",
        expected="0 to 1 in all bands",
        code="value-out-of-range",
    )
    return values


def mirrored_radiances(sky: str, wavelength: Floats, sun_zenith: float) -> tuple[Floats, Floats]:
    # Return the radiance of the zenith, and the excess of the sky around the sun over it (band,) [1].
    #
    # Both are relative to the mean of the sky. Only a clear sky is brighter around the sun. Takes ``sky``,
    # one of `SKIES`, ``wavelength`` (band,) [nm] and the sun's zenith angle [degree].
    zero = np.zeros(wavelength.shape)
    if sky != "clear":
        return zero + (OVERCAST_ZENITH if sky == "overcast" else 1.0), zero
    zenith = min(sun_zenith, MAX_SUN_ZENITH_DEG)
    above = zenith_radiance(wavelength, zenith)
    cosine = np.cos(np.radians(max(zenith - MIRROR.from_sun_deg, 0.0)))
    from_sun = scattering_cosine(cosine, np.array(0.0), zenith)
    shapes = function_shapes(zenith)
    radiances = np.array([1.0, *(relative_radiance(shape, cosine, from_sun) for shape in shapes)])
    return above, np.maximum(radiances @ clear_sky_shares(wavelength, zenith) - above, 0.0)
