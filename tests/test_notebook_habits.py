"""Ninety things that people do in a notebook, done to lines, libraries and stores.

Choosing, statistics and joining are done to a simulated line and to one that `hyperpaint.process` wrote;
`test_ordinary_tools` has others.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, refusal

import hyperpaint as hp
from hyperpaint.simulation import simulate_collect, simulate_line

pytestmark = pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::PendingDeprecationWarning"
)
LINES, BANDS, COLUMNS = 48, 20, 12


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    # Return what lies on a user's desk: a line in memory and in a store, a library, a collect
    folder = tmp_path_factory.mktemp("desk")
    line = simulate_line(lines=LINES, bands=BANDS, columns=COLUMNS).paint.reflectance().compute()
    store = hp.to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    hp.to_store(line.isel(along_track=slice(0, 32)), store, "flightlines/raw_1")
    flown = simulate_collect(folder / "flown", scene="plan", lines=LINES, bands=BANDS, columns=COLUMNS)
    processed = xr.open_zarr(hp.process(flown, folder / "flown.zarr"), group="flightlines/raw_0")
    regions = hp.Regions(
        tuple(
            hp.Region(f"paint {k}", [(1, 10 * k + 1), (9, 10 * k + 1), (9, 10 * k + 7), (1, 10 * k + 7)])
            for k in range(3)
        )
    )
    with np.errstate(all="ignore"):
        library = hp.extract_signatures(line, regions, exclude=0)
    return SimpleNamespace(
        folder=folder, line=line, store=store, library=library, regions=regions,
        lazy=xr.open_zarr(store, group="flightlines/raw_0"),
        processed=processed,
        collect=simulate_collect(folder / "collect", scene="plan", lines=40, bands=4, columns=6, cubes=2),
    )  # fmt: skip


def same(first: Any, second: Any) -> None:
    np.testing.assert_allclose(np.asarray(first), np.asarray(second), rtol=1e-6)


Habit = Callable[[SimpleNamespace], Any]


ROWS, PIXELS = xr.DataArray([1, 5, 9], dims="pixel"), xr.DataArray([0, 2, 4], dims="pixel")
AREA = (LINES, COLUMNS)
HABITS: dict[str, Habit] = {}


@pytest.fixture(params=["simulated", "processed"])
def line(desk: SimpleNamespace, request: pytest.FixtureRequest) -> xr.Dataset:
    return {"simulated": desk.line, "processed": desk.processed.compute()}[request.param]


def habit(function: Habit) -> Habit:
    HABITS[function.__name__] = function
    return function


# --- one expression: its value, or another one of the same values -------------------------------------------


def numbers(array: Any) -> list[float]:
    found: list[float] = np.asarray(array).tolist()
    return found


def by_wavelength(line: xr.Dataset) -> xr.DataArray:
    return line.reflectance.swap_dims(band="wavelength")


#: What is asked of a line, and the answer.
VALUES: dict[str, tuple[Callable[[xr.Dataset], Any], Any]] = {
    # choosing
    "sel a slice includes its end": (
        lambda line: line.quality.sel(along_track=slice(10, 20), cross_track=slice(2, 5)).shape, (11, 4),
    ),
    "sel the nearest": (lambda line: int(line.sel(along_track=7.4, method="nearest").along_track), 7),
    "isel pixels by arrays": (
        lambda line: line.reflectance.isel(along_track=ROWS, cross_track=PIXELS).dims, ("pixel", "band"),
    ),
    "where flags are not set": (
        lambda line: set(line.reflectance.where(line.quality == 0).dims),
        {"along_track", "band", "cross_track"},
    ),
    "where drops what is empty": (
        lambda line: numbers(line.where(line.along_track < 5, drop=True).along_track), [0, 1, 2, 3, 4],
    ),
    "query": (lambda line: line.query(along_track="along_track > 40").sizes["along_track"], LINES - 41),
    "thin": (lambda line: numbers(line.thin(along_track=4).along_track[:3]), [0, 4, 8]),
    "tail": (lambda line: int(line.tail(along_track=1).along_track[0]), LINES - 1),
    "a crop of a crop keeps its place": (
        lambda line: numbers(
            line.isel(along_track=slice(10, None)).isel(along_track=slice(5, 9)).along_track
        ),
        [15, 16, 17, 18],
    ),
    "slices of wavelength": (
        lambda line: bool(
            (abs(by_wavelength(line).sel(wavelength=slice(600, 700)).wavelength - 650) <= 50).all()
        ),
        True,
    ),
    # statistics
    "mean of an area": (
        lambda line: line.reflectance.mean(["along_track", "cross_track"]).sizes, {"band": BANDS},
    ),
    "coarsen lines": (
        lambda line: numbers(line.reflectance.coarsen(along_track=4, cross_track=3).mean().along_track[:2]),
        [1.5, 5.5],
    ),
    "rolling mean of lines": (
        lambda line: line.reflectance.rolling(along_track=5, center=True).mean().sizes["along_track"], LINES,
    ),
    "rolling over bands": (
        lambda line: line.reflectance.rolling(band=3, center=True).mean().sizes["band"], BANDS,
    ),
    "resample in time": (
        lambda line: (
            line.reflectance.swap_dims(along_track="time").resample(time="100ms").mean().sizes["time"]
        ),
        4,
    ),
    "resample the irradiance": (
        lambda line: line.irradiance.resample(irradiance_time="4s").mean().sizes["irradiance_time"] >= 2,
        True,
    ),
    "groupby bins of wavelength": (
        lambda line: (
            line.reflectance.groupby_bins("wavelength", [400, 500, 600, 700])
            .mean("band").sizes["wavelength_bins"]
        ),
        3,
    ),
    "groupby bins of lines": (
        lambda line: (
            line.reflectance.groupby_bins("along_track", 4).mean("along_track").sizes["along_track_bins"]
        ),
        4,
    ),
    "quantiles": (
        lambda line: line.reflectance.quantile([0.1, 0.9], "along_track").sizes["quantile"], 2,
    ),
    "derivative over wavelength": (
        lambda line: line.reflectance.differentiate("wavelength").shape == line.reflectance.shape, True,
    ),
    "integrate over wavelength": (
        lambda line: line.reflectance.fillna(0).integrate("wavelength").shape, AREA,
    ),
    "ratios of bands": (lambda line: index_of(line).shape, AREA),
    "angles between pixels": (
        lambda line: xr.dot(
            line.reflectance.fillna(0),
            line.reflectance.isel(along_track=0, cross_track=0, drop=True).fillna(0),
            dim="band",
        ).shape,
        AREA,
    ),
    # joining
    "merge products of a line": (
        lambda line: {"before", "counts"} <= set(
            xr.merge(
                [line, line[["reflectance"]].rename(reflectance="before")], compat="override"
            ).data_vars
        ),
        True,
    ),
    "bands have no number that joins two cameras": (lambda line: "band" in line.coords, False),
}  # fmt: skip

#: What has the same values.
SAME: dict[str, tuple[Callable[[xr.Dataset], Any], Callable[[xr.Dataset], Any]]] = {
    "sel a line by its number": (
        lambda line: line.sel(along_track=7).reflectance, lambda line: line.isel(along_track=7).reflectance,
    ),
    "sel in a crop": (
        lambda line: line.isel(along_track=slice(15, 19)).sel(along_track=16).reflectance,
        lambda line: line.isel(along_track=16).reflectance,
    ),
    "sel pixels by arrays": (
        lambda line: line.reflectance.sel(along_track=ROWS, cross_track=PIXELS),
        lambda line: line.reflectance.isel(along_track=ROWS, cross_track=PIXELS),
    ),
    "swap dims to wavelength": (
        lambda line: by_wavelength(line).sel(wavelength=550, method="nearest"),
        lambda line: line.paint.at(550.0).reflectance,
    ),
    "interp between lines": (
        lambda line: line.reflectance.interp(along_track=[3.5]).isel(along_track=0),
        lambda line: line.reflectance.isel(along_track=[3, 4]).mean("along_track", skipna=False),
    ),
    "weighted mean of lines": (
        lambda line: line.reflectance.weighted(xr.ones_like(line.along_track, float)).mean("along_track"),
        lambda line: line.reflectance.mean("along_track"),
    ),
    "groupby columns": (
        lambda line: (
            line.reflectance.groupby("cross_track").mean("along_track").transpose("band", "cross_track")
        ),
        lambda line: line.reflectance.mean("along_track").transpose("band", "cross_track"),
    ),
    "idxmax gives the line": (
        lambda line: line.reflectance.isel(band=3, cross_track=2).idxmax("along_track"),
        lambda line: line.reflectance.isel(band=3, cross_track=2).argmax("along_track"),
    ),
    "concat two crops": (
        lambda line: xr.concat(
            [line.isel(along_track=slice(0, 20)), line.isel(along_track=slice(20, None))],
            "along_track", data_vars="minimal", coords="minimal", compat="override",
        ).pipe(lambda both: both.reflectance + both.along_track),
        lambda line: line.reflectance + line.along_track,
    ),
    "combine crops in any order": (
        lambda line: xr.combine_by_coords(
            [line[["reflectance"]].isel(along_track=slice(*part)) for part in ((20, None), (0, 20))],
            combine_attrs="override",
        ).reflectance,
        lambda line: line.reflectance,
    ),
    "the difference of a crop is where it belongs": (
        lambda line: (line.reflectance.isel(along_track=slice(10, 20)) - line.reflectance).fillna(0),
        lambda line: 0 * line.reflectance.sel(along_track=range(10, 20)).fillna(0),
    ),
    "stack pixels and back": (
        lambda line: (
            line.reflectance.stack(pixel=("along_track", "cross_track"))
            .unstack("pixel").transpose(*line.reflectance.dims)
        ),
        lambda line: line.reflectance,
    ),
}  # fmt: skip


def index_of(line: xr.Dataset) -> xr.DataArray:
    nir, red = (line.paint.at(nm).reflectance for nm in (800.0, 670.0))
    return (nir - red) / (nir + red)


@pytest.mark.parametrize("name", VALUES)
def test_a_value_of_a_line(name: str, line: xr.Dataset) -> None:
    ask, expected = VALUES[name]
    assert ask(line) == expected


@pytest.mark.parametrize("name", SAME)
def test_two_ways_to_the_same_values(name: str, line: xr.Dataset) -> None:
    first, second = SAME[name]
    same(first(line), second(line))


def test_more_of_a_line(line: xr.Dataset, desk: SimpleNamespace) -> None:
    # interpolated values lie between those of the line
    at = by_wavelength(line).interp(wavelength=[500.0, 550.0])
    assert (at.isnull() | (at >= line.reflectance.min()) & (at <= line.reflectance.max())).all()
    # weights count where there are values
    weights = line.wavelength.fillna(0.0)
    mean = line.reflectance.weighted(weights).mean("band")
    own = (line.reflectance * weights).sum("band") / weights.where(line.reflectance.notnull()).sum("band")
    np.testing.assert_allclose(mean, own.transpose(*mean.dims), rtol=1e-5)
    mask = hp.regions.region_mask(desk.regions, line)
    assert numbers(line.reflectance.groupby(mask.rename("region")).mean().region) == [-1, 0, 1, 2]
    # signatures of a crop are those of the line
    crop = line.isel(along_track=slice(8, 20), cross_track=slice(0, 11))
    of_crop, of_line = (each.paint.signatures(desk.regions[1:2], exclude=0) for each in (crop, line))
    xr.testing.assert_equal(of_crop.reflectance, of_line.reflectance)
    inside = of_crop.member_along_track.values[of_crop.member_along_track.values >= 0]
    assert (inside.min(), inside.max()) == (11, 17)
    # two lines have the numbers of their lines in common
    second = xr.open_zarr(desk.store, group="flightlines/raw_1").paint.reflectance()[["reflectance"]]
    both = xr.concat(
        [line[["reflectance"]], second], "line", join="inner", coords="minimal", compat="override"
    )
    assert both.sizes["along_track"] == 32
    expect_error(ValueError, "band", lambda: line.reflectance + line.reflectance.isel(band=slice(0, 5)))


# --- files -------------------------------------------------------------------------------------------------


def again(dataset: xr.Dataset, desk: SimpleNamespace, name: str) -> xr.Dataset:
    path = desk.folder / name
    dataset.to_netcdf(path, engine="h5netcdf")
    return xr.load_dataset(path, engine="h5netcdf")


@habit
def netcdf_and_plain_zarr_and_back(desk: SimpleNamespace) -> None:
    back = again(desk.line, desk, "line.nc")
    xr.testing.assert_equal(back.drop_encoding(), desk.line)
    same(back.drop_vars("reflectance").paint.reflectance().reflectance, desk.line.reflectance)
    xr.testing.assert_equal(again(desk.library, desk, "library.nc"), desk.library)
    desk.line.to_zarr(desk.folder / "plain.zarr", mode="w", consolidated=False)
    xr.testing.assert_equal(xr.open_zarr(desk.folder / "plain.zarr", consolidated=False).load(), desk.line)


@habit
def the_store_keeps_the_numbers(desk: SimpleNamespace) -> None:
    crop = desk.line.isel(along_track=slice(8, 40), cross_track=slice(3, 9))
    hp.to_store(crop, desk.folder / "crop.zarr")
    stored = hp.open_store(desk.folder / "crop.zarr")
    assert stored.along_track.values.tolist() == list(range(8, 40))
    assert isinstance(stored.indexes["cross_track"].dtype, np.dtype)


@habit
def open_the_whole_store(desk: SimpleNamespace) -> None:
    tree = hp.open_store(desk.store)
    assert (type(tree), sorted(tree["flightlines"].children)) == (xr.DataTree, ["raw_0", "raw_1"])
    same(tree["flightlines/raw_0"].to_dataset().paint.reflectance().reflectance, desk.line.reflectance)
    plain = xr.open_datatree(desk.store, engine="zarr", consolidated=False)
    assert plain["flightlines/raw_0"].sizes["along_track"] == LINES


@habit
def open_a_collect_with_xarray_alone(desk: SimpleNamespace) -> None:
    for options in ({}, {"engine": "hyperpaint"}):
        tree = xr.open_datatree(desk.collect, **options)
        xr.testing.assert_identical(tree, hp.open_collect(desk.collect))
    one = xr.open_dataset(desk.collect, group="flightlines/raw_0")
    assert one.counts.dims == ("along_track", "band", "cross_track")
    expect_error(hp.SchemaError, "flightlines/raw_0", lambda: xr.open_dataset(desk.collect))


@habit
def open_a_spectrum_with_xarray_alone(desk: SimpleNamespace) -> None:
    asd, sig = (sorted(desk.collect.parent.rglob(f"*.{ending}"))[0] for ending in ("asd", "sig"))
    xr.testing.assert_identical(xr.open_dataset(asd), hp.open_asd(asd))
    xr.testing.assert_identical(xr.open_dataset(sig), hp.open_svc(sig))
    assert "radiance" in xr.open_dataset(sig, engine="svc", quantity="radiance")
    assert "time" not in xr.open_dataset(asd, engine="asd", drop_variables="time").variables


@habit
def pickle_everything(desk: SimpleNamespace) -> None:
    for each in (desk.line, desk.lazy, desk.library, desk.lazy.paint.reflectance(), desk.regions):
        back = pickle.loads(pickle.dumps(each))
        assert back == each if each is desk.regions else back.identical(each)


@habit
def copy_deeply(desk: SimpleNamespace) -> None:
    copy.deepcopy(desk.line)["counts"][:] = 0
    assert (desk.line.counts != 0).any()


@habit
def library_as_a_table(desk: SimpleNamespace) -> None:
    frame = desk.library[["reflectance", "reflectance_sd"]].to_dataframe()
    assert len(frame) == desk.library.sizes["signature"] * BANDS
    assert desk.library.reflectance.to_pandas().shape == ((3, BANDS))
    assert desk.line[["quality"]].to_dataframe().index.names == ["along_track", "cross_track"]
    assert xr.Dataset.from_dict(desk.library.to_dict()).sizes == desk.library.sizes
    firsts = desk.library.reflectance.groupby(desk.library["signature"].str.slice(0, 5)).mean()
    assert firsts.sizes["signature"] == 1


# --- dask --------------------------------------------------------------------------------------------------


@habit
def dask_gives_the_same(desk: SimpleNamespace) -> None:
    lazy, line = desk.lazy, desk.line
    same(lazy.paint.reflectance().reflectance.persist(), line.reflectance)
    cube = lazy.paint.reflectance().unify_chunks().reflectance
    same(cube.map_blocks(lambda block: 2 * block, template=cube), 2 * line.reflectance)
    options: dict[str, Any] = {"dask": "parallelized", "output_dtypes": [np.float32]}
    mean = xr.apply_ufunc(np.nanmean, cube, input_core_dims=[["band"]], kwargs={"axis": -1}, **options)
    same(mean, line.reflectance.mean("band"))
    same(lazy.chunk(band=5, along_track=7, cross_track=4).paint.reflectance().reflectance, line.reflectance)
    # small indexes have no chunks
    assert (lazy.along_track.chunks, lazy.unify_chunks().sizes["along_track"]) == (None, LINES)


@habit
def one_cube_alone_has_the_methods_of_a_cube(desk: SimpleNamespace) -> None:
    cube = desk.line.reflectance
    xr.testing.assert_identical(cube.paint.at(550.0), desk.line.paint.at(550.0).reflectance)
    xr.testing.assert_identical(cube.paint.rgb(), desk.line.paint.rgb())
    smoothed = cube.paint.smooth(window=5)
    assert smoothed.name == "reflectance"
    same(smoothed, desk.line.paint.smooth(window=5).reflectance)
    assert (2 * cube).rename(None).paint.at([500.0, 600.0]).sizes["band"] == 2
    assert desk.line.wavelength.paint.at(550.0).name == "wavelength"
    assert cube.isel(along_track=0, cross_track=0).paint.at(550.0).ndim == 0
    expect_error(
        hp.SchemaError,
        "'reflectance' is missing",
        lambda: (
            desk.line.radiance.paint.smooth() if "radiance" in desk.line else desk.line.counts.paint.smooth()
        ),
    )


@habit
def a_tree_of_lines(desk: SimpleNamespace) -> None:
    tree = xr.DataTree.from_dict({"a": desk.line, "b": desk.line.isel(along_track=slice(0, 9))})
    done = tree.map_over_datasets(lambda node: node.paint.reflectance() if "counts" in node else node)
    assert done["b"].sizes["along_track"] == 9


# --- units, pictures, maps ---------------------------------------------------------------------------------


@habit
def quantify_and_dequantify(desk: SimpleNamespace) -> None:
    pytest.importorskip("pint_xarray")
    view = desk.line.paint.quantify()
    same((view.irradiance * 2).pint.to("mW m-2 nm-1").pint.magnitude, 2000 * desk.line.irradiance)
    same(view.pint.dequantify().paint.reflectance().reflectance, desk.line.reflectance)


@habit
def plots_of_xarray(desk: SimpleNamespace) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    assert desk.line.reflectance.isel(band=5).plot().axes.get_xlabel().startswith("Column")
    plt.close("all")
    assert len(desk.library.reflectance.plot.line(x="wavelength", hue="signature")) == 3
    desk.line.reflectance.isel(along_track=3, cross_track=[1, 5]).plot.line(x="wavelength")
    plt.close("all")
    desk.line.reflectance.isel(band=[2, 9]).plot(col="band")
    desk.line.reflectance.plot.hist()
    plt.close("all")


@habit
def plots_of_hvplot(desk: SimpleNamespace) -> None:
    pytest.importorskip("hvplot.xarray")
    place = {"x": "cross_track", "y": "along_track"}
    image = desk.line.paint.at(550.0).reflectance.hvplot.image(**place)
    slider = by_wavelength(desk.line).hvplot.image(**place, groupby="wavelength", dynamic=False)
    curves = by_wavelength(desk.library).hvplot.line(x="wavelength", by="signature")
    assert ([dim.name for dim in image.kdims], len(slider), len(curves)) == ([*place.values()], BANDS, 3)


@habit
def the_accessor_of_rioxarray(desk: SimpleNamespace) -> None:
    pytest.importorskip("rioxarray")
    flat = (
        desk.line.reflectance.isel(band=0)
        .rio.set_spatial_dims("cross_track", "along_track")
        .rio.write_crs("EPSG:32617")
    )
    assert (flat.rio.width, flat.rio.clip_box(2, 3, 5, 9).shape) == (COLUMNS, (7, 4))


@habit
def look_at_it(desk: SimpleNamespace) -> None:
    for each in (desk.line, desk.library, desk.lazy):
        assert repr(each.paint)
        assert each.paint._repr_html_()
        assert each._repr_html_()
    assert repr(desk.regions)


@habit
def numbers_as_numpy_and_whole_floats(desk: SimpleNamespace) -> None:
    assert desk.line.paint.rgb(lines=20.0).sizes["along_track"] <= 20
    assert desk.line.isel(along_track=30).paint.rgb(lines=20).dims == ("cross_track", "rgb")
    shown = (desk.line.paint.flag_overlay(flags) for flags in (64, np.uint16(64), "glint"))
    assert len({len(figure.axes[0].get_children()) for figure in shown}) == 1
    same(
        desk.line.paint.signatures(desk.regions, exclude=np.int64(1)).reflectance,
        desk.line.paint.signatures(desk.regions, exclude=1).reflectance,
    )


@pytest.mark.parametrize("name", HABITS)
def test_a_habit(name: str, desk: SimpleNamespace) -> None:
    HABITS[name](desk)


REFUSED: dict[str, tuple[str, Habit]] = {
    "percentiles that fall": ("value-out-of-range", lambda desk: desk.line.paint.rgb(stretch=(98, 2))),
    "no percentiles": ("value-out-of-range", lambda desk: desk.line.paint.rgb(stretch=None)),
    "a slice of wavelengths": ("type-wrong", lambda desk: desk.line.paint.at(slice(500, 600))),
    "a table of wavelengths": ("type-wrong", lambda desk: desk.line.paint.at([[500, 600]])),
    "no wavelength": ("selection-empty", lambda desk: desk.line.paint.at([])),
    "no line": ("pixel-outside-line", lambda desk: desk.line.paint.pixels(None, 4)),
    "a line as text": ("type-wrong", lambda desk: desk.line.paint.pixels("3", 4)),
    "a half line": ("pixel-outside-line", lambda desk: desk.line.paint.pixels(3.5, 4)),
    "a panel of one pixel": (
        "type-wrong", lambda desk: desk.line.paint.reflectance(panel=hp.Panel(3, 4, 0.6))
    ),
    "a library by its path": ("type-wrong", lambda desk: desk.line.paint.detect("library.zarr")),
    "an array in a store": ("type-wrong", lambda desk: hp.to_store(desk.line.reflectance, "o.zarr")),
    "light of another shape": (
        "grid-mismatch", lambda desk: desk.line.paint.correct_light(direct=np.ones(3), sun_zenith=30.0)
    ),
    "a scene without reach": ("value-out-of-range", lambda desk: desk.line.paint.survey(reach=0)),
    "an unknown heading": ("not-finite", lambda desk: desk.line.paint.survey(heading=np.nan)),
    "a bare polygon": (
        "type-wrong", lambda desk: desk.line.paint.signatures({"type": "Polygon", "coordinates": [[[0, 0]]]})
    ),
    "no lines for a mosaic": ("type-wrong", lambda desk: hp.geometry.mosaic(list(desk.regions)[:0])),
    "two lines as one": (
        "dims-wrong",
        lambda desk: xr.concat([desk.line] * 2, "t", data_vars=["quality"]).paint.locate(ground=0.0),
    ),
    "lines without a number": (
        "not-finite", lambda desk: desk.line[["reflectance"]].pad(along_track=2).paint.quicklook()
    ),
    "good bands as text": (
        "type-wrong",
        lambda desk: desk.line.assign_coords(good=("band", ["False"] * BANDS)).paint.at(550.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_habit_that_is_refused_by_its_name(name: str, desk: SimpleNamespace) -> None:
    code, call = REFUSED[name]
    with refusal(hp.errors.PaintError, code):
        call(desk)


@pytest.mark.parametrize("names", [("latitude", "longitude"), ("lat", "lon")])
def test_a_map_in_degrees_is_a_map(names: tuple[str, str]) -> None:
    # dims, words and coordinates as EMIT-tools writes them
    values = np.random.default_rng(8).random((8, 9, 30)).astype(np.float32)
    cube = xr.Dataset(
        {
            "reflectance": ((*names, "wavelengths"), values, {"units": "unitless"}),
            "elev": (names, np.zeros((8, 9), np.float32), {"units": "m"}),
        },
        {
            "wavelengths": ("wavelengths", np.linspace(381, 1000, 30), {"units": "nm"}),
            "good_wavelengths": ("wavelengths", np.ones(30, np.float32)),
            names[0]: np.linspace(43.1, 43.0, 8),
            names[1]: np.linspace(-77.7, -77.6, 9),
            "spatial_ref": 0,
        },
    )
    region = hp.Region("field", [(1, 1), (6, 1), (6, 6), (1, 6)])
    paints = cube.paint.signatures([region], exclude=0)
    np.testing.assert_allclose(paints.reflectance[0], values[1:7, 1:7].mean((0, 1)), rtol=1e-6)
    np.testing.assert_array_equal(cube.paint.at(650).reflectance, values[..., 13])
    assert cube.paint.rgb().shape == (8, 9, 3)
