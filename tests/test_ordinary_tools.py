"""What xarray and pandas users do without thinking to a processed line: it works, or one sentence says how.

The store is that of `hyperpaint.process`, opened by plain `xr.open_zarr`.
"""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.accessor import METHODS
from hyperpaint.base.errors import PaintWarning, SchemaError, TimeError
from hyperpaint.base.schema import CALIBRATION_NAMES, Quality

REGIONS = hp.Regions((hp.Region("a", [(2, 2), (20, 2), (20, 14), (2, 14)]),))
PRODUCTS = ["reflectance", "quality"]

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::RuntimeWarning")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Return a collect with smile and full pixels, processed; its line in memory, and what it gives."""
    folder = tmp_path_factory.mktemp("flown")
    settings: dict[str, Any] = {"lines": 64, "bands": 40, "columns": 24, "seed": 11, "smile_nm": 2.0}
    collect = hp.simulate_collect(folder / "raw", scene="plan", **settings)
    store = hp.process(collect, folder / "lot.zarr")
    line = xr.open_zarr(store, group="flightlines/raw_0").load().copy()
    raw = line.drop_vars(PRODUCTS)
    return SimpleNamespace(
        folder=folder, store=store, collect=Path(collect), line=line, raw=raw,
        lazy=xr.open_zarr(store, group="flightlines/raw_0"),
        again=raw.paint.reflectance().compute(),
        library=hp.extract_signatures(line, REGIONS, exclude=0),
    )  # fmt: skip


def centre(line: xr.Dataset) -> np.ndarray:
    return np.asarray(hp.extract_signatures(line, REGIONS, exclude=0).reflectance.values)


# --- netCDF ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_every_product_becomes_netcdf(flown: SimpleNamespace, engine: str, tmp_path: Path) -> None:
    pytest.importorskip({"netcdf4": "netCDF4"}.get(engine, engine))
    home = flown.collect.parent
    tree = xr.open_datatree(flown.store, engine="zarr", chunks=None)
    products = {path: tree[path].to_dataset(inherit=False) for path in tree.groups if tree[path].variables}
    products |= {name: xr.open_zarr(home / f"{name}.zarr") for name in ("truth", "calibration")}
    products |= {
        **{path.stem: xr.open_zarr(path) for path in home.rglob("sweep.zarr")},
        "library": flown.library,
        "uncertain": flown.line.paint.reflectance(uncertainty=True),
        "flags": flown.line.paint.flag(),
        "map": flown.line.paint.orthorectify(gsd=1.0),
        "coarse": flown.line.paint.coarse(),
    }
    for name, product in products.items():
        path = tmp_path / f"{name.replace('/', '_')}.nc"
        product.to_netcdf(path, engine=engine)
        with xr.open_dataset(path, engine=engine) as back:
            xr.testing.assert_equal(back.load(), product.load())
            for key in product.variables:
                assert back[key].encoding["dtype"] != np.float16, (name, key)


def test_a_line_from_netcdf_serves(flown: SimpleNamespace, tmp_path: Path) -> None:
    pytest.importorskip("h5netcdf")
    flown.line.to_netcdf(tmp_path / "line.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "line.nc", engine="h5netcdf") as line:
        np.testing.assert_array_equal(line.paint.reflectance().reflectance, flown.again.reflectance)
        np.testing.assert_array_equal(centre(line), flown.library.reflectance)


# --- where, concat, averages -------------------------------------------------------------------------------

PARTS: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "of lines": lambda line: line.where(line.along_track < 50, drop=True),
    "of pixels": lambda line: line.where((line.along_track < 50) & (line.cross_track > 1), drop=True),
    "not dropped": lambda line: line.where(line.along_track < 50),
    "concat": lambda line: xr.concat(
        [line.isel(along_track=slice(0, 20)), line.isel(along_track=slice(20, None))],
        "along_track", data_vars="all", coords="all",
    ),
}  # fmt: skip


