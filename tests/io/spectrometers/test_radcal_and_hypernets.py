"""Calibrations of FRM4SOC, and irradiance of HYPERNETS."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from campaigns.faults.seed_files import RADCAL

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning

NAME = "CP_SAT0385_RADCAL_20220606105303.TXT"


def test_a_real_calibration(shared_data: Path) -> None:
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


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("!RADCAL", "!ANGDATA", "format-unknown"),
        ("[END_OF_LAMPDATA]", "", "table-missing"),
        ("500 0 4.0 1.0", "300 0 4.0 1.0", "wavelength-unordered"),
        ("410 1e-4", "410 broken", "line 16.*row-unreadable"),
        ("2.0 1.0", "nan 1.0", "not finite"),
    ],
)
def test_damaged_calibrations_are_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = tmp_path / "cal.txt"
    path.write_text(RADCAL)
    assert hp.io.read_radcal(path).sizes["wavelength"] == 2
    path.write_text(RADCAL.replace(old, new, 1))
    with pytest.raises(FormatError, match=problem):
        hp.io.read_radcal(path)


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
    path = tmp_path / "HYPERNETS_L_TEST_L1B_IRR_20240601T1200.nc"
    series = hp.open_irradiance(_hypernets(path, dim, level, time, [0, 0, 0]))
    np.testing.assert_allclose(series.irradiance[:, 0], np.multiply(level, 1e-3), rtol=1e-6)
    assert series.irradiance_time.values[0] == np.datetime64("2024-06-01T12:00:00")
    assert float(series.irradiance_fwhm.max()) == pytest.approx(3.2)


def test_flagged_spectra_of_hypernets_are_left_out(tmp_path: Path) -> None:
    time = np.array(["2024-06-01T12:00:00", "NaT", "2024-06-01T12:00:20", "2024-06-01T12:00:30"], "M8[ns]")
    path = _hypernets(tmp_path / "flagged.nc", "scan", [1000.0] * 4, time, [0, 0, 4, 0])
    with pytest.warns(PaintWarning, match="samples-flagged"):
        series = hp.open_irradiance(path)
    np.testing.assert_array_equal(series.irradiance_time, time[[0, 3]])
