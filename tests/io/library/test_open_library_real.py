"""Real libraries with their known values, and against SPy, which reads them by its own code."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError

pytestmark = pytest.mark.real_data

USGS = "splib07a_Brilliant(Hansa)yellowGDS785_ASDFRa_AREF.txt"
METAL = "jhu.becknic.manmade.roofing.metal.solid.0384uuu.spectrum.txt"
CEMENT = "jhu.becknic.manmade.construction.cement.solid.0432uuu.spectrum.txt"
SOIL = "soil.alfisol.haploxeralf.none.all.87p313.jhu.becknic.spectrum.txt"
AXES = ("reflectance", "wavelength")
WAVELENGTHS = "s07_ASD_Wavelengths_ASD_0.35-2.5_microns_2151_ch.txt"


@pytest.fixture
def sli(shared_data: Path) -> Path:
    return shared_data / "envi_sli"


@pytest.fixture
def text(shared_data: Path) -> Path:
    return shared_data / "spectra_ascii"


SPY_ON_NUMPY_2_5 = pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning")


def spy_library(path: Path) -> Any:
    return pytest.importorskip("spectral.io.envi").open(str(path.with_suffix(".hdr")), str(path))


def assert_is_library(library: xr.Dataset) -> None:
    assert [(library[name].dims, library[name].dtype, library[name].attrs["units"]) for name in AXES] == [
        (("signature", "band"), np.float32, "1"),
        (("band",), np.float64, "nm"),
    ]
    assert all(library.attrs[key] for key in ("source", "format"))


def test_berlin__has_its_scale_in_a_plot_title_and_its_classes_beside_it(sli: Path) -> None:
    # Expected: first stored value 589.95611966 of a reflectance times 10,000; 75 spectra, 177 bands.
    library = hp.open_library(sli / "library_berlin.hdr")
    assert_is_library(library)
    assert (
        dict(library.sizes),
        library["reflectance"].values[0, 0],
        library["wavelength"].values[[0, -1]].tolist(),
    ) == ({"signature": 75, "band": 177}, np.float32(0.058995611966), [460.0, 2409.0])
    roof = library.sel(signature="zinc")
    assert (roof["level_1"].item(), roof["level_3"].item()) == ("impervious", "roof")
    xr.testing.assert_identical(library, hp.open_library(sli / "library_berlin.sli"))


@SPY_ON_NUMPY_2_5
def test_berlin__is_as_spy_reads_it(sli: Path) -> None:
    found, spy = hp.open_library(sli / "library_berlin.sli"), spy_library(sli / "library_berlin.sli")
    assert found["signature"].values.tolist() == [name.strip() for name in spy.names]
    np.testing.assert_allclose(found["reflectance"].values, spy.spectra / 1e4, rtol=1e-6)
    np.testing.assert_allclose(found["wavelength"].values, np.array(spy.bands.centers) * 1e3)
    np.testing.assert_allclose(found["fwhm"].values, np.array(spy.bands.bandwidths) * 1e3)


def test_usgs_aviris__has_two_records_that_are_no_spectra_and_error_bars(sli: Path) -> None:
    # Expected: the values of SOURCES.md, and wavelengths that fall at 31 and 95.
    library = hp.open_library(sli / "s07_AV95_envi.sli")
    assert_is_library(library)
    # 3,139 records: wavelengths, bandwidths, and 680 error bars beside the spectra
    assert dict(library.sizes) == {"signature": 3139 - 2 - 680, "band": 224}
    painted = library.isel(
        signature=[at for at, n in enumerate(library["signature"].values) if "GDS333" in n][:1]
    )
    assert "Painted_Aluminum" in painted["signature"].item()
    np.testing.assert_allclose(painted["reflectance"].values[0, [20, 50]], [0.52703726, 0.4621601], rtol=1e-6)
    np.testing.assert_allclose(
        (
            library.isel(
                signature=[at for at, n in enumerate(library["signature"].values) if "GDS398" in n][:1]
            )
        )["reflectance"].values[0, [20, 50]],
        [0.10421019, 0.670282],
        rtol=1e-6,
    )
    assert np.flatnonzero(np.diff(library["wavelength"].values) < 0).tolist() == [31, 95]
    assert float(library["reflectance"].min()) > -0.1
    assert float(library["reflectance_u_random"].min()) >= 0.0


@SPY_ON_NUMPY_2_5
def test_usgs_aviris__is_as_spy_reads_it(sli: Path) -> None:
    # Rationale: the coordinate `record` leads back, so every one of the 3,139 records is accounted for.
    found, spy = hp.open_library(sli / "s07_AV95_envi.hdr"), spy_library(sli / "s07_AV95_envi.sli")
    stored = spy.spectra.astype(np.float64)
    assert (stored < -1e30).sum() == 80591
    stored[stored < -1e20] = np.nan  # convolution has spread some of the fill to its neighbours
    record = found["record"].values
    np.testing.assert_array_equal(found["reflectance"].values, stored[record].astype(np.float32))
    assert found["signature"].values.tolist() == [spy.names[at].strip() for at in record]
    known = np.isfinite(found["reflectance_u_random"].values).any(axis=1)
    expected = stored[record[known] + 1].astype(np.float32)
    expected[expected < 0] = np.nan
    np.testing.assert_array_equal(found["reflectance_u_random"].values[known], expected)
    bars = {at for at, name in enumerate(spy.names) if name.strip().startswith("error bars to preceding")}
    assert {*record.tolist(), *bars, 0, 1} == set(range(3139))
    np.testing.assert_allclose(found["wavelength"].values, stored[0] * 1e3, rtol=1e-5)
    np.testing.assert_allclose(found["fwhm"].values, stored[1] * 1e3, rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "paint", "form", "count", "ends", "first"),
    [
        (METAL, "Aluminum Metal", "ASTER", 536, (300.0, 12500.0), 0.2907),
        (CEMENT, "Construction Concrete", "ASTER", 491, (420.0, 14000.0), 0.250946),
        (SOIL, "Brown to dark brown gravelly loam", "ECOSTRESS", 2844, (14011.2, 400.0), 0.015945),
    ],
)
def test_ecostress_and_aster__have_their_known_values(
    text: Path, name: str, paint: str, form: str, count: int, ends: tuple[float, float], first: float
) -> None:
    library = hp.open_library(text / name)
    assert_is_library(library)
    assert library["signature"].values.tolist() == [paint]
    assert library.attrs["format"].startswith(form)
    assert library.sizes["band"] == count
    np.testing.assert_allclose(library["wavelength"].values[[0, -1]], ends)
    assert library["reflectance"].values[0, 0] == np.float32(first)
    assert "notes" not in library.attrs


def test_aster__values_that_wrap_are_whole(text: Path) -> None:
    library = hp.open_library(text / METAL)
    assert (library["origin"].item(), library["sample_no"].item()) == (
        "Spectra obtained from the Noncoventional Exploitation Factors Data System of the National "
        "Photographic Interpretation Center.",
        "0384UUUALM",
    )


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # SPy leaves files open
@pytest.mark.parametrize("name", [METAL, CEMENT, SOIL])
def test_ecostress_and_aster__are_as_spy_reads_them(text: Path, name: str) -> None:
    module, function = ("ecostress", "read_ecostress_file") if name == SOIL else ("aster", "read_aster_file")
    theirs = getattr(pytest.importorskip(f"spectral.database.{module}"), function)(str(text / name))
    ours = hp.open_library(text / name).sortby("wavelength")
    np.testing.assert_allclose(ours["wavelength"].values, np.array(theirs.x) * 1e3)
    np.testing.assert_allclose(ours["reflectance"].values[0], np.array(theirs.y) / 100.0, rtol=1e-6)


@pytest.mark.parametrize("given", [False, True])
def test_usgs_text__finds_its_wavelengths_or_is_told_them(text: Path, given: bool) -> None:
    library = hp.open_library(text / USGS, wavelength=text / WAVELENGTHS if given else None)
    assert_is_library(library)
    assert (
        library["signature"].values.tolist(),
        library["spectrometer"].item(),
        library["measurement"].item(),
        library["reflectance"].values[0, 0],
    ) == (["Brilliant(Hansa)yellowGDS785"], "ASDFRa", "AREF", np.float32(1.1358514e-2))
    assert (library["wavelength"].values[0], library.sizes["band"]) == (pytest.approx(349.99999), 2151)


def test_usgs_text__is_as_spy_reads_it(text: Path) -> None:
    usgs = pytest.importorskip("spectral.database.usgs")
    theirs = usgs.SampleData.read_from_file(str(text / USGS))
    axis = usgs.SpectrometerData.read_from_file(str(text / WAVELENGTHS))
    ours = hp.open_library(text / USGS)
    np.testing.assert_array_equal(ours["reflectance"].values[0], np.float32(theirs.values))
    np.testing.assert_allclose(ours["wavelength"].values, np.array(axis.values) * 1e3)


def test_usgs_text__without_wavelengths_says_what_is_missing(text: Path, tmp_path: Path) -> None:
    alone = tmp_path / "a" / "b" / "c" / USGS
    alone.parent.mkdir(parents=True)
    alone.write_bytes((text / USGS).read_bytes())
    expect_errors((FormatError, "wavelength-missing", lambda: hp.open_library(alone)))


def test_wavelengths_are_no_spectrum(text: Path) -> None:
    expect_errors((FormatError, "quantity-wrong", lambda: hp.open_library(text / WAVELENGTHS)))


@pytest.mark.parametrize(("name", "first"), [("PVC_Red", (344.200012, 0.367868)), ("R90", (250.0, 0.942517))])
def test_plain_tables__have_their_known_values(text: Path, name: str, first: tuple[float, float]) -> None:
    library = hp.open_library(text / f"{name}.txt")
    assert (
        library["signature"].values.tolist(),
        library["wavelength"].values[0],
        library["reflectance"].values[0, 0],
    ) == ([name], first[0], np.float32(first[1]))


def test_tables_with_headings__are_read(shared_data: Path) -> None:
    # Expected: latin-1 and semicolons; and a mean with its standard deviation, of which a comment tells.
    panel = hp.open_library(shared_data / "lab_calibration/zenith_lite_95R_certificate.csv")
    assert panel["reflectance"].values[0, 0] == np.float32(0.911211)
    assert "notes" not in panel.attrs  # "nm" stands in its heading
    lawn = hp.open_library(shared_data / "radiance_vs_field/insitu_BeckmanLawn.txt")
    assert (
        lawn["signature"].values.tolist(),
        lawn["reflectance"].values[0, int(np.flatnonzero(lawn["wavelength"].values == 550.0)[0])],
        lawn["reflectance_sd"].values[0, 0],
    ) == (["insitu_BeckmanLawn"], np.float32(0.0670867), np.float32(0.00805685))


def test_several_files__make_one_library_where_wavelengths_are_equal(text: Path) -> None:
    library = hp.open_library(str(text / "PVC_*.txt"))
    assert (library["signature"].values.tolist(), library["file"].values.tolist()) == (
        ["PVC_Red", "PVC_White"],
        ["PVC_Red.txt", "PVC_White.txt"],
    )
    assert "one of the equal rows is kept" in library.attrs["notes"]  # two of 1024, where detectors join
    expect_errors(
        (
            FormatError,
            r"R90.txt.*grid-mismatch",
            lambda: hp.open_library([text / "PVC_Red.txt", text / "PVC_White.txt", text / "R90.txt"]),
        )
    )


def test_a_folder_of_different_grids__is_one_error_that_names_them_all(text: Path) -> None:
    # Rationale: the ancillary text and the file of wavelengths are no spectra, and are not among them.
    with pytest.raises(FormatError) as caught:
        hp.open_library(text)
    message = str(caught.value)
    assert "ancillary" not in message
    assert WAVELENGTHS not in message
    assert all(name in message for name in (SOIL, METAL, USGS, "R90.txt"))
