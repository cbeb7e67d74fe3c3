"""Smoothing over the bands: what it keeps, what it says, what it refuses."""

from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_refusals
from support.strategies import flight

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.responses import spectral_parts
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import METHODS, at, smooth


def cube(lines: int = 20, bands: int = 15, columns: int = 4) -> xr.Dataset:
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, (lines, bands, columns)).astype("f4")
    return xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), values, {"units": "1", "tilt": "said"}),
            "quality": (("along_track", "cross_track"), rng.integers(0, 4095, (lines, columns)).astype("u2")),
        }
    )


def test_flags_survive_and_attributes_tell() -> None:
    before = cube()
    copy, made = before.copy(deep=True), smooth(before, "box", 5)
    xr.testing.assert_identical(made.quality, before.quality)
    xr.testing.assert_identical(before, copy)
    told = made.reflectance.attrs["smoothing"], made.reflectance.attrs["tilt"]
    assert told == ("box, 5 bands", "said")
    assert smooth(before).reflectance.attrs["smoothing"] == "Savitzky-Golay, 11 bands, order 2"


def test_saturated_samples_are_still_missing_afterwards() -> None:
    line = flight(bands=15, dtype=np.uint16).line
    line["counts"].values[3, 7, 2] = 40950
    made = reflectance(line)
    smoothed = made.paint.smooth("savitzky-golay", 5).compute()
    np.testing.assert_array_equal(np.isnan(smoothed.reflectance), np.isnan(made.reflectance))
    np.testing.assert_array_equal(smoothed.quality, made.quality)
    assert smoothed.quality.values[3, 2] == 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "chunks",
    [{"along_track": 1}, {"along_track": 7}, {"along_track": 6, "band": 4}, {"cross_track": 3}, {"band": 1}],
)
def test_the_same_bits_whatever_the_chunks(method: str, chunks: Any, no_compute: Any) -> None:
    whole = cube()
    whole.reflectance.values[2, 4, 1] = np.nan
    with no_compute():
        made = smooth(whole.chunk(chunks), method, 5)
    assert made.reflectance.dtype == np.float32
    with dask.config.set(scheduler="threads"):
        found = made.reflectance.compute()
    assert found.dtype == np.float32
    assert found.values.tobytes() == smooth(whole, method, 5).reflectance.values.tobytes()


@pytest.mark.parametrize(
    "dims", [("band",), ("signature", "band"), ("y", "x", "band"), ("band", "cross_track", "along_track")]
)
def test_any_arrangement_of_dims(dims: tuple[str, ...]) -> None:
    sizes = {"band": 15, "signature": 3, "y": 2, "x": 4, "cross_track": 3, "along_track": 2}
    values = np.random.default_rng(1).uniform(0, 1, [sizes[d] for d in dims]).astype("f4")
    array = xr.DataArray(values, dims=dims, attrs={"units": "1"})
    made = smooth(array.to_dataset(name="reflectance"), "box", 3).reflectance
    assert made.dims == dims
    expected = array.rolling(band=3, center=True, min_periods=1).mean()
    np.testing.assert_allclose(made, expected, rtol=1e-5)


def test_a_red_edge_as_published() -> None:
    # 0 to 0.6 over 30 nm (10 to 90 %), bands 2.21 nm apart
    nm = 2.214 * np.arange(121)
    edge = (0.6 / (1 + np.exp(-(nm - nm[60]) * 2 * np.log(9) / 30))).astype("f4")
    spectra = xr.Dataset({"reflectance": ("band", edge, {"units": "1"})})
    box = np.abs(smooth(spectra, "box", 11).reflectance.values - edge).max()
    polynomial = np.abs(smooth(spectra, "savitzky-golay", 11).reflectance.values - edge).max()
    assert box == pytest.approx(0.026, abs=0.008)
    assert polynomial == pytest.approx(0.002, abs=0.0015)


def test_everything_that_is_wrong_is_listed() -> None:
    error = expect_error(SchemaError, None, lambda: smooth(xr.Dataset(), "median", 4))
    assert error.codes == ("variable-missing", "choice-unknown", "value-out-of-range")
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: smooth(cube(), "box", 17)),
        (SchemaError, "value-out-of-range", "order ", lambda: smooth(cube(), "savitzky-golay", 5, order=4)),
    )


@pytest.mark.parametrize("method", ["box", "savitzky-golay"])
def test_a_band_that_is_not_good_touches_nothing(method: str) -> None:
    spectra, good = np.tile(np.linspace(0.2, 0.4, 21, dtype="f4"), (2, 1)), np.arange(21) != 10
    spectra[1, 10] = 9.0
    made = xr.Dataset({"reflectance": (("of", "band"), spectra, {"units": "1"})}, {"good": ("band", good)})
    plain, spoilt = smooth(made, method, 5).reflectance.values
    np.testing.assert_array_equal(spoilt[good], plain[good])
    assert spoilt[10] == np.float32(9.0)


AXES = {
    "overlap": np.r_[np.arange(400.0, 1000.0, 20.0), np.arange(960.0, 1400.0, 20.0)],
    "gap": np.r_[np.arange(400.0, 1000.0, 20.0), np.arange(1500.0, 1940.0, 20.0)],
    "descending": np.r_[np.arange(1400.0, 960.0, -20.0), np.arange(1000.0, 400.0, -20.0)],
}


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("method", METHODS)
def test_no_window_reaches_over_a_detector_join(axis: str, method: str) -> None:
    nm = AXES[axis]
    parts = spectral_parts(nm)
    assert len(parts) == 2
    step = np.where(np.arange(nm.size) < parts[0].stop, 0.2, 0.6).astype("f4")
    spectra = xr.Dataset(
        {"reflectance": ("band", step, {"units": "1"})}, {"wavelength": ("band", nm, {"units": "nm"})}
    )
    np.testing.assert_allclose(smooth(spectra, method, 7).reflectance, step, rtol=1e-5)
    assert smooth(spectra.chunk(band=5), method, 7).reflectance.chunks is not None


def test_axes_without_joins_are_one_part_and_shuffled_ones_are_refused() -> None:
    for nm in (np.r_[400:900:1.5, 902:1700:6.0], [450.0, 550.0, 650.0, 700.0, 850.0], [500.0], [5.0, 4.0]):
        assert len(spectral_parts(nm)) == 1
    nm = np.random.default_rng(3).permutation(np.arange(400.0, 1000.0, 5.0))
    spectra = xr.Dataset(
        {"reflectance": ("band", np.full(nm.size, 0.2, "f4"), {"units": "1"})},
        {"wavelength": ("band", nm, {"units": "nm"})},
    )
    expect_refusals((SchemaError, "wavelength-unordered", lambda: smooth(spectra, "box", 7)))


def test_no_band_is_near_inside_a_gap() -> None:
    spectra = xr.Dataset(coords={"wavelength": ("band", AXES["gap"], {"units": "nm"})})
    assert float(at(spectra, 985.0).wavelength) == 980.0
    expect_refusals((SchemaError, "band-missing", lambda: at(spectra, 1200.0)))
