"""Photon transfer against simulated cameras of known noise."""

import time as clock
import warnings
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.noisy_collects import BANDS, noisy_collect
from support.refusals import expect_error, expect_errors, expect_refusals, refusal
from support.strategies import flight, with_noise

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.illumination import matched_noise, noise_of_record
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.uncertainty import MAX_SAMPLES, estimate_noise, mean_uncertainty
from hyperpaint.simulation import simulate_line


def z_of(found: xr.Dataset, name: str, truth: float) -> float:
    return (float(found[name]) - truth) / float(found[f"{name}_u"])


def line_of(cube: np.ndarray, dark: float = 100.0) -> xr.Dataset:
    # Return a line of counts (along_track, band, cross_track) over an even dark
    element = ("band", "cross_track")
    return xr.Dataset(
        {
            "counts": (("along_track", *element), cube.astype("u2"), {"units": "count"}),
            "dark_counts": (element, np.full(cube.shape[1:], dark, "f4"), {"units": "count"}),
        }
    )


@pytest.mark.parametrize(
    ("k", "read_noise", "texture"),
    [(20.0, 0.5, 0.02), (8.0, 1.5, 0.02), (40.0, 3.0, 0.02), (20.0, 0.5, 0.05), (20.0, 0.5, 0.0)],
)
def test_a_flight_tells_its_camera(k: float, read_noise: float, texture: float) -> None:
    # Texture of 2 to 5 % is up to sixty times the shot noise's variance, and must not count
    line = simulate_line(
        lines=64, bands=60, columns=100, seed=2, electrons_per_count=k, read_noise=read_noise, texture=texture
    )
    found = estimate_noise(line)
    assert abs(z_of(found, "electrons_per_count", k)) < 4
    assert abs(z_of(found, "read_noise", read_noise)) < 4
    assert float(found.electrons_per_count_u) < 0.06 * k
    np.testing.assert_allclose(float(found.electrons_per_count), k, rtol=0.12)
    # what a plain variance would have told
    signal = (line.counts - line.dark_counts).transpose(*line.counts.dims).values[:8, 30]
    if texture:
        assert np.median(signal.mean(axis=0) / signal.var(axis=0, ddof=1)) < 0.8 * k


@pytest.mark.slow
def test_uncertainties_are_those_of_repetition() -> None:
    found = [estimate_noise(simulate_line(lines=32, bands=48, columns=80, seed=s)) for s in range(12)]
    for name, truth in (("electrons_per_count", 20.0), ("read_noise", 0.5)):
        z = [z_of(each, name, truth) for each in found]
        assert np.std(z) < 2.0, name
        assert abs(np.mean(z)) < 1.2, name


def test_what_it_returns_goes_into_reflectance() -> None:
    line = simulate_line(lines=32, bands=48, columns=60).drop_vars(["electrons_per_count", "read_noise"])
    expect_error(SchemaError, "variable-missing", lambda: line.paint.reflectance(uncertainty=True))
    found = hp.radiometry.estimate_noise(line)
    for name, units in (("electrons_per_count", "electron count-1"), ("read_noise", "count")):
        assert found[name].dtype == np.float32
        assert found[name].attrs["units"] == found[f"{name}_u"].attrs["units"] == units
        assert found[name].dims == ()
    assert "photon transfer" in found.attrs["noise_source"]
    made = line.assign(found).paint.reflectance(uncertainty=True)
    assert float(made.reflectance_u_random.mean()) > 0


def frames_of(levels: np.ndarray, n: int, k: float, read_noise: float, seed: int = 0) -> np.ndarray:
    # Return whole counts (level, frame, band, column) above a dark of 100
    rng = np.random.default_rng(seed)
    signal = levels[:, None, None, None] * rng.uniform(0.5, 1.5, (1, 1, 12, 20))
    spread = np.sqrt(signal / k + read_noise**2)
    return np.rint(100.0 + signal + spread * rng.normal(size=(levels.size, n, 12, 20)))


