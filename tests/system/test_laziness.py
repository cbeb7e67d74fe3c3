"""The same bits whatever the chunks, nothing read before it is asked for; dtypes and attributes."""

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from scipy.ndimage import map_coordinates
from support.commands import hyperpaint
from support.refusals import expect_errors
from support.strategies import SHIFT, START, assert_same, chunkings, flight, stored, values

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.panels import Panel


@pytest.fixture(scope="module")
def hard_line() -> xr.Dataset:
    # Every branch at once: smile, two darks, saturation, bad elements, a dropped frame, a gap
    line = flight(lines=40, bands=12, columns=6, dtype=np.uint16, smile=SHIFT, position=True, drift=0.01).line
    line["counts"].values[np.random.default_rng(4).random((40, 12, 6)) < 0.01] = 4095
    line["radiance_gain"].values[3, 4] = np.nan
    stamps = line.time.values.copy() + np.arange(40) * np.timedelta64(300_000_000, "ns")
    stamps[11] = np.datetime64("NaT", "ns")
    dark = line.dark_counts.values
    line = line.drop_vars("dark_counts").assign_coords(
        time=("along_track", stamps),
        dark_time=("dark_time", START + np.array([0, 30], "timedelta64[s]")),
    )
    line["dark_counts"] = (
        ("dark_time", "band", "cross_track"),
        np.stack([dark, dark + 3]),
        {"units": "count"},
    )
    return line


CHUNKS: list[Any] = [
    {"along_track": 1},
    {"along_track": 7, "band": -1, "cross_track": -1},
    {"along_track": 40},
    {"along_track": 16, "band": 5},
    {"along_track": (3, 30, 7), "band": (1, 11), "cross_track": (4, 2)},
]


@pytest.mark.parametrize(
    "scheduler",
    [
        "synchronous",
        "threads",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("processes", "cluster")),
    ],
)
def test_the_same_bits_whatever_the_chunks_and_the_scheduler(
    hard_line: xr.Dataset, scheduler: str, request: pytest.FixtureRequest
) -> None:
    # A result that depends on how it was computed cannot be checked by anyone
    with dask.config.set(scheduler="synchronous"):
        whole = reflectance(hard_line, keep_bits=12).compute()
    if scheduler == "cluster":
        context = request.getfixturevalue("two_workers").as_current()
    else:
        pool = request.getfixturevalue("two_processes") if scheduler == "processes" else None
        context = dask.config.set(scheduler=scheduler, pool=pool)
    with context:
        for chunks in CHUNKS:
            assert_same(whole, reflectance(hard_line.chunk(chunks), keep_bits=12).compute())


@settings(max_examples=8)
@given(data=st.data())
def test_the_same_bits_for_any_chunks(hard_line: xr.Dataset, data: st.DataObject) -> None:
    chunks = {
        dim: data.draw(chunkings(hard_line.sizes[dim]), label=dim)
        for dim in ("along_track", "band", "cross_track")
    }
    with dask.config.set(scheduler="synchronous"):
        assert_same(reflectance(hard_line), reflectance(hard_line.chunk(chunks)))


def test_any_order_of_dims(hard_line: xr.Dataset) -> None:
    turned = hard_line.transpose("cross_track", "band", "along_track", ...)
    assert_same(reflectance(hard_line), reflectance(turned))
    other = hard_line.rename_dims(along_track="downtrack", band="bands", cross_track="crosstrack")
    assert_same(reflectance(hard_line), other.paint.reflectance())


@pytest.mark.parametrize("dtype", ["uint8", ">u2", "int16", "int32", "float64", "float32"])
def test_counts_of_other_types(dtype: str) -> None:
    line = flight(dtype=np.uint16).line
    line["counts"].values[:] = line.counts.values // 20
    np.testing.assert_array_equal(values(line.assign(counts=line.counts.astype(dtype))), values(line))


def test_rounding_keeps_the_bits_that_were_asked_for() -> None:
    line = flight().line
    full, rounded = values(line), values(line, keep_bits=12)
    np.testing.assert_allclose(rounded, full, rtol=2.0**-13)
    assert not (rounded.view(np.uint32) & ((1 << 11) - 1)).any()
    np.testing.assert_array_equal(values(line, keep_bits=23), full)
    expect_errors(
        *((SchemaError, "keep_bits", partial(reflectance, line, keep_bits=bad)) for bad in (0, 24, -1))
    )


