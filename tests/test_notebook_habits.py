"""Sixty things that people do to xarray objects in a notebook, done to lines, libraries and stores.

Done to a simulated line and to one that `hyperpaint.process` wrote; `test_ordinary_tools` has others.
"""

from __future__ import annotations

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


# --- choosing ----------------------------------------------------------------------------------------------


@habit
def sel_a_line_by_its_number(desk: SimpleNamespace) -> None:
    same(desk.line.sel(along_track=7).reflectance, desk.line.isel(along_track=7).reflectance)


@habit
def sel_a_slice_includes_its_end(desk: SimpleNamespace) -> None:
    part = desk.line.sel(along_track=slice(10, 20), cross_track=slice(2, 5))
    assert (part.sizes["along_track"], part.sizes["cross_track"]) == (11, 4)


@habit
def sel_the_nearest(desk: SimpleNamespace) -> None:
    assert int(desk.line.sel(along_track=7.4, method="nearest").along_track) == 7


@habit
def a_crop_of_a_crop_keeps_its_place(desk: SimpleNamespace) -> None:
    crop = desk.line.isel(along_track=slice(10, None)).isel(along_track=slice(5, 9))
    assert crop.along_track.values.tolist() == [15, 16, 17, 18]
    same(crop.sel(along_track=16).reflectance, desk.line.isel(along_track=16).reflectance)


@habit
def isel_pixels_by_arrays(desk: SimpleNamespace) -> None:
    rows, columns = xr.DataArray([1, 5, 9], dims="pixel"), xr.DataArray([0, 2, 4], dims="pixel")
    assert desk.line.reflectance.isel(along_track=rows, cross_track=columns).dims == ("pixel", "band")


@habit
def sel_pixels_by_arrays(desk: SimpleNamespace) -> None:
    rows, columns = xr.DataArray([1, 5, 9], dims="pixel"), xr.DataArray([0, 2, 4], dims="pixel")
    picked = desk.line.reflectance.sel(along_track=rows, cross_track=columns)
    same(picked, desk.line.reflectance.isel(along_track=rows, cross_track=columns))


@habit
def where_flags_are_not_set(desk: SimpleNamespace) -> None:
    clean = desk.line.reflectance.where(desk.line.quality == 0)
    assert clean.dims == ("along_track", "band", "cross_track") or set(clean.dims) == set(
        desk.line.reflectance.dims
    )


@habit
def where_drops_what_is_empty(desk: SimpleNamespace) -> None:
    part = desk.line.where(desk.line.along_track < 5, drop=True)
    assert part.along_track.values.tolist() == [0, 1, 2, 3, 4]


@habit
def drop_and_query(desk: SimpleNamespace) -> None:
    assert desk.line.query(along_track="along_track > 40").sizes["along_track"] == LINES - 41


@habit
def thin_head_and_tail(desk: SimpleNamespace) -> None:
    assert (
        desk.line.thin(along_track=4).along_track.values[:3].tolist(),
        int(desk.line.tail(along_track=1).along_track[0]),
    ) == ([0, 4, 8], LINES - 1)


@habit
def swap_dims_to_wavelength(desk: SimpleNamespace) -> None:
    by_wavelength = desk.line.reflectance.swap_dims(band="wavelength")
    near = by_wavelength.sel(wavelength=550, method="nearest")
    same(near, desk.line.paint.at(550.0).reflectance)


@habit
def slices_of_wavelength(desk: SimpleNamespace) -> None:
    red = desk.line.reflectance.swap_dims(band="wavelength").sel(wavelength=slice(600, 700))
    assert ((red.wavelength >= 600) & (red.wavelength <= 700)).all()


@habit
def interp_over_wavelength(desk: SimpleNamespace) -> None:
    at = desk.line.reflectance.swap_dims(band="wavelength").interp(wavelength=[500.0, 550.0])
    low, high = desk.line.reflectance.min(), desk.line.reflectance.max()
    assert ((at >= low) & (at <= high) | at.isnull()).all()