def sweep_of(cube: np.ndarray) -> xr.Dataset:
    dims = ("step", "band", "cross_track")
    return xr.Dataset(
        {
            "counts": (dims, cube.mean(axis=1).astype("f4"), {"units": "count"}),
            "counts_variance": (dims, cube.var(axis=1, ddof=1).astype("f4"), {"units": "count2"}),
            "dark_counts": (dims[1:], np.full(cube.shape[2:], 100.0, "f4"), {"units": "count"}),
            "frame_count": ((), cube.shape[1], {"units": "1"}),
            "saturation_count": ((), np.float32(4095), {"units": "count"}),
        }
    )


def test_frames_of_a_sweep_saturated_ones_and_repeated_lines() -> None:
    cube = frames_of(np.geomspace(5.0, 2500.0, 12), 20, 15.0, 1.2)
    found = estimate_noise(sweep_of(np.minimum(cube, 4095)))
    for name, truth, within in (("electrons_per_count", 15.0, 0.03), ("read_noise", 1.2, 0.05)):
        assert abs(z_of(found, name, truth)) < 4
        np.testing.assert_allclose(float(found[name]), truth, rtol=within)
    expect_error(
        SchemaError,
        "frames-too-few",
        lambda: estimate_noise(sweep_of(cube).assign(frame_count=((), 1, {"units": "1"}))),
    )
    # saturated frames do not bend the line
    cube = np.minimum(frames_of(np.geomspace(50.0, 6000.0, 14), 20, 15.0, 1.2), 4095)
    assert (cube == 4095).any()
    np.testing.assert_allclose(float(estimate_noise(sweep_of(cube)).electrons_per_count), 15.0, rtol=0.03)
    # repeated lines of one scene
    line = line_of(frames_of(np.array([600.0]), 64, 20.0, 0.8)[0])
    # levels from 300 to 900: enough for the slope
    assert abs(z_of(estimate_noise(line, repeated=True), "electrons_per_count", 20.0)) < 4


