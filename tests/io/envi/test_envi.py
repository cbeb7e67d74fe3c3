"""ENVI cubes through the lazy reader: values, damage, laziness, and other readers as oracles."""

import contextlib
import json
import os
import pickle
import random
import shutil
import subprocess
import sys
import time
import tomllib
import tracemalloc
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from hypothesis import given, strategies as st
from support import ROOT
from support.envi_cubes import CODES, FROM_LBS, toy, write_cube
from support.files import write_file
from support.refusals import expect_equal, expect_error, expect_errors
from support.wrong_quantities import objection, remarks

from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.backends import EnviBackendEntrypoint
from hyperpaint.io.envi.envi_cubes import (
    EnviArray,
    EnviParser,
    find_pair,
    open_envi,
    parse_header,
    read_header,
    slab_lines,
    slab_offsets,
    write_envi,
)


@pytest.fixture
def bytes_read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    # Record the bytes of each read of a data file
    seen: list[int] = []
    original = EnviArray.fill_samples

    def recorded(self: EnviArray, file: Any, first: int, into: np.ndarray) -> None:
        seen.append(into.nbytes)
        original(self, file, first, into)

    monkeypatch.setattr(EnviArray, "fill_samples", recorded)
    return seen


# --- values ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interleave", FROM_LBS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", CODES)
def test_toy_cube_in_every_layout(tmp_path: Path, interleave: str, order: str, dtype: str) -> None:
    cube = (toy("i8") % 251).astype(dtype)
    line = open_envi(write_cube(tmp_path / "toy", cube, interleave=interleave, order=order, offset=7))
    assert list(line.data_vars) == ["values"]  # nothing says that integers are counts
    array, values = line["values"], line["values"].values
    assert (array.dims, array.dtype, values.dtype) == (schema.CUBE, np.dtype(dtype), np.dtype(dtype))
    assert (array.dtype.isnative, values.dtype.isnative) == (True, True)
    np.testing.assert_array_equal(values, cube)


_LENGTHS = (5, 20, 4)


def _index(size: int) -> st.SearchStrategy[Any]:
    return st.one_of(
        st.integers(-size, size - 1),
        # xarray itself fails on empty slices that run backwards
        st.slices(size).filter(lambda s: (s.step or 1) > 0 or len(range(*s.indices(size))) > 0),
        st.lists(st.integers(-size, size - 1), max_size=size + 2).map(lambda v: np.array(v, dtype=int)),
        st.just(slice(None)),
    )


@pytest.mark.parametrize("gap", [0, 8, 32 * 2**10])
@pytest.mark.parametrize("interleave", FROM_LBS)
def test_any_index_equals_numpy(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, interleave: str, gap: int
) -> None:
    from hyperpaint.io.envi import envi_cubes

    monkeypatch.setattr(envi_cubes, "_MAX_GAP_BYTES", gap)
    monkeypatch.setattr(envi_cubes, "_MAX_BOX_BYTES", 100)
    cube = toy("u2")
    header = write_cube(tmp_path_factory.mktemp("any") / "toy", cube, interleave=interleave, order=">")
    line = open_envi(header)["values"]

    @given(st.tuples(*map(_index, _LENGTHS)))
    def check(key: tuple[Any, ...]) -> None:
        expected = cube
        for axis in (2, 1, 0):
            expected = expected[(slice(None),) * axis + (key[axis],)]
        found = line[key]
        expect_equal((found.shape, expected.shape), (found.values, expected))

    check()


def test_pointwise_index(tmp_path: Path) -> None:
    cube = toy("u2")
    line = open_envi(write_cube(tmp_path / "toy", cube, interleave="bip"))["values"]
    i, j = xr.DataArray([4, 0, 2], dims="pixel"), xr.DataArray([3, 3, 0], dims="pixel")
    np.testing.assert_array_equal(line.isel(along_track=i, cross_track=j), cube[[4, 0, 2], :, [3, 3, 0]])


@pytest.mark.parametrize("interleave", FROM_LBS)
def test_dask_chunks_of_any_shape(tmp_path: Path, interleave: str) -> None:
    cube = np.random.default_rng(1).integers(0, 4096, (70, 6, 9)).astype("u2")
    header = write_cube(tmp_path / "cube", cube, interleave=interleave)
    for chunks in ({"along_track": 32}, {"band": 1}, {"along_track": 7, "band": 4, "cross_track": 5}):
        line = open_envi(header).chunk(chunks)
        assert line["values"].dtype == np.uint16
        np.testing.assert_array_equal(line["values"].compute(scheduler="threads", num_workers=2), cube)
    assert line.chunks["along_track"][0] == 7
    # by default whole lines
    line = xr.open_dataset(header, engine=EnviBackendEntrypoint, chunks={})
    assert dict(line.chunks) == {"along_track": (32, 32, 6), "band": (6,), "cross_track": (9,)}
    assert line["values"].encoding["preferred_chunks"] == {"along_track": 32, "band": 6, "cross_track": 9}


# --- the size of the file ----------------------------------------------------------------------------------


def _resize(header: Path, change: int) -> None:
    data = header.with_suffix("")
    size = data.stat().st_size + change
    with open(data, "r+b") as file:
        file.truncate(size)


@pytest.mark.parametrize("change", [-1, -160, -161, -799, 1, 160, 161, 800])
@pytest.mark.parametrize("interleave", FROM_LBS)
def test_any_wrong_size_is_refused(tmp_path: Path, interleave: str, change: int) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), interleave=interleave, offset=3)  # 160 bytes a line
    _resize(header, change)
    whole = (800 + change) // 160
    said = f"keep_whole_lines=True (keep_whole_lines = true in collect.toml) opens those {whole} lines"
    possible = interleave != "bsq" and whole > 0 and (change < 0 or change % 160 == 0)
    for keep_whole_lines in (False, True)[: 1 if possible else 2]:
        caught = expect_error(
            FormatError, "file-size", partial(open_envi, header, keep_whole_lines=keep_whole_lines)
        )
        assert (said in str(caught)) == possible
        assert ("whole lines" in str(caught)) == (interleave != "bsq")


@pytest.mark.parametrize(("change", "lines"), [(-160, 4), (-161, 3), (-799 + 160, 1), (160, 6), (800, 10)])
@pytest.mark.parametrize("interleave", ["bil", "bip"])
def test_whole_lines_are_kept_on_request(tmp_path: Path, interleave: str, change: int, lines: int) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), interleave=interleave)
    _resize(header, change)
    with pytest.warns(PaintWarning, match="header-doubtful"):
        line = xr.open_dataset(header, engine=EnviBackendEntrypoint, keep_whole_lines=True)
    assert (line.sizes["along_track"], line.attrs["lines_declared"]) == (lines, 5)
    expected = np.zeros((lines, 20, 4), "u2")
    expected[:5] = toy("u2")[:lines]
    np.testing.assert_array_equal(line["values"], expected)


@pytest.mark.parametrize(
    "changed",
    [
        "lines = 1000000000",
        "lines = 1000000000000000000",
        "bands = 2000000000",
        "header offset = 99999999999",
    ],
)
def test_declared_sizes_allocate_nothing(tmp_path: Path, changed: str) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"))
    key = changed.split(" =")[0]
    kept = [text for text in header.read_text().splitlines() if not text.startswith(key)]
    header.write_text("\n".join([*kept, changed]))
    expect_errors((FormatError, "file-size", lambda: open_envi(header)))


def test_contradictions_are_refused(tmp_path: Path) -> None:
    header = write_cube(
        tmp_path / "toy", toy("u2"), "reflectance scale factor = 1e4", "description = {x,RADIANCE}",
        "data gain values = {" + "2," * 20 + "}", "file type = ENVI Spectral Library",
    )  # fmt: skip
    error = expect_error(FormatError, None, lambda: open_envi(header))
    expected = ("spectral library", "band gains", "RADIANCE")
    assert [text for text in expected if text not in str(error)] == []


def _rewrite(header: Path) -> None:
    data = header.with_suffix("")
    before = data.stat()
    data.write_bytes(bytes(before.st_size))
    os.utime(data, ns=(before.st_atime_ns, before.st_mtime_ns + 1))


