"""Pixels, regions and bands at once: the bits of the lazy cube, what is needed is read, nothing is stale."""

import functools
import gc
import itertools
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.radiometry import planning
from hyperpaint.radiometry.panels import Panel
from hyperpaint.radiometry.pixel_reading import pixels
from hyperpaint.simulation import simulate_line

CAMERA: dict[str, Any] = {"lines": 70, "bands": 60, "columns": 24, "seed": 3}
SELECTIONS: list[dict[str, Any]] = [
    {"along_track": 40, "cross_track": 7},
    {"along_track": -1, "cross_track": slice(3, 9)},
    {"along_track": slice(20, 41), "cross_track": slice(None, None, 5)},
    {"along_track": slice(None, None, 9)},
    {"along_track": slice(60, 2, -7), "cross_track": slice(8, 2, -2)},
    {"along_track": slice(5, 5)},
]


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch) -> planning.PlanCache:
    fresh = planning.PlanCache()
    monkeypatch.setattr("hyperpaint.radiometry.planning.PLANS", fresh)
    monkeypatch.setattr("hyperpaint.radiometry.pixel_reading.PLANS", fresh)
    return fresh


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    # Return the plans that are made from now on
    made: list[Any] = []

    def watched(*arguments: Any, **options: Any) -> Any:
        made.append(planning.make_plan(*arguments, **options))
        return made[-1]

    monkeypatch.setattr("hyperpaint.radiometry.pixel_reading.make_plan", watched)
    monkeypatch.setattr("hyperpaint.radiometry.counts_to_reflectance.make_plan", watched)
    return made


@functools.cache
def simulated(**more: Any) -> xr.Dataset:
    return simulate_line(**CAMERA, **more)


def smiling(**more: Any) -> xr.Dataset:
    return simulated(**more).copy(deep=True)


def stray() -> xr.Dataset:
    share = 0.02 * np.exp(-0.5 * (np.subtract.outer(np.arange(60), np.arange(60)) / 9.0) ** 2)
    np.fill_diagonal(share, 0.0)
    labels = {"units": "1"}
    return smiling().assign(stray_light=(("band", "source_band"), share.astype(np.float32), labels))


def flagged() -> xr.Dataset:
    line = smiling()
    bits = np.zeros((70, 24), np.uint16)
    bits[10:30, 3:6] = 64
    return line.assign(quality=(("along_track", "cross_track"), bits, {"flags_from": "a hand"}))


def panelled() -> xr.Dataset:
    panel = Panel(slice(2, 6), slice(2, 8), 0.5)
    declared = (
        '[{"along_track": [2, 6], "cross_track": [2, 8], "reflectance": 0.5, '
        '"uncertainty": 0.01, "tilt": null}]'
    )
    line = flight(lines=70, bands=12, columns=24, flat=True).line
    measured = line.paint.reflectance(panel=panel)
    names = [name for name in measured.variables if str(name).startswith("panel_")]
    return line.assign(measured[names].compute()).assign_attrs(panels=declared)


def saturation_of_every_element() -> xr.Dataset:
    line = smiling()
    full = np.random.default_rng(1).integers(300, 4000, (60, 24)).astype(np.float32)
    return line.assign(saturation_count=(("band", "cross_track"), full, line.saturation_count.attrs))


LINES: dict[str, Callable[[], xr.Dataset]] = {
    "smile": smiling,
    "masked": lambda: smiling(masked_columns=3).assign(masked=("cross_track", np.arange(24) < 3)),
    "stray light": stray,
    "flagged before": flagged,
    "panels": panelled,
    "saturation": saturation_of_every_element,
    "radiance": lambda: smiling().paint.radiance().drop_vars(["counts", "quality"]),
    "level light": lambda: flight(lines=70, bands=12, columns=24).line,
}


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
@pytest.mark.parametrize("name", LINES)
def test_the_bits_are_those_of_the_lazy_cube(name: str) -> None:
    line = LINES[name]()
    whole, nm = line.paint.reflectance(), line.wavelength.values
    for places in SELECTIONS:
        for wavelength in (None, float(nm[4]), [float(nm[7]), float(nm[2])]):
            expected = (whole if wavelength is None else whole.paint.at(wavelength)).isel(places)
            region = line.paint.pixels(**places, wavelength=wavelength)
            names = ["reflectance", *(["quality"] if wavelength is None else [])]
            assert set(region.data_vars) == set(names)
            for each in names:
                made, right = region[each], expected[each]
                assert (made.dims, made.attrs.keys()) == (right.dims, right.attrs.keys())
                assert made.values.tobytes() == right.values.tobytes(), (each, places)
            np.testing.assert_array_equal(region.wavelength.values, expected.wavelength.values)


