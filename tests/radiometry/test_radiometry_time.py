"""Line and irradiance times: units, order, clocks, and records of their own."""

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.strategies import START, assert_same, flight, values

from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.counts_to_reflectance import reflectance


@pytest.mark.parametrize("line_unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("record_unit", ["s", "us", "ns"])
def test_mixed_units_of_time(line_unit: str, record_unit: str) -> None:
    made = flight(lines=4, bands=3, columns=2, drift=0.05)
    line = made.line
    # whole seconds, so that every unit can hold them
    seconds = np.array([1, 3, 9, 21])
    line = line.assign_coords(time=("along_track", START + seconds.astype("timedelta64[s]")))
    expected = values(line)
    mixed = line.assign_coords(
        time=("along_track", line.time.values.astype(f"datetime64[{line_unit}]")),
        irradiance_time=("irradiance_time", line.irradiance_time.values.astype(f"datetime64[{record_unit}]")),
    )
    np.testing.assert_array_equal(values(mixed), expected)
    light = 1.2 + 0.05 * seconds
    np.testing.assert_allclose(
        expected, made.reflectance * (made.irradiance / light)[:, None, None], rtol=1e-5
    )


def test_shuffled_lines_come_out_in_their_places() -> None:
    line = flight(lines=300, drift=0.05).line
    order = np.random.default_rng(1).permutation(300)
    got, expected = reflectance(line.isel(along_track=order)), reflectance(line).isel(along_track=order)
    assert_same(got, expected)


def test_records_that_run_backwards_or_stand_still_are_refused() -> None:
    line = flight().line
    orders = {"time-duplicate": [0, 1, 1, 2, 3, 4, 5, 6], "time-unordered": [0, 2, 1, 3, 4, 5, 6]}
    for code, order in orders.items():
        with pytest.raises(TimeError, match=code):
            reflectance(line.isel(irradiance_time=order))
    stamps = line.irradiance_time.values.copy()
    stamps[3] = np.datetime64("NaT", "ns")
    with pytest.raises(TimeError, match="time-missing"):
        reflectance(line.assign_coords(irradiance_time=("irradiance_time", stamps)))


def test_a_lazy_record_is_refused_when_it_is_read() -> None:
    line = flight().line.isel(irradiance_time=[0, 2, 1, 3, 4, 5, 6]).drop_indexes("irradiance_time")
    lazily = line.assign_coords(
        irradiance_time=("irradiance_time", da.from_array(line.irradiance_time.values))
    )
    with pytest.raises(TimeError, match="time-unordered"):
        reflectance(lazily).reflectance.compute()


def test_clocks_that_are_off() -> None:
    made = flight(drift=0.01)
    offset = np.timedelta64(37_250_000_000, "ns")
    wrong = made.line.assign_coords(irradiance_time=made.line.irradiance_time + offset)
    got = reflectance(wrong).compute()  # the record begins 27 s after the line
    assert np.isnan(got.reflectance.values).all()
    assert (got.quality.values == Quality.IRRADIANCE_GAP).all()
    np.testing.assert_array_equal(
        values(wrong.assign_coords(irradiance_time=wrong.irradiance_time - offset)), values(made.line)
    )
    hours = np.timedelta64(5 * 3600, "s")
    local = made.line.assign_coords(time=made.line.time - hours)
    assert np.isnan(values(local)).all()
    both = local.assign_coords(irradiance_time=local.irradiance_time - hours)
    np.testing.assert_array_equal(values(both), values(made.line))


def test_a_record_of_its_own_replaces_the_lines() -> None:
    made = flight()
    record = made.line[["irradiance", "irradiance_fwhm"]].assign_attrs(irradiance_srf_shape="gaussian")
    twice = record.assign(irradiance=record.irradiance * 2).isel(irradiance_time=slice(2, 9))
    twice["irradiance"].attrs = dict(record.irradiance.attrs)
    np.testing.assert_allclose(values(made.line, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    bare = made.line.drop_vars([n for n in made.line.variables if str(n).startswith("irradiance")])
    np.testing.assert_allclose(values(bare, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    with pytest.raises(SchemaError, match="holds light, expected"):
        reflectance(bare, xr.Dataset({"light": 1}))


def test_another_record_brings_its_own_gap_and_width() -> None:
    line = flight().line
    step = float(np.diff(line.irradiance_time.values)[0] / np.timedelta64(1, "s"))
    line = line.assign(irradiance_max_gap=((), 1.5 * step, {"units": "s"}))
    other = line[["irradiance", "irradiance_fwhm"]].isel(irradiance_time=slice(None, None, 2))
    assert (
        reflectance(line.isel(irradiance_time=slice(None, None, 2))).quality & Quality.IRRADIANCE_GAP
    ).any()
    assert not (reflectance(line, other).quality & Quality.IRRADIANCE_GAP).any()
    with pytest.raises(SchemaError, match="irradiance_fwhm"):
        reflectance(line, other.drop_vars("irradiance_fwhm"))
    with pytest.raises(SchemaError, match=r"DataArray.*type-wrong"):
        reflectance(line, other.irradiance)  # type: ignore[arg-type]


def test_one_spectrum_with_more_than_the_others_costs_nothing() -> None:
    line = flight().line
    spectra = np.repeat(line.irradiance.values, 5, axis=0)
    spectra[1:, -2:] = np.nan  # all but one end early
    when = line.irradiance_time.values[0] + np.arange(len(spectra)) * np.timedelta64(1, "s")
    record = xr.Dataset(
        {"irradiance": (line.irradiance.dims, spectra, {"units": "W m-2 nm-1"})},
        {"irradiance_time": when, "irradiance_wavelength": line.irradiance_wavelength},
    ).assign(irradiance_fwhm=line.irradiance_fwhm)
    assert not (reflectance(line, record).quality & Quality.IRRADIANCE_GAP).any()
