import datetime as dt

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr
from support.refusals import expect_errors, expect_refusals, refusal

from hyperpaint.base.errors import (
    FormatError,
    IncompleteStoreError,
    PaintWarning,
    SchemaError,
    TimeError,
    UnitsError,
)
from hyperpaint.io.spectrometers.irradiance import open_irradiance, read_irradiance_csv
from hyperpaint.io.store import to_store

GRID = np.arange(350.0, 1051.0)
LAMP, LAMP_COUNTS = 0.2 + GRID * 1e-4, 4000.0 + GRID
BLOCKS = {2: (0, LAMP), 3: (136, LAMP_COUNTS)}
SKY = 0.8 + 0.1 * np.sin(GRID / 50.0)
NOON = dt.datetime(2024, 5, 21, 12)
COUNTS = SKY * LAMP_COUNTS / LAMP  # at the integration time of the calibration


def utc(*texts):
    return np.array(texts, "datetime64[ns]")


@pytest.fixture
def log(write_asd):
    # Return a function that writes a series of .asd files, one a given second after noon
    def write(*seconds, prefix="sky", **fields):
        fields = {"data_type": 4, "blocks": BLOCKS, **fields}
        return [
            write_asd(
                f"{prefix}{i:05d}.asd", COUNTS * (1 + i / 100), local=NOON + dt.timedelta(seconds=s), **fields
            )
            for i, s in enumerate(seconds)
        ]

    return write


def sky(times, **coords):
    values = np.linspace(0.5, 0.9, len(times) * 3).reshape(-1, 3)
    coords = {
        "time": np.asarray(times),
        "wavelength": ("wavelength", [500.0, 600.0, 700.0], {"units": "nm"}),
        **coords,
    }
    return xr.DataArray(
        values, coords, ("time", "wavelength"), name="irradiance", attrs={"units": "W m-2 nm-1"}
    )


# --- real files


@pytest.mark.real_data
def test_the_real_skyward_exports_make_a_series(shared_data):
    folder = shared_data / "asd_ascii"
    # the later one first
    series = open_irradiance(
        [folder / "asd-e-irrad-sky.csv", folder / "asd-e-irrad-sky.tsv"], "irradiance", utc_offset_h=3
    )
    expected = utc("2024-05-21T08:33:06.932", "2024-05-21T08:33:12.932")  # the middle of 136 ms
    np.testing.assert_array_equal(series["irradiance_time"].values, expected)
    assert (series["irradiance_time"].dtype, series["irradiance"].dims, series["irradiance"].dtype) == (
        np.dtype("datetime64[ns]"),
        ("irradiance_time", "irradiance_wavelength"),
        np.float32,
    )
    np.testing.assert_allclose(
        series["irradiance"].sel(irradiance_wavelength=550).values,
        [0.890753970640618, 0.890642958711871],
        rtol=1e-7,
    )
    np.testing.assert_allclose(
        series["irradiance"].sel(irradiance_wavelength=slice(400, 1000)).integrate("irradiance_wavelength"),
        [391.381, 391.411],
        atol=6e-4,
    )
    # those of the detectors: 3 nm of the first, which a camera up to 1000 nm sees
    assert (series["irradiance_fwhm"].sel(irradiance_wavelength=slice(350, 1000)) == 3.0).all()
    assert (series["irradiance_fwhm"].sel(irradiance_wavelength=slice(1001, 2500)) == 10.0).all()
    assert "other detectors" in series.attrs["irradiance_fwhm_source"]
    assert (series["irradiance_max_gap"], series.attrs["irradiance_srf_shape"]) == (15.0, "gaussian")
    assert "assumed" in series.attrs["irradiance_fwhm_source"]
    assert "assumed" in series.attrs["irradiance_units_source"]


@pytest.mark.real_data
def test_real_exports_need_a_zone_and_a_quantity(shared_data):
    files = str(shared_data / "asd_ascii" / "asd-e-irrad-sky.*")
    expect_errors((TimeError, "utc_offset_h=", lambda: open_irradiance(files, "irradiance")))
    with pytest.warns(PaintWarning, match="quantity-assumed"):
        guessed = open_irradiance(files, utc_offset_h=3)
    xr.testing.assert_identical(guessed, open_irradiance(files, "irradiance", utc_offset_h=3))
    soil = shared_data / "asd_ascii" / "asd-Rfr-soil.tsv"
    with (
        pytest.warns(PaintWarning, match="quantity-assumed"),
        pytest.raises(FormatError, match="quantity-wrong"),
    ):
        open_irradiance(soil, utc_offset_h=3)


