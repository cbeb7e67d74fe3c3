"""Diffuse fraction and state of the sky, from a record of irradiance alone.

A record is compared with clear and cloudy skies that are possible at its place and time: by level,
colour, and changes over a minute. Called by `process`, which stores the split with each flight line,
and for flight lines that have a record only.
"""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    VARIABLES,
    Array,
    ArrayLike,
    Floats,
    Ints,
    Problems,
    SchemaError,
    convert,
    documented,
    label,
    require,
    takes_quantities,
)

from .clear_sky import ClearSky, sunlight_table
from .illumination import between_stamps, channels_of, check_irradiance_times
from .sun import solar_position

#: Words of ``sky_state``, in the order of its numbers.
SKY_STATES = ("clear", "hazy", "broken", "overcast", "contradictory")

#: Variables of the split of a line's light into direct and diffuse.
SPLIT = ("diffuse_fraction", "diffuse_fraction_u", "sky_state")

_SHOWN_NM = (400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0, 750.0, 800.0, 850.0, 900.0, 950.0, 1000.0)


@takes_quantities(latitude="degree", longitude="degree", calibration_uncertainty="1", wavelength="nm")
@documented()
def diffuse_from_record(
    irradiance: xr.Dataset,
    latitude: float,
    longitude: float,
    *,
    wavelength: ArrayLike = _SHOWN_NM,
    calibration_uncertainty: float = 0.05,
    pressure: float = 101_325.0,
) -> xr.Dataset:
    """Return the diffuse fraction of measured downwelling light, and the state of the sky.

    Parameters
    ----------
    irradiance
        With ``irradiance`` (irradiance_time, irradiance_wavelength) of a level receiver, in any unit of
        irradiance.
    latitude, longitude
    wavelength : (band,)
        Wavelengths of the fraction, 300 to 2500 [nm].
    calibration_uncertainty
        Relative standard uncertainty of the record's level [1]. 5 % suits a calibrated field spectrometer
        with a cosine receptor; a larger one leaves the decision to colour and changes.
    pressure
        Air pressure at the receiver [Pa].

    Returns
    -------
    Dataset
        ``diffuse_fraction`` and ``diffuse_fraction_u`` (irradiance_time, band), float32 [1], mean and
        standard deviation over the possible skies, and under broken clouds over a minute, except where the
        sun is free for 2.5 s before and after; NaN where a sample has no data. ``sky_state``
        (irradiance_time), int8: 0 clear, 1 hazy, 2 broken, 3 overcast, 4 contradictory: thin cloud before the
        sun, a level that no sky has or a receiver that is not calibrated, or several skies that explain it
        alike; the uncertainty is then wide. ``sky_probability`` (irradiance_time, state) [1], and
        ``cloud_share`` (irradiance_time) [1], from 0 at a clear sky's fraction at 550 nm to 1 at fraction 1.

    Raises
    ------
    SchemaError, TimeError, UnitsError
        Stamps are missing, stand twice or run backwards; variables are missing, or have other dims or units;
        the place is not finite; or the record has no channel in the compared intervals, 407 to 1013 nm
        between the bands of oxygen and water.

    Notes
    -----
    Bayes' rule over some 4600 skies drawn from a prior: clear air (`hyperpaint.light.clear_sky`) with varied
    aerosol, ozone, ground and pressure, and clouds over it. A spectrum alone cannot distinguish a thin
    neutral cloud from a dirty receiver.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.light.clear_sky import ClearSky
    >>> nm, noon = np.arange(400.0, 1001.0), np.array(["2024-06-21T12:00", "2024-06-21T12:01"], "M8[ns]")
    >>> sky = np.tile(0.967 * sum(ClearSky(26.6).irradiance(nm)), (2, 1))
    >>> light = xr.DataArray(
    ...     sky, {"irradiance_time": noon, "irradiance_wavelength": nm}, attrs={"units": "W m-2 nm-1"}
    ... )
    >>> record = light.to_dataset(name="irradiance")
    >>> split = diffuse_from_record(record, 50.0, 0.0, wavelength=[450.0, 850.0])
    >>> split.sky_state.values, split.diffuse_fraction.values[0].round(1)
    (array([0, 0], dtype=int8), array([0.3, 0.1], dtype=float32))
    """
    variables = require(irradiance, ["irradiance", IRRADIANCE_TIME], "the split of irradiance")
    record = variables["irradiance"]
    channels = channels_of(record)
    with Problems("the split of irradiance is not known", SchemaError) as problems:
        is_finite = np.isfinite(latitude) and np.isfinite(longitude)
        for is_valid, found, expected in (
            (
                is_finite,
                f"latitude {latitude}, longitude {longitude}",
                "the place of the receiver in degrees",
            ),
            (
                0.0 < calibration_uncertainty <= 1.0,
                f"calibration_uncertainty={calibration_uncertainty!r}",
                "above 0, at most 1",
            ),
            (3e4 <= pressure <= 1.1e5, f"pressure={pressure!r}", "30000 to 110000 Pa"),
        ):
            problems.add_if(not is_valid, found, expected=expected, code="value-out-of-range")
    check_irradiance_times(variables[IRRADIANCE_TIME].values.astype("datetime64[ns]"))
    SchemaError.raise_if(
        not windows_in(channels).centre.size,
        f"irradiance has no channel in the compared intervals, {WINDOWS_NM[0]:g} to {WINDOWS_NM[-1]:g} nm",
        code="irradiance-coverage",
    )
    wavelengths = np.atleast_1d(np.asarray(wavelength, np.float64))
    time = variables[IRRADIANCE_TIME].values
    receiver = float(latitude), float(longitude), float(calibration_uncertainty), float(pressure)
    fraction, u, probability, cloud = _split(record.values, time, channels, wavelengths, receiver)
    split = xr.Dataset(
        {
            "diffuse_fraction": ((IRRADIANCE_TIME, BAND), fraction.astype(np.float32)),
            "diffuse_fraction_u": ((IRRADIANCE_TIME, BAND), u.astype(np.float32)),
            "sky_state": (IRRADIANCE_TIME, states_of(probability)),
            "sky_probability": ((IRRADIANCE_TIME, "state"), probability, {"units": "1"}),
            "cloud_share": (IRRADIANCE_TIME, cloud, {"units": "1"}),
        },
        {
            IRRADIANCE_TIME: record[IRRADIANCE_TIME].variable,
            "wavelength": (BAND, wavelengths, VARIABLES["wavelength"].attrs),
            "state": list(SKY_STATES),
        },
    )
    return split.assign({name: labelled(split[name]) for name in SPLIT})