@pytest.mark.parametrize("change", [_rewrite, lambda header: _resize(header, -10)])
def test_file_changed_after_opening_is_noticed(tmp_path: Path, change: Callable[[Path], None]) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"))
    line = open_envi(header)
    xr.testing.assert_identical(line, open_envi(header, keep_whole_lines=True))  # of a sound file
    np.testing.assert_array_equal(line["values"][3], toy("u2")[3])
    change(header)
    for part in (line["values"], line["values"].isel(along_track=3)):
        expect_error(FormatError, "file-changed", part.load)


def test_file_cut_while_it_is_read_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"))
    line = open_envi(header)
    status_of = os.fstat
    # after the check whether the file has changed
    monkeypatch.setattr(os, "fstat", lambda file: (status_of(file), _resize(header, -10))[0])
    expect_errors((FormatError, "file-truncated", lambda: line["values"].load()))


# --- laziness ----------------------------------------------------------------------------------------------


@pytest.fixture
def long_header(tmp_path: Path) -> Path:
    # Return a 100,000-line cube of 35 GB that takes no room on the disk
    header = write_cube(tmp_path / "raw_0", np.zeros((1, 272, 640), "u2"))
    header.write_text(header.read_text().replace("lines = 1\n", "lines = 100000\n"))
    line_bytes = 272 * 640 * 2
    with open(tmp_path / "raw_0", "r+b") as file:
        file.truncate(100_000 * line_bytes)
        file.seek(77_777 * line_bytes)
        file.write(np.full(272 * 640, 1234, "<u2").tobytes())
    return header


def test_long_cube_opens_without_reading(long_header: Path, bytes_read: list[int]) -> None:
    start = time.process_time()
    line = xr.open_dataset(long_header, engine=EnviBackendEntrypoint, chunks={"along_track": 32})
    graph = line["values"].astype("f4").__dask_graph__()
    spent = time.process_time() - start
    assert (len(line.chunks["along_track"]), len(graph.layers), bytes_read) == (3125, 3, [])
    assert spent < 2  # milliseconds, and a slow machine
    np.testing.assert_array_equal(line["values"][77_777].compute(), 1234)
    assert 0 < sum(bytes_read) <= 32 * 272 * 640 * 2


def test_reads_only_what_is_asked(long_header: Path, bytes_read: list[int]) -> None:
    counts = open_envi(long_header)["values"]
    for key, most in [
        ((77_777,), 272 * 640 * 2),  # one line
        ((slice(5, 37),), 32 * 272 * 640 * 2),  # a slab
        ((slice(0, 1000, 100), 100), 10 * 640 * 2),  # one band of ten lines
        ((77_777, [0, 271]), 2 * 640 * 2),  # two distant bands
        ((77_777, 3, 9), 2),  # one sample
        ((77_777, slice(None), 9), 272 * 640 * 2),  # one spectrum: one read of its line
    ]:
        bytes_read.clear()
        counts[key].load()
        assert 0 < sum(bytes_read) <= most, key
    assert len(bytes_read) == 1


def test_bsq_band_is_one_read(tmp_path: Path, bytes_read: list[int]) -> None:
    cube = np.random.default_rng(0).integers(0, 4096, (50, 8, 700)).astype("u2")
    counts = open_envi(write_cube(tmp_path / "cube", cube, interleave="bsq"))["values"]
    expect_equal((counts[:, 3], cube[:, 3]), (bytes_read, [50 * 700 * 2]))


def test_array_is_small_and_picklable(long_header: Path, tmp_path: Path) -> None:
    line = open_envi(long_header)
    for thing in (line, line["values"].variable._data, line["values"]):
        assert len(pickle.dumps(thing)) < 4096
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(line))["values"][77_777, 5], 1234)
    assert len(pickle.dumps(line.chunk({"along_track": 50_000})["values"].data)) < 8192
    # reading in threads
    cube = np.random.default_rng(0).integers(0, 4096, (64, 5, 11)).astype("u2")
    counts = open_envi(write_cube(tmp_path / "cube", cube))["values"]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda i: counts[i].values, range(64)))
    np.testing.assert_array_equal(found, cube)


def test_two_opens_give_the_same_dask_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header = write_cube(
        tmp_path / "toy", toy("u2"), "reflectance scale factor = 10000",
        "bbl = {" + "1," * 20 + "}",
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)

    def names(path: str | Path) -> list[str]:
        engine = xr.open_dataset(path, engine=EnviBackendEntrypoint, chunks={})
        return [open_envi(path).chunk({"along_track": 2}).reflectance.data.name, engine.reflectance.data.name]

    first = names(header)
    assert names(header) == first
    assert names("toy.hdr")[0] == first[0]  # however the path is spelled
    status = os.stat(tmp_path / "toy")
    os.utime(tmp_path / "toy", ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))
    assert names(header)[0] != first[0]
    header.write_text(header.read_text().replace("10000", "1000"))
    assert names(header)[0] != first[0]


# --- xarray's door -----------------------------------------------------------------------------------------


def test_open_dataset_options(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), "bbl = {" + "1," * 20 + "}")
    line = xr.open_dataset(header, engine=EnviBackendEntrypoint, drop_variables="good")
    assert "good" not in line.variables
    # so that sel and hvplot work; two cameras would be joined by the number of a band
    assert set(line.indexes) == {"along_track", "cross_track"}
    line = xr.open_dataset(header, engine=EnviBackendEntrypoint, drop_variables=["values", "absent"])
    assert set(line.variables) == {"good"}


def test_installed_plugin_opens_by_itself(tmp_path: Path) -> None:
    if not any(point.name == "envi" for point in entry_points(group="xarray.backends")):
        pytest.skip("hyperpaint is not installed: its entry point 'envi' is not registered")
    for path in (write_cube(tmp_path / "raw_0", toy("u2")), tmp_path / "raw_0"):
        np.testing.assert_array_equal(xr.open_dataset(path)["values"], toy("u2"))


@pytest.mark.slow
def test_declared_entry_point_opens_by_itself(tmp_path: Path) -> None:
    # As if installed: the entry point that pyproject.toml declares, in a fresh interpreter
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    points = "\n".join(f"{key} = {value}" for key, value in declared["xarray.backends"].items())
    made = tmp_path / "site" / "hyperpaint_declared-0.dist-info"
    made.mkdir(parents=True)
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: hyperpaint-declared\nVersion: 0\n")
    (made / "entry_points.txt").write_text(f"[xarray.backends]\n{points}\n")
    write_cube(tmp_path / "raw_0", toy("u2"))
    # the module of the entry point imports nothing else of the package, and nothing heavy
    code = (
        "import sys, xarray as xr; before = set(sys.modules); import hyperpaint.io.backends\n"
        "print(*sorted(m for m in set(sys.modules) - before if m.split('.')[0] not in ('hyperpaint',)))\n"
        "print(*sorted(m for m in set(sys.modules) - before if m.startswith('hyperpaint.io.')))\n"
        "for path in sys.argv[1:]: print(int(xr.open_dataset(path)['values'][4, 19, 3]))\n"
    )
    paths = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "raw_0.hdr"), str(tmp_path / "raw_0")],
        env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    others, ours, *values = result.stdout.split("\n")
    assert (values[:2], ours.split()) == (["400", "400"], ["hyperpaint.io.backends"])
    assert not {"numba", "pint", "scipy", "dask", "zarr"} & {m.split(".")[0] for m in others.split()}


# --- other readers as oracles ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("interleave", FROM_LBS)
@pytest.mark.parametrize("order", "<>")
def test_spectral_python_agrees(tmp_path: Path, interleave: str, order: str) -> None:
    spy = pytest.importorskip("spectral.io.envi")
    header = write_cube(tmp_path / "toy", toy("i2"), interleave=interleave, order=order)
    oracle = spy.open(str(header), str(tmp_path / "toy")).open_memmap(interleave="bip")
    np.testing.assert_array_equal(open_envi(header)["values"].transpose(..., "band"), np.asarray(oracle))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("interleave", FROM_LBS)