@pytest.mark.parametrize("source", ["line", "lazy"])
@pytest.mark.parametrize("part", PARTS)
def test_parts_keep_flags_and_pictures(flown: SimpleNamespace, part: str, source: str) -> None:
    chosen = PARTS[part](getattr(flown, source))
    np.testing.assert_array_equal(centre(chosen), flown.library.reflectance)
    assert chosen.paint.smooth().quality.dtype == np.uint16
    assert chosen.paint.quicklook() is not None
    assert "flight line" in chosen.paint._repr_html_()


def test_gaps_of_flags_are_no_data(flown: SimpleNamespace) -> None:
    flags = flown.line.where(flown.line.cross_track > 3).paint.smooth().quality
    assert (flags[:, :4] == Quality.NO_DATA).all()
    np.testing.assert_array_equal(flags[:, 4:], flown.line.quality[:, 4:])


@pytest.mark.parametrize("part", ["of lines", "of pixels", "not dropped"])
def test_counts_that_where_emptied_are_told_of_sel(flown: SimpleNamespace, part: str) -> None:
    caught = expect_error(
        SchemaError, re.escape(".sel() or .isel()"), lambda: PARTS[part](flown.raw).paint.reflectance()
    )
    assert "rename" not in str(caught)


@pytest.mark.parametrize("source", ["line", "lazy"])
def test_concat_with_all_variables(flown: SimpleNamespace, source: str) -> None:
    again = PARTS["concat"](getattr(flown, source).drop_vars(PRODUCTS)).paint.reflectance()
    np.testing.assert_array_equal(again.reflectance, flown.again.reflectance)
    assert again.dark_counts.dims == ("band", "cross_track")


def test_what_differs_from_part_to_part_is_refused(flown: SimpleNamespace) -> None:
    first, second = (flown.raw.isel(along_track=part) for part in (slice(0, 20), slice(20, None)))
    second = second.assign(radiance_gain=second.radiance_gain * 2)
    both = xr.concat([first, second], "along_track", data_vars="all", coords="all")
    expect_errors(
        (SchemaError, "minimal", lambda: both.paint.reflectance()),
        (SchemaError, "radiance_gain", lambda: both.chunk({"along_track": 16}).paint.reflectance().compute()),
    )


def test_means_of_counts_are_flagged(flown: SimpleNamespace) -> None:
    counts = flown.raw.counts.copy()
    counts[10, 7, 5] = 4095
    counts[11, 7, 5] = 1001
    means = flown.raw.assign(counts=counts).coarsen(along_track=2).mean()
    with pytest.warns(PaintWarning, match="whole numbers"):
        line = means.paint.reflectance().compute()
    assert line.quality[5, 5] & Quality.SATURATED
    with pytest.warns(PaintWarning, match="means over pixels"):  # flags of several pixels are none
        flown.line.coarsen(along_track=2).mean().paint.rgb().compute()


@pytest.mark.parametrize("chunks", [None, 5])
def test_missing_counts_are_no_data(flown: SimpleNamespace, chunks: int | None) -> None:
    counts = flown.raw.counts.astype(np.float32)
    counts[3, :, 4] = np.nan
    counts[4, 2, 5] = -np.inf
    counts[5, 2, 6] = np.inf
    line = flown.raw.assign(counts=counts if chunks is None else counts.chunk(along_track=chunks))
    again = line.paint.reflectance().compute()
    assert np.isnan(again.reflectance[3, :, 4]).all()
    assert np.isnan(again.reflectance.values[[4, 5], 2, [5, 6]]).all()
    assert (again.quality.values[[3, 4], [4, 5]] & Quality.NO_DATA).all()
    assert again.quality[5, 6] & Quality.SATURATED
    untouched = np.ones(again.quality.shape, bool)
    untouched[[3, 4, 5], [4, 5, 6]] = False
    np.testing.assert_array_equal(again.quality.values[untouched], flown.again.quality.values[untouched])
    assert not np.isinf(again.reflectance).any()


