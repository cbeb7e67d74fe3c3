"""Tracing as labelled, lazy arrays: the same bits whatever the chunks, nothing done until it is asked for."""

import contextlib
import json
import pickle
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error
from support.traced_scenes import LOW_SUN, SUN, flight, two_cars

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import VARIABLES
from hyperpaint.simulation.atmosphere import preset_atmosphere
from hyperpaint.simulation.rendering import relighting
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import KINDS, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import Scene, SceneRecord, TraceSettings, plane, sun_vectors

SETTINGS: dict[str, Any] = {"samples": 8, "seed": 3, "overcast": True, "sun_radius": 0.27}
DIMS = {"along_track": 24, "slot": 104, "cross_track": 16, "sun": 2}


def traced(chunk_lines: int = 32, **more: Any) -> xr.Dataset:
    return hp.simulation.trace(
        two_cars(), flight(), [SUN, LOW_SUN], chunk_lines=chunk_lines, **{**SETTINGS, **more}
    )


@pytest.fixture(scope="module")
def whole() -> xr.Dataset:
    with dask.config.set(scheduler="synchronous"):
        return traced().compute()


def test_slots_grow_with_sources_and_samples() -> None:
    one = TraceSettings([SUN]).slot_count
    assert one == TraceSettings([SUN], samples=256).slot_count / 2 == 144
    assert TraceSettings([SUN], clear=False).slot_count == one / 3
    assert TraceSettings([SUN, LOW_SUN], overcast=True).slot_count == 2 * one
    assert (TraceSettings([SUN], samples=1).slot_count, TraceSettings([SUN], slots=5).slot_count) == (24, 5)


def test_variables_are_those_of_the_table_before_and_after(whole: xr.Dataset, no_compute: Any) -> None:
    with no_compute():
        lazy = traced(7)
    assert (dict(lazy.sizes), set(lazy.data_vars)) == (DIMS, set(relighting._LAYOUT))
    for made in (lazy, whole):
        for name, array in made.variables.items():
            row = VARIABLES[str(name)]
            assert (array.dims, array.dtype) == (row.dims, row.dtype), name
            assert array.attrs.get("units", "") == row.units, name
    for name in lazy.data_vars:
        assert lazy[name].chunks is not None, name
        assert (lazy[name].chunksizes["along_track"], lazy[name].shape) == ((7, 7, 7, 3), whole[name].shape)
    assert set(whole.coords) == {"time", "sun_zenith", "sun_azimuth"}


@pytest.mark.parametrize("chunk_lines", [1, 7, 24])
@pytest.mark.slow
def test_the_same_bits_whatever_the_chunks(
    whole: xr.Dataset, scheduler_of_lines: Callable[[int], Any], chunk_lines: int
) -> None:
    with scheduler_of_lines(chunk_lines):
        xr.testing.assert_identical(traced(chunk_lines).compute(), whole)


def test_a_block_is_what_the_dataset_holds_and_another_seed_another_draw(whole: xr.Dataset) -> None:
    prepared = relighting.prepare_scene(two_cars(), TraceSettings([SUN, LOW_SUN], **SETTINGS))
    np.testing.assert_allclose(prepared.sources.sun_radius, np.radians([0.27, 0.27]))
    block = relighting.trace_block(prepared, flight(), 5, 9)
    np.testing.assert_array_equal(block.weight, whole.transport_weight.values[5:9])
    np.testing.assert_array_equal(block.code, whole.transport_path.values[5:9])
    np.testing.assert_array_equal(block.position[:, 2], whole.up.values[5:9])
    assert (traced(seed=4).transport_weight.values != whole.transport_weight.values).any()


@pytest.mark.parametrize("scheduler", ["synchronous", "threads"])
def test_the_scene_is_prepared_once(monkeypatch: pytest.MonkeyPatch, scheduler: str) -> None:
    calls = []
    prepare = relighting.prepare_scene

    def counted(*args: Any) -> Any:
        calls.append(args)
        return prepare(*args)

    monkeypatch.setattr(relighting, "prepare_scene", counted)
    with dask.config.set(scheduler=scheduler):
        traced(2, samples=1).compute()
    assert len(calls) == 1


