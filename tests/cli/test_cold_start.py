"""What a fresh process imports and compiles, and what it need not."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from hyperpaint.io.store import open_group, to_store
from hyperpaint.report.summaries import with_times
from hyperpaint.simulation import simulate_line

HEAVY = ("dask.array", "distributed", "numba", "pint", "scipy")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("cold") / "lot.zarr"
    to_store(simulate_line(lines=16, bands=20, columns=12, seed=1), place, "flightlines/raw_0")
    return place


def loaded_after(statements: str, modules: tuple[str, ...] = HEAVY) -> list[str]:
    # Return which modules a fresh process has loaded after some statements
    code = f"import sys\n{statements}\nprint(*(name for name in {modules} if name in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    return done.stdout.splitlines()[-1].split()


def test_info_of_a_store_loads_nothing_heavy(store: Path) -> None:
    ask = "from hyperpaint.cli.info_command import describe_path"
    assert loaded_after(f"{ask}\nprint(describe_path({str(store)!r}))") == []


def test_info_of_a_cube_loads_nothing_heavy(tmp_path: Path) -> None:
    np.arange(24, dtype=np.uint16).tofile(tmp_path / "raw_0")
    header = "samples = 4\nlines = 3\nbands = 2\ninterleave = bil\ndata type = 12\nbyte order = 0\n"
    spectral = "wavelength units = nm\nwavelength = {500, 600}\nfwhm = {6, 6}\ndescription = {raw counts}\n"
    (tmp_path / "raw_0.hdr").write_text(f"ENVI\n{header}{spectral};Exposure (ms): 5\n")
    ask = "from hyperpaint.cli.info_command import describe_path"
    assert loaded_after(f"{ask}\nprint(describe_path({str(tmp_path / 'raw_0.hdr')!r}))") == []


def test_a_pixel_is_read_without_distributed(store: Path) -> None:
    read = (
        f"import xarray as xr, hyperpaint\nline = xr.open_zarr({str(store)!r}, group='flightlines/raw_0')\n"
    )
    assert "distributed" not in loaded_after(f"{read}line.paint.pixels(3, 4)")


def test_a_store_is_written_and_verified_without_distributed(store: Path) -> None:
    write = (
        "from hyperpaint.io.store import open_group, to_store, verify\n"
        f"line = open_group({str(store)!r}, 'flightlines/raw_0').drop_encoding()\n"
        f"to_store(line, {str(store.with_name('copy.zarr'))!r}, 'again')"
    )
    assert "distributed" not in loaded_after(write)


def test_times_are_those_that_xarray_decodes(store: Path) -> None:
    raw = {"chunks": None, "decode_times": False, "create_default_indexes": False}
    given = open_group(store, "flightlines/raw_0", **raw)
    expected = open_group(store, "flightlines/raw_0")
    decoded = with_times(given)
    assert given["time"].dtype == np.int64
    for name in ("time", "irradiance_time"):
        np.testing.assert_array_equal(decoded[name].values, expected[name].values)
    # of another program, in another unit
    days = xr.Dataset({"t": ("x", np.array([1.0, 2.5]), {"units": "days since 2021-07-20"})})
    np.testing.assert_array_equal(
        with_times(days)["t"].values, np.array(["2021-07-21", "2021-07-22T12"], "M8[ns]")
    )