@pytest.mark.parametrize("order", "<>")
def test_gdal_agrees(tmp_path: Path, interleave: str, order: str) -> None:
    header = write_cube(tmp_path / "toy", toy("i2"), interleave=interleave, order=order)
    with rasterio.open(tmp_path / "toy", driver="ENVI") as source:
        np.testing.assert_array_equal(open_envi(header)["values"].transpose("band", ...), source.read())


@pytest.mark.parametrize("reference", ["1, 1", "2.5, 3"])
def test_gdal_places_pixels_alike(tmp_path: Path, reference: str) -> None:
    info = f"map info = {{UTM, {reference}, 500000, 4000000, 0.5, 0.25, 18, North, WGS-84, units=Meters}}"
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), info))
    with rasterio.open(tmp_path / "toy", driver="ENVI") as source:
        expected = [source.xy(row, column) for row, column in ((0, 0), (4, 3))]
    found = [(float(line.x[column]), float(line.y[row])) for row, column in ((0, 0), (4, 3))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_scaled_reflectance_against_spectral_python(tmp_path: Path) -> None:
    # SPy divides the ignore value as well; everything else agrees
    spy = pytest.importorskip("spectral.io.envi")
    cube = toy("i2")
    cube[2, 2, 2] = -9999
    header = write_cube(
        tmp_path / "toy", cube, "reflectance scale factor = 10000", "data ignore value = -9999"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        oracle = np.asarray(spy.open(str(header), str(tmp_path / "toy")).load())
    found = open_envi(header).reflectance.transpose("along_track", "cross_track", "band").values
    assert np.isnan(found[2, 2, 2])
    assert oracle[2, 2, 2] == np.float32(-0.9999)
    np.testing.assert_allclose(np.where(np.isnan(found), -0.9999, found), oracle, rtol=2e-7)


# --- names, units, coordinates -----------------------------------------------------------------------------


_RADIANCE_UNITS = ";Units = mW/(cm2*sr*um)"


@pytest.mark.parametrize(
    ("dtype", "lines", "name", "units"),
    [
        ("u2", (), "values", None),
        ("u2", ("description = {raw data of the line}",), "counts", "count"),
        ("u2", ("description = {hood, counts}",), "counts", "count"),
        ("u2", (";Units = DN",), "counts", "count"),
        ("u2", ("data units = DN",), "counts", "count"),
        ("u2", ("description = {[HEADWALL Hyperspec III],RADIANCE}",), "radiance", None),
        ("f4", ("description = {raw}",), "values", None),
        ("i4", ("file type = ENVI Standard", "description = {[HEADWALL Hyperspec III]}"), "counts", "count"),
        ("u1", ("file type = ENVI Classification",), "values", None),
        ("f4", (), "values", None),
        ("f4", ("description = {[HEADWALL Hyperspec III],RADIANCE}",), "radiance", None),
        ("f4", ("description = {[HEADWALL Hyperspec III],RADIANCE}", _RADIANCE_UNITS), "radiance", "said"),
        ("u2", ("description = {[HEADWALL Hyperspec III],RADIANCE}", _RADIANCE_UNITS), "radiance", "said"),
        ("f4", (_RADIANCE_UNITS,), "radiance", "said"),
        ("f4", ("data units = mW/(cm2*sr*um)",), "radiance", "said"),
        ("f4", (";Units = mW/(cm^2*sr*um)",), "radiance", "mW/(cm2*sr*um)"),
        ("f4", (";Units = furlong per fortnight",), "values", None),
        ("f4", ("description = {[x],RADIANCE,REFLECTANCE}", _RADIANCE_UNITS), "reflectance", "1"),
        ("f4", ("description = {[HEADWALL Hyperspec III],REFLECTANCE,[OR]}",), "reflectance", "1"),
        ("u2", ("description = {x,REFLECTANCE}", "reflectance scale factor = 1e4"), "reflectance", "1"),
        ("u2", ("reflectance scale factor = 10000",), "reflectance", "1"),
        ("f4", ("reflectance scale factor = 1",), "reflectance", "1"),
        ("u2", ("reflectance scale factor = 1.0",), "values", None),
        ("f4", ("description = {radiance and other irradiance}",), "values", None),
        ("u2", ("data gain values = {" + "2," * 20 + "}",), "values", None),
        ("u2", ("data gain values = {" + "1," * 20 + "}", ";Units = counts"), "counts", "count"),
        ("f4", ("data gain values = {" + "2," * 20 + "}", _RADIANCE_UNITS), "radiance", "said"),
    ],
)
def test_name_and_units(
    tmp_path: Path, dtype: str, lines: tuple[str, ...], name: str, units: str | None
) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy(dtype), *lines))
    assert list(line.data_vars) == [name]
    assert line[name].attrs.get("units") == ("mW/(cm2*sr*um)" if units == "said" else units)
    if name in ("radiance", "reflectance"):
        assert (line[name].dtype, line[name].values.dtype) == (np.float32, np.float32)
        assert line[name].attrs["long_name"] == schema.VARIABLES[name].meaning


def test_integers_called_reflectance_need_a_scale(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), "description = {x,REFLECTANCE}")
    with pytest.warns(PaintWarning, match="header-doubtful"):
        line = open_envi(header)
    assert (list(line.data_vars), line["values"].dtype) == (["values"], np.uint16)


@pytest.mark.parametrize(
    "text",
    [
        "Surface reflectance x 10000, derived from raw data",
        "radiance converted from DN, uW/cm2/sr/nm x 1000",
        "[HEADWALL Hyperspec III] reflectance",
        "not raw",
        "Albedo from counts",
    ],
)
def test_a_product_of_raw_counts_is_no_counts(tmp_path: Path, text: str) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), f"description = {{{text}}}")
    with pytest.warns(PaintWarning, match="header-doubtful"):
        assert list(open_envi(header).data_vars) == ["values"]
    assert list(open_envi(header, quantity="counts").data_vars) == ["counts"]


def test_radiance_units_convert_through_the_schema(tmp_path: Path) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), "description = {x,RADIANCE}", _RADIANCE_UNITS))
    found = schema.require(line, ["radiance"], "reflectance")["radiance"]
    assert found.attrs["units"] == "W m-2 sr-1 nm-1"
    np.testing.assert_allclose(found.values, toy("f8") * 0.01, rtol=1e-6)


def test_ignore_value_is_compared_before_scaling(tmp_path: Path) -> None:
    cube = toy("i2")
    cube[1, 2, 3] = -9999
    header = write_cube(
        tmp_path / "toy", cube, "reflectance scale factor = 10000", "data ignore value = -9999"
    )
    line = open_envi(header).chunk({"along_track": 2})
    values = line.reflectance.compute()
    assert values.dtype == line.reflectance.dtype == np.float32
    expected = (cube / 1e4).astype(np.float32)
    expected[1, 2, 3] = np.nan
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("interleave", FROM_LBS)
def test_gain_and_offset_of_each_band(tmp_path: Path, interleave: str) -> None:
    cube, gain, offset = toy("u2"), 0.5 + np.arange(20) / 7, np.arange(20) - 3.0
    header = write_cube(
        tmp_path / "toy", cube,
        f"data gain values = {{{', '.join(map(repr, gain.tolist()))}}}",
        f"data offset values = {{{', '.join(map(repr, offset.tolist()))}}}",
        "data ignore value = 1", interleave=interleave,
    )  # fmt: skip
    values = open_envi(header)["values"].isel(band=[3, 0, 11])
    expected = (cube * gain[:, None] + offset[:, None])[:, [3, 0, 11]]
    expected[0, 1, 0] = np.nan
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, expected, rtol=3e-7, atol=1e-5)
    assert values.values.dtype == np.float32


