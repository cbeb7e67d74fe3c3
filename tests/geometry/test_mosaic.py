"""Several lines on one map: every cell is of the line that shows it best, and of no other."""

from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.flown_lines import GSD, HEIGHT, fly, located
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError

# --- A mosaic by a loop over cells and lines: what `hyperpaint.geometry.mosaic` must equal bit for bit


NO_DATA = 1024 | 2048


def better(rule: str, new: Any, old: Any) -> bool:
    # Tell whether a pixel is better than another; each is zenith, quality and time
    (zenith, quality, time), (zenith0, quality0, time0) = new, old
    if bool(quality & NO_DATA) != bool(quality0 & NO_DATA):
        return not quality & NO_DATA
    if rule == "newest":
        return bool(time > time0)
    if rule == "unflagged" and (quality == 0) != (quality0 == 0):
        return bool(quality == 0)
    return bool(zenith < zenith0)


def plain_mosaic(maps: dict[str, xr.Dataset], rule: str, names: list[str]) -> dict[str, np.ndarray]:
    # Return the variables of computed maps with north up, and ``flightline``, over all of them
    some = next(iter(maps.values()))
    gsd = float(some.spatial_ref.attrs["GeoTransform"].split()[1])
    corners = {}
    for name, one in maps.items():
        east, *_, north, _, _ = (float(part) for part in one.spatial_ref.attrs["GeoTransform"].split())
        corners[name] = round(-north / gsd), round(east / gsd)
    top, left = (min(corner[k] for corner in corners.values()) for k in (0, 1))
    bottom = max(corners[name][0] + one.sizes["y"] for name, one in maps.items())
    right = max(corners[name][1] + one.sizes["x"] for name, one in maps.items())
    shape = bottom - top, right - left
    out: dict[str, np.ndarray] = {"flightline": np.full(shape, -1, np.int16)}
    fills = {"quality": 1024, "line_time": np.datetime64("NaT", "ns"), "nearest_line": -1}
    for name in names:
        values = some[name].values
        out[name] = np.full((*shape, *values.shape[2:]), fills.get(name, np.nan), values.dtype)
    best: dict[tuple[int, int], Any] = {}
    for number, name in enumerate(sorted(maps)):
        one = {key: maps[name][key].values for key in {*names, "hits", "view_zenith", "quality", "line_time"}}
        for row, col in np.argwhere(one["hits"] > 0).tolist():
            at = row + corners[name][0] - top, col + corners[name][1] - left
            pixel = one["view_zenith"][row, col], int(one["quality"][row, col]), one["line_time"][row, col]
            if at not in best or better(rule, pixel, best[at]):
                best[at] = pixel
                out["flightline"][at] = number
                for key in names:
                    out[key][at] = one[key][row, col]
    return out


# --- tests


CUBE = ("along_track", "band", "cross_track")
NAMES = ["radiance", "quality", "line_time", "view_zenith", "nearest_line"]
START = np.datetime64("2021-07-20T17:10:00", "ns")


def flown_line(
    number: int, heading: float, shift: tuple[float, float], *, lines: int = 90, chunk: int | None = 32
) -> xr.Dataset:
    # Return a located line of random spectra, with flags, its own place, and its own time
    flown = fly(lines, 50, "rough", heading=heading, seed=number)
    rng = np.random.default_rng(number)
    flown = type(flown)(
        flown.east + shift[0], flown.north + shift[1], flown.up, flown.position, flown.attitude
    )
    cube = rng.random((lines, 4, 50)).astype(np.float32)
    line = located(flown, chunk=None, radiance=(CUBE, cube, {"units": "W m-2 sr-1 nm-1"}))
    across = np.hypot(
        flown.east - flown.position[:, :1] - shift[0], flown.north - flown.position[:, 1:2] - shift[1]
    )
    zenith = np.degrees(np.arctan2(across, HEIGHT))
    flags = rng.choice(np.uint16([0, 0, 0, 64, 128, 2048]), size=flown.east.shape)
    return line.assign(
        view_zenith=(CUBE[::2], zenith, {"units": "degree"}),
        quality=(CUBE[::2], flags),
        time=("along_track", line.time.values + np.timedelta64(100 * number, "s")),
    ).pipe(lambda one: one if chunk is None else one.chunk(along_track=chunk))