def test_signals_of_one_level_and_scenes_never_homogeneous_are_refused() -> None:
    line = line_of(np.rint(100.0 + 300.0 + 4.0 * np.random.default_rng(0).normal(size=(32, 12, 20))))
    shuffled = line.assign_coords(wavelength=("band", [1, 9, 2, 8, 3, 7, 4, 6, 5, 11, 0, 12]))
    for repeated in (False, True):
        with refusal(SchemaError, "electrons-uncertain", "signals of ", " to "):
            estimate_noise(line, repeated=repeated)
    expect_errors(
        (SchemaError, "lines-too-few", lambda: estimate_noise(line.isel(along_track=slice(0, 5)))),
        (SchemaError, "bands-too-few", lambda: estimate_noise(line.isel(band=slice(0, 2)))),
        (SchemaError, "dark_counts", lambda: estimate_noise(line.drop_vars("dark_counts"))),
        (SchemaError, "wavelength-unordered", lambda: estimate_noise(shuffled)),
    )
    # every line is of another surface
    line = line_of(np.random.default_rng(1).uniform(100.0, 3000.0, (64, 12, 20)), dark=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        expect_error(SchemaError, None, lambda: estimate_noise(line))


def test_dropped_saturated_and_bad_elements_do_not_count() -> None:
    line = simulate_line(lines=64, bands=48, columns=80, dropped=6, glint=0.02, bad_elements=40)
    assert abs(z_of(estimate_noise(line), "electrons_per_count", 20.0)) < 4
    # nor are quantisation and read noise needed
    options: dict[str, Any] = {"lines": 32, "bands": 60, "columns": 100, "read_noise": 0.0}
    for whole in (True, False):
        found = estimate_noise(simulate_line(**options, quantise=whole))
        assert abs(z_of(found, "electrons_per_count", 20.0)) < 4
        assert float(found.read_noise) < 0.3


def test_a_long_line_is_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    block, read = simulate_line(lines=32, bands=48, columns=60), []

    def piece(block_id: Any = None) -> np.ndarray:
        read.append(block_id)
        return block.counts.values

    chunks = ((32,) * (40_000 // 32), (48,), (60,))
    cube = da.map_blocks(piece, chunks=chunks, dtype=np.uint16, meta=np.empty((0, 0, 0), np.uint16))
    line = block.drop_dims("along_track")
    line["counts"] = (("along_track", "band", "cross_track"), cube, {"units": "count"})
    begin = clock.perf_counter()
    found = estimate_noise(line)
    assert clock.perf_counter() - begin < 20
    assert 4 <= len(set(read)) <= MAX_SAMPLES // (8 * 48 * 60)
    assert abs(float(found.electrons_per_count) / 20.0 - 1.0) < 0.15


# --- Noise of an irradiance record, from the record, and what bands see of it


CHANNELS = np.arange(350.0, 1051.0)


def record(samples: int, seed: int, noise: float = 0.004) -> tuple[np.ndarray, np.ndarray]:
    # Return spectra with a band of absorption under light that changes by 20 %, and their times
    rng = np.random.default_rng(seed)
    seconds = 2.0 * np.arange(samples) + rng.uniform(-0.2, 0.2, samples)
    sky = 1.0 - 0.3 * np.exp(-(((CHANNELS - 760.0) / 5.0) ** 2))
    light = 1.0 + 0.2 * np.sin(seconds / 7.0)[:, None] * (1.0 + 0.3 * (CHANNELS - 700.0) / 350.0)
    size = noise * (1.0 + (CHANNELS - 350.0) / 700.0)
    spectra = sky * light * (1.0 + size * rng.standard_normal((samples, CHANNELS.size)))
    return spectra, np.datetime64("2020-06-21", "ns") + (seconds * 1e9).astype("timedelta64[ns]")


def over_truth(spectra: np.ndarray, times: np.ndarray, **options: int) -> np.ndarray:
    # Return the noise that a record tells over its own
    noise = noise_of_record(spectra, times, **options)
    assert noise is not None
    return noise / (0.004 * (1.0 + (CHANNELS - 350.0) / 700.0))


@pytest.mark.parametrize(("samples", "within"), [(12, 0.3), (400, 0.1)])
def test_noise_is_told_from_changes_of_light(samples: int, within: float) -> None:
    ratio = over_truth(*record(samples, 3))
    assert abs(ratio.mean() - 1.0) < 0.05
    assert np.percentile(np.abs(ratio - 1.0), 95) < within


def test_channels_without_light_gaps_in_time_and_few_samples() -> None:
    spectra, times = record(30, 4)
    spectra[:, :40], spectra[3, 300] = 0.0, np.nan
    times[15:] += np.timedelta64(300, "s")
    noise = noise_of_record(spectra, times)
    assert noise is not None
    assert np.isfinite(noise).all()
    assert noise[:40] == pytest.approx(noise[40])
    assert noise_of_record(spectra[:5], times[:5]) is None
    assert noise_of_record(spectra[:, :10], times) is None
    # three samples tell where that is asked, and lost ones count for nothing
    spectra, times = record(40, 7)
    assert over_truth(spectra[:3], times[:3], fewest=1).mean() == pytest.approx(1.0, abs=0.15)
    assert noise_of_record(spectra[:2], times[:2], fewest=1) is None
    spectra[[5, 20]], spectra[30] = np.nan, 0.0
    assert over_truth(spectra, times).mean() == pytest.approx(1.0, abs=0.05)
    assert noise_of_record(np.full_like(spectra, np.nan), times) is None


def test_a_flight_tells_the_noise_of_its_record() -> None:
    line = noisy_collect(np.random.default_rng(5), 2400, 2, 10, gain_u=0.0)
    found = estimate_noise(line.drop_vars("irradiance_u_random"))
    assert found.irradiance_u_random.dims == ("irradiance_wavelength",)
    assert float(found.irradiance_u_random.mean()) == pytest.approx(0.005, rel=0.15)
    quiet = noisy_collect(np.random.default_rng(5), 2400, 2, 10, gain_u=0.0, irradiance_u=0.0)
    assert "irradiance_u_random" not in estimate_noise(quiet)


def test_bands_average_the_channels_they_are_matched_from() -> None:
    line = noisy_collect(np.random.default_rng(6), 4, 3, 10)
    arrays = {name: line[name].values for name in line.variables} | dict(line.attrs)
    _, covariance = matched_noise(arrays)
    assert covariance.shape == (BANDS, BANDS)
    own = np.sqrt(np.diagonal(covariance))
    assert (own < 0.005).all()
    # many draws of the same record, matched as the chain does
    noise = np.random.default_rng(7).standard_normal((400, 1, line.irradiance.shape[1]))
    drawn = line.irradiance.values[:1] * (1.0 + 0.005 * noise)
    draws = np.array([matched_noise({**arrays, "irradiance": spectra})[0] for spectra in drawn])
    np.testing.assert_allclose(own, draws.std(axis=0) / draws.mean(axis=0), rtol=0.2)
    between = np.corrcoef(draws.T)[3, 4]
    assert covariance[3, 4] / (own[3] * own[4]) == pytest.approx(between, abs=0.12)


# --- Means over pixels: what shrinks in them, what does not, and what nobody knows


U = ("reflectance_u_random", "reflectance_u_systematic")


def region(field: np.ndarray, u: float) -> xr.Dataset:
    dims = ("along_track", "cross_track")
    return xr.Dataset(
        {
            "reflectance": (dims, field),
            U[0]: (dims, np.full(field.shape, u)),
            U[1]: (dims, np.full(field.shape, 0.02)),
        }
    )


def test_only_the_random_part_of_a_mean_shrinks() -> None:
    rng = np.random.default_rng(0)
    for side in (5, 20, 60):
        made, n = mean_uncertainty(region(rng.normal(0.3, 0.01, (side, side)), 0.01)), side**2
        assert int(made.n) == n
        assert 0.7 * n < float(made.n_eff) <= n
        np.testing.assert_allclose(float(made.u_systematic), 0.02)
        np.testing.assert_allclose(float(made.u_random), 0.01 / np.sqrt(float(made.n_eff)))


def test_correlated_pixels_count_for_fewer() -> None:
    rng, found = np.random.default_rng(1), []
    for _ in range(200):
        white = rng.normal(size=(46, 46))
        # five by five pixels share their error
        field = np.lib.stride_tricks.sliding_window_view(white, (5, 5)).mean(axis=(2, 3)) * 0.05
        made = mean_uncertainty(region(0.3 + field, 0.01))
        found.append((float(made["mean"]), float(made.u_random)))
    truth = np.std(found, axis=0)[0]
    assert truth > 3 * 0.01 / 42  # far more than independent pixels would have
    assert 0.7 < np.median(found, axis=0)[1] / truth < 1.4


def test_a_mean_over_bands_keeps_them_and_skips_what_is_missing() -> None:
    line = with_noise(flight(dtype=np.uint16).line, radiance_gain_u_systematic=0.02)
    line["counts"].values[3, 5, 2] = 4090
    made = reflectance(line, uncertainty=True)
    found = mean_uncertainty(made)
    assert found["mean"].dims == ("band",)
    assert "wavelength" in found.coords
    np.testing.assert_array_equal(found.n, np.where(np.arange(12) == 5, 143, 144))
    np.testing.assert_allclose(
        found["mean"], made.reflectance.mean(["along_track", "cross_track"]), rtol=1e-5
    )
    expect_refusals(
        (SchemaError, "dim-missing", lambda: mean_uncertainty(made, "pixel")),
        (SchemaError, "variable-missing", lambda: mean_uncertainty(made.drop_vars(U[0]))),
    )


def test_an_error_that_nobody_knows_is_not_none() -> None:
    line = flight(dtype=np.uint16).line
    unknown = reflectance(with_noise(line), uncertainty=True)
    assert unknown[U[1]].isnull().all()
    found = mean_uncertainty(unknown)
    assert found.u_systematic.isnull().all()
    assert found.u_systematic.attrs["components"] == "none known"
    assert (found.u_random > 0).all()
    assert "read_noise" in found.u_random.attrs["components"]
    for name in U:
        unknown[name].attrs = {}
    assert mean_uncertainty(unknown).u_systematic.isnull().all()
    known = mean_uncertainty(reflectance(with_noise(line, wavelength_u=0.1), uncertainty=True))
    assert (known.u_systematic > 0).all()
    assert known.u_systematic.attrs["components"] == "wavelength_u"