@pytest.mark.filterwarnings("ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning")  # flat
@pytest.mark.filterwarnings("ignore:the panel at lines:hyperpaint.base.errors.PaintWarning")  # no panel
def test_nothing_is_read_while_building(tmp_path: Any, hard_line: xr.Dataset, no_compute: Any) -> None:
    line = stored(hard_line, tmp_path / "line.zarr")
    assert line.time.chunks is not None  # non-index coordinates are lazy too
    with no_compute():
        made = reflectance(
            line, panel=Panel(slice(0, 4), slice(0, 3), 0.4, uncertainty=0.1), tilt=(3.0, 90.0)
        )
        for name, array in (("reflectance", made), ("radiance", line.paint.radiance())):
            assert array[name].dtype == np.float32
            assert array[name].chunks is not None
            assert (array.quality.dtype, array[name].dims, array.quality.dims) == (
                np.uint16,
                ("along_track", "band", "cross_track"),
                ("along_track", "cross_track"),
            )
        assert made.irradiance_age.dtype == np.float32
        smoothed = made.paint.smooth()
    for name in ("reflectance", "quality", "irradiance_age"):
        assert (made[name].compute().dtype, made[name].compute().shape) == (
            made[name].dtype,
            made[name].shape,
        )
    assert smoothed.reflectance.compute().dtype == np.float32
    assert_same(reflectance(hard_line), reflectance(line))


def test_lazy_from_radiance(tmp_path: Any, no_compute: Any) -> None:
    line = radiance(flight().line).drop_vars("counts").compute()
    lazily = stored(line, tmp_path / "radiance.zarr")
    with no_compute():
        made = reflectance(lazily)
    assert_same(reflectance(line), made)


def test_two_tasks_a_slab_at_the_most(tmp_path: Any) -> None:
    sizes = {}
    for lines in (16, 96):
        line = stored(flight(lines=lines).line, tmp_path / f"{lines}.zarr")
        (fused,) = dask.optimize(line.paint.reflectance()["reflectance"])
        sizes[lines] = len(fused.__dask_graph__())
    assert (sizes[96] - sizes[16]) / 10 <= 2


def test_graph_of_a_long_line_computes_nothing(no_compute: Any) -> None:
    # How long it takes, benchmarks/bench_graph.py measures
    line = flight(lines=1, bands=272, columns=640).line
    lines = 100_000
    long = line.drop_dims("along_track").assign_coords(
        time=("along_track", START + np.arange(lines) * np.timedelta64(7_000_000, "ns"))
    )
    cube = da.zeros((lines, 272, 640), chunks=(32, -1, -1), dtype=np.uint16)
    long["counts"] = (("along_track", "band", "cross_track"), cube, {"units": "count"})
    with no_compute():
        cube = reflectance(long)["reflectance"]
        dask.optimize(cube)
    assert cube.shape == (lines, 272, 640)


@pytest.mark.filterwarnings("ignore:the irradiance fits no sky:hyperpaint.base.errors.PaintWarning")  # flat
@pytest.mark.filterwarnings("ignore:the panel at lines:hyperpaint.base.errors.PaintWarning")  # no panel
def test_inputs_are_never_changed(hard_line: xr.Dataset) -> None:
    before = hard_line.copy(deep=True)
    reflectance(
        hard_line, tilt=(2.0, 10.0), panel=Panel(slice(0, 4), slice(0, 3), 0.4, uncertainty=0.1)
    ).compute()
    radiance(hard_line).compute()
    xr.testing.assert_identical(hard_line, before)


@pytest.mark.parametrize("keep", [True, False, "default"])
def test_attributes_are_replaced(keep: Any) -> None:
    line = flight().line
    line["counts"].attrs["comment"] = "stale"
    with xr.set_options(keep_attrs=keep):
        made = reflectance(line)
        bright = radiance(line)
    assert made.reflectance.attrs["units"] == "1"
    assert made.reflectance.attrs["long_name"]
    assert "comment" not in made.reflectance.attrs
    assert (bright.radiance.attrs["units"], made.irradiance_age.attrs["units"]) == ("W m-2 sr-1 nm-1", "s")
    assert made.quality.attrs["flag_meanings"].startswith("saturated below_dark")
    assert made.attrs["name"] == "raw_0"
    assert set(line.variables) < set(made.variables)


def test_stored_reflectance_is_always_computed_anew() -> None:
    made = flight()
    stale = made.line.assign(reflectance=made.line.counts.assign_attrs(units="1"))
    np.testing.assert_allclose(values(stale), made.reflectance, rtol=1e-5)