# --- nothing selected, a dimension dropped -----------------------------------------------------------------

ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "at": (550.0,), "pixels": (0, 0), "signatures": (REGIONS,), "spectrum": (REGIONS,),
    "flag_overlay": (), "apply_alignment": (xr.Dataset(),), "relight": (),
}  # fmt: skip
DRAWN = {"explore", "relight", "apply_alignment"}
"""Methods that need an object of their own."""


@pytest.mark.parametrize("dim", ["along_track", "cross_track", "band"])
def test_nothing_selected_is_told(flown: SimpleNamespace, dim: str, tmp_path: Path) -> None:
    none = flown.line.isel({dim: slice(0, 0)})
    arguments = ARGUMENTS | {"detect": (flown.library,)}
    for name in METHODS.keys() - DRAWN:
        expect_error(
            SchemaError, f"selected: {dim}", partial(getattr(none.paint, name), *arguments.get(name, ()))
        )
    for function in (hp.slab, hp.reflectance, lambda line: hp.regions.region_mask(REGIONS, line)):
        expect_error(SchemaError, "selection-empty", partial(function, none))
    assert "flight line" in none.paint._repr_html_()
    assert hp.to_store(none, tmp_path / "none.zarr", "flightlines/a")


def test_no_irradiance_selected_is_told(flown: SimpleNamespace) -> None:
    expect_error(TimeError, "size 0", lambda: flown.raw.isel(irradiance_time=slice(0, 0)).paint.reflectance())


@pytest.mark.parametrize("dim", ["along_track", "cross_track", "band"])
def test_a_dropped_dimension_is_told(flown: SimpleNamespace, dim: str) -> None:
    one = flown.line.isel({dim: 5})
    arguments = ARGUMENTS | {"detect": (flown.library,)}
    for name in (
        "reflectance",
        "radiance",
        "quicklook",
        "flag",
        "signatures",
        "coarse",
        "flag_overlay",
        "detect",
    ):
        if name == "flag_overlay" and dim == "band":
            continue  # which needs none
        caught = expect_error(SchemaError, None, partial(getattr(one.paint, name), *arguments.get(name, ())))
        assert f"isel({dim}=[5])" in str(caught), name
        assert "rename" not in str(caught)
    kept = flown.raw.isel({dim: [5]}).paint.reflectance().reflectance
    np.testing.assert_allclose(kept, flown.again.reflectance.isel({dim: [5]}), rtol=1e-6)
    assert one.paint._repr_html_()


def test_a_stack_is_told(flown: SimpleNamespace) -> None:
    stacked = flown.raw.stack(pixel=("along_track", "cross_track"))
    expect_error(SchemaError, re.escape("unstack('pixel')"), lambda: stacked.paint.reflectance())


# --- a calibration without its smile -----------------------------------------------------------------------


def test_what_belongs_to_the_calibration_is_missed(flown: SimpleNamespace) -> None:
    assert "wavelength_shift" in flown.line.radiance_gain.attrs[CALIBRATION_NAMES]
    without = flown.raw.drop_vars("wavelength_shift")
    with pytest.warns(PaintWarning, match="wavelength_shift"):
        without.paint.reflectance()
    with pytest.warns(PaintWarning, match="wavelength_shift"):
        flown.line.drop_vars("wavelength_shift").paint.to_nominal()
    gain = without.radiance_gain.drop_attrs().assign_attrs(units=flown.raw.radiance_gain.units)
    with warnings.catch_warnings():  # an old store does not say it
        warnings.simplefilter("error")
        without.assign(radiance_gain=gain).paint.reflectance()
        flown.line.paint.to_nominal().paint.smooth()


# --- pictures of raw cubes ---------------------------------------------------------------------------------


def test_raw_counts_have_a_picture(flown: SimpleNamespace) -> None:
    cube = xr.open_dataset(flown.collect.parent / "flight/raw_0.hdr", engine="envi")
    picture = cube.paint.rgb()
    assert picture.sizes["rgb"] == 3
    assert "raw counts" in picture.attrs["long_name"]
    assert 0.0 <= float(picture.min()) < float(picture.max()) <= 1.0
    assert cube.paint.rgb(stretch=(0.0, 100.0)).compute().values.std() > 0.01
    assert "counts of all pixels" in [axes.get_title() for axes in cube.paint.quicklook().axes]
    assert ".rgb()" in repr(cube.paint)
    assert "radiance" in flown.raw.drop_vars(["irradiance"]).paint.rgb().attrs["long_name"]


