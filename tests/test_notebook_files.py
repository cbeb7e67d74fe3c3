"""Things that people do in a notebook to files, dask, pictures and other libraries, with lines and stores."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.notebook_desk import BANDS, COLUMNS, LINES, Habit, laid_out, same
from support.refusals import expect_error

import hyperpaint as hp

HABITS: dict[str, Habit] = {}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    return laid_out(tmp_path_factory.mktemp("desk"))


def habit(function: Habit) -> Habit:
    HABITS[function.__name__] = function
    return function


# --- files -------------------------------------------------------------------------------------------------


def again(dataset: xr.Dataset, desk: SimpleNamespace, name: str) -> xr.Dataset:
    path = desk.folder / name
    dataset.to_netcdf(path, engine="h5netcdf")
    return xr.load_dataset(path, engine="h5netcdf")


@habit
def line_to_netcdf_and_back(desk: SimpleNamespace) -> None:
    back = again(desk.line, desk, "line.nc")
    xr.testing.assert_equal(back.drop_encoding(), desk.line)
    same(back.drop_vars("reflectance").paint.reflectance().reflectance, desk.line.reflectance)


@habit
def library_to_netcdf_and_back(desk: SimpleNamespace) -> None:
    xr.testing.assert_equal(again(desk.library, desk, "library.nc"), desk.library)


@habit
def line_to_plain_zarr_and_back(desk: SimpleNamespace) -> None:
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
    assert isinstance(tree, xr.DataTree)
    assert sorted(tree["flightlines"].children) == ["raw_0", "raw_1"]
    same(tree["flightlines/raw_0"].to_dataset().paint.reflectance().reflectance, desk.line.reflectance)


@habit
def open_a_store_with_xarray_alone(desk: SimpleNamespace) -> None:
    tree = xr.open_datatree(desk.store, engine="zarr", consolidated=False)
    assert tree["flightlines/raw_0"].sizes["along_track"] == LINES


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
    asd = sorted(desk.collect.parent.rglob("*.asd"))[0]
    sig = sorted(desk.collect.parent.rglob("*.sig"))[0]
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
    other = copy.deepcopy(desk.line)
    other["counts"][:] = 0
    assert (desk.line.counts != 0).any()


@habit
def library_to_dataframe(desk: SimpleNamespace) -> None:
    frame = desk.library[["reflectance", "reflectance_sd"]].to_dataframe()
    assert (len(frame), desk.library.reflectance.to_pandas().shape) == (
        desk.library.sizes["signature"] * BANDS,
        (3, BANDS),
    )


@habit
def line_to_dataframe(desk: SimpleNamespace) -> None:
    frame = desk.line[["quality"]].to_dataframe()
    assert frame.index.names == ["along_track", "cross_track"]


@habit
def json_of_a_dict(desk: SimpleNamespace) -> None:
    assert xr.Dataset.from_dict(desk.library.to_dict()).sizes == desk.library.sizes


# --- dask --------------------------------------------------------------------------------------------------


@habit
def persist(desk: SimpleNamespace) -> None:
    same(desk.lazy.paint.reflectance().reflectance.persist(), desk.line.reflectance)


@habit
def map_blocks(desk: SimpleNamespace) -> None:
    cube = desk.lazy.paint.reflectance().unify_chunks().reflectance
    same(cube.map_blocks(lambda block: 2 * block, template=cube), 2 * desk.line.reflectance)


@habit
def apply_ufunc_over_bands(desk: SimpleNamespace) -> None:
    cube = desk.lazy.paint.reflectance().reflectance
    options: dict[str, Any] = {"dask": "parallelized", "output_dtypes": [np.float32]}
    mean = xr.apply_ufunc(np.nanmean, cube, input_core_dims=[["band"]], kwargs={"axis": -1}, **options)
    same(mean, desk.line.reflectance.mean("band"))


@habit
def rechunk_by_bands(desk: SimpleNamespace) -> None:
    cut = desk.lazy.chunk(band=5, along_track=7, cross_track=4)
    same(cut.paint.reflectance().reflectance, desk.line.reflectance)


@habit
def unify_chunks_of_small_indexes(desk: SimpleNamespace) -> None:
    assert desk.lazy.along_track.chunks is None
    assert desk.lazy.unify_chunks().sizes["along_track"] == LINES


@habit
def stack_pixels_and_back(desk: SimpleNamespace) -> None:
    pixels = desk.line.reflectance.stack(pixel=("along_track", "cross_track"))
    back = pixels.unstack("pixel")
    same(back.transpose(*desk.line.reflectance.dims), desk.line.reflectance)


@habit
def one_cube_alone_has_the_methods_of_a_cube(desk: SimpleNamespace) -> None:
    cube = desk.line.reflectance
    xr.testing.assert_identical(cube.paint.at(550.0), desk.line.paint.at(550.0).reflectance)
    xr.testing.assert_identical(cube.paint.rgb(), desk.line.paint.rgb())
    smoothed = cube.paint.smooth(window=5)
    assert smoothed.name == "reflectance"
    same(smoothed, desk.line.paint.smooth(window=5).reflectance)
    assert (
        (2 * cube).rename(None).paint.at([500.0, 600.0]).sizes["band"],
        desk.line.wavelength.paint.at(550.0).name,
        cube.isel(along_track=0, cross_track=0).paint.at(550.0).ndim,
    ) == (2, "wavelength", 0)
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
    lit = (view.irradiance * 2).pint.to("mW m-2 nm-1")
    same(lit.pint.magnitude, 2000 * desk.line.irradiance)
    same(view.pint.dequantify().paint.reflectance().reflectance, desk.line.reflectance)


@habit
def plot_an_image(desk: SimpleNamespace) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    drawn = desk.line.reflectance.isel(band=5).plot()
    assert drawn.axes.get_xlabel().startswith("Column")
    plt.close("all")


@habit
def plot_spectra(desk: SimpleNamespace) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    assert len(desk.library.reflectance.plot.line(x="wavelength", hue="signature")) == 3
    desk.line.reflectance.isel(along_track=3, cross_track=[1, 5]).plot.line(x="wavelength")
    plt.close("all")


@habit
def plot_facets_and_histograms(desk: SimpleNamespace) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    desk.line.reflectance.isel(band=[2, 9]).plot(col="band")
    desk.line.reflectance.plot.hist()
    plt.close("all")


@habit
def hvplot_an_image(desk: SimpleNamespace) -> None:
    pytest.importorskip("hvplot.xarray")
    image = desk.line.paint.at(550.0).reflectance.hvplot.image(x="cross_track", y="along_track")
    assert [dim.name for dim in image.kdims] == ["cross_track", "along_track"]


@habit
def hvplot_with_a_slider_over_wavelength(desk: SimpleNamespace) -> None:
    pytest.importorskip("hvplot.xarray")
    cube = desk.line.reflectance.swap_dims(band="wavelength")
    slider = cube.hvplot.image(x="cross_track", y="along_track", groupby="wavelength", dynamic=False)
    assert len(slider) == BANDS


@habit
def hvplot_lines_by_paint(desk: SimpleNamespace) -> None:
    pytest.importorskip("hvplot.xarray")
    curves = desk.library.reflectance.swap_dims(band="wavelength").hvplot.line(x="wavelength", by="signature")
    assert len(curves) == 3


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


@pytest.mark.parametrize("name", HABITS)
@pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::PendingDeprecationWarning"
)
def test_a_habit(name: str, desk: SimpleNamespace) -> None:
    HABITS[name](desk)
