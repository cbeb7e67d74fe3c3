"""Several panels along a line correct the level of the irradiance record between them."""

import functools
import json
import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.laid_panels import Laid, flown_over
from support.strategies import flight, values

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import solar_position
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.panels import PanelClosure, panel_correction

SEED = 5521
PANELS = tuple(Laid((first, first + 14), seed=first) for first in (20, 110, 200))
LINES = 240


@functools.cache
def flown(drift: float = 0.0) -> xr.Dataset:
    # Return a line of 12 s whose record rises by ``drift`` too much from its first to its last line
    line = flown_over(
        *PANELS,
        seed=SEED,
        lines=LINES,
        bands=20,
        frame_period_ms=50.0,
        drift_per_minute=0.0,
        glint=0.0,
        noise=False,
    )
    since = (line.irradiance_time - line.time[0]) / (line.time[-1] - line.time[0])
    wrong = line.irradiance * (1.0 + drift * since)
    return line.assign(irradiance=wrong.astype(np.float32).assign_attrs(line.irradiance.attrs))


def departure(line: xr.Dataset, **options: object) -> np.ndarray:
    # Return reflectance over the truth (along_track,), median over bands and columns beside the panels
    scaled = hp.reflectance(line, **options)
    beside = {"cross_track": slice(24, None), "band": slice(2, 18)}
    return (scaled.reflectance / line.true_reflectance).isel(beside).median(["band", "cross_track"]).values


@pytest.mark.parametrize("drift", [0.05, -0.03])
def test_a_record_that_drifts_is_corrected(drift: float) -> None:
    line, panels = flown(drift), [each.panel for each in PANELS]
    assert np.ptp(departure(line)) > 0.9 * abs(drift)
    scaled, off = hp.reflectance(line, panel=panels), np.abs(departure(line, panel=panels) - 1.0)
    u = scaled.panel_scale_u.values
    assert off[20:214].max() < 5e-3  # between the panels
    assert (off < 2.0 * u + 2e-3).all()  # and as good as it says outside of them
    assert (u[[0, -1, 70]] > u[[27, 207, 117]]).all()
    factors = np.median(scaled.panel_factor.values, axis=1)
    rising = 1.0 / (1.0 + drift * np.array([27, 117, 207]) / (LINES - 1))
    np.testing.assert_allclose(factors, rising, atol=3e-3)


def test_what_only_the_pixels_differ_in_is_averaged() -> None:
    line = flown()
    scaled = hp.reflectance(line, panel=[each.panel for each in PANELS])
    ratio = (scaled.reflectance / hp.reflectance(line).reflectance).values
    mean = np.exp(-np.log(scaled.panel_factor.values).mean(axis=0))
    np.testing.assert_allclose(ratio, np.broadcast_to(mean[:, None], ratio.shape), rtol=1e-5)
    expected = 0.005 / np.sqrt(3.0)  # of a panel that is laid out again
    assert expected < float(scaled.panel_scale_u[0]) < 1.1 * expected


def test_the_same_bits_whatever_the_chunks() -> None:
    line, panels = flown(0.05), [each.panel for each in PANELS]
    whole = hp.reflectance(line.chunk(along_track=-1), panel=panels).reflectance.values
    for chunks in (1, 7, (100, 3, 137)):
        parts = hp.reflectance(line.chunk(along_track=chunks), panel=panels)
        assert parts.reflectance.values.tobytes() == whole.tobytes()


def test_the_level_enters_the_uncertainty() -> None:
    line = flown(0.05).assign(
        read_noise=((), np.float32(2.0), {"units": "count"}),
        electrons_per_count=((), np.float32(5.0), {"units": "electron count-1"}),
    )
    panels = [hp.Panel(each.along, each.across, each.reflectance, uncertainty=0.01) for each in PANELS]
    scaled = hp.reflectance(line, panel=panels, uncertainty=True)
    relative = (scaled.reflectance_u_systematic / scaled.reflectance).values
    np.testing.assert_allclose(relative, float(scaled.panel_scale_u.max()), rtol=1e-4)
    assert float(scaled.panel_scale_u.min()) > 0.01


