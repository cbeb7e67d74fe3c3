"""ENVI cubes through the lazy reader: values, damage, laziness, and other readers as oracles."""

import itertools
import json
import os
import pickle
import shutil
import subprocess
import sys
import time
import tomllib
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support import ROOT
from support.envi_cubes import CODES, FROM_LBS, toy, write_cube
from support.refusals import expect_equal, expect_error, expect_errors

from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.backends import EnviBackendEntrypoint
from hyperpaint.io.envi.envi_cubes import (
    EnviArray,
    EnviParser,
    find_pair,
    open_envi,
    slab_lines,
    slab_offsets,
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
        with pytest.raises(FormatError, match="file-size") as caught:
            open_envi(header, keep_whole_lines=keep_whole_lines)
        assert (said in str(caught.value)) == possible
        assert ("whole lines" in str(caught.value)) == (interleave != "bsq")


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
        with pytest.raises(FormatError, match="file-changed"):
            part.load()


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


@pytest.fixture
def toy_variants(tmp_path: Path) -> list[tuple[Path, Path]]:
    # Return header and data file of the toy cube in every interleave and byte order
    made = []
    for interleave, order in itertools.product(FROM_LBS, "<>"):
        path = tmp_path / f"toy_{interleave}_{'<>'.index(order)}"
        made.append((write_cube(path, toy("i2"), interleave=interleave, order=order), path))
    return made


@pytest.mark.parametrize("package", ["spectral", "rasterio"])
@pytest.mark.filterwarnings("ignore")
def test_other_readers_agree(toy_variants: list[tuple[Path, Path]], package: str) -> None:
    pytest.importorskip(package)
    for header, data in toy_variants:
        found = open_envi(data)["values"]
        if package == "spectral":
            from spectral.io import envi as spy

            oracle = np.asarray(spy.open(str(header), str(data)).open_memmap(interleave="bip"))
            np.testing.assert_array_equal(found.transpose(..., "band"), oracle)
        else:
            import rasterio

            with rasterio.open(data, driver="ENVI") as source:
                np.testing.assert_array_equal(found.transpose("band", ...), source.read())


@pytest.mark.parametrize("reference", ["1, 1", "2.5, 3"])
def test_gdal_places_pixels_alike(tmp_path: Path, reference: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    info = f"map info = {{UTM, {reference}, 500000, 4000000, 0.5, 0.25, 18, North, WGS-84, units=Meters}}"
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), info))
    with rasterio.open(tmp_path / "toy", driver="ENVI") as source:
        expected = [source.xy(row, column) for row, column in ((0, 0), (4, 3))]
    found = [(float(line.x[column]), float(line.y[row])) for row, column in ((0, 0), (4, 3))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_scaled_reflectance_against_spectral_python(tmp_path: Path) -> None:
    # SPy divides the ignore value as well; everything else agrees
    pytest.importorskip("spectral")
    from spectral.io import envi as spy

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
    assert line.x.attrs == {"standard_name": "projection_x_coordinate", "units": "m"}
    assert line.attrs["map_info"].startswith("{UTM")
    np.testing.assert_array_equal(array.sel(x=500000.75, y=3999999.9, method="nearest"), toy()[0, :, 1])
    # a rotated map has no one-dimensional coordinates
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), _UTM.replace("}", ", rotation=30}")))
    assert line["values"].dims == ("y", "x", "band")
    assert not {"x", "y"} & set(line.coords)
    assert "rotation=30" in line.attrs["map_info"]
    # an arbitrary one is sensor geometry
    info = "map info = {Arbitrary, 1, 1, 0, 0, 1, 1, 0, North}"
    assert open_envi(write_cube(tmp_path / "toy", toy("u2"), info))["values"].dims == schema.CUBE


def test_map_geometry_geographic_with_another_reference_pixel(tmp_path: Path) -> None:
    info = "map info = {Geographic Lat/Lon, 2.5, 3, -77.5, 43.1, 1e-5, 2e-5, WGS84, units=Degrees}"
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), info))
    # the middle of column 1 (counted from 0) is column 2.5 of ENVI
    np.testing.assert_allclose(line.x.values[1], -77.5, rtol=1e-15)
    np.testing.assert_allclose(line.y.values[2], 43.1 - 1e-5, rtol=1e-15)
    assert line.x.attrs == {"standard_name": "longitude", "units": "degrees_east"}


