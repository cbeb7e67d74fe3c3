import datetime as dt

import numpy as np
import pytest

from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.spectrometers.asd import open_asd, read_asd_text, sniff

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
    assert (text.preamble["integration_ms"], text.preamble["sample_averages"], text.preamble["ymax"]) == (
        milliseconds,
        1,
        ymax,
    )
    assert (text.preamble["instrument_number"], text.preamble["splices"]) == ("18875/1", (1000.0, 1800.0))
    sky = "irrad" in name
    assert (text.preamble["cosine_receptor"], text.preamble["white_reference"]) == (sky, not sky)


@pytest.mark.real_data
def test_an_export_without_a_header(shared_data):
    text = read_asd_text(shared_data / "asd_binary" / "ribb00001.asd.txt")
    assert (text.spectra, text.preamble["local_time"], text.preamble["ymax"]) == (
        ("ribb00001.asd",),
        None,
        None,
    )
    opened = open_asd(shared_data / "asd_binary" / "ribb00001.asd.txt", "reflectance")
    assert np.isnat(opened["time"].values).all()


@pytest.mark.parametrize("separator", [";", "\t", ","])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("header", ["", preamble()])
def test_columns(tmp_path, separator, line_end, header):
    rows = f"Wavelength{separator}sky.asd\n350{separator} 0.25 \n351{separator}-6.35E-02 \nx2bar 0.1\n"
    text = read(tmp_path, (header + rows).replace("\n", line_end))
    np.testing.assert_array_equal(text.values, [[0.25, -6.35e-02]])
    np.testing.assert_array_equal(text.wavelength, [350.0, 351.0])
    assert text.spectra == ("sky.asd",)
    if header:
        assert text.preamble["local_time"] == dt.datetime(2024, 5, 21, 11, 33, 13)
        assert (text.preamble["integration_ms"], text.preamble["sample_averages"]) == (8.5, 10)
        assert (text.preamble["cosine_receptor"], text.preamble["white_reference"]) == (True, False)
        assert text.preamble["splices"] == (1000.0, 1830.0)


def test_many_columns_and_rows(tmp_path):
    columns = "Wavelength\ta.asd\tb.asd\t\n350\t1\t2\t\n351\t3\t4\t\n"
    for content in (columns, "Wavelength,350,351\na.asd,1,3\nb.asd,2,4\n"):
        text = read(tmp_path, content)
        assert text.spectra == ("a.asd", "b.asd")
        np.testing.assert_array_equal(text.values, [[1, 3], [2, 4]])
        np.testing.assert_array_equal(text.wavelength, [350, 351])
    opened = open_asd(tmp_path / "export.txt", "counts")
    assert list(opened["source"].values) == ["export.txt:a.asd", "export.txt:b.asd"]


def test_decimal_comma_and_windows_words_for_nan(tmp_path):
    text = read(tmp_path, "Wavelength;a\n350,5;0,25\n351,5;-1.#IND\n352,5;1.#INF\n")
    np.testing.assert_array_equal(text.values, [[0.25, np.nan, np.inf]])
    np.testing.assert_array_equal(text.wavelength, [350.5, 351.5, 352.5])


def test_old_years_and_twelve_hour_clock(tmp_path):
    text = read(tmp_path, "Spectrum saved: 01/15/120 at 12:30:00 AM\nWavelength,a\n350,1\n")
    assert text.preamble["local_time"] == dt.datetime(2020, 1, 15, 0, 30)


def test_guessed_quantity_is_said(tmp_path):
    (tmp_path / "soil.txt").write_text(preamble("", ymax="1.25") + "Wavelength,a\n350,0.1\n")
    with pytest.warns(PaintWarning, match="quantity-assumed"):
        opened = open_asd(tmp_path / "soil.txt", utc_offset_h=3)
    assert opened["reflectance"].values == 0.1
    assert opened["time"].values == np.datetime64("2024-05-21T08:33:13", "ns")
    (tmp_path / "soil.txt").write_text("Wavelength,a\n350,0.1\n")
    with pytest.raises(FormatError, match="quantity-ambiguous"):
        open_asd(tmp_path / "soil.txt", utc_offset_h=3)


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
    with pytest.raises(FormatError, match=problem):
        read(tmp_path, text)


def test_sniffing(tmp_path):
    path = tmp_path / "any"
    for content, kind in (
        (preamble() + "Wavelength,a\n350,1\n", "text"),
        ("# units: 1\ntime,350,351\n", "csv"),
        ("wave", "unknown"),
    ):
        path.write_text(content)
        assert sniff(path) == kind