# --- others ------------------------------------------------------------------------------------------------

SAME: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda line: pickle.loads(pickle.dumps(line)),
    "transpose": lambda line: line.transpose(*reversed(list(line.dims))),
    "persist": lambda line: line.chunk({"along_track": 7, "band": 9}).persist(),
    "reset coords": lambda line: line.reset_coords(),
    "new coords": lambda line: line.assign_coords(
        place=("along_track", np.arange(line.sizes["along_track"]))
    ),
    "swapped dims": lambda line: line.swap_dims(along_track="time"),
    "by wavelength": lambda line: line.swap_dims(band="wavelength"),
    "unstacked": lambda line: line.stack(pixel=("along_track", "cross_track")).unstack("pixel"),
    "sorted": lambda line: line.sortby("along_track", ascending=False).sortby("along_track"),
    "aligned": lambda line: xr.align(line, line.isel(along_track=slice(None)), join="inner")[0],
    "no encoding": lambda line: line.drop_encoding(),
    "as a tree": lambda line: xr.DataTree.from_dict({"/flightlines/a": line})["flightlines/a"].to_dataset(),
}


@pytest.mark.parametrize("habit", SAME)
def test_the_same_line_has_the_same_reflectance(flown: SimpleNamespace, habit: str) -> None:
    line = SAME[habit](flown.raw)
    again = line.paint.reflectance().reflectance.transpose("along_track", "band", "cross_track")
    np.testing.assert_array_equal(again, flown.again.reflectance)


def test_dims_of_other_names(flown: SimpleNamespace) -> None:
    renamed = flown.raw.rename(along_track="row", cross_track="pixel", band="layer")
    dims = {"along_track": "row", "cross_track": "pixel", "band": "layer"}
    np.testing.assert_array_equal(renamed.paint.reflectance(dims=dims).reflectance, flown.again.reflectance)
    expect_error(SchemaError, "dims=", lambda: renamed.paint.reflectance())


def test_tables_and_means_of_a_processed_line(flown: SimpleNamespace) -> None:
    assert flown.lazy.reflectance.isel(along_track=5, cross_track=3).to_dataframe().reflectance.size == 40
    near = flown.lazy.swap_dims(band="wavelength").sel(wavelength=550, method="nearest")
    np.testing.assert_array_equal(near.reflectance, flown.lazy.paint.at(550.0).reflectance)
    seconds = flown.lazy.reflectance.swap_dims(along_track="time").resample(time="1s").mean()
    assert seconds.sizes["time"] >= 1
    assert flown.line.reflectance.groupby(flown.line.quality).mean().sizes["quality"] >= 1


def test_a_library_after_where(flown: SimpleNamespace, tmp_path: Path) -> None:
    path = hp.write_library(flown.library.where(flown.library.n > 3, drop=True), tmp_path / "red.csv")
    np.testing.assert_allclose(hp.open_library(path).reflectance, flown.library.reflectance, rtol=1e-6)
    assert hp.open_library(path).n.values.tolist() == flown.library.n.values.tolist()


# --- regions -----------------------------------------------------------------------------------------------


def test_regions_are_shown_in_a_few_lines() -> None:
    corners = [(np.cos(angle), np.sin(angle)) for angle in np.linspace(0, 6, 300)]
    many = hp.Regions(
        tuple(hp.Region(f"car {k}", corners, properties={"make": "x" * 500}) for k in range(60))
    )
    assert len(repr(many)) < 2000
    assert repr(many).endswith("... and 50 more")
    assert "'car 9'" in repr(many)
    assert "more" not in repr(many[:3])
    assert "300 corners" in repr(many[0])