# --- the pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("raw_0.hdr", "raw_0"), ("raw_0.HDR", "raw_0"), ("a.hdr", "a.img"), ("a.hdr", "a.DAT"),
        ("a.hdr", "a.raw"), ("a.hdr", "a.bil"), ("a.hdr", "a.bip"), ("a.hdr", "a.bsq"),
        ("x.img.hdr", "x.img"), ("x.bil.hdr", "x.bil"), ("v1.2.hdr", "v1.2"), ("v1.2.hdr", "v1.2.img"),
        ("toy.hdr", "toy.bin"),
    ],
)  # fmt: skip
def test_either_file_finds_the_other(tmp_path: Path, header: str, data: str) -> None:
    written = write_cube(tmp_path / data, toy("u2"))
    if written.name != header:
        written.rename(tmp_path / header)
    backend = EnviBackendEntrypoint()
    for name in (header, data):
        assert find_pair(tmp_path / name) == (tmp_path / header, tmp_path / data)
        is_guessed = not name.endswith(".bin")  # other formats have that suffix too
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
        with pytest.raises(FormatError, match=code):
            find_pair(tmp_path / name)
    assert find_pair(tmp_path / "a.dat") == (header, tmp_path / "a.dat")
    for missing in ("nothing.hdr", "nothing", "."):
        with pytest.raises(FileNotFoundError, match="no such file"):
            find_pair(tmp_path / missing)


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

SHAPE = (40, 3, 5)


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


def _cube(folder: Path, interleave: str, code: int, dtype: str, offset: int) -> np.ndarray[Any, Any]:
    # Write a cube; return its samples in the order of the file
    order = {"bil": (0, 1, 2), "bip": (0, 2, 1), "bsq": (1, 0, 2)}[interleave]
    samples = np.arange(np.prod(SHAPE)).reshape(SHAPE).transpose(order).astype(dtype)
    (folder / "raw_0").write_bytes(bytes(offset) + samples.tobytes())
    (folder / "raw_0.hdr").write_text(
        f"ENVI\nsamples = 5\nlines = 40\nbands = 3\nheader offset = {offset}\ndata type = {code}\n"
        f"interleave = {interleave}\nbyte order = {int(dtype[0] == '>')}\nwavelength units = nm\n"
        "wavelength = {450, 550, 650}\n"
    )
    return samples


@pytest.fixture
def registry(tmp_path: Path) -> Any:
    pytest.importorskip("virtualizarr", reason="virtualizarr is not installed (extra `virtual`)")
    from obspec_utils.registry import ObjectStoreRegistry
    from obstore.store import LocalStore

    return ObjectStoreRegistry({"file://": LocalStore()})


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize(("code", "dtype"), [(12, "<u2"), (12, ">u2"), (4, "<f4")])
@pytest.mark.parametrize("suffix", ["", ".hdr"])
def test_the_parser_gives_the_samples(
    tmp_path: Path, registry: Any, interleave: str, code: int, dtype: str, suffix: str
) -> None:
    samples = _cube(tmp_path, interleave, code, dtype, offset=128)
    store = EnviParser()(f"file://{tmp_path}/raw_0{suffix}", registry)
    with xr.open_zarr(store, consolidated=False, zarr_format=3) as opened:
        assert opened["counts"].dims[{"bil": 0, "bip": 0, "bsq": 1}[interleave]] == "along_track"
        assert opened["counts"].chunksizes["along_track"] == (40,)
        np.testing.assert_array_equal(opened["counts"].values, samples)
        assert opened.attrs["wavelength"] == [450.0, 550.0, 650.0]


def test_the_parser_serves_virtualizarr(tmp_path: Path, registry: Any) -> None:
    from virtualizarr import open_virtual_dataset

    samples = _cube(tmp_path, "bil", 12, "<u2", 0)
    url = f"file://{tmp_path}/raw_0"
    with open_virtual_dataset(url, registry=registry, parser=EnviParser("raw", lines=8)) as opened:
        manifest = opened["raw"].data.manifest.dict()
    assert len(manifest) == 5
    entry = manifest["2.0.0"]
    content = (tmp_path / "raw_0").read_bytes()[entry["offset"] : entry["offset"] + entry["length"]]
    assert content == samples[16:24].tobytes()