def split_of_arrays(
    spectra: Array, stamps: Array, channels: Array, place: tuple[float, float], wavelength: Floats
) -> tuple[Floats, Array]:
    # Return diffuse fraction (sample, band) and number of the sky state (sample,) of a record as arrays.
    #
    # ``spectra`` (sample, channel) [W m-2 nm-1], ``channels`` and ``wavelength`` [nm]; see
    # `diffuse_from_record`.
    axis = xr.Variable(IRRADIANCE_WAVELENGTH, channels, VARIABLES[IRRADIANCE_WAVELENGTH].attrs)
    axes = {IRRADIANCE_TIME: stamps, IRRADIANCE_WAVELENGTH: axis}
    record = label(xr.DataArray(spectra, axes, tuple(axes)), "irradiance")
    split = diffuse_from_record(record.to_dataset(), *place, wavelength=wavelength)
    return split["diffuse_fraction"].values.astype(np.float64), split["sky_state"].values


def labelled(array: xr.DataArray) -> xr.DataArray:
    # Return a variable of `SPLIT` with its attributes of the table.
    return label(array, str(array.name), **sky_state_attrs() if array.name == "sky_state" else {})


def sky_state_attrs() -> dict[str, Any]:
    # Return the CF attributes that name the numbers of ``sky_state``.
    return {"flag_values": np.arange(len(SKY_STATES), dtype=np.int8), "flag_meanings": " ".join(SKY_STATES)}


def states_of(probability: Floats) -> Array:
    # Return the number of the likeliest of `SKY_STATES`; contradictory below `RULES.decided`.
    return np.where(
        probability.max(axis=1) < RULES.decided, len(SKY_STATES) - 1, probability.argmax(axis=1)
    ).astype(np.int8)


