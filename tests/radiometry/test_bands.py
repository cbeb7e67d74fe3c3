"""Bands by wavelength, and spectra without their smile."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals
from support.strategies import flight

from hyperpaint.base.errors import SchemaError
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import at, to_nominal

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


def test_gaps_between_pairs_of_bands_are_no_disorder() -> None:
    dataset, _ = smiling(1)
    nm = 500.0 + 100.0 * np.repeat(np.arange(8), 2)[:13] + 2.0 * (np.arange(13) % 2)
    pairs = dataset.assign_coords(wavelength=("band", nm, {"units": "nm"}))
    np.testing.assert_array_equal(to_nominal(pairs).reflectance[0, :, 1], pairs.reflectance[0, :, 1])


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
