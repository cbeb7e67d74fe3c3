"""`hyperpaint.slab`: the bits of the lazy path, in memory, picklable; foreign arrays are refused."""

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_refusals, refusal
from support.strategies import SHIFT, assert_same, flight, stored

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.counts_to_reflectance import reflectance

# exact signals, which no converter rounds
pytestmark = pytest.mark.filterwarnings("ignore:.*counts-averaged")


def _line(dtype: Any = np.uint16) -> xr.Dataset:
    line = flight(lines=24, bands=12, columns=6, dtype=dtype, smile=SHIFT, position=True, drift=0.01).line
    if "counts" in line:
        line["counts"].values[3, 2, 1] = 40950
    return line


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("uncertainty", [False, True])
def test_the_bits_of_the_whole_line(dtype: Any, uncertainty: bool) -> None:
    line = _line(dtype).assign(electrons_per_count=((), 8.0, {"units": "electron count-1"}),
                               read_noise=((), 2.0, {"units": "count"}))  # fmt: skip
    whole = reflectance(line, uncertainty=uncertainty).compute()
    pieces = [line.isel(along_track=slice(first, first + 7)) for first in range(0, 24, 7)]
    slabs = [hp.slab(piece, uncertainty=uncertainty) for piece in pieces]
    joined = xr.concat(slabs, "along_track", data_vars="minimal", coords="minimal", compat="override",
                       join="override")  # fmt: skip
    assert set(slabs[0].variables) == set(whole.variables)
    for name in whole.variables:
        assert joined[name].values.tobytes() == whole[name].values.tobytes(), name
        assert slabs[0][name].attrs.keys() == whole[name].attrs.keys()
        assert isinstance(slabs[0][name].data, np.ndarray), name


def test_it_asks_no_scheduler_keeps_flags_and_refuses_dask() -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a scheduler was asked")

    line = _line()
    with dask.config.set(scheduler=refuse):
        product = hp.slab(line)
    assert_same(product, pickle.loads(pickle.dumps(hp.slab))(pickle.loads(pickle.dumps(line))))
    assert product["counts"].data is line["counts"].data  # nothing is copied
    assert "reflectance" not in line
    # radiance, and what an earlier flag says
    radiance = hp.radiance(line).compute().drop_vars(["counts", "dark_counts"])
    assert_same(hp.slab(radiance), reflectance(radiance))
    flagged = reflectance(line).compute()
    flagged["quality"] |= np.uint16(Quality.SHADOW)
    assert (hp.slab(flagged)["quality"] & Quality.SHADOW).all()
    # dask arrays are refused
    expect_refusals(
        (
            SchemaError,
            "lines-not-loaded",
            lambda: hp.slab(line.assign(counts=line.counts.chunk(along_track=8))),
        ),
        (SchemaError, "lines-not-loaded", ", ...", lambda: hp.slab(line.chunk())),
    )


def test_lines_that_are_read_when_asked_for(tmp_path: Path) -> None:
    line = stored(_line(), tmp_path / "lot.zarr")
    some = xr.open_zarr(tmp_path / "lot.zarr", chunks=None).isel(along_track=slice(8, 16))
    assert_same(hp.slab(some), reflectance(line).isel(along_track=slice(8, 16)))
    assert not some["counts"].variable._in_memory


@pytest.mark.parametrize(
    ("package", "words"), [("cupy", "as_numpy() or array.get()"), ("cubed", "hyperpaint.slab")]
)
def test_foreign_arrays_are_refused_in_a_sentence(
    package: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # neither runs here: an array is told by the package of its class
    class Array:
        shape, dtype, ndim, nbytes = (2, 12, 6), np.dtype(np.uint16), 3, 288

        def __array_function__(self, *_: Any) -> None: ...
        def __array_ufunc__(self, *_: Any) -> None: ...

    Array.__module__ = f"{package}.core"
    monkeypatch.setitem(sys.modules, Array.__module__, types.ModuleType(Array.__module__))
    line = _line().isel(along_track=slice(2))
    foreign = line.assign(counts=xr.Variable(line.counts.dims, Array(), line.counts.attrs))
    for call in (foreign.paint.reflectance, foreign.paint.rgb, lambda: hp.slab(foreign)):
        with refusal(SchemaError, "array-foreign", "'counts'", package, "numpy or dask", words):
            call()
