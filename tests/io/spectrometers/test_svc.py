"""Dialects of ``.sig`` files, what is refused, and the way back from the simulator's own writer."""

import contextlib
import csv
import datetime as dt
import json
import os
import re
import struct
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.base.facts import conversion_factor
from hyperpaint.cli.info_command import describe_path
from hyperpaint.io.spectrometers import asd, spectrum_texts
from hyperpaint.io.spectrometers.asd import Cursor, open_asd, read_asd, read_asd_text, sniff
from hyperpaint.io.spectrometers.reference_files import open_references
from hyperpaint.io.spectrometers.spectrum_texts import (
    SVC_JOINS,
    dialect_of,
    open_svc,
    orders_of,
    position_of,
    read_gps_time,
    read_stamp,
    read_svc,
    utc_of,
)
from hyperpaint.simulation.instruments import SVC_WAVELENGTH, write_svc

# --- A writer of ``.sig`` files in any dialect, independent of the package's readers and simulator


# three short detectors that overlap twice
GRID = np.concatenate(
    [np.arange(400.0, 1011.0, 10.0), np.arange(965.0, 1911.0, 15.0), np.arange(1890.0, 2500.0, 20.0)]
)
PANEL = np.round(20000.0 - 5.0 * (GRID - 400.0), 2)
SURFACE = np.round(PANEL * (0.2 + 0.3 * np.sin(GRID / 200.0) ** 2), 2)
MATCHED = "Matching Type: Radiance @ 976 - 1010 / NIR-SWIR On"


def svc_text(
    wavelength=GRID,
    panel=PANEL,
    surface=SURFACE,
    percent=None,
    *,
    first="/*** Spectra Vista SIG Data ***/",
    separator="  ",
    data="data= ",
    end="\r\n",
    **keys,
):
    # Return a file; ``keys`` replace lines of the header: ``_`` is a blank there, None leaves one out
    header = {
        "name": "paint.sig",
        "instrument": "HI: 1152050 (HR-test)",
        "integration": "70.0, 9.0, 7.0, 200.0, 30.0, 7.0",
        "scan coadds": "28, 170, 205, 10, 61, 205",
        "error": "7, 3",
        "units": "Radiance, Radiance",
        "time": "27.05.2025 09:39:32, 27.05.2025 09:42:59",
        "longitude": "01332.0665E     , 01332.0490E     ",
        "latitude": "5225.9761N      , 5225.9748N      ",
        "gpstime": "073923.357      , 074250.357      ",
        "comm": "",
        "factors": "1.080, 1.133, 1.000 [Overlap: Preserve, Matching Type: None]",
    }
    header |= {key.replace("_", " "): value for key, value in keys.items()}
    lines = [first, *(f"{key}= {value}" for key, value in header.items() if value is not None), data]
    if percent is None:
        with np.errstate(all="ignore"):
            percent = 100.0 * np.asarray(surface) / np.asarray(panel)
    columns = (wavelength, panel, surface, percent)
    for nm, *values in zip(*columns, strict=True):
        lines.append(separator.join([f"{nm:.1f}", *(f"{value:.2f}" for value in values)]))
    return end.join(lines) + end


def german(text):
    # Return a file as a PC in Germany saves it: decimal commas, also inside lists
    lines, table = [], False
    for line in text.splitlines():
        key = line.partition("=")[0]
        if table or key in ("integration", "temp", "vis detector temp", "battery"):
            line = line.replace(".", ",")
        elif key == "factors":
            numbers, bracket, rest = line.partition("[")
            line = numbers.replace(".", ",") + bracket + rest
        elif key == "time":
            stamps = [stamp.split() for stamp in line.partition("= ")[2].split(", ")]
            line = f"time= {', '.join(_german_stamp(*parts) for parts in stamps)}"
        table |= key == "data"
        lines.append(line)
    return "\r\n".join(lines) + "\r\n"


def _german_stamp(date, clock, half=""):
    month, day, year = map(int, date.split("/"))
    hour, minute, second = map(int, clock.split(":"))
    hour = hour % 12 + 12 * (half == "PM") if half else hour
    return f"{day:02d}.{month:02d}.{year} {hour:02d}:{minute:02d}:{second:02d}"


# --- tests


VENDORS = conversion_factor("1e-10 W cm-2 sr-1 nm-1", "W m-2 sr-1 nm-1")


@pytest.fixture
def write(tmp_path: Path):
    def write_text(name: str = "paint.sig", **fields) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(svc_text(**fields), "utf-8", newline="")
        return path

    return write_text


# --- what a file becomes


def test_a_reflectance(write) -> None:
    found = open_svc(write(comm="left door, = fender", weather='{"wind": "=3"}'))
    assert (list(found.data_vars), found["reflectance"].dims) == (["reflectance"], ("spectrum", "wavelength"))
    np.testing.assert_array_equal(found["reflectance"].values[0], SURFACE / PANEL)
    np.testing.assert_array_equal(found["wavelength"].values, GRID)
    assert (found["wavelength"].attrs["units"], found.attrs) == ("nm", {"instrument": "SVC"})
    assert found["time"].values[0] == np.datetime64("2025-05-27T07:42:50.357", "ns")
    assert found["reference_time"].values[0] == np.datetime64("2025-05-27T07:39:23.357", "ns")
    assert found["latitude"].attrs["units"] == "degree"
    assert hp.open_svc is open_svc
    # the header is kept
    header = json.loads(found["header"].item())
    assert (header["comm"], header["weather"]) == ("left door, = fender", '{"wind": "=3"}')
    assert (header["scan coadds"], found["error_reference"].item()) == ("28, 170, 205, 10, 61, 205", 7)
    assert (found["error_target"].item(), found["factors"].item()) == (3, header["factors"])


@pytest.mark.parametrize(("scan", "scanned"), [("target", SURFACE), ("reference", PANEL)])
@pytest.mark.parametrize(
    ("quantity", "factor", "units"),
    [("radiance", VENDORS, "W m-2 sr-1 nm-1"), ("counts", 1.0, "count"), ("irradiance", 1e-6, "W m-2 nm-1")],
)
def test_every_quantity_of_either_scan(write, scan, scanned, quantity, factor, units) -> None:
    found = open_svc(
        write(units=f"{quantity.capitalize()}, {quantity.capitalize()}"),
        None if scan == "reference" else quantity,
        scan=scan,
    )
    np.testing.assert_allclose(found[quantity].values[0], scanned * factor, rtol=1e-14)
    assert (found[quantity].attrs["units"], found.attrs["scan"]) == (units, scan)
    clock = {"target": "07:42:50.357", "reference": "07:39:23.357"}[scan]
    assert found["time"].values[0] == np.datetime64(f"2025-05-27T{clock}", "ns")
    assert "reference_time" not in found.coords


@pytest.mark.parametrize(
    ("factors", "overlap", "matched", "numbers"),
    [
        ("0.795, 0.848, 1.000 [Overlap: Remove @ 970,1901, " + MATCHED
         + "]0.8, 0.844, 1.0 [Overlap: Preserve, Matching Type: None]",
         "removed @ 970, 1901 nm", True, (0.795, 0.848)),
        ("0.8, 0.9, 1.0 [Overlap: Preserve, Matching Type: None]0.7, 0.8, 1.0 [Overlap: Preserve, "
         + MATCHED + "]", "preserved", True, (0.8, 0.9)),
        ("1,171, 1,012, 1,000 [Overlap: Remove @ 990,1900, Matching Type: None]", "removed @ 990, 1900 nm",
         False, (1.171, 1.012)),
        ("1.000, 1.000, 0.000", "unknown", False, (1.0, 1.0)),
        ("nonsense", "unknown", False, (np.nan, np.nan)),
        (None, "unknown", False, (np.nan, np.nan)),
    ],
)  # fmt: skip
def test_factors(write, factors, overlap, matched, numbers) -> None:
    found = open_svc(write(factors=factors))
    assert (found["overlap"].item(), found["overlap_matched"].item()) == (overlap, matched)
    np.testing.assert_array_equal((found["factor_reference"].item(), found["factor_target"].item()), numbers)


def test_the_detectors_are_told_apart(write) -> None:
    names = open_svc(write())["detector"].values
    assert [str(name) for name in dict.fromkeys(names)] == ["VNIR", "SWIR1", "SWIR2"]
    assert GRID[names == "SWIR1"].min() == 965.0
    # of a file without overlap by its joins; of one that says nothing, not at all
    flat = np.arange(400.0, 2500.0, 10.0)
    removed = {"wavelength": flat, "panel": flat, "surface": flat / 2}
    names = open_svc(
        write("b.sig", **removed, factors="1.0, 1.0, 1.0 [Overlap: Remove @ 990,1900, Matching Type: None]")
    )["detector"].values
    assert (flat[names == "VNIR"].max(), flat[names == "SWIR2"].min()) == (990.0, 1910.0)
    assert "detector" not in open_svc(write("c.sig", **removed, factors=None)).coords


@pytest.mark.parametrize("joins", [None, (970.0, 1895.0), (1000.0, 1905.0)])
def test_trimming_takes_one_detector_at_each_join(write, joins) -> None:
    found = open_svc(write(), overlap="trim", joins=joins)
    first, second = joins or SVC_JOINS
    number = np.cumsum(np.diff(GRID, prepend=0.0) <= 0.0)
    expected = np.concatenate(
        [
            *[GRID[(number == 0) & (first >= GRID)], GRID[(number == 1) & (first < GRID) & (second >= GRID)]],
            GRID[(number == 2) & (second < GRID)],
        ]
    )
    np.testing.assert_array_equal(found["wavelength"].values, expected)
    assert np.all(np.diff(expected) > 0.0)
    assert found.attrs["overlap_trimmed_at_nm"] == [first, second]
    assert found["overlap"].item() == f"trimmed @ {first:g}, {second:g} nm"


