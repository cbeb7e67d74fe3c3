"""Real ENVI cubes: their known values, and other readers as oracles."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_equal

from hyperpaint.base import schema
from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.envi.envi_cubes import open_envi


@pytest.mark.real_data
def test_real_headwall_dark_reference(shared_data: Path) -> None:
    for name in ("darkReference.hdr", "darkReference"):
        counts = open_envi(shared_data / "envi_cube" / name).counts
        assert (counts.shape, counts.dtype) == ((1, 978, 1600), np.uint16)
        assert (counts.attrs["units"], int(counts.min()), int(counts.max())) == ("count", 2, 47)
        assert float(counts.mean(dtype="f8")) == pytest.approx(13.97111260, abs=5e-9)


@pytest.mark.real_data
def test_real_cube_without_byte_order(shared_data: Path) -> None:
    with pytest.warns(PaintWarning, match="header-doubtful"):
        counts = open_envi(shared_data / "envi_cube/corn-kernel-hyperspectral.hdr", quantity="counts").counts
    assert (counts.shape, int(counts.min()), int(counts.max())) == ((31, 580, 43), 0, 2887)
    assert float(counts.mean(dtype="f8")) == pytest.approx(601.543934, abs=5e-7)
    assert counts.wavelength.values[[0, -1]].tolist() == [366.551, 1048.421]


@pytest.mark.real_data
def test_real_rotated_bip_cube(shared_data: Path) -> None:
    array = open_envi(next((shared_data / "envi_cube").glob("ang*.img")))["values"]
    assert (array.dims, array.shape) == (("y", "x", "band"), (10, 10, 432))
    assert float(array.min()) == pytest.approx(-1.98575, abs=5e-6)
    assert float(array.max()) == pytest.approx(1.09767, abs=5e-6)
    assert float(array.mean(dtype="f8")) == pytest.approx(0.162651, abs=5e-7)
    assert float(array[0, 0, 0]) == pytest.approx(-0.08066899, abs=5e-9)


@pytest.mark.real_data
def test_real_prism_radiance(shared_data: Path) -> None:
    array = open_envi(shared_data / "envi_cube" / "prm20231110t071521_rdn_two_px")["values"]
    assert (array.dims, array.shape) == (schema.CUBE, (2, 246, 1))
    assert float(array.min()) == pytest.approx(0.0429913, abs=5e-8)
    assert float(array.max()) == pytest.approx(7.78472, abs=5e-6)
    assert float(array.mean(dtype="f8")) == pytest.approx(2.54413724, abs=2e-7)


@pytest.mark.real_data
def test_real_toy_cube_with_both_headers(shared_data: Path, tmp_path: Path) -> None:
    i, k, j = np.meshgrid(np.arange(5), np.arange(20), np.arange(4), indexing="ij")
    folder = shared_data / "envi_cube"
    shutil.copy(folder / "test_image.img", tmp_path / "copy.img")
    shutil.copy(folder / "test_image_multiline_header.hdr", tmp_path / "copy.hdr")
    for path in (folder / "test_image.hdr", tmp_path / "copy.hdr"):
        line = open_envi(path)
        np.testing.assert_array_equal(line["values"], 1 + j + 4 * i + 20 * k)
        np.testing.assert_allclose(line.wavelength, 1e3 * np.arange(20, 40), rtol=1e-14)
        assert "micrometres" in line.attrs["envi_notes"]


@pytest.mark.real_data
def test_real_specim_calibration_cube(shared_data: Path) -> None:
    line = open_envi(shared_data / "lab_calibration" / "specim_fenix_Radiometric_8x2_1x1.dat")
    assert line["values"].shape == (1, 363, 384)
    assert line.wavelength.values[[0, -1]].tolist() == [379.87, 2503.73]


def _as_lines_samples_bands(line: xr.Dataset) -> np.ndarray:
    (name,) = line.data_vars
    values: np.ndarray = line[name].transpose(..., "band").values
    return values


_CUBES = (
    "darkReference",
    "prm20231110t071521_rdn_two_px",
    "ang20150420t182808_corr_v1e_img_4200-4210_70-80.img",
)


@pytest.mark.real_data
@pytest.mark.parametrize("name", _CUBES)
def test_real_spectral_python_agrees(shared_data: Path, name: str) -> None:
    pytest.importorskip("spectral")
    from spectral.io import envi as spy

    data = shared_data / "envi_cube" / name
    header = data.with_name(name.removesuffix(".img") + ".hdr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image = spy.open(str(header), str(data))
        oracle = np.asarray(image.open_memmap(interleave="bip"))
    line = open_envi(data)
    expect_equal((_as_lines_samples_bands(line), oracle), (line.wavelength, image.bands.centers))
    if "fwhm" in line.coords:
        np.testing.assert_array_equal(line.fwhm, image.bands.bandwidths)


@pytest.mark.real_data
@pytest.mark.parametrize("name", _CUBES)
def test_real_gdal_agrees(shared_data: Path, name: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    data = shared_data / "envi_cube" / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(data, driver="ENVI") as source:
            oracle = source.read().transpose(1, 2, 0)
    np.testing.assert_array_equal(_as_lines_samples_bands(open_envi(data)), oracle)
