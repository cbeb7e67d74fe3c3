"""The chain against numbers that others published, on their own files."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base import schema

pytest.importorskip(
    "h5netcdf", reason="the Specim sample is netCDF: python -m pip install 'hyperpaint[test]'"
)


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
    broadband = np.trapezoid(pixel, wavelength) / np.ptp(wavelength)
    assert broadband == pytest.approx(0.61686938, abs=5e-9)