def test_the_default_join_moves_into_a_short_overlap(write) -> None:
    grid = np.concatenate([np.arange(400.0, 1041.0, 10.0), np.arange(1030.0, 1900.0, 10.0)])
    path = write(wavelength=grid, panel=grid, surface=grid / 2)
    found = open_svc(path, overlap="trim")
    assert np.all(np.diff(found["wavelength"].values) == 10.0)
    assert found.attrs["overlap_trimmed_at_nm"] == [1020.0]
    expect_errors(
        (FormatError, "join-outside-overlap", lambda: open_svc(path, overlap="trim", joins=SVC_JOINS))
    )


# --- dialects


def test_a_german_file_is_its_english_twin(write, tmp_path) -> None:
    english = write("a.sig", time="5/27/2025 9:39:32 AM, 5/27/2025 9:42:59 PM")
    (tmp_path / "de").mkdir()
    (tmp_path / "de" / "a.sig").write_text(german(english.read_text()), newline="")
    ours, twin = open_svc(english), open_svc(tmp_path / "de" / "a.sig")
    same = ["header", "factors"]
    xr.testing.assert_identical(ours.drop_vars(same), twin.drop_vars(same))
    assert "," in (tmp_path / "de" / "a.sig").read_text().partition("data=")[2]


@pytest.mark.parametrize(
    "fields",
    [
        {"end": "\n"},
        {"end": "\r"},
        {"data": "data="},
        {"data": "DATA =  \t"},
        {"separator": "\t"},
        {"separator": " "},
        {"first": "\ufeff/*** Spectra Vista SIG Data ***/"},
        {"first": "/*** Spectra Vista HR-1024 ***/"},
        {"units": "radiance,Radiance"},
        {"comm": "Auto vor der T\u00fcr\nzweite Zeile"},
        {"external_data_set1": "0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0"},
    ],
)
def test_ways_to_write_the_same(write, fields) -> None:
    np.testing.assert_array_equal(open_svc(write(**fields))["reflectance"].values[0], SURFACE / PANEL)


def test_texts_in_utf_16(write) -> None:
    path = write()
    path.write_bytes(path.read_text().encode("utf-16"))
    np.testing.assert_array_equal(open_svc(path)["reflectance"].values[0], SURFACE / PANEL)


def test_a_dialect_is_a_row_of_a_table(write, tmp_path, monkeypatch) -> None:
    row = spectrum_texts.Dialect(
        "PSR",
        re.compile(rb"Comment:"),
        "'Comment:' of a .sed file",
        suffix=".sed",
        assigns=":",
        headings=1,
        separator=",",
        keys={"model": "instrument", "gps clock": "gpstime"},
        units={"w/m^2/sr/nm": "radiance"},
        columns=(0, 2, 1, 3),
        scale={"radiance": 1.0},
    )
    monkeypatch.setattr(spectrum_texts, "DIALECTS", (*spectrum_texts.DIALECTS, row))
    path = write_file(
        tmp_path / "door.sed",
        "Comment: left door\nModel: PSR-3500\nUnits: W/m^2/sr/nm\nGPS clock: 073923, 074250\nTime: "
        + "27.05.2025 09:39:32, 27.05.2025 09:42:59\nData:\nWvl Target Reference Percent\n"
        + "350,0.04,0.08,50\n351,0.02,0.08,25\n",
    )
    found = open_svc(tmp_path)
    assert (found.attrs["instrument"], found["instrument"].item()) == ("PSR", "PSR-3500")
    assert found["reflectance"].values.tolist() == [[0.5, 0.25]]
    assert found["time"].values[0] == np.datetime64("2025-05-27T07:42:50")
    assert open_svc(path, "radiance", scan="reference")["radiance"].values.tolist() == [[0.08, 0.08]]
    # its content is enough, whatever its name
    other = path.rename(tmp_path / "door.txt")
    assert [reference.attrs["instrument"] for reference in open_references([other, write()])] == [
        "PSR",
        "SVC",
    ]
    assert "PSR spectrum, PSR-3500" in describe_path(other)
    path.write_text("nothing to see")
    for read in (open_svc, describe_path):
        expect_refusals(
            (FormatError, "format-unknown", "SVC .sig file or 'Comment:' of a .sed file", partial(read, path))
        )


def test_a_file_that_was_resampled(write) -> None:
    grid = np.arange(350.0, 2501.0)
    found = open_svc(
        write(wavelength=grid, panel=grid, surface=grid / 4, instrument="HI: 1152050 (HR-1024i)"),
        overlap="trim",
    )
    assert found["reflectance"].sel(wavelength=550.0).item() == 0.25
    assert "overlap_trimmed_at_nm" not in found.attrs
    assert "detector" not in found.coords


def test_old_firmware_and_bytes_of_windows(write, tmp_path) -> None:
    path = write(longitude="11121.2335,W, 11121.2324,W", latitude="5330.5955,N, 5330.5964,S", comm="T\u00fcr")
    path.write_bytes(path.read_text("utf-8").encode("latin-1") + b"\r\n\r\n")
    found = open_svc(path)
    assert found["longitude"].item() == pytest.approx(-(111 + 21.2324 / 60))
    assert found["latitude"].item() == pytest.approx(-(53 + 30.5964 / 60))
    assert json.loads(found["header"].item())["comm"] == "T\u00fcr"


@pytest.mark.parametrize("blank", ["1.00", "0.00"])
def test_a_file_without_white_reference(write, blank) -> None:
    path = write(panel=np.full(len(GRID), float(blank)), percent=np.zeros(len(GRID)))
    assert list(open_svc(path)) == ["radiance"]
    expect_refusals(
        (FormatError, "reference-missing", lambda: open_svc(path, "reflectance")),
        (FormatError, "reference-missing", lambda: open_svc(path, "radiance", scan="reference")),
    )


@pytest.mark.parametrize("word", ["NaN", "n. def.", "Infinity", "\u221e", "1.#INF", "-1.#IND", "0.00"])
def test_a_reference_of_zero_is_nan_and_said(tmp_path, word) -> None:
    panel = np.where(GRID == 500.0, 0.0, PANEL)
    text = svc_text(panel=panel, percent=np.where(panel == 0, 12345.0, 100 * SURFACE / PANEL))
    path = write_file(tmp_path / "a.sig", text.replace("12345.00", word), "utf-8")
    with pytest.warns(PaintWarning, match="samples-undefined"):
        found = open_svc(path)["reflectance"]
    np.testing.assert_array_equal(np.isnan(found.values[0]), GRID == 500.0)


def test_a_column_that_contradicts_the_scans_is_flagged(write) -> None:
    percent = 100 * SURFACE / PANEL
    percent[10:13] += 0.02
    path = write(percent=percent)
    with pytest.warns(PaintWarning, match="reflectance-conflict"):
        found = open_svc(path)
    np.testing.assert_array_equal(found["reflectance"].values[0], SURFACE / PANEL)
    assert found["column_difference"].item() == pytest.approx(2e-4, abs=5.1e-5)


@pytest.mark.parametrize(
    ("units", "quantity", "code"),
    [
        ("Counts, Counts", "reflectance", "integration-time-conflict"),
        ("Radiance, Counts", "reflectance", "units-conflict"),
        ("Radiance, Counts", "radiance", "quantity-wrong"),
    ],
)
def test_scans_that_do_not_match(write, units, quantity, code) -> None:
    path = write(units=units)
    assert list(open_svc(path)) == ["counts"]
    expect_refusals((FormatError, code, lambda: open_svc(path, quantity)))
    path = write(units="Counts, Counts", integration="70,0, 9,0, 7,0, 70,0, 9,0, 7,0")
    np.testing.assert_array_equal(open_svc(path, "reflectance")["reflectance"].values[0], SURFACE / PANEL)


# --- several files


def test_folders_globs_and_lists(write, tmp_path) -> None:
    paths = [write(f"{day}/{name}.sig") for day in ("mon", "tue") for name in ("red", "blue")]
    (tmp_path / "mon" / "notes.txt").write_text("no spectrum")
    assert open_svc(tmp_path / "mon")["spectrum"].values.tolist() == ["blue", "red"]
    assert open_svc(str(tmp_path / "*" / "red.sig"))["spectrum"].values.tolist() == ["mon/red", "tue/red"]
    found = open_svc([*paths, paths[0]])
    assert found["spectrum"].values.tolist() == ["mon/red", "mon/blue", "tue/red", "tue/blue", "mon/red (2)"]
    assert found.sel(spectrum="tue/blue")["source"].item() == "blue.sig"
    for nothing in ([], "none*.sig", tmp_path):
        expect_error(FormatError, "file-not-found" if nothing else "empty-input", partial(open_svc, nothing))


def test_all_bad_files_are_named_at_once(write, tmp_path) -> None:
    good = write("good.sig").read_bytes()
    (tmp_path / "cut.sig").write_bytes(good[:-9])
    (tmp_path / "head.sig").write_bytes(good.partition(b"data=")[0])
    (tmp_path / "note.sig").write_text("nothing to see")
    (tmp_path / "ger.sig").write_text("///GER SIGNATUR FILE///\n")
    os.mkfifo(tmp_path / "pipe.sig")
    raised = expect_error(FormatError, None, lambda: open_svc([tmp_path, tmp_path / "gone.sig"]))
    assert [
        name
        for name in (
            "cut.sig",
            "head.sig",
            "note.sig",
            "ger.sig",
            "pipe.sig",
            "gone.sig",
            "SVC's software converts",
        )
        if name not in str(raised)
    ] == []
    assert "good.sig" not in str(raised)


