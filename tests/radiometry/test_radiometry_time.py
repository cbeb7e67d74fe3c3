"""Line and irradiance times: units, order, clocks, and records of their own."""

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors
from support.strategies import START, assert_same, flight, values

from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.counts_to_reflectance import reflectance


@pytest.mark.parametrize("line_unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("record_unit", ["s", "us", "ns"])
def test_mixed_units_of_time(line_unit: str, record_unit: str) -> None:
    made = flight(lines=4, bands=3, columns=2, drift=0.05)
    # whole seconds, so that every unit can hold them
    seconds = np.array([1, 3, 9, 21])
    line = made.line.assign_coords(time=("along_track", START + seconds.astype("timedelta64[s]")))
    mixed = line.assign_coords(
        time=("along_track", line.time.values.astype(f"datetime64[{line_unit}]")),
        irradiance_time=("irradiance_time", line.irradiance_time.values.astype(f"datetime64[{record_unit}]")),
    )
    np.testing.assert_array_equal(values(mixed), values(line))
    share = made.irradiance / (1.2 + 0.05 * seconds)
    np.testing.assert_allclose(values(line), made.reflectance * share[:, None, None], rtol=1e-5)


def test_shuffled_lines_come_out_in_their_places() -> None:
    line = flight(lines=300, drift=0.05).line
    order = np.random.default_rng(1).permutation(300)
    got, expected = reflectance(line.isel(along_track=order)), reflectance(line).isel(along_track=order)
    assert_same(got, expected)


def test_records_that_run_backwards_or_stand_still_are_refused() -> None:
    line = flight().line
    stamps = line.irradiance_time.values.copy()
    stamps[3] = np.datetime64("NaT", "ns")
    unordered = line.isel(irradiance_time=[0, 2, 1, 3, 4, 5, 6])
    bare = unordered.drop_indexes("irradiance_time")
    lazy = bare.assign_coords(irradiance_time=("irradiance_time", da.from_array(bare.irradiance_time.values)))
    for code, other in (
        ("time-duplicate", line.isel(irradiance_time=[0, 1, 1, 2, 3, 4, 5, 6])),
        ("time-unordered", unordered),
        ("time-unordered", lazy),
        ("time-missing", line.assign_coords(irradiance_time=("irradiance_time", stamps))),
    ):
        with pytest.raises(TimeError, match=code):
            reflectance(other).reflectance.compute()


def test_clocks_that_are_off() -> None:
    line, offset, hours = flight(drift=0.01).line, np.timedelta64(37_250, "ms"), np.timedelta64(5, "h")
    wrong = line.assign_coords(irradiance_time=line.irradiance_time + offset)
    got = reflectance(wrong).compute()  # the record begins 27 s after the line
    local = line.assign_coords(time=line.time - hours)
    assert np.isnan([got.reflectance.values, values(local)]).all()
    assert (got.quality.values == Quality.IRRADIANCE_GAP).all()
    for other, off in ((wrong, offset), (local, hours)):
        back = other.assign_coords(irradiance_time=other.irradiance_time - off)
        np.testing.assert_array_equal(values(back), values(line))


def test_a_record_of_its_own_replaces_the_lines() -> None:
    made = flight()
    record = made.line[["irradiance", "irradiance_fwhm"]].assign_attrs(irradiance_srf_shape="gaussian")
    light = (record.irradiance * 2).assign_attrs(record.irradiance.attrs)
    twice = record.assign(irradiance=light).isel(irradiance_time=slice(2, 9))
    bare = made.line.drop_vars([n for n in made.line.variables if str(n).startswith("irradiance")])
    for line in (made.line, bare):
        np.testing.assert_allclose(values(line, irradiance=twice), made.reflectance / 2, rtol=1e-5)
    with pytest.raises(SchemaError, match="holds light, expected"):
        reflectance(bare, xr.Dataset({"light": 1}))


def test_another_record_brings_its_own_gap_and_width() -> None:
    line = flight().line
    step = float(np.diff(line.irradiance_time.values)[0] / np.timedelta64(1, "s"))
    line = line.assign(irradiance_max_gap=((), 1.5 * step, {"units": "s"}))
    half = line.isel(irradiance_time=slice(None, None, 2))
    other = half[["irradiance", "irradiance_fwhm"]]
    assert [
        bool((made.quality & Quality.IRRADIANCE_GAP).any())
        for made in (reflectance(half), reflectance(line, other))
    ] == [True, False]
    expect_errors(
        (SchemaError, "irradiance_fwhm", lambda: reflectance(line, other.drop_vars("irradiance_fwhm"))),
        (SchemaError, r"DataArray.*type-wrong", lambda: reflectance(line, other.irradiance)),
    )


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