def test_a_panel_that_is_refused_is_left_out() -> None:
    leaning = Laid((200, 214), lean=(5.0, 178.0))
    line = flown_over(*PANELS[:2], leaning, seed=SEED, lines=LINES, frame_period_ms=50.0)
    panels = [each.panel for each in (*PANELS[:2], leaning)]
    refused = pytest.warns(PaintWarning, match=r"1 of 3 .*panel-refused")
    with pytest.warns(PaintWarning, match="tilted"), refused:
        scaled = hp.reflectance(line, panel=panels).compute()
    with pytest.warns(PaintWarning, match="tilted"):
        np.testing.assert_array_equal(
            scaled.panel_state, hp.radiometry.panel_closure(line, panels).panel_state
        )
    np.testing.assert_array_equal(scaled.reflectance, hp.reflectance(line, panel=panels[:2]).reflectance)
    with pytest.warns(PaintWarning), pytest.raises(SchemaError, match=r"tilted.*panel-refused"):
        hp.reflectance(line, panel=[panels[2], panels[2]]).compute()


def closure(factor: np.ndarray, seconds: tuple[float, ...], mean_u: float = 1e-4) -> PanelClosure:
    time = np.datetime64("2024-06-21T12:00:00", "ns") + (np.array(seconds) * 1e9).astype("timedelta64[ns]")
    small = np.full(factor.shape, mean_u)
    states = np.zeros(len(factor), np.uint8)
    return PanelClosure(1.0 / factor, factor, small, small, small, states, time, ("",) * len(factor))


def test_weights_of_panels_that_differ_go_linearly_in_time() -> None:
    given = closure(np.array([[1.0, 1.0], [1.3, 1.3]]), (0.0, 100.0))
    at = given.time[0] + np.array([-50, 0, 25, 100, 200], "timedelta64[s]")
    scale, weights, u = panel_correction(given, at)
    np.testing.assert_allclose(weights[:, 1], [0.0, 0.0, 0.25, 1.0, 1.0], atol=2e-3)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(scale, -np.log(given.factor))
    # a random walk of (ln 1.3)^2 in 100 s: half of it after 50 s alone, a bridge of it at a quarter
    walk = np.log(1.3) ** 2 / 100.0
    np.testing.assert_allclose(u[[0, 2, 4]], np.sqrt(walk * np.array([50.0, 18.75, 100.0])), rtol=0.01)


def test_a_band_that_one_panel_lacks_is_that_of_the_others_at_its_level() -> None:
    factor = np.array([[1.0, 1.1, np.nan], [1.2, 1.32, 1.44]])
    scale, _, _ = panel_correction(closure(factor, (0.0, 10.0)), closure(factor, (0.0, 10.0)).time)
    np.testing.assert_allclose(np.exp(-scale[0]), [1.0, 1.1, 1.2], rtol=1e-9)


def test_declared_panels_scale_counts_again_in_any_crop() -> None:
    faulty = Laid((14, 22), lean=(5.0, 178.0))
    right = Laid((4, 12), level=0.9), Laid((24, 32), level=0.95)
    line = flown_over(faulty, *right, seed=SEED, lines=36)
    panels = [laid.panel for laid in (faulty, *right)]
    rows = [
        {
            "along_track": [panel.along_track.start, panel.along_track.stop],
            "cross_track": [panel.cross_track.start, panel.cross_track.stop],
            "reflectance": panel.reflectance, "uncertainty": 0.0, "tilt": None,
        }
        for panel in panels
    ]  # fmt: skip
    declared = line.assign_attrs(panels=json.dumps(rows))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        scaled = hp.reflectance(declared, panel=panels).compute()
        closure = hp.radiometry.panel_closure(scaled, panels).compute()
    np.testing.assert_array_equal(closure.panel_factor, scaled.panel_factor)  # not of what is scaled already
    assert (scaled.panel_weight[:, 0] == 0.0).all()
    np.testing.assert_allclose(scaled.panel_weight.sum("panel"), 1.0, rtol=1e-6)
    stored = scaled.drop_vars("reflectance")
    again = hp.reflectance(stored).compute()
    np.testing.assert_allclose(again.reflectance, scaled.reflectance, rtol=1e-6)
    assert again.reflectance.attrs["panel"] == scaled.reflectance.attrs["panel"]
    between = {"along_track": slice(13, 21)}
    crop = hp.reflectance(stored.isel(between)).reflectance
    np.testing.assert_allclose(crop, again.reflectance.isel(between), rtol=1e-6)
    plain = hp.reflectance(line).reflectance
    np.testing.assert_array_equal(hp.reflectance(stored.drop_vars("panel_weight")).reflectance, plain)
    light = line[["irradiance", "irradiance_fwhm"]]
    with pytest.warns(PaintWarning, match="panel-scale-foreign"):
        np.testing.assert_array_equal(hp.reflectance(stored, light).reflectance, plain)