def test_files_that_differ(write) -> None:
    flat = np.arange(400.0, 990.0, 10.0)
    first, other = write("a.sig"), write("b.sig", wavelength=flat, panel=flat, surface=flat / 2)
    expect_errors(
        (FormatError, r"a\.sig.*grid-mismatch", lambda: open_svc([first, other])),
        (
            FormatError,
            "quantity-ambiguous",
            lambda: open_svc([first, write("c.sig", units="Counts, Counts")]),
        ),
    )


@pytest.mark.parametrize(
    ("options", "error", "told"),
    [
        (
            {"quantity": "dn", "scan": "both", "overlap": "remove", "joins": (1900, 990)},
            SchemaError,
            r"(?s)quantity='dn'.*scan='both'.*overlap='remove'.*joins=\(1900, 990\)",
        ),
        ({"overlap": "trim", "joins": 990.0}, SchemaError, "joins=990"),
        ({"quantity": "reflectance", "scan": "reference"}, SchemaError, "option-conflict"),
        ({"utc_offset_h": 3600}, TimeError, "utc_offset_h=.*hours.*value-out-of-range"),
    ],
)
def test_arguments_that_are_refused(write, options, error, told) -> None:
    expect_errors((error, told, lambda: open_svc(write(), **options)))


# --- what is refused in a file


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"units": None}, "no line 'units='"),
        ({"units": "Furlongs, Counts"}, "units-unknown"),
        ({"data": "date="}, "no line 'data='"),
        ({"data": "comm= other\r\ndata="}, "'comm'.*key-duplicate"),
        ({"wavelength": GRID[:1], "panel": PANEL[:1], "surface": SURFACE[:1]}, "table-missing"),
        ({"wavelength": -GRID}, "wavelength-range"),
        ({"wavelength": np.where(GRID == 500.0, 5.0, GRID)}, "wavelength-unordered"),
        ({"separator": "; "}, "row-unreadable"),
        ({"instrument": "HI: 1152050 (HR-1024i)"}, "file-truncated"),
        (
            {
                "wavelength": GRID[:9],
                "panel": PANEL[:9],
                "surface": SURFACE[:9],
                "factors": "1.0, 1.0, 1.0 [Overlap: Remove @ 985,1906, Matching Type: None]",
            },
            "file-truncated",
        ),
    ],
)
def test_damage(write, fields, problem) -> None:
    if "wavelength" in fields and len(fields["wavelength"]) == len(GRID):
        fields = {**fields, "percent": 100 * SURFACE / PANEL}
    raised = expect_error(
        FormatError,
        problem,
        lambda: open_svc(write(comm="one", **fields) if "comm" not in fields else write(**fields)),
    )
    assert "paint.sig" in str(raised)


def test_detectors_in_no_order(write) -> None:
    grid = np.array([3000.0, 3010.0, 965.0, 970.0])
    path = write(wavelength=grid, panel=grid, surface=grid / 2)
    assert open_svc(path).sizes["wavelength"] == 4
    expect_errors((FormatError, "wavelength-unordered", lambda: open_svc(path, overlap="trim")))


def test_declared_or_not_a_huge_table_is_refused_early(tmp_path) -> None:
    path = write_file(
        tmp_path / "big.sig", svc_text().partition("data=")[0] + "data=\n" + "1 1 1 1\n" * 70_000
    )
    expect_errors((FormatError, "file-too-large", lambda: open_svc(path)))
    path.write_text(svc_text().replace("data=", "x\n" * 500_000 + "data="))
    expect_errors((FormatError, "500171 lines", lambda: open_svc(path)))
    path.write_text(svc_text(factors="1.0, " * 200_000, comm="[" * 10**6, error="9" * 10**6))
    assert np.isfinite(open_svc(path)["factor_target"].item())
    path.write_bytes(b"/*** Spectra Vista SIG Data ***/\n" + bytes(5 * 2**20))
    expect_errors((FormatError, "SVC spectrometer's file", lambda: open_svc(path)))


@pytest.mark.parametrize("head", [b"", b"as7\0", b"/***", b"Spectra Vista", b"\xff\xfe/***"])
def test_what_is_no_sig_file(head) -> None:
    assert dialect_of(head) is None


def test_metadata_that_cannot_be_read_is_missing_and_said(write) -> None:
    path = write(latitude="here, there", gpstime="noon, 256199", error="a, b", integration="x")
    with pytest.warns(PaintWarning) as found:
        opened = open_svc(path, utc_offset_h=2)
    said = " ".join(str(warning.message) for warning in found)
    expect_words(said, "position-unreadable", "gps-time-unreadable")
    assert np.isnan(opened["latitude"].item())
    assert opened["error_target"].item() == -1
    assert opened["time"].values[0] == np.datetime64("2025-05-27T07:42:59", "ns")
    assert "cannot be read" in describe_path(path)


# --- properties


@given(
    values=st.lists(st.tuples(st.integers(1, 10**9), st.integers(-(10**6), 10**9)), min_size=2, max_size=30),
    comma=st.booleans(),
)
def test_any_scans_come_back(tmp_path, values, comma) -> None:
    panel, surface = (np.array(column) / 100.0 for column in zip(*values, strict=True))
    grid = 400.0 + np.arange(len(values)) / 10.0
    text = svc_text(grid, panel, surface, time="5/27/2025 9:39:32 AM, 5/27/2025 9:42:59 AM")
    path = write_file(tmp_path / "any.sig", german(text) if comma else text)
    file = read_svc(path)
    np.testing.assert_array_equal(file.reference, panel)
    np.testing.assert_array_equal(file.target, surface)
    np.testing.assert_array_equal(file.wavelength, np.round(grid, 1))
    assert not file.target.flags.writeable
    if file.has_reference:  # and no warning, since warnings are errors
        np.testing.assert_array_equal(open_svc(path)["reflectance"].values[0], surface / panel)


@given(latitude=st.floats(-90, 90), longitude=st.floats(-180, 180), comma=st.booleans(), blanks=st.booleans())
def test_any_position_comes_back(latitude, longitude, comma, blanks) -> None:
    def text(angle, width, letters):
        degrees, rest = divmod(round(abs(angle) * 60e4), 600_000)
        made = f"{degrees:0{width}d}{rest // 10_000:02d}.{rest % 10_000:04d}{letters[angle < 0]}"
        return (made.replace(".", ",") if comma else made).ljust(16 if blanks else 0)

    header = {"latitude": f", {text(latitude, 2, 'NS')}", "longitude": f", {text(longitude, 3, 'EW')}"}
    found = position_of(header, 1)
    assert np.isnan(position_of(header, 0)).all()
    if np.isnan(found[0]):  # exactly on the equator and Greenwich, which is what files without a fix may hold
        assert abs(latitude) + abs(longitude) < 1e-5
    else:
        assert found == pytest.approx((latitude, longitude), abs=1e-6)


# --- the simulator's own writer


@pytest.mark.parametrize(("position", "zone"), [((43.0848, -77.6749), -5), ((-35.3, 149.1), 11)])
def test_what_the_simulator_writes_comes_back(tmp_path, position, zone) -> None:
    grid = SVC_WAVELENGTH
    white = 0.08 * np.exp(-(((grid - 550.0) / 700.0) ** 2))
    share = 0.2 + 0.1 * np.sin(grid / 100.0)
    stamp = int(np.datetime64("2024-05-21T15:33:07", "s").astype(int))
    write_svc(
        tmp_path / "red.sig", white, white * share, stamps=(stamp, stamp + 15), utc_offset=zone * 3600,
        position=position, sun=(40.0, 120.0),
    )  # fmt: skip
    found = open_svc(tmp_path)
    np.testing.assert_array_equal(found["wavelength"].values, grid)
    np.testing.assert_allclose(found["reflectance"].values[0], share, atol=1.5e-2 * 1e-6 / white.min())
    np.testing.assert_allclose(open_svc(tmp_path, "radiance")["radiance"].values[0], white * share, atol=6e-9)
    assert found["time"].values[0] == np.datetime64(stamp + 15, "s")
    assert found["reference_time"].values[0] == np.datetime64(stamp, "s")
    assert (found["latitude"].item(), found["longitude"].item()) == pytest.approx(position, abs=1e-6)
    assert (found["overlap"].item(), found["overlap_matched"].item()) == ("preserved", False)
    assert np.all(np.diff(open_svc(tmp_path, overlap="trim")["wavelength"].values) > 0.0)


# --- clocks of SVC files: stamps of any locale, and UTC by the GPS ----------------------------------------


MARCH = dt.datetime(2024, 3, 5, 17, 8, 9)


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (("05.03.2024 17:08:09", "5.3.24 17:08:09", "2024-03-05 17:08:09", "2024-03-05T17:08:09",
          "2024/03/05 5:08:09 PM", "05-Mar-24 17.08.09", "05-m\u00e4r-24 17.08.09", "5-mar-2024 17.08.09",
          "05-03-2024 17:08:09", "2024/3/5 17:08:09.000"), MARCH),
        (("7/29/2017 1:54:23 AM",), dt.datetime(2017, 7, 29, 1, 54, 23)),
        (("16/10/2024 10:47:58",), dt.datetime(2024, 10, 16, 10, 47, 58)),
        (("7/18/10 9:47:09 AM",), dt.datetime(2010, 7, 18, 9, 47, 9)),
        (("4/4/2024 12:00:00 AM",), dt.datetime(2024, 4, 4)),
        (("4/4/2024 12:00:00 p.m.",), dt.datetime(2024, 4, 4, 12)),
        (("11-lug-15 13.08.32", "11-juil.-15 13.08.32"), dt.datetime(2015, 7, 11, 13, 8, 32)),
        (("11-\u00b2\u00b2\u00b2-15 13.08.32", "11 juillet 2015", "", "now", "32/13/2024 10:00:00",
          "2024-02-30 10:00:00", "4/4/2024 13:00:00 PM", "4/4/2024 25:00:00", "4/4/0 10:00:00",
          "0000-00-00 00:00:00", "\u0664/\u0664/2024 10:00:00x", "1/2/2024" + " " * 200), None),
    ],
)  # fmt: skip
def test_stamps(texts, expected) -> None:
    stamps = [read_stamp(text) for text in texts]
    assert [stamp and stamp.read(None) for stamp in stamps] == [expected] * len(texts)