def flown_lines(**options: Any) -> dict[str, xr.Dataset]:
    # Return four: two side by side on opposite courses, one that crosses both, one that lies apart
    places = {"a": (10.0, (0.0, 0.0)), "b": (190.0, (0.21, 0.05)), "c": (95.0, (0.1, 0.0))}
    return {
        name: flown_line(number, heading, shift, **options)
        for number, (name, (heading, shift)) in enumerate(places.items())
    }


def apart(**options: Any) -> xr.Dataset:
    return flown_line(7, 45.0, (40 * GSD, -3.0), lines=300, **options)


@pytest.mark.parametrize("rule", ["nadir", "unflagged", "newest"])
def test_it_is_what_a_loop_over_cells_finds(rule: Any) -> None:
    lines = flown_lines()
    made = hp.geometry.mosaic(lines, GSD, rule=rule, tile=37).compute()
    maps = {name: hp.geometry.orthorectify(line, GSD, grid="north").compute() for name, line in lines.items()}
    for name, values in plain_mosaic(maps, rule, NAMES).items():
        assert made[name].dtype == values.dtype
        np.testing.assert_array_equal(made[name].values, values, err_msg=name)
    # all three count somewhere, and many cells have a choice
    assert set(np.unique(made.flightline)) == {-1, 0, 1, 2}
    assert int((made.line_count > 1).sum()) > 1000
    # maps given, whose tiles are others, are the same
    given = hp.geometry.mosaic(maps, rule=rule, tile=64).compute()
    xr.testing.assert_identical(given[[*NAMES, "flightline", "gap"]], made[[*NAMES, "flightline", "gap"]])


@pytest.mark.parametrize("rule", ["nadir", "unflagged", "newest"])
def test_neither_order_nor_tiles_nor_chunks_change_anything(rule: Any) -> None:
    whole = hp.geometry.mosaic(flown_lines(), GSD, rule=rule).compute()
    lines = dict(reversed(flown_lines(chunk=7).items()))
    xr.testing.assert_identical(hp.geometry.mosaic(lines, GSD, rule=rule).compute(), whole)
    places = ["glt_line", "glt_sample"]
    for chunk, tile in ((None, 33), (90, 100)):
        made = hp.geometry.mosaic(flown_lines(chunk=chunk), GSD, rule=rule, tile=tile).compute()
        xr.testing.assert_identical(made.drop_vars(places), whole.drop_vars(places))
        # fractions of a line are counted from the corner of a tile, and rounded there
        xr.testing.assert_allclose(made[places], whole[places], rtol=0, atol=1e-6)


def test_a_line_elsewhere_changes_nothing() -> None:
    lines = flown_lines()
    few = hp.geometry.mosaic(lines, GSD).compute()
    many = hp.geometry.mosaic({**lines, "z": apart()}, GSD).compute()
    assert many.sizes["y"] > few.sizes["y"] + 200
    here = many.sel(x=few.x, y=few.y)
    for name in few.data_vars:
        np.testing.assert_array_equal(here[name].values, few[name].values, err_msg=str(name))
    assert (many.flightline == 3).any()


def test_it_is_lazy_and_reads_only_the_lines_of_a_tile() -> None:
    read: list[tuple[str, int]] = []
    lines = {**flown_lines(chunk=16), "z": apart(chunk=16)}
    for name, line in lines.items():

        def block(block_id: Any = None, name: str = name) -> np.ndarray:
            read.append((name, block_id[0]))
            return np.ones((16, 3, 50), np.float32)

        slabs = da.map_blocks(
            block, chunks=((16,) * 19, (3,), (50,)), dtype=np.float32, meta=np.empty((0, 0, 0), "f4")
        )
        lines[name] = line.assign(radiance=(CUBE, slabs[: line.sizes["along_track"]], line.radiance.attrs))
    made = hp.geometry.mosaic(lines, GSD, tile=32)
    assert not read
    assert all(dask.is_dask_collection(part.data) for part in made.data_vars.values())
    made.radiance[-32:].compute(scheduler="sync")
    assert {name for name, _ in read} == {"z"}
    assert {slab for _, slab in read} <= set(range(9))


