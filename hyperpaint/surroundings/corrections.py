"""Corrections of reflectance for the light of the sky: mirrored sky, tilt, hidden sky, clear coat.

They are applied on request only, and recorded in the attributes of ``reflectance``.

They need the division of the light of a line into direct and diffuse light, the position of the sun and the
radiance of the sky. Only this module chooses the source of a diffuse fraction: measured, modelled or
declared. `survey`, the corrections and signatures use it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    BODY,
    CROSS_TRACK,
    EXCLUDED,
    SIGNATURE,
    THROUGH_COAT,
    Floats,
    Problems,
    SchemaError,
    convert,
    documented,
    mirror_reflection,
    needs_extra,
    one_of,
    schema,
    takes_quantities,
    warn_if,
)
from hyperpaint.geometry.georeference.viewing import pixel_view
from hyperpaint.light.clear_sky import ClearSky, air_mass, cubic_weights, linear_weights, sunward_gain
from hyperpaint.light.coat_transmission import (
    COAT_INDEX,
    COAT_INDEX_U,
    interface_reflectance,
    sky_reflectance,
    transmitted_share,
)
from hyperpaint.light.diffuse_record import SKY_STATES, SPLIT, split_of_lines
from hyperpaint.light.sky_functions import (
    AZIMUTH_STEP_DEG,
    ZENITH_STEP_DEG,
    clear_sky_shares,
    function_tables,
)
from hyperpaint.light.sun import diffuse_fraction, solar_position

from .detection_rules import MIRROR

#: Sources of the diffuse fraction other than a measured spectrum.
SOURCES = ("model", "pvlib", "shadow")

#: Variables of a line that determine the position of the sun.
SUN_FROM = ("time", "latitude", "longitude")

#: Distributions of sky radiance: clear (`hyperpaint.light.clear_sky`), uniform, and CIE's overcast sky.
SKIES = ("clear", "uniform", "overcast")

SKY = SimpleNamespace(
    #: Zenith radiance of a CIE overcast sky over the radiance of a uniform sky with the same irradiance [1].
    overcast_zenith=9.0 / 7.0,
    #: Maximum difference between ``sun_zenith`` and the angle from the clock; beyond, the split is computed
    #: again [degree].
    max_clock_deg=2.0,
    #: Standard uncertainty of the radiance of a sky in one direction, relative: polarisation changes it by 3
    #: to 6 % in the blue, the phase function of aerosol as much; and of a measured split's, taken for uniform
    #: [1].
    sky_u=(0.06, 0.4),
    #: Angle from the zenith of an unknown view: half of the half field of view of a usual camera [degree].
    unknown_view_deg=10.0,
    #: Minimum share of the lines for a state that `LightSplit.states` lists [1].
    min_state_share=0.1,
)

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


#: Value of ``LightSplit.sky`` where the record determines the sky.
RECORDED = "as recorded"

CONTRADICTORY = SKY_STATES.index("contradictory")

#: Number of an unknown state of the sky, as for a measured split; see `SKY_STATES`.
UNKNOWN_STATE = -1

#: Aerosol optical depths at 500 nm between which the sky of a split is interpolated [1].
SKY_AEROSOLS = np.array([0.03, 0.06, 0.1, 0.16, 0.25, 0.4])

#: Directions at which clear skies are computed, from the zenith and in azimuth from the sun [degree].
SKY_ZENITH_DEG, SKY_AZIMUTH_DEG = np.arange(0.0, 88.0, 3.0), np.arange(0.0, 181.0, 10.0)


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

    def mean(self) -> "LightSplit":
        # Return the mean over lines; eager.
        line_dims = [dim for dim in self.fraction.dims if dim != BAND]
        if not line_dims:
            return self
        import dask

        fraction, u, cloud, state = dask.compute(self.fraction, self.u, self.cloud, self.state)
        warn_of_contradiction(state, self.zenith)
        numbers, counts = np.unique(state, return_counts=True)
        frequent = numbers[(counts > SKY.min_state_share * counts.sum()) & (numbers != UNKNOWN_STATE)]
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
        # Return the radiance of the zenith, and the excess of the sky around the sun over it (band,) [1].
        #
        # Both are relative to the mean of the sky, and of a mean over lines.
        above = relative_sky(self)
        near_sun = relative_sky(self, max(self.zenith - MIRROR.from_sun_deg, 0.0))
        ones = np.ones(self.wavelength.shape)
        # without a sun the excess of a uniform or an overcast sky is not defined
        excess = np.maximum(near_sun - above, 0.0) if np.isfinite(self.zenith) else 0.0
        return np.asarray(ones * above), np.asarray(ones * excess)


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
    warn_if(diffuse is None, CLEAR_SKY_ASSUMED, "clear-sky-assumed")
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
    is_contradicted = np.mean(np.asarray(states) == CONTRADICTORY) > 0.5
    warn_if(is_contradicted, CONTRADICTION.format(zenith=zenith), "sky-contradictory")


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
        and abs(sun_zenith_of(line, None) - sun_zenith) > SKY.max_clock_deg
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


def _sun_azimuth_of(line: xr.Dataset, sun_zenith: float | None) -> float | None:
    # Mean azimuth of the sun [degree]; None where it is unknown, or the clock contradicts `sun_zenith`
    if not set(SUN_FROM) <= set(line.variables):
        return None
    zenith, azimuth = solar_position(*(line[name].values for name in SUN_FROM))
    is_contradicted = sun_zenith is not None and abs(np.nanmean(zenith) - sun_zenith) > SKY.max_clock_deg
    return None if is_contradicted else _mean_angle(azimuth)


def shadow_side_of(line: xr.Dataset, sun_azimuth: float | None, heading: float | None) -> Floats | None:
    # Return the direction (along, across) in the image in which shadows fall; None where it is unknown.
    #
    # The last column is to the right of the flight, and the last line ahead, unless ``look_across`` or else
    # the labels decrease: the camera's columns run to the left, or the picture has been reversed.
    if heading is None and "heading" in line.variables:
        heading = _mean_angle(line["heading"].values)
    if sun_azimuth is None:
        sun_azimuth = _sun_azimuth_of(line, None)
    if heading is None or sun_azimuth is None:
        return None
    away = np.radians(sun_azimuth + 180.0 - heading)
    across = "look_across" if "look_across" in line.variables else CROSS_TRACK
    axes = (np.asarray(line.get(name, np.zeros(1))) for name in (ALONG_TRACK, across))
    signs = [-1.0 if axis[0] > axis[-1] else 1.0 for axis in axes]
    return np.array([np.cos(away), np.sin(away)]) * signs


def _mean_angle(degrees: Any) -> float | None:
    # Mean direction [degree]; None without finite values
    angles = np.radians(np.asarray(degrees, np.float64)[np.isfinite(degrees)])
    return (
        None
        if not angles.size
        else float(np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())))
    )


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


#: Attributes of reflectance that record corrections.
CORRECTIONS = ("mirrored_sky_removed", "light_corrected", "tilt", "coat_corrected")

#: Maximum relative change of direct light that is treated as a lean, which changes diffuse light, too [1].
MAX_TILT_GAIN = 0.3

#: Normal reflectance of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1].
NORMAL_REFLECTANCE = 0.04

#: Standard deviation of the lean of roofs and bonnets that are assumed to be level [degree].
LEAN_U_DEG = 2.0

#: Mend of the error by the earlier correction.
_MENDS = {
    "mirrored_sky_removed": "start from uncorrected reflectance",
    "coat_corrected": "start from uncorrected reflectance, and correct the coat last",
    "light_corrected": "start from uncorrected reflectance, and remove the mirrored sky first",
    "tilt": "compute reflectance without tilt=, remove the mirrored sky if wanted, then call "
    "correct_light(direct=cos(incidence) / cos(sun zenith), sky_view_factor=(1 + cos(tilt)) / 2)",
}

#: Variables of a flight line or paint library that a subtraction changes; a division changes `WIDTHS`, too.
LEVELS = ("reflectance", "reflectance_quantiles", "member_reflectance")
WIDTHS = (
    "reflectance_sd",
    "reflectance_u_random",
    "reflectance_u_systematic",
    "reflectance_u_coat",
    "reflectance_errors",
)


@takes_quantities(sun_zenith="degree")
@documented(line="spectra")
def remove_mirrored_sky(
    line: xr.Dataset,
    *,
    strength: float = NORMAL_REFLECTANCE,
    sky_view_factor: float = 1.0,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Subtract the sky that a level clear coat mirrors to the camera.

    Lazy. For paint; on asphalt, which mirrors nothing, the result is too dark in the blue.

    Parameters
    ----------
    line
    strength
        Reflectance of the coat at normal incidence, :math:`F_0` [1].
    sky_view_factor
        Part of the mirrored directions that show sky [1].
    diffuse, sun_zenith
    sky
        Distribution of sky radiance: "clear", under a low sun darker at the zenith than on average;
        "uniform"; "overcast" (CIE), brighter at the zenith. By default from ``sky_state`` of the lines,
        between clear and overcast if it is broken or contradictory; without it, clear for a modelled split,
        and uniform for a measured split, which may be of any sky.

    Returns
    -------
    Dataset
        The line or library with reduced ``reflectance``, quantiles and members; the uncertainty of the
        mirrored sky is included in ``reflectance_u_systematic`` where present, and is
        ``reflectance_u_coat`` (signature, band) of a library [1]. The attribute ``mirrored_sky_removed`` of
        reflectance describes the correction, and ``mirror_reflection`` is "excluded".

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are outside 0 to 1, the sky was removed or the
        light corrected before (`correct_light`, or ``tilt=`` of `hyperpaint.reflectance`), or the split or
        the sky is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear sky is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} - V F(\theta_v) f_{dif} L(\theta_v, \varphi_v + 180°) / \bar L

    with Fresnel's reflectance F, :math:`F_0` at the normal, and the radiance L that a level body part mirrors
    to the camera at the zenith angle :math:`\theta_v` and azimuth :math:`\varphi_v`, over the mean of the
    sky. The directions are those of the line's pixels (``view_zenith`` and ``view_azimuth``, or look angles
    with attitude and heading), and of a library's paints; where they or the azimuth of the sun are unknown,
    the zenith is mirrored. The uncertainty includes the lean of a paint, ``lean`` of a library where present,
    else 2 degrees. For a tilted body part, remove the sky first, and correct the light then: mirrored light
    does not grow with the light on the paint.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.042, 0.033]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> remove_mirrored_sky(paint, sun_zenith=30.0).reflectance.values.round(3)
    array([0.032, 0.031], dtype=float32)
    """
    # all corrections must follow this one: mirrored light does not scale with the light on the paint
    numbers = {"strength": (strength, 0.0, 1.0), "sky_view_factor": (sky_view_factor, 0.0, 1.0)}
    line = _checked(line, CORRECTIONS, numbers)
    amount = strength * sky_view_factor
    if SIGNATURE in line["reflectance"].dims:
        paints = list(_paints(line, diffuse, sun_zenith, sky))
        parts = [
            mirrored_sky(split, *_view_of(paint), strength=amount, lean_u=_known(paint["lean"], LEAN_U_DEG))
            for paint, split in paints
        ]
        mirrored, mirrored_u = (_by_paint(column) for column in zip(*parts, strict=True))
        attrs = schema.LIBRARY_VARIABLES["reflectance_u_coat"].attrs
        line = line.assign(reflectance_u_coat=mirrored_u.astype(np.float32).assign_attrs(attrs))
        splits = [split for _, split in paints]
        has_view = any(np.isfinite(sum(_view_of(paint))) for paint, _ in paints)
    else:
        splits = [split := split_of(line, diffuse, sun_zenith, sky)]
        mirrored, mirrored_u = mirrored_sky(split, strength=amount)
        view, azimuth = pixel_view(line), _sun_azimuth_of(line, sun_zenith)
        if has_view := view is not None and azimuth is not None:
            # pixels without a view mirror the zenith
            is_known = np.isfinite(view[0] + view[1])
            zenith = view[0].where(is_known, 0.0).astype(np.float32)
            from_sun = (view[1].where(is_known, 0.0) + (180.0 - azimuth)).astype(np.float32)
            relative = xr.apply_ufunc(
                interface_reflectance, zenith, dask="parallelized", output_dtypes=[np.float64]
            ) / interface_reflectance(0.0)
            sky_light = split.fraction.astype(np.float32) * relative_sky(split, zenith, from_sun)
            mirrored = (amount * relative).astype(np.float32) * sky_light
    corrected = {name: line[name] - mirrored.astype(np.float32) for name in LEVELS if name in line.variables}
    if (name := "reflectance_u_systematic") in line.variables:
        corrected[name] = (line[name] ** 2 + mirrored_u.astype(np.float32) ** 2) ** 0.5
    sources = list(dict.fromkeys(split.source for split in splits))
    source = sources[0] if len(sources) == 1 else f"{sources[0]} to {sources[-1]}"
    text = (
        f"F0 {strength:g} x sky view {sky_view_factor:g} x diffuse fraction ({source}) "
        f"x sky ({splits[0].sky}) {'that a level panel mirrors' if has_view else 'at the zenith'}"
    )
    return _with_correction(line, corrected, "mirrored_sky_removed", text)


