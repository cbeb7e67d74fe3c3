"""Correct the record of a light sensor on the aircraft to a level receiver.

Direct light follows the cosine of the sun's angle from the sensor's normal, diffuse light follows the part of
the sky in view. The record itself gives the diffuse fraction; since the tilt changes the record's level, the
fraction is derived a second time from the corrected record.
"""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from hyperpaint.base import (
    ANGLES,
    IRRADIANCE_TIME,
    Array,
    Convention,
    Floats,
    Problems,
    SchemaError,
    convert,
    label,
    require,
    takes_quantities,
    warn_if,
)

from .clear_sky import sunward_gain
from .diffuse_record import SKY_STATES, split_of_arrays
from .illumination import channels_of, check_irradiance_times
from .sun import diffuse_fraction, solar_position

_POSITION = ("latitude", "longitude")
_TIME_NAMES = ("time", "navigation_time", IRRADIANCE_TIME)
#: Wavelengths of the split into direct and diffuse light [nm], which is smooth between them.
_NODES_NM = np.array([350.0, 400, 450, 500, 550, 600, 700, 800, 900, 1000, 1300, 1700, 2500])
_CLEAR, _HAZY, _OVERCAST, _CONTRADICTORY = (
    SKY_STATES.index(word) for word in ("clear", "hazy", "overcast", "contradictory")
)
LEVELLING = SimpleNamespace(
    #: Zenith angle of the sun above which nothing is corrected: there, a degree of attitude changes direct
    #: light by a tenth.
    max_zenith_deg=80.0,
    #: Tilt above which a sample is left out [degree]: survey aircraft do not bank so far.
    max_tilt_deg=30.0,
    #: Longest interval over which attitude is interpolated [s]; it is held constant for a quarter of that
    #: time.
    max_gap_s=1.0,
    #: Duration for which one split is used [s]: air and sun change little.
    same_sky_s=600.0,
    #: Width of the intervals in which the dependence on attitude is fitted to the record [nm].
    fit_interval_nm=50.0,
    #: Prior standard deviation of the fitted dependence [1].
    fit_prior_sd=0.03,
    #: Fewest steps from sample to sample for the fit.
    min_fit_steps=8,
    #: Most samples whose sky is determined, evenly spaced.
    max_sky_samples=200,
)


class _Sensor(NamedTuple):
    normal: Floats  # (sample, 3) to the east, the north and up; NaN where unknown
    zenith: Floats  # (sample,) of the sun [degree]
    azimuth: Floats
    place: tuple[float, float]  # Latitude and longitude [degree]
    response: tuple[Floats, Floats]  # Incidence [degree], and response relative to the cosine law [1]
    ground: float  # Reflectance of the ground [1]

    @property
    def tilt(self) -> Floats:
        # Angle of the normal from the zenith (sample,) [degree]
        return np.asarray(np.degrees(np.arccos(np.clip(self.normal[:, 2], -1.0, 1.0))))

    def sky_response(self) -> float:
        # Sensor's mean response to an isotropic sky, relative to the cosine law [1]
        incidence = np.linspace(0.0, 90.0, 181)
        weight = np.sin(np.radians(2.0 * incidence))
        return float((np.interp(incidence, *self.response) * weight).sum() / weight.sum())

    @property
    def lean(self) -> Floats:
        # Part of the normal towards the sun, times the tangent of the sun's zenith angle (sample,) [1]
        azimuth = np.radians(self.azimuth)
        sunward = self.normal[:, 0] * np.sin(azimuth) + self.normal[:, 1] * np.cos(azimuth)
        return np.asarray(sunward * np.tan(np.radians(self.zenith)))

    def factor(self, diffuse: Floats, by_lean: Floats) -> Floats:
        # Return the reading relative to a level sensor that follows the cosine law (sample, channel) [1].
        #
        # ``diffuse`` (sample, channel): Diffuse fraction of the level irradiance [1]. ``by_lean`` (sample,
        # channel): Gain of diffuse light per unit of `lean`, relative to the level irradiance [1].
        sun_cosine = np.cos(np.radians(self.zenith))
        beam = np.clip(self.normal[:, 2] + self.lean, 0.0, 1.0 / sun_cosine)
        beam *= np.interp(np.degrees(np.arccos(np.clip(beam * sun_cosine, 0.0, 1.0))), *self.response)
        view = 0.5 * (1.0 + self.normal[:, 2])[:, None]
        sky = diffuse * view + by_lean * self.lean[:, None] + (1.0 - view) * self.ground
        return np.asarray((1.0 - diffuse) * beam[:, None] + self.sky_response() * sky)


