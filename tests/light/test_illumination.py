"""Irradiance of every band and column: in wavelength, over the smile and on a tilted panel."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_errors

from hyperpaint.base.errors import PaintWarning, SchemaError, UnitsError
from hyperpaint.light.illumination import Tilt, match_irradiance, smile_cells
from hyperpaint.light.sun import diffuse_fraction, solar_position

START = np.datetime64("2020-06-21T17:00", "ns")
SAMPLES = np.arange(480.0, 621.0)


def record(spectra: np.ndarray, samples: np.ndarray = SAMPLES) -> xr.DataArray:
    return xr.DataArray(
        spectra,
        dims=("irradiance_time", "irradiance_wavelength"),
        coords={"irradiance_wavelength": ("irradiance_wavelength", samples, {"units": "nm"})},
        attrs={"units": "W m-2 nm-1"},
        name="irradiance",
    )


def ns(seconds: object) -> np.ndarray:
    return START + np.round(np.asarray(seconds, float) * 1e9).astype("timedelta64[ns]")


# ---------------------------------------------------------------------------------------------- matching


def test_match_is_labelled_lazy_and_float32(no_compute: Any) -> None:
    light = record(np.ones((4, 141), "f4")).chunk(irradiance_time=1, irradiance_wavelength=50)
    with no_compute():
        made = match_irradiance(light, [540.0, 550.0], [6.0, 6.0], nodes=[-0.5, 0.0, 0.5])
    assert made.dims == ("irradiance_time", "node", "band")
    assert made.dtype == made.compute().dtype == np.float32
    assert made.attrs["units"] == "W m-2 nm-1"
    assert made.misfit.dims == made.noise_gain.dims == made.coverage.dims == ("node", "band")
    np.testing.assert_allclose(made, 1.0, rtol=1e-6)


def test_match_takes_other_units_and_orders() -> None:
    spectra = np.random.default_rng(0).uniform(1, 2, (2, 141)).astype("f4")
    plain = match_irradiance(record(spectra), [540.0, 550.0], [6.0, 6.0])
    other = record(spectra[:, ::-1] * 100, SAMPLES[::-1] / 1000).T
    other.attrs["units"] = "uW cm-2 nm-1"
    other.irradiance_wavelength.attrs["units"] = "um"
    before = other.copy(deep=True)
    np.testing.assert_allclose(match_irradiance(other, [540.0, 550.0], [6.0, 6.0]), plain, rtol=1e-5)
    xr.testing.assert_identical(other, before)


def test_missing_samples_touch_their_bands_only_and_others_are_warned_of() -> None:
    spectra = np.ones((2, 141), "f4")
    spectra[1, 60] = np.nan  # 540 nm
    made = match_irradiance(record(spectra), [510.0, 540.0, 600.0], [6.0] * 3).values[:, 0]
    assert np.isnan(made).tolist() == [[False] * 3, [False, True, False]]
    with pytest.warns(PaintWarning, match="2 bands .*bands-too-sharp"):
        match_irradiance(record(spectra[:1]), [540.0, 550.0], [1.5, 1.5])
    with pytest.warns(PaintWarning, match="1 bands .*bands-outside-irradiance"):
        made = match_irradiance(record(spectra[:1]), [300.0, 550.0], [6.0, 6.0])
    assert np.isnan(made.values[0, 0]).tolist() == [True, False]


def test_a_level_panel_is_exactly_one_at_any_hour_and_one_turned_from_the_sun_sees_the_sky() -> None:
    times = START.astype("datetime64[D]") + np.arange(0, 1440, 50).astype("timedelta64[m]")
    np.testing.assert_array_equal(Tilt(0.0, 77.0).factor(times, 43.08, -77.67, np.array([450.0, 850.0])), 1.0)
    time = np.array(["2020-12-21T17:10"], "datetime64[ns]")  # zenith 66 degrees
    steep = Tilt(60.0, 0.0, ground_reflectance=0.0, diffuse_fraction=0.3)
    assert steep.factor(time, 43.08, -77.67, np.array([550.0]))[0, 0] == pytest.approx(0.3 * 0.75, rel=1e-9)


def test_match_refuses() -> None:
    light = record(np.ones((1, 141), "f4"))
    power = light.assign_attrs(units="W m-2 sr-1 nm-1")
    expect_errors(
        (SchemaError, "dims-wrong", lambda: match_irradiance(light[0], [550.0], [6.0])),
        (SchemaError, "fwhm-invalid", lambda: match_irradiance(light, [550.0], [-6.0])),
        (UnitsError, "irradiance", lambda: match_irradiance(power, [550.0], [6.0])),
        (
            SchemaError,
            "coordinate-missing",
            lambda: match_irradiance(light.drop_vars("irradiance_wavelength"), [550.0], [6.0]),
        ),
        (
            SchemaError,
            "choice-unknown",
            lambda: match_irradiance(light, [550.0], [6.0], srf_shape="round"),
        ),
    )


# ------------------------------------------------------------------------------------------------- smile


@given(
    seed=st.integers(0, 10_000),
    columns=st.integers(1, 40),
    rows=st.sampled_from([None, 1, 5]),
    reach=st.floats(0.01, 4.0),
)
def test_every_column_finds_its_cell(seed: int, columns: int, rows: int | None, reach: float) -> None:
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-reach, reach, columns if rows is None else (rows, columns))
    smile = smile_cells(shift, columns)
    table = np.atleast_2d(shift)
    assert ((smile.shift >= 0) & (smile.shift <= 1 + 1e-6)).all()
    for row, edges in enumerate(smile.edges):
        assert (edges[0], edges[-1]) == (0, columns)
        assert (np.diff(edges) >= 0).all()
        for run, cell in enumerate(smile.cells[row]):
            for x in range(edges[run], edges[run + 1]):
                place = smile.nodes[cell + 1] + 0.5 * smile.shift[row, x]
                assert place == pytest.approx(table[row, x], abs=1e-6)


def test_cubics_pass_through_any_cubic() -> None:
    smile = smile_cells(np.array([-1.2, 0.3, 0.9]), 3)
    curve = np.polynomial.Polynomial([0.3, -0.2, 0.1, 0.05])
    cubics = smile.cubics(curve(smile.nodes)[:, None] * np.ones((2, 1, 4)))
    assert cubics.shape == (2, 4, smile.nodes.size - 3, 4)
    for x, wanted in enumerate([-1.2, 0.3, 0.9]):
        terms = cubics[0, 0, smile.cells[0, np.searchsorted(smile.edges[0], x, side="right") - 1]]
        assert np.polyval(terms[::-1], float(smile.shift[0, x])) == pytest.approx(curve(wanted), abs=1e-6)


def test_no_smile_is_one_node() -> None:
    series = np.arange(6.0).reshape(2, 1, 3)
    for shift in (None, np.zeros(4)):
        smile = smile_cells(shift, 4)
        assert smile.nodes.tolist() == [0.0]
        np.testing.assert_array_equal(smile.cubics(series)[..., 0, 0], series[:, 0])
    for bad in (np.nan, 500.0):
        with pytest.raises(SchemaError, match="wavelength-shift-range"):
            smile_cells(np.full(4, bad), 4)


# ------------------------------------------------------------------------------------------------- tilt


def test_tilt_closes_to_ten_digits() -> None:
    times, wavelength = ns([0.0, 3600.0]), np.array([450.0, 850.0])
    zenith, azimuth = (np.radians(a) for a in solar_position(times, 43.08, -77.67))
    diffuse, angle, facing, surroundings = np.array([0.23, 0.06]), 10.0, 170.0, 0.15
    # by vectors, not by the formula of the code
    sun = np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], -1)
    a, f = np.radians(angle), np.radians(facing)
    normal = np.array([np.sin(a) * np.sin(f), np.sin(a) * np.cos(f), np.cos(a)])
    view = (1 + np.cos(a)) / 2
    expected = (
        (1 - diffuse) * (sun @ normal / sun[:, 2])[:, None] + view * diffuse + (1 - view) * surroundings
    )
    tilt = Tilt(angle, facing, ground_reflectance=surroundings, diffuse_fraction=diffuse)
    np.testing.assert_allclose(tilt.factor(times, 43.08, -77.67, wavelength), expected, rtol=1e-10)


def test_toward_the_sun_is_brighter_as_published() -> None:
    time = np.array(["2020-07-15T17:15"], "datetime64[ns]")  # noon in Rochester, zenith near 22 degrees
    toward, away = (
        Tilt(5.0, side).factor(time, 43.08, -77.67, np.array([850.0]))[0, 0] for side in (180.0, 0.0)
    )
    assert 1.02 < toward < 1.05
    assert 0.94 < away < 0.98


def test_diffuse_light_is_that_of_the_side_it_faces() -> None:
    time, nm = np.array(["2020-12-21T17:10"], "datetime64[ns]"), np.array([450.0])  # sun in the south, at 66
    split = diffuse_fraction(nm, float(solar_position(time, 43.08, -77.67)[0][0]))
    factors = {
        (sky, azimuth): float(
            Tilt(8.0, azimuth, diffuse_fraction=given, sky=sky).factor(time, 43.08, -77.67, nm)[0, 0]
        )
        for sky, given in (("clear", None), ("uniform", None), ("uniform", split), (None, split))
        for azimuth in (180.0, 0.0)
    }
    assert factors["clear", 180.0] > factors["uniform", 180.0] + 0.02
    assert factors["clear", 0.0] < factors["uniform", 0.0] - 0.02
    # a split that was measured may be of any sky: none is assumed
    assert (factors[None, 180.0], Tilt(8.0, 0.0).sky) == (factors["uniform", 180.0], "clear")
    with pytest.raises(SchemaError, match="choice-unknown"):
        Tilt(8.0, 0.0, sky="blue")
    # at night, the sky is that of a sun at the horizon
    dark = np.array(["2020-12-21T05:00"], "datetime64[ns]")
    assert np.isfinite(Tilt(8.0, 0.0).factor(dark, 43.08, -77.67, nm)).all()
