"""ENVI headers: real ones, damaged ones, hostile ones."""

import contextlib
import pickle
import random
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors
from support.wrong_quantities import objection, remarks

from hyperpaint.base.errors import FormatError
from hyperpaint.io.envi.envi_cubes import open_envi, parse_header, read_header

BASE = {
    "samples": "4",
    "lines": "5",
    "bands": "3",
    "header offset": "0",
    "data type": "12",
    "interleave": "bil",
    "byte order": "0",
}


def header_text(*lines: str, **changed: str | None) -> str:
    # Return a small sound header with keys changed (``byte_order=None`` drops one) and lines added
    fields = {**BASE, **{key.replace("_", " "): value for key, value in changed.items()}}
    said = [f"{key} = {value}" for key, value in fields.items() if value is not None]
    return "\n".join(["ENVI", *said, *lines]) + "\n"


def problems_of(text: str) -> list[str]:
    return str(expect_error(FormatError, None, lambda: parse_header(text))).splitlines()[1:]


def test_every_field_of_a_full_header() -> None:
    header = parse_header(
        header_text(
            "DESCRIPTION = {[HEADWALL Hyperspec III],RADIANCE}",
            "Wavelength  Units = Micrometers",
            "wavelength = {\n0.45\n,0.55\n,0.5}",
            "fwhm = {0.006, 0.005, 0.004}",
            "bbl = {1, 0.0, 1}",
            "band names = {a, b b, c}",
            "data ignore value = -9999.0",
            "reflectance scale factor = 10000",
            "data gain values = {1, 2, 3}",
            "data offset values = {0 0 -1e-3}",
            "map info = {UTM, 1, 1, 500000.5, 4000000, 0.5, 0.25, 18, North, WGS-84,",
            " units=Meters, rotation=30}",
            "unheard of = {x = 1,",
            "  y}",
            ";Exposure (ms) = 5.5",
            "; a remark",
            "; equals = a=b",
        )
    )
    assert (header.lines, header.samples, header.bands, header.header_offset) == (5, 4, 3, 0)
    assert (header.dtype, header.interleave) == (np.dtype("<u2"), "bil")
    assert header.description == "[HEADWALL Hyperspec III],RADIANCE"
    np.testing.assert_allclose(header.wavelength, [450, 550, 500], rtol=1e-15)  # never sorted
    np.testing.assert_allclose(header.fwhm, [6, 5, 4], rtol=1e-15)
    np.testing.assert_array_equal(header.good, [True, False, True])
    assert (header.wavelength.dtype, header.good.dtype) == (np.dtype(np.float64), np.dtype(bool))
    assert (header.band_names, header.data_ignore_value) == (("a", "b b", "c"), -9999)
    assert header.reflectance_scale_factor == 1e4
    np.testing.assert_array_equal(header.data_gain_values, [1, 2, 3])
    np.testing.assert_array_equal(header.data_offset_values, [0, 0, -1e-3])
    info = header.map_info
    assert (info.projection, info.reference_pixel, info.reference) == ("UTM", (1, 1), (500000.5, 4000000))
    assert (info.pixel_size, info.units, info.rotation) == ((0.5, 0.25), "meters", 30)
    assert (info.details, header.fields["unheard of"]) == (("18", "North", "WGS-84"), "{x = 1,\n  y}")
    assert list(header.fields)[:2] == ["samples", "lines"]
    assert (header.comments, header.notes) == ({"Exposure (ms)": "5.5", "equals": "a=b"}, ())
    assert pickle.loads(pickle.dumps(header)).fields == header.fields


@pytest.mark.parametrize("code", ["1", "2", "3", "4", "5", "6", "9", "12", "13", "14", "15"])
@pytest.mark.parametrize("order", ["0", "1"])
def test_data_types(code: str, order: str) -> None:
    types = dict(zip(
        ("1", "2", "3", "4", "5", "6", "9", "12", "13", "14", "15"),
        ("uint8", "int16", "int32", "float32", "float64", "complex64", "complex128",
         "uint16", "uint32", "int64", "uint64"), strict=True,
    ))  # fmt: skip
    found = parse_header(header_text(data_type=code, byte_order=order)).dtype
    assert found == np.dtype(types[code]).newbyteorder("<>"[int(order)])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_and_encodings(tmp_path: Path, end: str) -> None:
    path = tmp_path / "a.hdr"
    text = header_text("wavelength units = µm", "wavelength = {0.4,", "0.5,", "0.6}").replace("\n", end)
    for encoding in ("utf-8", "utf-8-sig", "latin-1"):
        path.write_bytes(text.encode(encoding))
        np.testing.assert_allclose(read_header(path).wavelength, [400, 500, 600], rtol=1e-14)