def test_the_parser_refuses_what_would_be_read_wrongly(tmp_path: Path, registry: Any) -> None:
    _cube(tmp_path, "bil", 12, "<u2", 0)
    url = f"file://{tmp_path}/raw_0"
    expect_errors((FormatError, "length-mismatch", lambda: EnviParser(lines=32)(url, registry)))
    (tmp_path / "raw_0").write_bytes(bytes(1198))
    expect_errors((FormatError, "file-size", lambda: EnviParser()(url, registry)))
    (tmp_path / "raw_0.hdr").write_text("ENVI\nsamples = 5\n")
    expect_errors((FormatError, "key-missing", lambda: EnviParser()(url, registry)))


# --- Real ENVI cubes: their known values, and other readers as oracles -------------------------------------


@pytest.mark.real_data
def test_real_headwall_dark_reference(shared_data: Path) -> None:
    for name in ("darkReference.hdr", "darkReference"):
        counts = open_envi(shared_data / "envi_cube" / name).counts
        assert (counts.shape, counts.dtype) == ((1, 978, 1600), np.uint16)
        assert (counts.attrs["units"], int(counts.min()), int(counts.max())) == ("count", 2, 47)
        assert float(counts.mean(dtype="f8")) == pytest.approx(13.97111260, abs=5e-9)


@pytest.mark.real_data
def test_real_cube_without_byte_order(shared_data: Path) -> None:
    with pytest.warns(PaintWarning, match="header-doubtful"):
        counts = open_envi(shared_data / "envi_cube/corn-kernel-hyperspectral.hdr", quantity="counts").counts
    assert (counts.shape, int(counts.min()), int(counts.max())) == ((31, 580, 43), 0, 2887)
    assert float(counts.mean(dtype="f8")) == pytest.approx(601.543934, abs=5e-7)
    assert counts.wavelength.values[[0, -1]].tolist() == [366.551, 1048.421]


@pytest.mark.real_data
def test_real_rotated_bip_cube(shared_data: Path) -> None:
    array = open_envi(next((shared_data / "envi_cube").glob("ang*.img")))["values"]
    assert (array.dims, array.shape) == (("y", "x", "band"), (10, 10, 432))
    assert float(array.min()) == pytest.approx(-1.98575, abs=5e-6)
    assert float(array.max()) == pytest.approx(1.09767, abs=5e-6)
    assert float(array.mean(dtype="f8")) == pytest.approx(0.162651, abs=5e-7)
    assert float(array[0, 0, 0]) == pytest.approx(-0.08066899, abs=5e-9)


@pytest.mark.real_data
def test_real_prism_radiance(shared_data: Path) -> None:
    array = open_envi(shared_data / "envi_cube" / "prm20231110t071521_rdn_two_px")["values"]
    assert (array.dims, array.shape) == (schema.CUBE, (2, 246, 1))
    assert float(array.min()) == pytest.approx(0.0429913, abs=5e-8)
    assert float(array.max()) == pytest.approx(7.78472, abs=5e-6)
    assert float(array.mean(dtype="f8")) == pytest.approx(2.54413724, abs=2e-7)


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


@pytest.mark.real_data
def test_real_specim_calibration_cube(shared_data: Path) -> None:
    line = open_envi(shared_data / "lab_calibration" / "specim_fenix_Radiometric_8x2_1x1.dat")
    assert line["values"].shape == (1, 363, 384)
    assert line.wavelength.values[[0, -1]].tolist() == [379.87, 2503.73]


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
    pytest.importorskip("spectral")
    from spectral.io import envi as spy

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
    rasterio = pytest.importorskip("rasterio")
    data = shared_data / "envi_cube" / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(data, driver="ENVI") as source:
            oracle = source.read().transpose(1, 2, 0)
    np.testing.assert_array_equal(_as_lines_samples_bands(open_envi(data)), oracle)