def _split(
    spectra: Array,
    time: Array,
    channels: Floats,
    wavelength: Floats,
    place: tuple[float, float, float, float],
    sun_zenith: float | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    # Return fraction and uncertainty (sample, band), probabilities (sample, state), cloud share (sample,).
    # `receiver`: latitude, longitude [degree], relative uncertainty of the level [1], pressure [Pa];
    # `sun_zenith` replaces the zenith angle from clock and place [degree].
    latitude, longitude, level_u, pressure = place
    spectra = np.asarray(spectra, np.float64)
    # leave out channels that most samples lack: a sample needs finite values in all intervals
    finite = np.isfinite(spectra)
    is_frequent = 2 * finite.sum(axis=0) > finite.any(axis=1).sum()
    spectra, channels = spectra[:, is_frequent], channels[is_frequent]
    # means over the compared intervals, at one astronomical unit
    windows = windows_in(channels)
    is_used = windows.operator.any(axis=0)
    means = spectra[:, is_used] @ windows.operator[:, is_used].T
    # the light at the mean distance of the sun
    days = (np.asarray(time).astype("datetime64[s]") - np.datetime64("2000-01-04")).astype(np.float64) / 86400
    means /= np.asarray(1.0 + 0.0334 * np.cos(2.0 * np.pi * days / 365.25))[:, None]
    zenith, _ = solar_position(time, latitude, longitude)
    if sun_zenith is not None:
        zenith = np.full(zenith.shape, sun_zenith)
    # without any interval, as in a record without values, no sample is usable
    usable = (
        bool(windows.centre.size) & ((means > 0.0) & np.isfinite(means)).all(axis=1) & np.isfinite(zenith)
    )
    samples, bands = len(means), wavelength.size
    fraction, u = np.full((samples, bands), np.nan), np.full((samples, bands), np.nan)
    probability = np.zeros((samples, len(SKY_STATES)))
    probability[:, -1] = 1.0
    cloud = np.full(samples, np.nan)
    if usable.any():
        seconds = (time[usable] - time[usable][0]).astype("timedelta64[ns]").astype(np.float64) / 1e9
        evidence = Evidence(np.log(means[usable]), zenith[usable], seconds, level_u)
        node_fraction, node_u, probability[usable], cloud[usable] = explain(evidence, windows, pressure)
        for out, values in ((fraction, node_fraction), (u, node_u)):
            out[usable] = [np.interp(wavelength, NODES_NM, row) for row in values]
    return fraction, u, probability, cloud


def split_of_lines(
    line: xr.Dataset, *, calibration_uncertainty: float = 0.05, sun_zenith: float | None = None
) -> xr.Dataset | None:
    # Return `SPLIT` for the lines of a flight line, from its own record; None without a record or a place.
    #
    # ``line`` has ``irradiance``, ``time``, ``latitude``, ``longitude`` and ``wavelength``. A line has the
    # fraction interpolated between both samples around it, and the state of the nearer one; NaN, and
    # contradictory, where it has no time. ``sun_zenith`` [degree] replaces the zenith angle from the clock.
    # Lazy where the record or ``wavelength`` come from a file.
    import dask
    import dask.array as da

    from hyperpaint.base.many_outputs import split_outputs

    wanted = ("irradiance", "time", "latitude", "longitude", "wavelength")
    if not set(wanted) <= set(line.variables) or line.sizes.get(IRRADIANCE_TIME, 0) == 0:
        return None
    variables = require(line, [*wanted, IRRADIANCE_TIME], "the split of irradiance")
    record = variables["irradiance"]
    latitude, longitude = (variables[name].values for name in ("latitude", "longitude"))
    is_located = np.isfinite(latitude) & np.isfinite(longitude)
    if not is_located.any() or IRRADIANCE_WAVELENGTH not in record.coords:
        return None
    channels = convert(record[IRRADIANCE_WAVELENGTH], "nm").values.astype(np.float64)
    if not windows_in(channels).centre.size:
        return None
    # rounded to a kilometre, so that a crop of the line gets the same sky
    place = round(float(latitude[is_located].mean()), 2), round(float(longitude[is_located].mean()), 2)
    wavelength = variables["wavelength"].values.astype(np.float64)
    samples = variables[IRRADIANCE_TIME].values
    check_irradiance_times(samples.astype("datetime64[ns]"))
    split_of_record = dask.delayed(_split)(
        record.data, samples, channels, wavelength, (*place, calibration_uncertainty, 101_325.0), sun_zenith
    )
    # blocks are the chunks of the cube
    chunks: Any = 1024
    for name in ("counts", "radiance", "reflectance"):
        if name in line.variables and line[name].chunks is not None:
            chunks = (line[name].variable.chunksizes.get(ALONG_TRACK, chunks),)
    stamps = da.from_array(variables["time"].values, chunks)
    meta = np.empty(0, object)
    blocks = da.map_blocks(_at_lines, stamps, split_of_record, samples=samples, dtype=object, meta=meta)
    layout = {0: ("lb", "f4"), 1: ("lb", "f4"), 2: ("l", "i1")}
    arrays = split_outputs(blocks, "l", layout, {"b": wavelength.size}).values()
    dims = (ALONG_TRACK, BAND)
    split = xr.Dataset({name: (dims[: a.ndim], a) for name, a in zip(SPLIT, arrays, strict=True)})
    return split.assign({name: labelled(split[name]) for name in SPLIT})


def _at_lines(
    time: Array, split: tuple[Floats, Floats, Floats, Floats], *, samples: Array
) -> tuple[Array, Array, Array]:
    # Interpolate fraction, uncertainty (line, band) and state (line,) from the samples around every line.
    fraction, u, probability, _ = split
    usable = np.flatnonzero(np.isfinite(fraction).any(axis=1))
    shape = (time.size, fraction.shape[1])
    state = np.full(time.size, len(SKY_STATES) - 1, np.int8)
    if not usable.size:
        return np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), state
    stamps, has_time = samples[usable].astype("datetime64[ns]"), ~np.isnat(time)
    before, weight = between_stamps(stamps, time)
    after, share = np.minimum(before + 1, usable.size - 1), weight[:, None]
    rows = [
        np.where(
            has_time[:, None],
            (1.0 - share) * values[usable[before]] + share * values[usable[after]],
            np.nan,
        )
        for values in (fraction, u)
    ]
    nearer = usable[np.where(weight > 0.5, after, before)]
    state = np.where(has_time, states_of(probability)[nearer], state).astype(np.int8)
    return rows[0].astype(np.float32), rows[1].astype(np.float32), state