def test_missing_byte_order_is_inferred_with_a_warning() -> None:
    header = parse_header(header_text(byte_order=None))
    assert header.dtype == np.dtype("<u2")
    assert "little-endian" in header.warnings[0]
    assert header.notes == header.warnings
    assert parse_header(header_text(byte_order=None, data_type="1")).notes == ()


@pytest.mark.parametrize(
    ("units", "values", "expected", "noted"),
    [
        ("nm", "400,500,600", [400, 500, 600], None),
        ("Nanometers", "400 500 600", [400, 500, 600], None),
        ("micrometers", ".4, .5, .6,", [400, 500, 600], None),
        ("um", "\n.4\n.5\n.6\n", [400, 500, 600], None),
        ("Angstroms", "4000,5000,6000", [400, 500, 600], None),
        ("Unknown", "0.4,0.5,2.5", [400, 500, 2500], "micrometres"),
        (None, "400,500,99", [400, 500, 99], "nanometres"),
        (None, "0.6,0.4,0.5", [600, 400, 500], "micrometres"),
        ("Index", "1,2,3", None, "'Index'"),
        ("nm", "0.4,0.5,0.6", [0.4, 0.5, 0.6], "check the unit"),
        ("um", "400,500,600", [4e5, 5e5, 6e5], "check the unit"),
    ],
)
def test_wavelength_units(
    units: str | None, values: str, expected: list[float] | None, noted: str | None
) -> None:
    lines = [f"wavelength = {{{values}}}", *([f"wavelength units = {units}"] if units else [])]
    header = parse_header(header_text(*lines))
    if expected is None:
        assert header.wavelength is None
    else:
        np.testing.assert_allclose(header.wavelength, expected, rtol=1e-14)
    assert (noted is None) == (not header.notes)
    assert noted is None or noted in header.notes[0]
    assert bool(header.warnings) == (noted == "check the unit")


@pytest.mark.parametrize(
    "names",
    ["399.356 nm, 401.5 nm, 1001.42 nm", "Band 1 (399.356 Nanometers),Band 2 (401.5 nm), b3 1.00142 um"],
)
def test_wavelengths_in_band_names(names: str) -> None:
    header = parse_header(header_text(f"band names = {{{names}}}"))
    np.testing.assert_allclose(header.wavelength, [399.356, 401.5, 1001.42], rtol=1e-14)
    assert "band names" in header.notes[0]
    listed = parse_header(
        header_text(f"band names = {{{names}}}", "wavelength = {1,2,3}", "wavelength units = um")
    )
    np.testing.assert_array_equal(listed.wavelength, [1000, 2000, 3000])
    assert parse_header(header_text("band names = {1 nm, red, 3 nm}")).wavelength is None


@pytest.mark.parametrize(
    ("changed", "lines", "expected"),
    [
        ({"lines": "10.5"}, (), "10.5"),
        ({"lines": "0"}, (), "above 0"),
        ({"lines": "-3"}, (), "above 0"),
        ({"samples": "1e3"}, (), "1e3"),
        ({"bands": "٣"}, (), "whole number"),
        ({"bands": "9" * 5000}, (), "..."),
        ({"lines": None}, (), "'lines' is missing"),
        ({"data type": None}, (), "'data type' is missing"),
        ({"data type": "7"}, (), "expected one of 1, 2, 3"),
        ({"interleave": None}, (), "'interleave' is missing"),
        ({"interleave": "bup"}, (), "bil, bip, bsq"),
        ({"interleave": "../x"}, (), "bil, bip, bsq"),
        ({"byte order": "7"}, (), "expected one of 0, 1"),
        ({"header offset": "-1"}, (), "0 or above"),
        ({}, ("lines = 6",), "given again"),
        ({}, ("wavelength = {400, 500, 600",), "never closed"),
        ({}, ("wavelength = {400, nan, 600}",), "finite"),
        ({}, ("wavelength = {400, 500, inf}",), "finite"),
        ({}, ("wavelength = {400, 1e999, 600}",), "finite"),
        ({}, ("wavelength = {400, 5_0_0, 600}",), "5_0_0"),
        ({}, ("wavelength = {400, 500, }",), "2 values for 3 bands"),
        (
            {"bands": "978"},
            (f"wavelength = {{{','.join(map(str, range(400, 435)))}}}",),
            "35 values for 978 bands",
        ),
        ({}, ("wavelength = {400, -1, 600}",), "above 0"),
        ({}, ("wavelength = {400, 500, 600}", "wavelength units = parsec"), "parsec"),
        ({}, ("fwhm = {4, 5}",), "2 values for 3 bands"),
        ({}, ("fwhm = {4, 5, -5}",), "below 0"),
        ({}, ("bbl = {1, 0.5, 1}",), "bbl"),
        ({}, ("data ignore value = none",), "none"),
        ({}, ("reflectance scale factor = 0",), "above 0"),
        ({}, ("reflectance scale factor = {1, 2}",), "one number"),
        ({}, ("data gain values = {1}",), "1 values for 3 bands"),
        ({}, ("map info = {UTM, 1, 1}",), "map info"),
        ({}, ("map info = {UTM, 1, 1, 0, 0, 0, 1}",), "map info"),
        ({}, ("map info = {UTM, 1, 1, nan, 0, 1, 1}",), "map info"),
        ({}, ("major frame offsets = {2, 0}",), "padded"),
        ({}, ("file compression = 1",), "unpack"),
        ({}, ("no equals sign",), "line 9"),
        ({}, ("= 5",), "key = value"),
    ],
)
def test_refused(changed: dict[str, str | None], lines: tuple[str, ...], expected: str) -> None:
    found = problems_of(header_text(*lines, **{k.replace(" ", "_"): v for k, v in changed.items()}))
    assert len(found) == 1
    assert expected in found[0]
    assert len(found[0]) < 400


