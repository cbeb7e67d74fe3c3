"""Bands by wavelength, and spectra without their smile."""

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
from hyperpaint.radiometry.spectral_axis import METHODS, at, smooth, to_nominal

SHIFT = np.array([-1.3, 0.0, 0.4, 2.2])


def smiling(lines: int = 6) -> tuple[xr.Dataset, np.ndarray]:
    wavelength = np.linspace(500.0, 560.0, 13)
    values = 0.4 + 0.3 * np.sin((wavelength[:, None] + SHIFT) / 15)
    dataset = xr.Dataset(
        {
            "reflectance": (
                ("along_track", "band", "cross_track"),
                np.tile(values, (lines, 1, 1)).astype("f4"),
                {"units": "1"},
            ),
            "counts": (("along_track", "band", "cross_track"), np.zeros((lines, 13, 4), "u2")),
            "quality": (("along_track", "cross_track"), np.arange(lines * 4).reshape(lines, 4).astype("u2")),
        },
        {
            "wavelength": ("band", wavelength, {"units": "nm"}),
            "wavelength_shift": ("cross_track", SHIFT, {"units": "nm"}),
        },
    )
    return dataset, 0.4 + 0.3 * np.sin(wavelength / 15)


def test_a_missing_band_touches_its_neighbours_only_and_descending_bands_are_the_same() -> None:
    dataset, _ = smiling(1)
    turned = to_nominal(dataset.isel(band=slice(None, None, -1))).reflectance.isel(band=slice(None, None, -1))
    np.testing.assert_allclose(turned, to_nominal(dataset).reflectance, rtol=1e-5)
    dataset.reflectance.values[0, 6, :] = np.nan
    missing = np.isnan(to_nominal(dataset).reflectance.values[0])
    assert np.flatnonzero(missing[:, 1]).tolist() == [6]
    assert set(np.flatnonzero(missing[1:12, 0]) + 1) <= {4, 5, 6, 7, 8}


def test_no_smile_is_no_work_and_what_cannot_be_is_refused() -> None:
    dataset, _ = smiling()
    plain = dataset.drop_vars("wavelength_shift")
    made = to_nominal(plain)
    xr.testing.assert_identical(made.reflectance, plain.reflectance)
    assert "counts" not in made
    shuffled = dataset.isel(band=np.random.default_rng(3).permutation(13))
    crossed = dataset.assign_coords(
        wavelength_shift=(("band", "cross_track"), 6.0 * np.eye(13, 4), {"units": "nm"})
    )
    expect_refusals(
        (SchemaError, "variable-missing", lambda: to_nominal(dataset.drop_vars("reflectance"))),
        (SchemaError, "bands-too-few", lambda: to_nominal(dataset.isel(band=slice(0, 3)))),
        (SchemaError, "wavelength-unordered", lambda: to_nominal(shuffled)),
        (SchemaError, "wavelength-unordered", lambda: to_nominal(crossed)),
    )
    # gaps between pairs of bands are no disorder
    dataset = dataset.isel(along_track=slice(1))
    nm = 500.0 + 100.0 * np.repeat(np.arange(8), 2)[:13] + 2.0 * (np.arange(13) % 2)
    pairs = dataset.assign_coords(wavelength=("band", nm, {"units": "nm"}))
    np.testing.assert_array_equal(to_nominal(pairs).reflectance[0, :, 1], pairs.reflectance[0, :, 1])


@pytest.mark.parametrize(
    "detectors", [(range(8), range(6, 13)), (range(12, 6, -1), range(7, -1, -1)), (range(11), range(10, 13))]
)
def test_detectors_in_one_cube_are_interpolated_apart(detectors: tuple[range, ...]) -> None:
    dataset, _ = smiling(1)
    joined = to_nominal(dataset.isel(band=[band for bands in detectors for band in bands])).reflectance
    start = 0
    for bands in detectors:
        found, start = joined.isel(band=slice(start, start + len(bands))), start + len(bands)
        if len(bands) > 3:
            np.testing.assert_array_equal(found, to_nominal(dataset.isel(band=list(bands))).reflectance)
        np.testing.assert_array_equal(found[0, :, 1], dataset.reflectance[0, list(bands), 1])
        error = np.abs(found - dataset.reflectance.isel(band=list(bands), cross_track=[1]).values)
        assert float(error.max()) < 3e-3


def test_at_takes_the_nearest_bands_of_any_axis() -> None:
    nm = np.array([400.0, 700.0, 690.0, 1000.0, 550.0])
    dataset = xr.Dataset(
        {"reflectance": ("band", np.arange(5.0))}, {"wavelength": ("band", nm, {"units": "nm"})}
    )
    assert (float(at(dataset, 560.0).reflectance), at(dataset, 560.0).reflectance.dims) == (4, ())
    np.testing.assert_array_equal(at(dataset, [690.4, 695.1, 400.0]).reflectance, [2, 1, 0])
    um = dataset.assign_coords(wavelength=("band", nm / 1000, {"units": "um"}))
    assert float(um.paint.at(560.0).reflectance) == 4
    for source, nowhere, match in (
        *((dataset, nm, "band-missing") for nm in (5000.0, np.nan, [550.0, -9.0])),
        (xr.Dataset(), 550.0, "wavelength"),
    ):
        with pytest.raises(SchemaError, match=match):
            at(source, nowhere)
    # no band is near inside a gap
    spectra = xr.Dataset(coords={"wavelength": ("band", AXES["gap"], {"units": "nm"})})
    assert float(at(spectra, 985.0).wavelength) == 980.0
    expect_refusals((SchemaError, "band-missing", lambda: at(spectra, 1200.0)))


@pytest.mark.parametrize(
    "chunks", [None, {"along_track": 2}, {"along_track": 4, "band": 5, "cross_track": 3}]
)
def test_smile_is_taken_out(chunks: Any, no_compute: Any) -> None:
    dataset, expected = smiling()
    source = dataset if chunks is None else dataset.chunk(chunks).assign_coords(dataset.coords)
    with no_compute():
        made = to_nominal(source)
    found, values = made.reflectance, made.reflectance.values
    assert found.dtype == values.dtype == np.float32
    assert (found.dims, found.attrs["units"]) == (("along_track", "band", "cross_track"), "1")
    # missing are the outermost bands of columns that do not reach them, and nothing else
    assert np.argwhere(np.isnan(values[0])).tolist() == [[0, 2], [0, 3], [12, 0]]
    expected = np.where(np.isnan(values), np.nan, expected[:, None])
    np.testing.assert_allclose(values, expected, atol=2e-4)
    assert not {"wavelength_shift", "counts"} & set(made.variables)
    np.testing.assert_array_equal(made.quality, dataset.quality)
    np.testing.assert_array_equal(values[:, :, 1], dataset.reflectance.values[:, :, 1])


def test_after_reflectance_of_a_whole_line() -> None:
    made = reflectance(flight(bands=20, columns=4, smile=SHIFT, flat=True).line)
    found = to_nominal(made).reflectance.values
    np.testing.assert_allclose(found[~np.isnan(found)], 0.4, rtol=1e-4)


# --- Smoothing over the bands: what it keeps, what it says, what it refuses


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
    # everything that is wrong is listed
    error = expect_error(SchemaError, None, lambda: smooth(xr.Dataset(), "median", 4))
    assert error.codes == ("variable-missing", "choice-unknown", "value-out-of-range")
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: smooth(cube(), "box", 17)),
        (SchemaError, "value-out-of-range", "order ", lambda: smooth(cube(), "savitzky-golay", 5, order=4)),
    )


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