# --- binaries


def test_binaries_through_their_calibration(log):
    series = open_irradiance(log(0, 2, 4, averages=10), utc_offset_h=0)
    np.testing.assert_allclose(
        series["irradiance"].values, SKY[:651] * np.array([[1.0], [1.01], [1.02]]), rtol=1e-6
    )
    np.testing.assert_array_equal(series["irradiance_wavelength"].values, GRID[:651])
    middles = utc(
        "2024-05-21T11:59:59.32", "2024-05-21T12:00:01.32", "2024-05-21T12:00:03.32"
    )  # 1.36 s windows
    np.testing.assert_array_equal(series["irradiance_time"].values, middles)
    assert series["irradiance_max_gap"] == 5.0
    assert series["irradiance_max_gap"].dtype == series["irradiance_fwhm"].dtype == np.float64
    assert series["irradiance"].attrs["units"] == "W m-2 nm-1"
    assert "irradiance_units_source" not in series.attrs


@pytest.mark.parametrize(
    ("options", "second"),
    [
        ({"stamp": "start"}, 0.068),
        ({"stamp": "mid"}, 0.0),
        ({"stamp": "end"}, -0.068),
        ({"averaging_s": 2.0}, -1.0),
    ],
)
def test_stamps_move_to_the_middle(log, options, second):
    elapsed = (
        open_irradiance(log(1, 2), utc_offset_h=0, **options)["irradiance_time"].values[0]
        - np.datetime64("2024-05-21T12:00:01", "ns")
    ) / np.timedelta64(1, "s")
    assert elapsed == pytest.approx(second)


def test_a_logging_pc_five_hours_off(log):
    # The zone comes from the white reference; a wrong clock on top of it from the user
    files = log(0, 2, reference=COUNTS, reference_epoch=1716300000, utc_offset_h=-5.0)
    series = open_irradiance(files, stamp="mid", clock_offset_s=37.25)
    np.testing.assert_array_equal(
        series["irradiance_time"].values, utc("2024-05-21T17:00:37.25", "2024-05-21T17:00:39.25")
    )
    assert (series.attrs["irradiance_utc_offset_h"], series.attrs["irradiance_clock_offset_s"]) == (
        [-5.0],
        37.25,
    )
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        series = open_irradiance(files, stamp="mid", utc_offset_h=2)
    assert series["irradiance_time"].values[0] == np.datetime64("2024-05-21T10:00", "ns")


def test_files_that_say_nothing_take_the_zone_of_those_that_do(log):
    files = log(0, 2) + log(4, prefix="w", reference=COUNTS, reference_epoch=1716300000, utc_offset_h=1.0)
    assert open_irradiance(files, stamp="mid")["irradiance_time"].values[0] == np.datetime64(
        "2024-05-21T11:00", "ns"
    )
    files += log(6, prefix="v", reference=COUNTS, reference_epoch=1716300000, utc_offset_h=2.0)
    expect_refusals(
        (TimeError, "utc-offset-conflict", "w00000.asd", "v00000.asd", lambda: open_irradiance(files))
    )
    expect_errors((TimeError, "utc_offset_h=", lambda: open_irradiance(files[:2])))


def test_shuffled_files_come_out_sorted_and_duplicates_are_refused(log, tmp_path):
    seconds = [8, 2, 6, 0, 4]
    series = open_irradiance(log(*seconds), utc_offset_h=0, stamp="mid")
    np.testing.assert_array_equal(
        (series["irradiance_time"].values - np.datetime64(NOON, "ns")) / np.timedelta64(1, "s"),
        sorted(seconds),
    )
    np.testing.assert_allclose(
        series["irradiance"].values[:, 0] / series["irradiance"].values[1, 0],
        np.array([1.03, 1.01, 1.04, 1.02, 1.0]) / 1.01,
        rtol=1e-6,
    )
    files = log(0, 2, 2)
    (tmp_path / "copy.asd").write_bytes(files[0].read_bytes())
    with pytest.raises(TimeError) as raised:
        open_irradiance([*files, tmp_path / "copy.asd"], utc_offset_h=0)
    assert "sky00001.asd and sky00002.asd" in str(raised.value)
    assert "sky00000.asd and copy.asd (the same spectrum twice)" in str(raised.value)


