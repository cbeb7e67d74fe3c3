"""ENVI cubes through the lazy reader: values, damage, laziness, and other readers as oracles."""

import itertools
import os
import pickle
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
from hypothesis import given, settings, strategies as st
from support import ROOT
from support.envi_cubes import CODES, FROM_LBS, toy, write_cube
from support.refusals import expect_equal, expect_error, expect_errors

from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.backends import EnviBackendEntrypoint
from hyperpaint.io.envi.envi_cubes import EnviArray, open_envi


@pytest.fixture
def bytes_read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    # Record the bytes of each read of a data file
    seen: list[int] = []
    original = EnviArray._fill

    def recorded(self: EnviArray, file: Any, first: int, into: np.ndarray) -> None:
        seen.append(into.nbytes)
        original(self, file, first, into)

    monkeypatch.setattr(EnviArray, "_fill", recorded)
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

    @settings(max_examples=40)
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
