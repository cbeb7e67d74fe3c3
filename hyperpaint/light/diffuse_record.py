"""Diffuse fraction and state of the sky, from a record of irradiance alone.

A record is compared with clear and cloudy skies that are possible at its place and time (`sky_states`): by
level, colour, and changes over a minute. Called by `process`, which stores the split with each flight line,
and for flight lines that have a record only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, BAND, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH
from hyperpaint.base.units import convert, takes_quantities

from .sky_states import NODES_NM, RULES, Evidence, explain, windows_in
from .sun import solar_position
from .synchrony import channels_of, check_irradiance_times

#: Words of ``sky_state``, in the order of its numbers.
SKY_STATES = ("clear", "hazy", "broken", "overcast", "contradictory")

#: Variables of the split of a line's light into direct and diffuse.
SPLIT = ("diffuse_fraction", "diffuse_fraction_u", "sky_state")

_SHOWN_NM = (400.0, 450.0, 500.0, 550.0, 600.0, 650.0, 700.0, 750.0, 800.0, 850.0, 900.0, 950.0, 1000.0)


def sun_distance_factor(time: Array) -> Floats:
    """Return extraterrestrial irradiance relative to one astronomical unit (time,), to 0.1 % [1].

    Examples
    --------
    >>> sun_distance_factor(np.array(["2024-01-04", "2024-07-04"], "datetime64[ns]")).round(3)
    array([1.033, 0.967])
    """
    days = (np.asarray(time).astype("datetime64[s]") - np.datetime64("2000-01-04")).astype(np.float64) / 86400
    return np.asarray(1.0 + 0.0334 * np.cos(2.0 * np.pi * days / 365.25))


@takes_quantities(latitude="degree", longitude="degree", calibration_uncertainty="1", wavelength="nm")
@documented()
def diffuse_from_record(
    irradiance: xr.Dataset,
    latitude: float,
    longitude: float,
    *,
    wavelength: npt.ArrayLike = _SHOWN_NM,
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
        standard deviation over the possible skies; NaN where a sample has no data. ``sky_state``
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
    Bayes' rule over some 4600 skies drawn from a prior: air from SPECTRL2 with varied aerosol, ozone, ground
    and pressure, and clouds over it, see `hyperpaint.light.sky_states`. A spectrum alone cannot distinguish a
    thin neutral cloud from a dirty receiver.

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
    variables = schema.require(irradiance, ["irradiance", IRRADIANCE_TIME], "the split of irradiance")
    record = variables["irradiance"]
    channels = channels_of(record)
    problems = Problems("the split of irradiance is not known", SchemaError)
    is_finite = np.isfinite(latitude) and np.isfinite(longitude)
    for is_valid, found, expected in (
        (is_finite, f"latitude {latitude}, longitude {longitude}", "the place of the receiver in degrees"),
        (
            0.0 < calibration_uncertainty <= 1.0,
            f"calibration_uncertainty={calibration_uncertainty!r}",
            "above 0, at most 1",
        ),
        (3e4 <= pressure <= 1.1e5, f"pressure={pressure!r}", "30000 to 110000 Pa"),
    ):
        if not is_valid:
            problems.add(found, expected=expected, code="value-out-of-range")
    problems.raise_if_any()
    check_irradiance_times(variables[IRRADIANCE_TIME].values.astype("datetime64[ns]"))
    if not windows_in(channels).centre.size:
        raise SchemaError(
            "irradiance has no channel in the compared intervals, "
            f"{RULES.window_nm[0]:g} to {RULES.window_nm[-1]:g} nm",
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
            "wavelength": (BAND, wavelengths, schema.VARIABLES["wavelength"].attrs),
            "state": list(SKY_STATES),
        },
    )
    return split.assign({name: labelled(split[name]) for name in SPLIT})


def labelled(array: xr.DataArray) -> xr.DataArray:
    """Return a variable of `SPLIT` with its attributes of the table."""
    return schema.label(array, str(array.name), **sky_state_attrs() if array.name == "sky_state" else {})


def sky_state_attrs() -> dict[str, Any]:
    """Return the CF attributes that name the numbers of ``sky_state``."""
    numbers = np.arange(len(SKY_STATES), dtype=np.int8)
    return {"flag_values": numbers, "flag_meanings": " ".join(SKY_STATES)}


def states_of(probability: Floats) -> npt.NDArray[np.int8]:
    """Return the number of the likeliest of `SKY_STATES`; contradictory below `RULES.decided`."""
    state = probability.argmax(axis=1)
    return np.where(probability.max(axis=1) < RULES.decided, len(SKY_STATES) - 1, state).astype(np.int8)


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
    means /= sun_distance_factor(time)[:, None]
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
    """Return `SPLIT` for the lines of a flight line, from its own record; None without a record or a place.

    ``line`` has ``irradiance``, ``time``, ``latitude``, ``longitude`` and ``wavelength``. A line has the
    fraction interpolated between both samples around it, and the state of the nearer one; NaN, and
    contradictory, where it has no time. ``sun_zenith`` [degree] replaces the zenith angle from the clock.
    Lazy where the record or ``wavelength`` come from a file.
    """
    import dask
    import dask.array as da

    wanted = ("irradiance", "time", "latitude", "longitude", "wavelength")
    if not set(wanted) <= set(line.variables) or line.sizes.get(IRRADIANCE_TIME, 0) == 0:
        return None
    variables = schema.require(line, [*wanted, IRRADIANCE_TIME], "the split of irradiance")
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
    receiver = (*place, calibration_uncertainty, 101_325.0)
    split_of_record = dask.delayed(_split)(record.data, samples, channels, wavelength, receiver, sun_zenith)
    parts: list[list[Any]] = [[], [], []]
    for rows in np.split(variables["time"].values, _block_starts(line)):
        block = dask.delayed(_at_lines, nout=3)(split_of_record, samples, rows)
        shapes = ((rows.size, wavelength.size), (rows.size, wavelength.size), (rows.size,))
        for out, array, shape, dtype in zip(parts, block, shapes, ("f4", "f4", "i1"), strict=True):
            out.append(da.from_delayed(array, shape, dtype))
    columns = zip(SPLIT, ((ALONG_TRACK, BAND), (ALONG_TRACK, BAND), (ALONG_TRACK,)), parts, strict=True)
    split = xr.Dataset({name: (dims, da.concatenate(blocks)) for name, dims, blocks in columns})
    return split.assign({name: labelled(split[name]) for name in SPLIT})


def _block_starts(line: xr.Dataset) -> list[int]:
    # Return the first line of every block but the first; blocks are the chunks of the cube.
    for name in ("reflectance", "radiance", "counts"):
        if name in line.variables and line[name].chunks is not None:
            sizes = line[name].variable.chunksizes.get(ALONG_TRACK, ())
            return [int(start) for start in np.cumsum(sizes)[:-1]]
    return list(range(1024, line.sizes[ALONG_TRACK], 1024))


def _at_lines(
    split: tuple[Floats, Floats, Floats, Floats], samples: Array, time: Array
) -> tuple[Array, Array, Array]:
    # Interpolate fraction, uncertainty (line, band) and state (line,) from the samples around every line.
    fraction, u, probability, _ = split
    usable = np.flatnonzero(np.isfinite(fraction).any(axis=1))
    shape = (time.size, fraction.shape[1])
    state = np.full(time.size, len(SKY_STATES) - 1, np.int8)
    if not usable.size:
        return np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), state
    stamps, has_time = samples[usable].astype("datetime64[ns]"), ~np.isnat(time)
    # as nanoseconds after the first sample, so that no bit depends on the distance to 1970
    line_ns = np.where(has_time, time.astype("datetime64[ns]") - stamps[0], np.timedelta64(0, "ns")).astype(
        np.int64
    )
    sample_ns = (stamps - stamps[0]).astype(np.int64)
    after = np.clip(np.searchsorted(sample_ns, line_ns), 0, usable.size - 1)
    before = np.maximum(after - (line_ns < sample_ns[after]), 0)
    weight = np.clip(
        (line_ns - sample_ns[before]) / np.maximum(sample_ns[after] - sample_ns[before], 1), 0.0, 1.0
    )[:, None]
    rows = [
        np.where(
            has_time[:, None],
            (1.0 - weight) * values[usable[before]] + weight * values[usable[after]],
            np.nan,
        )
        for values in (fraction, u)
    ]
    nearer = usable[np.where(weight[:, 0] > 0.5, after, before)]
    state = np.where(has_time, states_of(probability)[nearer], state).astype(np.int8)
    return rows[0].astype(np.float32), rows[1].astype(np.float32), state