# --- possible skies over a spectrometer, and how well each explains a spectrum of irradiance ---------------


#: Kinds of sky that are drawn: no cloud, thin cloud before the sun, broken cloud, overcast.
KINDS = ("air", "thin", "broken", "overcast")

#: Centres of the compared intervals [nm]: between the bands of oxygen and water.
WINDOWS_NM = (
    415.0, 445.0, 475.0, 500.0, 525.0, 550.0, 575.0, 615.0, 640.0, 670.0, 708.0, 748.0, 778.0, 865.0,
    882.0, 1005.0,
)  # fmt: skip
#: Prior of skies and receivers, before a spectrum is compared.
RULES = SimpleNamespace(
    # Half width of the intervals [nm]: wide enough that solar lines look alike to all spectrometers.
    half_width_nm=8.0,
    # Relative standard uncertainty of a single interval [1]: noise, sunlight, the model's bands.
    shape_u=0.015,
    # Relative standard uncertainty of slow changes over the spectrum [1], and their length [nm]: lamp,
    # receiver, and the residual of the model against others (tests: 2 to 3 %).
    colour_u=0.03,
    colour_nm=200.0,
    # Relative standard uncertainty of the level of a badly calibrated receiver [1], and the probability of
    # one. An uncalibrated light sensor is wrong by a quarter (MicaSense's, according to their tutorial).
    wide_u=0.2,
    wide_prior=0.08,
    # Median of the optical depth at 500 nm, and spread of its logarithm (AERONET, continental sites).
    aerosol=0.12,
    aerosol_spread=0.9,
    # Optical depth from which clear air is called hazy [1].
    hazy_aerosol=0.25,
    # Probabilities of `KINDS`.
    priors=(0.43, 0.12, 0.20, 0.25),
    # Relative standard deviation of the level over `window_s` below which, and above which, each of `KINDS`
    # is unlikely [1]: cirrus drifts by a per cent in a minute, broken cloud hides and reveals the sun.
    calm=(0.0, 0.004, 0.06, 0.0),
    restless=(0.01, 0.03, np.inf, 0.05),
    # Spread of the logarithm of that deviation beyond ``calm`` and ``restless``.
    calm_spread=(1.0, 0.8, 0.5, 1.0),
    restless_spread=0.5,
    # Half width of the interval over which the level varies [s]: clouds pass in seconds to a minute.
    window_s=90.0,
    # Half width of the interval within which the light of a moment is judged [s]: at 8 m/s, the shadow of a
    # cloud passes a receiver 20 m away in this time.
    passing_s=2.5,
    # Quantile of the level over `window_s` that stands for free sun; and the lowest level of free sun
    # relative to it, and relative to the highest within `passing_s` [1].
    bright=0.95,
    free=0.97,
    steady=0.98,
    # Probability that clock or place are wrong, so that the sun stands elsewhere [1].
    wrong_clock=0.02,
    # Minimum difference of that sun's zenith angle [degree]: smaller ones can hardly be distinguished.
    other_sun_deg=7.0,
    # Chi-square per interval of the best draw beyond which no sky explains a spectrum.
    misfit=4.0,
    # Probability that a state needs to be named [1].
    decided=0.5,
    # Standard uncertainty of a diffuse fraction that no record removes: alone, and times f (1 - f) [1].
    floor=0.008,
    model=0.10,
)


PRIOR = SimpleNamespace(
    #: Number of drawn states of the air; clouds are drawn over each.
    n_air_states=512,
    draws_per_state={"air": 1, "thin": 2, "broken": 4, "overcast": 2},
    #: Wavelengths of an interval at which the model is evaluated.
    points_per_window=5,
)
NODES_NM = np.array(
    [300.0, 350, 380, 410, 450, 500, 550, 600, 650, 700, 760, 830, 900, 1000, 1200, 1600, 2500]
)
#: Zenith angle of the sun above which the sky's state is not determined [degree].
MAX_SUN_ZENITH_DEG = 88.0


class _Draws(NamedTuple):
    kind: Ints  # (draw,) number of `KINDS`
    air: Ints  # (draw,) number of the state of the air
    beam: Floats  # (draw,) a
    blue: Floats  # b
    returned: Floats  # e
    cloud: Floats  # c
    tint: Floats  # of the cloud: share that falls with the fourth power of the wavelength
    states: Floats  # (parameter, air): aerosol, exponent, ozone, relative pressure, ground, water