def test_saturated_and_empty_samples_become_nan(log, write_asd):
    files = log(0, 2, 4) + log(6, prefix="bright", saturation=1)
    files.append(write_asd("dead.asd", COUNTS * 0, local=NOON + dt.timedelta(seconds=8), blocks=BLOCKS))
    with pytest.warns(PaintWarning) as found:
        series = open_irradiance(files, utc_offset_h=0)
    saturated, empty = sorted(str(warning.message) for warning in found)
    assert (
        "saturated" in saturated,
        "bright00000.asd" in saturated,
        "zero throughout" in empty,
        "dead.asd" in empty,
    ) == (True, True, True, True)
    np.testing.assert_array_equal(
        np.isnan(series["irradiance"]).all("irradiance_wavelength"), [False, False, False, True, True]
    )


def test_raw_counts_with_calibration_files(log, write_asd):
    files = log(0, 2, blocks={}, data_type=0)
    expect_refusals(
        (
            FormatError,
            "calibration-missing",
            "sky00000.asd",
            "sky00001.asd",
            lambda: open_irradiance(files, utc_offset_h=0),
        )
    )
    series = open_irradiance(
        files,
        utc_offset_h=0,
        calibration={"lamp": write_asd("c/a.ill", LAMP), "fore_optic": write_asd("c/a.raw", LAMP_COUNTS)},
    )
    np.testing.assert_allclose(series["irradiance"].values[0], SKY[:651], rtol=1e-6)


def test_a_folder_prefers_binaries_and_a_single_sample_needs_a_gap(log, tmp_path):
    files = log(0, 2)
    (tmp_path / "sky00000.asd.txt").write_text("Wavelength;sky00000.asd\n350;1\n")
    assert open_irradiance(tmp_path, utc_offset_h=0).sizes["irradiance_time"] == 2
    expect_errors((TimeError, "max_gap_s=", lambda: open_irradiance(files[:1], utc_offset_h=0)))
    assert open_irradiance(files[:1], utc_offset_h=0, max_gap_s=5)["irradiance_max_gap"] == 5.0
    (tmp_path / "sky.csv").write_text(CSV.format(z="Z"))
    expect_errors((FormatError, "formats-mixed", lambda: open_irradiance([files[0], tmp_path / "sky.csv"])))
    text = tmp_path / "only" / "a.txt"
    text.parent.mkdir()
    text.write_text("Wavelength;a.asd\n500;0.8\n501;0.8\n")
    expect_errors(
        (
            TimeError,
            r"a\.txt.*time-missing",
            lambda: open_irradiance(text.parent, "irradiance", utc_offset_h=0),
        )
    )


def test_all_wrong_arguments_at_once():
    wrong = {"stamp": "begin", "fwhm_nm": 0, "max_gap_s": -1, "averaging_s": -1, "clock_offset_s": np.nan}
    with pytest.raises(SchemaError) as raised:
        open_irradiance("x", quantity="radiance", **wrong)
    assert [name for name in ("quantity", *wrong) if f"{name}=" not in str(raised.value)] == []


# --- units


@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        (1e6, "uW m-2 nm-1"),
        (1e3, "mW m-2 nm-1"),
        (100.0, "uW cm-2 nm-1"),
        (1e-4, "W cm-2 nm-1"),
        (1e-6, "W mm-2 nm-1"),
    ],
)
def test_impossible_light_is_refused(log, factor, unit):
    # E in mW, uW, uW cm-2, W cm-2 or W mm-2 that is said to be W m-2 nm-1
    files = log(0, 2, blocks={2: (0, LAMP * factor), 3: (136, LAMP_COUNTS)})
    # W mm-2 is as likely as others
    named = "irradiance-implausible" if factor == 1e-6 else f"values in {unit} .*taken for W m-2 nm-1"
    expect_errors((UnitsError, named, lambda: open_irradiance(files, utc_offset_h=0)))
    np.testing.assert_allclose(
        open_irradiance(files, utc_offset_h=0, units=unit)["irradiance"].values[0], SKY[:651], rtol=1e-6
    )
    expect_errors(
        (
            UnitsError,
            "W m-2 sr-1 nm-1",
            lambda: open_irradiance(files, utc_offset_h=0, units="W m-2 sr-1 nm-1"),
        )
    )


