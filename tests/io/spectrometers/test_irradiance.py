import contextlib
import datetime as dt
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from campaigns.faults.seed_files import RADCAL
from hypothesis import given, strategies as st
from support import ROOT
from support.codecs import plain_zarr
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words, refusal

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import (
    FormatError,
    IncompleteStoreError,
    PaintError,
    PaintWarning,
    SchemaError,
    TimeError,
    UnitsError,
)
from hyperpaint.io.spectrometers.asd import EXPORTS
from hyperpaint.io.spectrometers.irradiance import open_irradiance, read_irradiance_csv
from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.io.spectrometers.spectrum_texts import (
    DIALECTS,
    FORMS,
    find_paths,
    for_all,
    name_spectra,
    read_spectrum_text,
    same_grids,
)
from hyperpaint.io.store import to_store
from hyperpaint.light.clear_sky import ClearSky

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
    assert series["irradiance_time"].dtype == np.dtype("datetime64[ns]")
    assert series["irradiance"].dims == ("irradiance_time", "irradiance_wavelength")
    assert series["irradiance"].dtype == np.float32
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
    assert series.attrs["irradiance_utc_offset_h"] == [-5.0]
    assert series.attrs["irradiance_clock_offset_s"] == 37.25
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
    raised = expect_error(
        TimeError, None, lambda: open_irradiance([*files, tmp_path / "copy.asd"], utc_offset_h=0)
    )
    expect_words(
        str(raised),
        "sky00001.asd and sky00002.asd",
        "sky00000.asd and copy.asd (the same spectrum twice)",
    )


def test_saturated_and_empty_samples_become_nan(log, write_asd):
    files = log(0, 2, 4) + log(6, prefix="bright", saturation=1)
    files.append(write_asd("dead.asd", COUNTS * 0, local=NOON + dt.timedelta(seconds=8), blocks=BLOCKS))
    with pytest.warns(PaintWarning) as found:
        series = open_irradiance(files, utc_offset_h=0)
    saturated, empty = sorted(str(warning.message) for warning in found)
    assert ("saturated" in saturated, "bright00000.asd" in saturated) == (True, True)
    assert ("zero throughout" in empty, "dead.asd" in empty) == (True, True)
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


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"fore_optic": 8}, "8 degree"),
        ({"fore_optic": 25}, "25 degree"),
        ({"fore_optic": 1}, "1 degree"),
        ({"data_type": 2}, "radiance"),
        ({"fore_optic": 0, "data_type": 2}, "radiance"),
    ],
)
def test_a_fore_optic_that_is_no_cosine_receptor_is_refused_or_said(fields, word, log):
    files = log(0, 2, **fields)
    expect_refusals((FormatError, "fore-optic-wrong", word, lambda: open_irradiance(files, utc_offset_h=0)))
    with pytest.warns(PaintWarning, match="fore-optic-wrong"):
        open_irradiance(files, utc_offset_h=0, quantity="irradiance")


def test_a_text_without_a_cosine_receptor_is_refused(tmp_path):
    head = "Spectrum saved: 05/21/2024 at 11:33:13\nymin= 0 ymax= 2.5\nThere was {} attached\n"
    path = tmp_path / "sky.txt"
    for optic, is_right in (("a remote cosine receptor", True), ("no foreoptic", False)):
        path.write_text(head.format(optic) + "Wavelength;a.asd\n500;0.8\n501;0.8\n")
        with refusal(FormatError, "fore-optic-wrong") if not is_right else warnings.catch_warnings():
            warnings.simplefilter("ignore")
            open_irradiance(path, utc_offset_h=0, max_gap_s=5)


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
    raised = expect_error(SchemaError, None, lambda: open_irradiance("x", quantity="radiance", **wrong))
    assert [name for name in ("quantity", *wrong) if f"{name}=" not in str(raised)] == []


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


def test_the_clock_of_the_pc_against_the_gps(log):
    # 12:00:00 of a clock two hours east of UTC, and 9:57:39 by the GPS
    gps = struct.pack("<5dhbbbbbh5sbb", 0, 0, 4815.0, -1142.0, 12.0, 1, 0, 39, 57, 9, 0, 0, b"", 0, 0)
    files = log(0, 2, gps=gps)
    with pytest.warns(PaintWarning, match=r"clock_offset_s=-142.*clock-conflict"):
        open_irradiance(files, utc_offset_h=2)
    open_irradiance(files, utc_offset_h=2, clock_offset_s=-142.0)


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


@pytest.mark.parametrize(
    ("change", "encoding"),
    [
        (lambda text: text.replace("mW m-2 nm-1", "mW/m²/nm"), "cp1252"),
        (lambda text: text.replace(",", "\t"), "utf-16"),
        (lambda text: "sep=;\n" + text.replace(",", ";").replace("2.5", "2.5;;"), "utf-8"),
        (lambda text: text.replace("T12", " 12").replace("Z", " UTC"), "utf-8"),
        (lambda text: text.replace("time", ""), "utf-8"),
        (lambda text: text.replace("time", ",time").replace("2024-05", "7,2024-05"), "utf-8"),
    ],
)  # fmt: skip
def test_csv_as_spreadsheets_and_pandas_write_it(
    change: Callable[[str], str], encoding: str, tmp_path: Path
) -> None:
    (tmp_path / "sky.csv").write_bytes(change(CSV.format(z="Z")).encode(encoding))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the little light
        opened = open_irradiance(tmp_path / "sky.csv")
    assert opened["irradiance_time"].values[0] == np.datetime64("2024-05-21T12:00:00", "ns")
    assert opened["irradiance_fwhm"] == 2.5


def test_csv_needs_zone_units_and_width(tmp_path):
    path = write_file(tmp_path / "sky.csv", CSV.format(z="").replace("890,", "890,790"))
    expect_errors((TimeError, "utc_offset_h=", lambda: open_irradiance(path)))
    assert open_irradiance(path, utc_offset_h=-5)["irradiance_time"].values[0] == utc("2024-05-21T17:00")[0]
    path.write_text("time,500,600\n2024-05-21T12:00:02Z,0.9,0.8\n2024-05-21T12:00:00Z,0.9,0.8\n")
    expect_refusals(
        (UnitsError, "units-missing", "units=", lambda: open_irradiance(path)),
        (SchemaError, "fwhm-missing", "fwhm_nm=", lambda: open_irradiance(path, units="W m-2 nm-1")),
    )
    assert open_irradiance(path, units="W m-2 nm-1", fwhm_nm=3)["irradiance_fwhm"] == 3.0
    path.write_text(CSV.format(z="Z"))
    other = {"units": "uW cm-2 nm-1"}
    expect_refusals((UnitsError, "units-conflict", "units=", lambda: open_irradiance(path, **other)))


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("time,500,600,", "{},1,2,"),
        ("time,600,500", "{},2,1"),
        ("time,E_500,E_600", "{},1,2"),
        ("time,500,600\nUTC,W m-2 nm-1,W m-2 nm-1", "{},1,2"),
        ("time;500;600\nUTC;W/(m^2 nm);W/(m^2 nm)", "{};1,0;2"),
    ],
)
def test_csv_of_other_loggers(tmp_path: Path, head: str, row: str) -> None:
    (tmp_path / "sky.csv").write_text(f"{head}\n{row.format('2024-05-21T12:00:00Z')}\n")
    table = read_irradiance_csv(tmp_path / "sky.csv")
    assert (table.wavelength.tolist(), table.values.tolist()) == ([500.0, 600.0], [[1.0, 2.0]])
    assert (table.units is not None) == ("UTC" in head)


def test_a_temperature_beside_the_time_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "sky.csv").write_text("time,temp,500,600\n2024-05-21T12:00:00Z,25.3,1,2\n")
    with pytest.warns(PaintWarning, match="temp.*column-unknown"):
        assert read_irradiance_csv(tmp_path / "sky.csv").values.tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no header"),
        ("time,600,500,550\n", "header-unreadable"),
        ("time,nan\n", "header-unreadable"),
        ("time,a\n", "header is ..*header-unreadable"),
        ("time,500\n", "no rows"),
        ("time,500\nnoon,1\n", "line 2.*row-unreadable"),
        ("time,500\n2024-05-21T12:00:00Z,1,2\n", "2 values"),
        ("time,500\n0001-01-01,1\n", "outside 1970 to 2199"),
        ("time,500\n2024-05-21T12:00:00Z,1\n2024-05-21T12:00:01,1\n", "zone-missing"),
        ("# fwhm_nm: three\ntime,500\n2024-05-21T12:00:00Z,1\n", "fwhm_nm: three"),
        ("# units: W m-2 nm-1\n# units: mW m-2 nm-1\ntime,500\n", "key-repeated"),
        ("# quantity: upwelling irradiance\ntime,500\n2024-05-21T12:00:00Z,1\n", "quantity-wrong"),
        ("# quantity: radiance\ntime,500\n2024-05-21T12:00:00Z,1\n", "quantity-wrong"),
    ],
)
def test_damaged_csv(tmp_path, text, problem):
    (tmp_path / "sky.csv").write_text(text)
    expect_errors((FormatError, problem, lambda: read_irradiance_csv(tmp_path / "sky.csv")))


