"""Certificates of panels, lists of pairs, and files of references."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from campaigns.faults.seed_files import RADCAL
from hypothesis import given, strategies as st
from support.refusals import expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.spectrometers.reference_files import open_references, read_pairs
from hyperpaint.io.spectrometers.spectrum_csv import read_certificate
from hyperpaint.io.spectrometers.spectrum_files import find_paths, for_all, name_spectra, same_grids


@pytest.mark.real_data
def test_real_certificates(shared_data: Path) -> None:
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    assert (
        panel.dtype,
        panel.attrs["units"],
        panel["wavelength"].attrs["units"],
        float(panel.sel(wavelength=250.0)),
    ) == (np.float64, "1", "nm", 0.942517)
    zenith = hp.io.read_certificate(shared_data / "lab_calibration" / "zenith_lite_95R_certificate.csv")
    assert (float(zenith.sel(wavelength=250.0)), float(zenith.sel(wavelength=312.0))) == (0.911211, 0.967611)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("p.csv", "paint,reference\na,b\na,c\nd,e\na,b\n", {"a": ("b", "c"), "d": ("e",)}),
        ("p.csv", '\ufeff"a, b",x\n# note\n\nümlaut , y \n', {"a, b": ("x",), "ümlaut": ("y",)}),
        ("p.json", '{"a": "b", "c": ["d", "e"]}', {"a": ("b",), "c": ("d", "e")}),
    ],
)
def test_pairs(tmp_path: Path, name: str, content: str, expected: dict[str, tuple[str, ...]]) -> None:
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
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
                (b"500,0.9\n400,0.9\n", "wavelength-unordered"),
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
    path = tmp_path / name
    path.write_bytes(content)
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
    with pytest.raises(FormatError, match="references cannot") as caught:
        open_references([tmp_path / name for name in ("a.sig", "b.asd", "c.txt")])
    for name in ("a.sig", "b.asd", "c.txt"):
        assert name in str(caught.value)
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
    assert (wavelength, values, _read(tmp_path, heading, 1.5, 1e-3)[1]) == (
        pytest.approx([400.0, 500.0]),
        [0.98, 0.98],
        [0.015, 0.015],
    )


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
    assert (
        made.device,
        made.lamp,
        made.laboratory,
        float(made.lamp_irradiance.sel(lamp_wavelength=300.0)),
    ) == ("SAT0385", "TO_717", "Tartu Observatory", pytest.approx(1.5637e-3))
    assert (
        float(made.lamp_irradiance_u.sel(lamp_wavelength=300.0)),
        float(made.panel_reflectance.sel(panel_wavelength=350.0)),
        made.sizes["wavelength"],
    ) == (pytest.approx(0.0231 / 2), pytest.approx(0.989), 255)
    pixel = made.isel(wavelength=50)
    assert (
        float(pixel.wavelength),
        float(pixel.coefficient),
        float(pixel.coefficient_u),
        pixel.counts.values.tolist(),
    ) == (471.98, 1.119e-4, pytest.approx(0.00835), [13893.0, 13901.87])
    assert np.isnan(made.coefficient[0])
    inside = made.panel_radiance.sel(lamp_wavelength=350.0)
    expected = made.lamp_irradiance.sel(lamp_wavelength=350.0) * 0.989 / np.pi
    assert float(inside) == pytest.approx(float(expected))
    assert np.isnan(made.panel_radiance[0])
    path = tmp_path / "cal.txt"
    path.write_text(RADCAL)
    assert hp.io.read_radcal(path).sizes["wavelength"] == 2


def _hypernets(path: Path, dim: str, level: list[float], time: np.ndarray, flags: list[int]) -> Path:
    # Write a product with names and units as hypernets_processor writes them: no real file is at hand
    nm = np.arange(400.0, 1001.0, 5.0)
    values = np.outer(np.ones(nm.size), level)
    data = xr.Dataset(
        {
            "irradiance": (("wavelength", dim), values, {"units": "mW m^-2 nm^-1"}),
            "bandwidth": ("wavelength", np.full(nm.size, 3.2)),
            "acquisition_time": (dim, time),
            "quality_flag": (dim, np.array(flags, np.uint32)),
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
    assert (series.irradiance_time.values[0], float(series.irradiance_fwhm.max())) == (
        np.datetime64("2024-06-01T12:00:00"),
        pytest.approx(3.2),
    )


def test_flagged_spectra_of_hypernets_are_left_out(tmp_path: Path) -> None:
    time = np.array(["2024-06-01T12:00:00", "NaT", "2024-06-01T12:00:20", "2024-06-01T12:00:30"], "M8[ns]")
    path = _hypernets(tmp_path / "flagged.nc", "scan", [1000.0] * 4, time, [0, 0, 4, 0])
    with pytest.warns(PaintWarning, match="samples-flagged"):
        series = hp.open_irradiance(path)
    np.testing.assert_array_equal(series.irradiance_time, time[[0, 3]])


# --- the chain against numbers that others published, on their own files ----------------------------------


@pytest.fixture
def specim(shared_data: Path) -> dict[str, xr.DataArray]:
    # Raw counts of a Specim FX10, whose own names for the dims are sample, point and wavelength
    pytest.importorskip("h5netcdf")
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
    assert (
        pixel[np.abs(wavelength - 1000.0).argmin()],
        np.trapezoid(pixel, wavelength) / np.ptp(wavelength),
    ) == (pytest.approx(0.28365385, abs=5e-9), pytest.approx(0.61686938, abs=5e-9))


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
    with pytest.raises(FormatError) as caught:
        for_all(["a", "good", "b"], read)
    assert (caught.value.codes, caught.value.problem.found, caught.value.problems[0].found) == (
        (("file-truncated",)),
        "spectra cannot be used",
        "a, b: truncated: at 3",
    )


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

    assert (find(tmp_path), find([tmp_path / "c.txt", str(tmp_path / "**" / "*.sig")])) == (
        ["a.sig", "b.sig"],
        ["c.txt", "a.sig", "b.sig", "d.sig"],
    )
    assert find(tmp_path / "gone.sig") == ["gone.sig"]  # to read it is the error that names it
    expect_refusals(
        (FormatError, "file-not-found", lambda: find([str(tmp_path / "one*"), str(tmp_path / "two*")])),
        (FormatError, "empty-input", lambda: find([])),
    )