@given(moment=st.datetimes(dt.datetime(1995, 1, 1), dt.datetime(2090, 1, 1)))
def test_every_date_is_read_in_either_order(moment) -> None:
    moment = moment.replace(microsecond=0)
    european = read_stamp(f"{moment:%d/%m/%Y %H:%M:%S}")
    american = read_stamp(f"{moment:%m/%d/%Y %I:%M:%S %p}")
    assert european.read(True) == american.read(False) == moment
    is_ambiguous = moment.day <= 12 and moment.day != moment.month
    assert european.read(None) == american.read(None) == (None if is_ambiguous else moment)


def test_other_files_of_an_instrument_settle_the_order() -> None:
    def orders(*dates):
        return orders_of((name, read_stamp(f"{date} 10:00:00")) for name, date in dates)

    assert orders(("a", "5/6/2024"), ("a", "5/16/2024"), ("b", "5/6/2024")) == {"a": False}
    assert orders(("a", "16/5/2024"), ("b", "5/16/2024")) == {"a": True, "b": False}
    assert orders(("a", "16/5/2024"), ("a", "5/16/2024")) == {}
    assert orders(("a", "16.05.2024")) == {}  # another way to write, which tells nothing about slashes


def test_gps_times() -> None:
    times = [read_gps_time(text) for text in ("090724.786", "235960.000", "90724,5", "")]
    at = dt.timedelta(hours=9, minutes=7)
    assert times == [
        at + dt.timedelta(seconds=24.786),
        dt.timedelta(days=1),
        at + dt.timedelta(seconds=24.5),
        None,
    ]
    for text in ("noon", "2460", "240000", "106000", "100061", "-10000", "1e5", "9" * 500):
        expect_error(ValueError, "time of day, HHMMSS", partial(read_gps_time, text))


@given(
    moment=st.datetimes(dt.datetime(1995, 1, 2), dt.datetime(2090, 1, 1)),
    zone=st.integers(-48, 56),
    wrong=st.integers(-1800, 1800),
)
def test_gps_time_finds_its_date(moment, zone, wrong) -> None:
    # Anywhere on earth, with a local clock that is up to half an hour wrong
    hours = zone / 4.0
    longitude = max(-180.0, min(180.0, 15.0 * hours))
    local = moment + dt.timedelta(hours=hours, seconds=wrong)
    gps = moment - dt.datetime.combine(moment.date(), dt.time())
    assert (utc_of(local, gps, longitude, None), utc_of(local, gps, float("nan"), hours)) == (moment, moment)
    assert utc_of(local, None, longitude, hours) == local - dt.timedelta(hours=hours)
    assert utc_of(local, None, longitude, None) is None


def test_times_of_several_files(tmp_path) -> None:
    blank = {"gpstime": " , ", "latitude": " , ", "longitude": " , "}
    for name, date in {"a": "5/6/2025", "b": "5/27/2025"}.items():
        (tmp_path / f"{name}.sig").write_text(svc_text(time=f"{date} 9:39:32 AM, {date} 9:42:59 AM", **blank))
    with pytest.warns(PaintWarning, match="a.sig.*date-ambiguous"):
        assert np.isnat(open_svc(tmp_path / "a.sig", utc_offset_h=-5)["time"].values).all()
    found = open_svc(tmp_path, utc_offset_h=-5)["time"].values
    np.testing.assert_array_equal(
        found, np.array(["2025-05-06T14:42:59", "2025-05-27T14:42:59"], "datetime64[ns]")
    )
    found = open_svc(tmp_path, utc_offset_h=-5, dayfirst=True)["time"].values
    assert found[0] == np.datetime64("2025-06-05T14:42:59")
    with pytest.warns(PaintWarning, match=r"a\.sig, b\.sig \[zone-"):
        assert np.isnat(open_svc(tmp_path)["time"].values).all()


def test_gps_wins_over_a_zone_that_contradicts_it(tmp_path) -> None:
    path = write_file(tmp_path / "a.sig", svc_text())
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        found = open_svc(path, utc_offset_h=-7)
    assert found["time"].values[0] == np.datetime64("2025-05-27T07:42:50.357")
    assert open_svc(path, utc_offset_h=2)["time"].values[0] == found["time"].values[0]


@pytest.mark.parametrize("time", [None, "", "long ago, yesterday", "27.05.2025 09:39:32"])
def test_times_that_are_missing(tmp_path, time) -> None:
    path = write_file(tmp_path / "a.sig", svc_text(time=time))
    with pytest.warns(PaintWarning, match="time-unreadable"):
        found = open_svc(path)
    assert np.isnat(found["reference_time"].values[0])
    # one stamp alone is the target's
    assert np.isnat(found["time"].values[0]) == (time != "27.05.2025 09:39:32")


# --- every real ``.sig`` file beside the project, against values known from elsewhere ---------------------


NAMES = [
    "241016_1051_R009_T014", "ACPL_D2_P1_B_1_001", "ACPL_D2_P1_T_1_WR_000", "BNL13001_000",
    "BNL13001_000_moc", "BNL13002_000", "BNL13002_000_moc", "HR.020824.0000", "gr070214_003",
]  # fmt: skip
DATE = {"dayfirst": False}  # of the files whose dates make sense both ways; their names settle it


@pytest.fixture
def folder(shared_data: Path) -> Path:
    return shared_data / "svc_sig"


def opened(paths: object, **options: object) -> xr.Dataset:
    # Open files whose clocks are no matter, without the warnings that they deserve
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return open_svc(paths, **options)


@pytest.mark.real_data
def test_every_file_is_tested(folder: Path) -> None:
    assert sorted(path.stem for path in folder.iterdir()) == sorted(NAMES)


@pytest.mark.real_data
@pytest.mark.parametrize("name", NAMES)
def test_reflectance_is_the_files_own_with_more_digits(folder: Path, name: str) -> None:
    path = folder / f"{name}.sig"
    found = opened(path)
    table = np.loadtxt(
        [line for line in path.read_text("latin-1").splitlines() if line[:1].isdigit()], dtype=np.float64
    )
    np.testing.assert_array_equal(found["wavelength"].values, table[:, 0])
    np.testing.assert_allclose(found["reflectance"].values[0], table[:, 2] / table[:, 1], rtol=1e-15)
    np.testing.assert_allclose(found["reflectance"].values[0], table[:, 3] / 100.0, atol=5.5e-5)
    assert 0.0 < found["column_difference"].item() < 5.5e-5
    assert found["reflectance"].dtype == found["wavelength"].dtype == np.float64
    assert found["reflectance"].attrs["units"] == "1"
    assert found["reflectance"].attrs["reflectance_scale"] == "relative"
    assert found["spectrum"].values.tolist() == [name]


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "rows", "overlap", "matched", "factors", "errors"),
    [
        ("ACPL_D2_P1_B_1_001", 1024, "preserved", False, (1.080, 1.133), (7, 3)),
        ("BNL13001_000", 1024, "preserved", False, (0.800, 0.844), (6, 1)),
        ("BNL13001_000_moc", 982, "removed @ 970, 1901 nm", True, (0.795, 0.848), (6, 1)),
        ("gr070214_003", 991, "removed @ 985, 1906 nm", True, (0.993, 0.990), (1, 1)),
        ("HR.020824.0000", 1024, "preserved", False, (1.0, 1.0), (0, 0)),
        ("241016_1051_R009_T014", 1024, "preserved", False, (1.1, 1.1), (0, 0)),
    ],
)
def test_what_files_say_of_overlap_and_errors(
    folder: Path, name: str, rows: int, overlap: str, matched: bool, factors: tuple, errors: tuple
) -> None:
    found = opened(folder / f"{name}.sig")
    assert (found.sizes, found["overlap"].item()) == ({"spectrum": 1, "wavelength": rows}, overlap)
    assert found["overlap_matched"].item() == matched
    assert (found["factor_reference"].item(), found["factor_target"].item()) == factors
    assert (found["error_reference"].item(), found["error_target"].item()) == errors
    assert np.all(np.diff(found["wavelength"].values) > 0) == overlap.startswith("removed")
    header = json.loads(found["header"].item())
    assert (header["factors"], found["instrument"].item()) == (found["factors"].item(), header["instrument"])


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["BNL13001_000", "BNL13002_000", "ACPL_D2_P1_B_1_001", "HR.020824.0000"])
def test_factors_are_the_first_detector_over_the_second_of_both_scans(folder: Path, name: str) -> None:
    # they belong to reference and target, not to detectors: the ratio of radiances where these overlap
    file = read_svc(folder / f"{name}.sig")
    first, second = slice(0, file.starts[1]), slice(file.starts[1], file.starts[2])
    at = np.arange(978.0, 1009.0)
    found = opened(folder / f"{name}.sig")
    for scan, key in ((file.reference, "factor_reference"), (file.target, "factor_target")):
        ratio = np.interp(at, file.wavelength[first], scan[first]) / np.interp(
            at, file.wavelength[second], scan[second]
        )
        assert found[key].item() == pytest.approx(ratio.mean(), abs=0.012)


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["BNL13001_000", "BNL13002_000"])
def test_matching_scales_the_first_detector_by_a_ramp(folder: Path, name: str) -> None:
    raw = folder / f"{name}.sig"
    matched = folder / f"{name}_moc.sig"
    for scan in ("reference", "target"):
        before = opened(raw, quantity="radiance", scan=scan, overlap="trim", joins=(970, 1901))["radiance"]
        after = opened(matched, quantity="radiance", scan=scan)["radiance"]
        np.testing.assert_array_equal(before["wavelength"], after["wavelength"])
        np.testing.assert_array_equal(before["detector"], after["detector"])
        vnir = (before["detector"] == "VNIR").values
        # within the matching zone (976 to 1010 nm) the vendor fades one detector into the other
        beyond = (before["wavelength"] > 1010.0).values
        np.testing.assert_array_equal(before.values[0, beyond], after.values[0, beyond])
        zone = ~vnir & ~beyond
        assert np.all(np.abs(after.values[0, zone] / before.values[0, zone] - 1.0) < 0.06)
        sure = vnir & (before.values[0] > 0.0)
        ratio = after.values[0, sure] / before.values[0, sure]
        rounding = 0.02e-6 / before.values[0, sure]
        assert np.all(np.diff(ratio) > -(rounding[1:] + rounding[:-1]))
        assert ratio[0] == pytest.approx(1.0, abs=2e-3)
        assert 1.1 < ratio[-1] < 1.3