@pytest.mark.parametrize(
    ("heading", "stamp", "expected"),
    [
        ("Time (UTC)", "2024-06-01 12:00:00", "12:00:00+00:00"),
        ("utc", "2024-06-01 12:00:00", "12:00:00+00:00"),
        ("Time (GMT)", "2024-06-01 12:00:00", "12:00:00+00:00"),
        ("Time (UTC-5)", "2024-06-01 12:00:00", "12:00:00-05:00"),
        ("local time (UTC+2)", "2024-06-01 12:00:00", "12:00:00+02:00"),
        ("Time (GMT+2)", "2024-06-01 12:00:00", "12:00:00+02:00"),
        ("timestamp [UTC+05:30]", "2024-06-01 12:00:00", "12:00:00+05:30"),
        ("Time (not UTC)", "2024-06-01 12:00:00", "12:00:00"),
        ("Time (UTC+99)", "2024-06-01 12:00:00", "12:00:00"),
        ("gps_time", "2024-06-01 12:00:00", "11:59:42+00:00"),
        ("gps_time", "1401278400", "11:59:42+00:00"),
        ("gps_time", "2024-06-01T12:00:00Z", "12:00:00+00:00"),
        ("unix_time", "1717243200", "12:00:00+00:00"),
    ],
)
def test_the_heading_of_the_times_states_their_clock(tmp_path, heading, stamp, expected):
    (tmp_path / "sky.csv").write_text(f"{heading},500\n{stamp},1\n")
    (time,) = read_irradiance_csv(tmp_path / "sky.csv").times
    assert time.isoformat() == f"2024-06-01T{expected}"


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


def test_opened_spectra_make_a_series(log):
    files = log(0, 2, 4)
    spectra = hp.open_asd(files, utc_offset_h=0)
    series = open_irradiance(spectra, fwhm_nm=3, averaging_s=0.68)
    of_files = open_irradiance(files, utc_offset_h=0, averaging_s=0.68)
    np.testing.assert_array_equal(series["irradiance"].values, of_files["irradiance"].values)
    np.testing.assert_array_equal(series["irradiance_time"].values, of_files["irradiance_time"].values)
    line = xr.Dataset({"radiance": (("along_track", "band", "cross_track"), np.ones((2, 3, 4)))})
    expect_refusals((SchemaError, "dims-wrong", lambda: hp.reflectance(line, irradiance=spectra)))


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
    expect_refusals((error, *told, lambda: open_irradiance(change(data), **{"fwhm_nm": 3, **options})))


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


# --- Certificates of panels, lists of pairs, and files of references ---


@pytest.mark.real_data
def test_real_certificates(shared_data: Path) -> None:
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    assert (panel.dtype, panel.attrs["units"], panel["wavelength"].attrs["units"]) == (np.float64, "1", "nm")
    assert float(panel.sel(wavelength=250.0)) == 0.942517
    zenith = hp.io.read_certificate(shared_data / "lab_calibration" / "zenith_lite_95R_certificate.csv")
    assert (float(zenith.sel(wavelength=250.0)), float(zenith.sel(wavelength=312.0))) == (0.911211, 0.967611)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("p.csv", "paint,reference\na,b\na,c\nd,e\na,b\n", {"a": ("b", "c"), "d": ("e",)}),
        ("p.csv", '\ufeff"a, b",x\n# note\n\nümlaut , y \n', {"a, b": ("x",), "ümlaut": ("y",)}),
        ("p.csv", "paint;reference\na;b\n;\n", {"a": ("b",)}),
        (
            "p.csv",
            "a;1,b\nc,d;2\n# note, too\n",
            {"a;1": ("b",), "c": ("d;2",)},
        ),  # commas in all rows separate
        ("p.json", '{"a": "b", "c": ["d", "e"]}', {"a": ("b",), "c": ("d", "e")}),
    ],
)
def test_pairs(tmp_path: Path, name: str, content: str, expected: dict[str, tuple[str, ...]]) -> None:
    path = write_file(tmp_path / name, content, encoding="utf-8")
    assert read_pairs(path) == expected


@pytest.mark.parametrize(
    ("read", "name", "content", "told"),
    [
        *(
            (hp.io.read_certificate, "panel.csv", content, told)
            for content, told in (
                (b"400,98.1\n500,98.5\n", "divide percent by 100"),
                (b"400,0.9\n", "table-missing"),
                (b"0.4,0.9\n0.5,0.9\n", "expected nanometres"),
                (b"500,0.9\n400,0.9\n450,0.9\n", "wavelength-unordered"),
                (b"heading\n" * 41 + b"400,0.9\n500,0.9\n", "line 41"),
                (b"400,0.9\noops\n500,0.9\n", "line 2"),
                (b"400,nan\n500,0.9\n", "not finite"),
                (b"\0" * 50, "0 lines of numbers"),
                (b"", "0 lines"),
            )
        ),
        (read_pairs, "p.csv", b"a\nb,c,d\n", "line 1.*row-unreadable"),
        (read_pairs, "p.csv", b"", "empty-input"),
        (read_pairs, "p.csv", b"\xff\xfe", "save it as UTF-8"),
        (read_pairs, "p.csv", b'a,"b\n', "after line"),
        (read_pairs, "p.json", b"[" * 100_000, "text-unreadable"),
        (read_pairs, "p.json", b"[1]", "type-wrong"),
        (read_pairs, "p.json", b'{"a": 3, "b": []}', "'a': 3.*\n.*'b'"),
        *(
            (hp.io.read_radcal, "cal.txt", RADCAL.replace(old, new, 1).encode(), told)
            for old, new, told in (
                ("!RADCAL", "!ANGDATA", "format-unknown"),
                ("[END_OF_LAMPDATA]", "", "table-missing"),
                ("500 0 4.0 1.0", "300 0 4.0 1.0", "wavelength-unordered"),
                ("410 1e-4", "410 broken", "line 16.*row-unreadable"),
                ("2.0 1.0", "nan 1.0", "not finite"),
            )
        ),
    ],
)
def test_damaged_texts(tmp_path: Path, read: Any, name: str, content: bytes, told: str) -> None:
    path = write_file(tmp_path / name, content)
    expect_errors((FormatError, told, lambda: read(path)))


@given(st.binary(max_size=80), st.sampled_from([b"", b'{"a":', b'{"a":["b",']))
def test_any_bytes_are_read_or_refused(tmp_path: Path, data: bytes, head: bytes) -> None:
    path = tmp_path / "a.json"  # the fault campaign has the other form
    path.write_bytes(head + data)
    with contextlib.suppress(FormatError):
        read_pairs(path)


def test_all_bad_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.sig").write_text("nothing")
    (tmp_path / "b.asd").write_bytes(b"asd" + b"\0" * 20)
    (tmp_path / "c.txt").write_text("poem")
    caught = expect_error(
        FormatError,
        "references cannot",
        lambda: open_references([tmp_path / name for name in ("a.sig", "b.asd", "c.txt")]),
    )
    expect_words(str(caught), "a.sig", "b.asd", "c.txt")
    expect_errors((FormatError, "file-not-found", lambda: open_references([tmp_path / "none*"])))
    (tmp_path / "empty").mkdir()
    expect_errors((FormatError, "file-not-found", lambda: open_references([tmp_path / "empty"])))


def test_a_store_without_references(tmp_path: Path) -> None:
    import xarray as xr

    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "s.zarr", "flightlines/raw_0")
    expect_errors((FormatError, "library-missing", lambda: open_references([tmp_path / "s.zarr"])))


# --- certificates of panels: units of headings are converted, labels are none, percent is never guessed ---


NM = "Wavelength [nm]"


def _read(folder: Path, headings: str, first: float, scale: float) -> tuple[list[float], list[float]]:
    path = folder / "panel.csv"
    rows = "".join(f"{nm * scale:g},{first}\n" for nm in (400, 500))
    path.write_text(f"{headings}\n{rows}", encoding="utf-8")
    certificate = read_certificate(path)
    return certificate.wavelength.values.tolist(), certificate.values.tolist()