@takes_quantities(direct="1", sky_view_factor="1", sun_zenith="degree")
@documented(line="spectra")
def correct_light(
    line: xr.Dataset,
    *,
    direct: Any = 1.0,
    sky_view_factor: Any = 1.0,
    neighbour_reflectance: float = 0.2,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Divide by the light on a tilted surface, or on one with partly hidden sky.

    Lazy. For one surface of known or estimated attitude (`hyperpaint.surroundings.flag` gives 1 - c as
    ``blocked_direct``); `hyperpaint.reflectance` takes a `Tilt` where it is known in degrees.

    Parameters
    ----------
    line
    direct
        Direct light relative to level ground, c = cos(incidence) / cos(zenith) [1]: a number, or a DataArray
        on dims of the line.
    sky_view_factor
        Visible part of the sky, V [1]; as ``direct``.
    neighbour_reflectance
        Reflectance of the objects that hide the rest [1].
    diffuse, sun_zenith
    sky
        As for `remove_mirrored_sky`; a small lean changes as little under an overcast as under a uniform sky.

    Returns
    -------
    Dataset
        The same with ``reflectance`` and its uncertainties divided, and a library's spread, quantiles and
        members; NaN without light. The attribute ``light_corrected`` of reflectance records the correction.

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are out of range, the light was corrected before
        (here, or by ``tilt=`` of `hyperpaint.reflectance`), or the split is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear one is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{obs} / (c f_{dir} + V (1 + g (c - 1)) f_{dif} + (1 - V) \rho_n)

    with the gain g of diffuse light of a surface that leans towards the sun, 0 but under a clear sky
    (`hyperpaint.light.clear_sky.sunward_gain`; to first order, up to `MAX_TILT_GAIN` of c).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.4, 0.4]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [410.0, 850.0], {"units": "nm"})})
    >>> correct_light(paint, direct=1.1, sun_zenith=30.0).reflectance.values.round(3)
    array([0.37 , 0.364], dtype=float32)
    """
    plain = {
        name: value
        for name, value in (("direct", direct), ("sky_view_factor", sky_view_factor))
        if np.ndim(value) == 0 and not hasattr(value, "dims")
    }
    numbers = {"neighbour_reflectance": neighbour_reflectance, **plain}.items()
    line = _checked(line, ("light_corrected", "tilt"), {name: (value, 0.0, 10.0) for name, value in numbers})
    split = split_of(line, diffuse, sun_zenith, sky)
    gain: Any = 0.0
    if split.sky not in ("uniform", "overcast"):
        of_sky = sunward_gain(split.wavelength, split.zenith).astype(np.float32)
        gain = (1.0 - split.cloud) * xr.DataArray(of_sky, dims=BAND)
    share, lean = split.fraction.astype(np.float32), np.clip(direct - 1.0, -MAX_TILT_GAIN, MAX_TILT_GAIN)
    try:
        # xarray would reduce operands with other pixels to the common ones
        with xr.set_options(arithmetic_join="exact"):
            sky_light = sky_view_factor * (1.0 + lean * gain) * share
            light = direct * (1.0 - share) + sky_light + (1.0 - sky_view_factor) * neighbour_reflectance
            light = light.where(light > 0)
            corrected = {name: line[name] / light for name in (*LEVELS, *WIDTHS) if name in line.variables}
    except ValueError as error:  # also of numpy, for shapes
        raise SchemaError(
            "lines, bands or columns of direct= or sky_view_factor= differ from those of the flight line",
            expected="a number, or a DataArray on dims of the line",
            mend="crop all to the same pixels, or drop their coordinates along_track and cross_track",
            code="grid-mismatch",
        ) from error
    amounts = ", ".join(
        f"{name} {f'{value:g}' if name in plain else 'given'}"
        for name, value in (("direct", direct), ("sky view", sky_view_factor))
    )
    return _with_correction(
        line, corrected, "light_corrected", f"{amounts}, diffuse fraction ({split.source}), sky ({split.sky})"
    )


def _checked(
    line: xr.Dataset,
    excluded: tuple[str, ...],
    numbers: Mapping[str, tuple[float, float, float]],
    of_body: bool = False,
) -> xr.Dataset:
    # The line with `LEVELS` and `WIDTHS` in units of 1. Raise for missing variables, numbers (value, minimum,
    # maximum) out of range, one of the excluded corrections, and, with `of_body`, a mirrored sky
    line = schema.rename_to_roles(line)
    with Problems("reflectance cannot be corrected", SchemaError) as problems:
        for name in ("reflectance", "wavelength"):
            problems.add_if(name not in line.variables, f"{name!r} is missing", code="variable-missing")
        for name, (value, low, high) in numbers.items():
            problems.add_if(
                not low <= value <= high,
                f"{name}={value!r}",
                expected=f"{low:g} to {high:g}",
                code="value-out-of-range",
            )
        attrs = line["reflectance"].attrs if "reflectance" in line.variables else {}
        earlier = [name for name in excluded if name in attrs]
        for name in earlier:
            problems.add(
                f"corrected before: {name} is {attrs[name]!r}", mend=_MENDS[name], code="corrected-before"
            )
        problems.add_if(
            of_body
            and "reflectance" in line.variables
            and not earlier
            and mirror_reflection(line) != EXCLUDED,
            "the reflectance includes the sky mirrored by the coat, or does not declare its exclusion",
            mend="call remove_mirrored_sky first, or set reflectance.attrs['mirror_reflection'] = "
            f"{EXCLUDED!r} where no mirrored sky is included",
            option="give --specular-sky",
            code="mirrored-sky-included",
        )
    return line.assign(
        {name: convert(line[name], "1") for name in (*LEVELS, *WIDTHS) if name in line.variables}
    )


def relative_sky(split: LightSplit, zenith: Any = 0.0, from_sun: Any = 0.0) -> Any:
    # Return the radiance of the sky in a direction over its mean [1], on the dims of split and direction.
    #
    # Takes the direction's angle from the zenith and its azimuth from the sun [degree]: numbers or
    # DataArrays, also lazy ones of pixels, for which the clear sky is the sum of its functions
    # (`hyperpaint.light.sky_functions`). The clear sky has the aerosol with which its diffuse fraction at
    # 550 nm is that of the split without its clouds: a hazy sky is brighter around the sun.
    SchemaError.raise_if(
        not np.isfinite(split.zenith) and split.sky not in ("uniform", "overcast"),
        "the mirrored sky depends on the position of the sun, which is unknown",
        mend="pass sun_zenith= [degree]",
        option="give --sun-zenith",
        code="sun-unknown",
    )
    cosine = np.cos(np.radians(zenith))
    overcast = SKY.overcast_zenith * (1.0 + 2.0 * cosine) / 3.0
    if split.sky in ("uniform", "overcast"):
        return overcast if split.sky == "overcast" else 1.0 + 0.0 * cosine
    # weights of skies with the aerosols of the nodes
    nm, sun = split.wavelength, min(split.zenith, MAX_SUN_ZENITH_DEG)
    green = int(np.nanargmin(np.abs(nm - 550.0)))
    direct, diffuse = ClearSky(sun, SKY_AEROSOLS[:, None]).transmittances(nm[[green]])
    nodes = (diffuse / (direct + diffuse))[:, 0]
    clear_fraction = (split.fraction.isel({BAND: green}) - split.cloud) / np.maximum(1.0 - split.cloud, 1e-3)
    weights = xr.apply_ufunc(
        partial(linear_weights, nodes),
        clear_fraction.reset_coords(drop=True),
        output_core_dims=[["aerosol"]],
        dask="parallelized",
        output_dtypes=[np.float64],
        dask_gufunc_kwargs={"output_sizes": {"aerosol": nodes.size}},
    )
    if {ALONG_TRACK, CROSS_TRACK} & set(getattr(cosine, "dims", ())):
        shares = np.stack([clear_sky_shares(nm, sun, aerosol) for aerosol in SKY_AEROSOLS])
        by_line = (weights * xr.DataArray(shares, dims=("aerosol", "function", BAND))).sum(
            "aerosol", skipna=False
        )
        uniform, *amounts = (by_line.isel(function=k).astype(np.float32) for k in range(shares.shape[1]))
        clear: Any = uniform
        for amount, table in zip(amounts, function_tables(sun), strict=True):
            clear = clear + amount * xr.apply_ufunc(
                partial(_towards, table), zenith, from_sun, dask="parallelized", output_dtypes=[np.float32]
            )
    else:
        turned = np.degrees(np.arccos(np.cos(np.radians(from_sun))))
        by_zenith, by_azimuth = cubic_weights(SKY_ZENITH_DEG, zenith), cubic_weights(SKY_AZIMUTH_DEG, turned)
        places = by_zenith[..., :, None] * by_azimuth[..., None, :]
        # suns of one line are rounded, so that they share their skies
        skies = np.tensordot(_clear_skies(round(sun, 1), tuple(nm)), places, ((2, 3), (-2, -1)))
        dims = ("aerosol", BAND, *getattr(cosine, "dims", ()))
        clear = (weights * xr.DataArray(skies, dims=dims)).sum("aerosol", skipna=False)
    return (1.0 - split.cloud) * clear + split.cloud * overcast


@lru_cache(maxsize=8)
def _clear_skies(sun_zenith: float, wavelength: tuple[float, ...]) -> Floats:
    # Clear skies over their means (aerosol, band, zenith, azimuth), at nodes of the directions
    cosine, azimuth = np.cos(np.radians(SKY_ZENITH_DEG))[:, None], np.radians(SKY_AZIMUTH_DEG)
    skies = [ClearSky(sun_zenith, aerosol) for aerosol in SKY_AEROSOLS]
    return np.array([sky.relative_radiance(np.array(wavelength), cosine, azimuth) for sky in skies])


def _towards(table: Floats, zenith: Floats, from_sun: Floats) -> Floats:
    # A function of the sky (zenith, azimuth) in directions [degree]
    turned = np.abs((from_sun + 180.0) % 360.0 - 180.0)
    places = np.broadcast_arrays(zenith / ZENITH_STEP_DEG, turned / AZIMUTH_STEP_DEG)
    return np.asarray(map_coordinates(table, places, np.float32, order=1, mode="nearest"))


def mirrored_sky(
    split: LightSplit,
    view_zenith: float = 0.0,
    relative_azimuth: float = 0.0,
    *,
    strength: float = NORMAL_REFLECTANCE,
    index_u: float = COAT_INDEX_U,
    lean_u: float = LEAN_U_DEG,
) -> tuple[xr.DataArray, xr.DataArray]:
    r"""Return the reflectance of the sky in a level coat, and its standard uncertainty [1].

    Both on the dims of the split, lazy where it is lazy.

    Parameters
    ----------
    split
        From `split_of`.
    view_zenith, relative_azimuth
        Angle of the camera from the vertical, and between the azimuths of sun and camera, 0 where the sun is
        behind the camera [degree]. NaN where unknown: then the zenith is mirrored, and the uncertainty is
        that of this direction.
    strength
        Reflectance of the coat at normal incidence, :math:`F_0` [1].
    index_u
        Standard uncertainty of the index of the coat [1].
    lean_u
        Standard deviation of the lean of the body part in each direction [degree].

    Notes
    -----
    .. math:: \rho_m = F(\theta_v) \, f_{dif} \, L(\theta_v, \varphi + 180°) / \bar L

    The uncertainty combines the index; the diffuse fraction with the aerosol that follows it; the weight of
    clouds; the lean, which turns the mirrored direction by twice its angle; and the radiance of the sky in a
    single direction.
    """
    # mirrored direction, and by how much it may be turned
    turn, zenith = 2.0 * lean_u, view_zenith if np.isfinite(view_zenith) else 0.0
    if not np.isfinite(view_zenith + relative_azimuth):
        turn = float(
            np.hypot(turn, zenith / np.sqrt(2.0) if np.isfinite(view_zenith) else SKY.unknown_view_deg)
        )
    is_known = np.isfinite(view_zenith + relative_azimuth) and zenith > 0.0
    theta, phi, angle = np.radians(
        [zenith if is_known else 0.0, 180.0 - relative_azimuth if is_known else 0.0, turn]
    )
    mirrored = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    outwards = np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])
    sideways = np.array([-np.sin(phi), np.cos(phi), 0.0])
    turned = [
        np.cos(angle) * mirrored + sign * np.sin(angle) * across
        for across in (outwards, sideways)
        for sign in (1.0, -1.0)
    ]
    east, north, up = np.array([mirrored, *turned]).T
    directions = (
        xr.DataArray(np.degrees(angles), dims="turn")
        for angles in (np.arccos(np.clip(up, 0.02, 1.0)), np.arctan2(north, east))
    )
    # the split as it is, with more and with less light of the sky, and with more clouds
    signs = xr.DataArray([0.0, 1.0, -1.0, 0.0], dims="change")
    clouds = xr.DataArray([0.0, 0.0, 0.0, 1.0], dims="change")
    fraction = (split.fraction + signs * split.u).clip(0.0, 1.0)
    spread = (split.cloud * (1.0 - split.cloud)) ** 0.5
    changed = replace(split, fraction=fraction, cloud=split.cloud + clouds * 0.5 * spread)
    coat = strength * float(interface_reflectance(zenith) / interface_reflectance(0.0))
    values = coat * fraction * relative_sky(changed, *directions)
    value, *differences = (
        values.isel(change=change, turn=turn)
        for change, turn in ((0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (0, 3), (0, 4))
    )
    pairs = zip(differences[::2], differences[1::2], strict=True)
    cloud_part = values.isel(change=3, turn=0) - value
    known_u = (4.0 * index_u / (COAT_INDEX**2 - 1.0)) ** 2 + SKY.sky_u[split.sky == "uniform"] ** 2
    variance = known_u * value**2 + cloud_part**2 + sum((0.5 * (more - less)) ** 2 for more, less in pairs)
    return value, variance**0.5


def _with_correction(
    line: xr.Dataset, variables: dict[str, xr.DataArray], name: str, text: str
) -> xr.Dataset:
    # The line with corrected variables and the attributes of the correction
    corrected = {
        key: array.astype(np.float32).transpose(*line[key].dims).assign_attrs(line[key].attrs)
        for key, array in variables.items()
    }
    quantity = {"mirrored_sky_removed": THROUGH_COAT, "coat_corrected": BODY}.get(name)
    attrs = {"mirror_reflection": EXCLUDED, "quantity": quantity, "specular_component": EXCLUDED}
    corrected["reflectance"].attrs |= {name: text, **(attrs if quantity else {})}
    result = line.assign(corrected)
    if SIGNATURE in line["reflectance"].dims:
        earlier = line.attrs.get("corrections", "none")
        entries = [*([] if earlier == "none" else [earlier]), f"{name}: {text}"]
        result = result.assign_attrs(corrections="; ".join(entries))
    return result


# --- clear coat ------------------------------------------------------------------------------------------


@takes_quantities(sun_zenith="degree", view_zenith="degree", lean_u="degree")
def correct_coat(
    line: xr.Dataset,
    *,
    index: float = COAT_INDEX,
    index_u: float = COAT_INDEX_U,
    lean_u: float = LEAN_U_DEG,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    view_zenith: float | None = None,
    sky: str | None = None,
) -> xr.Dataset:
    r"""Divide by the transmission of a clear coat relative to its transmission near the normal.

    Lazy. For paint whose mirrored sky was removed (`remove_mirrored_sky`): a body under a coat receives less
    light the lower the sun stands, 5 % less at 60 degrees, 8 % at 65. Assumes a level body part, unless
    `correct_light` was applied; then ``sun_zenith`` is the angle of the sun to its normal.

    Parameters
    ----------
    line
        Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; or a paint library,
        with ``sun_zenith``, ``view_zenith`` and ``diffuse_fraction`` of each paint.
    index, index_u
        Refractive index of the coat, and its standard uncertainty [1].
    lean_u
        Standard uncertainty of the angle between sun and body part [degree].
    diffuse, sun_zenith, sky
        As for `remove_mirrored_sky`.
    view_zenith
        Angle between the body part's normal and the camera [degree]; by default that of a library's paints, 0
        for a line: up to 40 degrees its effect is 0.6 %.

    Returns
    -------
    Dataset
        The same with ``reflectance``, its spread, quantiles, members and uncertainties divided, the
        uncertainty of the coat included in ``reflectance_u_systematic`` where present, and
        ``coat_transmission`` C and ``coat_transmission_u`` [1]; for a library also ``reflectance_u_coat``
        [1], the uncertainty from C and the subtracted mirrored sky, common to all pixels of a paint.
        Attributes of reflectance: ``coat_corrected``; ``quantity``, which is then the body under the coat;
        ``specular_component`` "excluded".

    Raises
    ------
    SchemaError
        ``reflectance`` or ``wavelength`` is missing, numbers are out of range, the mirrored sky is included,
        the coat was corrected before, or the split or the sun is unknown; all are listed.

    Warns
    -----
    PaintWarning
        The state of the sky is unknown, and a clear one is assumed.

    Notes
    -----
    .. math:: \rho = \rho_{seen} / C, \qquad C = \frac{f_{dir} (1 - F(\theta_s)) + f_{dif} (1 - F_{sky})}
              {1 - F(0)} \cdot \frac{1 - F(\theta_v)}{1 - F(0)}

    with Fresnel's reflectance F, see `hyperpaint.light.coat_transmission`. The uncertainty of C combines
    those of the index, the lean, and the diffuse fraction.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> seen = xr.DataArray(np.float32([0.475, 0.475]), dims="band", attrs={"units": "1"})
    >>> paint = xr.Dataset({"reflectance": seen}, {"wavelength": ("band", [450.0, 850.0], {"units": "nm"})})
    >>> paint.reflectance.attrs["mirror_reflection"] = "excluded"
    >>> correct_coat(paint, sun_zenith=60.0, diffuse="model").reflectance.values.round(3)
    array([0.508, 0.504], dtype=float32)
    """
    numbers = {"index": (index, 1.0, 3.0), "index_u": (index_u, 0.0, 1.0), "lean_u": (lean_u, 0.0, 45.0)}
    line = _checked(line, ("coat_corrected",), numbers, of_body=True)
    coat, is_library = (float(index), float(index_u), lean_u), SIGNATURE in line["reflectance"].dims
    if is_library:
        # a sky that was removed from the flight line
        is_removed = "mirrored_sky_removed" in line["reflectance"].attrs
        needs_u, rows, removed_u = is_removed and "reflectance_u_coat" not in line.variables, [], []
        for paint, split in _paints(line, diffuse, sun_zenith, sky):
            incidence = split.zenith if np.isfinite(split.zenith) else sun_zenith_of(paint, sun_zenith)
            view, azimuth = _view_of(paint)
            view = view if view_zenith is None else view_zenith
            angle = min(float(view), 85.0) if np.isfinite(view) else 0.0
            rows.append(_shares(split, incidence, angle, *coat))
            if needs_u:
                removed_u.append(
                    mirrored_sky(split, view, azimuth, index_u=index_u, lean_u=_known(paint["lean"], lean_u))[
                        1
                    ]
                )
        shares: Any = [_by_paint(column) for column in zip(*rows, strict=True)]
        if needs_u:
            line = line.assign(reflectance_u_coat=_by_paint(removed_u).astype(np.float32))
    else:
        split = split_of(line, diffuse, sun_zenith, sky)
        zenith = split.zenith if np.isfinite(split.zenith) else sun_zenith_of(line, sun_zenith)
        shares = _shares(split, zenith, 0.0 if view_zenith is None else view_zenith, *coat)
    share, share_u = (array.astype(np.float32) for array in shares)
    corrected = {name: line[name] / share for name in (*LEVELS, *WIDTHS) if name in line.variables}
    coat_u = corrected["reflectance"] * share_u / share
    if (name := "reflectance_u_systematic") in corrected:
        corrected[name] = (corrected[name] ** 2 + coat_u**2) ** 0.5
    text = f"clear coat of index {index:g} +- {index_u:g}, panel level +- {lean_u:g} degree"
    layers, table = {"coat_transmission": share, "coat_transmission_u": share_u}, schema.VARIABLES
    if is_library:
        layers["reflectance_u_coat"] = (corrected.pop("reflectance_u_coat", 0.0) ** 2 + coat_u**2) ** 0.5
        table = schema.LIBRARY_VARIABLES
        layers = {name: layer.transpose(SIGNATURE, BAND) for name, layer in layers.items()}
    result = _with_correction(line, corrected, "coat_corrected", text)
    return result.assign({name: layer.assign_attrs(table[name].attrs) for name, layer in layers.items()})


def _shares(
    split: LightSplit, incidence: float, view: float, index: float, index_u: float, lean_u: float
) -> tuple[xr.DataArray, xr.DataArray]:
    # Relative transmission C and its standard uncertainty, on the dims of the split. `index`, `index_u`: of
    # the coat; `lean_u`: uncertainty of the lean [degree].

    def share(fraction: Any, n: float, angle: float) -> Any:
        # reflectance of the coat for the light of a uniform sky, or between a clear and an overcast sky
        sun = None if split.sky == "uniform" else min(incidence, 89.0)
        sky: Any = xr.DataArray(sky_reflectance(split.wavelength, sun, 0.0, n), dims=BAND)
        if sun is not None:
            overcast = xr.DataArray(sky_reflectance(split.wavelength, sun, 1.0, n), dims=BAND)
            sky = (1.0 - split.cloud) * sky + split.cloud * overcast
        return transmitted_share(fraction, sky, float(np.clip(angle, 0.0, 89.9)), view, n)

    # uncertainties by finite differences in index, lean and diffuse fraction
    relative = share(split.fraction, index, incidence)
    by_index = 0.5 * (
        share(split.fraction, index + index_u, incidence)
        - share(split.fraction, max(1.0, index - index_u), incidence)
    )
    leans = [abs(share(split.fraction, index, incidence + turn) - relative) for turn in (-lean_u, lean_u)]
    by_sky = split.u * abs(share(1.0, index, incidence) - share(0.0, index, incidence))
    relative_u = np.sqrt(by_index**2 + (0.5 * (leans[0] + leans[1])) ** 2 + by_sky**2)
    return relative, relative_u


def _paints(
    library: xr.Dataset, diffuse: Any, sun_zenith: float | None, sky: str | None
) -> Iterator[tuple[xr.Dataset, LightSplit]]:
    # Yield geometry and split of every paint under its sun; other arguments as for `split_of`. Angles that
    # the library lacks are NaN.
    angles = {"sun_zenith", "view_zenith", "relative_azimuth", "lean"}
    names = {"wavelength", *SPLIT, *angles} & set(library.variables)
    variables = library[sorted(names)].reset_coords().compute()
    variables = variables.assign(dict.fromkeys(angles - names, np.nan))
    for number in range(library.sizes[SIGNATURE]):
        paint = variables.isel({SIGNATURE: number})
        zenith = paint["sun_zenith"].item() if sun_zenith is None else sun_zenith
        if "diffuse_fraction" in paint and not np.isfinite(paint["diffuse_fraction"]).any():
            paint = paint.drop_vars("diffuse_fraction")
        yield paint, split_of(paint, diffuse, zenith if np.isfinite(zenith) else None, sky)


def _view_of(paint: xr.Dataset) -> tuple[float, float]:
    # Zenith angle of the camera, and its azimuth relative to the sun [degree]; NaN where unknown
    return float(paint["view_zenith"]), float(paint["relative_azimuth"])


def _known(angle: xr.DataArray, default: float) -> float:
    return float(angle) if np.isfinite(angle) else default


def _by_paint(arrays: Iterable[xr.DataArray]) -> xr.DataArray:
    return xr.concat([array.reset_coords(drop=True) for array in arrays], SIGNATURE).transpose(
        SIGNATURE, BAND
    )