def test_ignore_values_of_floats_and_counts(tmp_path: Path) -> None:
    cube = toy("f4")
    cube[0, 0, 0] = -1.23e34
    # written with fewer digits
    values = open_envi(write_cube(tmp_path / "toy", cube, "data ignore value = -1.23e+034"))["values"]
    assert (np.flatnonzero(np.isnan(values)).tolist(), values.dtype) == ([0], np.float32)
    header = write_cube(tmp_path / "toy", toy("u2"), "data ignore value = 65535", "description = {raw}")
    counts = open_envi(header).counts
    assert (counts.dtype, counts.attrs["data_ignore_value"]) == (np.uint16, 65535)


def test_coordinates_on_band_have_no_index(tmp_path: Path) -> None:
    values = ", ".join(str(0.9 - i / 100) for i in range(20))
    line = open_envi(
        write_cube(
            tmp_path / "toy", toy("u2"), f"wavelength = {{{values}}}", "wavelength units = um",
            "fwhm = {" + "0.006," * 20 + "}", "bbl = {" + "0 " * 3 + "1 " * 17 + "}",
        )
    )  # fmt: skip
    assert not line.indexes
    np.testing.assert_allclose(line.wavelength, 900 - 10 * np.arange(20), rtol=1e-14)  # not sorted
    for name in ("wavelength", "fwhm", "good"):
        assert (line[name].dims, line[name].dtype) == (("band",), schema.dtype_of(name))
        assert line[name].attrs == schema.VARIABLES[name].attrs
    assert int((~line.good).sum()) == 3


def test_attributes_keep_all_the_header_says(tmp_path: Path) -> None:
    header = write_cube(
        tmp_path / "raw_0", toy("u2"), "strange key = {a, b}", ";Exposure (ms) = 5", "; remark"
    )
    line = open_envi(header)
    assert line.attrs["source"] == "raw_0"
    fields = json.loads(line.attrs["envi_header"])
    assert (next(iter(fields)), fields["strange key"]) == ("lines", "{a, b}")
    assert json.loads(line.attrs["envi_comments"]) == {"Exposure (ms)": "5"}
    assert json.dumps(line.attrs)
    assert str(tmp_path) not in json.dumps(line.attrs)


_UTM = "map info = {UTM, 1, 1, 500000, 4000000, 0.5, 0.25, 18, North, WGS-84, units=Meters}"


def test_map_geometry(tmp_path: Path) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), _UTM, interleave="bsq"))
    array = line["values"]
    assert array.dims == ("y", "x", "band")
    np.testing.assert_array_equal(array, toy("f4").transpose(0, 2, 1))
    np.testing.assert_array_equal(line.x, 500000.25 + 0.5 * np.arange(4))
    np.testing.assert_array_equal(line.y, 4000000 - 0.125 - 0.25 * np.arange(5))
    assert line.x.attrs == {"standard_name": "projection_x_coordinate", "units": "m", "crs": "EPSG:32618"}
    assert line.attrs["map_info"].startswith("{UTM")
    np.testing.assert_array_equal(array.sel(x=500000.75, y=3999999.9, method="nearest"), toy()[0, :, 1])
    # a rotated map has no one-dimensional coordinates
    for rotation in ("rotation=30", "rotation = 30"):
        line = open_envi(write_cube(tmp_path / "toy", toy("f4"), _UTM.replace("}", f", {rotation}}}")))
        assert line["values"].dims == ("y", "x", "band")
        assert not {"x", "y"} & set(line.coords)
        assert rotation in line.attrs["map_info"]
    # an arbitrary one is sensor geometry
    info = "map info = {Arbitrary, 1, 1, 0, 0, 1, 1, 0, North}"
    assert open_envi(write_cube(tmp_path / "toy", toy("u2"), info))["values"].dims == schema.CUBE


def test_map_geometry_geographic_with_another_reference_pixel(tmp_path: Path) -> None:
    info = "map info = {Geographic Lat/Lon, 2.5, 3, -77.5, 43.1, 1e-5, 2e-5, WGS84, units=Degrees}"
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), info))
    # the middle of column 1 (counted from 0) is column 2.5 of ENVI
    np.testing.assert_allclose(line.x.values[1], -77.5, rtol=1e-15)
    np.testing.assert_allclose(line.y.values[2], 43.1 - 1e-5, rtol=1e-15)
    assert line.x.attrs == {"standard_name": "longitude", "units": "degrees_east", "crs": "EPSG:4326"}


def test_the_reference_system_of_a_map_goes_on(tmp_path: Path) -> None:
    cube = toy("f4")
    for text, expected in (
        ('coordinate system string = {PROJCS["WGS_1984_UTM_Zone_18N",GEOGCS[]]}', "EPSG:32618"),
        ("coordinate system string = {LOCAL}", "LOCAL"),
        ("", "EPSG:32618"),
    ):
        line = open_envi(write_cube(tmp_path / "toy", cube, _UTM, text, "wavelength = {" + "500," * 20 + "}"))
        assert line.x.attrs["crs"] == line.y.attrs["crs"] == expected
    header = write_envi(line, tmp_path / "again.img")
    assert "map info = {UTM, 1, 1, 500000.0" in header.read_text()
    assert open_envi(header).x.attrs["crs"] == "EPSG:32618"


# --- the pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("raw_0.hdr", "raw_0"), ("raw_0.HDR", "raw_0"), ("a.hdr", "a.img"), ("a.hdr", "a.DAT"),
        ("a.hdr", "a.raw"), ("a.hdr", "a.bil"), ("a.hdr", "a.bip"), ("a.hdr", "a.bsq"),
        ("x.img.hdr", "x.img"), ("x.bil.hdr", "x.bil"), ("v1.2.hdr", "v1.2"), ("v1.2.hdr", "v1.2.img"),
        ("toy.hdr", "toy.bin"), ("a.hdr", "a.hyspex"), ("a.hdr", "a.float"), ("a.hdr", "a.REF"),
    ],
)  # fmt: skip
def test_either_file_finds_the_other(tmp_path: Path, header: str, data: str) -> None:
    written = write_cube(tmp_path / data, toy("u2"))
    if written.name != header:
        written.rename(tmp_path / header)
    backend = EnviBackendEntrypoint()
    for name in (header, data):
        assert find_pair(tmp_path / name) == (tmp_path / header, tmp_path / data)
        # other formats have these suffixes too
        is_guessed = not name.endswith((".bin", ".hyspex", ".float", ".REF"))
        assert backend.guess_can_open(tmp_path / name) == is_guessed
        assert backend.guess_can_open(str(tmp_path / name)) == is_guessed
    for name in (header, data):
        np.testing.assert_array_equal(open_envi(str(tmp_path / name))["values"], toy("u2"))


def test_pair_problems(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "a.img", toy("u2")).rename(tmp_path / "a.hdr")
    shutil.copy(tmp_path / "a.img", tmp_path / "a.dat")
    (tmp_path / "lonely.hdr").write_text("ENVI\n")
    (tmp_path / "bare").write_bytes(b"")
    for name, code in (
        ("a.hdr", "data-file-ambiguous"),
        ("lonely.hdr", "data-file-missing"),
        ("bare", "header-missing"),
    ):
        expect_error(FormatError, code, partial(find_pair, tmp_path / name))
    assert find_pair(tmp_path / "a.dat") == (header, tmp_path / "a.dat")
    (tmp_path / "a.dat.hdr").write_text(header.read_text() + "band names = {}\n")
    with pytest.warns(PaintWarning, match="header-doubtful"):
        assert find_pair(tmp_path / "a.dat") == (tmp_path / "a.dat.hdr", tmp_path / "a.dat")
    expect_error(FormatError, "path-is-folder", partial(find_pair, tmp_path))
    netcdf = tmp_path / "a.nc"  # beside the header of a.img
    netcdf.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(1000))
    expect_error(FormatError, "format-unknown", partial(open_envi, netcdf, keep_whole_lines=True))
    for missing in ("nothing.hdr", "nothing"):
        expect_error(FileNotFoundError, "no such file", partial(find_pair, tmp_path / missing))