@functools.cache
def _draws() -> _Draws:
    # Draw the skies for comparison, the same in every run.
    rng = np.random.default_rng(19_590)
    # one stratum per draw, so that a few hundred draws fill the range
    strata = (
        np.argsort(rng.random((6, PRIOR.n_air_states)), axis=1) + rng.random((6, PRIOR.n_air_states))
    ) / PRIOR.n_air_states
    from scipy.special import ndtri

    normal = ndtri(strata)
    states = np.stack(
        [
            np.clip(RULES.aerosol * np.exp(RULES.aerosol_spread * normal[0]), 0.01, 1.2),
            np.clip(1.2 + 0.35 * normal[1], 0.2, 2.2),
            np.clip(0.31 + 0.03 * normal[2], 0.2, 0.45),
            np.exp(0.01 * normal[3]),
            np.clip(0.2 + 0.08 * normal[4], 0.03, 0.6),
            0.2 + 2.5 * strata[5],
        ]
    )
    parts = []
    for number, name in enumerate(KINDS):
        count = PRIOR.n_air_states * PRIOR.draws_per_state[name]
        u = rng.random((5, count))
        ones, zeros = np.ones(count), np.zeros(count)
        tint = 0.3 * u[0]
        if name == "air":
            amounts = ones, ones, zeros, zeros
        elif name == "thin":
            beam = 0.25 + 0.7 * u[1]
            amounts = beam, 1.0 - 0.3 * (1.0 - beam) * u[3], (1.0 - beam) * (0.3 + 0.6 * u[2]), zeros
        elif name == "broken":
            cover = 0.1 + 0.85 * u[2]
            # the sun is visible in 45 %, hidden in 35 %, else behind the edge of a cloud
            beam = np.where(u[1] < 0.45, 1.0, np.where(u[1] < 0.8, 0.1 * u[4], u[4]))
            amounts = beam, 1.0 - cover, zeros, cover * (0.15 + 0.4 * u[3])
        else:
            amounts = zeros, zeros, zeros, np.exp(np.log(0.03) + u[1] * np.log(0.75 / 0.03))
        air = np.tile(np.arange(PRIOR.n_air_states), PRIOR.draws_per_state[name])
        parts.append((np.full(count, number), air, *amounts, tint))
    kind, air, beam, blue, returned, cloud, tint = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Draws(kind, air, beam, blue, returned, cloud, tint, states)


class Windows(NamedTuple):
    """Compared intervals of the spectrum that a spectrometer covers."""

    centre: Floats  # (window,) [nm]
    operator: Floats  # (window, channel): means over channels


def windows_in(wavelength: Floats) -> Windows:
    # Return the intervals that channels (channel,) [nm], in any order, cover.
    rows, centres = [], []
    for centre in WINDOWS_NM:
        is_inside = np.abs(wavelength - centre) <= RULES.half_width_nm
        is_covered = wavelength.size and wavelength.min() <= centre - 2.0 and centre + 2.0 <= wavelength.max()
        if is_covered and is_inside.any():
            rows.append(is_inside / is_inside.sum())
            centres.append(centre)
    return Windows(np.array(centres), np.array(rows).reshape(len(rows), wavelength.size))


def _irradiance_of_draws(
    draws: _Draws, wavelength: Floats, direct: Floats, diffuse: Floats
) -> tuple[Floats, Floats]:
    # Return irradiance and diffuse fraction of all draws (draw, wavelength).
    beam, blue, returned, cloud, tint = (amount[:, None] for amount in draws[2:7])
    direct, diffuse = direct[draws.air], diffuse[draws.air]
    colour = 1.0 - tint + tint * (wavelength / 490.0) ** -4.0
    scattered = blue * diffuse + returned * direct + cloud * colour * (direct + diffuse)
    total = beam * direct + scattered
    return total, scattered / total


def _clear_light(
    sun_zenith: float, pressure: float, centres: tuple[float, ...], every: int = 1
) -> tuple[Floats, Floats, Floats, Floats]:
    # Return direct and diffuse light of every n-th state of clear air: at points of the intervals (air,
    # window, point), and without gases, which absorb the same share of both, at the nodes (air, node).
    aerosol, exponent, ozone, relative, ground, water = (state[::every, None] for state in _draws().states)
    sky = ClearSky(
        sun_zenith, aerosol, exponent, ozone=ozone, water=water, pressure=pressure * relative, ground=ground
    )
    steps = np.linspace(-RULES.half_width_nm, RULES.half_width_nm, 2 * PRIOR.points_per_window + 1)[1::2]
    points = np.array(centres)[:, None] + steps
    table = sunlight_table()
    above = np.cos(np.radians(sun_zenith)) * np.interp(points, table.wavelength, table.extraterrestrial)
    # scattering is smooth within an interval, gases are not
    direct, diffuse = (
        above * scattered[..., None] * gases.reshape(-1, *points.shape)
        for scattered, gases in zip(
            sky.transmittances(np.array(centres)), sky.gases(points.ravel()), strict=True
        )
    )
    return direct, diffuse, *sky.transmittances(NODES_NM)


