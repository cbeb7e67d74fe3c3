"""Reflectance of panels by direction: measured factors, reciprocity, energy, and panels of a flight."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.laid_panels import Laid, flown_over
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError
from hyperpaint.radiometry import panel_closure, panel_factor, panels

# Factors of white sintered PTFE over its reflectance for light from 8 degrees, mean of 532, 633 and 1064 nm,
# evaluated from the expansion of T. A. Germer, Appl. Opt. 56, 9333 (2017): zenith angles of light and view,
# azimuth between them, factor.
MEASURED = (
    (15.0, 0.0, 0.0, 1.0667), (30.0, 0.0, 0.0, 1.0436), (45.0, 0.0, 0.0, 1.0155), (60.0, 0.0, 0.0, 0.9756),
    (70.0, 0.0, 0.0, 0.9262), (75.0, 0.0, 0.0, 0.8886), (45.0, 20.0, 0.0, 1.005), (45.0, 20.0, 180.0, 1.033),
    (60.0, 30.0, 0.0, 0.953), (60.0, 30.0, 180.0, 1.038), (70.0, 30.0, 90.0, 0.934),
)  # fmt: skip


def factor_of(*angles: float, **options: Any) -> float:
    return float(panel_factor([550.0], *angles, **options).factor.item())


def test_the_factors_are_the_measured_ones() -> None:
    for *angles, factor in MEASURED:
        assert factor_of(*angles) == pytest.approx(factor, abs=6e-3), angles
    # seen from the nadir, within the scatter that is stated
    errors = [factor_of(*angles) - factor for *angles, factor in MEASURED if angles[1] == 0.0]
    assert np.std(errors) < 2e-3


def test_other_plates_are_within_twice_the_uncertainty() -> None:
    # model of a plate in the field, IEEE Trans. Geosci. Remote Sens. (2024), doi:10.1109/TGRS.2024.3361392,
    # over its certificate, at 633 nm and the nadir
    for zenith, other in ((8.0, 1.1045), (30.0, 1.0652), (45.0, 1.0227), (60.0, 0.9512), (70.0, 0.8771)):
        factor, u = panel_factor([633.0], zenith)
        assert abs(other - factor.item()) < 2.0 * u.item()
        assert 0.01 < u.item() < 0.03


def test_light_and_view_can_be_exchanged() -> None:
    rng = np.random.default_rng(5)
    for light, view in rng.uniform(0.0, 45.0, (20, 2)):
        azimuth = float(rng.uniform(-720.0, 720.0))
        assert factor_of(light, view, azimuth) == pytest.approx(factor_of(view, light, -azimuth), rel=1e-12)


def test_the_hemisphere_reflects_the_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(panels, "_LIMITS", {})
    zenith, azimuth = np.arange(0.5, 90.0), np.arange(5.0, 180.0, 10.0)
    weight = np.sin(2.0 * np.radians(zenith))
    for light in (0.0, 8.0, 20.0, 30.0, 45.0):
        rings = np.array([[factor_of(light, view, turn) for turn in azimuth] for view in zenith]).mean(axis=1)
        assert (rings * weight).sum() / weight.sum() == pytest.approx(1.0, abs=1.2e-3), light
    # so that a uniform sky shows the certificate, from wherever it is seen
    assert factor_of(30.0, direct_share=0.0) == 1.0


@pytest.mark.parametrize(("sun", "truth"), [(30.0, 1.0436), (45.0, 1.0155), (60.0, 0.9756)])
def test_a_panel_of_a_flight_closes_with_its_surface(sun: float, truth: float) -> None:
    place = {"seed": 7, "sun_zenith": sun, "irradiance_noise": 0.0}
    plain, own = (Laid(texture=0.0, reflectance=0.95, directional=each) for each in (1.0, truth))
    flown, region = flown_over(own, **place), (own.along, own.across, 0.95)
    split = np.float32(flown.attrs["diffuse_of_the_sky"])
    known = flown.assign(diffuse_fraction=("band", split, {"units": "1"}))

    def error(line: xr.Dataset = flown, **surface: Any) -> np.ndarray:
        level = panel_closure(flown_over(plain, **place), plain.panel).panel_factor.values[0]
        factor = panel_closure(line, hp.Panel(*region, **surface)).panel_factor.values[0]
        return np.asarray(factor / level - 1.0)

    with pytest.warns(PaintWarning, match="panel-doubtful"):
        lambertian = error()
    # the sun has most of the light
    assert 0.7 < np.median(lambertian) / (truth - 1.0) < 1.0
    assert np.abs(lambertian).max() > 0.012
    # a table of exactly this panel, and white sintered PTFE in general
    degrees = ("sun_zenith", [sun - 5.0, sun + 5.0], {"units": "degree"})
    table = xr.DataArray([truth, truth], {"sun_zenith": degrees}, ["sun_zenith"])
    assert np.abs(error(known, surface=table)).max() < 2e-4
    assert np.abs(error(known, surface="sintered-ptfe")).max() < 2e-3
    # the split that follows from the record is off by up to 0.04
    assert np.abs(error(surface=table)).max() < 0.04 * abs(truth - 1.0)
    assert np.abs(error(surface="sintered-ptfe")).max() < 2e-3
    # read as Lambertian it is refused as tilted, unless its uncertainty allows for that
    with pytest.warns(PaintWarning), pytest.raises(SchemaError, match="panel-refused"):
        hp.reflectance(flown, panel=hp.Panel(*region)).compute()
    scaled = hp.reflectance(flown, panel=hp.Panel(*region, surface="sintered-ptfe"), uncertainty=True)
    seen = scaled.reflectance.isel(along_track=own.along, cross_track=own.across)
    expected = 0.95 * (1.0 + lambertian)
    np.testing.assert_allclose(seen.mean(("along_track", "cross_track")), expected, rtol=3e-3)
    assert 0.009 < float(scaled.panel_scale_u.max()) < 0.016


# the simulated panel is Lambertian
@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
def test_the_camera_sees_more_against_the_sun() -> None:
    laid = Laid(texture=0.0, reflectance=0.95)
    line = flown_over(laid, seed=7, sun_zenith=45.0, irradiance_noise=0.0)
    _, azimuth = hp.light.solar_position(line.time.values[16], line.latitude.mean(), line.longitude.mean())

    def level(turn: float) -> float:
        view = (20.0, float(azimuth) + turn)
        panel = hp.Panel(laid.along, laid.across, 0.95, surface="sintered-ptfe", view=view)
        return float(np.median(panel_closure(line, panel).panel_factor))

    # with the sun behind the camera 1.005, and opposite 1.033 of the certificate, in nine tenths of the light
    assert level(180.0) / level(0.0) == pytest.approx((1.0 + 0.9 * 0.005) / (1.0 + 0.9 * 0.033), abs=5e-3)
    assert level(90.0) == pytest.approx(level(-90.0), rel=1e-6)


def test_a_surface_needs_the_sun() -> None:
    laid = Laid(texture=0.0, reflectance=0.95)
    line = flown_over(laid, seed=7).drop_vars(["latitude", "longitude"])
    panel = hp.Panel(laid.along, laid.across, 0.95, surface="sintered-ptfe")
    expect_refusals(
        (SchemaError, "panel-light-unknown", "position", lambda: panel_closure(line, panel).compute()),
        (
            SchemaError, "panel-surface-unknown", "glossy",
            lambda: hp.Panel(*[slice(9)] * 2, 0.9, surface="glossy"),
        ),
        (
            SchemaError, "panel-surface-grey", "0.5", "0.9",
            lambda: hp.Panel(*[slice(9)] * 2, 0.5, surface="sintered-ptfe"),
        ),
        (
            SchemaError, "panel-direction-outside", "sun_zenith", "80.0", "75", "view_zenith", "45",
            lambda: factor_of(80.0, 50.0),
        ),
    )  # fmt: skip


def test_a_table_of_factors_is_interpolated(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    rows = [
        f"{sun},{view},{nm},{1.0 + 1e-3 * (45 - sun) + 1e-3 * view + 1e-5 * (nm - 500)}"
        for nm in (400, 1000) for view in (0, 20) for sun in (60, 30)
    ]  # fmt: skip
    path.write_text("# of our panel\nSun_Zenith,view_zenith,wavelength,factor\n" + "\n".join(rows) + "\n")
    factor, u = panel_factor([400.0, 700.0, 1100.0], 40.0, 10.0, surface=path)
    np.testing.assert_allclose(factor, [1.014, 1.017, np.nan])
    assert not u.any()
    half = panel_factor([400.0], 40.0, 10.0, surface=str(path), direct_share=0.5)
    np.testing.assert_allclose(half.factor, 1.007)

    def read(text: str) -> Any:
        path.write_text(text)
        return lambda: hp.io.read_panel_table(path)

    for text, code in (
        ("", "header-wrong"),
        ("sun_zenith,brightness\n30,1\n", "header-wrong"),
        ("sun_zenith,factor\n", "empty-input"),
        ("sun_zenith,factor\n30,1,2\n", "length-mismatch"),
        ("sun_zenith,factor\n30,104\n", "value-out-of-range"),
        ("sun_zenith,factor\n30,x\n", "value-out-of-range"),
        ("sun_zenith,factor\n30,1\n30,1.1\n", "grid-mismatch"),
        ("sun_zenith,view_zenith,factor\n30,0,1\n30,10,1\n60,0,1\n", "grid-mismatch"),
    ):
        expect_refusals((FormatError, code, read(text)))
    outside = read("sun_zenith,view_zenith,factor\n30,0,1\n60,0,1\n")()
    assert outside.sizes == {"sun_zenith": 2, "view_zenith": 1}
    expect_refusals(
        (SchemaError, "panel-direction-outside", "view_zenith", lambda: factor_of(40.0, 5.0, surface=outside))
    )
    assert factor_of(40.0, surface=outside) == 1.0
