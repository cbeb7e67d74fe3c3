"""Irradiance that is no daylight, not that of its place and time, or lacks channels."""

import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.planning import check_light, light_level


def _line(factor: float = 1.0, *, position: bool = True, hours: int = 0) -> xr.Dataset:
    # A line with a clear sky's level over it, times a factor, all stamps late by some hours
    line = flight(lines=4, position=position).line
    delay = np.timedelta64(hours, "h")
    times = {name: (line[name].dims, line[name].values + delay) for name in ("time", "irradiance_time")}
    line = line.assign_coords(times)
    return line.assign(irradiance=line.irradiance.copy(data=line.irradiance.values * np.float32(factor)))


@pytest.mark.parametrize("position", [True, False])
@pytest.mark.parametrize("factor", [0.2, 0.5, 1.0, 1.4])
def test_daylight_passes_without_a_word(factor: float, position: bool) -> None:
    reflectance(_line(factor, position=position)).reflectance.compute()


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1e-6, "declared in uW m-2 nm-1"), (1e-4, "values in W cm-2 nm-1 that are taken"), (10.0, "mW cm-2"),
     (100.0, "values in uW cm-2 nm-1 that are taken"), (1e3, r"mW m-2 nm-1 \(W m-2 um-1\) that are taken")],
)  # fmt: skip
def test_what_no_daylight_is_is_refused_with_the_unit(factor: float, unit: str) -> None:
    # Rationale: a millionth of the sun gave a reflectance of 203, and no flag
    lazily = reflectance(_line(factor))
    with pytest.raises(SchemaError, match=rf"{unit}.*irradiance-level"):
        lazily.reflectance.compute()


@pytest.mark.parametrize(
    ("options", "words"),
    [({"factor": 1e-2}, "declared in uW cm-2 nm-1"), ({"factor": 1e-3}, "declared in mW m-2 nm-1"),
     ({"factor": 2.2}, ""), ({"factor": 1e-2, "position": False}, r"0\.02 "), ({"hours": 12}, "local time")],
    ids=["uW", "mW", "too bright", "without a place", "noon by night"],
)  # fmt: skip
def test_what_a_clear_sky_contradicts_is_warned_of(options: dict[str, Any], words: str) -> None:
    lazily = reflectance(_line(**options))
    with pytest.warns(PaintWarning, match=rf"{words}.*irradiance-level"):
        lazily.reflectance.compute()


def test_a_channel_that_is_undefined_is_said_with_the_bands_it_costs() -> None:
    # Rationale: two of twelve bands had no reflectance, no flag and no word
    line = _line()
    record = line.irradiance.copy(deep=True)
    record[:, 150] = np.nan
    lazily = reflectance(line.assign(irradiance=record))
    with pytest.warns(PaintWarning, match=r"1 channels.* 550 nm: 2 of 12.*irradiance-gaps"):
        lost = np.isnan(lazily.reflectance.values).all(axis=(0, 2))
    assert np.flatnonzero(lost).tolist() == [2, 3]
    # a sample without any channel is a gap and no lost band
    record = line.irradiance.copy(deep=True)
    record[0] = np.nan
    reflectance(line.assign(irradiance=record)).reflectance.compute()


@pytest.mark.parametrize(
    ("zenith", "median", "is_doubtful"),
    [(60.0, 0.02, False), (60.0, 0.011, True), (60.0, 1.5, False), (60.0, 2.2, True), (83.0, 0.25, False),
     (83.0, 0.4, True)],
)  # fmt: skip
def test_limits_of_the_level(zenith: float, median: float, is_doubtful: bool) -> None:
    # relative to a clear sky, or for a sun lower than 80 degrees from the zenith in W m-2 nm-1
    morning = np.datetime64("2024-04-03T06:00", "ns") + np.arange(0, 21600, 20).astype("timedelta64[s]")
    stamp = morning[[np.abs(solar_position(morning, 0.0, 0.0)[0] - zenith).argmin()]]
    place, channels = {"latitude": 0.0, "longitude": 0.0}, np.arange(400.0, 1001.0)
    clear = light_level(place, np.ones((1, channels.size)), channels, stamp).clear if zenith < 80.0 else 1.0
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        check_light(place, np.full((1, channels.size), median * clear), channels, stamp)
    assert [w.message.code for w in noted] == ["irradiance-level"] * is_doubtful