def test_guess_leaves_other_files_alone(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_text("ENVI\n")
    for name in ("a.nc", "a.tif", "b", "b.img"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "other.hdr").write_bytes(b"#?RADIANCE\n")
    (tmp_path / "a.zarr").mkdir()
    guess = EnviBackendEntrypoint().guess_can_open
    for name in ("a.nc", "a.tif", "b", "b.img", "other.hdr", "missing.hdr", "a.zarr", "bad\0name", "."):
        assert not guess(str(tmp_path / name)), name
    for thing in ("", ".", "..", "https://example.org/a.img", 3, None, b"bytes", {}):
        assert not guess(thing)


# --- what integers are -------------------------------------------------------------------------------------


def test_integers_are_what_the_caller_says_where_the_header_does_not(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"))
    counts = open_envi(header, quantity="counts").counts
    assert (counts.dtype, counts.attrs["units"]) == (np.dtype(np.uint16), "count")
    assert list(open_envi(header, quantity="radiance").data_vars) == ["radiance"]
    assert list(open_envi(header, unsaid="counts").data_vars) == ["counts"]
    opened = xr.open_dataset(header, engine=EnviBackendEntrypoint, quantity="counts")
    np.testing.assert_array_equal(opened.counts, toy("u2"))


@pytest.mark.parametrize(
    ("dtype", "lines", "quantity", "message"),
    [
        ("u2", ("description = {x,RADIANCE}",), "counts", "quantity-conflict"),
        ("u2", ("description = {[HEADWALL Hyperspec III]}",), "radiance", "quantity-conflict"),
        ("u2", ("reflectance scale factor = 10000",), "counts", "quantity-conflict"),
        ("f4", (), "counts", "quantity-conflict"),
        ("u2", ("data gain values = {" + "2," * 20 + "}",), "counts", "quantity-conflict"),
        ("u2", (), "reflectance", "quantity-conflict"),
        ("u2", (), "brightness", "choice-unknown"),
    ],
)
def test_what_the_header_contradicts_is_refused(
    tmp_path: Path, dtype: str, lines: tuple[str, ...], quantity: str, message: str
) -> None:
    header = write_cube(tmp_path / "toy", toy(dtype), *lines)
    expect_errors((FormatError, message, lambda: open_envi(header, quantity=quantity)))


# --- Slabs of raw cubes as runs of bytes, and the parser of VirtualiZarr that offers them ------------------

RAW = np.arange(600, dtype="u2").reshape(40, 3, 5)
NANOMETRES = "wavelength units = nm\nwavelength = {450, 550, 650}"


@given(st.lists(st.integers(1, 5000), min_size=1, max_size=4))
def test_slabs_that_are_broken_are_as_few_as_can_be(sizes: list[int]) -> None:
    chosen = slab_lines(np.cumsum(sizes).tolist())
    assert 8 <= chosen <= 64

    def broken(lines: int) -> int:
        # by hand: a slab is whole where all its lines are there and in one cube
        owner = np.repeat(np.arange(len(sizes)), sizes)
        slabs = [owner[first : first + lines] for first in range(0, len(owner), lines)]
        return sum(len(slab) < lines or slab[0] != slab[-1] for slab in slabs)

    assert broken(chosen) == min(broken(lines) for lines in range(8, 65))


def test_offsets_count_from_the_line_a_slab_begins_at() -> None:
    assert slab_offsets(10, 3, 2, 100, 7).tolist() == [121, 191]
    assert slab_offsets(10, 0, 0, 0, 7).size == 0


@pytest.fixture
def registry(tmp_path: Path) -> Any:
    pytest.importorskip("virtualizarr", reason="virtualizarr is not installed (extra `virtual`)")
    from obspec_utils.registry import ObjectStoreRegistry
    from obstore.store import LocalStore

    return ObjectStoreRegistry({"file://": LocalStore()})


@pytest.mark.parametrize("interleave", FROM_LBS)
@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<f4"])
@pytest.mark.parametrize("suffix", ["", ".hdr"])
def test_the_parser_gives_the_samples(
    tmp_path: Path, registry: Any, interleave: str, dtype: str, suffix: str
) -> None:
    write_cube(
        tmp_path / "raw_0",
        RAW.astype(dtype[1:]),
        NANOMETRES,
        interleave=interleave,
        order=dtype[0],
        offset=128,
    )
    store = EnviParser()(f"file://{tmp_path}/raw_0{suffix}", registry)
    with xr.open_zarr(store, consolidated=False, zarr_format=3) as opened:
        assert opened["counts"].dims[FROM_LBS[interleave].index(0)] == "along_track"
        assert opened["counts"].chunksizes["along_track"] == (40,)
        np.testing.assert_array_equal(opened["counts"].transpose(*schema.CUBE), RAW)
        assert opened.attrs["wavelength"] == [450.0, 550.0, 650.0]


def test_the_parser_serves_virtualizarr(tmp_path: Path, registry: Any) -> None:
    from virtualizarr import open_virtual_dataset

    write_cube(tmp_path / "raw_0", RAW, NANOMETRES)
    url = f"file://{tmp_path}/raw_0"
    with open_virtual_dataset(url, registry=registry, parser=EnviParser("raw", lines=8)) as opened:
        manifest = opened["raw"].data.manifest.dict()
    assert len(manifest) == 5
    entry = manifest["2.0.0"]
    content = (tmp_path / "raw_0").read_bytes()[entry["offset"] : entry["offset"] + entry["length"]]
    assert content == RAW[16:24].tobytes()


def test_the_parser_refuses_what_would_be_read_wrongly(tmp_path: Path, registry: Any) -> None:
    write_cube(tmp_path / "raw_0", RAW, NANOMETRES)
    url = f"file://{tmp_path}/raw_0"
    expect_errors((FormatError, "length-mismatch", lambda: EnviParser(lines=32)(url, registry)))
    (tmp_path / "raw_0").write_bytes(bytes(1198))
    expect_errors((FormatError, "file-size", lambda: EnviParser()(url, registry)))
    (tmp_path / "raw_0.hdr").write_text("ENVI\nsamples = 5\n")
    expect_errors((FormatError, "key-missing", lambda: EnviParser()(url, registry)))


# --- Real ENVI cubes: their known values, and other readers as oracles -------------------------------------


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "shape", "figures", "ends"),
    [  # first sample, least, largest, mean; first and last wavelength [nm]
        ("darkReference", (1, 978, 1600), (22, 2, 47, 13.97111260), (379.027, 1000.95)),
        ("darkReference.hdr", (1, 978, 1600), (22, 2, 47, 13.97111260), (379.027, 1000.95)),
        ("corn-kernel-hyperspectral.hdr", (31, 580, 43), (22, 0, 2887, 601.543934), (366.551, 1048.421)),
        ("ang20150420t182808_corr_v1e_img_4200-4210_70-80.img", (10, 10, 432),
         (-0.080668993, -1.9857477, 1.0976714, 0.16265104), (346.2995778, 2505.0363678)),
        ("prm20231110t071521_rdn_two_px", (2, 246, 1),
         (3.5448196, 0.042991258, 7.7847199, 2.5441371), (350.5548293, 1045.6487295)),
        ("../lab_calibration/specim_fenix_Radiometric_8x2_1x1.dat", (1, 363, 384),
         (5.9051208, 0.0020899656, 6.1450582, 0.10669173), (379.87, 2503.73)),
    ],
)  # fmt: skip
def test_real_cubes(shared_data: Path, name: str, shape: Any, figures: Any, ends: Any) -> None:
    corn, path = name.startswith("corn"), shared_data / "envi_cube" / name  # without byte order
    with pytest.warns(PaintWarning, match="header-doubtful") if corn else contextlib.nullcontext():
        line = open_envi(path, quantity="counts" if corn else None)
    (array,) = line.data_vars.values()
    assert array.dims == (("y", "x", "band") if name.startswith("ang") else schema.CUBE)
    found = [array.values.flat[0], array.min(), array.max(), array.mean(dtype="f8")]
    assert (array.shape, list(map(float, found))) == (shape, pytest.approx(figures, rel=1e-7))
    np.testing.assert_allclose(line.wavelength[[0, -1]], ends, rtol=1e-9)
    if shape[1] in (978, 580):
        assert (array.name, array.dtype, array.attrs["units"]) == ("counts", np.uint16, "count")