@pytest.mark.real_data
def test_raw_and_matched_files_do_not_mix_unless_trimmed_alike(folder: Path) -> None:
    both = [folder / "BNL13001_000.sig", folder / "BNL13001_000_moc.sig"]
    raised = expect_error(FormatError, None, lambda: opened(both))
    expect_words(str(raised), "1024 from", "overlap kept: BNL13001_000.sig", "982 from", "joins=(970, 1901)")
    expect_errors(
        (FormatError, "grid-mismatch", lambda: opened([folder / "ACPL_D2_P1_B_1_001.sig", both[0]]))
    )
    found = opened(both, overlap="trim", joins=(970, 1901))
    assert found.sizes == {"spectrum": 2, "wavelength": 982}
    assert found["overlap"].values.tolist() == ["trimmed @ 970, 1901 nm", "removed @ 970, 1901 nm"]
    assert found["overlap_matched"].values.tolist() == [False, True]


@pytest.mark.real_data
@pytest.mark.parametrize("name", NAMES)
def test_trimmed_wavelengths_increase(folder: Path, name: str) -> None:
    kept, trimmed = opened(folder / f"{name}.sig"), opened(folder / f"{name}.sig", overlap="trim")
    at = trimmed["wavelength"].values
    assert np.all(np.diff(at) > 0.0)
    assert at.size == (kept["wavelength"].size if "removed" in kept["overlap"].item() else at.size)
    for detector in ("VNIR", "SWIR1", "SWIR2"):
        ours = trimmed["reflectance"].isel(wavelength=(trimmed["detector"] == detector).values)
        np.testing.assert_array_equal(
            ours,
            kept["reflectance"]
            .isel(wavelength=(kept["detector"] == detector).values)
            .sel(wavelength=ours["wavelength"]),
        )


@pytest.mark.real_data
def test_times_and_places(folder: Path) -> None:
    found = open_svc(folder / "HR.020824.0000.sig", **DATE)
    assert found["time"].values[0] == np.datetime64("2024-02-08T09:07:53.786", "ns")
    assert found["reference_time"].values[0] == np.datetime64("2024-02-08T09:07:24.786", "ns")
    assert found["latitude"].item() == pytest.approx(52 + 25.9416 / 60, abs=1e-9)
    assert found["longitude"].item() == pytest.approx(13 + 32.0176 / 60, abs=1e-9)
    found = open_svc(folder / "ACPL_D2_P1_B_1_001.sig", **DATE)
    assert found["longitude"].item() == pytest.approx(-(92 + 31.1626 / 60), abs=1e-9)
    assert found["time"].values[0] == np.datetime64("2015-08-06T14:37:08", "ns")
    assert found["time"].dtype == np.dtype("datetime64[ns]")
    # no fix: day first is plain, the zone is not
    with pytest.warns(PaintWarning, match="zone-missing"):
        found = open_svc(folder / "241016_1051_R009_T014.sig")
    assert np.isnat(found["time"].values[0])
    assert np.isnan(found["latitude"].item())
    found = open_svc(folder / "241016_1051_R009_T014.sig", utc_offset_h=2)
    assert found["time"].values[0] == np.datetime64("2024-10-16T08:51:32", "ns")
    # a date that may be either is no date
    with pytest.warns(PaintWarning, match="date-ambiguous"):
        found = open_svc(folder / "HR.020824.0000.sig")
    assert np.isnat(found["time"].values[0])
    found = open_svc(folder / "HR.020824.0000.sig", dayfirst=True)
    assert found["time"].values[0] == np.datetime64("2024-08-02T09:07:53.786", "ns")


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["gr070214_003", "ACPL_D2_P1_B_1_001", "BNL13001_000_moc"])
def test_the_german_twin_is_the_same(folder: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.sig"
    path.write_text(german((folder / path.name).read_text("latin-1")), "latin-1")
    assert "0,99" in path.read_text() or "1,0" in path.read_text() or "0,8" in path.read_text()
    ours = opened(folder / path.name, **DATE, utc_offset_h=-5)
    twin = opened(path, utc_offset_h=-5)
    for key, coord in {
        key: coord for key, coord in ours.coords.items() if key not in ("header", "factors")
    }.items():
        xr.testing.assert_identical(coord.variable, twin[key].variable)
    np.testing.assert_array_equal(ours["reflectance"], twin["reflectance"])
    assert not np.isnat(twin["time"].values).any()


@pytest.mark.real_data
def test_info(folder: Path) -> None:
    text = describe_path(folder / "BNL13001_000_moc.sig")
    expect_words(
        text,
        "SVC spectrum, HI: 6142041 (HR-1024i)",
        "338.2 to 2517.2 nm, 982 channels",
        "removed @ 970, 1901 nm",
        "Radiance @ 976 - 1010 / NIR-SWIR On (factors 0.795, 0.848, 1.000)",
        "7/29/2017 1:55:32 AM",
        "reference 6, target 1",
    )
    text = describe_path(folder / "HR.020824.0000.sig")
    expect_words(text, "52.432360, 13.533627", "090753.786 UTC")


# ---  ---


ASD_GRID = np.arange(350.0, 1051.0)
COUNTS = 1000.0 + np.arange(len(ASD_GRID)) * 3.0
LAMP, LAMP_COUNTS, PANEL_VALUES = (
    np.full(len(ASD_GRID), 0.2),
    np.full(len(ASD_GRID), 4000.0),
    np.full(len(ASD_GRID), 0.99),
)
BLOCKS = {1: (0, PANEL_VALUES), 2: (0, LAMP), 3: (136, LAMP_COUNTS)}


def at(array, nanometres):
    return float(array.sel(wavelength=nanometres).squeeze())


# --- real files


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "version", "offset", "local", "counts"),
    [
        ("v6sample00000.asd", 6, -6.0, dt.datetime(2009, 7, 21, 12, 39, 29), (350.0, 29.31173796)),
        ("v7sample00000.asd", 7, None, dt.datetime(2009, 7, 21, 13, 36, 11), None),
        ("v7sample00003.asd", 7, -6.0, dt.datetime(2009, 7, 21, 13, 37, 7), None),
        ("v7sample00005.asd", 7, -6.0, dt.datetime(2009, 7, 21, 13, 38, 16), None),
        ("soil.asd", 8, 12.0, dt.datetime(2015, 8, 11, 16, 1, 8), None),
        ("handheld_raw.asd", 7, None, dt.datetime(2016, 5, 21, 15, 11, 58), (325.0, 1348.10969471)),
        ("ribb00001.asd", 7, 2.0, dt.datetime(2018, 8, 8, 10, 3, 28), None),
        ("ww00045.asd", 7, 2.0, dt.datetime(2022, 4, 21, 12, 51, 28), None),
    ],
)
def test_real_headers(shared_data, name, version, offset, local, counts):
    file = read_asd(shared_data / "asd_binary" / name)
    assert (file.version, file.utc_offset_h, file.local_time) == (version, offset, local)
    assert file.spectrum.dtype == file.wavelength.dtype == np.float64
    if counts:
        assert file.spectrum[file.wavelength == counts[0]] == pytest.approx(counts[1], rel=1e-9)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("v6sample00000.asd", {550: 0.838715695, 1000: 0.878999151}),
        ("v7sample00003.asd", {550: 0.852098975, 1000: 0.892995520}),
        ("v7sample00005.asd", {550: 0.847199224}),
        ("soil.asd", {550: 0.253994864, 1000: 0.471799076}),
    ],
)
def test_real_reflectance(shared_data, name, known):
    opened = open_asd(shared_data / "asd_binary" / name, "reflectance")
    assert opened["reflectance"].dims == ("spectrum", "wavelength")
    assert opened["reflectance"].attrs["units"] == "1"
    for nanometres, value in known.items():
        assert at(opened["reflectance"], nanometres) == pytest.approx(value, abs=1e-9)


@pytest.mark.real_data
@pytest.mark.parametrize("number", [1, 2, 3])
def test_reflectance_is_the_vendors(shared_data, number):
    folder = shared_data / "asd_binary"
    np.testing.assert_allclose(
        open_asd(folder / f"ribb0000{number}.asd")["reflectance"].values[0],
        read_asd_text(folder / f"ribb0000{number}.asd.txt").values[0],
        rtol=1e-12,
        atol=1e-12,
    )


