"""The same bits under threads, processes, a LocalCluster, cubed, Ray and `hp.slab` in a pool."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.workflows.pipeline import virtualise

pytestmark = pytest.mark.slow

SLAB, GROUP = 32, "flightlines/raw_0"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("icechunk")
    folder = tmp_path_factory.mktemp("engines")
    collect = hp.simulate_collect(folder / "day", scene="plan", lines=80, bands=8, columns=12)
    hp.process(collect, folder / "lot.zarr", reflectance="none")
    virtualise(collect, folder / "lot.icechunk")
    return folder / "lot.zarr"


@pytest.fixture(scope="module")
def wanted(store: Path) -> xr.Dataset:
    with dask.config.set(scheduler="synchronous"):
        return xr.open_zarr(store, group=GROUP).paint.reflectance().compute()


def assert_same(parts: list[xr.Dataset] | xr.Dataset, wanted: xr.Dataset) -> None:
    parts = [parts] if isinstance(parts, xr.Dataset) else parts
    for name in ("reflectance", "quality", "irradiance_age"):
        values = np.concatenate([part[name].values for part in parts])
        assert values.tobytes() == wanted[name].values.tobytes(), name


def calibrated(store: str, first: int) -> xr.Dataset:
    # Return a slab of a stored line, as a task of any engine makes it
    line = xr.open_zarr(store, group=GROUP, chunks=None)
    return hp.slab(line.isel(along_track=slice(first, first + SLAB)))[
        ["reflectance", "quality", "irradiance_age"]
    ]


def test_threads_and_processes(store: Path, wanted: xr.Dataset, two_processes: ProcessPoolExecutor) -> None:
    line = xr.open_zarr(store, group=GROUP).paint.reflectance()
    with dask.config.set(scheduler="threads", num_workers=2):
        assert_same(line.compute(), wanted)
    with dask.config.set(scheduler="processes", pool=two_processes):
        assert_same(line.compute(), wanted)
    assert_same(list(two_processes.map(calibrated, [str(store)] * 3, range(0, 80, SLAB))), wanted)


def test_a_cluster_reads_raw_files(store: Path, wanted: xr.Dataset, two_workers: Any) -> None:
    with two_workers.as_current():
        for line in (xr.open_zarr(store, group=GROUP), hp.io.open_virtual(store.with_name("lot.icechunk"))):
            assert_same(line.paint.reflectance().compute(), wanted)
        futures = two_workers.map(calibrated, [str(store)] * 3, range(0, 80, SLAB), pure=False)
        assert_same(two_workers.gather(futures), wanted)


def test_ray(store: Path, wanted: xr.Dataset) -> None:
    ray = pytest.importorskip("ray", reason="ray is not installed")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        task = ray.remote(calibrated)
        assert_same(ray.get([task.remote(str(store), first) for first in range(0, 80, SLAB)]), wanted)
    finally:
        ray.shutdown()


def calibrated_block(block: Any, block_id: Any = None, line: Any = None) -> Any:
    # Return the reflectance of a block of counts, a slab of whole lines
    first = block_id[0] * SLAB
    rest = line.isel(along_track=slice(first, first + len(block)))
    return hp.slab(
        rest.assign(counts=(("along_track", "band", "cross_track"), np.asarray(block), {"units": "count"}))
    )["reflectance"].values


@pytest.mark.filterwarnings("ignore")
def test_cubed(store: Path, wanted: xr.Dataset, tmp_path: Path) -> None:
    cubed = pytest.importorskip("cubed", reason="cubed is not installed")
    spec = cubed.Spec(work_dir=str(tmp_path), allowed_mem="500MB")
    line = xr.open_zarr(store, group=GROUP, chunks=None)
    small = line.drop_vars("counts").compute()
    counts = cubed.from_array(line["counts"].values, chunks=(SLAB, 8, 12), spec=spec)
    cube = cubed.map_blocks(calibrated_block, counts, line=small, dtype=np.float32)
    for executor in ("single-threaded", "threads"):
        values = np.asarray(cube.compute(executor=cubed.runtime.create.create_executor(executor)))
        assert values.tobytes() == wanted["reflectance"].values.tobytes()
    dims = ("along_track", "band", "cross_track")
    expect_refusals(
        (
            hp.SchemaError,
            "array-foreign",
            "cubed",
            "hyperpaint.slab",
            lambda: small.assign(counts=xr.Variable(dims, counts, {"units": "count"})).paint.reflectance(),
        )
    )
