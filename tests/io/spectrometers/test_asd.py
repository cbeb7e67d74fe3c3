import contextlib
import csv
import datetime as dt
import os
import re
import struct
import warnings

import numpy as np
import pytest
from support.refusals import expect_errors, expect_refusals

from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.io.spectrometers import asd
from hyperpaint.io.spectrometers.asd import Cursor, open_asd, read_asd, read_asd_text, sniff
from hyperpaint.io.spectrometers.reference_files import open_references

GRID = np.arange(350.0, 1051.0)
COUNTS = 1000.0 + np.arange(len(GRID)) * 3.0
LAMP, LAMP_COUNTS, PANEL = np.full(len(GRID), 0.2), np.full(len(GRID), 4000.0), np.full(len(GRID), 0.99)
BLOCKS = {1: (0, PANEL), 2: (0, LAMP), 3: (136, LAMP_COUNTS)}


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
    np.testing.assert_array_equal(file.wavelength, GRID)
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
        blocks={0: (0, PANEL), **BLOCKS},
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
        write_asd(f"{n}.asd", COUNTS, data_type=1, reference=COUNTS, blocks={0: (0, PANEL)}) for n in "ab"
    ]
    opened = open_asd(paths, absolute=True, utc_offset_h=0)["reflectance"]
    np.testing.assert_array_equal(opened.values, [PANEL, PANEL])
    assert opened.attrs["panel"] == "block.ref"
    opened = open_asd(
        paths, absolute=True, utc_offset_h=0, calibration={"absolute": write_asd("x.ref", PANEL / 2)}
    )["reflectance"]
    np.testing.assert_array_equal(opened.values[0], PANEL / 2)
    assert opened.attrs["panel"] == "x.ref"
    other_grid = {"absolute": write_asd("y.ref", PANEL[:-1])}
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
    text = tmp_path / "two.asd.txt"
    text.write_text("Wavelength;red.asd;blue.asd\n550; 0.1; 0.2\n551; 0.1; 0.2\n")
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
    path = write_asd("a.asd", COUNTS, reference=np.where(GRID == 400, 0, 2000), saturation=2)
    with pytest.warns(PaintWarning) as found:
        reflectance = open_asd(path, "reflectance", utc_offset_h=0)["reflectance"]
    assert sorted(re.search("that are (.*) become", str(w.message))[1] for w in found) == [
        "saturated",
        "undefined (not finite)",
    ]
    np.testing.assert_array_equal(np.isnan(reflectance.values[0]), (GRID > 1000) | (GRID == 400))
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


def test_all_bad_files_are_named_at_once(write_asd, tmp_path):
    good = write_asd("good.asd", COUNTS)
    (tmp_path / "cut.asd").write_bytes(good.read_bytes()[:-100])
    (tmp_path / "long.asd").write_bytes(good.read_bytes() + b"more")
    (tmp_path / "note.asd").write_text("nothing to see")
    os.mkfifo(tmp_path / "pipe.asd")
    (tmp_path / "link.asd").symlink_to("nowhere")
    with pytest.raises(FormatError) as raised:
        open_asd([tmp_path, tmp_path / "gone.asd"], utc_offset_h=0)
    assert [
        name
        for name in (
            *("cut.asd", "long.asd", "note.asd", "gone.asd", "pipe.asd", "link.asd", "file-not-plain"),
            "good.asd",
        )
        if name not in str(raised.value)
    ] == ["good.asd"]


def test_nothing_to_open(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for paths, code in (([], "empty-input"), ("nothing*.asd", "file-not-found"), (".", "file-not-found")):
        with pytest.raises(FormatError, match=code):
            open_asd(paths)


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
    path = tmp_path / "export.txt"
    path.write_bytes(text.encode("latin-1") if isinstance(text, str) else text)
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
    path = tmp_path / "door.txt"
    path.write_text("Serial 1904\nt = 12 ms\nnm;door\n550;0,25\n551;0,5\n")
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
