"""The whole chain against a simulator that shares no code with it: files in, known reflectance out."""

import contextlib
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import dask
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


CHUNKS = (
    {"along_track": 1},
    {"along_track": (5, 40, 25)},
    {"along_track": 32},
    {"along_track": -1},
    {"along_track": 16, "band": 50, "cross_track": 7},
)


@pytest.fixture(scope="module")
def made():
    # Return what makes the bits of a line in some chunks, all at once
    line = simulate_line(lines=70, bands=40, columns=12, seed=2, smile_nm=1.2, glint=0.01)

    def bits(chunks):
        lit = line.chunk(chunks).paint.reflectance(keep_bits=12)
        return [array.tobytes() for array in dask.compute(lit["reflectance"].data, lit["quality"].data)]

    return bits


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", ["threads", "processes", "cluster"])
def test_one_result__whatever_the_chunks_and_the_scheduler(made, scheduler):
    # Rationale: a result that depends on how it was computed cannot be checked by anyone
    # Expected: the same bits for five chunkings on threads, on processes and on a cluster of two workers
    expected = made(CHUNKS[2])
    with contextlib.ExitStack() as stack:
        if scheduler == "cluster":
            distributed = pytest.importorskip("distributed")
            workers = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
            cluster = stack.enter_context(distributed.LocalCluster(**workers, dashboard_address=":0"))
            stack.enter_context(distributed.Client(cluster))
        else:
            # one pool for all chunks: its processes import the package once
            spawned = multiprocessing.get_context("spawn")
            made_by = {
                "threads": ThreadPoolExecutor,
                "processes": partial(ProcessPoolExecutor, mp_context=spawned),
            }
            pool = stack.enter_context(made_by[scheduler](2))
            stack.enter_context(dask.config.set(scheduler=scheduler, pool=pool))
        for chunks in CHUNKS:
            assert made(chunks) == expected
