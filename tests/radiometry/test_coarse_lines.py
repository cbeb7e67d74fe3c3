"""A line at the size of a screen: means of blocks against plain loops, stored and computed."""

import importlib
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.io.store.computing import storage_chunks
from hyperpaint.kernels.overviews import mix_bands
from hyperpaint.pictures.exploring import Explored
from hyperpaint.radiometry import slabs
from hyperpaint.radiometry.pixel_reading import coarse, coarse_reflectance
from hyperpaint.radiometry.planning import make_plan


def plain_means(cube: np.ndarray, side: int) -> np.ndarray:
    # Return means of blocks of (line, band, column), NaN left out, by one loop over blocks
    rows, columns = -(-cube.shape[0] // side), -(-cube.shape[2] // side)
    means = np.empty((rows, cube.shape[1], columns))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # blocks without any value
        for y, x in np.ndindex(rows, columns):
            block = cube[y * side : (y + 1) * side, :, x * side : (x + 1) * side].astype("f8")
            means[y, :, x] = np.nanmean(block, axis=(0, 2))
    return means


def speckled(lines: int = 70, columns: int = 11) -> xr.Dataset:
    line = flight(lines=lines, columns=columns).line.paint.reflectance().compute()
    cube = line.reflectance.values.copy()
    cube[np.random.default_rng(5).random(cube.shape) < 0.2] = np.nan
    cube[8:16, 1, :8] = np.nan
    cube[0, 0, 0] = 1e30  # more than half precision holds
    line = line.assign_coords(along_track=np.arange(lines))
    return line.assign(reflectance=line.reflectance.copy(data=cube)).drop_vars("counts")


@pytest.fixture(scope="module")
def raw_collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("coarse") / "raw"
    return hp.simulate_collect(folder, scene="plan", lines=40, bands=12, columns=9, seed=3, truth=False)


def level_of(line: xr.Dataset, **options: Any) -> str:
    return str(coarse(line, **options).reflectance.attrs["level"])


@pytest.mark.parametrize("side", [1, 3, 8, 32])
def test_means_are_those_of_plain_loops(side: int) -> None:
    line = speckled()
    means = coarse_reflectance(line, side)
    assert means.dtype == np.float32
    np.testing.assert_allclose(means.values, plain_means(line.reflectance.values, side), rtol=2**-11)
    assert not (means.values.view("u4") & 0x1FFF).any()  # ten bits of the mantissa are kept
    assert side > 8 or np.isnan(means.values[-(-8 // side), 1, 0])


def test_same_bits_whatever_the_chunks() -> None:
    line = speckled()
    whole = coarse_reflectance(line, 8).values
    for chunks in (1, 5, 32, (3, 50, 17)):
        parts = coarse_reflectance(line.chunk({"along_track": chunks, "band": 1}), 8)
        np.testing.assert_array_equal(parts.values, whole)


@pytest.mark.parametrize(("lines", "side"), [(30, 4), (4000, 4), (4001, 8), (12000, 16), (90000, 32)])
def test_a_long_line_has_wider_blocks(lines: int, side: int) -> None:
    cube = xr.DataArray(
        np.broadcast_to(np.float32(0.5), (lines, 2, 3)), dims=("along_track", "band", "cross_track")
    )
    line = xr.Dataset({"reflectance": cube.chunk({"along_track": 4096}).assign_attrs(units="1")})
    means = coarse_reflectance(line)
    assert (means.attrs["block_side"], means.shape) == (side, (-(-lines // side), 2, 1))


def test_what_is_stored_serves(tmp_path: Path, no_compute: Any) -> None:
    line = speckled().drop_vars("quality").chunk({"along_track": 32})
    hp.to_store(line.assign(coarse_reflectance=coarse_reflectance(line)), tmp_path / "lot.zarr")
    assert hp.verify(tmp_path / "lot.zarr").ok
    opened = hp.open_store(tmp_path / "lot.zarr")
    # a task reads its group of bands, of other cubes all bands
    groups = [len(opened[name].chunks[1]) for name in ("coarse_reflectance", "reflectance")]
    assert groups == [line.sizes["band"] // 2, 1]
    with no_compute():
        small = coarse(opened)
    computed = coarse(line)
    levels = small.reflectance.attrs["level"], computed.reflectance.attrs["level"]
    assert levels == ("stored", "computed")
    np.testing.assert_array_equal(small.reflectance.values, computed.reflectance.values)
    # a line as any other; the last block is cut
    assert small.along_track.values[[0, 1, 2, -1]].tolist() == [2, 6, 10, 69]
    place = int(np.abs(line.wavelength.values - 550.0).argmin())
    band = small.paint.at(550.0).reflectance.values
    np.testing.assert_array_equal(band, small.reflectance.values[:, place])
    two = [550.0, 560.0]
    xr.testing.assert_identical(opened.paint.at(two).paint.coarse().compute(), small.paint.at(two).compute())
    # not what was asked for in other blocks; alone it is all there is
    assert (level_of(opened, side=8), level_of(opened.drop_vars("reflectance"))) == ("computed", "stored")
    for side in (0, 33):
        with pytest.raises(SchemaError, match=rf"side={side}.*value-out-of-range"):
            coarse(line, side=side)
    # and means of an older store
    line = speckled().drop_vars("quality")
    line = line.assign(reflectance=line.reflectance.clip(max=1.0))
    means = coarse_reflectance(line)
    old = means.astype(np.float16)  # until 0.2
    schema.stamp_means(old, line)
    small = coarse(line.assign(coarse_reflectance=old)).reflectance
    assert small.attrs["level"] == "stored"
    np.testing.assert_array_equal(small, means.values)


def edits(opened: xr.Dataset) -> dict[str, xr.Dataset]:
    loaded = opened.assign(reflectance=opened.reflectance.copy()).load()
    loaded.reflectance.values[:] *= 2
    return {
        "scaled": opened.assign(reflectance=(opened.reflectance * np.float32(0.5)).assign_attrs(units="1")),
        "smooth": opened.paint.smooth(window=3, order=1),
        "backwards": opened.isel(along_track=slice(None, None, -1)),
        "earlier": opened.isel(along_track=slice(0, 40)),
        "later": opened.isel(along_track=slice(2, None)),
        "data": opened.assign(reflectance=opened.reflectance.copy(data=opened.reflectance.data * 2)),
        "in place": loaded,
    }


def test_means_of_what_was_edited_do_not_serve(tmp_path: Path) -> None:
    line = speckled(71).drop_vars("quality").chunk({"along_track": 32})
    hp.to_store(line.assign(coarse_reflectance=coarse_reflectance(line)), tmp_path / "lot.zarr")
    opened = hp.open_store(tmp_path / "lot.zarr")
    for name, other in edits(opened).items():
        hp.to_store(other, tmp_path / f"{name}.zarr")
        small, again = (
            coarse(each).reflectance for each in (other, hp.open_store(tmp_path / f"{name}.zarr"))
        )
        assert small.attrs["level"] == again.attrs["level"] == "computed", name
        np.testing.assert_array_equal(again.values, small.values)
    hp.to_store(opened, tmp_path / "same.zarr")
    assert level_of(hp.open_store(tmp_path / "same.zarr")) == "stored"


def test_means_of_counts_follow_what_calibrates_them(tmp_path: Path) -> None:
    line = flight(lines=40, columns=9).line.paint.reflectance().chunk({"along_track": 32})
    line = line.assign(coarse_reflectance=coarse_reflectance(line)).drop_vars("reflectance")
    opened = hp.open_store(hp.to_store(line, tmp_path / "lot.zarr"))
    assert level_of(opened) == "stored"
    for name in ("irradiance", "radiance_gain", "exposure_time"):
        assert level_of(opened.assign({name: opened[name].copy(data=opened[name].data * 2)})) == "computed"


def test_process_stores_means_which_the_explorer_takes(raw_collect: Path, tmp_path: Path) -> None:
    line = hp.open_store(hp.process(raw_collect, tmp_path / "lot.zarr"), "flightlines/raw_0")
    small = line.paint.coarse()
    assert small.reflectance.attrs["level"] == "stored"
    expected = plain_means(line.reflectance.values, 4)
    np.testing.assert_allclose(small.reflectance.values, expected, rtol=2**-11)
    assert small.paint.rgb(stretch=(0.0, 100.0)).shape == (10, 3, 3)
    assert storage_chunks(("coarse_y", "band", "coarse_x"), (1000, 272, 160), 2) == (128, 34, 160)
    # the explorer takes means of counts
    store = hp.process(raw_collect, tmp_path / "counts.zarr", reflectance="none")
    line = hp.open_store(store, "flightlines/raw_0")
    assert Explored(line)._means is not None
    assert level_of(line) == "stored"
    line.paint.pixels(3, 4)  # reads scalars
    plain = xr.open_zarr(store, group="flightlines/raw_0")
    assert (level_of(line), level_of(plain)) == ("stored", "computed")


def test_colours_are_those_of_a_plain_sum() -> None:
    rng = np.random.default_rng(1)
    values = rng.random((5, 7, 6), np.float32)
    values[rng.random(values.shape) < 0.3] = np.nan
    values[2, :, 3] = np.nan
    weights = rng.normal(size=(3, 7, 6)).astype("f4")
    out = np.empty((5, 6, 3), np.float32)
    mix_bands(values, weights, out)
    seen = np.isfinite(values).any(axis=1, keepdims=True).astype("f4")
    filled = np.where(np.isnan(values), seen, values)
    plain = np.stack([(filled * weight).sum(axis=1, dtype="f4") for weight in weights], axis=-1)
    np.testing.assert_array_equal(out, plain)
    assert not out[2, 3].any()


# --- What tasks share: the plan, its values, and chunks of whole lines


def plan_of(line: xr.Dataset) -> slabs.Plan:
    light = ("irradiance", "irradiance_fwhm", "irradiance_time", "irradiance_wavelength")
    cube = ("dark_counts", "radiance_gain", "exposure_time", "saturation_count", "time", "wavelength", "fwhm")
    return make_plan(
        line.counts.shape,
        line.counts.dtype.str,
        np.array([0]),
        cube={name: line[name].values for name in cube},
        light={**{name: line[name].values for name in light}, **line.attrs},
    )


def test_chunks_are_whole_lines_and_small_values_stay_lazy(no_compute: Any) -> None:
    cube = xr.DataArray(np.zeros((70, 4, 5), "u2"), dims=("along_track", "band", "cross_track"))
    turned = cube.transpose("cross_track", "along_track", "band")
    with no_compute():
        for source, lines in (
            (cube, (32, 32, 6)),
            (turned.chunk(band=2, cross_track=3, along_track=10), (10,) * 7),
            (cube.chunk(along_track=(1, 69)), (1, 69)),
        ):
            assert slabs.line_chunked(source).chunks == (lines, (4,), (5,))
    assert isinstance(slabs.small(cube[0, 0]), np.ndarray)
    assert not isinstance(slabs.small(cube[0, 0].chunk()), np.ndarray)


def test_a_plan_holds_the_light_of_its_lines_and_not_the_cube() -> None:
    plan = plan_of(flight(lines=9).line)
    whole = plan.light(0, 9)
    assert whole.dtype == np.float32
    np.testing.assert_array_equal(plan.light(4, 7), whole[4:7])
    # a count at the limit is saturated
    assert plan_of(flight(dtype=np.uint16).line).saturation_limit.tolist() == [[4079]]
    # a plan does not grow with the cube
    small, large = (len(pickle.dumps(plan_of(flight(lines=n, bands=4, columns=3).line))) for n in (10, 1010))
    assert (large - small) / 1000 < 100  # bytes a line


# --- saturated pixels of traced glossy and metallic cars, against counts that no converter clipped ----------


@pytest.fixture(scope="module")
def scenes() -> Any:
    # Return campaigns.saturated_pixels, and a scene of it
    module = importlib.import_module("campaigns.saturated_pixels")
    return module, *module.trace_scene(303, lines=120, columns=150)


@pytest.mark.slow
def test_every_clipped_pixel_is_found_and_few_others(scenes: Any) -> None:
    module, traced, _, sky = scenes
    found, clipped = [], []
    for exposure in module.EXPOSURES:
        line, true = module.exposed(traced, sky, exposure, 303)
        found.append(module.found_in(line))
        clipped.append(true["clipped"])
        assert 10 <= true["clipped"].sum() < 0.2 * true["clipped"].size
        # what the flag promises: any band within 16 counts of the converter's end
        np.testing.assert_array_equal(found[-1], true["margin"])
    # within those 16 counts the converter is not trusted, though some of the samples were not clipped
    recall, precision = module.recall_and_precision(np.stack(found), np.stack(clipped))
    assert recall == 1.0
    assert precision >= 0.99


def test_samples_that_were_clipped_are_missing_and_the_others_stay(scenes: Any) -> None:
    module, traced, _, sky = scenes
    line, true = module.exposed(traced, sky, 0.012, 303, bands=30)
    radiance = hp.radiance(line).radiance.values
    full = line.counts.values >= line.saturation_count.values - module.MARGIN
    assert np.isnan(radiance[full]).all()
    assert np.isfinite(radiance[~full]).all()
    assert full.any(axis=1)[true["clipped"]].all()
    assert np.isfinite(radiance).any(axis=1)[true["clipped"]].mean() > 0.9