def test_each_block_is_traced_once_for_all_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    first_lines = []
    task = relighting.trace_rays

    def counted(*args: Any) -> Any:
        first_lines.append(args[-1])
        return task(*args)

    monkeypatch.setattr(relighting, "trace_rays", counted)
    with dask.config.set(scheduler="synchronous"):
        traced(8, samples=1).compute()
        assert sorted(first_lines) == [0, 8, 16]
        traced(8, samples=1).isel(along_track=slice(9, 12)).compute()
    assert first_lines[3:] == [8]


def test_graph_of_a_long_line_is_quick(no_compute: Any, record_property: Any) -> None:
    scene, platform = two_cars(), pushbroom(100_000, 640)
    begin = clock.perf_counter()
    with no_compute():
        made = hp.simulation.trace(scene, platform, [SUN])
    record_property("seconds", clock.perf_counter() - begin)
    assert clock.perf_counter() - begin < 5.0  # a third of a second on an idle machine
    assert made.transport_weight.data.npartitions == 3125
    # the scene is in the graph once, and a task knows no lines but its own
    assert sum("prepare" in str(key) for key in dict(made.transport_weight.data.__dask_graph__())) == 1


def test_a_car_park_is_sent_without_a_warning() -> None:
    # Of a graph of 10 MB dask says that it is large
    park = car_park()
    made, again = (
        hp.simulation.trace(scene, flight(), [SUN]).transport_weight.data
        for scene in (park, pickle.loads(pickle.dumps(park)))
    )
    assert len(pickle.dumps(dict(made.__dask_graph__()))) < 8e6
    assert made.name == again.name


def test_labels_say_what_is_seen(whole: xr.Dataset) -> None:
    scene = two_cars()
    record, settings = SceneRecord.from_attrs(whole.attrs)
    assert (record, settings) == (SceneRecord.of(scene), TraceSettings([SUN, LOW_SUN], **SETTINGS))
    names = [instance["name"] for instance in json.loads(whole.attrs["instances"])]
    assert names == [instance.name for instance in scene.instances]
    cars = {names[number] for number in np.unique(whole.car_id) if number >= 0}
    assert cars == {"car_0", "car_1"}
    np.testing.assert_array_equal(whole.car_id >= 0, whole.paint_id >= 0)
    meanings = whole["paint_id"].attrs["flag_meanings"].split()
    on = {name: whole.car_id.values == names.index(name) for name in cars}
    assert meanings[int(whole["paint_id"].values[on["car_0"]][0])] == "red"
    assert meanings[int(whole["paint_id"].values[on["car_1"]][0])] == "blue"
    assert whole.surface_class.attrs["flag_meanings"].split() == list(KINDS)
    on_ground = whole.instance.values == names.index("ground")
    assert (whole.surface_class.values[on_ground] == KINDS.index("asphalt")).all()
    np.testing.assert_allclose(whole.up.values[on_ground & (whole.purity.values == 1)], 0.0, atol=1e-9)
    assert ((whole.purity > 0) & (whole.purity <= 1)).all()


def test_the_sky_has_no_labels() -> None:
    made = hp.simulation.trace(
        plane(1.0), pushbroom(3, 9, altitude=10.0, ground_sample=1.0), [SUN], samples=2
    ).compute()
    assert (made.instance.values[:, 0] == -1).all()
    for name in ("material", "surface_class", "paint_id", "car_id"):
        assert (made[name].values[:, 0] == -1).all(), name
    assert set(np.unique(made.transport_path.values[:, :, 0])) == {-1, 0}  # the sky itself, and empty slots