#: Start of the attribute ``irradiance_mount`` of a levelled record.
_LEVELLED = "aircraft, corrected to level"


@takes_quantities(ground_reflectance="1")
def level_irradiance(
    irradiance: xr.Dataset,
    attitude: xr.Dataset,
    *,
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0),
    cosine_response: xr.DataArray | None = None,
    ground_reflectance: float = 0.2,
) -> xr.Dataset:
    r"""Return the record of a light sensor on the aircraft, corrected to a level sensor.

    Eager.

    Parameters
    ----------
    irradiance
        As of `hyperpaint.open_irradiance`: ``irradiance`` (irradiance_time, irradiance_wavelength), in any
        unit of irradiance, as the sensor measured it.
    attitude
        A flight line, or navigation as of `hyperpaint.open_navigation`: ``roll``, ``pitch``, ``heading``,
        ``latitude`` and ``longitude`` over time. Its attributes ``convention_...`` give the signs and order
        of the angles; by default they are canonical, see `hyperpaint.Convention`.
    mounting
        Roll, pitch and heading of the sensor in the aircraft [degree].
    cosine_response
        Response of the sensor relative to the cosine law (incidence) [1], with a coordinate ``incidence``
        [degree] from its normal; 1 by default.
    ground_reflectance
        Reflectance of the ground, which fills the rest of the sensor's view [1].

    Returns
    -------
    Dataset
        The record with ``irradiance`` of a level sensor, and ``irradiance_tilt`` (irradiance_time) [degree].
        NaN where the attitude is not known, or beyond 30 degrees. The attribute ``irradiance_mount`` names
        the correction and the sky.

    Raises
    ------
    SchemaError, TimeError, UnitsError
        Variables are missing, or have other dims or units; no sample has an attitude; the cosine response is
        out of range; the record has no channel that the split into direct and diffuse light needs.

    Warns
    -----
    PaintWarning
        The record fits no sky, and is corrected as under a clear one; the sun is lower than 10 degrees, where
        nothing is corrected; or samples have no attitude.

    Notes
    -----
    .. math:: E = E_m \Big/ \left[ (1 - f) \frac{\cos i}{\cos \theta} r(i)
              + \bar r \left( f (V + s b) + (1 - V) \rho_n \right) \right]

    with :math:`f` the diffuse fraction (`hyperpaint.light.diffuse_from_record`), :math:`i` and
    :math:`\theta` the angles of the sun from the sensor's normal and from the zenith, :math:`V` the part of
    the sky in view, :math:`b` the lean towards the sun times :math:`\tan \theta`, :math:`s` the relative gain
    of a clear sky on that side (`hyperpaint.light.clear_sky.sunward_gain`), :math:`\rho_n` the ground's
    reflectance, and :math:`r`, :math:`\bar r` the response to the beam and to the sky. Under an overcast sky
    light comes from above whatever the attitude: only :math:`\bar r` is corrected.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.light.clear_sky import ClearSky
    >>> nm, noon = np.arange(400.0, 1001.0), np.array(["2024-06-21T12:00", "2024-06-21T12:01"], "M8[ns]")
    >>> zenith = solar_position(noon, 50.0, 0.0)[0][0]
    >>> direct, diffuse = (0.967 * part for part in ClearSky(zenith).irradiance(nm))
    >>> leaning = np.cos(np.radians(zenith + 5.0)) / np.cos(np.radians(zenith))
    >>> light = xr.DataArray(
    ...     [direct + diffuse, leaning * direct + diffuse],
    ...     {"irradiance_time": noon, "irradiance_wavelength": nm}, attrs={"units": "W m-2 nm-1"})
    >>> pose = xr.Dataset(
    ...     {"roll": ("time", [0.0, 0.0]), "pitch": ("time", [0.0, -5.0]), "heading": ("time", [0.0, 0.0])},
    ...     {"time": noon, "latitude": ("time", [50.0, 50.0]), "longitude": ("time", [0.0, 0.0])})
    >>> level = level_irradiance(light.to_dataset(name="irradiance"), pose)
    >>> print((leaning - 1.0).round(3), float(level.irradiance_tilt[1].round(1)))
    -0.047 5.0
    >>> bool(abs(level.irradiance[1] / level.irradiance[0] - 1.0).max() < 0.01)
    True
    """
    SchemaError.raise_if(
        str(irradiance.attrs.get("irradiance_mount", "")).startswith(_LEVELLED),
        "this record is already corrected to level (attribute irradiance_mount)",
        mend="open the original record",
        code="record-already-levelled",
    )
    variables = require(irradiance, ["irradiance", IRRADIANCE_TIME], "the irradiance of level ground")
    record = variables["irradiance"]
    stamps = variables[IRRADIANCE_TIME].values.astype("datetime64[ns]")
    check_irradiance_times(stamps)
    channels = channels_of(record)
    with Problems("the light sensor cannot be levelled", SchemaError) as problems:
        missing = [name for name in (*ANGLES, *_POSITION) if name not in attitude.variables]
        time_name = next((name for name in _TIME_NAMES if name in attitude.variables), None)
        problems.add_if(
            missing or time_name is None,
            f"the attitude has no {', '.join([*missing, *([] if time_name else ['time'])])}",
            code="variable-missing",
        )
        problems.add_if(
            np.shape(mounting) != (3,) or not np.isfinite(mounting).all(),
            f"mounting={mounting!r}",
            expected="roll, pitch and heading [degree]",
            code="angles-unreadable",
        )
        problems.add_if(
            not 0.0 <= ground_reflectance <= 1.0,
            f"ground_reflectance={ground_reflectance!r}",
            expected="0 to 1",
            code="value-out-of-range",
        )
        # incidence [degree] and response relative to the cosine law [1]
        response = np.array([0.0, 90.0]), np.ones(2)
        if cosine_response is not None and "incidence" not in getattr(cosine_response, "coords", ()):
            problems.add("cosine_response has no coordinate 'incidence' [degree]", code="coordinate-missing")
        elif cosine_response is not None:
            incidence, values = response = (
                np.asarray(cosine_response["incidence"].values, np.float64),
                np.asarray(cosine_response.values, np.float64),
            )
            problems.add_if(
                values.ndim != 1
                or (np.diff(incidence) <= 0).any()
                or not ((values > 0.0) & (values < 2.0)).all(),
                "cosine_response is out of range, or its incidences do not increase",
                expected="0 to 2, relative to the cosine law",
                code="cosine-response-invalid",
            )
    # angles in the canonical convention
    convention = Convention.from_attrs(attitude.attrs) or Convention()
    angles = [attitude[name] for name in ANGLES]
    if all("units" in angle.attrs for angle in angles):
        angles = [convert(angle, "degree") for angle in angles]
        convention = convention.replace(angle_unit="degree")
    roll, pitch, heading = convention.canonical(*(np.asarray(angle.values, np.float64) for angle in angles))
    time = attitude[time_name].values.astype("datetime64[ns]")
    has_pose = ~np.isnat(time) & np.isfinite(roll)
    normal = np.full((stamps.size, 3), np.nan)
    places = [np.asarray(attitude[name].values, np.float64) for name in _POSITION]
    is_located = np.isfinite(places[0]) & np.isfinite(places[1])
    if has_pose.any() and is_located.any():
        order = np.flatnonzero(has_pose)[np.argsort(time[has_pose], kind="stable")]
        angles_by_time = np.stack([heading, pitch, roll], axis=-1)[order]
        # normals of the sensor: in the frame of the aircraft, then in north, east, down
        axis = Rotation.from_euler("ZYX", mounting[::-1], degrees=True).apply([0.0, 0.0, -1.0])
        body = Rotation.from_euler("ZYX", angles_by_time, degrees=True).apply(axis)
        # interpolate the normals to the samples, except over gaps of the attitude
        seconds = (stamps - time[order[0]]) / np.timedelta64(1, "s")
        pose_seconds = (time[order] - time[order[0]]) / np.timedelta64(1, "s")
        upper = np.clip(np.searchsorted(pose_seconds, seconds), 1, max(pose_seconds.size - 1, 1))
        low, high = pose_seconds[upper - 1], pose_seconds[np.minimum(upper, pose_seconds.size - 1)]
        distance = np.minimum(np.abs(seconds - low), np.abs(seconds - high))
        is_known = ((seconds >= low) & (seconds <= high) & (high - low <= LEVELLING.max_gap_s)) | (
            distance <= LEVELLING.max_gap_s / 4.0
        )
        normal = np.stack([np.interp(seconds, pose_seconds, body[:, axis]) for axis in (1, 0, 2)], axis=-1)
        normal *= np.array([1.0, 1.0, -1.0]) / np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = np.where(is_known[:, None], normal, np.nan)
    # rounded to a kilometre, so that a crop of the line gets the same sky
    latitude, longitude = (round(float(p[is_located].mean()), 2) if is_located.any() else 0.0 for p in places)
    zenith, azimuth = solar_position(stamps, latitude, longitude)
    sensor = _Sensor(normal, zenith, azimuth, (latitude, longitude), response, ground_reflectance)
    usable = np.nan_to_num(sensor.tilt, nan=np.inf) <= LEVELLING.max_tilt_deg
    SchemaError.raise_if(
        not usable.any(),
        "no sample of the light sensor has an attitude",
        mend="pass navigation that covers the record",
        code="attitude-missing",
    )
    warn_if(
        not usable.all(),
        f"{(~usable).sum()} of {usable.size} samples of the light sensor have no attitude and become NaN",
        "attitude-missing",
    )
    is_low = sensor.zenith > LEVELLING.max_zenith_deg
    warn_if(
        is_low[usable].any(),
        "the light sensor's attitude is not corrected with the sun beyond "
        f"{LEVELLING.max_zenith_deg:g} degrees",
        "sun-low",
    )
    spectra = np.where(usable[:, None], record.values.astype(np.float64), np.nan)
    factor = np.ones(spectra.shape)
    correctable = np.flatnonzero(usable & ~is_low & np.isfinite(spectra).any(axis=1))
    sky = "the sun too low"
    if correctable.size:
        factor, sky = _factor(spectra, stamps, channels, sensor, correctable)
        factor[is_low] = 1.0
    level = record.copy(data=(spectra / factor).astype(np.float32))
    tilt = xr.DataArray(sensor.tilt.astype(np.float32), dims=(IRRADIANCE_TIME,))
    levelled = irradiance.assign(
        irradiance=label(level, "irradiance"), irradiance_tilt=label(tilt, "irradiance_tilt")
    )
    return levelled.assign_attrs(irradiance_mount=f"{_LEVELLED}: {sky}")