@pytest.mark.real_data
def test_real_details(shared_data):
    folder = shared_data / "asd_binary"
    sample = read_asd(folder / "v6sample00000.asd")
    assert (sample.integration_ms, sample.instrument_number) == (68.0, 6355)
    assert read_asd(folder / "soil.asd").integration_ms == 8.5
    panel = read_asd(folder / "v7sample00005.asd").calibrations["ABS"]
    assert (panel.name, panel.values[0]) == ("abs64665_54.ref", pytest.approx(0.98625571, abs=1e-8))
    fore_optic = read_asd(folder / "v7sample00000.asd").calibrations["FO"]
    assert fore_optic.integration_ms == 136.0
    handheld = read_asd(folder / "handheld_raw.asd")
    assert (handheld.instrument, handheld.splices, handheld.reference) == ("HandHeld", (1075.0, -1.0), None)
    expect_errors(
        (
            FormatError,
            "reference-missing",
            lambda: open_asd(folder / "handheld_raw.asd", "reflectance", utc_offset_h=12),
        )
    )


@pytest.mark.real_data
def test_real_absolute_reflectance(shared_data):
    path = shared_data / "asd_binary" / "v7sample00005.asd"
    relative = open_asd(path)["reflectance"]
    absolute = open_asd(path, absolute=True)["reflectance"]
    assert at(relative, 550) == pytest.approx(0.847199224, abs=1e-9)
    np.testing.assert_array_equal(
        absolute.values, relative.values * read_asd(path).calibrations["ABS"].values
    )
    assert at(absolute, 350) == pytest.approx(at(relative, 350) * 0.98625571, rel=1e-8)
    assert relative.attrs["reflectance_scale"] == "relative"
    assert (absolute.attrs["reflectance_scale"], absolute.attrs["panel"]) == ("absolute", "abs64665_54.ref")
    expect_errors(
        (
            FormatError,
            "calibration-missing",
            lambda: open_asd(shared_data / "asd_binary" / "v7sample00003.asd", absolute=True),
        )
    )


@pytest.mark.real_data
def test_every_real_file_opens_as_what_it_is(shared_data):
    files = sorted((shared_data / "asd_binary").glob("*.asd"))
    assert len(files) == 12
    for path in files:
        file = read_asd(path)
        held = {"reflectance": "reflectance", "radiance": "radiance", "raw": "counts"}[file.data_type]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PaintWarning)  # saturated samples; what contradicts the zone
            opened = open_asd(path, utc_offset_h=0 if file.utc_offset_h is None else None)
        assert (list(opened), opened["spectrum"].values.tolist()) == ([held], [path.stem])
        for name in ("time", "latitude", "longitude", "altitude"):
            assert opened[name].dims == ("spectrum",)
        assert np.isnan(opened["latitude"].item()) == (not path.name.startswith("ww"))
        if file.reference is not None:
            expected = file.spectrum / file.reference
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", PaintWarning)
                values = open_asd(path, "reflectance")["reflectance"].values[0]
            used = np.isfinite(values)
            assert used.mean() > 0.3
            np.testing.assert_array_equal(values[used], expected[used])


@pytest.mark.real_data
def test_real_radiance_ends_at_the_splice(shared_data):
    radiance = open_asd(shared_data / "asd_binary" / "v7sample00000.asd", utc_offset_h=-6)["radiance"]
    for nanometres, value in {350: 0.00036096, 550: 0.034134, 700: 0.11626, 1000: 0.35085}.items():
        assert at(radiance, nanometres) == pytest.approx(value, rel=5e-5)
    assert (radiance["wavelength"].values[-1], radiance.attrs["units"]) == (1000.0, "W m-2 sr-1 nm-1")


@pytest.mark.real_data
def test_of_an_unknown_zone_the_time_is_nat(shared_data, write_asd):
    # Rationale: as `open_svc` does; a spectrum of a paint is of use without its time
    path = shared_data / "asd_binary" / "v7sample00000.asd"
    with pytest.warns(PaintWarning, match="zone-missing"):
        opened = open_asd(path)
    assert np.isnat(opened["time"].values).all()
    np.testing.assert_array_equal(
        opened["radiance"].values, open_asd(path, utc_offset_h=-6)["radiance"].values
    )
    # others of the series keep theirs
    write_asd("a.asd", COUNTS)
    path = write_asd("b.asd", COUNTS, reference=COUNTS, reference_epoch=1716286000, utc_offset_h=2.0)
    with pytest.warns(PaintWarning, match=r"a\.asd.*zone-missing"):
        opened = open_asd(path.parent, "counts")
    assert list(opened["source"].values) == ["b.asd", "a.asd"]
    assert np.isnat(opened["time"].values).tolist() == [False, True]


@pytest.mark.real_data
def test_gps_is_that_of_the_nmea_log(shared_data):
    opened = open_asd(str(shared_data / "asd_binary" / "ww*.asd"))
    fixes = {}
    with (shared_data / "gps_imu" / "asd_nmea_042122gps.log").open() as log:
        for row in csv.reader(log):
            if len(row) > 12:
                fixes[row[1].rsplit("\\", 1)[1]] = row[3:12]
    for index, name in enumerate(opened["source"].values):
        utc, latitude, north, longitude, east, *_, altitude = fixes[name]
        assert (north, east) == ("N", "E")
        expected = [int(text[:at]) + float(text[at:]) / 60 for text, at in ((latitude, 2), (longitude, 3))]
        position = opened[["latitude", "longitude", "altitude"]].isel(spectrum=index).reset_coords()
        assert (
            [float(position[key]) for key in ("latitude", "longitude", "altitude")],
            read_asd(shared_data / "asd_binary" / name).gps.utc.strftime("%H%M%S"),
        ) == (pytest.approx([*expected, float(altitude)], abs=1e-9), utc)
    assert opened["time"].values[0] == np.datetime64("2022-04-21T10:51:28", "ns")
    assert opened["time"].dtype == np.dtype("datetime64[ns]")


# --- every version and number format, written by the tests' own writer


@pytest.mark.parametrize("version", range(1, 9))
@pytest.mark.parametrize("dtype", ["<f4", "<i4", "<f8"])
def test_synthetic_versions(write_asd, version, dtype):
    file = read_asd(
        write_asd(
            "a.asd", COUNTS, version=version, dtype=dtype, reference=COUNTS + 1, trailer=b"\xff\xfe\xfd"
        )
    )
    np.testing.assert_array_equal(file.wavelength, ASD_GRID)
    np.testing.assert_array_equal(file.spectrum, COUNTS)
    assert (file.version, file.sample_averages) == (version, 1)
    assert file.local_time == dt.datetime(2024, 5, 21, 11, 33, 7)
    if version == 1:
        assert file.reference is None
    else:
        np.testing.assert_array_equal(file.reference, COUNTS + 1)


def test_optional_blocks(write_asd):
    path = write_asd(
        "a.asd",
        COUNTS,
        version=8,
        blocks={0: (0, PANEL_VALUES), **BLOCKS},
        labels=("protein", ""),
        audit=("<event/>",),
    )
    file = read_asd(path)
    assert set(file.calibrations) == {"ABS", "BSE", "LMP", "FO"}
    np.testing.assert_array_equal(file.calibrations["FO"].values, LAMP_COUNTS)
    # version 6 may end before the classifier
    path.write_bytes(write_asd("b.asd", COUNTS, version=6).read_bytes()[:-46])
    np.testing.assert_array_equal(read_asd(path).spectrum, COUNTS)


@pytest.mark.parametrize("nominal", [8, 9])
def test_irradiance_through_the_calibration_blocks(write_asd, nominal):
    path = write_asd("a.asd", COUNTS, data_type=4, blocks=BLOCKS, integration_ms=nominal, averages=5)
    irradiance = open_asd(path, utc_offset_h=0)["irradiance"]
    expected = 0.2 * COUNTS[:651] / 4000.0 * (136 / 8.5)
    np.testing.assert_allclose(irradiance.values[0], expected, rtol=1e-13)
    assert irradiance["wavelength"].values[-1] == 1000.0
    with pytest.warns(PaintWarning, match="cosine receptor.*fore-optic-wrong"):
        radiance = open_asd(path, "radiance", utc_offset_h=0)["radiance"]
    np.testing.assert_allclose(radiance.values[0], expected * 0.99 / np.pi, rtol=1e-13)


def test_missing_blocks_are_named_and_files_stand_in(write_asd):
    path = write_asd("a.asd", COUNTS, data_type=4, blocks={2: (0, LAMP)})
    expect_errors((FormatError, "calibration-missing", lambda: open_asd(path, utc_offset_h=0)))
    files = {
        "lamp": write_asd("x.ill", LAMP * 2),
        "fore_optic": write_asd("x.raw", LAMP_COUNTS, integration_ms=68),
    }
    np.testing.assert_allclose(
        open_asd(path, utc_offset_h=0, calibration=files)["irradiance"].values[0],
        0.4 * COUNTS[:651] / 4000.0 * (68 / 136),
        rtol=1e-13,
    )
    expect_errors((SchemaError, "key-unknown", lambda: open_asd(path, calibration={"ill": files["lamp"]})))
    other_grid = {**files, "lamp": write_asd("y.ill", LAMP[:-1])}
    expect_errors(
        (
            FormatError,
            r"y\.ill.*grid-mismatch",
            lambda: open_asd(path, utc_offset_h=0, calibration=other_grid),
        )
    )