@pytest.mark.parametrize(
    "heading",
    [
        f"{NM},Reflectance (99%)", f"{NM},Panel (50%)", f"{NM},R (2024)", f"{NM},Reflectance (8/h)",
        f"{NM},R (45/0)", f"{NM},R (absolute)", f"{NM},R (k=2)", f"{NM},R (SRS-99)", f"{NM},R [1]",
        "Wavelength (air), Reflectance (N)", "Panel,99 %", "Diffuse target;95 %\nnm;R",
        f"# accurate to 0.5 %\n{NM},R", "wavelength reflectance", "# made in May, 2024\nnm,R/1", "nm;R",
        "Wavelength (nm);Reflectance (fraction)",
    ],
)  # fmt: skip
def test_a_label_is_no_factor(tmp_path: Path, heading: str) -> None:
    assert _read(tmp_path, heading, 0.98, 1.0) == ([400.0, 500.0], [0.98, 0.98])


@pytest.mark.parametrize(
    "heading",
    [
        "Wavelength (um)  Reflectance (%)", "Wavelength (um) Diffuse Reflectance (%)",
        "Wavelength  (um)   Hemispherical Reflectance Factor  (%)", "# Wavelength [um],Reflectance [%]",
        "Wavelength/um;R/%", "Wavelength [um],Reflectance, %", "Wavelength um, Reflectance %",
        "Wavelength [um],Reflectance [%]\n-----,-----", "Wavelength,R\num,%", "wavelength_um\tR_percent",
        "Wavelength [µm],R (8/h) [%]", "Wavelength [Microns];R (per cent)", "# Wavelength [um],R [%]\na,b",
        "Wavelength um R %",
        "wavelength_um;reflectance_%", '"Wavelength um","Reflectance %"', "Wavelength   um   Reflectance   %",
    ],
)  # fmt: skip
def test_percent_and_micrometres_are_converted(tmp_path: Path, heading: str) -> None:
    wavelength, values = _read(tmp_path, heading, 98.0, 1e-3)
    assert (wavelength, values) == (pytest.approx([400.0, 500.0]), [0.98, 0.98])
    assert _read(tmp_path, heading, 1.5, 1e-3)[1] == [0.015, 0.015]


@pytest.mark.parametrize(
    ("heading", "problem"),
    [
        (f"# all values in %\n{NM},R", "units-ambiguous"),
        (f"# {NM}, uncertainty [%]\n{NM},R", "units-ambiguous"),
        (f"{NM},R [nm]", "contains 'nm'.*units-unknown"),
        (f"{NM},R [W m-2 nm-1]", "contains 'W m-2 nm-1'"),
        ("Wavenumber [cm-1],R", "contains 'cm-1'"),
        (f"{NM},R [%]\n{NM},R [1]", "'%'.*units-conflict"),
    ],
)
def test_what_is_not_clear_is_refused(tmp_path: Path, heading: str, problem: str) -> None:
    expect_errors((FormatError, problem.replace("[", r"\["), lambda: _read(tmp_path, heading, 0.98, 1.0)))


# --- calibrations of FRM4SOC, and irradiance of HYPERNETS -------------------------------------------------


NAME = "CP_SAT0385_RADCAL_20220606105303.TXT"


def test_a_real_calibration(shared_data: Path, tmp_path: Path) -> None:
    made = hp.io.read_radcal(shared_data / "lab_calibration" / NAME)
    assert (made.device, made.lamp, made.laboratory) == ("SAT0385", "TO_717", "Tartu Observatory")
    assert float(made.lamp_irradiance.sel(lamp_wavelength=300.0)) == pytest.approx(1.5637e-3)
    assert float(made.lamp_irradiance_u.sel(lamp_wavelength=300.0)) == pytest.approx(0.0231 / 2)
    assert float(made.panel_reflectance.sel(panel_wavelength=350.0)) == pytest.approx(0.989)
    assert made.sizes["wavelength"] == 255
    pixel = made.isel(wavelength=50)
    assert (float(pixel.wavelength), float(pixel.coefficient)) == (471.98, 1.119e-4)
    assert float(pixel.coefficient_u) == pytest.approx(0.00835)
    assert pixel.counts.values.tolist() == [13893.0, 13901.87]
    assert np.isnan(made.coefficient[0])
    inside = made.panel_radiance.sel(lamp_wavelength=350.0)
    expected = made.lamp_irradiance.sel(lamp_wavelength=350.0) * 0.989 / np.pi
    assert float(inside) == pytest.approx(float(expected))
    assert np.isnan(made.panel_radiance[0])
    path = write_file(tmp_path / "cal.txt", RADCAL)
    assert hp.io.read_radcal(path).sizes["wavelength"] == 2


FLAGS = "saturation nonlinearity bad_pointing placeholder1 lon_default lat_default outliers"


def _hypernets(
    path: Path, dim: str, level: list[float], time: np.ndarray, flags: list[int], units: str = "mW m^-2 nm^-1"
) -> Path:
    # Write a product with names and units as hypernets_processor writes them: no real file is at hand
    nm = np.arange(400.0, 1001.0, 5.0)
    values = np.outer(np.ones(nm.size), level)
    data = xr.Dataset(
        {
            "irradiance": (("wavelength", dim), values, {"units": units}),
            "radiance": (("wavelength", "series"), np.ones((nm.size, len(level) + 2 * (dim == "scan")))),
            "bandwidth": ("wavelength", np.full(nm.size, 3.2)),
            "acquisition_time": (dim, time),
            "quality_flag": (dim, np.array(flags, np.uint32), {"flag_meanings": FLAGS}),
        },
        {"wavelength": ("wavelength", nm, {"units": "nm"})},
    )
    if time.dtype.kind != "M":
        data["acquisition_time"].attrs["units"] = "s"
    data.to_netcdf(path)
    return path


@pytest.mark.parametrize("dim", ["series", "scan"])
def test_hypernets_irradiance(tmp_path: Path, dim: str) -> None:
    level, time = [1000.0, 1010.0, 990.0], np.array([1717243200, 1717243210, 1717243220], np.uint32)
    series = hp.open_irradiance(
        _hypernets(tmp_path / "HYPERNETS_L_TEST_L1B_IRR_20240601T1200.nc", dim, level, time, [0, 0, 0])
    )
    np.testing.assert_allclose(series.irradiance[:, 0], np.multiply(level, 1e-3), rtol=1e-6)
    assert series.irradiance_time.values[0] == np.datetime64("2024-06-01T12:00:00")
    assert float(series.irradiance_fwhm.max()) == pytest.approx(3.2)


TIMES = np.array([1717243200, 1717243210, 1717243220])


def test_flagged_spectra_of_hypernets_are_left_out(tmp_path: Path) -> None:
    time = np.array(["2024-06-01T12:00:00", "NaT", "2024-06-01T12:00:20", "2024-06-01T12:00:30"], "M8[ns]")
    path = _hypernets(tmp_path / "flagged.nc", "scan", [1000.0] * 4, time, [0, 0, 4, 48])
    with pytest.warns(PaintWarning, match=r"bad_pointing.*samples-flagged"):
        series = hp.open_irradiance(path)
    # Expected: the flags lon_default and lat_default, of a lost GPS fix, say nothing of the spectrum
    np.testing.assert_array_equal(series.irradiance_time, time[[0, 3]])
    path = _hypernets(tmp_path / "bad.nc", "series", [1000.0] * 3, TIMES, [4, 1, 5])
    with (
        pytest.warns(PaintWarning, match="samples-flagged"),
        pytest.raises(FormatError, match=r"saturation, bad_pointing.*\[samples-flagged"),
    ):
        hp.open_irradiance(path)


