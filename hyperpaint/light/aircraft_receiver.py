"""From a light sensor that leans with the aircraft to the irradiance of level ground.

The direct part goes with the cosine of the sun's angle to the sensor's normal, the diffuse part with what of
the sky it sees, and which of the two is how large the record itself has to say: leaning changes its level,
and so it is asked again after a first correction.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.schema import IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH
from hyperpaint.base.units import convert, takes_quantities

from .diffuse_record import SKY_STATES, diffuse_from_record
from .sky_functions import sunward_gain
from .sun import diffuse_fraction, solar_position
from .synchrony import check_irradiance_times

if TYPE_CHECKING:
    import xarray as xr

_ANGLES = ("roll", "pitch", "heading")
_PLACE = ("latitude", "longitude")
_TIMES = ("time", "navigation_time", IRRADIANCE_TIME)
_NODES_NM = np.array([350.0, 400, 450, 500, 550, 600, 700, 800, 900, 1000, 1300, 1700, 2500])
"""Where the split is asked for; it is smooth between."""
_CLEAR, _HAZY, _OVERCAST, _CONTRADICTORY = (
    SKY_STATES.index(word) for word in ("clear", "hazy", "overcast", "contradictory")
)
MAX_ZENITH_DEG = 80.0
"""Sun beyond which nothing is corrected [degree]: a degree of attitude changes direct light by a tenth."""
MAX_TILT_DEG = 30.0
"""Attitude beyond which a sample is left out [degree]: aircraft that survey do not lean so far."""
MAX_GAP_S = 1.0
"""Interval of the attitude that is interpolated at the most [s]; a quarter of it is how long one holds."""
SAME_SKY_S = 600.0
"""How long one split holds [s]: air and sun change little."""
LEARNT_NM = 50.0
"""Width of the intervals in which the record itself tells how it goes with the attitude [nm]."""
LEARNT_SD = 0.03
"""How far the share of light that goes with the attitude may be off without that [1]."""
LEARNT_FROM = 8
"""Steps from sample to sample from which on it does [1]."""
ASKED = 200
"""Samples that are asked for their sky at the most, at even distances; between them it is interpolated."""


class _Sensor(NamedTuple):
    """How the sensor stood at every sample, and what it makes of light."""

    normal: Floats  # (sample, 3) to the east, the north and up; NaN where unknown
    zenith: Floats  # (sample,) of the sun [degree]
    azimuth: Floats
    place: tuple[float, float]  # Latitude and longitude [degree]
    response: tuple[Floats, Floats]  # Incidence [degree], and over the cosine law [1]
    ground: float  # Reflectance [1]

    @property
    def tilt(self) -> Floats:
        """Angle of the normal from the zenith (sample,) [degree]."""
        return np.asarray(np.degrees(np.arccos(np.clip(self.normal[:, 2], -1.0, 1.0))))

    def of_sky(self) -> float:
        """Return the response to even light from all sides [1]."""
        incidence = np.linspace(0.0, 90.0, 181)
        weight = np.sin(np.radians(2.0 * incidence))
        return float((np.interp(incidence, *self.response) * weight).sum() / weight.sum())

    @property
    def lean(self) -> Floats:
        """How far it leans to the sun, times the tangent of the sun's zenith angle (sample,) [1]."""
        turn = np.radians(self.azimuth)
        sunward = self.normal[:, 0] * np.sin(turn) + self.normal[:, 1] * np.cos(turn)
        return np.asarray(sunward * np.tan(np.radians(self.zenith)))

    def bright_side(self, channels: Floats) -> Floats:
        """Return by how much a clear sky lights it more for a unit of `lean` (sample, channel) [1]."""
        # the sun goes slowly: one gain for those within half a degree
        rounded, which = np.unique(np.round(2.0 * self.zenith) / 2.0, return_inverse=True)
        return np.stack([sunward_gain(channels, min(float(zenith), 89.0)) for zenith in rounded])[which]

    def factor(self, diffuse: Floats, by_lean: Floats) -> Floats:
        """Return what it reads over a level sensor of the cosine law (sample, channel) [1].

        Of the ``diffuse`` fraction, and the diffuse light that it gains for a unit of `lean` over all level
        light (sample, channel).
        """
        height = np.cos(np.radians(self.zenith))
        beam = np.clip(self.normal[:, 2] + self.lean, 0.0, 1.0 / height)
        beam *= np.interp(np.degrees(np.arccos(np.clip(beam * height, 0.0, 1.0))), *self.response)
        view = 0.5 * (1.0 + self.normal[:, 2])[:, None]
        sky = diffuse * view + by_lean * self.lean[:, None] + (1.0 - view) * self.ground
        return np.asarray((1.0 - diffuse) * beam[:, None] + self.of_sky() * sky)