def test_absolute_reflectance(write_asd):
    paths = [
        write_asd(f"{n}.asd", COUNTS, data_type=1, reference=COUNTS, blocks={0: (0, PANEL_VALUES)})
        for n in "ab"
    ]
    opened = open_asd(paths, absolute=True, utc_offset_h=0)["reflectance"]
    np.testing.assert_array_equal(opened.values, [PANEL_VALUES, PANEL_VALUES])
    assert opened.attrs["panel"] == "block.ref"
    opened = open_asd(
        paths, absolute=True, utc_offset_h=0, calibration={"absolute": write_asd("x.ref", PANEL_VALUES / 2)}
    )["reflectance"]
    np.testing.assert_array_equal(opened.values[0], PANEL_VALUES / 2)
    assert opened.attrs["panel"] == "x.ref"
    other_grid = {"absolute": write_asd("y.ref", PANEL_VALUES[:-1])}
    expect_refusals(
        (
            FormatError,
            "grid-mismatch",
            "a.asd",
            "b.asd",
            lambda: open_asd(paths, absolute=True, utc_offset_h=0, calibration=other_grid),
        ),
        (SchemaError, "option-conflict", lambda: open_asd(paths, "counts", absolute=True)),
    )


def test_spectra_have_names(write_asd, tmp_path):
    paths = [write_asd(f"{day}/red.asd", COUNTS) for day in ("mon", "tue")]
    paths.append(write_asd("mon/blue.000", COUNTS))
    opened = open_asd(paths, utc_offset_h=0)
    assert opened["spectrum"].values.tolist() == ["mon/red", "tue/red", "blue.000"]
    assert opened.sel(spectrum="tue/red")["source"].item() == "red.asd"
    text = write_file(tmp_path / "two.asd.txt", "Wavelength;red.asd;blue.asd\n550; 0.1; 0.2\n551; 0.1; 0.2\n")
    assert open_asd(text, "reflectance")["spectrum"].values.tolist() == ["red", "blue"]
    text.write_text("Wavelength;red.asd\n550; 0.1\n551; 0.1\n")
    opened = open_asd(text, "reflectance")
    assert opened["spectrum"].values.tolist() == ["two"]
    assert np.isnan(opened["latitude"].item())
    expect_errors((FormatError, "option-conflict", lambda: open_asd(text, "reflectance", absolute=True)))


@pytest.mark.parametrize(
    ("ddmm", "clock", "position"),
    [((4815.0, -1142.0), (7, 31, 22), (48.25, 11.7)), ((-1230.0, 4515.0), (59, 58, 23), (-12.5, -45.25))],
)
def test_a_position_and_the_zone_that_it_hints_at(write_asd, ddmm, clock, position):
    path = write_asd(
        "a.asd",
        COUNTS,
        gps=struct.pack("<5dhbbbbbh5sbb", 0, 0, *ddmm, 12.0, 1, 0, *clock, 0, 0, b"", 0, 0),
        local=dt.datetime(2024, 5, 21, 0, 33, 7),
    )
    fix = read_asd(path).gps
    assert (fix.latitude, fix.longitude, fix.altitude, fix.utc) == (*position, 12.0, dt.time(*clock[::-1]))
    with pytest.warns(PaintWarning, match=r"perhaps [+-]\d+ by the GPS.*a\.asd.*zone-missing"):
        open_asd(path)


def test_doubtful_samples_are_said(write_asd):
    path = write_asd("a.asd", COUNTS, reference=np.where(ASD_GRID == 400, 0, 2000), saturation=2)
    with pytest.warns(PaintWarning) as found:
        reflectance = open_asd(path, "reflectance", utc_offset_h=0)["reflectance"]
    assert sorted(re.search("that are (.*) become", str(w.message))[1] for w in found) == [
        "saturated",
        "undefined (not finite)",
    ]
    np.testing.assert_array_equal(np.isnan(reflectance.values[0]), (ASD_GRID > 1000) | (ASD_GRID == 400))
    np.testing.assert_array_equal(open_asd(path, "counts", utc_offset_h=0)["counts"].values[0], COUNTS)
    path = write_asd("a.asd", COUNTS, reference=COUNTS, dark_subtracted=False)
    with pytest.warns(PaintWarning, match="dark-not-subtracted"):
        open_asd(path, "reflectance", utc_offset_h=0)


def test_spectra_are_ordered_by_time_and_offsets_come_from_each_file(write_asd):
    for name, hour, offset in (("a.asd", 12, 2.0), ("b.asd", 9, 5.5)):
        path = write_asd(
            name,
            COUNTS,
            local=dt.datetime(2024, 5, 21, hour),
            reference=COUNTS,
            reference_epoch=1716286000,
            utc_offset_h=offset,
        )
    folder = path.parent
    opened = open_asd(folder)
    assert list(opened["source"].values) == ["b.asd", "a.asd"]
    np.testing.assert_array_equal(
        opened["time"].values, np.array(["2024-05-21T03:30", "2024-05-21T10:00"], "datetime64[ns]")
    )
    with pytest.warns(PaintWarning, match="utc-offset-conflict"):
        opened = open_asd(folder, utc_offset_h=2)
    assert opened["time"].values[0] == np.datetime64("2024-05-21T07:00", "ns")


# --- what is refused


def test_all_bad_asd_files_are_named_at_once(write_asd, tmp_path):
    good = write_asd("good.asd", COUNTS)
    (tmp_path / "cut.asd").write_bytes(good.read_bytes()[:-100])
    (tmp_path / "long.asd").write_bytes(good.read_bytes() + b"more")
    (tmp_path / "note.asd").write_text("nothing to see")
    os.mkfifo(tmp_path / "pipe.asd")
    (tmp_path / "link.asd").symlink_to("nowhere")
    raised = expect_error(
        FormatError, None, lambda: open_asd([tmp_path, tmp_path / "gone.asd"], utc_offset_h=0)
    )
    assert [
        name
        for name in (
            *("cut.asd", "long.asd", "note.asd", "gone.asd", "pipe.asd", "link.asd", "file-not-plain"),
            "good.asd",
        )
        if name not in str(raised)
    ] == ["good.asd"]


def test_nothing_to_open(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for paths, code in (([], "empty-input"), ("nothing*.asd", "file-not-found"), (".", "file-not-found")):
        expect_error(FormatError, code, partial(open_asd, paths))


def test_files_that_do_not_match_are_refused(write_asd):
    paths = [
        write_asd("a.asd", COUNTS, data_type=1, reference=COUNTS),
        write_asd("b.asd", COUNTS, data_type=8),
    ]
    expect_refusals(
        (FormatError, "quantity-ambiguous", lambda: open_asd(paths, utc_offset_h=0)),
        (SchemaError, "choice-unknown", lambda: open_asd(paths, "dn")),
    )
    paths[1] = write_asd("c.asd", COUNTS, first=325.0)
    expect_errors((FormatError, r"a\.asd.*grid-mismatch", lambda: open_asd(paths, "counts", utc_offset_h=0)))


@pytest.mark.parametrize("offset_h", [-18000.0, 15.0, float("nan")])
def test_impossible_zone(write_asd, offset_h):
    expect_refusals(
        (
            TimeError,
            "value-out-of-range",
            "utc_offset_h=",
            "hours",
            lambda: open_asd(write_asd("a.asd", COUNTS), utc_offset_h=offset_h),
        )
    )


@pytest.mark.parametrize(
    ("offset", "packed", "problem"),
    [
        (160, struct.pack("<9h", 0, 0, 0, 31, 1, 124, 0, 0, 0), "time-unreadable"),
        (186, b"\x09", "data type"),
        (199, b"\x03", "data format"),
        (191, struct.pack("<f", float("nan")), "first wavelength"),
        (204, b"\0\0", "no channels"),
        (334 + 16, struct.pack("<2d", 4875.0, -1142.5), "GPS position"),
    ],
)
def test_contradictory_headers(write_asd, offset, packed, problem):
    path = write_asd("a.asd", COUNTS)
    data = bytearray(path.read_bytes())
    data[offset : offset + len(packed)] = packed
    path.write_bytes(data)
    expect_errors((FormatError, problem, lambda: read_asd(path)))


def test_declared_sizes_are_not_believed(write_asd, monkeypatch):
    # A million-fold count in each place that holds one costs neither work nor memory
    path = write_asd("a.asd", COUNTS, version=8, reference=COUNTS, labels=("x",), audit=("y",), blocks=BLOCKS)
    whole = path.read_bytes()
    tail = 484 + 2 * 8 * len(COUNTS) + 20
    reads, original = [], Cursor.bytes

    def counted(self, count, what):
        reads.append(count)
        return original(self, count, what)

    monkeypatch.setattr(Cursor, "bytes", counted)
    for at_byte in range(tail, min(tail + 200, len(whole))):
        path.write_bytes(whole[:at_byte] + b"\xff\xff\xff\x7f" + whole[at_byte + 4 :])
        reads.clear()
        with contextlib.suppress(FormatError):
            read_asd(path)
        assert len(reads) <= len(whole)


# --- asd text ---------------------------------------------------------------------------------------------


PREAMBLE = """
Text conversion of header file c:\\sky\\sky_00001.asd
 -------------------------------------------------------------
{comment}
The instrument number was  18875/1
New ASD spectrum file: Program version = 6.04 file version = 7.00
Spectrum saved: 05/21/2024 at 11:33:13
VNIR integration time : {milliseconds}
VNIR channel 1 wavelength = 350 wavelength step = 1
There {averages} per data value
xmin = 350 xmax= 2500
ymin= 0 ymax= {ymax}
SWIR1 gain was 16 offset was 2051
Join between VNIR and SWIR1 was 1000 nm
Join between SWIR1 and SWIR2 was 1830 nm
Data is {compared} to a white reference
There was a remote cosine receptor attached
Spectrum file is raw data with embedded reference
GPS-Latitude is S0

"""


def preamble(
    comment="\0" * 156, milliseconds=9, averages="were 10 samples", ymax="2.5", compared="not compared"
):
    return PREAMBLE.format(**locals())


def read(tmp_path, text):
    path = write_file(tmp_path / "export.txt", text.encode("latin-1") if isinstance(text, str) else text)
    return read_asd_text(path)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "first", "at_550", "second", "milliseconds", "ymax"),
    [
        ("asd-e-irrad-sky.tsv", 0.219269418855826, 0.890753970640618, 7, 136.0, 2.5),
        ("asd-e-irrad-sky.csv", 0.219226658252059, 0.890642958711871, 13, 136.0, 2.5),
        ("asd-Rfr-soil.tsv", 4.34852393157055e-02, None, None, 34.0, 1.25),
    ],
)
def test_real_exports(shared_data, name, first, at_550, second, milliseconds, ymax):
    text = read_asd_text(shared_data / "asd_ascii" / name)
    assert text.values.shape == (1, 2151)
    assert text.values.dtype == text.wavelength.dtype == np.float64
    assert text.values[0, 0] == first
    if at_550:
        assert text.values[0, 200] == at_550
        assert text.preamble["local_time"] == dt.datetime(2024, 5, 21, 11, 33, second)
    assert (text.preamble["integration_ms"], text.preamble["sample_averages"]) == (milliseconds, 1)
    assert (text.preamble["ymax"], text.preamble["instrument_number"]) == (ymax, "18875/1")
    assert text.preamble["splices"] == (1000.0, 1800.0)
    sky = "irrad" in name
    assert (text.preamble["cosine_receptor"], text.preamble["white_reference"]) == (sky, not sky)