def test_a_day_of_hypernets_is_one_series(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number, flag in enumerate((0, 1, 0)):
        _hypernets(
            Path(f"IRR_{number}.nc"), "series", [1000.0 + number] * 3, TIMES + 1800 * number, [flag] * 3
        )
    for paths in ("IRR_*.nc", ".", sorted(map(str, Path().glob("*.nc")))):
        with pytest.warns(PaintWarning, match="samples-flagged"):
            series = hp.open_irradiance(paths)
        np.testing.assert_allclose(series.irradiance[:, 0], [1.0] * 3 + [1.002] * 3, rtol=1e-6)
    alone = hp.open_irradiance("IRR_0.nc")
    with xr.open_dataset("IRR_0.nc") as data:
        np.testing.assert_array_equal(hp.open_irradiance(data).irradiance, alone.irradiance)
    _hypernets(Path("IRR_3.nc"), "series", [1.0] * 3, TIMES + 5400, [0] * 3, "W m-2 nm-1")
    with pytest.raises(FormatError, match="series-mismatch"):
        hp.open_irradiance(["IRR_0.nc", "IRR_3.nc"])


def test_times_and_units_of_hypernets(tmp_path: Path) -> None:
    level = [1000.0] * 3
    with pytest.raises(FormatError, match="time-unreadable") as caught:
        hp.open_irradiance(_hypernets(tmp_path / "ms.nc", "series", level, TIMES * 1000, [0] * 3))
    assert caught.value.codes == ("time-unreadable",)
    bare = _hypernets(tmp_path / "bare.nc", "scan", level, TIMES, [0] * 3, "")
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        series = hp.open_irradiance(bare, units="mW m-2 nm-1", utc_offset_h=2)
    assert series.irradiance_time.values[0] == np.datetime64("2024-06-01T12:00:00")
    with pytest.raises(UnitsError, match="units-missing"):
        hp.open_irradiance(bare)


# --- the chain against numbers that others published, on their own files ----------------------------------


@pytest.fixture
def specim(shared_data: Path) -> dict[str, xr.DataArray]:
    # Raw counts of a Specim FX10, whose own names for the dims are sample, point and wavelength
    names = {schema.ALONG_TRACK: "sample", schema.CROSS_TRACK: "point"}
    found = {}
    for name in ("capture", "white", "black"):
        with xr.open_dataset(shared_data / "real_counts" / f"specim_fx10_{name}.nc") as file:
            (array,) = schema.rename_to_roles(file.load(), names).data_vars.values()
        found[name] = array.assign_attrs(units="count")
    return found


@pytest.mark.real_data
def test_specim_counts_give_the_four_published_ratios(specim):
    # Rationale: real counts of another camera, dark and white frames, and ratios its users published
    # Expected: line 0 peaks at 0.7786328655500226 and bottoms at 0.125; its pixel 0 is 0.28365385 at the band
    # nearest 1000 nm and 0.61686938 on the mean over wavelength. A float32 dark, as stores hold it, moves a
    # count by no more than rounding does.
    dark = specim["black"].mean(schema.ALONG_TRACK, keep_attrs=True)
    single, above, white = (
        (specim[name].astype(level.dtype) - level).transpose(*schema.CUBE)
        for name, level in (("capture", dark.astype(np.float32)), ("capture", dark), ("white", dark))
    )
    assert (above.dims, above.dtype, single.dtype) == (schema.CUBE, np.float64, np.float32)
    np.testing.assert_allclose(single, above, atol=1e-3)
    line = (above / white.mean(schema.ALONG_TRACK)).isel(along_track=0)
    assert (float(line.max()), float(line.min())) == (0.7786328655500226, 0.125)
    pixel, wavelength = line.isel(cross_track=0).values, line["wavelength"].values
    assert pixel[np.abs(wavelength - 1000.0).argmin()] == pytest.approx(0.28365385, abs=5e-9)
    assert np.trapezoid(pixel, wavelength) / np.ptp(wavelength) == pytest.approx(0.61686938, abs=5e-9)


# --- what readers of field spectrometers share ------------------------------------------------------------


NAMES = st.sampled_from(["red", "red (2)", "blue", "a/red", ""])


@given(st.lists(st.tuples(st.sampled_from(["a/x.sig", "b/x.sig", "x.sig", "/x.sig"]), NAMES)))
def test_names_are_unique_and_plain_where_they_can_be(sources) -> None:
    made = name_spectra([(Path(path), name) for path, name in sources])
    assert len(set(made)) == len(made) == len(sources)
    given_names = [name for _, name in sources]
    for (_, name), unique in zip(sources, made, strict=True):
        assert name in unique
        if given_names.count(name) == 1 and made.count(name):
            assert unique.startswith(name)


def test_grids_are_the_same_to_the_last_bit() -> None:
    grid = np.array([400.0, 401.0])
    assert [
        names for _, names in same_grids([("a", grid), ("b", np.nextafter(grid, 0)), ("c", grid.copy())])
    ] == [["a", "c"], ["b"]]


def test_one_error_for_all_with_each_reason_once() -> None:
    def read(name: str) -> str:
        if name == "good":
            return name
        raise FormatError(f"{name}: truncated: at 3", code="file-truncated")

    assert for_all(["good"], read) == ["good"]
    caught = expect_error(FormatError, None, lambda: for_all(["a", "good", "b"], read))
    assert (caught.codes, caught.problem.found) == (("file-truncated",), "spectra cannot be used")
    assert caught.problems[0].found == "a, b: truncated: at 3"


def test_files_folders_globs_and_lists(tmp_path) -> None:
    for name in ("b.sig", "a.sig", ".hidden.sig", "c.txt", "sub/d.sig"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    def find(paths):
        return [
            path.name
            for path in find_paths(
                paths, lambda inside: [p for p in inside if p.suffix == ".sig"], ".sig files"
            )
        ]

    assert find(tmp_path) == ["a.sig", "b.sig"]
    assert find([tmp_path / "c.txt", str(tmp_path / "**" / "*.sig")]) == ["c.txt", "a.sig", "b.sig", "d.sig"]
    assert find(tmp_path / "gone.sig") == ["gone.sig"]  # to read it is the error that names it
    expect_refusals(
        (FormatError, "file-not-found", lambda: find([str(tmp_path / "one*"), str(tmp_path / "two*")])),
        (FormatError, "empty-input", lambda: find([])),
    )


# --- Records with faults of the instrument, each named and left out; right ones are left alone ---


SKY_NM = np.arange(350.0, 1076.0)
SCANS = 40
Change = Callable[[np.ndarray], np.ndarray]


def noisy_sky(zenith: float = 45.0, noise: float = 0.003, seed: int = 0, scans: int = SCANS) -> np.ndarray:
    # Irradiance of a clear sky (scan, channel) with noise and the sun's course [W m-2 nm-1]
    rng = np.random.default_rng(seed)
    course = 1.0 + 2e-4 * np.arange(scans)[:, None]
    clear = sum(ClearSky(zenith).irradiance(SKY_NM))
    return clear * course * (1.0 + rng.normal(0.0, noise, (scans, SKY_NM.size)))


def opened(values: np.ndarray, interval_s: float = 1.0) -> xr.Dataset:
    stamps = np.datetime64("2024-05-21T16:00", "ns") + (np.arange(len(values)) * interval_s * 1e9).astype(
        "timedelta64[ns]"
    )
    record = xr.DataArray(
        values,
        {"time": stamps, "wavelength": ("wavelength", SKY_NM, {"units": "nm"})},
        ("time", "wavelength"),
        attrs={"units": "W m-2 nm-1"},
    )
    return hp.open_irradiance(record, fwhm_nm=3.0)


def scan(number: int, change: Change) -> Change:
    return lambda values: np.where(np.arange(len(values))[:, None] == number, change(values), values)


def channels(first: float, last: float, change: Change) -> Change:
    return lambda values: np.where((first <= SKY_NM) & (last >= SKY_NM), change(values), values)


#: Fault, change of a right record, code, whether it is refused, and shares of scans and channels that stay.
WRONG = (
    ("shaded", scan(17, lambda e: 0.1 * e), "irradiance-scans", 39, 1.0),
    ("shaded, first scan", scan(0, lambda e: 0.1 * e), "irradiance-scans", 39, 1.0),
    (
        "shaded twice",
        lambda e: scan(17, lambda x: 0.1 * x)(scan(19, lambda x: 0.5 * x)(e)),
        "irradiance-scans",
        38,
        1.0,
    ),
    ("a lamp beside the receptor", scan(8, lambda e: e + 0.6), "irradiance-scans", 39, 1.0),
    ("scan from red to blue", scan(25, lambda e: e[:, ::-1]), "irradiance-scans", 39, 1.0),
    ("fill of 16 bits", scan(20, lambda e: 0 * e + 65535.0), "irradiance-scans", 39, 1.0),
    ("negative", scan(30, lambda e: -e), "irradiance-scans", 39, 1.0),
    (
        "one channel of one scan",
        scan(12, channels(600, 600, lambda e: 0 * e - 1.0)),
        "irradiance-scans",
        39,
        1.0,
    ),
    ("channels of 9999", channels(520, 540, lambda e: 0 * e + 9999.0), "irradiance-channels", 40, 0.971),
    ("channels of zero", channels(700, 712, lambda e: 0 * e), "irradiance-channels", 40, 0.982),
    ("clipped", lambda e: np.minimum(e, 0.85 * e.max()), "irradiance-channels", 40, 0.8),
    ("stuck", channels(640, 650, lambda e: 0 * e + e[:1]), "irradiance-channels", 40, 0.985),
    ("gain", lambda e: e * np.where(np.arange(len(e)) < 22, 1.0, 0.8)[:, None], "irradiance-step", 40, 1.0),
)
#: Refused changes.
REFUSED = (
    ("every second channel zero", lambda e: e * (np.arange(SKY_NM.size) % 2)),
    ("every second channel at half", lambda e: e * (1.0 - 0.5 * (np.arange(SKY_NM.size) % 2))),
    ("clipped at a third", lambda e: np.minimum(e, e.max() / 3.0)),
    ("most scans are fill", lambda e: np.where(np.arange(len(e))[:, None] % 3 > 0, -999.0, e)),
)


@pytest.mark.parametrize(
    ("change", "code", "scans", "share"), [row[1:] for row in WRONG], ids=[row[0] for row in WRONG]
)
def test_faults_are_named_and_left_out(change: Change, code: str, scans: int, share: float) -> None:
    right = noisy_sky()
    with pytest.warns(PaintWarning) as caught:
        record = opened(change(right))
    assert {warning.message.code for warning in caught} == {code}  # type: ignore[union-attr]
    assert code in record.attrs["irradiance_faults"]
    values = record["irradiance"].values
    is_kept = np.isfinite(values)
    assert is_kept.all(axis=1).sum() == scans or share < 1.0
    assert is_kept.any(axis=0).mean() == pytest.approx(share, abs=0.06 if share == 0.8 else 0.002)
    if code != "irradiance-step":  # values that remain are right
        np.testing.assert_allclose(values[is_kept], right[is_kept], rtol=2e-3)


@pytest.mark.parametrize("change", [row[1] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_too_little_light_is_refused(change: Change) -> None:
    expect_errors((SchemaError, "irradiance-lost", lambda: opened(change(noisy_sky()))))


def ramp(first: int, last: int, depth: float) -> Change:
    # a cloud that dims the sun, red more than blue
    blocked = np.clip((np.arange(SCANS) - first) / (last - first), 0.0, 1.0)[:, None]
    return lambda e: e * (1.0 - depth * blocked * np.clip(SKY_NM / 800.0, 0.5, 1.0))


RIGHT: tuple[tuple[str, Callable[[], np.ndarray], float], ...] = (
    ("clear", lambda: noisy_sky(), 1.0),
    ("noise of 2 %", lambda: noisy_sky(noise=0.02), 1.0),
    ("low sun", lambda: noisy_sky(85.0, 0.01), 1.0),
    ("edge of a cloud", lambda: ramp(14, 24, 0.7)(noisy_sky()), 1.0),
    ("edge of a cloud between two scans", lambda: ramp(14, 15, 0.7)(noisy_sky()), 1.0),
    (
        "small cloud",
        lambda: ramp(10, 14, 0.6)(noisy_sky()) / ramp(16, 20, 0.6)(np.ones((SCANS, SKY_NM.size))),
        1.0,
    ),
    ("single cloud in slow scans", lambda: scan(20, ramp(0, 1, 0.7))(noisy_sky()), 30.0),
    (
        "three digits",
        lambda: np.array([[float(f"{x:.3g}") for x in row] for row in noisy_sky(noise=1e-4)]),
        1.0,
    ),
    ("two digits", lambda: noisy_sky(noise=1e-4).round(2), 1.0),
    ("four scans", lambda: noisy_sky(scans=4), 20.0),
)


@pytest.mark.parametrize(("values", "interval_s"), [row[1:] for row in RIGHT], ids=[row[0] for row in RIGHT])
@pytest.mark.filterwarnings("error")
def test_right_records_stay(values: Callable[[], np.ndarray], interval_s: float) -> None:
    right = values()
    record = opened(right, interval_s)
    np.testing.assert_array_equal(record["irradiance"], right.astype("f4"))
    assert "irradiance_faults" not in record.attrs


# --- Files of further instruments, loggers and laboratories: the right value, or the right code ---


FIVE_NM = np.arange(350.0, 1050.0, 5.0)
LIGHT = 1.2 * np.exp(-(((FIVE_NM - 600.0) / 300.0) ** 2))  # W m-2 nm-1


def columns(*values: Any, sep: str = "\t", comma: bool = False, end: str = "\n", form: str = ".6f") -> str:
    # Return lines of numbers: wavelengths, then columns of values
    texts = (
        sep.join([f"{nm:.2f}", *(f"{cell:{form}}" for cell in row)])
        for nm, *row in zip(FIVE_NM, *(np.broadcast_to(each, FIVE_NM.shape) for each in values), strict=True)
    )
    text = end.join(texts) + end
    return text.replace(".", ",") if comma else text


def darwin(headings: str, rows: str, units: str = "W/m^2/sr/nm", measurement: str = "REFLECTANCE") -> str:
    # Return a file of Spectral Evolution's DARWin
    return (
        "Comment: left door\nVersion: 2.3 [1.2.6250C]\nFile Name: folder\\door.sed\n"
        "Instrument: PSR-3500_SN1 [3]\n"
        f"Measurement: {measurement}\nDate: 03/05/2024,03/05/2024\nTime: 10:00:00.07,10:00:20.07\n"
        f"Averages: 5,5\nIntegration: 15,30,50,30\nRadiometric Calibration: RADIANCE\nUnits: {units}\n"
        f"Latitude: 72.35670\nLongitude: n/a\nGPS Time: n/a\nColumns [4]:\nData:\n{headings}\n{rows}"
    )


def ocean(rows: str, first: str = "SpectraSuite Data File", more: str = "", heading: str = "") -> str:
    # Return a file of Ocean Optics
    return (
        f"{first}\n++++++++++++++++++++++++++++++++++++\nDate: Sat Jun 01 10:00:00 CEST 2024\n"
        f"Dark Spectrum Present: Yes\nIntegration Time (usec): 70000 (QEA7025)\n"
        "Spectra Averaged: 3 (QEA7025)\n"
        f"{more}>>>>>Begin Processed Spectral Data<<<<<\n{heading}{rows}"
    )


def avantes(names: str, units: str, rows: str) -> str:
    # Return a text of AvaSoft
    head = (
        "1305084U1- I C\nIntegration time: 95,00 ms\nAverage: 20 scans\nNr of pixels used for smoothing: 1\n"
    )
    return f"{head}Data measured with spectrometer name: 1305084U1\n{names}\n{units}\n{rows}"


END = ">>>>>End Processed Spectral Data<<<<<\n"
LI180 = (
    "Model Name\tLI-180\nSerial Number\tA18M0157\nTime\t2021/03/02_09:24:26\nPPFD\t129.9\nUV%\t1.36\n"
    "R:B\t1.48\nCustom1(655~665nm)\t5.05\nI-Time\t92.0\n"
    + "".join(f"{nm:.0f}nm\t{1e3 * light:.6f}\n" for nm, light in zip(FIVE_NM, LIGHT, strict=True))
    + "CCT\t5465.0\nu'\t0.203671\nR15\t97.8\n"
)
RAD = "Wvl\tRad. (Ref.)\tRad. (Target)\tTgt./Ref. %"

REFLECTANCES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "radiance of both, their ratio": ("a.sed", darwin(RAD, columns(0.08, 0.02, 25.0, form=".6E")), {}),
    "two columns": ("a.sed", darwin("Wvl\tReflect. %", columns(25.0)), {}),
    "a fraction": ("a.sed", darwin("Wvl\tReflect. [1.0]", columns(0.25)), {}),
    "channels": (
        "a.sed",
        darwin(
            "Chan.#\tWvl\tReflect. %",
            "".join(f"{n}\t{line}\n" for n, line in enumerate(columns(25.0).splitlines())),
        ),
        {},
    ),
    "as CSV": (
        "a.csv",
        darwin("Wvl,Norm. DN (Ref.),Norm. DN (Target),Reflect. %", columns(723.0, 112.0, 25.0, sep=","))
        .replace("Columns [4]:", "Columns [4]:,,,")
        .replace("Data:", "Data:,,,"),
        {},
    ),
    "radiances without a ratio": (
        "a.sed",
        darwin("Wvl\tRad. (Ref.)\tRad. (Target)", columns(0.08, 0.02, form=".4E")),
        {},
    ),
    "Jaz, declared": (
        "a.jaz",
        ocean(columns(1.0, 9.0, 3.0, 25.0), "Jaz Data File", heading="W\tD\tR\tS\tP\n") + END,
        {"quantity": "reflectance", "scale": 100},
    ),
    "R in percent": ("a.txt", ocean(columns(25.0), heading="lambda / nm\tR / %\n") + END, {}),
    "mode by a word": ("a.txt", ocean(columns(25.0), more="Mode: Reflection [%]\n") + END, {}),
    "mode by a word, commas": (
        "a.txt",
        ocean(columns(25.0, comma=True), more="Mode: Reflectance [%]\n") + END,
        {},
    ),
    "Avantes": (
        "a.ttt",
        avantes(
            "Wave   ;Dark     ;Ref      ;Sample   ;Reflectance",
            "[nm]   ;[counts] ;[counts] ;[counts] ;[%]",
            "\n" + columns(3.0, 6429.0, 124.0, 25.0, sep=";", comma=True),
        ),
        {},
    ),
    "EcoSIS": (
        "e.csv",
        "Site,Target Name,Wavelength Units,Measurement Units," + ",".join(f"{x:g}" for x in FIVE_NM)
        + "\n" + "lot,door,Nanometers,percent," + ",".join(["25"] * FIVE_NM.size) + "\n",
        {},
    ),
    "EcoSIS in micrometres": (
        "e.csv",
        "id;Wavelength Units;" + ";".join(f"{x / 1e3:g}" for x in FIVE_NM)
        + "\n" + "door;micrometers;" + ";".join(["0,25"] * FIVE_NM.size) + "\n",
        {},
    ),
    **{
        f"a row a spectrum, {form}": (
            "e.csv",
            "name,"
            + ",".join(form.format(x, x / 1e3) for x in FIVE_NM)
            + "\ndoor"
            + ",0.25" * FIVE_NM.size
            + "\n",
            {},
        )
        for form in ("{1:g}", "{1:g} um", "wl_{0:g}", "nm{0:g}", "R{0:g}", "Reflectance_{0:g}")
    },
    "a row a spectrum, name last": (
        "e.csv",
        ",".join(f"{x:g}" for x in FIVE_NM) + ",name\n" + "0.25," * FIVE_NM.size + "door\n",
        {},
    ),
    "headings of R": (
        "e.csv",
        '"","sample_name",' + ",".join(f'"X{x:g}"' for x in FIVE_NM)
        + '\n"1","door, left",' + ",".join(["0.25"] * FIVE_NM.size) + "\n",
        {},
    ),
    "SPECCHIO": (
        "s.csv",
        "File Name,door.000\nLocation Name,Hyytiala, Finland\nFile Comments,\nLatitude,61.82\nFOV,25\n"
        + columns(0.25, sep=","),
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFLECTANCES)
def test_reflectance_of_others(name: str, tmp_path: Path) -> None:
    file, text, options = REFLECTANCES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    library = hp.open_library(tmp_path / file, **options)
    assert library["reflectance"].dims == ("signature", "band")
    np.testing.assert_allclose(library["reflectance"].values, [[0.25] * FIVE_NM.size], rtol=1e-6)
    np.testing.assert_allclose(library["wavelength"].values, FIVE_NM, rtol=1e-12)
    # what was read is written and read again with the same values
    again = hp.open_library(hp.write_library(library, tmp_path / "again.csv"))
    np.testing.assert_array_equal(again["reflectance"].values, library["reflectance"].values)


def test_properties_of_samples_are_kept(tmp_path: Path) -> None:
    path = write_file(
        tmp_path / "eco.csv",
        "Site,sample name,Latitude,n,450,550,650\nlot,roof 1,61.5,3,.1,.15,.17\nlot,roof 2,,4,.2,,.26\n",
    )
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == ["roof 1", "roof 2"]
    assert library["site"].values.tolist() == ["lot", "lot"]
    np.testing.assert_array_equal(library["latitude"].values, [61.5, np.nan])
    assert np.isnan(library["reflectance"].values[1, 1])
    path.write_text("File Name,red,blue\nAltitude,170.0,171.5\n450,0.1,0.2\n550,0.3,0.4\n650,0.5,0.6\n")
    library = hp.open_library(path)
    assert library["signature"].values.tolist() == ["red", "blue"]
    assert library["altitude"].values.tolist() == [170.0, 171.5]
    np.testing.assert_allclose(library["reflectance"].values, [[0.1, 0.3, 0.5], [0.2, 0.4, 0.6]])


IRRADIANCES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "DARWin": (
        "a.sed",
        darwin(
            "Wvl\tIrrad. (Ref.)\tIrrad. (Target)",
            columns(1.0, LIGHT, form=".6E"),
            "W/m^2/nm",
            "DIRECT_ENERGY",
        ),
        {"utc_offset_h": 0},
    ),
    "Jaz": (
        "a.JazIrrad",
        ocean(columns(3.0, 90.0, 100.0 * LIGHT), "Jaz Absolute Irradiance File", heading="W\tD\tS\tP\n")
        + END
        + ">>>>>Begin Calibration Data<<<<<\n7.685e-04\n>>>>>End Calibration Data<<<<<\n",
        {},
    ),
    "Jaz, commas": (
        "a.JazIrrad",
        ocean(
            columns(3.0, 90.0, 100.0 * LIGHT, comma=True),
            "Jaz Absolute Irradiance File",
            heading="W\tD\tS\tP\n",
        )
        + END,
        {},
    ),
    "OceanView": (
        "a.OVIrrad",
        ocean(columns(100.0 * LIGHT, comma=True), "Data from roof_AbsoluteIrradiance__0__19-20.txt Node"),
        {},
    ),
    "Spanish": (
        "a.txt",
        ocean(columns(100.0 * LIGHT, comma=True), "Fichero De SpectraSuite", "Unidades: uW/cm^2/nm\n")
        .replace(">>>>>Begin Processed Spectral Data<<<<<", ">>>>> Comienza Data<<<<< Espectral")
        + ">>>>> Data<<<<< Espectral Procesado Extremo\n",
        {"units": "uW cm-2 nm-1", "quantity": "irradiance"},
    ),
    "LI-180": ("a.txt", LI180, {"utc_offset_h": 2}),
}  # fmt: skip


@pytest.mark.parametrize("name", IRRADIANCES)
def test_irradiance_of_others(name: str, tmp_path: Path) -> None:
    file, text, options = IRRADIANCES[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    opened = open_irradiance(tmp_path / file, fwhm_nm=1.5, max_gap_s=5, **options)
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(opened["irradiance_wavelength"].values, FIVE_NM)


def test_units_of_avantes_irradiance_are_those_of_the_file(tmp_path: Path) -> None:
    rows = columns(100.0 * LIGHT, sep=";", comma=True)
    (tmp_path / "a.ttt").write_text(avantes("Wave ;AbsIrr", "[nm] ;[µW/cm²/nm]", rows), encoding="latin-1")
    opened = hp.open_asd(tmp_path / "a.ttt", "irradiance")
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, rtol=1e-4, atol=1e-6)


def test_the_fore_optic_and_the_zone_of_a_text_are_judged(tmp_path: Path) -> None:
    _, text, options = IRRADIANCES["DARWin"]
    path = write_file(
        tmp_path / "a.sed", text.replace("Units:", "Foreoptic: LENS4 {RADIANCE}, LENS4 {RADIANCE}\nUnits:")
    )
    options = {"fwhm_nm": 1.5, "max_gap_s": 5, **options}
    expect_refusals((FormatError, "fore-optic-wrong", lambda: open_irradiance(path, **options)))
    path = write_file(tmp_path / "a.OVIrrad", IRRADIANCES["OceanView"][1].replace("CEST", "EDT"))
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        open_irradiance(path, fwhm_nm=1.5, max_gap_s=5, utc_offset_h=-5)


@pytest.mark.parametrize(
    ("date", "expected"),
    [("03/05/2024", "2024-03-05"), ("13.05.2024", "2024-05-13"), ("05.06.2024", "2024-06-05")],
)
def test_dates_of_darwin(tmp_path: Path, date: str, expected: str) -> None:
    text = darwin("Wvl\tReflect. %", columns(25.0)).replace("03/05/2024", date)
    (tmp_path / "a.sed").write_text(text)
    time = read_spectrum_text(tmp_path / "a.sed").local_time
    assert time is not None
    assert time.date().isoformat() == expected


def test_a_date_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.sed").write_text(
        darwin("Wvl\tReflect. %", columns(25.0)).replace("03/05/2024", "31/31/2024")
    )
    with pytest.warns(PaintWarning, match="time-unreadable"):
        assert read_spectrum_text(tmp_path / "a.sed").local_time is None


def test_zone_and_window_of_a_date(tmp_path: Path) -> None:
    (tmp_path / "a.JazIrrad").write_text(IRRADIANCES["Jaz"][1])
    opened = open_irradiance(tmp_path / "a.JazIrrad", fwhm_nm=1.5, max_gap_s=5)
    expect_refusals(
        (
            TimeError,
            "argument-missing",
            "csv",
            "xarray",
            lambda: open_irradiance(tmp_path / "a.JazIrrad", fwhm_nm=1.5),
        )
    )
    # 10:00:00 CEST at the end of three scans of 70 ms
    assert opened["irradiance_time"].values[0] == np.datetime64("2024-06-01T07:59:59.895")
    (tmp_path / "door.sed").write_text(REFLECTANCES["radiance of both, their ratio"][1])
    field = hp.open_asd(tmp_path / "door.sed", "radiance", utc_offset_h=1)
    np.testing.assert_allclose(field["radiance"].values, [[0.02] * FIVE_NM.size])
    assert field["time"].values[0] == np.datetime64("2024-03-05T09:00:20.07")
    assert "Spectral Evolution" in field.attrs["instrument"]


def logged(
    head: str = "time",
    sep: str = ",",
    unit: str = "",
    dates: str = "2024-06-01T10:00:{:02d}Z",
    *,
    comma: bool = False,
) -> str:
    rows = (
        dates.format(2 * k) + sep
        + sep.join(f"{x:.5f}".replace(".", "," if comma else ".") for x in LIGHT * (1 + 0.01 * k))
        for k in range(4)
    )  # fmt: skip
    heading = sep.join([head, *(f"{x:g}{unit}" for x in FIVE_NM)])
    return f"# units: W m-2 nm-1\n# fwhm_nm: 3\n{heading}\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (logged(), "2024-06-01T10:00:00"),
        (logged("Timestamp", unit=" nm"), "2024-06-01T10:00:00"),
        (logged('"Date/Time"', ";", " [nm]", comma=True), "2024-06-01T10:00:00"),
        (logged("Time (UTC)", "\t", "nm", "2024-06-01 10:00:{:02d}", comma=True), "2024-06-01T10:00:00"),
        (logged("datetime", dates="06/13/2024 10:00:{:02d} AM"), "2024-06-13T10:00:00"),
        (logged("datetime", ";", dates="13.06.2024 10:00:{:02d}", comma=True), "2024-06-13T10:00:00"),
        (logged("unix time", dates="17172360{:02d}"), "2024-06-01T10:00:00"),
        (logged("Date,Time", dates="2024-06-01,10:00:{:02d}"), "2024-06-01T10:00:00"),
        (logged("time", ",", "nm").replace("# units", "units"), None),
    ],
)
def test_csv_of_loggers(text: str, first: str | None, tmp_path: Path) -> None:
    path = write_file(tmp_path / "sky.csv", text)
    if first is None:  # a line that is neither comment nor heading
        expect_refusals((FormatError, "format-unknown", lambda: open_irradiance(path, utc_offset_h=0)))
        return
    opened = open_irradiance(path, utc_offset_h=None if "Z" in text or "UTC" in text or "unix" in text else 0)
    assert opened["irradiance"].shape == (4, 140)
    assert opened["irradiance_time"].values[0] == np.datetime64(first)
    np.testing.assert_allclose(opened["irradiance"].values[0], LIGHT, atol=1e-5)