def test_all_problems_at_once() -> None:
    assert len(problems_of(header_text("bbl = {1}", lines="10.5", interleave="bup", byte_order="9"))) == 4
    assert len(problems_of(header_text(*["x"] * 1000))) < 30  # a flood is cut short


def test_same_value_twice_is_noted_and_comments_keep_the_first() -> None:
    header = parse_header(header_text("lines = 5", ";Exposure (ms) = 5", ";Exposure (ms) = 7"))
    assert "given twice" in header.notes[0]
    assert header.comments["Exposure (ms)"] == "5"
    assert "Exposure" in header.warnings[0]


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n", b"ENVISAT\n", b"ENVI", b"ENVI\n\n", b"ENVI\n;a = b\n"]
)
def test_foreign_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign.hdr"
    path.write_bytes(content)
    expect_errors((FormatError, r"foreign\.hdr", lambda: read_header(path)))


def test_damaged_headers_raise_format_error_only(shared_data: Path) -> None:
    # Random bytes changed, cut out, doubled and swapped in real headers
    dice = random.Random(20260)
    pieces = [b"{", b"}", b"=", b",", b";", b"\n", b"\0", b"\xff", b"nan", b"-", b"1e400", b"9" * 40, b"ENVI"]
    pieces += [b"1", b"4", b" ", b"a", b""]
    outcomes = {True: 0, False: 0}
    for path in sorted((shared_data / "envi_cube").glob("*.hdr")):
        raw = path.read_bytes()
        for _ in range(60):
            made = bytearray(raw)
            for _ in range(dice.randint(1, 3)):
                at = dice.randrange(len(made))
                span = dice.choice((0, 1, 1, 5, 200))
                made[at : at + span] = dice.choice([*pieces, bytes(made[at : at + 50])])
            try:
                header = parse_header(bytes(made).decode("latin-1"))
            except FormatError:
                outcomes[False] += 1
            else:
                outcomes[True] += 1
                assert min(header.lines, header.samples, header.bands) >= 1
                assert header.wavelength is None or header.wavelength.shape == (header.bands,)
    assert min(outcomes.values()) > 20, outcomes


_KEYS = st.sampled_from(
    [*BASE, "wavelength", "wavelength units", "fwhm", "bbl", "band names", "map info", "data ignore value",
     "description", "file type", "reflectance scale factor", ";x"]
)  # fmt: skip
_VALUES = st.one_of(
    st.text(max_size=30),
    st.floats().map(str),
    st.integers().map(str),
    st.lists(st.floats() | st.text(max_size=5), max_size=8).map(lambda v: "{" + ",".join(map(str, v)) + "}"),
    st.sampled_from(["bil", "nm", "{nm}", "Unknown", "{UTM,1,1,0,0,1,1,rotation=", "ENVI Spectral Library"]),
)