@habit
def interp_between_lines(desk: SimpleNamespace) -> None:
    middle = desk.line.reflectance.interp(along_track=[3.5])
    same(
        middle.isel(along_track=0),
        desk.line.reflectance.isel(along_track=[3, 4]).mean("along_track", skipna=False),
    )


# --- statistics --------------------------------------------------------------------------------------------


@habit
def mean_of_an_area(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.mean(["along_track", "cross_track"]).sizes == {"band": BANDS}


@habit
def weighted_mean_over_bands(desk: SimpleNamespace) -> None:
    weights = desk.line.wavelength.fillna(0.0)
    mean = desk.line.reflectance.weighted(weights).mean("band")
    own = (desk.line.reflectance * weights).sum("band") / weights.where(desk.line.reflectance.notnull()).sum(
        "band"
    )
    np.testing.assert_allclose(mean, own.transpose(*mean.dims), rtol=1e-5)


@habit
def weighted_mean_of_lines(desk: SimpleNamespace) -> None:
    weights = xr.DataArray(np.ones(LINES), dims="along_track", coords={"along_track": np.arange(LINES)})
    same(
        desk.line.reflectance.weighted(weights).mean("along_track"), desk.line.reflectance.mean("along_track")
    )


@habit
def coarsen_lines(desk: SimpleNamespace) -> None:
    coarse = desk.line.reflectance.coarsen(along_track=4, cross_track=3).mean()
    assert coarse.along_track.values[:2].tolist() == [1.5, 5.5]


@habit
def rolling_mean_of_lines(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.rolling(along_track=5, center=True).mean().sizes["along_track"] == LINES


@habit
def rolling_over_bands(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.rolling(band=3, center=True).mean().sizes["band"] == BANDS


@habit
def resample_in_time(desk: SimpleNamespace) -> None:
    timed = desk.line.reflectance.swap_dims(along_track="time")
    assert timed.resample(time="100ms").mean().sizes["time"] == 4


@habit
def resample_the_irradiance(desk: SimpleNamespace) -> None:
    assert desk.line.irradiance.resample(irradiance_time="4s").mean().sizes["irradiance_time"] >= 2


@habit
def groupby_columns(desk: SimpleNamespace) -> None:
    means = desk.line.reflectance.groupby("cross_track").mean("along_track")
    same(
        means.transpose("band", "cross_track"),
        desk.line.reflectance.mean("along_track").transpose("band", "cross_track"),
    )


@habit
def groupby_a_mask_of_regions(desk: SimpleNamespace) -> None:
    mask = hp.regions.region_mask(desk.regions, desk.line)
    means = desk.line.reflectance.groupby(mask.rename("region")).mean()
    assert means.region.values.tolist() == [-1, 0, 1, 2]


@habit
def signatures_of_a_crop_are_those_of_the_line(desk: SimpleNamespace) -> None:
    crop = desk.line.isel(along_track=slice(8, 20), cross_track=slice(0, 11))
    region = desk.regions[1:2]
    options: dict[str, Any] = {"exclude": 0}
    of_crop, of_line = (each.paint.signatures(region, **options) for each in (crop, desk.line))
    xr.testing.assert_equal(of_crop.reflectance, of_line.reflectance)
    inside = of_crop.member_along_track.values[of_crop.member_along_track.values >= 0]
    assert (inside.min(), inside.max()) == (11, 17)


@habit
def groupby_bins_of_wavelength(desk: SimpleNamespace) -> None:
    parts = desk.line.reflectance.groupby_bins("wavelength", [400, 500, 600, 700]).mean("band")
    assert parts.sizes["wavelength_bins"] == 3


@habit
def groupby_bins_of_lines(desk: SimpleNamespace) -> None:
    assert (
        desk.line.reflectance.groupby_bins("along_track", 4).mean("along_track").sizes["along_track_bins"]
        == 4
    )


@habit
def groupby_with_names(desk: SimpleNamespace) -> None:
    firsts = desk.library.reflectance.groupby(desk.library["signature"].str.slice(0, 5)).mean()
    assert firsts.sizes["signature"] == 1


@habit
def quantiles_and_medians(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.quantile([0.1, 0.9], "along_track").sizes["quantile"] == 2


@habit
def idxmax_gives_the_line(desk: SimpleNamespace) -> None:
    brightest = desk.line.reflectance.isel(band=3, cross_track=2)
    assert int(brightest.idxmax("along_track")) == int(brightest.argmax("along_track"))


@habit
def derivative_over_wavelength(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.differentiate("wavelength").shape == desk.line.reflectance.shape


@habit
def integrate_over_wavelength(desk: SimpleNamespace) -> None:
    assert desk.line.reflectance.fillna(0).integrate("wavelength").shape == (LINES, COLUMNS)


@habit
def ratios_of_bands(desk: SimpleNamespace) -> None:
    nir, red = (desk.line.paint.at(nm).reflectance for nm in (800.0, 670.0))
    index = (nir - red) / (nir + red)
    assert index.shape == (LINES, COLUMNS)


@habit
def angles_between_pixels(desk: SimpleNamespace) -> None:
    cube = desk.line.reflectance.fillna(0)
    dot = xr.dot(cube, cube.isel(along_track=0, cross_track=0, drop=True), dim="band")
    assert dot.shape == (LINES, COLUMNS)


# --- joining -----------------------------------------------------------------------------------------------


@habit
def concat_two_crops(desk: SimpleNamespace) -> None:
    parts = [desk.line.isel(along_track=slice(0, 20)), desk.line.isel(along_track=slice(20, None))]
    whole = xr.concat(parts, "along_track", data_vars="minimal", coords="minimal", compat="override")
    assert whole.along_track.values.tolist() == list(range(LINES))
    same(whole.reflectance, desk.line.reflectance)


@habit
def combine_crops_in_any_order(desk: SimpleNamespace) -> None:
    parts = [
        desk.line[["reflectance"]].isel(along_track=slice(20, None)),
        desk.line[["reflectance"]].isel(along_track=slice(0, 20)),
    ]
    same(xr.combine_by_coords(parts, combine_attrs="override").reflectance, desk.line.reflectance)


@habit
def merge_products_of_a_line(desk: SimpleNamespace) -> None:
    other = desk.line[["reflectance"]].rename(reflectance="before")
    assert {"before", "counts"} <= set(xr.merge([desk.line, other], compat="override").data_vars)


@habit
def concat_two_lines(desk: SimpleNamespace) -> None:
    second = xr.open_zarr(desk.store, group="flightlines/raw_1")
    parts = [desk.line[["reflectance"]], second.paint.reflectance()[["reflectance"]]]
    both = xr.concat(parts, "line", join="inner", coords="minimal", compat="override")
    assert both.sizes["along_track"] == 32


@habit
def the_difference_of_a_crop_is_where_it_belongs(desk: SimpleNamespace) -> None:
    difference = desk.line.reflectance.isel(along_track=slice(10, 20)) - desk.line.reflectance
    assert (difference.along_track.values.tolist(), float(abs(difference).max())) == (
        list(range(10, 20)),
        0.0,
    )


@habit
def two_cameras_are_not_joined_by_the_number_of_a_band(desk: SimpleNamespace) -> None:
    assert "band" not in desk.line.coords
    expect_error(
        ValueError, "band", lambda: desk.line.reflectance + desk.line.reflectance.isel(band=slice(0, 5))
    )


@pytest.mark.parametrize("source", ["simulated", "processed"])
@pytest.mark.parametrize("name", HABITS)
@pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::PendingDeprecationWarning"
)
def test_a_habit(name: str, source: str, desk: SimpleNamespace) -> None:
    lines = {"simulated": desk.line, "processed": desk.processed.compute()}
    HABITS[name](SimpleNamespace(**{**vars(desk), "line": lines[source]}))
