"""Photon transfer against simulated cameras of known noise."""

import time as clock
import warnings
from typing import Any

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors, refusal

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.radiometry.uncertainty import MAX_SAMPLES, estimate_noise
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


def test_counts_without_quantisation_and_without_read_noise() -> None:
    options: dict[str, Any] = {"lines": 32, "bands": 60, "columns": 100, "read_noise": 0.0}
    for whole in (True, False):
        found = estimate_noise(simulate_line(**options, quantise=whole))
        assert abs(z_of(found, "electrons_per_count", 20.0)) < 4
        assert float(found.read_noise) < 0.3


def test_what_it_returns_goes_into_reflectance() -> None:
    line = simulate_line(lines=32, bands=48, columns=60).drop_vars(["electrons_per_count", "read_noise"])
    with pytest.raises(SchemaError, match="variable-missing"):
        line.paint.reflectance(uncertainty=True)
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


def test_frames_of_a_sweep() -> None:
    cube = frames_of(np.geomspace(5.0, 2500.0, 12), 20, 15.0, 1.2)
    found = estimate_noise(sweep_of(np.minimum(cube, 4095)))
    for name, truth, within in (("electrons_per_count", 15.0, 0.03), ("read_noise", 1.2, 0.05)):
        assert abs(z_of(found, name, truth)) < 4
        np.testing.assert_allclose(float(found[name]), truth, rtol=within)
    with pytest.raises(SchemaError, match="frames-too-few"):
        estimate_noise(sweep_of(cube).assign(frame_count=((), 1, {"units": "1"})))


def test_saturated_frames_do_not_bend_the_line() -> None:
    cube = np.minimum(frames_of(np.geomspace(50.0, 6000.0, 14), 20, 15.0, 1.2), 4095)
    assert (cube == 4095).any()
    np.testing.assert_allclose(float(estimate_noise(sweep_of(cube)).electrons_per_count), 15.0, rtol=0.03)


def test_repeated_lines_of_one_scene() -> None:
    line = line_of(frames_of(np.array([600.0]), 64, 20.0, 0.8)[0])
    # levels from 300 to 900: enough for the slope
    assert abs(z_of(estimate_noise(line, repeated=True), "electrons_per_count", 20.0)) < 4


def test_signals_of_one_level_are_refused() -> None:
    line = line_of(np.rint(100.0 + 300.0 + 4.0 * np.random.default_rng(0).normal(size=(32, 12, 20))))
    for repeated in (False, True):
        with refusal(SchemaError, "electrons-uncertain", "signals of ", " to "):
            estimate_noise(line, repeated=repeated)
    expect_errors(
        (SchemaError, "lines-too-few", lambda: estimate_noise(line.isel(along_track=slice(0, 5)))),
        (SchemaError, "bands-too-few", lambda: estimate_noise(line.isel(band=slice(0, 2)))),
        (SchemaError, "dark_counts", lambda: estimate_noise(line.drop_vars("dark_counts"))),
    )


def test_a_scene_that_is_never_homogeneous_is_no_scene_to_use() -> None:
    # every line is of another surface
    line = line_of(np.random.default_rng(1).uniform(100.0, 3000.0, (64, 12, 20)), dark=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        with pytest.raises(SchemaError):
            estimate_noise(line)


def test_dropped_and_saturated_lines_and_bad_elements_do_not_count() -> None:
    line = simulate_line(lines=64, bands=48, columns=80, dropped=6, glint=0.02, bad_elements=40)
    assert abs(z_of(estimate_noise(line), "electrons_per_count", 20.0)) < 4


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