REFUSED_FILES: dict[str, tuple[str, str | bytes, Any, str, tuple[str, ...]]] = {
    # file, content, call, code, words
    "counts alone": (
        "a.sed",
        darwin("Wvl\tNorm. DN (Ref.)\tNorm. DN (Target)", columns(400.0, 100.0), "None"),
        hp.open_library,
        "quantity-wrong",
        ("counts", "0.25"),
    ),
    "irradiance in a library": (
        "a.sed",
        darwin("Wvl\tIrrad. (Ref.)\tIrrad. (Target)", columns(1.0, 0.5), "W/m^2/nm"),
        hp.open_library,
        "quantity-wrong",
        ("irradiance", "open_irradiance"),
    ),
    "a lamp in photons": (
        "a.txt",
        ocean(columns(3.0), more="Units: umol/m^2/s/nm\n") + END,
        lambda path: open_irradiance(path, "irradiance", fwhm_nm=2),
        "units-unknown",
        ("umol",),
    ),
    "processed, of what": (
        "a.txt", ocean(columns(25.0)) + END, hp.open_library, "quantity-ambiguous", ("quantity=",)
    ),
    "a row in the middle": (
        "a.txt",
        ocean(columns(25.0).replace("500.00\t", "oops\t"), more="Mode: Reflection [%]\n") + END,
        hp.open_library,
        "row-unreadable",
        ("line 39",),
    ),
    "Avantes counts": (
        "a.trt",
        avantes("Wave   ;Sample", "[nm]   ;[counts]", columns(805.0, sep=";")),
        hp.open_library,
        "quantity-wrong",
        ("counts",),
    ),
    "Avantes transmittance": (
        "a.ttt",
        avantes("Wave   ;Transmittance", "[nm]   ;[% transmittance]", columns(80.0, sep=";")),
        hp.open_library,
        "quantity-wrong",
        ("ransmittance",),
    ),
    "StellarNet": (
        "a.IRR",
        '" File: Users\\roof"\n" RAD->  Wave:643.77nm  Pix:1050  Val:  0.001  Time:100ms  Avg:1"\n'
        + columns(LIGHT, sep="  ", form=".4E"),
        lambda path: open_irradiance(path, "irradiance", units="W m-2 nm-1", fwhm_nm=2),
        "time-missing",
        ("a.IRR",),
    ),
    "June or January": (
        "sky.csv",
        logged("datetime", dates="06/01/2024 10:00:{:02d}"),
        open_irradiance,
        "date-ambiguous",
        ("2024-01-06", "2024-06-01"),
    ),
    "a series in a library": ("sky.csv", logged(), hp.open_library, "quantity-wrong", ("open_irradiance",)),
    "EcoSIS radiance": (
        "e.csv",
        "id,Measurement Quantity,450,550,650\ndoor,Radiance,1,2,3\n",
        hp.open_library,
        "quantity-wrong",
        ("Radiance",),
    ),
    "EcoSIS fractions under percent": (
        "e.csv",
        "id,Measurement Units,450,550,650\ndoor,Percent,.1,.2,.3\n",
        hp.open_library,
        "scale-conflict",
        ("scale=1",),
    ),
    "EcoSIS ragged": (
        "e.csv",
        "id,site,450,550,650\ndoor,lot,.1,.2,.3\nroof,.1,.2,.3\n",
        hp.open_library,
        "row-unreadable",
        ("line 3",),
    ),
    "sheet": ("a.xlsx", b"PK\x03\x04" + b"\0" * 40, hp.open_library, "format-unknown", ("Excel", "CSV")),
    "certificate as PDF": ("a.pdf", b"%PDF-1.7\n", hp.io.read_certificate, "format-unknown", ("PDF", "text")),
    "JCAMP": ("a.jdx", "##TITLE= door\n##JCAMP-DX= 5\n", hp.open_library, "format-unknown", ("JCAMP",)),
    "AvaSoft 8": ("a.irr8", b"AVS84\0\1\2", open_irradiance, "format-unknown", ("AvaSoft", "text")),
    "gzip": ("a.asd.gz", b"\x1f\x8b\x08\0as7", hp.open_asd, "format-unknown", ("unpack",)),
    "GER": ("a.sig", b"///GER SIGNATUR FILE///\n", hp.open_svc, "format-unknown", ("GER",)),
    "MATLAB": ("a.mat", b"MATLAB 5.0 MAT-file" + b" " * 109, hp.open_library, "format-unknown", ("MATLAB",)),
    "netCDF as library": (
        "a.nc", b"CDF\x01" + b"\0" * 40, hp.open_library, "format-unknown", ("xr.open_dataset",)
    ),
    "netCDF as cube": (
        "cube.nc",
        b"\x89HDF\r\n\x1a\n" + b"\0" * 90,
        hp.open_flightline,
        "format-unknown",
        ("xr.open_dataset", "wavelength"),
    ),
    "a table is no ASD text": (
        "a.csv", "a,b\n1,2\n3,4\n", open_irradiance, "format-unknown", ("time,", "xarray")
    ),
    "fractions under percent": (
        "p.csv",
        "Wavelength [nm];Reflectance [%]\n400;0.98\n500;0.97\n",
        hp.io.read_certificate,
        "units-conflict",
        ("%",),
    ),
    "percent without a word": (
        "p.csv", "nm;R\n400;98\n500;97\n", hp.io.read_certificate, "scale-missing", ()
    ),
    **{
        f"certificate of {heading}": ("p.csv", f"# 8/h\n{heading}\n8000;0.9\n9000;0.9\n", read, code, ())
        for read in [hp.io.read_certificate]
        for heading, code in (
            ("nm;absorptance", "quantity-wrong"),
            ("nm;transmittance (%)", "quantity-wrong"),
            ("nm;%T", "quantity-wrong"),
            ("nm;emissivity;u(k=2)", "quantity-wrong"),
            ("cm-1;R", "units-unknown"),
        )
    },
    "wavenumbers of OceanView": (
        "a.txt",
        ocean(columns(0.25), more="XAxis mode: Wavenumbers\nMode: Reflectance\n") + END,
        hp.open_library,
        "units-unknown",
        ("Wavenumbers",),
    ),
    "Raman shifts": (
        "a.txt",
        ocean(columns(0.25), more="XAxis mode: Raman Shifts\n") + END,
        lambda path: hp.open_asd(path, "reflectance"),
        "units-unknown",
        ("Raman",),
    ),
    "SVC as irradiance": (
        "a.sig",
        "/*** Spectra Vista SIG Data ***/\nunits= Irradiance, Irradiance\ndata=\n",
        open_irradiance,
        "format-unknown",
        ("hp.open_svc", "swap_dims"),
    ),
    "two reflectances": (
        "p.csv",
        "nm;R(8/h);R(0/45)\n400;0.98;0.97\n500;0.97;0.96\n",
        hp.io.read_certificate,
        "column-ambiguous",
        (),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_FILES)
def test_the_way_out_is_named(name: str, tmp_path: Path) -> None:
    file, content, call, code, words = REFUSED_FILES[name]
    path = write_file(tmp_path / file, content if isinstance(content, bytes) else content.encode())
    caught = expect_error(PaintError, None, lambda: call(path))
    assert code in caught.codes
    absent = [word for word in words if word not in str(caught)]
    assert not absent, f"{absent} in: {caught}"
    assert "neither" not in str(caught)


@pytest.mark.parametrize(
    ("text", "at_550"),
    [
        ("Wavelength (nm),Reflectance,Uncertainty (k=2)\n400,0.99,0.005\n700,0.93,0.005\n", 0.96),
        ("Wavelength (nm),Reflectance\n700,0.93\n400,0.99\n", 0.96),
        ("Wavelength (nm);Reflectance\n400;0,99\n700;0,93\n", 0.96),
        ("nm\tR\n400\t0,99\n700\t0,93\n", 0.96),
        ("Wellenlaenge nm   Reflexion\n400,0  0,99\n700,0  0,93\n", 0.96),
        ("wavelength [um],reflectance [%],std [%]\n0.4,99,0.2\n0.7,93,0.2\n", 0.96),
        ("# absorbance accessory\nnm,%R\n400,99\n700,93\n", 0.96),
        ("nm;%Reflectance\n400;99\n700;93\n", 0.96),
        ("Wavelength,R (8/h),u(R)\nnm,1,1\n400,0.99,0.005\n700,0.93,0.005\n", 0.96),
        ('"nm","R"\n"400","0.99"\n"700","0.93"\n', 0.96),
        ("nm,R,,\n400,0.99,,\n700,0.93,,\n", 0.96),
        ("# nm;[%];;\nnm;[%];;\n400;99;;\n700;93;;\n", 0.96),
        ("sep=;\nWavelength (µm);Reflectance\n0.4;0.99\n0.7;0.93\n".encode("cp1252"), 0.96),
        ("Wavelength (µm)\tReflectance\n0.4\t0.99\n0.7\t0.93\n".encode("utf-16"), 0.96),
        ("A,R\n4000,0.99\n7000,0.93\n", 0.96),
        ("A,B\n400,0.99\n700,0.93\n", 0.96),
        ("400,0.02,0.001\n700,0.02,0.001\n", None),
    ],
)
def test_certificates_as_laboratories_print_them(
    text: str | bytes, at_550: float | None, tmp_path: Path
) -> None:
    path = write_file(tmp_path / "p.csv", text)
    if at_550 is None:
        expect_refusals((FormatError, "column-ambiguous", lambda: hp.io.read_certificate(path)))
    else:
        assert float(hp.io.read_certificate(path).interp(wavelength=550.0)) == pytest.approx(at_550)


def test_usgs_chapters(tmp_path: Path) -> None:
    um = 1 / np.linspace(1 / 1.1225606, 1 / 216.00604, 60)
    values = np.linspace(0.1, 0.3, 60)
    values[7] = -1.23e34

    def column(title: str, numbers: Any) -> str:
        return title + "\n" + "\n".join(f" {number:.7E}" for number in numbers) + "\n"

    chapter = tmp_path / "ASCIIdata_splib07a" / "ChapterA_ArtificialMaterials"
    chapter.mkdir(parents=True)
    axis = write_file(
        chapter.parent / "splib07a_Wavelengths_NIC4_Nicolet_1.12-216microns.txt",
        column(" splib07a Record=23: Wavelengths NIC4 Nicolet 1.12-216microns", um),
    )
    (chapter / "splib07a_Coat_NIC4ccc_RREF.txt").write_text(
        column(" splib07a Record=900: Coat X NIC4ccc RREF", values)
    )
    bars = write_file(
        chapter / "errorbars_for_splib07a_Coat_NIC4ccc_RREF.txt",
        column(" splib07a Record=901: error bars for Coat X NIC4ccc RREF", values * 0.01),
    )
    library = hp.open_library(chapter)
    assert library["signature"].values.tolist() == ["Coat X"]
    np.testing.assert_allclose(library["wavelength"].values[[0, -1]], [1122.5606, 216006.04], rtol=1e-6)
    assert np.flatnonzero(np.isnan(library["reflectance"].values[0])).tolist() == [7]
    expect_refusals((FormatError, "quantity-wrong", lambda: hp.open_library(bars)))
    um[3] = -1.23e34  # a channel that the spectrometer lacks
    axis.write_text(column(" splib07a Record=23: Wavelengths NIC4 Nicolet 1.12-216microns", um))
    library = hp.open_library(chapter)
    assert (library.sizes["band"], bool((np.diff(library["wavelength"].values) > 0).all())) == (59, True)


RADCAL_IRRADIANCE = """!FRM4SOC_CP
!RADCAL
[DEVICE]
SAM_8329
[LAMPDATA]
400 0 2.0 1.0
500 0 4.0 1.0
[END_OF_LAMPDATA]
[CALDATA]
0 0 1024 0 0 0 1024 0 512 0
1 400 1e-4 1.5 10 0 900 1 901 1
2 410 1e-4 1.5 10 0 950 1 951 1
[END_OF_CALDATA]
"""
_TABLES = """[COLUMN_NAMES]
px wl\\angle -60 0 60
[COSERROR]
0 400 5.0 0.0 4.0
1 410 5.5 0.0 4.5
[END_OF_COSERROR]
[COLUMN_NAMES]
px wl\\angle -60 0 60
[UNCERTAINTY]
0 400 1.0 0.5 1.0
1 410 1.0 0.5 1.0
[END_OF_UNCERTAINTY]
"""
ANGULAR = (
    "!FRM4SOC_CP\n!ANGDATA\n[DEVICE]\nSAM_8329\n[AZIMUTH_ANGLE]\n0\n"
    + _TABLES
    + "[AZIMUTH_ANGLE]\n90\n"
    + _TABLES
)


def test_irradiance_sensors_of_frm4soc(tmp_path: Path) -> None:
    path = write_file(tmp_path / "CP_SAM_8329_RADCAL_20220706.TXT", RADCAL_IRRADIANCE)
    calibration = hp.io.read_radcal(path)
    assert calibration["coefficient"].values.tolist() == [1e-4, 1e-4]
    assert not {"panel_reflectance", "panel_radiance"} & set(calibration.variables)
    path.write_text(ANGULAR)
    response = hp.io.read_angular_response(path)
    assert response["cosine_error"].dims == ("azimuth", "wavelength", "zenith")
    assert response["cosine_error"].sel(azimuth=90, wavelength=410, zenith=-60).item() == 0.055
    assert response["cosine_error_u"].sel(azimuth=0, wavelength=400, zenith=0).item() == 0.0025
    assert response.attrs["device"] == "SAM_8329"
    expect_refusals((FormatError, "format-unknown", lambda: hp.io.read_radcal(path)))
    path.write_text(ANGULAR.replace("0 400 5.0 0.0 4.0", "0 400 5.0 0.0", 1))
    expect_refusals((FormatError, "row-unreadable", lambda: hp.io.read_angular_response(path)))


@pytest.mark.real_data
def test_a_real_angular_response(shared_data: Path) -> None:
    response = hp.io.read_angular_response(
        shared_data / "lab_calibration" / "CP_SAM_8329_ANGULAR_20220704122830.TXT"
    )
    assert response["cosine_error"].shape == (2, 256, 45)
    at = response["cosine_error"].isel(azimuth=0)
    assert float(at.sel(wavelength=305.42, zenith=-80.0)) == pytest.approx(0.1817)
    assert float(abs(at.sel(zenith=0.0)).isel(wavelength=slice(1, None)).max()) == 0.0


def test_a_sheet_within_a_folder(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.ProcSpec", "w") as file:
        file.writestr("OOISignatures.xml", "<x/>")
    expect_refusals(
        (FormatError, "format-unknown", "ProcSpec", lambda: hp.open_library(tmp_path / "a.ProcSpec"))
    )


def test_the_table_of_the_docs_names_every_form() -> None:
    table = (ROOT / "docs" / "formats" / "index.md").read_text("utf-8")
    rows = [line for line in table.splitlines() if line.count("|") == 6]
    instruments = [*(row.instrument for row in (*EXPORTS, *DIALECTS, *FORMS))]
    assert [name for name in instruments if not any(name in row for row in rows)] == []