@pytest.mark.real_data
def test_real_toy_cube_with_both_headers(shared_data: Path, tmp_path: Path) -> None:
    i, k, j = np.meshgrid(np.arange(5), np.arange(20), np.arange(4), indexing="ij")
    folder = shared_data / "envi_cube"
    shutil.copy(folder / "test_image.img", tmp_path / "copy.img")
    shutil.copy(folder / "test_image_multiline_header.hdr", tmp_path / "copy.hdr")
    for path in (folder / "test_image.hdr", tmp_path / "copy.hdr"):
        line = open_envi(path)
        np.testing.assert_array_equal(line["values"], 1 + j + 4 * i + 20 * k)
        np.testing.assert_allclose(line.wavelength, 1e3 * np.arange(20, 40), rtol=1e-14)
        assert "micrometres" in line.attrs["envi_notes"]


def _as_lines_samples_bands(line: xr.Dataset) -> np.ndarray:
    (name,) = line.data_vars
    values: np.ndarray = line[name].transpose(..., "band").values
    return values


_CUBES = (
    "darkReference",
    "prm20231110t071521_rdn_two_px",
    "ang20150420t182808_corr_v1e_img_4200-4210_70-80.img",
)


@pytest.mark.real_data
@pytest.mark.parametrize("name", _CUBES)
def test_real_spectral_python_agrees(shared_data: Path, name: str) -> None:
    spy = pytest.importorskip("spectral.io.envi")
    data = shared_data / "envi_cube" / name
    header = data.with_name(name.removesuffix(".img") + ".hdr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image = spy.open(str(header), str(data))
        oracle = np.asarray(image.open_memmap(interleave="bip"))
    line = open_envi(data)
    expect_equal((_as_lines_samples_bands(line), oracle), (line.wavelength, image.bands.centers))
    if "fwhm" in line.coords:
        np.testing.assert_array_equal(line.fwhm, image.bands.bandwidths)


@pytest.mark.real_data
@pytest.mark.parametrize("name", _CUBES)
def test_real_gdal_agrees(shared_data: Path, name: str) -> None:
    data = shared_data / "envi_cube" / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(data, driver="ENVI") as source:
            oracle = source.read().transpose(1, 2, 0)
    np.testing.assert_array_equal(_as_lines_samples_bands(open_envi(data)), oracle)


# --- ENVI headers: real ones, damaged ones, hostile ones


BASE = {
    "samples": "4",
    "lines": "5",
    "bands": "3",
    "header offset": "0",
    "data type": "12",
    "interleave": "bil",
    "byte order": "0",
}


def header_text(*lines: str, **changed: str | None) -> str:
    # Return a small sound header with keys changed (``byte_order=None`` drops one) and lines added
    fields = {**BASE, **{key.replace("_", " "): value for key, value in changed.items()}}
    said = [f"{key} = {value}" for key, value in fields.items() if value is not None]
    return "\n".join(["ENVI", *said, *lines]) + "\n"


def problems_of(text: str) -> list[str]:
    return str(expect_error(FormatError, None, lambda: parse_header(text))).splitlines()[1:]


def test_every_field_of_a_full_header() -> None:
    header = parse_header(
        header_text(
            "DESCRIPTION = {[HEADWALL Hyperspec III],RADIANCE}",
            "Wavelength  Units = Micrometers",
            "wavelength = {\n0.45\n,0.55\n,0.5}",
            "fwhm = {0.006, 0.005, 0.004}",
            "bbl = {1, 0.0, 1}",
            "band names = {a, b b, c}",
            "data ignore value = -9999.0",
            "reflectance scale factor = 10000",
            "data gain values = {1, 2, 3}",
            "data offset values = {0 0 -1e-3}",
            "map info = {UTM, 1, 1, 500000.5, 4000000, 0.5, 0.25, 18, North, WGS-84,",
            " units=Meters, rotation=30}",
            "unheard of = {x = 1,",
            "  y}",
            ";Exposure (ms) = 5.5",
            "; a remark",
            "; equals = a=b",
        )
    )
    assert (header.lines, header.samples, header.bands, header.header_offset) == (5, 4, 3, 0)
    assert (header.dtype, header.interleave) == (np.dtype("<u2"), "bil")
    assert header.description == "[HEADWALL Hyperspec III],RADIANCE"
    np.testing.assert_allclose(header.wavelength, [450, 550, 500], rtol=1e-15)  # never sorted
    np.testing.assert_allclose(header.fwhm, [6, 5, 4], rtol=1e-15)
    np.testing.assert_array_equal(header.good, [True, False, True])
    assert (header.wavelength.dtype, header.good.dtype) == (np.dtype(np.float64), np.dtype(bool))
    assert (header.band_names, header.data_ignore_value) == (("a", "b b", "c"), -9999)
    assert header.reflectance_scale_factor == 1e4
    np.testing.assert_array_equal(header.data_gain_values, [1, 2, 3])
    np.testing.assert_array_equal(header.data_offset_values, [0, 0, -1e-3])
    info = header.map_info
    assert (info.projection, info.reference_pixel, info.reference) == ("UTM", (1, 1), (500000.5, 4000000))
    assert (info.pixel_size, info.units, info.rotation) == ((0.5, 0.25), "meters", 30)
    assert (info.details, header.fields["unheard of"]) == (("18", "North", "WGS-84"), "{x = 1,\n  y}")
    assert list(header.fields)[:2] == ["samples", "lines"]
    assert (header.comments, header.notes) == ({"Exposure (ms)": "5.5", "equals": "a=b"}, ())
    assert pickle.loads(pickle.dumps(header)).fields == header.fields


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_and_encodings(tmp_path: Path, end: str) -> None:
    path = tmp_path / "a.hdr"
    text = header_text("wavelength units = µm", "wavelength = {0.4,", "0.5,", "0.6}").replace("\n", end)
    for encoding in ("utf-8", "utf-8-sig", "latin-1"):
        path.write_bytes(text.encode(encoding))
        np.testing.assert_allclose(read_header(path).wavelength, [400, 500, 600], rtol=1e-14)


def test_missing_byte_order_is_inferred_with_a_warning() -> None:
    header = parse_header(header_text(byte_order=None))
    assert header.dtype == np.dtype("<u2")
    assert "little-endian" in header.warnings[0]
    assert header.notes == header.warnings
    assert parse_header(header_text(byte_order=None, data_type="1")).notes == ()


@pytest.mark.parametrize(
    ("units", "values", "expected", "noted"),
    [
        ("nm", "400,500,600", [400, 500, 600], None),
        ("Nanometers", "400 500 600", [400, 500, 600], None),
        ("micrometers", ".4, .5, .6,", [400, 500, 600], None),
        ("um", "\n.4\n.5\n.6\n", [400, 500, 600], None),
        ("Angstroms", "4000,5000,6000", [400, 500, 600], None),
        ("Unknown", "0.4,0.5,2.5", [400, 500, 2500], "micrometres"),
        (None, "400,500,99", [400, 500, 99], "nanometres"),
        (None, "0.6,0.4,0.5", [600, 400, 500], "micrometres"),
        ("Index", "1,2,3", None, "'Index'"),
        ("nm", "0.4,0.5,0.6", [0.4, 0.5, 0.6], "check the unit"),
        ("um", "400,500,600", [4e5, 5e5, 6e5], "check the unit"),
    ],
)
def test_wavelength_units(
    units: str | None, values: str, expected: list[float] | None, noted: str | None
) -> None:
    lines = [f"wavelength = {{{values}}}", *([f"wavelength units = {units}"] if units else [])]
    header = parse_header(header_text(*lines))
    if expected is None:
        assert header.wavelength is None
    else:
        np.testing.assert_allclose(header.wavelength, expected, rtol=1e-14)
    assert (noted is None) == (not header.notes)
    assert noted is None or noted in header.notes[0]
    assert bool(header.warnings) == (noted == "check the unit")


@pytest.mark.parametrize(
    "names",
    ["399.356 nm, 401.5 nm, 1001.42 nm", "Band 1 (399.356 Nanometers),Band 2 (401.5 nm), b3 1.00142 um"],
)
def test_wavelengths_in_band_names(names: str) -> None:
    header = parse_header(header_text(f"band names = {{{names}}}"))
    np.testing.assert_allclose(header.wavelength, [399.356, 401.5, 1001.42], rtol=1e-14)
    assert "band names" in header.notes[0]
    listed = parse_header(
        header_text(f"band names = {{{names}}}", "wavelength = {1,2,3}", "wavelength units = um")
    )
    np.testing.assert_array_equal(listed.wavelength, [1000, 2000, 3000])
    assert parse_header(header_text("band names = {1 nm, red, 3 nm}")).wavelength is None


@pytest.mark.parametrize(
    ("changed", "lines", "expected"),
    [
        ({"lines": "10.5"}, (), "10.5"),
        ({"lines": "0"}, (), "above 0"),
        ({"lines": "-3"}, (), "above 0"),
        ({"samples": "1e3"}, (), "1e3"),
        ({"bands": "٣"}, (), "whole number"),
        ({"bands": "9" * 5000}, (), "..."),
        ({"lines": None}, (), "'lines' is missing"),
        ({"data type": None}, (), "'data type' is missing"),
        ({"data type": "7"}, (), "expected one of 1, 2, 3"),
        ({"interleave": None}, (), "'interleave' is missing"),
        ({"interleave": "bup"}, (), "bil, bip, bsq"),
        ({"interleave": "../x"}, (), "bil, bip, bsq"),
        ({"byte order": "7"}, (), "expected one of 0, 1"),
        ({"header offset": "-1"}, (), "0 or above"),
        ({}, ("lines = 6",), "given again"),
        ({}, ("wavelength = {400, 500, 600",), "never closed"),
        ({}, ("wavelength = {400, nan, 600}",), "finite"),
        ({}, ("wavelength = {400, 500, inf}",), "finite"),
        ({}, ("wavelength = {400, 1e999, 600}",), "finite"),
        ({}, ("wavelength = {400, 5_0_0, 600}",), "5_0_0"),
        ({}, ("wavelength = {400, 500, }",), "2 values for 3 bands"),
        (
            {"bands": "978"},
            (f"wavelength = {{{','.join(map(str, range(400, 435)))}}}",),
            "35 values for 978 bands",
        ),
        ({}, ("wavelength = {400, -1, 600}",), "above 0"),
        ({}, ("wavelength = {400, 500, 600}", "wavelength units = parsec"), "parsec"),
        ({}, ("fwhm = {4, 5}",), "2 values for 3 bands"),
        ({}, ("fwhm = {4, 5, -5}",), "below 0"),
        ({}, ("bbl = {1, 0.5, 1}",), "bbl"),
        ({}, ("data ignore value = none",), "none"),
        ({}, ("reflectance scale factor = 0",), "such as 10000"),
        ({}, ("reflectance scale factor = 0.0001",), "inverse"),
        ({}, ("reflectance scale factor = {1, 2}",), "one number"),
        ({}, ("data gain values = {1}",), "1 values for 3 bands"),
        ({}, ("map info = {UTM, 1, 1}",), "map info"),
        ({}, ("map info = {UTM, 1, 1, 0, 0, 0, 1}",), "map info"),
        ({}, ("map info = {UTM, 1, 1, nan, 0, 1, 1}",), "map info"),
        ({}, ("major frame offsets = {2, 0}",), "padded"),
        ({}, ("file compression = 1",), "unpack"),
        ({}, ("no equals sign",), "line 9"),
        ({}, ("= 5",), "key = value"),
    ],
)
def test_refused(changed: dict[str, str | None], lines: tuple[str, ...], expected: str) -> None:
    found = problems_of(header_text(*lines, **{k.replace(" ", "_"): v for k, v in changed.items()}))
    assert len(found) == 1
    assert expected in found[0]
    assert len(found[0]) < 400


def test_all_problems_at_once() -> None:
    assert len(problems_of(header_text("bbl = {1}", lines="10.5", interleave="bup", byte_order="9"))) == 4
    assert len(problems_of(header_text(*["x"] * 1000))) < 30  # a flood is cut short


def test_same_value_twice_is_noted_and_comments_keep_the_first() -> None:
    header = parse_header(header_text("lines = 5", ";Exposure (ms) = 5", ";Exposure (ms) = 7"))
    assert "given twice" in header.notes[0]
    assert header.comments["Exposure (ms)"] == "5"
    assert "Exposure" in header.warnings[0]


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n", b"ENVISAT\n", b"ENVI", b"ENVI\n\n", b"ENVI\n;a = b\n"]
)
def test_foreign_files(tmp_path: Path, content: bytes) -> None:
    path = write_file(tmp_path / "foreign.hdr", content)
    expect_errors((FormatError, r"foreign\.hdr", lambda: read_header(path)))