def test_what_a_cell_is_of_is_said() -> None:
    made = hp.geometry.mosaic(flown_lines(), GSD)
    assert made.flightline.attrs["flag_meanings"] == "a b c"
    assert made.flightline.attrs["flag_values"].tolist() == [0, 1, 2]
    assert (made.attrs["flightlines"], made.attrs["mosaic_rule"]) == (["a", "b", "c"], "nadir")
    computed = made.compute()
    is_shown = computed.flightline >= 0
    assert (np.isfinite(computed.view_zenith) == is_shown).all()
    assert ((computed.gap & is_shown).any(), ((computed.line_count > 0) == is_shown).all()) == (False, True)
    assert (computed.quality.values[~is_shown.values] == 1024).all()


def test_what_does_not_fit_is_refused() -> None:
    lines = flown_lines()
    make, second = hp.geometry.mosaic, lines["b"]
    best: Any = "best"
    elsewhere = second.assign_coords(east=second.east.assign_attrs(crs="EPSG:32618"))
    maps = {name: hp.geometry.orthorectify(line, GSD, grid="north") for name, line in lines.items()}
    coarse = hp.geometry.orthorectify(second, 1.5 * GSD, grid="north")
    turned = hp.geometry.orthorectify(second, GSD, grid="flight")
    # grids may be a thousandth of a cell apart
    east, *rest = map(float, maps["b"].spatial_ref.attrs["GeoTransform"].split())
    near, far = (
        maps["b"].assign_coords(
            spatial_ref=maps["b"].spatial_ref.assign_attrs(
                GeoTransform=" ".join(map(repr, (east + cells * GSD, *rest)))
            )
        )
        for cells in (0.7e-3, 1.4e-3)
    )
    assert make({**maps, "b": near}).sizes["x"] > 0
    counts = {**lines, "b": second.assign(radiance=second.radiance.assign_attrs(units="mW"))}
    expect_refusals(
        (SchemaError, ("choice-unknown", "value-out-of-range"), lambda: make(lines, -1.0, rule=best)),
        (SchemaError, "type-wrong", lambda: make({})),
        (SchemaError, "variable-missing", "a, b, c lack", lambda: make(lines, variables=["quality"])),
        (
            SchemaError,
            "variable-missing",
            "b has",
            lambda: make({**lines, "b": second.drop_vars("view_zenith")}),
        ),
        (SchemaError, "crs-conflict", "a: EPSG:32617", lambda: make({**lines, "b": elsewhere})),
        (SchemaError, "grid-mismatch", lambda: make({**maps, "b": coarse})),
        (SchemaError, "grid-mismatch", lambda: make({**maps, "b": far})),
        (SchemaError, ("crs-conflict", "grid-turned"), lambda: make({**maps, "b": turned})),
        (
            SchemaError,
            "variable-mismatch",
            "mW",
            lambda: make(counts, variables=["radiance", "view_zenith"]),
        ),
    )


def test_seamlines_enclose_the_cells_of_each_line() -> None:
    features = pytest.importorskip("rasterio.features")
    made = hp.geometry.mosaic(flown_lines(), GSD).compute()
    areas = hp.geometry.seamlines(made)
    assert [area["properties"]["flightline"] for area in areas["features"]] == ["a", "b", "c"]
    assert areas["crs"]["properties"]["name"] == "EPSG:32617"
    east, a, b, north, c, d = (float(part) for part in made.spatial_ref.attrs["GeoTransform"].split())
    burnt = features.rasterize(
        [(area["geometry"], number) for number, area in enumerate(areas["features"])],
        made.flightline.shape, fill=-1, transform=(a, b, east, c, d, north), dtype="int16",
    )  # fmt: skip
    np.testing.assert_array_equal(burnt, made.flightline.values)
    expect_refusals(
        (SchemaError, "variable-missing", lambda: hp.geometry.seamlines(made.drop_vars("flightline")))
    )