def test_a_long_record_does_not_weigh_on_the_tasks() -> None:
    line = flight().line
    when = line.irradiance_time.values[0] + np.arange(5000) * np.timedelta64(1, "s")
    record = xr.Dataset(
        {
            "irradiance": (
                line.irradiance.dims,
                np.repeat(line.irradiance.values[:1], 5000, 0),
                {"units": "W m-2 nm-1"},
            )
        },
        {"irradiance_time": when, "irradiance_wavelength": line.irradiance_wavelength},
    ).assign(irradiance_fwhm=line.irradiance_fwhm)
    made = reflectance(line, record).reflectance.data
    (key,) = (key for key in made.dask if str(key).startswith("make_plan"))
    assert len(dask.get(dict(made.dask), key).series) < 100


# --- A region in coordinates of the sensor and of the map: the same pixels ---


LINES, COLUMNS = 120, 80
MOUNTED = (0.34, -0.95, -0.13)
BORESIGHT = ("--set", f"boresight={','.join(map(str, MOUNTED))}")
SETTINGS = ("focal_length_mm=12", "pixel_pitch_um=7.4", "column_order=left_to_right")
CAMERA = tuple(word for setting in SETTINGS for word in ("--set", setting))
#: Corners between pixels, so that no centre lies on an edge.
OUTLINES = {
    "panel": np.array([(8.5, 10.5), (60.5, 20.5), (70.5, 100.5), (12.5, 90.5)]),
    "hood": np.array([(20.5, 30.5), (61.5, 30.5), (61.5, 60.5), (20.5, 60.5)]),
}
Pairs = set[tuple[int, int]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Return a folder with a processed line, and its regions in both kinds of coordinates
    folder = tmp_path_factory.mktemp("lot")
    collect = hp.simulate_collect(
        folder / "collect", lines=LINES, bands=4, columns=COLUMNS, scene="checkerboard", boresight=MOUNTED,
        wobble="calm", swath=COLUMNS * 0.008,
    )  # fmt: skip
    run("process", collect, "--out", folder / "lot.zarr")
    truth = xr.open_zarr(folder / "collect" / "truth.zarr")
    sensor, ground = [], []
    for name, corners in OUTLINES.items():
        sensor.append(hp.Region(name, corners, flightline="raw_0"))
        # along the edges of the outline, as the truth places them
        closed = np.concatenate([corners, corners[:1]])
        steps = np.linspace(0.0, 1.0, 60, endpoint=False)[:, None]
        x, y = np.concatenate([a + steps * (b - a) for a, b in pairwise(closed)]).T
        places = [map_coordinates(truth[key].values, [y, x], order=1) for key in ("east", "north")]
        ground.append(hp.Region(name, np.stack(places, axis=-1), flightline="raw_0"))
    hp.write_regions(hp.Regions(tuple(sensor)), folder / "sensor.geojson")
    hp.write_regions(hp.Regions(tuple(ground), "map", truth.attrs["crs"]), folder / "map.geojson")
    return folder


def run(*words: object) -> str:
    return hyperpaint(*words, "--quiet", status=0).output


def ground_of(folder: Path) -> float:
    return float(xr.open_zarr(folder / "collect" / "truth.zarr").attrs["ground"])


def signatures(folder: Path, store: str, regions: str, *options: object) -> xr.Dataset:
    # Return the library that the command writes, with all pixels as members
    out = folder / "paints.zarr"
    words = ("--no-flags", "--members", 10_000, "--overwrite", *options)
    run("signatures", folder / store, "--regions", folder / regions, "--out", out, *words)
    return xr.open_zarr(out).load()


def pixels_of(library: xr.Dataset) -> dict[str, Pairs]:
    names = ("member_along_track", "member_cross_track")
    places = np.stack([library[name].values for name in names], axis=-1)
    return {
        str(paint): {(int(a), int(c)) for a, c in of_paint if a >= 0}
        for paint, of_paint in zip(library["signature"].values, places, strict=True)
    }


def agreement(one: dict[str, Pairs], other: dict[str, Pairs]) -> float:
    # Return the least share of pixels that both have, of all that either has
    assert set(one) == set(other) == set(OUTLINES)
    return min(len(one[name] & other[name]) / len(one[name] | other[name]) for name in one)


def test_the_same_pixels_of_a_stored_line_from_the_command_line(folder: Path) -> None:
    where = ("--ground", ground_of(folder), *CAMERA, *BORESIGHT)
    drawn = pixels_of(signatures(folder, "lot.zarr", "sensor.geojson"))
    placed = pixels_of(signatures(folder, "lot.zarr", "map.geojson", *where))
    assert agreement(drawn, placed) >= 0.99
    # what the collect declares, and the store carries, stands for options
    assert pixels_of(signatures(folder, "lot.zarr", "map.geojson")) == placed
    off = pixels_of(signatures(folder, "lot.zarr", "map.geojson", *where[:2], "--set", "boresight=0,0,0"))
    assert agreement(drawn, off) < 0.9  # the boresight counts


def test_the_same_pixels_in_python_before_and_after_a_map_is_stored(folder: Path) -> None:
    line = hp.open_store(folder / "lot.zarr", "flightlines/raw_0").paint.reflectance()
    camera = hp.geometry.PinholeCamera(COLUMNS, focal_length=0.012, pixel_pitch=7.4e-6)
    located = line.paint.locate(ground=ground_of(folder), camera=camera, boresight=MOUNTED)
    sensor, ground = (hp.read_regions(folder / f"{name}.geojson") for name in ("sensor", "map"))
    drawn = pixels_of(line.paint.signatures(sensor, members=10_000))
    assert agreement(drawn, pixels_of(located.paint.signatures(ground, members=10_000))) >= 0.99
    fine = located.paint.orthorectify(0.004, grid="north")
    hp.to_store(fine, folder / "fine.zarr")
    for source in (fine, hp.open_store(folder / "fine.zarr"), xr.open_zarr(folder / "fine.zarr")):
        assert agreement(drawn, pixels_of(source.paint.signatures(ground, members=10_000))) >= 0.97
        assert agreement(drawn, pixels_of(source.paint.signatures(sensor, members=10_000))) >= 0.99


def test_a_stored_map_from_the_command_line(folder: Path) -> None:
    where = ("--ground", ground_of(folder), *CAMERA, *BORESIGHT)
    run("orthorectify", folder / "lot.zarr", *where, "--grid", "north", "--out", folder / "map.zarr")
    line, of_map = (
        signatures(folder, "lot.zarr", "map.geojson", *where), signatures(folder, "map.zarr", "map.geojson")
    )  # fmt: skip
    for name, pixels in pixels_of(of_map).items():
        assert len(pixels & pixels_of(line)[name]) >= 0.98 * len(pixels)
    np.testing.assert_allclose(of_map["reflectance"], line["reflectance"], atol=0.02)
    assert (of_map["view_zenith"].values, of_map["sun_zenith"].values) == (
        pytest.approx(line["view_zenith"].values, abs=0.3),
        pytest.approx(line["sun_zenith"].values, abs=0.01),
    )


def test_what_does_not_fit_is_said(folder: Path) -> None:
    call = ["signatures", str(folder / "lot.zarr"), "--out", str(folder / "no.zarr"), "--quiet"]
    line = hp.open_store(folder / "lot.zarr", "flightlines/raw_0")
    line.attrs = {name: value for name, value in line.attrs.items() if name != "ground"}
    hp.to_store(line, folder / "unknown.zarr", group="flightlines/raw_0")
    unknown = ["signatures", str(folder / "unknown.zarr"), *call[2:], "--regions"]
    refused = hyperpaint(*unknown, folder / "map.geojson", status=2)
    assert "--ground or --dem, or [geometry] ground" in refused.output
    sensor = hyperpaint(*call, "--regions", folder / "sensor.geojson", "--ground", "0", status=2)
    assert "location-unused" in sensor.output


@pytest.mark.slow
def test_signatures_of_a_map_are_those_of_its_line(tmp_path: Path) -> None:
    # Cars of the real fleet, a third of them with flakes, in the sun: the map is flagged as the line is, and
    # its cells are smaller than pixels, so that none is left out. Cells of their size leave out a tenth.
    collect = hp.simulate_collect(
        tmp_path / "collect", scene="rendered", lines=320, bands=40, columns=224, samples=4, seed=12
    )
    run("process", collect, "--out", tmp_path / "lot.zarr")
    for name, options in {"map": ("--gsd", 0.05), "plain": ("--gsd", 0.3, "--no-flags")}.items():
        out = tmp_path / f"{name}.zarr"
        run("orthorectify", tmp_path / "lot.zarr", "--ground", 160, "--out", out, *options)
    found = {}
    for name in ("lot", "map"):
        out = tmp_path / f"{name}_paints.zarr"
        words = ("--regions", collect.parent / "regions.geojson", "--out", out)
        run("signatures", tmp_path / f"{name}.zarr", *words)
        found[name] = xr.open_zarr(out).load()
    assert {"metallic", "pearl", "solid"} <= set(found["lot"]["finish"].values)
    assert found["map"].attrs["exclude"] == found["lot"].attrs["exclude"]
    levels = {name: library["reflectance"].mean("band").values for name, library in found.items()}
    np.testing.assert_allclose(levels["map"], levels["lot"], rtol=0.002)
    is_glint = xr.open_zarr(tmp_path / "map.zarr")["quality"] & hp.Quality.GLINT > 0
    assert is_glint.any()
    assert not (xr.open_zarr(tmp_path / "plain.zarr")["quality"] & hp.Quality.GLINT > 0).any()