def test_damaged_headers_raise_format_error_only(shared_data: Path) -> None:
    # Random bytes changed, cut out, doubled and swapped in real headers
    dice = random.Random(20260)
    pieces = [b"{", b"}", b"=", b",", b";", b"\n", b"\0", b"\xff", b"nan", b"-", b"1e400", b"9" * 40, b"ENVI"]
    pieces += [b"1", b"4", b" ", b"a", b""]
    outcomes = {True: 0, False: 0}
    for path in sorted((shared_data / "envi_cube").glob("*.hdr")):
        raw = path.read_bytes()
        for _ in range(60):
            made = bytearray(raw)
            for _ in range(dice.randint(1, 3)):
                at = dice.randrange(len(made))
                span = dice.choice((0, 1, 1, 5, 200))
                made[at : at + span] = dice.choice([*pieces, bytes(made[at : at + 50])])
            try:
                header = parse_header(bytes(made).decode("latin-1"))
            except FormatError:
                outcomes[False] += 1
            else:
                outcomes[True] += 1
                assert min(header.lines, header.samples, header.bands) >= 1
                assert header.wavelength is None or header.wavelength.shape == (header.bands,)
    assert min(outcomes.values()) > 20, outcomes


_KEYS = st.sampled_from(
    [*BASE, "wavelength", "wavelength units", "fwhm", "bbl", "band names", "map info", "data ignore value",
     "description", "file type", "reflectance scale factor", ";x"]
)  # fmt: skip
_VALUES = st.one_of(
    st.text(max_size=30),
    st.floats().map(str),
    st.integers().map(str),
    st.lists(st.floats() | st.text(max_size=5), max_size=8).map(lambda v: "{" + ",".join(map(str, v)) + "}"),
    st.sampled_from(["bil", "nm", "{nm}", "Unknown", "{UTM,1,1,0,0,1,1,rotation=", "ENVI Spectral Library"]),
)


@given(st.lists(st.tuples(_KEYS, _VALUES), max_size=6), st.booleans())
def test_any_header_is_read_or_refused(pairs: list[tuple[str, str]], sound: bool) -> None:
    text = "\n".join(f"{key} = {value}" for key, value in pairs)
    with contextlib.suppress(FormatError):
        parse_header((header_text() if sound else "ENVI\n") + text)


_MEGABYTE = 2**20