@functools.lru_cache(maxsize=64)
def _spectra(sun_zenith: float, pressure: float, centres: tuple[float, ...]) -> tuple[Floats, Floats, Floats]:
    # Return, of all draws for a zenith angle of the sun [degree], the logarithm of the irradiance (draw,
    # window), the diffuse fraction, and that of the same air without clouds (draw, node).
    draws = _draws()
    direct, diffuse, node_direct, node_diffuse = _clear_light(sun_zenith, pressure, centres)
    total, _ = _irradiance_of_draws(draws, np.array(centres), direct.mean(axis=2), diffuse.mean(axis=2))
    _, fraction = _irradiance_of_draws(draws, NODES_NM, node_direct, node_diffuse)
    return np.log(total), fraction, (node_diffuse / (node_direct + node_diffuse))[draws.air]


@functools.lru_cache(maxsize=16)
def _whitening(centres: tuple[float, ...], level_u: float) -> tuple[Floats, float]:
    wavelengths = np.array(centres)
    covariance = RULES.shape_u**2 * np.eye(wavelengths.size) + level_u**2
    covariance += RULES.colour_u**2 * np.exp(
        -0.5 * ((wavelengths[:, None] - wavelengths) / RULES.colour_nm) ** 2
    )
    lower = np.linalg.cholesky(covariance)
    return np.linalg.inv(lower), float(np.log(np.diag(lower)).sum())


class Evidence(NamedTuple):
    # Measurements of a record.
    level: Floats  # (sample, window): logarithm of the irradiance [W m-2 nm-1]
    sun_zenith: Floats  # (sample,) [degree]
    seconds: Floats  # (sample,) since the first
    level_u: float  # relative standard uncertainty of the level


def _chi_square(
    level: Floats, drawn: Floats, centres: tuple[float, ...], level_u: float
) -> tuple[Floats, float]:
    # Return chi-square of every sample with every draw (sample, draw), and the logarithm of the norm.
    whitening, log_norm = _whitening(centres, level_u)
    samples, draws = level @ whitening.T, drawn @ whitening.T
    chi = (samples**2).sum(axis=1)[:, None] + (draws**2).sum(axis=1) - 2.0 * samples @ draws.T
    return chi, log_norm


def _evidence_of(chi: Floats, log_norm: float) -> tuple[Floats, Floats, Floats]:
    # Return the logarithm of the evidence of draws of equal weight (sample,) from chi-square (sample, draw);
    # likelihoods relative to the best draw (sample, draw), and their sum (sample,).
    lowest = chi.min(axis=1)
    weight = np.exp(-0.5 * (chi - lowest[:, None]))
    total = weight.sum(axis=1)
    return np.log(total / chi.shape[1]) - 0.5 * lowest - log_norm, weight, total


def _posterior(evidence: Evidence, windows: Windows, pressure: float) -> tuple[Floats, ...]:
    # Return the posterior by sample, width of the level (calibrated or not) and kind of sky (sample, width,
    # kind ...): logarithm of the evidence; mean of the diffuse fraction (..., node), of its square, and of
    # the fraction without clouds; probability that the air is hazy; and chi-square per interval of the best
    # draw (sample,).
    draws, centres = _draws(), tuple(map(float, windows.centre))
    shape = evidence.level.shape[0], 2, len(KINDS)
    log, turbid = np.zeros(shape), np.zeros(shape)
    mean, square, clear = (np.zeros((*shape, NODES_NM.size)) for _ in range(3))
    best = np.full(shape[0], np.inf)
    is_hazy = (draws.states[0][draws.air] >= RULES.hazy_aerosol).astype(np.float64)
    kinds = [np.flatnonzero(draws.kind == number) for number in range(len(KINDS))]
    sun = np.minimum(evidence.sun_zenith, MAX_SUN_ZENITH_DEG)
    node_zenith = np.round(2.0 * sun) / 2.0
    for zenith in np.unique(node_zenith):
        drawn_level, drawn_fraction, drawn_clear = _spectra(float(zenith), pressure, centres)
        for block in np.array_split(
            samples := np.flatnonzero(node_zenith == zenith), 1 + samples.size // 128
        ):
            # levels at the sun of the node
            sun_ratio = np.cos(np.radians(sun[block])) / np.cos(np.radians(zenith))
            level = evidence.level[block] - np.log(sun_ratio)[:, None]
            for width, level_u in enumerate((evidence.level_u, np.hypot(evidence.level_u, RULES.wide_u))):
                chi, log_norm = _chi_square(level, drawn_level, centres, float(level_u))
                if width == 0:
                    best[block] = chi.min(axis=1) / len(centres)
                chi /= np.maximum(1.0, best[block] / RULES.misfit)[:, None]
                # evidence of each kind, and its means over the draws
                for number, draw in enumerate(kinds):
                    log[block, width, number], weight, total = _evidence_of(chi[:, draw], log_norm)
                    weight /= total[:, None]
                    mean[block, width, number] = weight @ drawn_fraction[draw]
                    square[block, width, number] = weight @ drawn_fraction[draw] ** 2
                    clear[block, width, number] = weight @ drawn_clear[draw]
                    turbid[block, width, number] = weight @ is_hazy[draw]
    return log, mean, square, clear, turbid, best