def _factor(
    spectra: Floats, stamps: Array, channels: Floats, sensor: _Sensor, usable: Array
) -> tuple[Floats, str]:
    # Return the factor of all samples (sample, channel), from the `usable` samples, and the name of the sky.
    sky_samples = usable[:: max(1, -(-usable.size // LEVELLING.max_sky_samples))]
    _, state = _split(spectra[sky_samples], stamps[sky_samples], channels, sensor.place)
    if np.mean(state == _OVERCAST) > 0.5:
        return np.full(spectra.shape, sensor.sky_response()), "overcast, its attitude without effect"
    clear = np.stack([diffuse_fraction(channels, min(float(zenith), 89.0)) for zenith in sensor.zenith])
    # gain of clear-sky diffuse light per unit of lean, one for sun zenith angles within half a degree
    suns, sun_of_sample = np.unique(np.round(2.0 * sensor.zenith) / 2.0, return_inverse=True)
    gain = np.stack([sunward_gain(channels, min(float(zenith), 89.0)) for zenith in suns])[sun_of_sample]
    factor = sensor.factor(clear, clear * gain)
    # periods of LEVELLING.same_sky_s, each with one split
    seconds = (stamps - stamps[0]) / np.timedelta64(1, "s")
    periods = max(1, round(float(np.ptp(seconds)) / LEVELLING.same_sky_s))
    period = np.minimum((seconds / (np.ptp(seconds) + 1.0) * periods).astype(np.int64), periods - 1)
    # the first pass corrects under a modelled clear sky, the second under the sky that the first one finds
    for _ in range(2):
        fraction, state = _split((spectra / factor)[sky_samples], stamps[sky_samples], channels, sensor.place)
        is_explained = (state != _CONTRADICTORY) & np.isfinite(fraction).all(axis=1)
        diffuse, by_lean = clear.copy(), clear * gain
        for number in range(periods):
            inside, is_fitted = period == number, is_explained & (period[sky_samples] == number)
            if is_fitted.any():
                diffuse[inside] = np.median(fraction[is_fitted], axis=0)
                is_bright = np.isin(state[is_fitted], (_CLEAR, _HAZY)).mean() > 0.5
                by_lean[inside] = diffuse[inside] * gain[inside] if is_bright else 0.0
            # add the dependence on lean that remains in the corrected record
            rows = usable[period[usable] == number]
            factors = sensor.factor(diffuse, by_lean)[rows]
            linear, quadratic = _residual_by_lean(
                spectra[rows], factors, sensor.lean[rows], seconds[rows], channels
            )
            by_lean[inside] += linear + quadratic * sensor.lean[inside][:, None]
        factor = sensor.factor(diffuse, by_lean)
    warn_if(
        (state == _CONTRADICTORY).mean() > 0.5,
        "the light sensor's record fits no sky; its attitude is corrected as under a clear one",
        "sky-unknown",
    )
    return factor, SKY_STATES[int(np.bincount(state, minlength=len(SKY_STATES)).argmax())]


def _residual_by_lean(
    spectra: Floats, factor: Floats, lean: Floats, seconds: Floats, channels: Floats
) -> tuple[Floats, Floats]:
    # Return the change of `factor` per unit of lean, and per unit of lean squared, both (channel,).
    # It is a robust fit of changes from sample to sample, during which the light changes little: logarithm
    # of spectra over factors against lean, with a prior of zero. Intervals of wavelength without light get
    # zero.
    change = np.diff(seconds)
    is_near = change <= 5.0 * np.median(change) if change.size else np.zeros(0, bool)
    powers = np.stack([lean, lean**2], axis=1)
    nodes = np.arange(channels.min(), channels.max() + LEVELLING.fit_interval_nm, LEVELLING.fit_interval_nm)
    slopes = np.zeros((nodes.size, 2))
    for row, node in enumerate(nodes):
        inside = np.abs(channels - node) <= LEVELLING.fit_interval_nm / 2.0
        light = np.nan_to_num(spectra[:, inside]).sum(axis=1)
        if is_near.sum() < LEVELLING.min_fit_steps or not inside.any() or not (light > 0.0).all():
            continue
        mean_factor = factor[:, inside].mean(axis=1)
        rise, steps = np.diff(np.log(light / mean_factor)), np.diff(powers / mean_factor[:, None], axis=0)
        fit = slopes[row]
        for _ in range(10):
            residual = rise - steps @ fit
            spread = max(1.4826 * float(np.median(np.abs(residual[is_near]))), 1e-5)
            # steps changed by clouds are outliers
            is_inlier = is_near & (np.abs(residual) <= 3.0 * spread)
            x, y = steps[is_inlier] / spread, rise[is_inlier] / spread
            fit = np.linalg.solve(x.T @ x + np.eye(2) / LEVELLING.fit_prior_sd**2, x.T @ y)
        slopes[row] = fit
    linear, quadratic = (np.interp(channels, nodes, column) for column in slopes.T)
    return linear, quadratic


def _split(
    spectra: Floats, stamps: Array, channels: Floats, place: tuple[float, float]
) -> tuple[Floats, Array]:
    # Return the diffuse fraction (sample, channel) and the number of the sky state (sample,).
    rows, state = split_of_arrays(spectra, stamps, channels, place, _NODES_NM)
    return np.stack([np.interp(channels, _NODES_NM, row) for row in rows]), state