@pytest.mark.parametrize(
    "bomb",
    [
        pytest.param(lambda: "wavelength = {" + "4," * _MEGABYTE + "}", id="one-line list"),
        pytest.param(lambda: "wavelength = {" + "4\n" * _MEGABYTE + "}", id="one value a line"),
        pytest.param(lambda: "wavelength = {" + "4\n" * _MEGABYTE, id="never closed"),
        pytest.param(lambda: "wavelength = {" + "4" * (2 * _MEGABYTE) + "}", id="one long number"),
        pytest.param(lambda: "band names = {" + "1" * (2 * _MEGABYTE) + ",b,c}", id="digits in a band name"),
        pytest.param(lambda: "band names = {" + "a," * _MEGABYTE + "}", id="band names"),
        pytest.param(lambda: "description = {" + ", " * _MEGABYTE + "}", id="description"),
        pytest.param(lambda: "map info = {" + "1," * _MEGABYTE + "}", id="map info"),
        pytest.param(lambda: "x\n" * _MEGABYTE, id="lines without a key"),
        pytest.param(lambda: "\n".join(f"k{i} = " for i in range(400_000)), id="keys"),
        pytest.param(lambda: "lines = 5\n" * 400_000, id="one key again and again"),
        pytest.param(lambda: "lines = 6\n" * 400_000, id="one key contradicted"),
        pytest.param(lambda: "\n".join(f";k{i} = " for i in range(400_000)), id="comments"),
        pytest.param(lambda: "{" * (2 * _MEGABYTE), id="braces"),
    ],
)
def test_bombs_cost_little(tmp_path: Path, bomb: Callable[[], str]) -> None:
    path = write_file(tmp_path / "bomb.hdr", header_text() + bomb())
    start = time.process_time()
    with contextlib.suppress(FormatError):
        read_header(path)
    # linear: a quadratic reader takes minutes
    assert time.process_time() - start < 5


def test_long_list_takes_little_memory(tmp_path: Path) -> None:
    path = write_file(tmp_path / "bomb.hdr", header_text("wavelength = {" + "4," * (_MEGABYTE // 4) + "}"))
    tracemalloc.start()
    error = expect_error(FormatError, "length-mismatch", lambda: read_header(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * path.stat().st_size
    assert len(str(error)) < 1000


def test_oversized_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "big.hdr"
    with open(path, "wb") as file:
        file.write(b"ENVI\n")
        file.truncate(2**30)
    expect_errors((FormatError, "over 4 MB", lambda: read_header(path)))


@pytest.mark.real_data
def test_real_headwall_header(shared_data: Path) -> None:
    header = read_header(shared_data / "envi_cube" / "darkReference.hdr")
    assert (header.lines, header.samples, header.bands) == (1, 1600, 978)
    assert (header.dtype, header.description) == (np.dtype("<u2"), "[HEADWALL Hyperspec III]")
    assert (header.wavelength[0], header.wavelength[1], header.wavelength[-1]) == (379.027, 379.663, 1000.95)
    assert (len(header.comments), header.comments["Serial Number"]) == (20, "G4-426")
    assert header.comments["Array Pixel Pitch (um)"] == "6.5"
    assert (header.fields["default bands"], header.notes) == ("{159,253,520}", ())


@pytest.mark.real_data
def test_real_header_with_bad_bands_and_rotation(shared_data: Path) -> None:
    header = read_header(next((shared_data / "envi_cube").glob("ang*.hdr")))
    assert header.good[:8].tolist() == [False] * 7 + [True]
    assert (header.fwhm[0], header.map_info.rotation) == (5.55165, 75)
    assert header.fields["correction factors"].startswith("{ 1.0 , 1.0")


@pytest.mark.real_data
def test_real_libraries_count_samples_as_wavelengths(shared_data: Path) -> None:
    berlin = read_header(shared_data / "envi_sli" / "library_berlin.hdr")
    assert berlin.is_spectral_library
    assert berlin.wavelength.shape == (177,)
    np.testing.assert_allclose(berlin.wavelength[[0, -1]], [460, 2409], rtol=1e-12)
    aviris = read_header(shared_data / "envi_sli" / "s07_AV95_envi.hdr").wavelength
    assert list(np.flatnonzero(np.diff(aviris) < 0) + 1) == [32, 96]  # 1-based neighbours of 31 and 95


# --- headers of other programs: keys that change the meaning of samples are honoured, or named ------------


SIZES = "ENVI\nsamples = 4\nlines = 10\nbands = 3\nheader offset = 0\ndata type = 12\nbyte order = 0\n"
PLAIN = "interleave = bil\nwavelength units = nm\nwavelength = {500, 510, 520}\n"
PLACE = "map info = {UTM, 1, 1, 500000, 4500000, 0.5, 0.5, 18, North, WGS-84}\n"


def header(folder: Path, text: str) -> Path:
    (folder / "a.hdr").write_text(SIZES + text)
    np.arange(120, dtype="u2").tofile(folder / "a")
    return folder / "a.hdr"


@pytest.mark.parametrize(
    ("unit", "wavelength", "fwhm", "expected", "is_told"),
    [
        ("um", "0.5, 0.51, 0.52", "5, 5, 5", 5.0, True),
        ("nm", "500, 510, 520", "0.005, 0.005, 0.005", 5.0, True),
        ("Unknown", "0.5, 0.51, 0.52", "5, 6, 5", 5.0, True),
        ("Angstroms", "5000, 5100, 5200", "5, 5, 5", 0.5, False),
        ("um", "0.76, 0.7601, 0.7602", "0.28, 0.28, 0.28", 0.28, True),
        ("um", "0.5, 0.51, 0.52", "0.005, 0.005, 0.005", 5.0, False),
        ("nm", "760, 760.1, 760.2", "0.11, 0.11, 0.11", 0.11, False),
        ("nm", "450, 550, 850", "60, 60, 150", 60.0, False),
        ("nm", "500, 510, 520", "0, 0, 0", 0.0, False),
    ],
)
def test_widths_in_another_unit(
    unit: str, wavelength: str, fwhm: str, expected: float, is_told: bool, tmp_path: Path
) -> None:
    lists = f"wavelength units = {unit}\nwavelength = {{{wavelength}}}\nfwhm = {{{fwhm}}}\n"
    path = header(tmp_path, f"interleave = bil\ndescription = {{raw}}\n{lists}")
    said = remarks(lambda _: open_envi(path), tmp_path)
    assert [text for text in said if "fwhm" in text] == said * is_told
    with pytest.warns(match="header-doubtful") if is_told else xr.set_options():
        np.testing.assert_allclose(open_envi(path).fwhm[0], expected)


@pytest.mark.parametrize(
    ("text", "code", "word"),
    [
        (PLAIN + "file type = PCI\n", "file-type-wrong", "PCI"),
        (PLAIN + "file type = ERDAS IMAGINE\n", "file-type-wrong", "ERDAS"),
        (
            PLAIN + "file type = ENVI Standard\nread procedures = {a, b}\n",
            "file-type-wrong",
            "read procedures",
        ),
        (PLAIN + "data reflectance gain values = {1, 2, 3}\n", "header-doubtful", "data reflectance gain"),
        (PLAIN + "radiance scale factor = 100\n", "header-doubtful", "radiance scale factor"),
        (PLAIN.replace("bil", "bsq") + "autodarkstartline = 8\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = {8}\n", "header-doubtful", "autodarkstartline"),
        (PLAIN + "autodarkstartline = 12\n", "header-doubtful", "autodarkstartline"),
    ],
)
def test_keys_that_change_samples_are_named(text: str, code: str, word: str, tmp_path: Path) -> None:
    path = header(tmp_path, text)
    said = objection(lambda _: open_envi(path), tmp_path)
    assert code in said
    assert word in said


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (PLACE + "description = {[HEADWALL Hyperspec III],[HEADWALL Hyperspec III OR]}\n", "values"),
        (PLACE + "description = {raw_0 OR}\nfile type = ENVI\n", "values"),
        (PLACE + "data units = DN\n", "counts"),
        ("description = {[HEADWALL Hyperspec III]}\n", "counts"),
        ("autodarkstartline = 8\ndescription = {raw}\n", "counts"),
        ("autodarkstartline = 0\ndescription = {raw}\n", "counts"),
    ],
)
def test_integers_of_a_map_are_counts_only_by_their_units(text: str, name: str, tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + text)
    assert remarks(lambda _: open_envi(path), tmp_path) == []
    cube = open_envi(path)
    assert list(cube.data_vars) == [name]
    assert cube.sizes.get("along_track", 10) == (8 if "= 8" in text else 10)


def test_a_map_of_integers_is_no_dark(tmp_path: Path) -> None:
    path = header(tmp_path, PLAIN + PLACE)
    assert "values" in open_envi(path, unsaid="counts").data_vars
    expect_errors((FormatError, "dark-missing", lambda: open_envi(path, dark_lines=True)))