# --- csv

CSV = """# units: mW m-2 nm-1
# fwhm_nm: 2.5
time,500,600
2024-05-21T12:00:02{z},900,800
2024-05-21T12:00:00{z},890,
"""


def test_csv_series(tmp_path):
    (tmp_path / "sky.csv").write_text(CSV.format(z="+03:00"))
    with pytest.warns(PaintWarning, match=r"not finite.*sky\.csv:5"):
        series = open_irradiance(tmp_path / "sky.csv")
    np.testing.assert_array_equal(
        series["irradiance_time"].values, utc("2024-05-21T09:00", "2024-05-21T09:00:02")
    )
    np.testing.assert_allclose(series["irradiance"].values, [[0.89, np.nan], [0.9, 0.8]], rtol=1e-6)
    assert (series["irradiance_fwhm"], series["irradiance"].dtype) == (2.5, np.float32)
    # stamps may each have their zone
    (tmp_path / "sky.csv").write_text(
        "# units: W m-2 nm-1\n# fwhm_nm: 3\ntime,500\n"
        + "2024-05-21T12:00:02+03:00,0.9\n2024-05-21T09:00:00Z,0.8\n"
    )
    series = open_irradiance(tmp_path / "sky.csv")
    np.testing.assert_allclose(series["irradiance"].values[:, 0], [0.8, 0.9], rtol=1e-6)
    assert series["irradiance_max_gap"] == 5.0


def test_csv_needs_zone_units_and_width(tmp_path):
    path = tmp_path / "sky.csv"
    path.write_text(CSV.format(z="").replace("890,", "890,790"))
    expect_errors((TimeError, "utc_offset_h=", lambda: open_irradiance(path)))
    assert open_irradiance(path, utc_offset_h=-5)["irradiance_time"].values[0] == utc("2024-05-21T17:00")[0]
    path.write_text("time,500,600\n2024-05-21T12:00:02Z,0.9,0.8\n2024-05-21T12:00:00Z,0.9,0.8\n")
    expect_refusals(
        (UnitsError, "units-missing", "units=", lambda: open_irradiance(path)),
        (SchemaError, "fwhm-missing", "fwhm_nm=", lambda: open_irradiance(path, units="W m-2 nm-1")),
    )
    assert open_irradiance(path, units="W m-2 nm-1", fwhm_nm=3)["irradiance_fwhm"] == 3.0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no header"),
        ("time,600,500\n", "header-unreadable"),
        ("time,nan\n", "header-unreadable"),
        ("time,a\n", "header is ..*header-unreadable"),
        ("time,500\n", "no rows"),
        ("time,500\nnoon,1\n", "line 2.*row-unreadable"),
        ("time,500\n2024-05-21T12:00:00Z,1,2\n", "2 values"),
        ("time,500\n0001-01-01,1\n", "outside 1970 to 2199"),
        ("time,500\n2024-05-21T12:00:00Z,1\n2024-05-21T12:00:01,1\n", "zone-missing"),
        ("# fwhm_nm: three\ntime,500\n2024-05-21T12:00:00Z,1\n", "fwhm_nm: three"),
    ],
)
def test_damaged_csv(tmp_path, text, problem):
    (tmp_path / "sky.csv").write_text(text)
    expect_errors((FormatError, problem, lambda: read_irradiance_csv(tmp_path / "sky.csv")))


# --- xarray and its stores


@pytest.mark.parametrize("resolution", ["s", "ms", "us", "ns"])
def test_every_time_resolution_comes_out_in_nanoseconds(resolution):
    data = sky(np.array(["2024-05-21T12:00:04", "2024-05-21T12:00:00"], f"datetime64[{resolution}]"))
    series = open_irradiance(data, fwhm_nm=3)
    assert series["irradiance_time"].dtype == np.dtype("datetime64[ns]")
    np.testing.assert_array_equal(
        series["irradiance_time"].values, utc("2024-05-21T12:00", "2024-05-21T12:00:04")
    )
    np.testing.assert_array_equal(series["irradiance"].values, data.values[::-1].astype(np.float32))