_LEVELLED = "aircraft, corrected to level"
"""What the attribute ``irradiance_mount`` of a levelled record begins with."""


@takes_quantities(ground_reflectance="1")
def level_irradiance(
    irradiance: xr.Dataset,
    attitude: xr.Dataset,
    *,
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0),
    cosine_response: xr.DataArray | None = None,
    ground_reflectance: float = 0.2,
) -> xr.Dataset:
    r"""Return the record of a light sensor on the aircraft as a level one would have made it.

    Eager.

    Parameters
    ----------
    irradiance
        As of `hyperpaint.open_irradiance`: ``irradiance`` (irradiance_time, irradiance_wavelength), in any
        unit of irradiance, as the sensor measured it.
    attitude
        A flight line, or navigation as of `hyperpaint.open_navigation`: ``roll``, ``pitch``, ``heading``,
        ``latitude`` and ``longitude`` over time. What angles mean, its attributes ``convention_...`` say; by
        default canonical, see `hyperpaint.Convention`.
    mounting
        Roll, pitch and heading of the sensor in the aircraft [degree].
    cosine_response
        What the sensor reads over the cosine law (incidence) [1], with a coordinate ``incidence`` [degree]
        from its normal; 1 by default.
    ground_reflectance
        Of what fills the rest of its view [1].

    Returns
    -------
    Dataset
        The same with ``irradiance`` of a level sensor, and ``irradiance_tilt`` (irradiance_time) [degree].
        NaN where the attitude is not known, or beyond 30 degrees. The attribute ``irradiance_mount`` says
        what was done.

    Raises
    ------
    SchemaError, TimeError, UnitsError
        Variables are missing, or have other dims or units; no sample has an attitude; the response is not
        one; the record has no channel from which the sky is told.

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
    the sky in view, :math:`b` the lean towards the sun times :math:`\tan \theta`, :math:`s` what a clear sky
    is brighter on that side (`hyperpaint.light.sky_functions.sunward_gain`), :math:`\rho_n` the ground, and
    :math:`r`, :math:`\bar r` the response to the beam and to the sky. Under an overcast sky light comes from
    above whatever the attitude: of it only :math:`\bar r` is taken out.

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
    import xarray as xr

    if str(irradiance.attrs.get("irradiance_mount", "")).startswith(_LEVELLED):
        raise SchemaError(
            "this record is corrected to level already (attribute irradiance_mount)",
            mend="open it anew",
            code="record-already-leveled",
        )
    variables = schema.require(irradiance, ["irradiance", IRRADIANCE_TIME], "the irradiance of level ground")
    record = variables["irradiance"]
    stamps = variables[IRRADIANCE_TIME].values.astype("datetime64[ns]")
    check_irradiance_times(stamps)
    if IRRADIANCE_WAVELENGTH not in record.coords:
        raise SchemaError(
            "'irradiance' has no coordinate 'irradiance_wavelength' [nm]", code="coordinate-missing"
        )
    own = record[IRRADIANCE_WAVELENGTH]
    channels = (convert(own, "nm") if "units" in own.attrs else own).values.astype(np.float64)
    sensor = _sensor(stamps, attitude, mounting, cosine_response, ground_reflectance)
    usable = np.nan_to_num(sensor.tilt, nan=np.inf) <= MAX_TILT_DEG
    if not usable.any():
        raise SchemaError(
            "no sample of the light sensor has an attitude",
            mend="does the navigation cover it?",
            code="attitude-missing",
        )
    if not usable.all():
        text = f"{(~usable).sum()} of {usable.size} samples of the light sensor have no attitude, and are NaN"
        warnings.warn(text, PaintWarning, stacklevel=2)
    is_low = sensor.zenith > MAX_ZENITH_DEG
    if is_low[usable].any():
        text = f"with the sun beyond {MAX_ZENITH_DEG:g} degrees the light sensor's attitude is not corrected"
        warnings.warn(text, PaintWarning, stacklevel=2)
    spectra = np.where(usable[:, None], record.values.astype(np.float64), np.nan)
    factor = np.ones(spectra.shape)
    some = np.flatnonzero(usable & ~is_low & np.isfinite(spectra).any(axis=1))
    words = "the sun too low"
    if some.size:
        factor, words = _factor(spectra, stamps, channels, sensor, some)
        factor[is_low] = 1.0
    level = record.copy(data=(spectra / factor).astype(np.float32))
    tilt = xr.DataArray(sensor.tilt.astype(np.float32), dims=(IRRADIANCE_TIME,))
    levelled = irradiance.assign(
        irradiance=schema.label(level, "irradiance"), irradiance_tilt=schema.label(tilt, "irradiance_tilt")
    )
    return levelled.assign_attrs(irradiance_mount=f"{_LEVELLED}: {words}")


def _factor(
    spectra: Floats, stamps: Array, channels: Floats, sensor: _Sensor, usable: Array
) -> tuple[Floats, str]:
    """Return the factor of all samples (sample, channel) by what ``usable`` ones tell, and the sky's name.

    Warns PaintWarning: The record fits no sky.
    """
    some = usable[:: max(1, -(-usable.size // ASKED))]
    _, state = _split(spectra[some], stamps[some], channels, sensor.place)
    if np.mean(state == _OVERCAST) > 0.5:
        return np.full(spectra.shape, sensor.of_sky()), "overcast, its attitude without effect"
    clear = np.stack([diffuse_fraction(channels, min(float(zenith), 89.0)) for zenith in sensor.zenith])
    gain = sensor.bright_side(channels)
    factor = sensor.factor(clear, clear * gain)
    seconds = (stamps - stamps[0]) / np.timedelta64(1, "s")
    number = max(1, round(float(np.ptp(seconds)) / SAME_SKY_S))
    part = np.minimum((seconds / (np.ptp(seconds) + 1.0) * number).astype(np.int64), number - 1)
    # the first of the record under a modelled sky, the second under the one that it showed
    for _ in range(2):
        fraction, state = _split((spectra / factor)[some], stamps[some], channels, sensor.place)
        fits = (state != _CONTRADICTORY) & np.isfinite(fraction).all(axis=1)
        diffuse, by_lean = clear.copy(), clear * gain
        for each in range(number):
            here, asked = part == each, fits & (part[some] == each)
            if asked.any():
                diffuse[here] = np.median(fraction[asked], axis=0)
                is_bright = np.isin(state[asked], (_CLEAR, _HAZY)).mean() > 0.5
                by_lean[here] = diffuse[here] * gain[here] if is_bright else 0.0
            rows = usable[part[usable] == each]
            assumed = sensor.factor(diffuse, by_lean)[rows]
            first, second = _left_by_lean(spectra[rows], assumed, sensor.lean[rows], seconds[rows], channels)
            by_lean[here] += first + second * sensor.lean[here][:, None]
        factor = sensor.factor(diffuse, by_lean)
    unknown = (state == _CONTRADICTORY).mean()
    if unknown > 0.5:
        text = "the light sensor's record fits no sky; its attitude is corrected as under a clear one"
        warnings.warn(text, PaintWarning, stacklevel=3)
    return factor, SKY_STATES[int(np.bincount(state, minlength=len(SKY_STATES)).argmax())]


def _left_by_lean(
    spectra: Floats, factor: Floats, lean: Floats, seconds: Floats, channels: Floats
) -> tuple[Floats, Floats]:
    """Return what the ``factor`` of spectra (sample, channel) lacks for a unit of lean, and of its square.

    Each (channel,). From sample to sample, where light itself changes little: the slopes of the logarithm of
    spectra over factors, with none as prior. Intervals of wavelength that have no light get none.
    """
    change = np.diff(seconds)
    near = change <= 5.0 * np.median(change) if change.size else np.zeros(0, bool)
    powers = np.stack([lean, lean**2], axis=1)
    nodes = np.arange(channels.min(), channels.max() + LEARNT_NM, LEARNT_NM)
    slopes = np.zeros((nodes.size, 2))
    for place, node in enumerate(nodes):
        inside = np.abs(channels - node) <= LEARNT_NM / 2.0
        light, own = np.nan_to_num(spectra[:, inside]).sum(axis=1), factor[:, inside]
        if near.sum() < LEARNT_FROM or not inside.any() or not (light > 0.0).all():
            continue
        mean = own.mean(axis=1)
        rise, steps = np.diff(np.log(light / mean)), np.diff(powers / mean[:, None], axis=0)
        fit = slopes[place]
        for _ in range(10):
            rest = rise - steps @ fit
            spread = max(1.4826 * float(np.median(np.abs(rest[near]))), 1e-5)
            # what a cloud does is far from the rest
            used = near & (np.abs(rest) <= 3.0 * spread)
            x, y = steps[used] / spread, rise[used] / spread
            fit = np.linalg.solve(x.T @ x + np.eye(2) / LEARNT_SD**2, x.T @ y)
        slopes[place] = fit
    first, second = (np.interp(channels, nodes, each) for each in slopes.T)
    return first, second


def _split(
    spectra: Floats, stamps: Array, channels: Floats, place: tuple[float, float]
) -> tuple[Floats, Array]:
    """Return diffuse fraction (sample, channel) and the number of the state (sample,)."""
    import xarray as xr

    nm = xr.Variable(IRRADIANCE_WAVELENGTH, channels, schema.VARIABLES[IRRADIANCE_WAVELENGTH].attrs)
    record = xr.DataArray(
        spectra,
        {IRRADIANCE_TIME: stamps, IRRADIANCE_WAVELENGTH: nm},
        (IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH),
    )
    named = schema.label(record, "irradiance").to_dataset()
    split = diffuse_from_record(named, *place, wavelength=_NODES_NM)
    rows = split["diffuse_fraction"].values.astype(np.float64)
    return np.stack([np.interp(channels, _NODES_NM, row) for row in rows]), split["sky_state"].values


def _sensor(
    stamps: Array,
    attitude: xr.Dataset,
    mounting: tuple[float, float, float],
    cosine_response: xr.DataArray | None,
    ground: float,
) -> _Sensor:
    """Return the sensor at every sample, from the attitude of the aircraft."""
    from scipy.spatial.transform import Rotation

    problems = Problems("the light sensor cannot be levelled", SchemaError)
    missing = [name for name in (*_ANGLES, *_PLACE) if name not in attitude.variables]
    clock = next((name for name in _TIMES if name in attitude.variables), None)
    if missing or clock is None:
        problems.add(
            f"the attitude has no {', '.join([*missing, *([] if clock else ['time'])])}",
            code="variable-missing",
        )
    if np.shape(mounting) != (3,) or not np.isfinite(mounting).all():
        problems.add(
            f"mounting={mounting!r}", expected="roll, pitch and heading [degree]", code="mounting-unreadable"
        )
    if not 0.0 <= ground <= 1.0:
        problems.add(f"ground_reflectance={ground!r}", expected="0 to 1", code="value-out-of-range")
    response = _response(cosine_response, problems)
    problems.raise_if_any()
    convention = Convention.from_attrs(attitude.attrs) or Convention()
    angles = [attitude[name] for name in _ANGLES]
    if all("units" in each.attrs for each in angles):
        angles = [convert(each, "degree") for each in angles]
        convention = convention.replace(angle_unit="degree")
    roll, pitch, heading = convention.canonical(*(np.asarray(each.values, np.float64) for each in angles))
    time = attitude[clock].values.astype("datetime64[ns]")
    there = ~np.isnat(time) & np.isfinite(roll)
    normal = np.full((stamps.size, 3), np.nan)
    places = [np.asarray(attitude[name].values, np.float64) for name in _PLACE]
    known = np.isfinite(places[0]) & np.isfinite(places[1])
    if there.any() and known.any():
        order = np.flatnonzero(there)[np.argsort(time[there], kind="stable")]
        turns = np.stack([heading, pitch, roll], axis=-1)[order]
        axis = Rotation.from_euler("ZYX", mounting[::-1], degrees=True).apply([0.0, 0.0, -1.0])
        # north, east, down
        body = Rotation.from_euler("ZYX", turns, degrees=True).apply(axis)
        at = (stamps - time[order[0]]) / np.timedelta64(1, "s")
        rows = (time[order] - time[order[0]]) / np.timedelta64(1, "s")
        after = np.clip(np.searchsorted(rows, at), 1, max(rows.size - 1, 1))
        low, high = rows[after - 1], rows[np.minimum(after, rows.size - 1)]
        away = np.minimum(np.abs(at - low), np.abs(at - high))
        is_known = ((at >= low) & (at <= high) & (high - low <= MAX_GAP_S)) | (away <= MAX_GAP_S / 4.0)
        each = np.stack([np.interp(at, rows, body[:, axis]) for axis in (1, 0, 2)], axis=-1)
        each *= np.array([1.0, 1.0, -1.0]) / np.linalg.norm(each, axis=-1, keepdims=True)
        normal = np.where(is_known[:, None], each, np.nan)
    # to a kilometre, so that a crop of the line means the same sky
    latitude, longitude = (round(float(each[known].mean()), 2) if known.any() else 0.0 for each in places)
    zenith, azimuth = solar_position(stamps, latitude, longitude)
    return _Sensor(normal, zenith, azimuth, (latitude, longitude), response, ground)


def _response(cosine_response: Any, problems: Problems) -> tuple[Floats, Floats]:
    """Return incidence [degree] and what is read over the cosine law [1]."""
    if cosine_response is None:
        return np.array([0.0, 90.0]), np.ones(2)
    if not hasattr(cosine_response, "coords") or "incidence" not in cosine_response.coords:
        problems.add("cosine_response has no coordinate 'incidence' [degree]", code="coordinate-missing")
        return np.array([0.0, 90.0]), np.ones(2)
    incidence = np.asarray(cosine_response["incidence"].values, np.float64)
    values = np.asarray(cosine_response.values, np.float64)
    if values.ndim != 1 or (np.diff(incidence) <= 0).any() or not ((values > 0.0) & (values < 2.0)).all():
        problems.add(
            "cosine_response must be 0 to 2 at incidences that increase",
            mend="it is over the cosine law",
            code="cosine-response-invalid",
        )
    return incidence, values
