"""The chain against numbers that others published, on their own files."""

from __future__ import annotations

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
    """Raw counts of a Specim FX10, whose own names for the dims are sample, point and wavelength."""
    names = {schema.ALONG_TRACK: "sample", schema.CROSS_TRACK: "point"}
    found = {}
    for name in ("capture", "white", "black"):
        with xr.open_dataset(shared_data / "real_counts" / f"specim_fx10_{name}.nc") as file:
            (array,) = schema.rename_to_roles(file.load(), names).data_vars.values()
        found[name] = array.assign_attrs(units="count")
    return found


def subtract_dark(counts, dark):
    """Counts above the dark in the dark's precision."""
    return (counts.astype(dark.dtype) - dark).transpose(*schema.CUBE)


@pytest.mark.real_data
def test_specim_counts__give_the_four_published_ratios(specim):
    """Rationale: real counts of another camera, dark and white frames, and ratios its users published.

    Expected: line 0 peaks at 0.7786328655500226 and bottoms at 0.125; its pixel 0 is 0.28365385 at the band
    nearest 1000 nm and 0.61686938 on the
    mean over wavelength.
    """
    dark = specim["black"].mean(schema.ALONG_TRACK, keep_attrs=True)
    above = subtract_dark(specim["capture"], dark)
    white = subtract_dark(specim["white"], dark).mean(schema.ALONG_TRACK)
    line = (above / white).isel(along_track=0)
    pixel = line.isel(cross_track=0)
    near = int(np.abs(line["wavelength"].values - 1000.0).argmin())

    assert above.dims == schema.CUBE
    assert above.dtype == np.float64
    assert float(line.max()) == 0.7786328655500226
    assert float(line.min()) == 0.125
    assert float(pixel.isel(band=near)) == pytest.approx(0.28365385, abs=5e-9)
    wavelength = pixel["wavelength"].values
    broadband = np.trapezoid(pixel.values, wavelength) / np.ptp(wavelength)
    assert broadband == pytest.approx(0.61686938, abs=5e-9)


@pytest.mark.real_data
def test_specim_counts__are_the_same_in_single_precision(specim):
    """Expected: a float32 dark, as stores hold it, moves a count by no more than rounding does."""
    dark = specim["black"].mean(schema.ALONG_TRACK, keep_attrs=True)
    double = subtract_dark(specim["capture"], dark)
    single = subtract_dark(specim["capture"], dark.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=1e-3)
