"""The whole chain against a simulator that shares no code with it: files in, known reflectance out."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.simulation import simulate_line

pytestmark = pytest.mark.slow

LINES, BANDS, COLUMNS = 70, 272, 24


@pytest.fixture(scope="module", params=["gaussian", "slit"])
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect without noise, in the instruments' formats, processed from its files
    folder = tmp_path_factory.mktemp(request.param)
    collect = hp.simulate_collect(
        folder,
        scene="plan",
        lines=LINES,
        bands=BANDS,
        columns=COLUMNS,
        seed=11,
        srf_shape=request.param,
        smile_nm=0.7,
        noise=False,
        glint=0.0,
        cubes=2,
        dropped=3,
        clock_offset_s=37.25,
        clock_uncertainty_s=0.0,
        utc_offset_h=5.5,
        drift_per_minute=0.2,
    )
    return hp.process(collect, folder / "lot.zarr")


def lines(store: Path) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    # Yield every flight line of a store beside its truth
    truth = xr.open_zarr(store.parent / "truth.zarr").load().swap_dims(along_track="frame")
    for name in sorted(path.name for path in (store / "flightlines").iterdir() if path.is_dir()):
        line = xr.open_zarr(store, group=f"flightlines/{name}")
        yield line, truth.sel(frame=line["frame"].values)


def test_twelve_bits_without_noise__close(store):
    # Rationale: with everything known, the converter's steps and the spectrometer's resolution are left
    # Expected: bias below 0.002 and RMSE below 0.005 over reflectance from 0.03 to 0.9
    errors, seen = [], []
    for line, truth in lines(store):
        made = line.paint.reflectance()
        assert made["reflectance"].dtype == np.float32
        assert not made["quality"].values.any()
        errors.append(made["reflectance"].values - truth["reflectance"].values)
        seen.append(truth["reflectance"].values)
    error, true = np.concatenate(errors), np.concatenate(seen)
    assert true.min() < 0.06
    assert true.max() > 0.85
    assert abs(error.mean()) < 1e-4
    assert np.sqrt((error**2).mean()) < 1e-3
    for low, high in ((0.03, 0.1), (0.1, 0.4), (0.4, 0.95)):
        part = error[(true >= low) & (true < high)]
        assert abs(part.mean()) < 0.002
        assert np.sqrt((part**2).mean()) < 0.005


def test_dropped_frames_and_clocks__leave_every_line_its_own_light(store):
    # Rationale: three clocks, two cubes and missing frames must not shift light from line to line
    # Expected: line times are those of the simulator, to the nanosecond
    for line, truth in lines(store):
        np.testing.assert_array_equal(line["time"].values, truth["time"].values)
        assert (np.diff(line["frame"].values) > 0).all()
        assert line["irradiance_age"].max() <= 1.0


@pytest.mark.filterwarnings("ignore:.*counts-averaged")
def test_exact_irradiance__closes_to_single_precision():
    # Rationale: float32 counts that were never quantised, and the irradiance each element saw itself
    # Expected: pi L / E is the true reflectance to 1e-5
    line = simulate_line(
        lines=12, bands=60, columns=9, seed=4, matched=True, quantise=False, noise=False, smile_nm=1.0,
        drift_per_minute=0.0,
    )  # fmt: skip
    radiance = line.paint.radiance()["radiance"].values
    irradiance = line["matched_irradiance"].values.mean(axis=0)
    truth = line["true_reflectance"].values
    made = np.pi * radiance / irradiance
    seen = np.isfinite(made)
    assert seen.mean() > 0.99
    np.testing.assert_allclose(made[seen], truth[seen], rtol=1e-5)