_OTHER_SUNS_DEG = np.arange(5.0, 85.1, 2.5)


@functools.lru_cache(maxsize=64)
def _clear_air(sun_zenith: float, pressure: float, centres: tuple[float, ...]) -> tuple[Floats, Floats]:
    # Return level (air, window) and diffuse fraction (air, node) of every fourth state of clear air.
    direct, diffuse, node_direct, node_diffuse = _clear_light(sun_zenith, pressure, centres, every=4)
    return np.log((direct + diffuse).mean(axis=2)), node_diffuse / (node_direct + node_diffuse)


def explain(evidence: Evidence, windows: Windows, pressure: float) -> tuple[Floats, Floats, Floats, Floats]:
    # Return the posterior over the drawn skies, each weighted by how well it explains a sample.
    #
    # Diffuse fraction and its uncertainty at `NODES_NM` (sample, node); probability of clear, hazy, broken,
    # overcast and contradictory (sample, state); and how far the fraction is from that of clear air to 1
    # (sample,).
    #
    # Misfits of the logarithm are Gaussian, with the covariance of a level common to all wavelengths, of slow
    # colour and of single intervals; the uncertainty of the level is `Evidence.level_u` or, with a small
    # prior, `RULES.wide_u`. The evidence of a kind of sky is averaged over `RULES.window_s` and
    # weighted by how much the level varies in it. Where even the best draw does not fit, all misfits are
    # divided until it does, which gives a wide posterior. A spectrum that clear air under another sun
    # explains better contradicts the clock.
    # posterior of kinds of sky and widths of the level
    log, means, mean_squares, means_without_cloud, turbid, best = _posterior(evidence, windows, pressure)
    prior = np.log(np.array([[1.0 - RULES.wide_prior], [RULES.wide_prior]]) * np.array(RULES.priors))
    # log likelihood of the level's changes under each kind of sky (sample, kind).
    sun_cosine = np.maximum(np.cos(np.radians(np.minimum(evidence.sun_zenith, 88.0))), 1e-3)
    level = evidence.level.mean(axis=1) - np.log(sun_cosine)
    level = level - level.mean()
    mean = _window_means(level, evidence.seconds)
    spread = np.sqrt(np.maximum(_window_means(level**2, evidence.seconds) - mean**2, 0.0))
    # a record of a few seconds shows only a small part of the changes of a minute
    first, last = _window_of(evidence.seconds)
    span = (evidence.seconds[last - 1] - evidence.seconds[first]) / (2.0 * RULES.window_s)
    log_spread = np.log(np.maximum(spread, 1e-3))[:, None]
    with np.errstate(divide="ignore"):
        below = np.maximum(np.log(RULES.calm) - log_spread, 0.0) / np.array(RULES.calm_spread)
    above = np.maximum(log_spread - np.log(RULES.restless), 0.0) / RULES.restless_spread
    variation = np.asarray(-0.5 * (below**2 * np.minimum(span, 1.0)[:, None] + above**2))
    logs = _window_means(log, evidence.seconds) + prior + variation[:, None, :]
    share = np.exp(logs - logs.max(axis=(1, 2), keepdims=True))
    total = share.sum(axis=(1, 2))
    share /= total[:, None, None]
    # thin cloud, and a level far from its calibration, count as contradictory
    air, thin, broken, overcast = share[:, 0].T
    hazy = air * turbid[:, 0, 0]
    probability = np.stack([air - hazy, hazy, broken, overcast, (share[:, 1].sum(axis=1) + thin)], axis=1)
    fraction, square, clear = (
        (share[..., None] * part).sum(axis=(1, 2)) for part in (means, mean_squares, means_without_cloud)
    )
    if (probability[:, :2].sum(axis=1) < RULES.decided).any():
        # a spectrum that no clear sky explains now may be explained by a clear sky at another hour
        # the posterior of clear air if the sun were at other zenith angles than clock and position give:
        # logarithm of the evidence (sample,), mean of the diffuse fraction (sample, node), and of its square
        centres = tuple(map(float, windows.centre))
        shape = evidence.level.shape[0], _OTHER_SUNS_DEG.size
        log, mean, squares = np.empty(shape), *np.empty((2, *shape, NODES_NM.size))
        for number, zenith in enumerate(_OTHER_SUNS_DEG):
            levels, sky_fraction = _clear_air(float(zenith), pressure, centres)
            chi, log_norm = _chi_square(evidence.level, levels, centres, float(evidence.level_u))
            log[:, number], weight, sums = _evidence_of(chi, log_norm)
            mean[:, number] = weight @ sky_fraction / sums[:, None]
            squares[:, number] = weight @ sky_fraction**2 / sums[:, None]
        # average over the other suns, without those near the sun of the clock
        log[np.abs(_OTHER_SUNS_DEG - evidence.sun_zenith[:, None]) < RULES.other_sun_deg] = -np.inf
        best_log = log.max(axis=1)
        weights = np.exp(log - best_log[:, None])
        sums = weights.sum(axis=1)
        weights = (weights / sums[:, None])[..., None]
        moments = (weights * mean).sum(axis=1), (weights * squares).sum(axis=1)
        log, mean, mean_square = best_log + np.log(sums / _OTHER_SUNS_DEG.size), *moments
        log_other_sun = _window_means(log, evidence.seconds) + variation[:, KINDS.index("air")]
        log_clock_sun = logs.max(axis=(1, 2)) + np.log(total) - np.log(RULES.wrong_clock)
        is_other_sun = 1.0 / (1.0 + np.exp(np.clip(log_clock_sun - log_other_sun, -500.0, 500.0)))[:, None]
        probability = (1.0 - is_other_sun) * probability + is_other_sun * np.eye(5)[4]
        fraction += is_other_sun * (mean - fraction)
        square += is_other_sun * (mean_square - square)
    probability[(best > RULES.misfit) | (evidence.sun_zenith > MAX_SUN_ZENITH_DEG)] = np.eye(5)[4]
    # mean of the likeliest kind; its distance from the mean of all kinds enters the uncertainty
    kind = np.array([0, 0, KINDS.index("broken"), KINDS.index("overcast")])
    state = probability[:, :4].argmax(axis=1)
    is_decided = probability[:, :4].max(axis=1) >= RULES.decided
    mean = np.where(is_decided[:, None], means[np.arange(state.size), 0, kind[state]], fraction)
    model = RULES.floor + RULES.model * mean * (1.0 - mean)
    u = np.sqrt(np.maximum(square - 2.0 * mean * fraction + mean**2, 0.0) + model**2)
    fraction = mean
    # under broken cloud, a shadow reaches receiver and ground at different times, except in free sun
    departure = fraction - fraction.mean(axis=0)
    square = _window_means(departure**2, evidence.seconds) - _window_means(departure, evidence.seconds) ** 2
    # Whether no cloud hides the sun for some seconds around a sample (sample,): the light is then steady,
    # with both neighbours in the record, and as bright as the brightest moments of the window.
    cosine = np.cos(np.radians(np.minimum(evidence.sun_zenith, MAX_SUN_ZENITH_DEG)))
    level = np.exp(evidence.level).mean(axis=1) / cosine
    start, stop = _window_of(evidence.seconds, RULES.passing_s)
    is_free = np.zeros(level.size, bool)
    for sample, around in enumerate(zip(*_window_of(evidence.seconds), strict=True)):
        if 0 < sample < level.size - 1:
            near = level[min(start[sample], sample - 1) : max(stop[sample], sample + 2)]
            lowest = RULES.free * np.quantile(level[slice(*around)], RULES.bright)
            is_free[sample] = near.min() > max(lowest, RULES.steady * near.max())
    square[is_free] = 0.0
    u = np.sqrt(u**2 + share[:, :, KINDS.index("broken")].sum(axis=1)[:, None] * np.maximum(square, 0.0))
    node_550 = int(np.abs(NODES_NM - 550.0).argmin())
    cloud = (fraction - clear)[:, node_550] / np.maximum(1.0 - clear[:, node_550], 1e-6)
    return fraction, u, probability, np.clip(cloud, 0.0, 1.0)


def _window_of(seconds: Floats, half_s: float = RULES.window_s) -> tuple[Ints, Ints]:
    # Return the first sample within the window of each sample, and the first sample after it (sample,).
    first = np.searchsorted(seconds, seconds - half_s, side="left")
    return first, np.searchsorted(seconds, seconds + half_s, side="right")


def _window_means(values: Floats, seconds: Floats) -> Floats:
    # Return means of values (sample, ...) over the window of each sample; times increase.
    first, last = _window_of(seconds)
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return np.asarray((sums[last] - sums[first]) / (last - first).reshape(-1, *[1] * (values.ndim - 1)))