def test_units_and_width_of_an_xarray_series():
    data = sky(utc("2024-05-21T12:00", "2024-05-21T12:01")) * 1000
    data.attrs["units"] = "mW m-2 nm-1"
    width = xr.DataArray([0.003, 0.004, 0.005], dims="wavelength", attrs={"units": "um"})
    series = open_irradiance(data.to_dataset().assign(irradiance_fwhm=width))
    np.testing.assert_allclose(series["irradiance_fwhm"].values, [3, 4, 5])
    np.testing.assert_allclose(series["irradiance"].values, data.values / 1000, rtol=1e-6)
    # a width that depends on wavelength
    series = open_irradiance(data, fwhm_nm=[[400, 4.0], [600, 3.0], [601, 10.0]])
    np.testing.assert_allclose(series.irradiance_fwhm, [3.5, 3.0, 10.0])
    assert series.irradiance_fwhm.dims == ("irradiance_wavelength",)


@pytest.mark.parametrize(
    ("change", "options", "error", "told"),
    [
        (lambda data: data.to_dataset(name="radiance"), {}, SchemaError, ("variable-missing",)),
        (lambda data: data.rename(time="when"), {}, SchemaError, ("dims-wrong",)),
        (lambda data: data.assign_coords(time=[1.0, 2.0]), {}, TimeError, ("type-wrong", "datetime64")),
        (lambda data: data, {"utc_offset_h": -18000}, TimeError,
         ("value-out-of-range", "utc_offset_h=", "hours")),
        (lambda data: data.isel(wavelength=[2, 1, 0]), {}, SchemaError, ("wavelength-unordered",)),
        (lambda data: data.isel(time=[0, 0]), {}, TimeError, ("time-duplicate",)),
        (lambda data: data.drop_attrs(deep=False), {}, UnitsError, ("units-missing",)),
        (lambda data: data, {"units": "mW m-2 nm-1"}, UnitsError, ("units-conflict",)),
        (lambda data: data, {"fwhm_nm": None}, SchemaError, ("fwhm-missing", "fwhm_nm=")),
        *((lambda data: data, {"fwhm_nm": wrong}, SchemaError, ("value-out-of-range",))
          for wrong in ([[700, 3.0], [400, 3.0]], [[400, -1.0]], [3.0, 4.0], [[400, 3.0], [500]])),
    ],
)  # fmt: skip
def test_what_is_no_series_is_refused(change, options, error, told):
    data = sky(utc("2024-05-21T12:00", "2024-05-21T12:01"))
    with refusal(error, *told):
        open_irradiance(change(data), **{"fwhm_nm": 3, **options})


@pytest.mark.parametrize(("name", "group"), [("s.zarr", None), ("s.zarr", "irradiance"), ("s.nc", None)])
def test_store_round_trip(log, tmp_path, name, group):
    series = open_irradiance(log(0, 2, 4), utc_offset_h=1)
    if name.endswith(".nc"):
        series.to_netcdf(tmp_path / name, engine="h5netcdf")
    else:
        plain_zarr(series, tmp_path / name, group)
    again = open_irradiance(tmp_path / name)
    for name in ("irradiance", "irradiance_fwhm", "irradiance_max_gap"):
        xr.testing.assert_identical(again[name].drop_encoding(), series[name])
    assert again.attrs["irradiance_fwhm_source"] == "given by the data"


def test_an_unfinished_group_of_a_collect_is_refused(log, tmp_path):
    series = open_irradiance(log(0, 2, 4), utc_offset_h=1)
    to_store(series, tmp_path / "lot.zarr", group="irradiance")
    again = open_irradiance(tmp_path / "lot.zarr")
    np.testing.assert_array_equal(again["irradiance"].values, series["irradiance"].values)
    np.testing.assert_array_equal(again["irradiance_time"].values, series["irradiance_time"].values)
    (tmp_path / "lot.zarr/irradiance/irradiance/c/0/0").unlink()
    expect_errors((IncompleteStoreError, "1 of 1 chunks", lambda: open_irradiance(tmp_path / "lot.zarr")))


def test_a_damaged_store_is_named(tmp_path):
    (tmp_path / "sky.zarr").mkdir()
    (tmp_path / "sky.zarr" / "zarr.json").write_text("{")
    expect_refusals(
        (FormatError, "file-unreadable", lambda: open_irradiance(tmp_path / "sky.zarr")),
        (FormatError, "file-unreadable", "gone.zarr", lambda: open_irradiance(tmp_path / "gone.zarr")),
    )