def test_levelling_finds_the_gains_of_lines() -> None:
    # Lines over one smooth ground, each with gains of its own; flagged pixels and some others are astray
    rng = np.random.default_rng(3)
    gains = {name: rng.uniform(0.8, 1.25, 4) for name in ("a", "b", "c", "z")}
    lines = {**flown_lines(), "z": apart()}
    for name, line in lines.items():
        waves = np.sin(9.0 * (line.east.values - 5e5)) * np.cos(8.0 * (line.north.values - 3.76e6))
        ground = 1.0 + 0.3 * waves
        astray = (line.quality.values != 0) | (rng.random(ground.shape) < 0.05)
        cube = ground[:, None] * gains[name][:, None] * np.where(astray, 3.0, 1.0)[:, None]
        lines[name] = line.assign(radiance=(CUBE, cube.astype(np.float32), line.radiance.attrs))
    plain = hp.geometry.mosaic(lines, GSD).compute()
    made = hp.geometry.mosaic(lines, GSD, levelling="overlap").compute()
    assert (plain.attrs["levelling"], made.attrs["levelling"]) == ("none", "overlap")
    assert "levelling_factor" not in plain
    factor = {name: made.levelling_factor.sel(source=name).values for name in "abcz"}
    level = np.array([factor[name] * gains[name] for name in "abc"])
    np.testing.assert_allclose(level, level.mean(axis=0, keepdims=True).repeat(3, 0), rtol=0.005)
    # the mean of lines that hang together stays, and a line apart is as it was
    np.testing.assert_allclose(sum(np.log(factor[name]) for name in "abc"), 0.0, atol=1e-5)
    assert (factor["z"] == 1.0).all()
    for number, name in enumerate("abcz"):
        cells = plain.flightline.values == number
        np.testing.assert_array_equal(
            made.radiance.values[cells], plain.radiance.values[cells] * factor[name]
        )
    expect_refusals(
        (
            SchemaError,
            "overlap-missing",
            lambda: hp.geometry.mosaic({"a": lines["a"], "z": lines["z"]}, GSD, levelling="overlap"),
        )
    )


def test_a_band_without_overlap_is_levelled_as_its_neighbours() -> None:
    # A band that one line lacks: no step in the spectra of either
    waves = np.array([450.0, 500.0, 700.0, 750.0])
    lines = {name: line for name, line in flown_lines().items() if name != "c"}
    for name, gains in (("a", [0.9, 0.9, 0.9, 0.9]), ("b", [1.2, 1.2, 1.5, 1.5])):
        cube = np.ones((90, 4, 50)) * np.array(gains)[:, None]
        line = lines[name].assign(quality=(CUBE[::2], np.zeros((90, 50), np.uint16)))
        lines[name] = line.assign(radiance=(CUBE, cube.astype(np.float32), line.radiance.attrs))
        lines[name] = lines[name].assign_coords(wavelength=("band", waves, {"units": "nm"}))
    whole = hp.geometry.mosaic(lines, GSD, levelling="overlap").compute()
    assert "interpolated_bands" not in whole.levelling_factor.attrs
    values = lines["b"].radiance.values.copy()
    values[:, 1] = np.nan  # between two bands
    values[:, 3] = -0.01  # beyond the last
    holed = lines | {"b": lines["b"].assign(radiance=(CUBE, values, lines["b"].radiance.attrs))}
    made = hp.geometry.mosaic(holed, GSD, levelling="overlap").compute()
    factor, expected = made.levelling_factor, whole.levelling_factor
    np.testing.assert_array_equal(factor[:, [0, 2]], expected[:, [0, 2]])
    share = (500.0 - 450.0) / (700.0 - 450.0)
    between = np.exp((1 - share) * np.log(expected[:, 0]) + share * np.log(expected[:, 2]))
    np.testing.assert_allclose(factor[:, 1], between, rtol=1e-6)
    np.testing.assert_array_equal(factor[:, 3], expected[:, 2])
    assert factor.attrs["interpolated_bands"] == "a: 1, 3; b: 1, 3"