@pytest.mark.parametrize("chunks", [{}, None])
def test_of_a_store_only_the_chunks_are_read_that_are_needed(
    tmp_path: Path, chunks: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    hp.to_store(smiling(), tmp_path / "line.zarr")
    line = xr.open_zarr(tmp_path / "line.zarr", chunks=chunks)
    expected = line.paint.reflectance().reflectance[40, :, 7].values
    pixels(line, 40, 7)  # what is small is read
    keys: list[str] = []
    from zarr.storage import LocalStore

    plain = LocalStore.get

    async def get(store: Any, key: str, *args: Any, **options: Any) -> Any:
        keys.append(key)
        return await plain(store, key, *args, **options)

    monkeypatch.setattr(LocalStore, "get", get)
    with dask.config.set(scheduler=lambda *_args, **_options: pytest.fail("dask computes")):
        region = pixels(line, 40, 7)
    assert (keys, region.reflectance.values.tobytes()) == (["counts/c/1/0/0"], expected.tobytes())


# --- the plan


def lazily(line: xr.Dataset) -> xr.Dataset:
    return line.chunk({"along_track": 32})


def pixel(line: xr.Dataset) -> np.ndarray:
    return pixels(line, 5, 5).reflectance.values


def test_a_second_look_makes_no_second_plan(plans: list[Any]) -> None:
    line = lazily(smiling())
    for along in range(3):
        pixels(line, along, 0)
    first = line.paint.reflectance()
    np.testing.assert_array_equal(first.reflectance[5].values, pixels(line, 5).reflectance.values)
    assert len(plans) == 1
    # a lazy cube that computes the plan leaves it to the next
    other = lazily(smiling().assign_attrs(title="another"))
    for _ in range(3):
        other.paint.reflectance().reflectance[:1].compute()
        assert len(plans) == 2


def test_a_plan_at_hand_changes_no_name(cache: planning.PlanCache) -> None:
    line, cubes = lazily(smiling()), []
    for number in range(3):
        assert bool(cache._entries) == (number > 0)
        cubes.append(line.paint.reflectance().reflectance)
        cubes[-1][:1].compute()
    assert len({(cube.data.name, cube[:40].values.tobytes()) for cube in cubes}) == 1


def replaced(line: xr.Dataset, name: str) -> xr.Dataset:
    values = line[name].values * 1.01
    return line.assign({name: line[name].copy(data=values.astype(line[name].dtype))})


@pytest.mark.parametrize("is_lazy", [False, True])
@pytest.mark.parametrize("name", ["dark_counts", "radiance_gain", "irradiance", "exposure_time"])
def test_what_is_replaced_counts(name: str, is_lazy: bool, plans: list[Any]) -> None:
    line = lazily(smiling()) if is_lazy else smiling()
    before, changed = pixel(line), replaced(line, name)
    after = pixel(changed)
    assert len(plans) == 2
    assert not np.array_equal(before, after)
    np.testing.assert_array_equal(after, changed.paint.reflectance().reflectance[5, :, 5].values)
    np.testing.assert_array_equal(before, pixel(line))
    assert len(plans) == 2


def test_what_is_assigned_in_place_or_written_anew_counts(tmp_path: Path) -> None:
    hp.to_store(smiling(), tmp_path / "line.zarr")
    stored = (xr.open_zarr(tmp_path / "line.zarr", **options) for options in ({}, {"chunks": None}))
    for line in (smiling(), *stored):
        before = pixel(line)
        line["exposure_time"][...] = line.exposure_time.values * 2
        line["radiance_gain"][...] = line.radiance_gain.values * 3
        np.testing.assert_allclose(pixel(line), before * 1.5, rtol=1e-6)
        line["radiance_gain"][...] = line.radiance_gain.values / 3
        np.testing.assert_allclose(pixel(line), before / 2, rtol=1e-6)
    # a store that is written anew
    group = "flightlines/a"
    store = hp.to_store(smiling(), tmp_path / "lot.zarr", group)
    before = pixel(xr.open_zarr(store, group=group))
    hp.to_store(replaced(smiling(), "radiance_gain"), store, group, overwrite=True)
    for line in (xr.open_zarr(store, group=group), hp.open_store(store, group)):
        np.testing.assert_allclose(pixel(line), before * 1.01, rtol=1e-5)
        np.testing.assert_array_equal(pixel(line), line.paint.reflectance().reflectance[5, :, 5].values)


def test_attributes_count(plans: list[Any]) -> None:
    line = smiling()
    before = pixel(line)
    longer = line.assign(exposure_time=line.exposure_time.copy())
    longer["exposure_time"].attrs["units"] = "minute"
    np.testing.assert_allclose(pixel(longer), before / 60, rtol=1e-5)
    assert not np.array_equal(pixel(line.assign_attrs(srf_shape="slit")), before)
    assert len(plans) == 3
    # counts and radiance have plans of their own
    line = smiling().paint.radiance()
    of_radiance = pixel(line.drop_vars("counts"))
    np.testing.assert_allclose(of_radiance, pixel(line), rtol=1e-5)
    assert np.isfinite(of_radiance).any()


def test_few_plans_are_held_and_no_cube(
    cache: planning.PlanCache, monkeypatch: pytest.MonkeyPatch, plans: list[Any]
) -> None:
    line = lazily(smiling())
    cube, expected = weakref.ref(line.counts.data), line.paint.reflectance().reflectance[5, :, 5].values
    for number in range(planning.MAX_PLANS + 3):
        pixels(line.assign_attrs(title=str(number)), 0, 0)
    assert len(cache._entries) == planning.MAX_PLANS
    assert sum(entry.nbytes for entry in cache._entries) < planning.MAX_BYTES
    # a plan that is too large is not held
    monkeypatch.setattr(planning, "MAX_BYTES", 10_000)
    made = len(plans)
    for _ in range(2):
        np.testing.assert_array_equal(pixel(line), expected)
    assert len(plans) == made + 2
    assert not cache._entries
    del line
    gc.collect()
    assert cube() is None


def test_many_threads_look_at_once() -> None:
    lines = [lazily(smiling().assign_attrs(title=str(number))) for number in range(3)]
    expected = lines[0].paint.reflectance().reflectance.values
    wrong: list[Any] = []

    def look(start: int) -> None:
        for number in itertools.islice(itertools.count(start), 20):
            along = number % 70
            region = pixels(lines[number % 3], along, slice(2, 9))
            if region.reflectance.values.tobytes() != expected[along, :, 2:9].tobytes():
                wrong.append(along)

    threads = [threading.Thread(target=look, args=(start,)) for start in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_derived_cubes_and_stored_reflectance_are_read() -> None:
    line = lazily(smiling())
    line = line.assign(counts=line.counts.copy(data=da.flip(da.flip(line.counts.data, 0), 0)))
    region = pixels(line, slice(30, 34), 3)
    np.testing.assert_array_equal(region.reflectance, line.paint.reflectance().reflectance[30:34, :, 3])
    # where there is nothing else, what is stored
    stored = smiling().paint.reflectance()[["reflectance"]]
    region = pixels(stored, slice(3, 5), 2)
    np.testing.assert_array_equal(region.reflectance, stored.reflectance[3:5, :, 2])
    expect_errors(
        (SchemaError, r"'reflectance'.*variable-missing", lambda: pixels(stored.drop_vars("reflectance"))),
        (SchemaError, r"along_track 70 .*pixel-outside-line", lambda: pixels(smiling(), 70, 0)),
        (SchemaError, r"3000 nm.*band-missing", lambda: pixels(smiling(), 0, 0, wavelength=3000.0)),
    )
