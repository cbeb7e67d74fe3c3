"""Every real ``.sig`` file beside the project, against values known from elsewhere."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.svc_texts import german

from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.base.units import conversion_factor
from hyperpaint.cli.info_command import describe_path
from hyperpaint.io.spectrometers.svc import open_svc, read_svc

pytestmark = pytest.mark.real_data

NAMES = [
    "241016_1051_R009_T014", "ACPL_D2_P1_B_1_001", "ACPL_D2_P1_T_1_WR_000", "BNL13001_000",
    "BNL13001_000_moc", "BNL13002_000", "BNL13002_000_moc", "HR.020824.0000", "gr070214_003",
]  # fmt: skip
DATE = {"dayfirst": False}  # of the files whose dates make sense both ways; their names settle it
VENDORS = "1e-10 W cm-2 sr-1 nm-1"


@pytest.fixture
def folder(shared_data: Path) -> Path:
    return shared_data / "svc_sig"


def opened(paths: object, **options: object) -> xr.Dataset:
    # Open files whose clocks are no matter, without the warnings that they deserve
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return open_svc(paths, **options)


def test_every_file_is_tested(folder: Path) -> None:
    assert sorted(path.stem for path in folder.iterdir()) == sorted(NAMES)


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


@pytest.mark.parametrize(
    ("name", "nm", "panel", "surface", "percent"),
    [
        ("ACPL_D2_P1_B_1_001", 549.4, 71380.57, 5034.72, 7.05),
        ("gr070214_003", 550.0, 14675.44, 298.75, 2.04),
        ("241016_1051_R009_T014", 549.4, 446383.30, 41219.13, 9.23),
        ("ACPL_D2_P1_T_1_WR_000", 549.4, None, None, 100.02),
        ("BNL13001_000", 550.1, None, None, 8.49),
        ("BNL13001_000_moc", 550.1, None, None, 8.35),
        ("BNL13002_000", 550.1, None, None, 14.53),
        ("BNL13002_000_moc", 550.1, None, None, 14.40),
    ],
)
def test_known_values(
    folder: Path, name: str, nm: float, panel: float | None, surface: float | None, percent: float
) -> None:
    path = folder / f"{name}.sig"
    assert opened(path)["reflectance"].sel(wavelength=nm).item() == pytest.approx(percent / 100, abs=5e-5)
    if panel is not None:
        factor = conversion_factor(VENDORS, "W m-2 sr-1 nm-1")
        target = opened(path, quantity="radiance")["radiance"]
        white = opened(path, quantity="radiance", scan="reference")["radiance"]
        assert target.sel(wavelength=nm).item() == pytest.approx(surface * factor, rel=1e-12)
        assert white.sel(wavelength=nm).item() == pytest.approx(panel * factor, rel=1e-12)
        assert target.attrs["units"] == "W m-2 sr-1 nm-1"


def test_a_white_panel_is_white(folder: Path) -> None:
    white = opened(folder / "ACPL_D2_P1_T_1_WR_000.sig")["reflectance"]
    assert white.where((white.wavelength > 450) & (white.wavelength < 900)).mean().item() == pytest.approx(
        1.0, abs=0.002
    )


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
    assert found.sizes == {"spectrum": 1, "wavelength": rows}
    assert (found["overlap"].item(), found["overlap_matched"].item()) == (overlap, matched)
    assert (found["factor_reference"].item(), found["factor_target"].item()) == factors
    assert (found["error_reference"].item(), found["error_target"].item()) == errors
    assert np.all(np.diff(found["wavelength"].values) > 0) == overlap.startswith("removed")
    header = json.loads(found["header"].item())
    assert (header["factors"], found["instrument"].item()) == (found["factors"].item(), header["instrument"])


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


def test_raw_and_matched_files_do_not_mix_unless_trimmed_alike(folder: Path) -> None:
    both = [folder / "BNL13001_000.sig", folder / "BNL13001_000_moc.sig"]
    with pytest.raises(FormatError) as raised:
        opened(both)
    for part in ("1024 from", "overlap kept: BNL13001_000.sig", "982 from", "joins=(970, 1901)"):
        assert part in str(raised.value)
    with pytest.raises(FormatError, match="grid-mismatch"):
        opened([folder / "ACPL_D2_P1_B_1_001.sig", both[0]])
    found = opened(both, overlap="trim", joins=(970, 1901))
    assert found.sizes == {"spectrum": 2, "wavelength": 982}
    assert found["overlap"].values.tolist() == ["trimmed @ 970, 1901 nm", "removed @ 970, 1901 nm"]
    assert found["overlap_matched"].values.tolist() == [False, True]


@pytest.mark.parametrize("name", NAMES)
def test_trimmed_wavelengths_increase(folder: Path, name: str) -> None:
    kept, trimmed = opened(folder / f"{name}.sig"), opened(folder / f"{name}.sig", overlap="trim")
    at = trimmed["wavelength"].values
    assert np.all(np.diff(at) > 0.0)
    assert at.size == (kept["wavelength"].size if "removed" in kept["overlap"].item() else at.size)
    for detector in ("VNIR", "SWIR1", "SWIR2"):
        ours = trimmed["reflectance"].isel(wavelength=(trimmed["detector"] == detector).values)
        theirs = kept["reflectance"].isel(wavelength=(kept["detector"] == detector).values)
        np.testing.assert_array_equal(ours, theirs.sel(wavelength=ours["wavelength"]))


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


def test_a_date_that_may_be_either_is_no_date(folder: Path) -> None:
    with pytest.warns(PaintWarning, match="date-ambiguous"):
        found = open_svc(folder / "HR.020824.0000.sig")
    assert np.isnat(found["time"].values[0])
    found = open_svc(folder / "HR.020824.0000.sig", dayfirst=True)
    assert found["time"].values[0] == np.datetime64("2024-08-02T09:07:53.786", "ns")


@pytest.mark.parametrize("name", ["gr070214_003", "ACPL_D2_P1_B_1_001", "BNL13001_000_moc"])
def test_the_german_twin_is_the_same(folder: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.sig"
    path.write_text(german((folder / path.name).read_text("latin-1")), "latin-1")
    assert "0,99" in path.read_text() or "1,0" in path.read_text() or "0,8" in path.read_text()
    ours = opened(folder / path.name, **DATE, utc_offset_h=-5)
    twin = opened(path, utc_offset_h=-5)
    header = {key: coord for key, coord in ours.coords.items() if key not in ("header", "factors")}
    for key, coord in header.items():
        xr.testing.assert_identical(coord.variable, twin[key].variable)
    np.testing.assert_array_equal(ours["reflectance"], twin["reflectance"])
    assert not np.isnat(twin["time"].values).any()


def test_info(folder: Path) -> None:
    text = describe_path(folder / "BNL13001_000_moc.sig")
    for part in (
        "SVC spectrum, HI: 6142041 (HR-1024i)",
        "338.2 to 2517.2 nm, 982 channels",
        "removed @ 970, 1901 nm",
        "Radiance @ 976 - 1010 / NIR-SWIR On (factors 0.795, 0.848, 1.000)",
        "7/29/2017 1:55:32 AM",
        "reference 6, target 1",
    ):
        assert part in text
    text = describe_path(folder / "HR.020824.0000.sig")
    assert "52.432360, 13.533627" in text
    assert "090753.786 UTC" in text