@given(st.lists(st.tuples(_KEYS, _VALUES), max_size=6), st.booleans())
def test_any_header_is_read_or_refused(pairs: list[tuple[str, str]], sound: bool) -> None:
    text = "\n".join(f"{key} = {value}" for key, value in pairs)
    with contextlib.suppress(FormatError):
        parse_header((header_text() if sound else "ENVI\n") + text)


_MEGABYTE = 2**20


@pytest.mark.parametrize(
    "bomb",
    [
        pytest.param(lambda: "wavelength = {" + "4," * _MEGABYTE + "}", id="one-line list"),
        pytest.param(lambda: "wavelength = {" + "4\n" * _MEGABYTE + "}", id="one value a line"),
        pytest.param(lambda: "wavelength = {" + "4\n" * _MEGABYTE, id="never closed"),
        pytest.param(lambda: "wavelength = {" + "4" * (2 * _MEGABYTE) + "}", id="one long number"),
        pytest.param(lambda: "band names = {" + "1" * (2 * _MEGABYTE) + ",b,c}", id="digits in a band name"),
        pytest.param(lambda: "band names = {" + "a," * _MEGABYTE + "}", id="band names"),
        pytest.param(lambda: "description = {" + ", " * _MEGABYTE + "}", id="description"),
        pytest.param(lambda: "map info = {" + "1," * _MEGABYTE + "}", id="map info"),
        pytest.param(lambda: "x\n" * _MEGABYTE, id="lines without a key"),
        pytest.param(lambda: "\n".join(f"k{i} = " for i in range(400_000)), id="keys"),
        pytest.param(lambda: "lines = 5\n" * 400_000, id="one key again and again"),
        pytest.param(lambda: "lines = 6\n" * 400_000, id="one key contradicted"),
        pytest.param(lambda: "\n".join(f";k{i} = " for i in range(400_000)), id="comments"),
        pytest.param(lambda: "{" * (2 * _MEGABYTE), id="braces"),
    ],
)
def test_bombs_cost_little(tmp_path: Path, bomb: Callable[[], str]) -> None:
    path = tmp_path / "bomb.hdr"
    path.write_text(header_text() + bomb())
    start = time.process_time()
    with contextlib.suppress(FormatError):
        read_header(path)
    # linear: a quadratic reader takes minutes
    assert time.process_time() - start < 5