def test_suns_may_be_atmospheres_or_their_names() -> None:
    noon = preset_atmosphere("noon")
    made = hp.simulation.trace(plane(), flight(1, 1), ["noon", noon, "near_sunset", SUN])
    sunset = preset_atmosphere("near_sunset")
    assert made.sun_zenith.values.tolist() == [noon.sun_zenith, sunset.sun_zenith, SUN[0]]
    assert made.attrs["overcast"] == 0
    assert hp.simulation.trace(plane(), flight(1, 1), "cloudy").attrs["overcast"] == 1
    np.testing.assert_allclose(sun_vectors([(90.0, 0.0)]), [[0.0, 1.0, 0.0]], atol=1e-15)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"suns": []}, "sun-number"),
        ({"suns": [(zenith, 0.0) for zenith in range(7)]}, "sun-number"),
        ({"suns": [(95.0, 0.0)]}, "sun 0 has zenith 95"),
        ({"suns": [(np.nan, 0.0)]}, "sun-unreadable"),
        ({"suns": 3}, "sun-unreadable"),
        ({"suns": [("a", 1)]}, "sun-unreadable"),
        ({"suns": ["midnight"]}, "midnight"),
        ({"samples": 0}, "samples=0"),
        ({"samples": 2.5}, "samples=2.5"),
        ({"seed": -1}, "seed=-1"),
        ({"slots": 0}, "slots=0"),
        ({"depth": 32}, "path-code-too-long"),
        ({"sun_radius": -1.0}, "sun_radius"),
        ({"chunk_lines": 0}, "chunk_lines=0"),
    ],
)
def test_settings_out_of_range(wrong: dict[str, Any], found: str) -> None:
    suns = wrong.pop("suns", [SUN])
    expect_error(SchemaError, found, lambda: hp.simulation.trace(two_cars(), flight(1, 1), suns, **wrong))


def test_all_problems_at_once_and_too_many_spectra_for_the_depth() -> None:
    wrong = {"suns": [(95.0, 0.0)], "samples": 0, "slots": 0}
    error = expect_error(SchemaError, None, lambda: hp.simulation.trace(plane(), flight(1, 1), **wrong))
    assert str(error).count("\n") == 3
    many = [Material(f"m{number}", "asphalt", "asphalt") for number in range(300)]
    scene = Scene.join([plane(1.0, material, instance=f"i{n}") for n, material in enumerate(many)])
    expect_error(
        SchemaError, "path-code-too-long", lambda: hp.simulation.trace(scene, flight(1, 1), [SUN], depth=7)
    )


def test_a_store_holds_a_traced_scene(tmp_path: Path, whole: xr.Dataset, no_compute: Any) -> None:
    path = tmp_path / "traced.zarr"
    hp.to_store(traced(7), path)
    assert hp.verify(path).ok
    for opened in (xr.open_zarr(path), hp.open_store(path)):
        assert opened.transport_path.dtype == np.int64
        with contextlib.suppress(AttributeError):
            assert opened.transport_weight.chunksizes["along_track"] == (24,)
        xr.testing.assert_equal(opened.compute(), whole)
        record, _ = SceneRecord.from_attrs(opened.attrs)
        assert record == SceneRecord.of(two_cars())
    # the same content, by name: nothing is traced again
    with no_compute():
        hp.to_store(traced(7), path)


def test_damaged_attributes_are_said_to_be_so(whole: xr.Dataset) -> None:
    for name, value, found in (
        ("materials", None, "metadata-missing"),
        ("factors", "[", "metadata-damaged"),
        ("factors", '[{"material": 99, "flakes": false}]', "metadata-damaged"),
        ("instances", "[1]", "metadata-damaged"),
        ("suns", "[]", "metadata-damaged"),
        ("depth", "4", "metadata-damaged"),
        ("materials", '[{"name": 1}]', "metadata-damaged"),
    ):
        attrs = {**whole.attrs, name: value}
        if value is None:
            del attrs[name]
        with pytest.raises(SchemaError, match=found):
            SceneRecord.from_attrs(attrs)