@pytest.mark.real_data
def test_an_export_without_a_header(shared_data):
    text = read_asd_text(shared_data / "asd_binary" / "ribb00001.asd.txt")
    assert (text.spectra, text.preamble["local_time"]) == (("ribb00001.asd",), None)
    assert text.preamble["ymax"] is None
    assert np.isnat(
        open_asd(shared_data / "asd_binary" / "ribb00001.asd.txt", "reflectance")["time"].values
    ).all()


@pytest.mark.parametrize("separator", [";", "\t", ","])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("header", ["", preamble()])
def test_columns(tmp_path, separator, line_end, header):
    text = read(
        tmp_path,
        (
            header
            + f"Wavelength{separator}sky.asd\n350{separator} 0.25 \n351{separator}-6.35E-02 \nx2bar 0.1\n"
        ).replace("\n", line_end),
    )
    np.testing.assert_array_equal(text.values, [[0.25, -6.35e-02]])
    np.testing.assert_array_equal(text.wavelength, [350.0, 351.0])
    assert text.spectra == ("sky.asd",)
    if header:
        assert text.preamble["local_time"] == dt.datetime(2024, 5, 21, 11, 33, 13)
        assert (text.preamble["integration_ms"], text.preamble["sample_averages"]) == (8.5, 10)
        assert (text.preamble["cosine_receptor"], text.preamble["white_reference"]) == (True, False)
        assert text.preamble["splices"] == (1000.0, 1830.0)


@pytest.mark.parametrize(("last", "is_told"), [(2500, False), (795, True)])
def test_an_export_that_ends_before_its_plot_is_told(tmp_path, last, is_told):
    rows = "".join(f"{nm}\t0.5\n" for nm in range(350, last + 1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read(tmp_path, f"{preamble()}Wavelength\ta.asd\n{rows}")
    assert [warning.message.code for warning in caught] == ["file-truncated"] * is_told


def test_many_columns_and_rows(tmp_path):
    for content in (
        "Wavelength\ta.asd\tb.asd\t\n350\t1\t2\t\n351\t3\t4\t\n",
        "Wavelength,350,351\na.asd,1,3\nb.asd,2,4\n",
    ):
        text = read(tmp_path, content)
        assert text.spectra == ("a.asd", "b.asd")
        np.testing.assert_array_equal(text.values, [[1, 3], [2, 4]])
        np.testing.assert_array_equal(text.wavelength, [350, 351])
    assert list(open_asd(tmp_path / "export.txt", "counts")["source"].values) == [
        "export.txt:a.asd",
        "export.txt:b.asd",
    ]


def test_decimal_comma_and_windows_words_for_nan(tmp_path):
    text = read(tmp_path, "Wavelength;a\n350,5;0,25\n351,5;-1.#IND\n352,5;1.#INF\n")
    np.testing.assert_array_equal(text.values, [[0.25, np.nan, np.inf]])
    np.testing.assert_array_equal(text.wavelength, [350.5, 351.5, 352.5])

    # old years and a clock of twelve hours
    text = read(tmp_path, "Spectrum saved: 01/15/120 at 12:30:00 AM\nWavelength,a\n350,1\n")
    assert text.preamble["local_time"] == dt.datetime(2020, 1, 15, 0, 30)


def test_guessed_quantity_is_said(tmp_path):
    (tmp_path / "soil.txt").write_text(preamble("", ymax="1.25") + "Wavelength,a\n350,0.1\n")
    with pytest.warns(PaintWarning, match="quantity-assumed"):
        opened = open_asd(tmp_path / "soil.txt", utc_offset_h=3)
    assert opened["reflectance"].values == 0.1
    assert opened["time"].values == np.datetime64("2024-05-21T08:33:13", "ns")
    (tmp_path / "soil.txt").write_text("Wavelength,a\n350,0.1\n")
    expect_errors(
        (FormatError, "quantity-ambiguous", lambda: open_asd(tmp_path / "soil.txt", utc_offset_h=3))
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "'Wavelength'.*format-unknown"),
        ("Wavelength,a\n", "table-missing"),
        ("Wavelength;\n350;1\n", "no column"),
        ("Wavelength,a\n350,1\n351\n", "line 3.*row-unreadable"),
        ("Wavelength,a\n350,1\nx2bar,1\n352,2\n", "line 4.*row-unreadable"),
        ("Wavelength,a\n350,1\n351,one\n", "line 3.*row-unreadable"),
        ("Wavelength,a\n350,1\n350,1\n", "wavelength-unordered"),
        ("Wavelength,a\ninf,1\n", "wavelength-unordered"),
        ("Wavelength,350,351\na,1\n", "expected 3 cells"),
        ("Spectrum saved: 21/05/2024 at 11:33:13\nWavelength,a\n350,1\n", "month/day/year"),
    ],
)
def test_damaged_exports(tmp_path, text, problem):
    expect_errors((FormatError, problem, lambda: read(tmp_path, text)))


@pytest.mark.parametrize(
    ("heading", "value", "code"),
    [
        ("Wavelength,white", 80, "scale-missing"),
        ("Wavelength,DN", 20000, "quantity-wrong"),
        ("Wavelength,a,Absorbance", 0.5, "quantity-wrong"),
        ("Wavelength,Radiance (W/m2/sr/nm)", 0.1, "quantity-wrong"),
        ("Wavelength,Reflectance (%)", 80, None),
        ("# units: percent\nWavelength,red", 80, None),
        ("Wavelength,DN.asd", 0.8, None),
    ],
)
def test_tables_of_other_programs_are_checked(tmp_path, heading, value, code):
    columns = heading.count(",")
    rows = "".join(f"{nm / 1e3}" + f",{value}" * columns + "\n" for nm in range(400, 900, 5))
    (tmp_path / "a.csv").write_text(f"{heading}\n{rows}")
    for opened in (
        lambda: open_asd(tmp_path / "a.csv", "reflectance"),
        lambda: open_references([tmp_path])[0],
    ):
        if code is not None:
            expect_errors((FormatError, code, opened))
            continue
        np.testing.assert_allclose(opened()["reflectance"].values, 0.8, rtol=1e-12)
        np.testing.assert_allclose(opened()["wavelength"].values, np.arange(400, 900, 5))


def test_fill_values_of_a_table_are_missing(tmp_path):
    (tmp_path / "a.csv").write_text("Wavelength,a\n400,-9999\n500,0.1\n600,0.3\n")
    with pytest.warns(PaintWarning, match="values-far-below-zero|samples-undefined"):
        values = open_asd(tmp_path / "a.csv", "reflectance")["reflectance"].values
    np.testing.assert_array_equal(values, [[np.nan, 0.1, 0.3]])


def test_the_text_of_a_spectrometer_is_a_row(tmp_path, monkeypatch):
    heading = re.compile(r"nm;", re.IGNORECASE)
    row = asd.Export("AvaSpec", heading, {"integration_ms": (r"t = (\d+) ms", lambda match: float(match[1]))})
    path = write_file(tmp_path / "door.txt", "Serial 1904\nt = 12 ms\nnm;door\n550;0,25\n551;0,5\n")
    expect_refusals((FormatError, "format-unknown", lambda: read_asd_text(path)))
    monkeypatch.setattr(asd, "EXPORTS", (*asd.EXPORTS, row))
    opened = open_asd(path, "reflectance")
    assert opened["reflectance"].values.tolist() == [[0.25, 0.5]]
    assert (opened.attrs["instrument"], read_asd_text(path).preamble["integration_ms"]) == ("AvaSpec", 12.0)


def test_sniffing(tmp_path):
    path = tmp_path / "any"
    for content, kind in (
        (preamble() + "Wavelength,a\n350,1\n", "text"),
        ("Wavelength,a\n350,1\n", "table"),
        ("# units: 1\ntime,350,351\n", "csv"),
        ("wave", "unknown"),
    ):
        path.write_text(content)
        assert sniff(path) == kind
