"""Maps of flown lines, against where the pixels are known to lie."""

import tracemalloc
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter
from support.flown_lines import GSD, MAP, Flown, fly, hills, located, nearest_by_distance
from support.refusals import expect_refusals
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError
from hyperpaint.geometry.georeference.locating import angles_of, crs_of, is_in_metres, quaternions
from hyperpaint.regions import Region, Regions, pixels

CUBE = ("along_track", "band", "cross_track")
OFF = int(hp.Quality.OFF_SWATH)


def centres(made: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    # Return where cells lie, by GDAL's transform alone
    c, a, b, f, d, e = map(float, made.spatial_ref.attrs["GeoTransform"].split())
    row, col = np.meshgrid(np.arange(made.sizes["y"]) + 0.5, np.arange(made.sizes["x"]) + 0.5, indexing="ij")
    return c + a * col + b * row, f + d * col + e * row


def away(made: xr.Dataset) -> np.ndarray:
    # Return how far what cells got lies from them [pixel]
    east, north = centres(made)
    there = made.there.values
    return np.hypot(there[..., 0] - east, there[..., 1] - north) / made.attrs["gsd"]


@pytest.mark.parametrize("grid", ["flight", "north"])
@pytest.mark.parametrize("ground", [None, hills], ids=["plane", "dem"])
@pytest.mark.parametrize("wobble", ["calm", "rough"])
def test_coordinates_come_back(wobble: str, ground: Any, grid: Any) -> None:
    flown = fly(300, 120, wobble, heading=37.0, ground=ground)
    # bands of east and north
    line = located(flown, there=(CUBE, np.stack([flown.east, flown.north], axis=1)))
    made = hp.geometry.orthorectify(line, grid=grid, variables="there", method="bilinear").compute()
    error = away(made)
    shown = np.isfinite(made.glt_line.values)
    assert (np.isfinite(error) == shown).all()
    assert shown.mean() > 0.25
    assert error[shown].max() <= 1e-3
    nearest = hp.geometry.orthorectify(line, grid=grid, variables="there").compute()
    exact, _ = nearest_by_distance(flown, *(part[shown] for part in centres(nearest)))
    exact_rms = np.sqrt((exact**2).mean()) / made.attrs["gsd"]
    assert np.sqrt((away(nearest)[shown] ** 2).mean()) <= 1.10 * exact_rms
    report = hp.geometry.map_report(made)
    assert report["covered"] == shown.sum()
    # beyond the ends of hilly lines little is left out
    assert report["gaps"] <= (0 if ground is None else 0.002 * shown.sum())


def test_a_line_without_wobble_is_its_own_map_and_which_pixel_is_chosen() -> None:
    flown = fly(40, 30, "none")
    values = np.arange(1200.0).reshape(40, 30)
    line = located(flown, chunk=None, red=(CUBE[::2], values))
    made = hp.geometry.orthorectify(line, GSD, variables=["red", "time"])
    assert made.sizes == {"y": 40, "x": 30}
    # the flight goes up
    np.testing.assert_array_equal(made.red, values[::-1])
    assert made.line_time.dtype == "datetime64[ns]"
    np.testing.assert_array_equal(made.line_time[:, 3], line.time[::-1])
    np.testing.assert_array_equal(made.nearest_line[:, 0], np.arange(40)[::-1])
    # which of several is chosen
    flown = fly(120, 30, "none")
    north = flown.north.copy()
    north[60:] = north[59::-1]  # turns round half way
    turning = located(Flown(flown.east, north, flown.up, flown.position, flown.attitude))
    first, last = (
        hp.geometry.orthorectify(turning, GSD, variables=[], multi_hit=rule, grid="north").compute().glt_line
        for rule in ("first", "last")
    )
    assert float(first.max()) <= 60
    assert float(last.min()) >= 59


@pytest.mark.parametrize("method", ["nearest", "bilinear"])
def test_neither_tiles_nor_chunks_change_anything(method: Any) -> None:
    flown = fly(150, 70, "rough", heading=200.0)
    cube = np.random.default_rng(0).random((150, 5, 70)).astype(np.float32)
    whole = None
    for chunk, tile in ((None, 256), (32, 17), (7, 64), (150, 33)):
        line = located(flown, chunk=chunk, radiance=(CUBE, cube, {"units": "W m-2 sr-1 nm-1"}))
        made = hp.geometry.orthorectify(line, grid="north", method=method, tile=tile).compute()
        if whole is None:
            whole = made
        xr.testing.assert_identical(made, whole)
    assert whole.radiance.dtype == np.float32


def test_it_is_lazy_and_reads_the_lines_it_needs() -> None:
    import dask.array as da

    read: list[int] = []

    def block(block_id: Any = None) -> np.ndarray:
        read.append(block_id[0])
        return np.ones((16, 3, 40), np.float32)

    flown = fly(320, 40, "calm")
    cube = da.map_blocks(
        block, chunks=((16,) * 20, (3,), (40,)), dtype=np.float32, meta=np.empty((0, 0, 0), "f4")
    )
    made = hp.geometry.orthorectify(
        located(flown, chunk=16).assign(radiance=(CUBE, cube, {"units": "W m-2 sr-1 nm-1"})), tile=64
    )
    assert not read
    assert all(dask.is_dask_collection(part.data) for part in made.data_vars.values())
    made.radiance[-64:].compute(scheduler="sync")
    assert read
    assert set(read) <= set(range(7))


def test_reflectance_and_map_can_be_made_in_either_order() -> None:
    # Counts on the map, with the line and column that each is of, become the reflectance of the map
    flown = fly(24, 10, "rough", heading=20.0)
    line = flight(lines=24, columns=10).line
    line["counts"] = line.counts.astype(np.uint16).assign_attrs(line.counts.attrs)
    dims = CUBE[::2]
    attrs = {"units": "m", "crs": MAP}
    line = line.assign_coords(east=(dims, flown.east, attrs), north=(dims, flown.north, attrs))
    after = hp.geometry.orthorectify(hp.reflectance(line), variables=["reflectance"]).compute()
    before = hp.geometry.orthorectify(line, variables=["counts", "time"]).compute()
    assert before.counts.dtype == np.uint16
    shown = before.nearest_line.values >= 0
    assert (before.counts.values[~shown] == 65535).all()
    # every cell becomes a line of its own, with its own time, dark but for its own column
    columns = before.nearest_sample.values[shown]
    cells = np.arange(columns.size)
    counts = np.zeros((columns.size, line.sizes["band"], 10), np.uint16)
    counts[cells, :, columns] = before.counts.values[shown]
    fake = line.drop_dims("along_track").assign(counts=(CUBE, counts, line.counts.attrs))
    fake = fake.assign_coords(time=("along_track", before.line_time.values[shown]))
    lines = before.nearest_line.values[shown]
    for name in line.variables:
        if line[name].dims == ("along_track",) and name != "time":
            fake[name] = ("along_track", line[name].values[lines], line[name].attrs)
    made = hp.reflectance(fake).reflectance.values[cells, :, columns]
    np.testing.assert_array_equal(made.view(np.uint32), after.reflectance.values[shown].view(np.uint32))
    assert np.isfinite(made).any()


def test_flags_are_joined_and_what_is_missing_does_not_leak() -> None:
    flown = fly(40, 30, "calm", heading=10.0)
    values = np.ones((40, 2, 30), np.float32)
    values[20, 1, 15] = np.nan
    line = located(flown, radiance=(CUBE, values, {"units": "W m-2 sr-1 nm-1"})).compute()
    line.quality[20, 15] = 1
    made = hp.geometry.orthorectify(line, method="bilinear").compute()
    bad = np.isnan(made.radiance.values[..., 1]) & (made.hits.values > 0)
    assert 2 <= bad.sum() <= 9
    assert (made.quality.values[bad] == 1).all()
    assert (made.radiance.values[bad, 0] == 1.0).all()
    assert ((made.quality.values == OFF) == (made.hits.values == 0)).all()
    one = hp.geometry.orthorectify(line).compute()
    assert (
        (one.quality.values == 1) == (np.isnan(one.radiance.values[..., 1]) & (one.hits.values > 0))
    ).all()


def test_gaps_holes_and_single_pixels_are_empty_flagged_and_counted() -> None:
    flown = fly(200, 40, "none")
    lost = flown.east.copy()
    lost[80:120] = np.nan
    line = located(Flown(lost, flown.north, flown.up, flown.position, flown.attitude))
    line["red"] = line.east * 0 + 1
    made = hp.geometry.orthorectify(line, GSD, variables=["red", "quality"]).compute()
    assert made.sizes["y"] == 200
    hole = made.hits.values == 0
    assert (hole[80:120].all(), hole.sum(), (made.gap.values == hole).all()) == (True, 40 * 40, True)
    assert ((made.quality.values[hole] == OFF).all(), np.isnan(made.red.values[hole]).all()) == (True, True)
    assert hp.geometry.map_report(made) == {
        "cells": 8000,
        "covered": 6400,
        "gaps": 1600,
        "multiple": 0,
        "most_hits": 1,
    }
    # the same frames never recorded: lines follow one another, far apart
    made = hp.geometry.orthorectify(
        line.isel(along_track=np.r_[0:80, 120:200]).chunk(along_track=32), GSD, variables=["red"]
    ).compute()
    assert (made.hits.values == 0).sum() == 40 * 40
    # holes and single pixels
    flown = fly(60, 40, "rough")
    lost = flown.east.copy()
    lost[10:20, 5:12] = np.nan
    lost[40, 7] = np.nan
    made = hp.geometry.orthorectify(
        located(Flown(lost, flown.north, flown.up, flown.position, flown.attitude)), variables=["quality"]
    ).compute()
    filled = hp.geometry.orthorectify(located(flown), made.attrs["gsd"], variables=["quality"]).compute()
    assert hp.geometry.map_report(made)["covered"] < hp.geometry.map_report(filled)["covered"]
    assert not (made.quality.values[made.hits.values > 0] & OFF).any()


def test_bounds_make_one_grid_for_several_lines() -> None:
    bounds = (500_000.0, 3_760_000.0, 500_000.4, 3_760_000.3)
    maps = [
        hp.geometry.orthorectify(
            located(fly(80, 40, seed=k)), 0.01, grid="north", bounds=bounds, variables=["quality"]
        )
        for k in (1, 2)
    ]
    assert maps[0].sizes == {"y": 30, "x": 40}
    np.testing.assert_array_equal(maps[0].x, maps[1].x)
    np.testing.assert_allclose(maps[0].x[0], 500_000.005)
    np.testing.assert_allclose(maps[0].y[0], 3_760_000.295)
    along = {"grid": "flight", "variables": ["quality"]}
    whole = hp.geometry.orthorectify(located(fly(80, 40, seed=1)), 0.01, **along)
    part = hp.geometry.orthorectify(located(fly(80, 40, seed=1)), 0.01, **along, bounds=bounds)
    east, north = centres(part)
    np.testing.assert_allclose(part.east, east, atol=1e-7)
    np.testing.assert_allclose(part.north, north, atol=1e-7)
    assert part.sizes["y"] < whole.sizes["y"]
    for gsd, far in ((0.01, (0.0, 0.0, 0.3, 0.3)), (100.0, None)):
        with pytest.warns(hp.errors.PaintWarning, match="map-empty"):
            hp.geometry.orthorectify(located(fly(80, 40, seed=1)), gsd, variables=["quality"], bounds=far)


@pytest.mark.parametrize("order", ["sensor", "map"])
def test_regions_of_the_map_are_pixels_of_the_line(order: str) -> None:
    flown = fly(60, 40, "calm", heading=70.0)
    values = np.random.default_rng(3).random((60, 6, 40)).astype(np.float32)
    line = located(flown, reflectance=(CUBE, values, {"units": "1"}))
    line = line.assign_coords(wavelength=("band", np.linspace(450.0, 700.0, 6), {"units": "nm"}))
    low, high, left, right = 20, 33, 11, 25
    sensor = hp.Region("hood", [(left, low), (right, low), (right, high), (left, high)])
    # the outline of these pixels on the ground, half a pixel around their centres
    corners = [
        tuple(part[i : i + 2, j : j + 2].mean() for part in (flown.east, flown.north))
        for i, j in [(low - 1, left - 1), (low - 1, right), (high, right), (high, left - 1)]
    ]
    along = [(low - 1, j) for j in range(left - 1, right + 1)] + [(i, right) for i in range(low, high + 1)]
    along += [(high, j) for j in range(right - 1, left - 2, -1)] + [
        (i, left - 1) for i in range(high - 1, low - 1, -1)
    ]
    corners = [
        tuple(part[i : i + 2, j : j + 2].mean() for part in (flown.east, flown.north)) for i, j in along
    ]
    regions = hp.Regions((hp.Region("hood", corners),), "map", MAP)
    if order == "map":  # drawn in degrees
        to_degrees = pytest.importorskip("pyproj").Transformer.from_crs(MAP, "OGC:CRS84", always_xy=True)
        regions = hp.Regions(
            (hp.Region("hood", [to_degrees.transform(*xy) for xy in corners]),), "map", "OGC:CRS84"
        )
    on_map = line.paint.signatures(regions)
    on_sensor = line.paint.signatures(hp.Regions((sensor,)))
    assert int(on_map.n[0]) == (high - low + 1) * (right - left + 1)
    for name in ("reflectance", "reflectance_sd", "member_reflectance", "n"):
        np.testing.assert_array_equal(on_map[name].values, on_sensor[name].values)


def test_what_comes_along() -> None:
    flown = fly(40, 20, "calm")
    line = located(flown, radiance=(CUBE, np.ones((40, 3, 20), np.float32), {"units": "W m-2 sr-1 nm-1"}))
    line = line.assign_coords(wavelength=("band", [500.0, 600.0, 700.0], {"units": "nm"}))
    line = line.assign(roll=("along_track", flown.attitude[:, 0]), look=("cross_track", np.arange(20.0)))
    made = hp.geometry.orthorectify(line)
    assert set(made.data_vars) == {
        "radiance", "quality", "line_time", "hits", "gap",
        "glt_line", "glt_sample", "nearest_line", "nearest_sample",
    }  # fmt: skip
    assert made.radiance.attrs["units"] == "W m-2 sr-1 nm-1"
    assert made.radiance.attrs["grid_mapping"] == "spatial_ref"
    np.testing.assert_array_equal(made.wavelength, line.wavelength)
    asked = hp.geometry.orthorectify(line, variables=["roll", "look"]).compute()
    shown = asked.nearest_line.values >= 0
    np.testing.assert_array_equal(
        asked["roll"].values[shown], line["roll"].values[asked.nearest_line.values[shown]]
    )
    np.testing.assert_array_equal(asked["look"].values[shown], asked.nearest_sample.values[shown])
    # progress is told
    told: list[tuple[int, int]] = []
    hp.geometry.orthorectify(
        located(fly(100, 10)), variables=[], progress=lambda done, of: told.append((done, of))
    )
    assert told[-1] == (4, 4)


def test_what_cannot_be_mapped_is_named_at_once() -> None:
    line = located(fly(20, 10))
    make = hp.geometry.orthorectify
    wrong: dict[str, Any] = {"grid": "up", "method": "cubic", "multi_hit": "best", "tile": 0}
    codes = ("choice-unknown",) * 3 + ("value-out-of-range",) * 2 + ("bounds-invalid",)
    lamp, unseen = line.assign(lamp=1.0), line.assign_coords(east=line.east * np.nan)
    odd = {f"odd_{kind}": (CUBE[::2], np.zeros((20, 10), kind)) for kind in ("c8", "U3", "m8[ns]")}
    expect_refusals(
        (SchemaError, codes, lambda: make(line, -1, bounds=(1, 1, 0, 0), **wrong)),
        (SchemaError, ("variable-missing", "dim-missing"), lambda: make(lamp, variables=["paint", "lamp"])),
        (SchemaError, "option-conflict", lambda: make(line, ground=0.0)),
        (SchemaError, "ground-not-seen", lambda: make(unseen, variables=[])),
        (SchemaError, "line-too-short", lambda: make(line.isel(cross_track=[0]), variables=[])),
        (SchemaError, "map-too-large", lambda: make(line, 1e-7, variables=[])),
        (SchemaError, "variable-missing", lambda: hp.geometry.map_report(line)),
        (SchemaError, ("type-wrong",) * 3, lambda: make(line.assign(odd), variables=list(odd))),
    )
    # too many tiles are counted before they are made
    tracemalloc.start()
    expect_refusals((SchemaError, "map-too-large", lambda: make(line, GSD / 40.0, tile=1, variables=[])))
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("method", ["nearest", "bilinear"])
@pytest.mark.parametrize("dtype", [">f4", ">f8", "f2", ">u2", ">i4"])
def test_foreign_types_become_native_ones(dtype: str, method: Any, lazy: bool) -> None:
    flown = fly(20, 12, "none")
    cube = np.random.default_rng(3).integers(0, 99, (20, 3, 12))
    native = "f4" if dtype == "f2" else dtype[1:]
    line = located(flown, chunk=None)
    maps = []
    for kind in (dtype, native):
        given = line.assign(there=(CUBE, cube.astype(kind))).assign_coords(
            mark=(CUBE[::2], cube[:, 0].astype(kind))
        )
        given = given.chunk(along_track=7) if lazy else given
        maps.append(hp.geometry.orthorectify(given, variables=["there", "mark"], method=method))
    for name in ("there", "mark"):
        assert maps[0][name].dtype.str == maps[1][name].dtype.str
        assert maps[0][name].compute().dtype.isnative
        np.testing.assert_array_equal(maps[0][name], maps[1][name])


def test_places_that_are_kept_have_the_bits_of_those_that_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    line = located(fly(100, 10)).chunk(along_track=32)
    for grid in ("north", "flight"):
        kept = hp.geometry.orthorectify(line, grid=grid, variables=["quality"]).compute()
        with monkeypatch.context() as patched:
            patched.setattr("hyperpaint.geometry.orthorectification.mapping._MAX_KEPT_BYTES", 0)
            again = hp.geometry.orthorectify(line, grid=grid, variables=["quality"]).compute()
        xr.testing.assert_identical(kept, again)


# --- A crop of a flight line keeps its numbers: on its map they are the places of the whole line


PLACES = ("nearest_line", "nearest_sample", "glt_line", "glt_sample")


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    flown = fly(120, 50, "calm", heading=30.0)
    values = np.random.default_rng(2).random((120, 3, 50)).astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"}))
    return line.assign_coords(
        wavelength=("band", [450.0, 550.0, 650.0], {"units": "nm"}),
        along_track=np.arange(120), cross_track=np.arange(50),
    )  # fmt: skip


CROP = {"along_track": slice(33, 110), "cross_track": slice(7, 41)}


@pytest.mark.parametrize("grid", ["north", "flight"])
def test_places_on_the_map_of_a_crop_are_those_of_the_whole_line(line: xr.Dataset, grid: Any) -> None:
    crop = line.isel(CROP)
    numbered = hp.geometry.orthorectify(crop, GSD, grid=grid).compute()
    plain = hp.geometry.orthorectify(crop.drop_vars(["along_track", "cross_track"]), GSD, grid=grid).compute()
    for name in PLACES:
        first = 33 if name.endswith("line") else 7
        assert numbered[name].dtype == plain[name].dtype
        shown = plain[name].values >= 0
        assert shown.mean() > 0.3
        np.testing.assert_allclose(
            numbered[name].values[shown], plain[name].values[shown] + first, rtol=1e-13
        )
        np.testing.assert_array_equal(numbered[name].values[~shown], plain[name].values[~shown])
    np.testing.assert_array_equal(numbered.reflectance, plain.reflectance)


def test_numbers_of_averaged_lines_name_no_pixel_and_positions_stay(line: xr.Dataset) -> None:
    thin = line.isel(along_track=slice(0, 120, 2))
    halves = thin.assign_coords(along_track=thin.along_track + 0.5)
    made, half, plain = (
        hp.geometry.orthorectify(one, GSD).nearest_line.values
        for one in (thin, halves, thin.drop_vars("along_track"))
    )
    np.testing.assert_array_equal(made[plain >= 0], 2 * plain[plain >= 0])
    np.testing.assert_array_equal(half, plain)


def test_a_region_of_the_whole_line_gives_its_pixels_on_the_map_of_a_crop(line: xr.Dataset) -> None:
    regions = Regions((Region("hood", [(10.5, 40.5), (35.5, 42.5), (30.5, 90.5), (12.5, 80.5)]),))
    orthomap = hp.geometry.orthorectify(line.isel(CROP), GSD / 2)
    row, col = pixels(regions[0], orthomap)
    shown = {
        (int(a), int(c))
        for a, c in zip(
            orthomap.nearest_line.values[row, col], orthomap.nearest_sample.values[row, col], strict=True
        )
    }
    along, across = pixels(regions[0], line)
    wanted = set(zip(along.tolist(), across.tolist(), strict=True))
    assert shown <= wanted
    assert len(shown) >= 0.98 * len(wanted)
    library, direct = (
        hp.extract_signatures(one, regions, exclude=0, members=10**6) for one in (orthomap, line)
    )
    members = [
        set(
            zip(
                *(one[f"member_{dim}"].values[0].tolist() for dim in ("along_track", "cross_track")),
                strict=True,
            )
        )
        for one in (library, direct)
    ]
    assert members == [shown, wanted]


def test_tie_points_in_a_crop_are_positions_in_it() -> None:
    flown = fly(220, 160, "none")
    grey = gaussian_filter(np.random.default_rng(3).random((220, 160)), 2.0)[:, None].astype(np.float32)
    line = located(flown, reflectance=(("along_track", "band", "cross_track"), grey, {"units": "1"}))
    heights = ("along_track", "cross_track"), np.zeros((220, 160)), {"units": "m"}
    whole = line.assign_coords(ground_height=heights)
    crop = whole.assign_coords(along_track=np.arange(220)).isel(along_track=slice(20, 220))
    numbered, plain = (
        hp.geometry.find_tie_points({"a": whole, "b": one}, GSD)
        for one in (crop, crop.drop_vars("along_track"))
    )
    xr.testing.assert_equal(numbered, plain)
    assert np.median(numbered.along_track_pixel.values @ [1.0, -1.0]) == pytest.approx(20.0, abs=0.05)


# --- angles a hair below north, and maps whose axes point elsewhere -----------------------------------------


pytest.importorskip("pyproj")


def test_headings_stay_below_360_and_maps_are_in_metres_east_and_north() -> None:
    assert Convention().canonical(0.0, 0.0, -1e-20)[2] == angles_of(quaternions(0.0, 0.0, -1e-20))[2] == 0.0
    # the first has axes west and south, the third is in feet; the last two go to the south, from a pole
    crs = ("EPSG:2053", "EPSG:4326", "EPSG:2225", "EPSG:32617", "EPSG:3413", "EPSG:3031")
    assert [is_in_metres(crs_of(each)) for each in crs] == [False] * 3 + [True] * 3