# --- tilted surfaces under the sky that the record tells of -------------------------------------------------


TOWARDS_SUN = (20.0, 180.0)
UNIFORM = 1.0 + (np.cos(np.radians(10.0)) ** 2 - 1.0) * (1.0 - 0.2)
"""Light on a surface 20 degree from level over that on level ground, of a sky that is the same all around."""


def _line(share: float) -> xr.Dataset:
    # A line whose record is a share of a clear sky's global irradiance, of smooth colour
    line = flight(position=True).line
    nm = line.irradiance_wavelength.values
    zenith, _ = solar_position(line.irradiance_time.values, 43.08, -77.67)
    sky = sum(ClearSky(float(zenith.mean())).irradiance(nm)) * 0.967 * share
    return line.assign(irradiance=line.irradiance.copy(data=np.tile(sky, (12, 1)).astype(np.float32)))


def _onto(line: xr.Dataset, tilt: Any) -> np.ndarray[Any, Any]:
    # Return level over tilted reflectance: the light on the surface over that on level ground
    return np.asarray(np.nanmean(values(line) / values(line, tilt=tilt), axis=(0, 2)))


def test_under_an_overcast_record_no_side_is_brighter() -> None:
    # Rationale: the clear sky that was taken instead gave 1.056 where 0.976 is right
    assert pytest.approx(0.976, abs=5e-4) == UNIFORM
    for tilt in (TOWARDS_SUN, (20.0, 0.0)):
        np.testing.assert_allclose(_onto(_line(0.25), tilt), UNIFORM, atol=2e-3)


def test_under_a_clear_record_the_model_of_the_tilt_counts() -> None:
    line = _line(1.0)
    model = hp.Tilt(*TOWARDS_SUN).factor(
        line.irradiance_time.values[5:6], 43.08, -77.67, line.wavelength.values
    )
    assert model.min() > 1.05
    np.testing.assert_allclose(_onto(line, TOWARDS_SUN), model[0], atol=1e-4)


def test_a_diffuse_fraction_of_the_lines_counts_before_the_record() -> None:
    clear = _line(1.0)
    bands = np.ones(clear.sizes["band"], np.float32)
    fraction = np.tile(bands, (clear.sizes["along_track"], 1))
    overcast = clear.assign(
        diffuse_fraction=(("along_track", "band"), fraction, {"units": "1"}),
        sky_state=("along_track", np.full(len(fraction), 3, np.int8)),
    )
    one = clear.assign(diffuse_fraction=("band", bands, {"units": "1"}))
    for line in (overcast, one):
        np.testing.assert_allclose(_onto(line, TOWARDS_SUN), UNIFORM, atol=1e-4)
    known = hp.Tilt(*TOWARDS_SUN, diffuse_fraction=0.1)
    np.testing.assert_allclose(_onto(overcast, known), _onto(clear, known))


def test_a_record_of_no_sky_is_warned_of() -> None:
    line = reflectance(_line(1.7), tilt=TOWARDS_SUN)
    with pytest.warns(PaintWarning, match="sky-unknown"):
        line.reflectance.compute()
    reflectance(_line(1.7), tilt=(0.0, 0.0)).reflectance.compute()


def test_no_bit_depends_on_chunks_or_on_a_crop() -> None:
    line = _line(0.25)
    whole = values(line, tilt=TOWARDS_SUN)
    crop = line.isel(along_track=slice(7, 15))
    chunked = line.assign(counts=line.counts.chunk(along_track=5))
    np.testing.assert_array_equal(values(chunked, tilt=TOWARDS_SUN), whole)
    np.testing.assert_array_equal(values(crop, tilt=TOWARDS_SUN), whole[7:15])