def test_long_list_takes_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "bomb.hdr"
    path.write_text(header_text("wavelength = {" + "4," * (_MEGABYTE // 4) + "}"))
    tracemalloc.start()
    error = expect_error(FormatError, "length-mismatch", lambda: read_header(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * path.stat().st_size
    assert len(str(error)) < 1000


def test_oversized_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "big.hdr"
    with open(path, "wb") as file:
        file.write(b"ENVI\n")
        file.truncate(2**30)
    expect_errors((FormatError, "over 4 MB", lambda: read_header(path)))


@pytest.mark.real_data
def test_real_headwall_header(shared_data: Path) -> None:
    header = read_header(shared_data / "envi_cube" / "darkReference.hdr")
    assert (header.lines, header.samples, header.bands) == (1, 1600, 978)
    assert (header.dtype, header.description) == (np.dtype("<u2"), "[HEADWALL Hyperspec III]")
    assert (header.wavelength[0], header.wavelength[1], header.wavelength[-1]) == (379.027, 379.663, 1000.95)
    assert (len(header.comments), header.comments["Serial Number"]) == (20, "G4-426")
    assert header.comments["Array Pixel Pitch (um)"] == "6.5"
    assert (header.fields["default bands"], header.notes) == ("{159,253,520}", ())


@pytest.mark.real_data
def test_real_header_with_bad_bands_and_rotation(shared_data: Path) -> None:
    header = read_header(next((shared_data / "envi_cube").glob("ang*.hdr")))
    assert header.good[:8].tolist() == [False] * 7 + [True]
    assert (header.fwhm[0], header.map_info.rotation) == (5.55165, 75)
    assert header.fields["correction factors"].startswith("{ 1.0 , 1.0")


@pytest.mark.real_data
def test_real_libraries_count_samples_as_wavelengths(shared_data: Path) -> None:
    berlin = read_header(shared_data / "envi_sli" / "library_berlin.hdr")
    assert berlin.is_spectral_library
    assert berlin.wavelength.shape == (177,)
    np.testing.assert_allclose(berlin.wavelength[[0, -1]], [460, 2409], rtol=1e-12)
    aviris = read_header(shared_data / "envi_sli" / "s07_AV95_envi.hdr").wavelength
    assert list(np.flatnonzero(np.diff(aviris) < 0) + 1) == [32, 96]  # 1-based neighbours of 31 and 95


# --- headers of other programs: keys that change the meaning of samples are honoured, or named ------------


SIZES = "ENVI\nsamples = 4\nlines = 10\nbands = 3\nheader offset = 0\ndata type = 12\nbyte order = 0\n"
PLAIN = "interleave = bil\nwavelength units = nm\nwavelength = {500, 510, 520}\n"
PLACE = "map info = {UTM, 1, 1, 500000, 4500000, 0.5, 0.5, 18, North, WGS-84}\n"


def header(folder: Path, text: str) -> Path:
    (folder / "a.hdr").write_text(SIZES + text)
    np.arange(120, dtype="u2").tofile(folder / "a")
    return folder / "a.hdr"


@pytest.mark.parametrize(
    ("unit", "wavelength", "fwhm", "expected", "is_told"),
    [
        ("um", "0.5, 0.51, 0.52", "5, 5, 5", 5.0, True),
        ("nm", "500, 510, 520", "0.005, 0.005, 0.005", 5.0, True),
        ("Unknown", "0.5, 0.51, 0.52", "5, 6, 5", 5.0, True),
        ("Angstroms", "5000, 5100, 5200", "5, 5, 5", 0.5, False),
        ("um", "0.5, 0.51, 0.52", "0.005, 0.005, 0.005", 5.0, False),
        ("nm", "760, 760.1, 760.2", "0.11, 0.11, 0.11", 0.11, False),
        ("nm", "450, 550, 850", "60, 60, 150", 60.0, False),
        ("nm", "500, 510, 520", "0, 0, 0", 0.0, False),
    ],
)
def test_widths_in_another_unit(
    unit: str, wavelength: str, fwhm: str, expected: float, is_told: bool, tmp_path: Path
) -> None:
    lists = f"wavelength units = {unit}\nwavelength = {{{wavelength}}}\nfwhm = {{{fwhm}}}\n"
    path = header(tmp_path, f"interleave = bil\ndescription = {{raw}}\n{lists}")
    said = remarks(lambda _: open_envi(path), tmp_path)
    assert [text for text in said if "fwhm" in text] == said * is_told
    with pytest.warns(match="header-doubtful") if is_told else xr.set_options():
        np.testing.assert_allclose(open_envi(path).fwhm[0], expected)


@pytest.mark.parametrize(
    ("text", "code", "word"),
    [
        (PLAIN + "file type = PCI\n", "file-type-wrong", "PCI"),
        (PLAIN + "file type = ERDAS IMAGINE\n", "file-type-wrong", "ERDAS"),
        (
            PLAIN + "file type = ENVI Standard\nread procedures = {a, b}\n",
            "file-type-wrong",
            "read procedures",
        ),
        (PLAIN + "data reflectance gain values = {1, 2, 3}\n", "header-doubtful", "data reflectance gain"),
        (PLAIN + "radiance scale factor = 100\n", "header-doubtful", "radiance scale factor"),
        (PLAIN.replace("bil", "bsq") + "autodarkstartline = 8\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = {8}\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = 12\n", "header-doubtful", "autodarkstartline"),
    ],
)
def test_keys_that_change_samples_are_named(text: str, code: str, word: str, tmp_path: Path) -> None:
    path = header(tmp_path, text)
    said = objection(lambda _: open_envi(path), tmp_path)
    assert code in said
    assert word in said


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (PLACE + "description = {[HEADWALL Hyperspec III],[HEADWALL Hyperspec III OR]}\n", "values"),
        (PLACE + "description = {raw_0 OR}\nfile type = ENVI\n", "values"),
        (PLACE + "data units = DN\n", "counts"),
        ("description = {[HEADWALL Hyperspec III]}\n", "counts"),
        ("autodarkstartline = 8\ndescription = {raw}\n", "counts"),
        ("autodarkstartline = 0\ndescription = {raw}\n", "counts"),
    ],
)
def test_integers_of_a_map_are_counts_only_by_their_units(text: str, name: str, tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + text)
    assert remarks(lambda _: open_envi(path), tmp_path) == []
    cube = open_envi(path)
    assert list(cube.data_vars) == [name]
    assert cube.sizes.get("along_track", 10) == (8 if "= 8" in text else 10)


def test_a_map_of_integers_is_no_dark(tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + PLACE)
    assert "values" in open_envi(path, unsaid="counts").data_vars
    expect_errors((FormatError, "dark-missing", lambda: open_envi(path, dark_lines=True)))
